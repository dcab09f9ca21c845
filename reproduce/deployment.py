"""Further evaluations of the models of one training: the same models, deployed in other ways (`recipes.PROTOCOLS`).

`train` evaluates in one way, "full". Whenever that is due, the checkpoint of the moment is evaluated in the others.
"""

import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd
from units import Unit

from difflcs.rl import Evaluation, RunDirectory, evaluate, get_task, load_policy, write_atomically
from difflcs.rl.runs.checkpoint import load_checkpoint
from difflcs.rl.runs.training import EVALUATION_ENVS, Reporter, TrainConfig, count_goals_due, load_action_support

NUMBERS = ("success_rate", "ci_low", "ci_high", "goals", "solver_failures")


class Deployments(Reporter):
    """Evaluations of the models of a training, kept in a CSV file beside its run; they survive any interruption.

    Args:
        unit: what is trained.
        schedule: its configuration with all evaluations.
        run: its run directory.
        file: the CSV file.
    """

    def __init__(self, unit: Unit, schedule: TrainConfig, run: Path, file: Path):
        self.unit, self.schedule, self.run, self.file = unit, schedule, run, file
        self.protocols = [name for name in unit.protocols if name != "full"]

    def evaluated(self, minutes: float, result: Evaluation) -> None:
        """Evaluate the checkpoint just written, also the one before any data; see `Reporter`."""
        self.catch_up()

    def iterated(self, report: Any) -> None:
        """Evaluate the checkpoint just written; see `Reporter`."""
        self.catch_up()

    def rows(self) -> pd.DataFrame:
        """Read the evaluations so far: protocol, minutes, NUMBERS, seconds."""
        columns = ["protocol", "minutes", *NUMBERS, "seconds"]
        return pd.read_csv(self.file) if self.file.is_file() else pd.DataFrame(columns=columns)

    def catch_up(self) -> None:
        """Evaluate the latest checkpoint in every way, if an evaluation is due there and has not been done."""
        if not self.protocols or not (self.run / "checkpoints" / "latest.json").is_file():
            return
        run = RunDirectory.open(self.run)
        # After an interruption the log may be ahead of the checkpoint by one row, which will be written anew.
        latest = load_checkpoint(run.checkpoints)["iteration"]
        logged = [row for row in run.rows() if int(row["iteration"]) <= latest][-2:]
        steps = [int(row["env_steps"]) for row in logged]
        per_minute = self.unit.spec.steps_per_minute
        previous, now = steps if len(steps) == 2 else (-1, *steps)
        goals, minutes = count_goals_due(self.schedule, previous, now, self.unit.spec), round(now / per_minute, 6)
        known = self.rows()
        done = set(known.protocol[known.minutes == minutes])
        for protocol in self.protocols if goals else ():
            if protocol not in done:
                start = time.perf_counter()
                numbers = self.measure(run, protocol, goals)
                row = {"protocol": protocol, "minutes": minutes, **numbers, "seconds": time.perf_counter() - start}
                new = pd.DataFrame([row])
                known = pd.concat([known, new]) if len(known) else new
                write_atomically(self.file, known.to_csv(index=False).encode())

    def measure(self, run: RunDirectory, protocol: str, goals: int) -> dict[str, float]:
        """Compute the NUMBERS of one evaluation of the latest checkpoint."""
        spec: Any = get_task(self.unit.task) if protocol == "task" else self.unit.spec
        bounds = load_action_support(run) if protocol == "support" else (None, None)
        with closing(spec.make_envs(min(EVALUATION_ENVS, goals), threads=1)) as envs:
            seed, steps = self.schedule.evaluation_seed, spec.episode_steps
            evaluation = evaluate(envs, load_policy(run, spec), goals, seed, steps, *bounds)
        return {name: getattr(evaluation, name) for name in NUMBERS}
