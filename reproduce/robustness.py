"""Robustness: a model as it was trained, on a system that is not as in the training: `python reproduce/robustness.py`.

Mass, friction, gains of the robot's controller, observations with noise, actions that come late. Without options table
and figure are drawn from the tracked record; `--rerun` computes what is missing in it, with `--smoke` in seconds.
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import records
import report
import torch
from matplotlib.figure import Figure
from runs import check_amounts, command_line
from stats import bootstrap, wilson
from torch import Tensor

from difflcs.cli.bench import machine
from difflcs.errors import CheckpointError
from difflcs.rl import TaskSpec, TrainedPolicy, collect, get_task, write_atomically
from difflcs.rl.rollout import Act, mpc_actions
from difflcs.rl.runs.delay import delay_actions, make_predictor
from difflcs.rl.seeding import Stream, episode_seeds

NOMINAL = "as in the training"


@dataclass(frozen=True)
class Options:
    """Robustness without retraining. Interrupt it at any time; the same command goes on."""

    model: Path = Path("zoo:trifinger-cube")
    """Run directory, or zoo:NAME, of a TriFinger task."""
    goals: int = 1000
    """Goals, the same for every condition."""
    seed: int = 0
    """Of goals, starts and noise."""
    rerun: bool = False
    """Compute what is missing in the record; then draw."""
    smoke: bool = False
    """A few goals, in a separate record: shows that everything works."""
    results: Path = records.RESULTS
    """Folder of the record, robustness.json, and of table and figure."""

    def __post_init__(self) -> None:
        check_amounts(goals=self.goals)


@dataclass(frozen=True)
class Condition:
    """One way in which the system differs from that of the training."""

    group: str
    name: str
    env: dict[str, float] | None = None
    """Arguments of the environment."""
    noise: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of the object's observed position [m] and yaw [rad], new in every step."""
    delay: int = 0
    """Steps by which actions come late."""
    predicted: bool = False
    """Whether the LCS advances the observed state to the time at which the action will be executed."""


def conditions(mass: float, friction: float, gain: float) -> Iterator[Condition]:
    """List all conditions, for an object's mass [kg] and friction and the robot controller's stiffness [1/s²]."""
    yield Condition("", NOMINAL)
    for factor in (0.2, 0.5, 2.0, 3.0, 10.0):
        yield Condition("mass", f"{1000 * mass * factor:g} g", {"object_mass": mass * factor})
    for factor in (0.2, 0.5, 1.6):
        yield Condition("friction", f"{friction * factor:g}", {"object_friction": friction * factor})
    for factor in (0.4, 2.5):
        yield Condition("gains", f"× {factor:g}", {"osc_kp": gain * factor})
    for position, yaw in ((0.001, 0.02), (0.003, 0.05), (0.006, 0.1)):
        yield Condition("noise", f"{1000 * position:g} mm, {yaw:g} rad", noise=(position, yaw))
    for delay in (1, 2):
        late = f"{delay} step{'s' * (delay > 1)} late"
        yield Condition("delay", late, delay=delay)
        yield Condition("delay", f"{late}, predicted", delay=delay, predicted=True)


def acting(condition: Condition, policy: Any, n_u: int, rng: np.random.Generator) -> Act:
    """Run a model in a condition, in one batch of episodes, with the noise of a generator."""
    act = mpc_actions(policy)
    position, yaw = condition.noise

    def noisy(state: Tensor, *rest: Tensor) -> tuple[np.ndarray, np.ndarray]:
        error = torch.from_numpy(rng.standard_normal((len(state), 3)) * (position, position, yaw))
        return act(torch.cat([state[:, :3] + error, state[:, 3:]], 1), *rest)

    seeing: Act = noisy if any(condition.noise) else act
    if not condition.delay:
        return seeing
    return delay_actions(seeing, n_u, condition.delay, make_predictor(policy.lcs) if condition.predicted else None)


def measure(condition: Condition, task: TaskSpec, policy: Any, goals: int, seed: int) -> dict[str, Any]:
    """Count the goals reached and the solves that failed."""
    changed, parts = replace(task, env_kwargs={**task.env_kwargs, **(condition.env or {})}), []
    with closing(changed.make_envs(min(50, goals))) as envs:
        for first in range(0, goals, envs.num_envs):
            seeds = episode_seeds(seed, Stream.EVALUATION, first, min(envs.num_envs, goals - first))
            act = acting(condition, policy, task.n_u, np.random.default_rng((seed, Stream.ACTION, first)))
            parts.append(collect(envs, act, seeds, task.episode_steps))
    reached = torch.cat([part["success"] for part in parts]).int().tolist()
    failures = sum(int(part["failures"].sum()) for part in parts)
    return {**asdict(condition), "reached": "".join(map(str, reached)), "solver_failures": failures}


def read(path: Path) -> dict[str, Any]:
    """Read a record."""
    try:
        record: Any = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path}: expected JSON, got {error}; restore it from a copy, or delete it") from error
    keys = {"options", "machine", "results"}
    if not isinstance(record, dict) or not keys <= record.keys() or "model" not in record["options"]:
        wanted = ", ".join(sorted(keys))
        raise CheckpointError(f"{path}: expected {wanted}, got other JSON; restore it from a copy, or delete it")
    return record


def compute(options: Options, path: Path, say: Callable[[str], object] = print) -> None:
    """Measure what is missing in the record; it is written after every condition."""
    torch.set_num_threads(1)
    learned = TrainedPolicy.open(options.model)
    task, policy = get_task(learned.task), learned.policy
    env: Any = task.make_env().unwrapped
    described = task.describe(env)
    selected = list(conditions(described["mass"], described["friction"], env.osc_kp))
    env.close()
    if options.smoke:
        selected = [one for one in selected if one.group in ("", "noise") or one.delay == 1]
    asked = {"model": str(options.model), "goals": options.goals, "seed": options.seed, "object": dict(described)}
    new = {"options": asked, "machine": machine(), "results": []}
    record = read(path) if path.exists() else new
    if record["options"] != asked:
        raise CheckpointError(
            f"{path}: expected a record of {asked}, got one of {record['options']}; pass another --results, or "
            f"delete it to compute it anew"
        )
    known = {(row["group"], row["name"]) for row in record["results"]}
    for condition in selected:
        if (condition.group, condition.name) not in known:
            row = measure(condition, task, policy, options.goals, options.seed)
            record["results"].append(row)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, (json.dumps(record, indent=2, sort_keys=True) + "\n").encode())
            say(f"{condition.group} {condition.name}: {100 * np.mean(list(map(int, row['reached']))):.1f} %")


def estimates(rows: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], Any, Any]]:
    """Compute each row's success [%], and the difference to the nominal one, goal by goal, with their intervals."""
    reached = {row["name"]: 100.0 * np.array(list(map(int, row["reached"]))) for row in rows}
    nominal, results = reached[NOMINAL], []
    for row in rows:
        goals = reached[row["name"]]
        apart = None if row["name"] == NOMINAL else bootstrap([list(goals - nominal)])
        results.append((row, wilson(goals.mean(), len(goals)), apart))
    return results


def draw(record: dict[str, Any], folder: Path, name: str) -> None:
    """Write table and figure."""
    shown = estimates(record["results"])
    lines = [
        [row["group"], row["name"], report.say(success), report.say(apart, signed=True), str(row["solver_failures"])]
        for row, success, apart in shown
    ]
    columns = ["", "condition", "success [%]", "difference", "failed solves"]
    asked = record["options"]
    notes = [
        f"{asked['model']}, {asked['goals']} goals of seed {asked['seed']}, the same in every condition. Brackets: "
        f"95 % intervals over goals, of success Wilson's, of the difference to the first line by the bootstrap. One "
        f"step is 0.1 s. Predicted: the LCS first predicts the state in which the action will be executed.",
        f"On {', '.join(f'{name} {value}' for name, value in record['machine'].items())}.",
    ]
    title = "Success on a system that is not that of the training"
    table = pd.DataFrame(lines, columns=columns)
    report.write_tables(folder, name, {title: table}, notes, {name: "Success where the system is another one"})
    figure = Figure((7.0, 5.0), dpi=150, layout="constrained")
    axes = figure.subplots()
    groups = list(dict.fromkeys(row["group"] for row, _, _ in shown))
    palette = ("#000000", "#0072b2", "#009e73", "#d55e00", "#cc79a7", "#e69f00")
    for y, (row, success, _) in enumerate(shown):
        color = palette[groups.index(row["group"]) % len(palette)]
        axes.plot([success.low, success.high], [-y, -y], color=color, lw=2)
        axes.plot(success.value, -y, "o", color=color)
    axes.axvline(shown[0][1].value, color="grey", lw=0.8, ls=":")
    axes.set(xlabel="success [%]", xlim=(0, 101), yticks=[-y for y in range(len(shown))])
    axes.set_yticklabels([f"{row['group']} {row['name']}".strip() for row, _, _ in shown])
    axes.grid(alpha=0.25, axis="x")
    axes.spines[["top", "right"]].set_visible(False)
    report.write_figure(figure, folder, name)


def draw_record(options: Options) -> int:
    """Compute if asked for, then draw; return the exit code."""
    name = "robustness-smoke" if options.smoke else "robustness"
    options = replace(options, goals=min(options.goals, 4)) if options.smoke else options
    path = options.results / f"{name}.json"
    if options.rerun or options.smoke:
        compute(options, path)
    if not path.exists():
        raise CheckpointError(f"{path}: expected a record, found none; make it: python reproduce/robustness.py --rerun")
    record = read(path)
    if record["options"]["model"] != str(options.model):
        raise CheckpointError(
            f"{path}: expected a record of {options.model}, got one of {record['options']['model']}; measure it with "
            f"--rerun, and another --results"
        )
    draw(record, options.results, name)
    return 0


if __name__ == "__main__":
    sys.exit(command_line(Options, draw_record))
