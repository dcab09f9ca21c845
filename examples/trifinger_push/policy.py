"""The policy: sampling-based contact MPC for one tip at a time, and torques that make the tips follow it."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from trifinger_rl_datasets import PolicyBase, PolicyConfig

from difflcs import GoalCost, LCSMPCLayer
from difflcs.planning import Decision, Mode, SamplingPolicy, SamplingSettings
from trifinger_push.control import TipControl, TipReference
from trifinger_push.cube import HEIGHT, UNIT, CubeEstimator
from trifinger_push.fingers import N_FINGERS, STEP
from trifinger_push.places import FINGER, PUSH_HEIGHT, FingerPlaces, FingerTravel, OneFinger, lift

Array = NDArray[np.float64]

FRICTION = 0.5
"""Between tip and cube."""
PLAN_FRICTION = 0.15
"""Friction that the plan assumes."""
PLAN_STEP = 0.1
"""Of the system [s]; the plan is made anew at each step of the environment."""
HORIZON = 8
REACH = 0.03
"""Largest |u| of each component in a step of the system [m]: 0.3 m/s."""
INPUT_WEIGHT = 0.1
SETTINGS = SamplingSettings(keep=0.3, smallest_gain=0.002, switch_price=0.18, travel_price=0.0833, patience=75)
WAIVED = replace(SETTINGS, smallest_gain=0.0, switch_price=0.0018, travel_price=0.000833)
"""Settings for states in which no journey is worth its price and nothing is gained, as beside the wall."""
WAIT_HEIGHT = 0.115
"""Of the tips that do not push [m]."""
LEAD = 0.03
"""How far the reference of a tip that pushes may be ahead of it [m]."""
PUSH_FORCE = 0.4
"""Fed forward while a tip pushes [N]; on the table it takes up to 0.92 N to move the cube."""
ARRIVED = 0.003
"""Distance of the cube from the goal at which the tips rest [m]."""
PATIENCE, PROGRESS, REFUSAL = 12, 0.2, 100
"""A tip that makes less than this part of its way in so many steps stands before an obstacle: its face of the cube is
not tried again for `REFUSAL` steps."""


class PushPolicy(PolicyBase):
    """For `trifinger_rl_datasets.evaluate_sim push`. It has seen no data: geometry, masses and friction are known.

    Args:
        action_space: of the environment, not used.
        observation_space: likewise.
        episode_length: likewise.
    """

    def __init__(self, action_space: Any = None, observation_space: Any = None, episode_length: int = 750) -> None:
        torch.set_num_threads(1)
        self.control, self.cube = TipControl(), CubeEstimator(FRICTION)
        self.places, self.travel = FingerPlaces(), FingerTravel()
        model = OneFinger(PLAN_FRICTION, compliance=0.05)
        cost = GoalCost.reach(model.n_x, model.n_u, [1.0, 1.0], [3.0, 3.0], INPUT_WEIGHT)
        mpc = LCSMPCLayer(model, cost, HORIZON, -REACH / UNIT, REACH / UNIT, relaxation=1e-4, on_failure="mask")
        self.planner = SamplingPolicy(mpc, self.places, self.travel, SETTINGS)
        self.reset()

    @staticmethod
    def get_policy_config() -> PolicyConfig:
        """Return the configuration: observations as dictionaries."""
        return PolicyConfig(flatten_obs=False, image_obs=False)

    def reset(self) -> None:
        """Forget the episode."""
        self.control.reset()
        self.cube.reset()
        self.places.reset()
        self.planner.reset()
        self.reference: TipReference | None = None
        self.finger = 0
        self._asked = self._made = 0.0
        self._pushed = 0

    def get_action(self, observation: Any) -> NDArray[np.float32]:
        """Compute joint torques (9,) [N m]."""
        robot = observation["robot_observation"]
        q, v = robot["position"].astype(float), robot["velocity"].astype(float)
        tips, _ = self.control.tips(q)
        if self.reference is None:
            self.reference = TipReference(tips)
            self.waiting = tips.copy()
            self.waiting[:, 2] = WAIT_HEIGHT
            self._last = tips
        pose = self.cube.update(observation["camera_observation"], tips)
        goal = observation["desired_goal"]["object_position"][:2].astype(float)
        self._watch(pose, tips)
        targets, velocity = self._decide(pose, tips, goal)
        place, speed, acceleration = self.reference.towards(targets)
        force = np.zeros((N_FINGERS, 3))
        if velocity is not None:
            f = self.finger
            place, speed = place.copy(), speed.copy()
            place[f], speed[f], acceleration[f] = self.reference.lead(f, tips[f], velocity, PUSH_HEIGHT, LEAD)
            size = float(np.linalg.norm(velocity))
            force[f, :2] = PUSH_FORCE * velocity / max(size, 0.1) if size > 0.02 else 0.0
        return self.control.torque(q, v, (place, speed, acceleration), force)

    def _decide(self, pose: Array, tips: Array, goal: Array) -> tuple[Array, Array | None]:
        """Decide the targets of the tips, and the velocity of the one that pushes."""
        assert self.reference is not None
        targets, f = self.waiting.copy(), self.finger
        for other in range(N_FINGERS):
            if tips[other, 2] < HEIGHT + 0.01:
                targets[other] = lift(pose, tips[other])
        if np.linalg.norm(pose[:2] - goal) < ARRIVED:
            targets[f] = self.reference.place[f]
            return targets, None
        self.travel.tips = tips
        action, decision = self._plan(self._state(pose, tips), goal / UNIT)
        if decision.mode is Mode.TRAVEL:
            assert decision.target is not None
            f = self.finger = int(decision.target[FINGER])
            targets[f] = tips[f] + action * UNIT
            self.places.held = False
            return targets, None
        velocity = action[:2] * UNIT / PLAN_STEP
        self._asked += float(np.linalg.norm(velocity)) * STEP
        return targets, velocity

    def _plan(self, state: Array, goal: Array) -> tuple[Array, Decision]:
        """Plan; return the planner's action and decision. If it would only wait, prices are waived."""
        before = self.planner.decision
        action, decision = self.planner.act(state, goal), self.planner.decision
        assert decision is not None
        travelled = before is not None and before.mode is Mode.TRAVEL
        idle = decision.gain <= SETTINGS.smallest_gain or not self.places.near(torch.from_numpy(state))
        if decision.mode is Mode.PUSH and idle and not travelled:
            self.planner.settings = WAIVED
            action, decision = self.planner.act(state, goal), self.planner.decision
            assert decision is not None
            self.planner.settings = SETTINGS
        return action, decision

    def _state(self, pose: Array, tips: Array) -> Array:
        return np.array([pose[0] / UNIT, pose[1] / UNIT, pose[2], *tips[self.finger] / UNIT, self.finger])

    def _watch(self, pose: Array, tips: Array) -> None:
        """Check whether a tip that pushes makes progress."""
        self.places.now += 1
        decision = self.planner.decision
        if decision is None or decision.mode is not Mode.PUSH:
            self._asked = self._made = 0.0
            self._pushed = 0
        else:
            self._pushed += 1
            self._made += float(np.linalg.norm(tips[self.finger, :2] - self._last[self.finger, :2]))
            if self._pushed == PATIENCE:
                if self._asked > 0.01 and self._made < PROGRESS * self._asked:
                    scale = np.array([UNIT, UNIT, 1, UNIT, UNIT, UNIT, 1])
                    self.places.refuse(self._state(pose, tips) * scale, REFUSAL)
                self._asked = self._made = 0.0
                self._pushed = 0
        self._last = tips
