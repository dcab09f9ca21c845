"""Report on the installation: solvers, instruction set, extras, rendering, meshes.

`difflcs doctor [--json]`, or `python -m difflcs doctor`. Failures are reported, never raised. Simulation and
OpenGL are tried in separate processes, which may crash.
"""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module, metadata
from itertools import groupby
from textwrap import TextWrapper
from typing import Any

import torch

import difflcs
from difflcs import GoalCost, LCSModel, LCSMPCLayer, solve_lcp, zoo
from difflcs._checks import usable_cpus
from difflcs._optional import version
from difflcs._storage import load_record, read_json
from difflcs.errors import BackendNotFoundError, DiffLCSError

GROUPS = ("library", "solvers", "machine", "extras", "environments")
"""Groups of checks for users, in the order of the report."""
TIMEOUT = 120.0
"""Seconds that a separate process may take; the first picture in software takes some."""

_HARD = ("torch", "numpy", "casadi", "safetensors")
_OPTIONAL_BACKENDS = ("relaxed",)
_EXTRAS = {
    "rl": "training, evaluation and the command line",
    "envs": "the simulated robot hand",
    "viz": "videos and figures",
    "relaxed": "the backend relaxed",
    "scoreboard": "Push-T",
}
"""Extras for users → what they are for."""
_MARKS = {"ok": "ok", "missing": "--", "failed": "!!"}

# Each prints one JSON object as its last line.
_SIMULATION = """
import json, os
import gymnasium, numpy
import difflcs_envs
from difflcs_envs.assets import YCB_DIR_VARIABLE, find_ycb_mesh, ycb_download_directory
from difflcs_envs.ycb import YCB
difflcs_envs.register_envs()
envs = gymnasium.make_vec("difflcs/TriFingerMoveCube-v0", num_envs=2)
envs.reset(seed=0)
assert numpy.isfinite(envs.step(numpy.zeros((2, 6)))[0]["state"]).all(), "the state is not finite"
envs.close()
def mesh(entry):
    try:
        return find_ycb_mesh(entry) is not None
    except difflcs_envs.MeshError:  # DIFFLCS_YCB_DIR is set, and lacks it
        return None
chosen = os.environ.get(YCB_DIR_VARIABLE)
folder = f"{YCB_DIR_VARIABLE}={chosen}" if chosen else str(ycb_download_directory())
print(json.dumps({"meshes": {name: mesh(entry) for name, entry in YCB.items()}, "folder": folder}))
"""
_PICTURE = """
import json, os
import gymnasium
import difflcs_envs
difflcs_envs.register_envs()
env = gymnasium.make("difflcs/TriFingerMoveCube-v0", render_mode="rgb_array", width=32, height=32)
env.reset(seed=0)
picture = env.render()
env.close()
assert picture.shape == (32, 32, 3) and picture.std() > 0, "the picture is empty"
print(json.dumps({"gl": os.environ.get("MUJOCO_GL", "")}))
"""


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
        group: heading it belongs to.
        name: name of the check.
        status: "ok", "missing" (something optional that is not installed), or "failed".
        text: the result in words.
        remedy: advice; empty if there is nothing to do.
        core: True if the library does not work without it.
    """

    group: str
    name: str
    status: str
    text: str
    remedy: str = ""
    core: bool = False


class _MissingError(Exception):
    """Something optional is not installed."""

    def __init__(self, text: str, remedy: str):
        super().__init__(text)
        self.remedy = remedy


def examine(groups: Sequence[str] = GROUPS) -> list[Check]:
    """Run the checks; takes some seconds.

    Args:
        groups: groups to check, of `GROUPS`.
    """
    look = {
        "library": lambda: [_check("library", name, work, core=True) for name, work in _LIBRARY.items()],
        "solvers": _solvers,
        "machine": lambda: [_check("machine", name, work) for name, work in _MACHINE.items()],
        "extras": lambda: [_check("extras", name, lambda name=name: _extra(name)) for name in _EXTRAS],
        "environments": _environments,
    }
    return [check for group in groups for check in look[group]()]


def healthy(checks: Sequence[Check]) -> bool:
    """Return True if the library itself works, whatever else is missing."""
    return all(check.status == "ok" for check in checks if check.core)


def as_text(checks: Sequence[Check], width: int = 100) -> str:
    """Format one paragraph per check, with its remedy, and a verdict at the end."""
    wrap = TextWrapper(width, subsequent_indent=" " * 19, break_long_words=False, break_on_hyphens=False)
    lines: list[str] = []
    for group, members in groupby(checks, lambda check: check.group):
        lines.append(group)
        for check in members:
            lines += wrap.wrap(f"  {_MARKS[check.status]}  {check.name:<12} {check.text}")
            lines += wrap.wrap(f"{'':<19}→ {check.remedy}") * bool(check.remedy)
    rest = list(dict.fromkeys(check.name for check in checks if check.status != "ok" and not check.core))
    verdict = "The library works" if healthy(checks) else "The library does NOT work, see the lines with !!"
    return "\n".join([*lines, verdict + (f"; not here: {', '.join(rest)}." if rest else ".")])


def _check(group: str, name: str, work: Callable[[], str], core: bool = False) -> Check:
    try:
        return Check(group, name, "ok", work(), core=core)
    except _MissingError as error:
        return Check(group, name, "missing", str(error), error.remedy, core)
    except Exception as error:  # a broken package raises anything
        text = " ".join(str(error).split())
        if isinstance(error, DiffLCSError | RuntimeError) and text:  # its message says how to mend it
            return Check(group, name, "failed", text, core=core)
        remedy = "install difflcs again: pip install --force-reinstall difflcs" if core else ""
        return Check(group, name, "failed", f"{type(error).__name__}: {text}", remedy, core)


# --- library and solvers ----------------------------------------------------------------------------------------------


def _kernels() -> str:
    """Solve an LCP with a known solution by the compiled kernels."""
    from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]

    lam = solve_lcp(torch.eye(2, dtype=torch.float64), torch.tensor([-1.0, 2.0], dtype=torch.float64)).lam
    if not torch.allclose(lam, torch.tensor([1.0, 0.0], dtype=torch.float64)):
        raise RuntimeError(f"expected [1, 0] as the solution of an LCP, got {lam.tolist()}")
    chosen = os.environ.get("DIFFLCS_ISA")
    why = f"by DIFFLCS_ISA={chosen}" if chosen else "the widest that this CPU has"
    return f"loaded, instruction set {_kernels.isa()} ({why})"


def _files() -> str:
    model = _tiny_model()
    with tempfile.TemporaryDirectory() as folder:
        model.save_pretrained(folder)
        again = LCSModel.from_pretrained(folder)
    if not torch.equal(model.A, again.A):
        raise RuntimeError("expected the model that was saved, got another one back")
    return "models are saved and read again"


def _models() -> str:
    for name in zoo.names():
        # A system of known physics needs its task to be built again: of that only the files are read.
        header: Any = read_json(zoo.path(name) / "config.json")
        if header["kind"] == "LCSModel":
            LCSModel.from_pretrained(f"zoo:{name}")
        else:
            load_record(zoo.path(name), header["kind"])
    return f"learned models that ship with the package: {len(zoo.names())}"


def _tiny_model() -> LCSModel:
    return LCSModel(2, 1, 1, init_scale=0.1, generator=torch.Generator().manual_seed(0))


def _solvers() -> list[Check]:
    return [
        _check("solvers", name, lambda name=name: _solves(name), core=name not in _OPTIONAL_BACKENDS)
        for name in dict.fromkeys(("batched", "ipopt", *_OPTIONAL_BACKENDS, *difflcs.available_backends()))
    ]


def _solves(name: str) -> str:
    """Plan a few steps with a tiny model, and differentiate the plan."""
    model = _tiny_model()
    cost = GoalCost.reach(2, 1, goal_weight=(1.0,), input_weight=0.1)
    try:
        mpc = LCSMPCLayer(model, cost, horizon=3, u_min=-1.0, u_max=1.0, backend=name)
    except BackendNotFoundError as error:
        what, _, remedy = str(error).partition("; run: ")
        raise _MissingError(what.partition(": ")[2], remedy) from error
    state, goal = torch.tensor([0.1, 0.0], dtype=torch.float64), torch.tensor([0.3], dtype=torch.float64)
    mpc(state, goal)  # the first call loads the solver
    start = time.perf_counter()
    plan = mpc(state, goal)
    plan.action.sum().backward()
    seconds = time.perf_counter() - start
    if model.B.grad is None or not bool(torch.isfinite(model.B.grad).all()):
        raise RuntimeError("expected a finite gradient, got another one")
    return f"solves and differentiates a tiny problem, {1e3 * seconds:.1f} ms"


# --- machine ----------------------------------------------------------------------------------------------------------


def _threads() -> str:
    variable = os.environ.get("OMP_NUM_THREADS")
    return f"{usable_cpus()} of {os.cpu_count()} cores usable" + (f", OMP_NUM_THREADS={variable}" if variable else "")


def _devices() -> str:
    if not torch.cuda.is_available():
        return "cpu; no GPU that torch can use (none is needed: the solvers run on the CPU)"
    gpus = ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
    return f"cpu and {gpus}; tensors there are accepted and returned, the solvers run on the CPU"


def _extra(name: str) -> str:
    """Check the packages of an extra, which the metadata of the package lists."""
    wanted = [line for line in metadata.requires("difflcs") or () if re.search(rf"extra == ['\"]{name}['\"]", line)]
    if not wanted:
        raise RuntimeError("expected packages in the metadata of difflcs, got none; install difflcs again")
    present, lacking = [], []
    for line in wanted:
        match = re.match(r"[\w.-]+", line)
        package = match[0] if match else line
        found, least = version(package), re.search(r">=\s*([\w.]+)", line)
        if found is None:
            lacking.append(package)
        elif least and _release(found) < _release(least[1]):
            lacking.append(f"{package} >= {least[1]} (found {found})")
        else:
            present.append(f"{package} {found}")
    if lacking:
        raise _MissingError(f"for {_EXTRAS[name]}: without {', '.join(lacking)}", f'pip install "difflcs[{name}]"')
    return f"{_EXTRAS[name]}: {', '.join(present)}"


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version.partition("+")[0])[:3])


# --- environments -----------------------------------------------------------------------------------------------------


def _environments() -> list[Check]:
    report: dict[str, Any] = {}

    def simulation() -> str:
        report.update(_in_process(_SIMULATION))
        return "the cube's environments step"

    def meshes() -> str:
        return _meshes(report["meshes"], report["folder"])

    checks = [_check("environments", "simulation", simulation)]
    checks += [_check("environments", "pictures", _pictures), _check("environments", "video", _video)]
    return checks + [_check("environments", "YCB meshes", meshes)] * bool(report)


def _pictures() -> str:
    gl = _in_process(_PICTURE)["gl"]
    return f"a 32 × 32 picture is drawn, {f'MUJOCO_GL={gl}' if gl else 'on the display'}"


def _video() -> str:
    if version("imageio-ffmpeg") is None:
        raise _MissingError("without imageio-ffmpeg", 'pip install "difflcs[viz]"')
    import imageio_ffmpeg

    return f"ffmpeg {imageio_ffmpeg.get_ffmpeg_version()}"


def _meshes(state: dict[str, bool | None], folder: str) -> str:
    """Report the objects with a mesh; None in `state` means that the folder which the user named lacks it."""
    there = [name for name, has_mesh in state.items() if has_mesh]
    absent = [name for name, has_mesh in state.items() if not has_mesh]
    if not absent:
        return f"all {len(there)} in {folder}"
    download = f"difflcs assets download {' '.join(absent) if there else ''}".strip()
    if None in state.values():
        raise _MissingError(f"{folder} lacks {', '.join(absent)}", f"{download}, or unset DIFFLCS_YCB_DIR")
    raise _MissingError(f"{', '.join(there) or 'none'} in {folder}; stand-ins for {', '.join(absent)}", download)


def _in_process(code: str) -> dict[str, Any]:
    if any(version(package) is None for package in ("gymnasium", "mujoco")):
        raise _MissingError("without gymnasium and mujoco", 'pip install "difflcs[envs]"')
    command = [sys.executable, "-c", code]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"no answer within {TIMEOUT:g} s") from None
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        raise RuntimeError(lines[-1] if lines else f"the process ended with code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


_LIBRARY: dict[str, Callable[[], str]] = {
    "python": lambda: f"{platform.python_version()}, {platform.system()} {platform.machine()}",
    "difflcs": lambda: difflcs.__version__,
    "packages": lambda: ", ".join(f"{name} {import_module(name).__version__}" for name in _HARD),
    "kernels": _kernels,
    "files": _files,
    "zoo": _models,
}
_MACHINE: dict[str, Callable[[], str]] = {"threads": _threads, "devices": _devices}


def main(as_object: bool = False) -> int:
    """Run the checks and print the report.

    Args:
        as_object: print JSON instead of text.

    Returns:
        Exit code: 0 if the library works, 1 if not.
    """
    checks = examine()
    if as_object:
        print(json.dumps({"ok": healthy(checks), "checks": [asdict(check) for check in checks]}, sort_keys=True))
    else:
        print(as_text(checks, min(120, shutil.get_terminal_size().columns)))
    return 0 if healthy(checks) else 1
