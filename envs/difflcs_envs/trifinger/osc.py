"""Inputs and outputs of the compiled stepper's operational-space control of the three fingertips (Khatib 1987).

The task acceleration of a tip is a = kp (target - tip) - kd v with kd = 2 sqrt(kp), critically damped. The control law
is tau = J^T Lambda a + bias with Lambda = (J M^-1 J^T)^-1. The mass matrix is block diagonal over the fingers and each
finger has as many joints (3) as its tip has coordinates, hence exactly, finger by finger,

    tau_f = M_f J_f^-1 a_f + bias_f.

Like the control law of the paper it leaves out the term of dJ/dt. Near a singular posture J^-1 gives way to the damped
J^T (J J^T + lambda^2 I)^-1 with lambda^2 = SINGULAR_DAMPING^2 (1 - (det J / SINGULAR_DETERMINANT)^2), after Nakamura
and Hanafusa 1986: it vanishes at the edge of the singular region, so the torque is continuous there.
"""

import mujoco
import numpy as np

from difflcs_envs.trifinger.model import JOINTS_PER_FINGER, NUM_FINGERS

# |det J| is 6.1e-3 m^3 in the home posture. Below the limit (knee within 0.06 rad of straight: the tip is less than
# 0.2 mm from the end of its reach) J^-1 gives way to a damped inverse, so that torques stay bounded.
SINGULAR_DETERMINANT = 5e-4  # [m^3]
SINGULAR_DAMPING = 0.02  # [m] largest damping factor, reached where det J = 0


def controller_fields(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, np.ndarray]:
    """Return the views of the data that the control law reads, and `control`, the torques [N m] that it writes.

    Args:
        model: The TriFinger model.
        data: Its data.
    """
    first_joint = model.joint("joint_0_0").id
    first_dof = int(model.jnt_dofadr[first_joint])
    first_site = model.site("tip_0").id
    num_joints = NUM_FINGERS * JOINTS_PER_FINGER
    joints = slice(first_joint, first_joint + num_joints)
    dofs = slice(first_dof, first_dof + num_joints)
    # The lower triangle of every block M_f, row by row, in one piece: rows of 1, 2 and 3 entries.
    if model.M_rownnz[dofs].tolist() != [1, 2, 3] * NUM_FINGERS:
        raise RuntimeError(
            "Expected the mass matrix of every finger as a full lower triangle (rows of 1, 2, 3 entries), got rows "
            f"of {model.M_rownnz[dofs].tolist()}. Give each finger three serial joints and nothing more."
        )
    first_entry = int(model.M_rowadr[first_dof])
    return {
        "axes": data.xaxis[joints].reshape(-1),
        "anchors": data.xanchor[joints].reshape(-1),
        "tips": data.site_xpos[first_site : first_site + NUM_FINGERS].reshape(-1),
        "velocities": data.qvel[dofs],
        "bias": data.qfrc_bias[dofs],
        "mass": data.M[first_entry : first_entry + 6 * NUM_FINGERS],
        "control": data.ctrl,
    }
