"""The package from outside: what an import costs, what imports what, and that the README runs."""

import ast
import re
from pathlib import Path

import pytest

import difflcs
from tests.conftest import python

ROOT = Path(__file__).resolve().parents[2]
HEAVY = (
    "casadi", "cvxpy", "cvxpylayers", "torchrl", "tensordict", "gymnasium", "mujoco", "tyro", "scipy", "matplotlib",
    "trimesh", "coacd", "numba", "filelock", "pooch", "safetensors", "tqdm", "tensorboard", "imageio", "dask",
)  # fmt: skip


def sources(folder):
    return sorted((ROOT / folder).rglob("*.py"))


CALLS = """
m = difflcs.LCSModel(2, 1, 1)
x, u = torch.zeros(3, 2).double(), torch.zeros(3, 1).double()
difflcs.violation_loss(m, x, u, x).backward()
m(x, u).x_next.sum().backward()
"""
TASKS = """
from difflcs.rl.tasks import get_task, task_names
assert {"cube", "mug"} <= set(task_names())
get_task("cube")
"""
# What a process does, one after the other, and what is not loaded by then besides what torch and NumPy load.
STEPS = (
    ("import sys, torch, numpy", ()),
    ("import difflcs", (*HEAVY, "difflcs.zoo")),
    ("difflcs.available_backends()", ("casadi", "cvxpy", "cvxpylayers")),
    (CALLS, ("torch._dynamo",)),
    ("from difflcs import zoo; zoo.card('trifinger-cube')", ("difflcs.rl", "safetensors", "gymnasium", "tyro")),
    ("import difflcs.rl", ("torchrl", "tensordict")),
    (TASKS, ("mujoco",)),
)


@pytest.fixture(scope="module")
def loaded():
    """Names of the modules after each step."""
    printed = python("-c", "\nprint(*sys.modules)\n".join([*dict(STEPS), ""])).stdout
    return [set(names.split()) for names in printed.splitlines()]


@pytest.mark.parametrize("step", range(1, len(STEPS)))
def test_nothing_is_imported_before_it_is_needed(loaded, step):
    assert "difflcs" in loaded[step]
    assert not (loaded[step] - loaded[0]) & set(STEPS[step][1])


def test_import_leaves_global_state_alone():
    done = python(
        "-c",
        """
import torch, warnings, signal, random
import numpy as np
before = torch.get_default_dtype(), torch.get_num_threads(), torch.initial_seed(), len(warnings.filters)
state = torch.random.get_rng_state(), signal.getsignal(signal.SIGINT)
import difflcs
assert before == (torch.get_default_dtype(), torch.get_num_threads(), torch.initial_seed(), len(warnings.filters))
assert torch.equal(state[0], torch.random.get_rng_state()) and state[1] is signal.getsignal(signal.SIGINT)
print("same")
""",
    )
    assert done.stdout.strip() == "same"


def test_every_exported_name_exists_and_is_documented():
    assert sorted(set(difflcs.__all__)) == sorted(difflcs.__all__)
    for name in difflcs.__all__:
        value = getattr(difflcs, name)
        assert value.__doc__, f"{name} has no docstring"
        assert value.__module__.startswith("difflcs."), name


def test_the_version_is_one_and_the_same():
    from importlib.metadata import version

    assert difflcs.__version__ == version("difflcs")
    assert re.fullmatch(r"\d+\.\d+\.\d+.*", difflcs.__version__)


def test_no_pickle_and_no_torch_save():
    unsafe = r"^\s*(import|from) (pickle|cloudpickle|dill|joblib|shelve|marshal)\b|\btorch\.(save|load)\("
    unsafe += r"|allow_pickle=(?!False)"
    assert [path for path in sources("difflcs") if re.search(unsafe, path.read_text(), re.MULTILINE)] == []


def test_the_readmes_example_runs_and_prints_a_gradient(tmp_path):
    readme = ROOT / "README.md"
    blocks = re.findall(r"```python\n(.*?)```", readme.read_text(), re.DOTALL)
    assert blocks, "README.md has no python example"
    script = tmp_path / "example.py"
    script.write_text(blocks[0])
    done = python("-W", "error", script, cwd=tmp_path)
    assert re.search(r"tensor\(|\d\.\d", done.stdout), "nothing was printed that looks like a gradient"
    numbers = [float(v) for v in re.findall(r"-?\d+\.\d*(?:e[+-]?\d+)?", done.stdout)]
    assert any(v != 0 for v in numbers)
    assert "nan" not in done.stdout
    assert "grad" in blocks[0]


def test_only_commands_print():
    """What the library has to say it logs (`difflcs.rl.runs.training`), returns, raises or warns."""
    for path in sources("difflcs"):
        if path.relative_to(ROOT / "difflcs").parts[0] not in ("cli", "__main__.py"):
            calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
            assert "print" not in {ast.unparse(call.func) for call in calls}, path


def test_errors_refer_to_what_every_installation_has():
    from difflcs import errors

    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.DiffLCSError)]
    known = {kind.see for kind in kinds} - {None}
    assert known
    for text in known:
        name = text.removeprefix("help(difflcs.").removesuffix(")")
        assert text == "difflcs doctor" or len(getattr(difflcs, name).__doc__) > 500, text
