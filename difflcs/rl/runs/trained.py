"""Trained policies, from a run directory or from the zoo, and those that known physics makes without a training."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from difflcs import _storage, zoo
from difflcs._checks import did_you_mean
from difflcs.errors import CheckpointError
from difflcs.rl.methods import ContactMethod, get_method
from difflcs.rl.methods.contact_lcs import known_physics
from difflcs.rl.rollout import Policy
from difflcs.rl.runs.checkpoint import RunDirectory
from difflcs.rl.runs.training import load_policy, stored_config
from difflcs.rl.tasks import get_task, task_names


@dataclass(frozen=True)
class TrainedPolicy:
    """The policy that a run has learned, that of a model of the zoo or of known physics, and where it comes from.

    Attributes:
        name: the run directory, "zoo:NAME", or the task.
        task: what it was trained for.
        method: name of the method; "known physics" if nothing is learned.
        backend: MPC solver; None without one.
        policy: from states and goals to plans.
        finished: True if its training has finished.
        object: description of what it was trained on, by the environment; None if there is none.
        run: the run, if it is one.
        card: the card, if it is a model of the zoo.
    """

    name: str
    task: str
    method: str
    backend: str | None
    policy: Policy
    finished: bool
    object: Mapping[str, Any] | None
    run: RunDirectory | None = None
    card: zoo.ModelCard | None = None

    @classmethod
    def open(cls, source: Path | str) -> TrainedPolicy:
        """Load a trained policy.

        Args:
            source: run directory, or "zoo:NAME"; or the name of a task, for the MPC with the physics that is known of
                it (`PhysicsSpec`), as it is before a training.

        Raises:
            CheckpointError: there is none, or it cannot be used.
            InvalidInputError: nothing is known of the physics of the task.
        """
        name = str(source)
        if name in task_names() and not Path(name).exists():
            task, method = get_task(name), ContactMethod()
            policy = method.policy(task, known_physics(task).make_system())
            return cls(name, name, "known physics", method.solver, policy, True, None)
        if name.startswith(zoo.PREFIX):
            known = zoo.card(name)
            task = get_task(known.task)
            make: Any = get_method(known.method)
            method = make(backend=known.backend)
            learned = method.rebuild(task, *_storage.load_record(zoo.path(name), method.kind), name)
            policy = method.policy(task, learned)
            return cls(name, known.task, known.method, known.backend, policy, True, known.object, card=known)
        if not os.path.exists(name):  # False for what can be no path
            raise CheckpointError(
                f"{name}: expected a directory written by `difflcs train`, zoo:NAME or a task, found none of them"
                f"{did_you_mean(name, task_names())}"
            )
        run = RunDirectory.open(source)
        config, description = stored_config(run), run.config().get("object")
        description = description if isinstance(description, dict) else None
        if description is not None:
            zoo.check_object(description, name)
        method = config.method
        return cls(
            name, config.task, method.name, method.solver, load_policy(run), run.finished(), description, run=run
        )

    def fits(self, description: Mapping[str, Any]) -> bool:
        """Return True unless the description of an environment differs from that of the training in a common key."""
        known = self.object or {}
        return all(known[key] == description[key] for key in known.keys() & description.keys())
