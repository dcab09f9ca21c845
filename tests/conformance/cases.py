"""A batch of LCS-MPC problems in NumPy. Nothing here calls the code under test but `Case.problem`, which hands over."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
        own = value if self.shared(name) else value[i if len(value) > 1 else 0]
        return own[k] if own.ndim > rank(name) else own

    def problem(self):
        """The batch as the backends take it."""
        import torch

        from difflcs.mpc.problem import MPCProblem

        tensors = {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in self.arrays.items()}
        return MPCProblem(**tensors, horizon=self.horizon, relaxation=self.relaxation)
