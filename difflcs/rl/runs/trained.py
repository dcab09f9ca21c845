"""Trained policies, from a run directory or from the zoo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from difflcs import _storage, zoo
from difflcs.rl.methods import get_method
from difflcs.rl.rollout import Policy
from difflcs.rl.runs.checkpoint import RunDirectory
from difflcs.rl.runs.training import load_policy, stored_config
from difflcs.rl.tasks import get_task


@dataclass(frozen=True)
class TrainedPolicy:
    """The policy that a run has learned, or that of a model of the zoo, and where it comes from.

    Attributes:
        name: the run directory, or "zoo:NAME".
        task: what it was trained for.
        method: how.
        backend: MPC solver; None without one.
        policy: from states and goals to plans.
        finished: whether the training is.
        object: what it was trained on, as the environment described it; None if it did not.
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
        """Load it.

        Args:
            source: run directory, or "zoo:NAME".

        Raises:
            CheckpointError: there is none, or it cannot be used.
        """
        name = str(source)
        if name.startswith(zoo.PREFIX):
            known = zoo.card(name)
            task = get_task(known.task)
            make: Any = get_method(known.method)
            method = make(backend=known.backend)
            learned = method.rebuild(task, *_storage.load_record(zoo.path(name), method.kind), name)
            policy = method.policy(task, learned)
            return cls(name, known.task, known.method, known.backend, policy, True, known.object, card=known)
        run = RunDirectory.open(source)
        config, found = stored_config(run), run.config().get("object")
        found = found if isinstance(found, dict) else None
        if found is not None:
            zoo.check_object(found, name)
        method = config.method
        return cls(name, config.task, method.name, method.solver, load_policy(run), run.finished(), found, run=run)

    def fits(self, found: Mapping[str, Any]) -> bool:
        """Whether an environment holds what it was trained on, as far as both say; True if that is not known."""
        own = self.object or {}
        return all(own[key] == found[key] for key in own.keys() & found.keys())
