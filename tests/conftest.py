"""Shared builders of small models, as fixtures; and how many threads the tests may use."""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

# With several workers of pytest-xdist at once, the processes that a test starts take their share of the cores. It has
# to be said before NumPy and torch are loaded.
if workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")):
    for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, str(max(1, (os.cpu_count() or 1) // workers)))

import numpy as np
import pytest
import torch
from torch import Tensor

from difflcs import GoalCost, LCSModel, LCSParams, QuadraticCost

# Threads cost more than they bring on problems as small as those of the tests; it is the number of the kernels', too.
# Tests about threads say themselves how many they want, until they end.
torch.set_num_threads(1)

F64 = torch.float64


@pytest.fixture(autouse=True)
def one_thread():
    yield
    torch.set_num_threads(1)


def refuse(error, match: str, function: Callable, *args, **kwargs) -> str:
    """Check that a call raises an error of the library, or of its environments, that matches; return its message."""
    with pytest.raises(error, match=match) as caught:
        function(*args, **kwargs)
    # Environments raise plain ones for arguments, as Gymnasium does.
    kinds = {kind.__name__ for kind in type(caught.value).__mro__}
    assert error is ValueError or {"DiffLCSError", "DifflcsEnvsError"} & kinds
    return str(caught.value)


def python(*arguments: str | Path, fails: bool = False, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run Python with arguments, such as "-c" and code, in a process of its own, which has to end well, or to fail."""
    options = {"capture_output": True, "text": True, "timeout": 120, "check": False, **options}
    done = subprocess.run([sys.executable, *arguments], **options)
    assert fails == (done.returncode != 0), done.stdout[-2000:] + done.stderr[-2000:]
    return done


def tensor(values: Sequence[Any] | float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def linear_system(A: Any, B: Any, d: Any = None, **contacts: Any) -> LCSParams:
    """x₊ = A x + B u + d, without contacts where none are given."""
    n, m = np.shape(B)
    sizes = {"d": n, "C": (n, 0), "D": (0, n), "E": (0, m), "F": (0, 0), "c": 0}
    given = contacts if d is None else {"d": d, **contacts}
    return LCSParams(A, B, **{**{name: np.zeros(size) for name, size in sizes.items()}, **given})


def draw(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal float64 numbers."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def contents(root: Path) -> dict[str, bytes]:
    """The files of a folder and of those in it, by their paths."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


class Build:
    """Random but reproducible systems, costs and references; nothing here calls the code under test."""

    @staticmethod
    def normal(seed: int) -> Callable[..., Tensor]:
        """A function shape → standard normal float64 numbers."""
        generator = torch.Generator().manual_seed(seed)
        return lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)

    @staticmethod
    def lcs_tensors(
        seed: int = 0, n_x: int = 4, n_u: int = 2, n_lam: int = 3, batch: tuple[int, ...] = ()
    ) -> dict[str, Tensor]:
        """A stable system whose contacts open and close for states and actions of size 0.1."""
        n = Build.normal(seed)
        G, H = 0.5 * n(*batch, n_lam, n_lam), 0.3 * n(*batch, n_lam, n_lam)
        return {
            "A": 0.9 * torch.eye(n_x, dtype=torch.float64) + 0.05 * n(*batch, n_x, n_x),
            "B": 0.5 * n(*batch, n_x, n_u),
            "C": 0.4 * n(*batch, n_x, n_lam),
            "d": 0.005 * n(*batch, n_x),
            "D": n(*batch, n_lam, n_x),
            "E": n(*batch, n_lam, n_u),
            "F": G @ G.mT + 0.4 * torch.eye(n_lam, dtype=torch.float64) + H - H.mT,
            "c": 0.02 * n(*batch, n_lam),
        }

    @staticmethod
    def params(seed: int = 0, **sizes) -> LCSParams:
        return LCSParams(**Build.lcs_tensors(seed, **sizes))

    @staticmethod
    def model(
        seed: int = 0, n_x: int = 4, n_u: int = 2, n_lam: int = 3, scale: float = 0.5, dtype=torch.float64
    ) -> LCSModel:
        """A model with parameters large enough for contacts to matter."""
        model = LCSModel(n_x, n_u, n_lam, stiffness=0.2, dtype=dtype)
        n = Build.normal(seed)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.copy_(scale * n(*parameter.shape))
        return model

    @staticmethod
    def cost_tensors(seed: int = 0, n_x: int = 4, n_u: int = 2, batch: tuple[int, ...] = ()) -> dict[str, Tensor]:
        n = Build.normal(seed + 1000)

        def definite(size: int) -> Tensor:
            root = 0.4 * n(*batch, size, size)
            return root @ root.mT + 0.5 * torch.eye(size, dtype=torch.float64)

        return {
            "Q": definite(n_x),
            "R": definite(n_u),
            "Q_final": 3 * definite(n_x),
            "q": 0.1 * n(*batch, n_x),
            "r": 0.1 * n(*batch, n_u),
            "q_final": 0.1 * n(*batch, n_x),
        }

    @staticmethod
    def cost(seed: int = 0, **sizes) -> QuadraticCost:
        return QuadraticCost(**Build.cost_tensors(seed, **sizes))

    class AskedCost:
        """A `GoalCost` that is asked as a `CostModule`."""

        def __init__(self, cost: GoalCost):
            self.cost, self.n_x, self.n_u, self.n_goal = cost, cost.n_x, cost.n_u, cost.n_goal

        def at(self, x: Tensor, goal: Tensor | None = None, context: Tensor | None = None) -> QuadraticCost:
            assert goal is not None
            end, one = self.cost(goal, horizon=0), self.cost(goal, horizon=1)
            return QuadraticCost(**end.tensors(), constant_stage=one.constant - end.constant)


@pytest.fixture(scope="session")
def build() -> type[Build]:
    return Build


@pytest.fixture(scope="module")
def stand_ins(tmp_path_factory):
    """No test sees the user's meshes: objects of the YCB set are stand-ins, whose parts are computed once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DIFFLCS_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "difflcs-cache"))
        patch.delenv("DIFFLCS_YCB_DIR", raising=False)
        yield


@pytest.fixture(scope="module", autouse=True)
def registries():
    """What a file registers is gone after it: no other file finds it, in whatever order a process runs them."""
    from difflcs.mpc.backends import base
    from difflcs.rl import tasks
    from difflcs.rl.methods import base as methods

    tasks.task_names()  # installed packages register theirs once
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((base, "REGISTRY"), (methods, "_REGISTRY"), (tasks, "_REGISTRY")):
            patch.setattr(module, name, dict(getattr(module, name)))
        yield
