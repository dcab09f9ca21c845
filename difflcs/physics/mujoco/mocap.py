"""Mocap bodies as inputs: joints and servos in place of what moves them from outside."""

from typing import Any

import mujoco
import numpy as np

from difflcs._checks import check_kind
from difflcs.errors import InvalidInputError

_HEAVIER = 1e3  # than all that may pull or push


def drive_mocap(spec: Any) -> Any:
    """Make a specification in which servos move the mocap bodies, so that where these go is an action.

    Each mocap body gets three slides along the axes of the world, each with a critically damped `position` servo whose
    time constant is that of the body's geoms, `weld` or `connect` (`solref`), so that what hangs there or is pushed
    follows as it does after a jump of `mocap_pos`. The body weighs so much that nothing pushes it back, gravity does
    not act on it, it touches no more than before, and it keeps its orientation. The numbers of its joints in `qpos`
    are its `mocap_pos`.

    Args:
        spec: a `mujoco.MjSpec` with mocap bodies; it is not changed.

    Returns:
        A new `MjSpec`. The joints and servos of a body `hand` are `hand_x`, `hand_y` and `hand_z`; the servos are the
        last ones, and their `ctrl` is a place. Make a `MujocoLCS` of the model that it compiles to, and add the actions
        to `mocap_pos` of the model that was given.

    Raises:
        DTypeError: no `MjSpec`.
        InvalidInputError: it has no mocap bodies.
    """
    spec = check_kind("spec", spec, mujoco.MjSpec, "make one with MjSpec.from_file").copy()
    for i, body in enumerate(spec.bodies[1:]):
        body.name = body.name or f"body_{i + 1}"
    model = spec.compile()
    driven = [body for body in spec.bodies if body.mocap]
    if not driven:
        raise InvalidInputError('spec: expected bodies with mocap="true", got none; give it to MujocoLCS as it is')
    still = [body.name for body in spec.bodies if body.mocap or model.body_weldid[body.id] == 0]
    mass = _HEAVIER * max(float(model.body_mass.sum()), 1e-3)
    for body in driven:
        holds = [e for e in spec.equalities if body.name in (e.name1, e.name2)]
        constant = max([model.opt.timestep, *(_time_constant(soft.solref) for soft in (*holds, *body.geoms))])
        body.mocap, body.gravcomp = False, 1.0
        body.explicitinertial, body.mass, body.inertia, body.ipos = True, mass, [mass] * 3, np.zeros(3)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.body_quat[body.id])
        for axis, place, name in zip(rotation.reshape(3, 3), model.body_pos[body.id], "xyz", strict=True):
            joint = f"{body.name}_{name}"
            damping = 2 * mass / constant
            body.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, ref=place, damping=damping)
            servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=mass / constant**2)
        for other in still:
            if other != body.name:
                spec.add_exclude(bodyname1=body.name, bodyname2=other)
        still.remove(body.name)
    return spec


def _time_constant(solref: Any) -> float:
    """Return the time constant of a constraint [s]."""
    return solref[0] if solref[0] > 0 else (-solref[0]) ** -0.5 if solref[0] < 0 else 0.0
