"""Export of a controller for a robot without Python: its file, and a description of the numbers in it."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from difflcs import __version__, _storage
from difflcs._checks import describe
from difflcs.errors import InvalidInputError
from difflcs.mpc import LCSMPCLayer, controller_file

CONTROLLER, DESCRIPTION = "controller.difflcs", "controller.json"


def export_controller(
    mpc: LCSMPCLayer, out: str | os.PathLike[str], *, step_seconds: float = 0.0, about: Mapping[str, Any] | None = None
) -> Path:
    """Write the controller of a layer for the C library: system, cost, bounds, constraints, options of the solver.

    Args:
        mpc: the layer, with backend `batched`; nothing in it has a batch dimension.
        out: directory for `controller.difflcs` and `controller.json`, made if needed; what is there is replaced.
        step_seconds: time from one step to the next [s]; 0 if that is not known.
        about: further entries of `controller.json`, in JSON types.

    Returns:
        The path of `controller.difflcs`.

    Raises:
        InvalidInputError and its kinds: the layer cannot be written, such as one whose system depends on the state.
    """
    if not isinstance(mpc, LCSMPCLayer):
        raise InvalidInputError(f"mpc: expected an LCSMPCLayer, got {describe(mpc)}; pass the layer of the controller")
    try:
        further = json.loads(json.dumps(dict(about or {}), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"about: expected finite values in JSON types, got: {error}; convert them") from error
    setup = controller_file.constant_setup(mpc.setup())
    controller_file.check_constant(setup)
    problem, constant = controller_file.make_problem(setup, controller_file.gather_at_zero(setup))
    content = controller_file.controller_bytes(setup, problem, constant, step_seconds)
    low, high = mpc.limits()
    description = {
        **further,
        "format": controller_file.VERSION,
        "difflcs": __version__,
        "file": CONTROLLER,
        "bytes": len(content),
        "n_x": problem.n_x,
        "n_u": problem.n_u,
        "n_lam": problem.n_lam,
        "n_c": problem.n_c,
        "n_goal": getattr(mpc.cost, "n_goal", 0),
        "horizon": mpc.horizon,
        "relaxation": problem.relaxation,
        "step_seconds": step_seconds,
        "u_min": _bound(low),
        "u_max": _bound(high),
    }
    directory = Path(out)
    with _storage.place_to_write(directory):
        _storage.write_atomically(directory / CONTROLLER, content)
        _storage.write_json(directory / DESCRIPTION, description)
    return directory / CONTROLLER


def _bound(value: torch.Tensor) -> list[Any]:
    """Convert a bound to JSON: null for an infinite one."""
    flat = value.detach().double().reshape(-1, value.shape[-1]).tolist()
    rows = [[v if abs(v) < float("inf") else None for v in row] for row in flat]
    return rows[0] if len(rows) == 1 else rows
