"""A batch of LCS-MPC problems, in NumPy or torch. Only `Case.problem` calls the code under test: it hands over."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

MATRICES = ("A", "B", "C", "D", "E", "F", "Q", "R", "S", "Q_final", "G_x", "G_u")


def rank(name: str) -> int:
    """Number of dimensions of an input that is neither given per element nor by stage."""
    return 2 if name in MATRICES else 1


def in_units(t, x, u, f):
    """Inputs in other units: numbers of states are x (n_x,) times as large, of actions u, of forces f. λ·s stays."""
    matrices = {"A": (x, x), "B": (x, u), "C": (x, f), "D": (1 / f, x), "E": (1 / f, u), "F": (1 / f, f)}
    matrices |= {"Q": (1 / x, x), "R": (1 / u, u), "Q_final": (1 / x, x)}
    vectors = {"d": x, "c": 1 / f, "q": 1 / x, "r": 1 / u, "q_final": 1 / x, "u_min": u, "u_max": u, "x0": x}
    changed = {name: row[:, None] * t[name] / column for name, (row, column) in matrices.items()}
    return {**changed, **{name: size * t[name] for name, size in vectors.items()}}


@dataclass(frozen=True)
class Case:
    """A batch of problems.

    Attributes:
        inputs: arrays or tensors by the names of `MPCProblem`, each shared, per element, by stage (1, stages, …), or
            both; x0 (count, n_x).
        horizon: H.
        relaxation: λ·s.
        barrier: weight of the barrier.
        numbers: u_min and u_max of all actions as Python floats, if the caller gives them so.
        answer: (count, H, n_u) actions known beforehand, NaN where not; only of classes that are linear programs.
        witness: (count, H, n_u) actions that are known to meet the bounds and every constraint.
        impossible: (count,) True where no plan meets them for sure.
        possible: (count,) True where one does for sure.
    """

    inputs: dict[str, Any]
    horizon: int = 3
    relaxation: float = 1e-4
    barrier: float = 0.0
    numbers: dict[str, float] | None = None
    answer: np.ndarray | None = None
    witness: np.ndarray | None = None
    impossible: np.ndarray | None = None
    possible: np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of problems."""
        return len(self.inputs["x0"])

    def shared(self, name: str) -> bool:
        """Whether all elements have the same."""
        value = self.inputs[name]
        return value.ndim == rank(name) or (value.ndim == rank(name) + 2 and len(value) == 1 < self.count)

    def select(self, index) -> Case:
        """Some of the problems."""
        inputs = {k: v if self.shared(k) else v[index] for k, v in self.inputs.items()}
        known = {k: getattr(self, k) for k in ("answer", "witness", "impossible", "possible")}
        return replace(self, inputs=inputs, **{k: v if v is None else v[index] for k, v in known.items()})

    def full(self) -> dict[str, Any]:
        """Every input with the batch in front, copied."""
        lead = {k: v if v.ndim > rank(k) else v[None] for k, v in self.inputs.items()}
        return {k: v[[i % len(v) for i in range(self.count)]] for k, v in lead.items()}

    def by_stage(self) -> dict[str, Any]:
        """The same with a dimension of stages after the batch, of one stage where all are alike; what is free is ∞."""
        t = {k: v if v.ndim == rank(k) + 2 else v[:, None] for k, v in self.full().items()}
        price = {"price": abs(t["g"]) + np.inf} if "g" in t else {}
        return {"u_min": -np.inf, "u_max": np.inf, **price, **t}

    def each(self) -> Case:
        """The same problems, each with every input of its own."""
        return replace(self, inputs=self.full(), numbers=None)

    def cast(self, dtype) -> Case:
        """The same in another precision."""
        with np.errstate(over="ignore", under="ignore"):
            return self.changed(**{k: v.astype(dtype) for k, v in self.inputs.items()})

    def changed(self, **inputs) -> Case:
        """The same with other inputs."""
        return replace(self, inputs={**self.inputs, **inputs})

    def without(self, names) -> Case:
        """The same without some inputs."""
        return replace(self, inputs={k: v for k, v in self.inputs.items() if k not in names})

    def problem(self):
        """The batch as the backends take it."""
        import torch

        from difflcs.mpc.problem import MPCProblem

        tensors = {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in self.inputs.items()}
        return MPCProblem(**tensors, horizon=self.horizon, relaxation=self.relaxation)
