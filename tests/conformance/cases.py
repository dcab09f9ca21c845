"""A batch of LCS-MPC problems in NumPy. Nothing here calls the code under test but `Case.problem`, which hands over."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

MATRICES = ("A", "B", "C", "D", "E", "F", "Q", "R", "S", "Q_final", "G_x", "G_u")


def rank(name: str) -> int:
    """Number of dimensions of an input that is neither given per element nor by stage."""
    return 2 if name in MATRICES else 1


@dataclass(frozen=True)
class Case:
    """A batch of problems.

    Attributes:
        arrays: inputs by the names of `MPCProblem`, each shared, per element, by stage, or both; x0 (count, n_x).
        horizon: H.
        relaxation: λ·s.
        barrier: weight of the barrier.
        numbers: u_min and u_max of all actions as Python floats, if the caller gives them so.
        answer: (count, H, n_u) actions known beforehand, NaN where not; only of classes that are linear programs.
        witness: (count, H, n_u) actions that are known to meet the bounds and every constraint.
        impossible: (count,) True where no plan meets them for sure.
        possible: (count,) True where one does for sure.
    """

    arrays: dict[str, np.ndarray]
    horizon: int
    relaxation: float = 1e-5
    barrier: float = 0.0
    numbers: tuple[float, float] | None = None
    answer: np.ndarray | None = None
    witness: np.ndarray | None = None
    impossible: np.ndarray | None = None
    possible: np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of problems."""
        return len(self.arrays["x0"])

    def shared(self, name: str) -> bool:
        """Whether all elements and stages have the same."""
        return name != "x0" and self.arrays[name].ndim == rank(name)

    def select(self, index) -> Case:
        """Some of the problems."""
        arrays = {k: v if self.shared(k) else v[index] for k, v in self.arrays.items()}
        known = {k: getattr(self, k) for k in ("answer", "witness", "impossible", "possible")}
        return replace(self, arrays=arrays, **{k: v if v is None else v[index] for k, v in known.items()})

    def full(self) -> dict[str, np.ndarray]:
        """Every array with the batch in front."""
        return {
            k: np.broadcast_to(v, (self.count, *(v.shape if self.shared(k) else v.shape[1:])))
            for k, v in self.arrays.items()
        }

    def each(self) -> Case:
        """The same problems, each with every input of its own."""
        return replace(self, arrays={k: np.array(v) for k, v in self.full().items()}, numbers=None)

    def cast(self, dtype) -> Case:
        """The same in another precision."""
        with np.errstate(over="ignore", under="ignore"):
            return self.changed(**{k: v.astype(dtype) for k, v in self.arrays.items()})

    def changed(self, **arrays: np.ndarray) -> Case:
        """The same with other inputs."""
        return replace(self, arrays={**self.arrays, **arrays})

    def at(self, name: str, i: int, k: int) -> np.ndarray:
        """One input of element i at stage k."""
        value = self.arrays[name]
        if self.shared(name):
            return value
        value = value[i if len(value) > 1 else 0]
        return value[k] if value.ndim > rank(name) else value

    def problem(self):
        """The batch as the backends take it."""
        import torch

        from difflcs.mpc.problem import MPCProblem

        tensors = {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in self.arrays.items()}
        return MPCProblem(**tensors, horizon=self.horizon, relaxation=self.relaxation)
