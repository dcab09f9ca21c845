"""The file of a controller: one problem with the options of its solver, which Python and C read by the same code.

`difflcs/_native/controller_file.hpp` says how its bytes lie.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable

import numpy as np
import torch

from difflcs._checks import check_number, check_positive_int, describe
from difflcs.cost import GoalCost
from difflcs.errors import InvalidInputError, ShapeError
from difflcs.lcs import LCSModel, LCSParams, LCSSequence
from difflcs.mpc import kkt
from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.mpc.setup import Call, Setup, gather
from difflcs.records import system_at
from difflcs.scales import ScaledLCS

MAGIC = b"\x89LCS\r\n\x1a\n"
VERSION = 1
_LARGEST = 2**53  # of whole numbers, so that a double holds it
_MAPS = ("at", "along")


def constant_system(lcs: object) -> LCSParams | LCSSequence | None:
    """Return the system of an LCS whose matrices are the same at all states and contexts; None if it has others."""
    if isinstance(lcs, LCSParams | LCSSequence):
        return lcs.detach()
    inner = lcs
    while isinstance(inner, ScaledLCS):
        inner = inner.lcs
    with torch.no_grad():
        constant = isinstance(inner, LCSModel) and getattr(inner.params, "__func__", None) is LCSModel.params
        return system_at(lcs, None).detach() if constant else None  # pyright: ignore


def controller_bytes(setup: Setup, system: LCSParams | LCSSequence, step_seconds: float = 0.0) -> bytes:
    """Make the file of a layer's controller, with its cost, bounds and constraints as they are now.

    Args:
        setup: that of the layer; its backend is `batched`, and nothing in it has a batch dimension.
        system: the system to plan with, without batch dimensions.
        step_seconds: time from one step to the next [s]; 0 if that is not known.

    Raises:
        InvalidInputError and its kinds: another backend, a batch, or parts that do not fit each other.
    """
    step_seconds = check_number("step_seconds", step_seconds)
    backend, cost = setup.backend, setup.cost
    if not isinstance(backend, BatchedBackend):
        raise InvalidInputError(
            f"backend: expected 'batched', whose solver a controller uses, got {backend.name!r}; build the layer with "
            f"backend='batched'"
        )
    if isinstance(cost, GoalCost) and any(getattr(type(cost), k) is not getattr(GoalCost, k) for k in _MAPS):
        raise InvalidInputError(
            f"cost: expected a GoalCost, whose terms are linear in the goal, got the subclass "
            f"{type(cost).__name__} that overrides how goals enter; build the layer with a GoalCost"
        )
    for name, value in (("seed", backend.seed), ("max_iter", backend.max_iter)):
        check_positive_int(name, value, minimum=0, maximum=_LARGEST)
    problem, constant = _problem(setup, system)
    sizes = {"n_x": problem.n_x, "n_u": problem.n_u, "n_lam": problem.n_lam, "n_c": problem.n_c}
    n_x = problem.n_x
    n_goal = cost.n_goal if isinstance(cost, GoalCost) else 0
    options = {
        "relaxation": problem.relaxation,
        "barrier": problem.barrier,
        "tol": backend.tol,
        "certified": kkt.CERTIFIED,
        "homotopy": backend.homotopy or 0.0,
        "shrink": backend.shrink,
        "max_iter": backend.max_iter,
        "seed": backend.seed,
        "starts": backend.starts(problem, guessed=False),
        "starts_guessed": backend.starts(problem, guessed=True),
        "step_seconds": step_seconds,
    }
    numbers = {**sizes, "horizon": problem.horizon, "n_goal": n_goal, **options}
    entries: list[tuple[str, np.ndarray]] = [(name, np.array([value], np.float64)) for name, value in numbers.items()]
    entries += [(name, getattr(problem, name).numpy()) for name in INPUTS if name != "x0"]
    for name, shape in (
        ("goal_to_q", (n_x, n_goal)),
        ("goal_to_q_final", (n_x, n_goal)),
        ("goal_stage", (n_goal, n_goal)),
        ("goal_final", (n_goal, n_goal)),
    ):
        value = getattr(cost, name).detach().to("cpu", torch.float64).numpy() if n_goal else np.zeros(shape)
        entries.append((name, value))
    entries.append(("constant", np.array([constant], np.float64)))
    return _pack(entries)


def _problem(setup: Setup, system: LCSParams | LCSSequence) -> tuple[MPCProblem, float]:
    """Make the problem of one state and one goal, both zero, and the constant of its cost."""
    x0, cost = torch.zeros(1, system.n_x, dtype=torch.float64), setup.cost
    goal = torch.zeros(cost.n_goal, dtype=torch.float64).to(cost.Q) if isinstance(cost, GoalCost) else None
    low, high = setup.action_bounds(setup.lcs) if setup.bounds is None else (None, None)
    inputs = gather(setup, Call(x0, goal, lcs=system, u_min=low, u_max=high))
    for name, tensor in inputs.tensors.items():
        if tensor.shape[: tensor.ndim - inputs.rank(name)].numel() != 1:
            value = tensor.detach().to("cpu", torch.float64)
            raise ShapeError(
                f"{name}: expected no batch dimension, as a controller is for one robot, got "
                f"{describe(value)}; index it"
            )
    values = inputs.numbers(inputs.tensors, (1,))
    constant = float(values.pop("constant"))
    problem = MPCProblem(**values, horizon=setup.horizon, relaxation=setup.relaxation, barrier=setup.barrier)
    return problem, constant


def _pack(entries: Iterable[tuple[str, np.ndarray]]) -> bytes:
    body = b"".join(
        struct.pack("<16sQ", name.encode(), value.size) + np.ascontiguousarray(value, "<f8").tobytes()
        for name, value in entries
    )
    size = struct.pack("<Q", len(MAGIC) + 16 + len(body))
    return MAGIC + struct.pack("<II", VERSION, zlib.crc32(size + body)) + size + body
