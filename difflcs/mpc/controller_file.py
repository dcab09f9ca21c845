"""The file of a controller: one problem with the options of its solver, which Python and C read by the same code.

`difflcs/_native/controller_file.hpp` documents its bytes.
"""

import struct
import zlib

import numpy as np
import torch

from difflcs._checks import check_number, check_positive_int, describe
from difflcs.cost import CostSequence, GoalCost, QuadraticCost, cost_at
from difflcs.errors import InvalidInputError, ShapeError
from difflcs.lcs import LCSModel
from difflcs.mpc import kkt
from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.mpc.setup import PLAIN_COSTS, Call, Inputs, Setup, gather
from difflcs.records import LCSParams, LCSSequence, system_at
from difflcs.scales import ScaledLCS

MAGIC = b"\x89LCS\r\n\x1a\n"
VERSION = 3
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


def constant_cost(cost: object, n_x: int) -> GoalCost | QuadraticCost | CostSequence | None:
    """Return a cost that is the same for all states and contexts; None for any other module."""
    if isinstance(cost, PLAIN_COSTS):
        return cost
    with torch.no_grad():
        constant = getattr(cost, "constant", False) is True
        return cost_at(cost, torch.zeros(n_x, dtype=torch.float64)) if constant else None  # pyright: ignore


def constant_setup(setup: Setup) -> Setup:
    """Replace system, cost and bounds of a setup by constant ones, as far as they do not depend on the state."""
    system, cost = constant_system(setup.lcs), constant_cost(setup.cost, setup.lcs.n_x)
    bounds = (setup.u_min, setup.u_max) if setup.bounds is not None else setup.action_bounds(setup.lcs)
    low, high = (bound.detach().clone() for bound in bounds)
    return setup._replace(
        lcs=setup.lcs if system is None else system,
        cost=setup.cost if cost is None else cost,
        u_min=low,
        u_max=high,
        limits=None,
    )


def check_constant(setup: Setup) -> None:
    """Refuse a system or a cost that may depend on the state."""
    if not isinstance(setup.lcs, LCSParams | LCSSequence):
        raise InvalidInputError(
            f"lcs: expected an LCSModel or matrices, got {describe(setup.lcs)}, whose system may depend on the state; "
            f"build a layer with lcs=module.params(x, context)"
        )
    if not isinstance(setup.cost, PLAIN_COSTS):
        raise InvalidInputError(
            f"cost: expected a GoalCost or weights, got {describe(setup.cost)}, whose cost may depend on the state; "
            f"build a layer with cost=module.at(x, goal, context)"
        )


def gather_at_zero(setup: Setup) -> Inputs:
    """Gather the inputs at state zero and goal zero, for a setup whose system and cost depend on no state."""
    cost, x0 = setup.cost, torch.zeros(1, setup.lcs.n_x, dtype=torch.float64)
    return gather(setup, Call(x0, torch.zeros(cost.n_goal).to(cost.Q) if isinstance(cost, GoalCost) else None))


def numbers_of_one(inputs: Inputs) -> tuple[dict[str, torch.Tensor], float]:
    """Convert inputs to the numbers of one robot's problem, and the constant of its cost.

    Raises:
        ShapeError: there is a batch of them.
    """
    for name, tensor in inputs.tensors.items():
        if tensor.shape[: tensor.ndim - inputs.rank(name)].numel() != 1:
            value = tensor.detach().to("cpu", torch.float64)
            raise ShapeError(
                f"{name}: expected no batch dimension, as a controller is for one robot, got "
                f"{describe(value)}; index it"
            )
    values = inputs.numbers(inputs.tensors, (1,))
    return values, float(values.pop("constant"))


def make_problem(setup: Setup, inputs: Inputs) -> tuple[MPCProblem, float]:
    """Make the problem of one robot, and the constant of its cost."""
    values, constant = numbers_of_one(inputs)
    problem = MPCProblem(**values, horizon=setup.horizon, relaxation=setup.relaxation, barrier=setup.barrier)
    return problem, constant


def controller_bytes(setup: Setup, problem: MPCProblem, constant: float, step_seconds: float = 0.0) -> bytes:
    """Make the file of a layer's controller.

    Args:
        setup: settings of the layer; its backend is `batched`.
        problem: its problem and the constant of its cost, see `make_problem`.
        constant: likewise.
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
    numbers = {name: getattr(problem, name) for name in ("n_x", "n_u", "n_lam", "n_c", "horizon")}
    numbers |= {
        "n_goal": cost.n_goal if isinstance(cost, GoalCost) else 0,
        "relaxation": problem.relaxation,
        "barrier": problem.barrier,
        "tol": backend.tol,
        "certified": kkt.CERTIFIED,
        "homotopy": backend.homotopy or 0.0,
        "shrink": backend.shrink,
        "max_iter": backend.max_iter,
        "seed": backend.seed,
        **backend.starts(problem, guessed=False)._asdict(),
        "starts_guessed": backend.starts(problem, guessed=True).starts,
        "step_seconds": step_seconds,
    }
    entries: list[tuple[str, np.ndarray]] = [(name, np.array([value], np.float64)) for name, value in numbers.items()]
    entries += [(name, getattr(problem, name).numpy()) for name in INPUTS if name != "x0"]
    for name in ("goal_to_q", "goal_to_q_final", "goal_stage", "goal_final"):
        value = getattr(cost, name).detach().to("cpu", torch.float64).numpy() if numbers["n_goal"] else np.zeros(0)
        entries.append((name, value))
    entries.append(("constant", np.array([constant], np.float64)))
    body = b"".join(
        struct.pack("<16sQ", name.encode(), value.size) + np.ascontiguousarray(value, "<f8").tobytes()
        for name, value in entries
    )
    size = struct.pack("<Q", len(MAGIC) + 16 + len(body))
    return MAGIC + struct.pack("<II", VERSION, zlib.crc32(size + body)) + size + body
