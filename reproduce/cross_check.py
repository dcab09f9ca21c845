"""Models of ours in the simulator of the prior work, goal by goal beside ours: `python reproduce/cross_check.py`.

Without options the table is drawn from the tracked record. To make the record, have a checkout of the prior work,

    git clone https://github.com/wanxinjin/Task-Driven-Hybrid-Reduction
    python reproduce/cross_check.py --checkout Task-Driven-Hybrid-Reduction

Nothing of it is changed: its robot, meshes, controller and reset are used as they are. Its code is of 2023; two of its
calls are answered by the packages of today, see `prior_environment`.
"""

import importlib
import json
import sys
import types
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import records
import report
import torch
from runs import command_line
from stats import wilson

from difflcs._checks import check_positive_int
from difflcs.bench import machine
from difflcs.errors import CheckpointError, InvalidInputError, MissingDependencyError
from difflcs.rl import write_atomically
from difflcs.rl.rollout import Act, mpc_actions
from difflcs.rl.tasks import get_task
from difflcs.zoo import Learned

MODULE = "env.gym_env.trifinger_quasistaic_ground_continuous"
"""Their environment, as they spell it."""


@dataclass(frozen=True)
class Options:
    """Cross-check in the simulator of the prior work."""

    checkout: Path | None = None
    """Where the prior work lies; without it the table is drawn from the record."""
    models: tuple[Path, ...] = (Path("zoo:trifinger-cube"), Path("zoo:trifinger-cube-violation"))
    """Run directories, or zoo:NAME, of the cube."""
    goals: int = 200
    """Goals, with starts of theirs; the same for every model and both simulators."""
    seed: int = 0
    """Of goals and starts."""
    results: Path = records.RESULTS
    """Folder of the record, cross_check.json, and of the table."""

    def __post_init__(self) -> None:
        check_positive_int("goals", self.goals)


def prior_environment(checkout: Path) -> Any:
    """Their environment of the moving task.

    It is written for Gym, whose successor Gymnasium has the same names, and for a MuJoCo where the mass matrix was the
    array `MjData.qM`, which MuJoCo 4 no longer has.

    Raises:
        InvalidInputError: it is not there.
        MissingDependencyError: a package that it needs is not installed.
    """
    import gymnasium

    mujoco: Any = importlib.import_module("mujoco")
    file = checkout / f"{MODULE.replace('.', '/')}.py"
    if not file.is_file():
        raise InvalidInputError(f"checkout: expected {file}, found none; clone the prior work and pass its folder")
    if "gym" not in sys.modules:
        sys.modules |= {"gym": gymnasium, "gym.utils": gymnasium.utils, "gym.spaces": gymnasium.spaces}
        sys.modules["gym.error"] = gymnasium.error
    sys.path.insert(0, str(checkout.resolve()))
    try:
        module = importlib.import_module(MODULE)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(f"{error.name}: the prior work needs it: pip install {error.name}") from error
    finally:
        sys.path.pop(0)
    if not hasattr(mujoco.MjData, "qM"):
        mujoco.MjData.qM = property(lambda data: data)
        full = {"mj_fullM": lambda model, matrix, data: mujoco.mj_fullM(model, data, matrix)}
        module.mujoco = types.SimpleNamespace(**{**vars(mujoco), **full})  # pyright: ignore[reportAttributeAccessIssue]
    env = module.TriFingerQuasiStaticGroundEnv()
    env.random_mag = 0.05  # as their trainings, and as ours
    return env


def play(act: Act, step: Any, state: np.ndarray, goal: np.ndarray, steps: int) -> np.ndarray:
    """One episode: states (steps + 1, 9)."""
    states = [state]
    for _ in range(steps):
        action, _ = act(*(torch.from_numpy(value)[None] for value in (states[-1], goal)))
        states.append(step(action[0]))
    return np.stack(states)


def compare(options: Options, checkout: Path) -> dict[str, Any]:
    """Play every goal in both simulators, from the same starts: success, and how far apart the states are."""
    torch.set_num_threads(1)
    spec, theirs = get_task("cube"), prior_environment(checkout)
    ours: Any = spec.make_env().unwrapped
    low, high = (bound.numpy() for bound in spec.bounds)

    def their_step(action: np.ndarray) -> np.ndarray:
        theirs.step(np.clip(action, low, high))
        return theirs.get_stateinfo()["state"]

    rows = []
    for model in options.models:
        learned = Learned.open(model)
        if learned.task != spec.name:
            raise InvalidInputError(f"models: expected models of the cube, got one of {learned.task}; pass others")
        rng = np.random.default_rng(options.seed)
        np.random.seed(options.seed)  # noqa: NPY002  # their reset draws from it
        reached, tips, ends = [], [], []
        for _ in range(options.goals):
            goal = ours.task.sample_goal(rng)
            theirs.reset()
            theirs.set_cube_target(goal[:2], goal[2])
            state = np.clip(theirs.get_stateinfo()["state"], -0.5, 0.5)
            ours.reset(seed=0, options={"goal": goal, "state": state})
            act = mpc_actions(learned.policy)
            there = play(act, their_step, state, goal, spec.episode_steps)
            here = play(act, lambda action: ours.step(action)[0]["state"], state, goal, spec.episode_steps)
            reached.append([bool(ours.task.pose_info(states[-1], goal)["success"]) for states in (there, here)])
            tips.append(there[1, 3:] - here[1, 3:])
            ends.append(np.hypot(*(there[-1, :2] - here[-1, :2])))
        rows.append(
            {
                "model": str(model),
                **{name: "".join(str(int(pair[k])) for pair in reached) for k, name in enumerate(("theirs", "ours"))},
                "tips_rms": float(np.sqrt(np.mean(np.square(tips)))),
                "cube_median": float(np.median(ends)),
            }
        )
        print(f"{model}: {rows[-1]['theirs'].count('1')} of {options.goals} there, {rows[-1]['ours'].count('1')} here")
    ours.close()
    return {"goals": options.goals, "seed": options.seed, "machine": machine(), "results": rows}


def table(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Success in both, and where they disagree."""
    lines = []
    for row in rows:
        there, here = (np.array([digit == "1" for digit in row[name]]) for name in ("theirs", "ours"))
        success = [report.say(wilson(100 * reached.mean(), len(reached))) for reached in (there, here)]
        only = f"{int((there & ~here).sum())} and {int((here & ~there).sum())}"
        lines.append([row["model"], *success, only, f"{1e3 * row['tips_rms']:.2f}", f"{1e3 * row['cube_median']:.1f}"])
    columns = ["model", "their simulator [%]", "ours [%]", "goals reached there only, here only",
               "tips after one step, rms [mm]", "cube at the end, median [mm]"]  # fmt: skip
    return pd.DataFrame(lines, columns=columns)


def draw_record(options: Options) -> int:
    """Make the record if there is a checkout, then write the table; returns the exit code."""
    path = options.results / "cross_check.json"
    if options.checkout is not None:
        record = compare(options, options.checkout)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, (json.dumps(record, indent=2, sort_keys=True) + "\n").encode())
    if not path.exists():
        raise CheckpointError(f"{path}: expected a record, found none; make it with --checkout, see --help")
    found: Any = json.loads(path.read_text())
    note = (
        f"{found['goals']} goals (seed {found['seed']}), each from the same start in both simulators. Brackets: 95 % "
        f"intervals over the goals, Wilson's. The last two columns: how far apart tips and cube are."
    )
    machine_note = f"On {', '.join(f'{name} {value}' for name, value in found['machine'].items())}."
    tables = {"The same models and goals in the simulator of the prior work": table(found["results"])}
    report.write_tables(options.results, "cross_check", tables, [note, machine_note])
    return 0


if __name__ == "__main__":
    sys.exit(command_line(Options, draw_record))
