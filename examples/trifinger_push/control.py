"""Torques that lead the tips along references, at 50 Hz and with the delay of the robot.

What is measured now is answered by a torque that acts from 10 ms to 30 ms after it. The controller therefore predicts
the joints to the time when its torque begins to act, under the torque that it sent before.
"""

import numpy as np
from numpy.typing import NDArray
from trifinger_lift import STEP, Follow, Robot

Array = NDArray[np.float64]

DELAY = 0.01
"""Of the action [s]."""


class TipControl(Robot):
    """Joint torques from references of the tips; it stores the last torque sent."""

    def reset(self) -> None:
        """Forget the torque that was sent last."""
        self.sent = np.zeros(9)

    def predict(self, q: Array, v: Array, steps: int = 2) -> tuple[Array, Array]:
        """Predict joint angles and velocities at the time when the next torque begins to act."""
        h = DELAY / steps
        for _ in range(steps):
            mass, bias = self.dynamics(q, v)
            after = np.linalg.solve(mass + h * np.diag(self.damping), mass @ v + h * (self.sent - bias))
            q = q + h * (v + after) / 2
            v = after
        return q, v


class TipReference(Follow):
    """References of the tips, with bounded speed and acceleration."""

    speed, acceleration = 0.6, 7.0  # [m/s, m/s²]

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
