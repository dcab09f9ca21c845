"""Exact operational-space control of the three fingertips (Khatib 1987).

The task acceleration of a tip is a = kp (target - tip) - kd v with kd = 2 sqrt(kp), critically damped. The control law
is tau = J^T Lambda a + bias with Lambda = (J M^-1 J^T)^-1. The mass matrix is block diagonal over the fingers and each
finger has as many joints (3) as its tip has coordinates, hence exactly, finger by finger,

    tau_f = M_f J_f^-1 a_f + bias_f.

Like the control law of the paper it leaves out the term of dJ/dt.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math

import mujoco
import numpy as np

from difflcs_envs.trifinger.model import JOINTS_PER_FINGER, NUM_FINGERS

__all__ = ["OperationalSpaceController"]

# |det J| is 6.1e-3 m^3 in the home posture. Below the limit (knee within 0.06 rad of straight: the tip is less than
# 0.2 mm from the end of its reach) J^-1 gives way to a damped inverse, so that torques stay bounded.
SINGULAR_DETERMINANT = 5e-4  # [m^3]
SINGULAR_DAMPING = 0.02  # [m] largest damping factor, reached where det J = 0


class OperationalSpaceController:
    """Writes the joint torques that pull the three tips towards a target into `data.ctrl`.

    Plain Python floats on purpose: 3x3 matrices are too small for NumPy. One call takes 5 us; the same law with
    preallocated NumPy arrays, batched over the fingers, takes 15 us.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, kp: float) -> None:
        """Bind the controller to one simulation.

        Args:
            model: The TriFinger model.
            data: Its data. The controller keeps views of its arrays.
            kp: Stiffness of the tips per unit of effective mass [1/s^2].
        """
        self.kp = float(kp)
        self.kd = 2.0 * math.sqrt(self.kp)
        self.target = [0.0] * (3 * NUM_FINGERS)  # x, y, z of each tip [m]
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
        self._axes = data.xaxis[joints].reshape(-1)
        self._anchors = data.xanchor[joints].reshape(-1)
        self._tips = data.site_xpos[first_site : first_site + NUM_FINGERS].reshape(-1)
        self._velocities = data.qvel[dofs]
        self._bias = data.qfrc_bias[dofs]
        self._mass = data.M[first_entry : first_entry + 6 * NUM_FINGERS]
        self._control = data.ctrl

    def fields(self) -> dict[str, np.ndarray]:
        """The views of the data that the control law reads and writes, for the compiled stepper."""
        return {
            "axes": self._axes,
            "anchors": self._anchors,
            "tips": self._tips,
            "velocities": self._velocities,
            "bias": self._bias,
            "mass": self._mass,
            "control": self._control,
        }

    def apply(self) -> None:
        """Compute the torques [N m] from the current data (after `mj_step1`) and write them into `data.ctrl`."""
        axes, anchors, tips = self._axes.tolist(), self._anchors.tolist(), self._tips.tolist()
        velocities, bias, mass = self._velocities.tolist(), self._bias.tolist(), self._mass.tolist()
        target, kp, kd = self.target, self.kp, self.kd
        torques: list[float] = []
        for i in (0, 3, 6):  # index of the finger's first coordinate and first joint
            px, py, pz = tips[i : i + 3]
            # Columns a, b, c of the Jacobian: axis x (tip - anchor) of each joint.
            x0, y0, z0, x1, y1, z1, x2, y2, z2 = axes[3 * i : 3 * i + 9]
            u0, v0, w0, u1, v1, w1, u2, v2, w2 = anchors[3 * i : 3 * i + 9]
            u0, v0, w0 = px - u0, py - v0, pz - w0
            u1, v1, w1 = px - u1, py - v1, pz - w1
            u2, v2, w2 = px - u2, py - v2, pz - w2
            ax, ay, az = y0 * w0 - z0 * v0, z0 * u0 - x0 * w0, x0 * v0 - y0 * u0
            bx, by, bz = y1 * w1 - z1 * v1, z1 * u1 - x1 * w1, x1 * v1 - y1 * u1
            cx, cy, cz = y2 * w2 - z2 * v2, z2 * u2 - x2 * w2, x2 * v2 - y2 * u2

            # Task acceleration e = kp (target - tip) - kd J qdot.
            qd0, qd1, qd2 = velocities[i : i + 3]
            ex = kp * (target[i] - px) - kd * (ax * qd0 + bx * qd1 + cx * qd2)
            ey = kp * (target[i + 1] - py) - kd * (ay * qd0 + by * qd1 + cy * qd2)
            ez = kp * (target[i + 2] - pz) - kd * (az * qd0 + bz * qd1 + cz * qd2)

            # Joint acceleration J^-1 e by Cramer's rule, with b x c and a x e:
            # q0 = e.(b x c) / det,  q1 = c.(a x e) / det,  q2 = -b.(a x e) / det.
            nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
            det = ax * nx + ay * ny + az * nz
            if abs(det) > SINGULAR_DETERMINANT:
                gx, gy, gz = ay * ez - az * ey, az * ex - ax * ez, ax * ey - ay * ex
                q0 = (ex * nx + ey * ny + ez * nz) / det
                q1 = (cx * gx + cy * gy + cz * gz) / det
                q2 = -(bx * gx + by * gy + bz * gz) / det
            else:
                jacobian = np.array([[ax, bx, cx], [ay, by, cy], [az, bz, cz]])
                q0, q1, q2 = _damped_solve(jacobian, np.array([ex, ey, ez]), det)

            m00, m10, m11, m20, m21, m22 = mass[2 * i : 2 * i + 6]
            torques += (
                m00 * q0 + m10 * q1 + m20 * q2 + bias[i],
                m10 * q0 + m11 * q1 + m21 * q2 + bias[i + 1],
                m20 * q0 + m21 * q1 + m22 * q2 + bias[i + 2],
            )
        self._control[:] = torques


def _damped_solve(jacobian: np.ndarray, acceleration: np.ndarray, det: float) -> list[float]:
    """Joint acceleration J^T (J J^T + lambda^2 I)^-1 a near a singular posture.

    lambda^2 = SINGULAR_DAMPING^2 (1 - (det / SINGULAR_DETERMINANT)^2) (after Nakamura and Hanafusa 1986): it vanishes
    at the edge of the singular region, so the torque is continuous there.
    """
    damping = SINGULAR_DAMPING**2 * (1.0 - (det / SINGULAR_DETERMINANT) ** 2)
    # The small constant keeps the matrix invertible if both factors vanish to rounding.
    gram = jacobian @ jacobian.T + (damping + 1e-12) * np.eye(3)
    return (jacobian.T @ np.linalg.solve(gram, acceleration)).tolist()
