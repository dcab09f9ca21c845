"""The C library from outside: built and installed without Python, found by CMake, and bit-equal to Python."""

import csv
import functools
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from difflcs import LCSModel, LCSMPCLayer, cli
from difflcs.errors import InvalidInputError
from difflcs.mpc import MPCController
from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.export import export_controller
from difflcs.physics import BodyFrameLCS
from difflcs.rl import TrainedPolicy
from difflcs.rl.tasks import get_task, single_start_backend
from difflcs.systems import pushing_cost
from tests.conftest import refuse

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ("cmake", "cc", "c++")
MODEL = "zoo:trifinger-cube-violation"  # with the full range of actions, which it uses: few of them lie at a bound
needs_tools = pytest.mark.skipif(
    any(shutil.which(tool) is None for tool in TOOLS),
    reason="building C needs cmake, cc and c++, which are not all here",
)
# One instruction set is compiled, and Python takes the same one.
BASELINE = {**os.environ, "DIFFLCS_ISA": "baseline"}


def call(*command, **kwargs):
    done = subprocess.run(
        [str(c) for c in command], capture_output=True, text=True, timeout=900, check=False, env=BASELINE, **kwargs
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The cube's controller, and a trajectory of states and goals that it saw."""
    folder = tmp_path_factory.mktemp("export")
    assert cli.main(["export", MODEL, "--out", str(folder)]) == 0
    rng = np.random.default_rng(0)
    controller = MPCController.load(folder / "controller.difflcs")
    rows, x, goal = [], np.zeros(9), np.zeros(3)
    for k in range(60):
        if k % 20 == 0:
            goal = rng.uniform([-0.05, -0.05, -0.5], [0.05, 0.05, 0.5])
        rows.append([*x, *goal])
        controller.step(x, goal)
        x = controller.plan.x[1] + 1e-3 * rng.normal(size=9)
    rows[30][4] = float("nan")  # a sensor that failed once
    names = ",".join([f"x{i}" for i in range(9)] + [f"goal{i}" for i in range(3)])
    np.savetxt(folder / "trajectory.csv", rows, "%.17g", ",", header=names, comments="")
    return folder


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Where the C library was installed, built by the documented commands for the baseline alone."""
    folder = tmp_path_factory.mktemp("library")
    build, prefix = folder / "build", folder / "prefix"
    options = ["-DDIFFLCS_C_LIBRARY=ON", "-DDIFFLCS_ISAS=none", "-DPython_EXECUTABLE=none"]
    options.append("-DCMAKE_CXX_FLAGS_RELEASE=-O1 -DNDEBUG")  # the same numbers, compiled in a third of the time
    call("cmake", "-S", ROOT, "-B", build, *options)
    call("cmake", "--build", build)
    call("cmake", "--install", build, "--prefix", prefix)
    return prefix


@pytest.fixture(scope="module")
def project(installed, tmp_path_factory):
    """Builds a project that finds the library."""

    @functools.cache
    def make(source):
        folder = tmp_path_factory.mktemp("project")
        call("cmake", "-S", ROOT / source, "-B", folder, f"-DCMAKE_PREFIX_PATH={installed}")
        call("cmake", "--build", folder)
        return folder

    return make


@pytest.fixture(scope="module")
def robot(project):
    """The example."""
    return project("examples/c") / "robot"


PYTHON = """
import csv, sys
import numpy as np
from difflcs.mpc import MPCController
controller = MPCController.load(sys.argv[1])
rows = np.array([[float(v) for v in row] for row in list(csv.reader(open(sys.argv[2])))[1:]])
for row in rows:
    u = controller.step(row[:9], row[9:])
    print(controller.status.name, *(v.hex() for v in u), sep=",")
"""


@pytest.mark.slow
@needs_tools
def test_the_example_closes_the_loop_bit_equal_to_python(exported, robot):
    files = exported / "controller.difflcs", exported / "trajectory.csv"
    names, *rows = csv.reader(call(robot, *files).splitlines())
    assert names == ["status", *(f"u{j}" for j in range(6))]
    ours = [(row[0], *(float(v).hex() for v in row[1:])) for row in rows]
    theirs = [tuple(line.split(",")) for line in call(sys.executable, "-c", PYTHON, *files).splitlines()]
    assert ours == theirs
    assert len(ours) == 60
    statuses = [row[0] for row in ours]
    assert statuses[30] == "NUMERICAL"
    assert statuses.count("CONVERGED") + statuses.count("DEGENERATE") >= 58
    assert len({row[1:] for row in ours}) > 50  # the robot moves
    bare = exported / "bare.csv"  # without the line of names
    bare.write_text(files[1].read_text().partition("\n")[2])
    assert [*csv.reader(call(robot, files[0], bare).splitlines())][1:] == rows


@pytest.mark.slow
@needs_tools
def test_a_hand_is_linearised_anew_before_each_step(project, tmp_path):
    gymnasium, tasks = pytest.importorskip("gymnasium"), pytest.importorskip("difflcs_envs.tasks")
    env = gymnasium.make("difflcs/HandTurnObject-v0").unwrapped
    goal, module = torch.from_numpy(env.reset(seed=0)[0]["goal"]), tasks.hand_system(env.model)
    options = {"horizon": 4, "backend": BatchedBackend(restarts=1), "relaxation": 1e-3}
    mpc = LCSMPCLayer(module, tasks.hand_cost(module), u_min=-0.05, u_max=0.05, **options)
    files, controller, steps = (tmp_path / "hand.difflcs", tmp_path / "changes"), mpc.controller(), []
    for _ in range(4):
        x = module.observe(env.data)
        lcs, cost = module.params(x), mpc.cost.at(x, goal)
        low, high = (bound.clamp(-0.05, 0.05) for bound in module.action_bounds(x))
        if not steps:
            LCSMPCLayer(lcs, cost, u_min=low, u_max=high, **options).controller().save(files[0])
        env.step(u := controller.step(x, goal))
        weights = cost.Q, cost.R, torch.zeros(22, 16), cost.Q_final, cost.q, cost.r, cost.q_final
        arrays = *lcs.tensors().values(), *weights, low, high, x, torch.from_numpy(u)
        steps += [array.double().flatten() for array in arrays]
    files[1].write_bytes(torch.cat(steps).numpy().tobytes())
    assert call(project("tests/native/c") / "contract_difflcs", *files) == "all holds\n"


@pytest.mark.slow
@needs_tools
def test_what_the_header_promises(exported, project, build, tmp_path):
    folder, searching = project("tests/native/c"), BatchedBackend(effort="best")
    mpc = LCSMPCLayer(LCSModel.from_pretrained(MODEL), pushing_cost(), 8, -0.015, 0.015, backend=searching)
    mpc.controller().save(tmp_path / "best.difflcs")
    for kind, file in (("difflcs", exported / "controller.difflcs"), ("difflcs_static", tmp_path / "best.difflcs")):
        assert call(folder / f"contract_{kind}", file) == "all holds\n"


@pytest.mark.slow
@needs_tools
def test_the_example_measures_itself(exported, robot):
    text = call(robot, exported / "controller.difflcs", exported / "trajectory.csv", "--bench", "300")
    assert text.startswith("300 steps, baseline, ")
    whole, solver = (
        [float(v) for v in re.findall(r"\d+\.\d+", line)] for line in text.splitlines()[1:] if "p50" in line
    )
    assert 0 < solver[0] <= whole[0] <= whole[1] <= whole[2]


@pytest.mark.slow
@needs_tools
def test_push_t_in_c_decides_as_in_python(project, tmp_path):
    files, program = [tmp_path, tmp_path / "observations.csv"], project("examples/c") / "push_t"
    call(sys.executable, ROOT / "examples" / "push_t.py", "--export", tmp_path, "--simulated")
    outputs = call(program, *files), (tmp_path / "actions.csv").read_text()
    ours, theirs = ([line.split(",") for line in output.splitlines()] for output in outputs)
    assert [row[:2] for row in ours] == [row[:2] for row in theirs]
    targets = [np.array([row[2:] for row in rows[1:]], float) for rows in (ours, theirs)]
    np.testing.assert_allclose(*targets, rtol=0, atol=1e-5)  # pixels
    assert len({tuple(row[:2]) for row in ours}) > 8  # pushes, and travels to several places
    assert call(program, *files, "--bench", 2).startswith("200 steps, baseline")


@pytest.mark.slow
@needs_tools
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="symbols are listed on Linux")
def test_nothing_but_the_header_is_to_be_seen(installed):
    if shutil.which("nm") is None:
        pytest.skip("the symbols of a library are listed by nm, of binutils, which is not here")
    (library,) = installed.rglob("libdifflcs.so")
    symbols = {line.split()[-1] for line in call("nm", "-D", "--defined-only", library).splitlines()}
    header = next(installed.rglob("difflcs.h")).read_text()
    declared = set(re.findall(r"^DIFFLCS_API [^;(]*?\b(difflcs_\w+)\(", header, re.MULTILINE))
    assert symbols == declared
    assert len(declared) >= 12


def test_what_export_writes(exported, capsys):
    described = json.loads((exported / "controller.json").read_text())
    assert described["task"] == "cube"
    assert described["step_seconds"] == 0.1
    assert described["goal"] == [{"name": n, "unit": u} for n, u in (("x", "m"), ("y", "m"), ("yaw", "rad"))]
    assert (described["n_x"], described["n_u"], described["n_goal"], described["horizon"]) == (9, 6, 3, 8)
    assert described["u_max"] == [0.015] * 6
    assert described["bytes"] == (exported / described["file"]).stat().st_size
    assert cli.main(["export", MODEL, "--out", str(exported)]) == 2
    assert "--force" in capsys.readouterr().err
    assert cli.main(["export", MODEL, "--out", str(exported), "--force"]) == 0


def test_the_exported_controller_is_that_of_the_model(exported):
    mpc = get_task("cube").make_policy(LCSModel.from_pretrained(MODEL), single_start_backend("batched"))
    one, two = mpc.controller(), MPCController.load(exported / "controller.difflcs")
    for x in 0.02 * np.random.default_rng(0).normal(size=(5, 9)):
        assert np.array_equal(one.step(x, np.zeros(3)), two.step(x, np.zeros(3)))


def test_a_controller_stays_within_the_action_support_of_its_model(tmp_path):
    assert cli.main(["export", "zoo:trifinger-cube", "--out", str(tmp_path / "out")]) == 0
    described = json.loads((tmp_path / "out" / "controller.json").read_text())
    low, high = LCSModel.from_pretrained("trifinger-cube").action_support.tolist()  # within the ±15 mm of the task
    assert (described["u_min"], described["u_max"]) == (low, high)
    assert max(map(abs, low + high)) <= 0.015


def test_a_run_whose_system_depends_on_the_state_is_not_exported(tmp_path, monkeypatch, capsys):
    policy = get_task("cube").make_policy(BodyFrameLCS(9, 6, 3))
    learned = SimpleNamespace(task="cube", policy=policy, name="mine", method="frame-lcs")
    monkeypatch.setattr(TrainedPolicy, "open", lambda _: learned)
    assert cli.main(["export", "runs/mine", "--out", str(tmp_path / "out")]) == 2
    assert "got mine of method frame-lcs; export a run of another method, or act from Python" in capsys.readouterr().err


def test_layers_are_exported_too(build, tmp_path):
    mpc = LCSMPCLayer(build.params(0), build.cost(0), 5, u_max=0.3)
    path = export_controller(mpc, tmp_path / "new" / "folder", step_seconds=0.02, about={"robot": "of mine"})
    described = json.loads((path.parent / "controller.json").read_text())
    assert described["robot"] == "of mine"
    assert described["u_min"] == [None, None]
    assert described["u_max"] == [0.3, 0.3]
    assert described["step_seconds"] == 0.02
    u = MPCController.load(path).step(np.full(4, 0.1))
    assert np.array_equal(u, mpc.controller().step(np.full(4, 0.1)))
    refuse(InvalidInputError, "expected an LCSMPCLayer", export_controller, mpc.lcs, tmp_path)
    for about in ({"offset": np.zeros(3)}, {"offset": np.nan}, "mine"):
        with pytest.raises(InvalidInputError, match="about: expected finite values in JSON types"):
            export_controller(mpc, tmp_path, about=about)
    (tmp_path / "file").write_text("")
    refuse(InvalidInputError, "expected a place to write", export_controller, mpc, tmp_path / "file")
