"""Torques that lead the tips along references, at 50 Hz and with the delay of the robot.

What is measured now is answered by a torque that acts from 10 ms to 30 ms after it. The controller therefore predicts
the joints to the time when its torque begins to act, under the torque that it sent before, and asks there for the
acceleration

    a = r̈ + k_p (r − p) + k_d (ṙ − ṗ)

of each tip, with the gains that put both poles of a double integrator with held input to `POLE`. Computed torque gives
it, τ = M J⁻¹ a + bias + what the damping of the robot's safety layer takes away + Jᵀ f. The term of dJ/dt is left out.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import robot_properties_fingers
from numpy.typing import NDArray

from trifinger_push.fingers import N_FINGERS, STEP

Array = NDArray[np.float64]

URDF = Path(str(robot_properties_fingers.__file__)).parent / "urdf" / "pro" / "trifingerpro.urdf"
TIPS = ("finger_tip_link_0", "finger_tip_link_120", "finger_tip_link_240")
DELAY = 0.01
"""Of the action [s]."""
DAMPING = np.array([0.08, 0.08, 0.04] * N_FINGERS)
"""Of the joints, by the robot's safety layer [N m s/rad]."""
LARGEST_TORQUE = 0.396
"""[N m]."""
POLE = 0.5
"""Per step."""
K_P = (1 - POLE) ** 2 / STEP**2
K_D = (1 - POLE**2 + (1 - POLE) ** 2 / 2) / STEP
LARGEST_ACCELERATION = 25.0
"""Of a tip [m/s²]; a far reference asks for more than motors have."""
SINGULAR = 5e-4
"""|det J| [m³] below which the inverse is damped."""


class TipControl:
    """Joint torques from references of the tips; it stores the last torque sent."""

    def __init__(self) -> None:
        self.model = pin.buildModelFromUrdf(str(URDF))
        self.data = self.model.createData()
        self.frames = [self.model.getFrameId(name) for name in TIPS]
        self.reset()

    def reset(self) -> None:
        """Forget the torque that was sent last."""
        self.sent = np.zeros(3 * N_FINGERS)

    def tips(self, q: Array) -> tuple[Array, Array]:
        """Compute the places (3, 3) of the tips [m] at joint angles (9,), and their Jacobians (3, 3, 9)."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        places = np.array([self.data.oMf[i].translation for i in self.frames])
        around = pin.LOCAL_WORLD_ALIGNED
        return places, np.stack([pin.getFrameJacobian(self.model, self.data, i, around)[:3] for i in self.frames])

    def _dynamics(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Compute the mass matrix and the bias."""
        upper = np.triu(pin.crba(self.model, self.data, q))
        return upper + np.triu(upper, 1).T, pin.nonLinearEffects(self.model, self.data, q, v)

    def predict(self, q: Array, v: Array, steps: int = 2) -> tuple[Array, Array]:
        """Predict joint angles and velocities at the time when the next torque begins to act."""
        h = DELAY / steps
        for _ in range(steps):
            mass, bias = self._dynamics(q, v)
            after: Any = np.linalg.solve(mass + h * np.diag(DAMPING), mass @ v + h * (self.sent - bias))
            q = q + h * (v + after) / 2
            v = after
        return q, v

    def torque(self, q: Array, v: Array, reference: tuple[Array, Array, Array], force: Array) -> NDArray[np.float32]:
        """Compute torques (9,) [N m].

        Args:
            q: (9,) measured joint angles [rad].
            v: (9,) measured joint velocities [rad/s].
            reference: place, velocity and acceleration (3, 3) of each tip, for the time when the torque begins to act.
            force: (3, 3) that each tip is to push with [N].
        """
        q, v = self.predict(q, v)
        places, jacobians = self.tips(q)
        mass, bias = self._dynamics(q, v)
        where, speed, ahead = reference
        a = ahead + K_P * (where - places) + K_D * (speed - np.einsum("fij,j->fi", jacobians, v))
        a *= np.minimum(1, LARGEST_ACCELERATION / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-9))
        wanted, push = np.zeros(9), np.zeros(9)
        for f in range(N_FINGERS):
            joints = slice(3 * f, 3 * f + 3)
            j = jacobians[f][:, joints]
            damping = 1e-4 if abs(np.linalg.det(j)) < SINGULAR else 1e-8
            wanted[joints] = j.T @ np.linalg.solve(j @ j.T + damping * np.eye(3), a[f])
            push[joints] = j.T @ force[f]
        torque = mass @ wanted + bias + DAMPING * (v + wanted * STEP / 2) + push
        self.sent = np.clip(torque, -LARGEST_TORQUE, LARGEST_TORQUE)
        return self.sent.astype(np.float32)


class TipReference:
    """References of the tips, with bounded speed and acceleration.

    Args:
        places: (3, 3) where the tips are [m].
        speed: largest [m/s].
        acceleration: largest [m/s²].
    """

    def __init__(self, places: Array, speed: float, acceleration: float) -> None:
        self.place, self.velocity = places.copy(), np.zeros_like(places)
        self.speed, self.acceleration = speed, acceleration

    def towards(self, targets: Array) -> tuple[Array, Array, Array]:
        """Step towards targets (3, 3), to arrive at rest; return place and velocity before it, and the acceleration."""
        gap = targets - self.place
        distance = np.linalg.norm(gap, axis=1, keepdims=True)
        # The fastest from which it can still stop, in steps.
        half = self.acceleration * STEP / 2
        brake = np.sqrt(half**2 + 2 * self.acceleration * distance) - half
        wanted = gap / np.maximum(distance, 1e-9) * np.minimum(np.minimum(self.speed, brake), distance / STEP)
        change = wanted - self.velocity
        size = np.linalg.norm(change, axis=1, keepdims=True)
        a = change * np.minimum(1, self.acceleration * STEP / np.maximum(size, 1e-9)) / STEP
        before = self.place, self.velocity
        self.place = self.place + STEP * self.velocity + STEP**2 / 2 * a
        self.velocity = self.velocity + STEP * a
        return *before, a

    def lead(self, finger: int, tip: Array, velocity: Array, height: float, most: float) -> tuple[Array, Array, Array]:
        """Step a tip that pushes, with a velocity in the plane and a height to keep.

        Args:
            finger: which one.
            tip: (3,) where it is [m].
            velocity: (2,) of the reference [m/s].
            height: to keep [m].
            most: how far the reference may be ahead of the tip [m]; what holds the tip up must not wind it up.

        Returns:
            Place and velocity (3,) before the step, and the acceleration.
        """
        place, before = self.place[finger].copy(), self.velocity[finger].copy()
        speed = np.array([*velocity, 0.0])
        to = place + STEP * speed
        to[2] = place[2] + np.clip(height - place[2], -0.004, 0.004)
        ahead = to - tip
        self.place[finger] = tip + ahead * min(1.0, most / max(float(np.linalg.norm(ahead)), 1e-9))
        self.velocity[finger] = speed
        return place, speed, np.clip((speed - before) / STEP, -self.acceleration, self.acceleration)
