"""Quasi-static motion of a MuJoCo model in one step without contact."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from difflcs.errors import InvalidInputError
from difflcs.physics.complementarity import FreeMotion
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.actuators import Actuators
from difflcs.physics.mujoco.library import Places, library

Array = NDArray[np.float64]


class QuasiStatic:
    """Joints with actuators go where they are told; all else moves only while pushed, by its mobility times the force.

    Args:
        model: a private copy.
        actuators: of the model.
        mobility: "inertia": the inverse of the mass matrix; "damping": of the joints' damping; or what a unit of force
            on each degree of freedom does, (nv,) or (nv, nv).
    """

    def __init__(self, model: Any, actuators: Actuators, mobility: str | Array):
        if not model.nu:
            raise InvalidInputError(
                'model: expected actuators on what is moved, got none; add <position joint="..."/> for each joint'
            )
        others = [i for i, dof in enumerate(actuators.dof) if dof < 0 or (actuators.dof == dof).sum() > 1]
        if others:
            raise InvalidInputError(
                "model: expected each actuator on a slide or hinge of its own for quasi-static motion, got others "
                f'(numbers {others}); change them, or use motion="quasi-dynamic" or "dynamic"'
            )
        self.model = model
        self.pushed = np.setdiff1d(np.arange(model.nv), actuators.dof)
        self.B = np.zeros((model.nv, model.nu))
        self.B[actuators.dof, np.arange(model.nu)] = 1.0
        self.mobility = None if isinstance(mobility, str) and mobility == "inertia" else self._fixed(mobility)
        self._native = actuators.describe(model)

    def _fixed(self, mobility: str | Array) -> Array:
        nv = self.model.nv
        fixed = np.zeros(nv) if isinstance(mobility, str) else mobility
        if isinstance(mobility, str):
            damping = self.model.dof_damping[self.pushed]
            if (damping <= 0).any():
                raise InvalidInputError(
                    'mobility: expected damping above 0 of all joints that are pushed with "damping", got '
                    f'{float(damping.min()):g}; set it in the model, use "inertia", or give the mobility'
                )
            fixed[self.pushed] = 1 / damping
        fixed = np.diag(fixed) if fixed.ndim == 1 else fixed
        if fixed.shape != (nv, nv) or not np.isfinite(fixed).all():
            raise InvalidInputError(
                f"mobility: expected finite numbers ({nv},) or ({nv}, {nv}), got {fixed.shape}; one for each degree of "
                f"freedom"
            )
        return fixed

    def read(self, places: Places, states: Array, ctrl: Array) -> Array:
        """Read the inverse mass matrices (n, nv, nv) at states (n, nq + nv + na); the controls (n, nu) do not matter.

        Raises:
            InvalidInputError: MuJoCo raised an error, or has counted a warning.
        """
        n, nv, none = len(states), self.model.nv, np.zeros(0)
        inverse_mass = np.zeros((n, nv, nv))
        if self.mobility is None:
            taken = library(), self._native, places.take(n), states, np.ascontiguousarray(ctrl), inverse_mass
            places.check(_mujoco.read_rest(*taken, *[none] * 5), n)
        return inverse_mass

    def finish(self, arrays: Array, x: Array, tangent: Array | None) -> FreeMotion:
        """Return the motion at states x (n, nv), for the tangent of their rotations."""
        (n, nv), response = x.shape, self.mobility
        if response is None:
            block = np.ix_(np.arange(n), self.pushed, self.pushed)
            response = np.zeros((n, nv, nv))
            # What the servos hold does not give way, so the mass matrix counts without their rows.
            response[block] = np.linalg.inv(np.linalg.inv(arrays)[block])
        if tangent is not None:
            inverse = np.linalg.inv(tangent)
            response = inverse @ response @ inverse.swapaxes(-1, -2)
        matrices: Any = np.eye(nv), self.B.copy(), np.zeros(nv), response
        return FreeMotion(*matrices)
