"""Policies of FetchPush and FetchSlide by contact MPC; `benchmarks/scoreboard/fetch.py` plays them.

They are given the environment's observation and what its MJCF says: sizes, friction, stiffness of the weld. Nothing is
learned, nothing is simulated. They plan with contact LCSs: of a block that two closed fingers, taken for a disc, push
about a plane, and of a gripper that hits a puck, which slides on until friction stops it. Settings were chosen with
seeds from 1000 on.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from difflcs import GoalCost, LCSMPCLayer, LCSParams, LCSSequence
from difflcs.physics import PlanarPushing, box
from difflcs.planning import DiscPlaces, PlanarTravel, SamplingPolicy, SamplingSettings

SECONDS, REACH = 0.04, 0.05  # of a step [s]; how far an action of 1 moves the mocap body [m]
STRIDE = 0.0325  # how far the gripper goes in each step at an action of 1 [m]
NEAR = 0.015  # from the goal, where the gripper stops [m]
FROM_REST = 0.0297  # how far it goes in a step from rest [m]
EFFORT, SOON = 1e-3, 5e-4  # weights of the actions, and of every stage, in parts of the final one
GAP, LEAD, LAG = 0.03, 0.022, 0.055  # run-up; lead of the fingers [m], in parts of the way, as they give way along y
ABOVE, CLEAR, PRESSED = 0.468, 0.46, 0.4575  # heights: over the puck, clear of it, in touch with it [m]
LAND, PRESS, PULL = -0.4, -0.2, 0.9  # actions: down onto the puck, and pressing and dragging
REACHED, HIT = 1.2, 1.12  # x up to which the puck is dragged to the goal, and where it is hit otherwise [m]
CLOSE, STILL, ASIDE = 0.012, 0.06, 0.012  # end of a drag [m], [m/s]; how far off its centre a hit may be [m]
HEIGHT = 0.425  # of the gripper's site above the floor, fingers just above the table [m]


def fingers(model: Any) -> np.ndarray:
    """Half the width and depth of the two closed fingers together [m], as seen from above."""
    finger = model.geom("robot0:r_gripper_finger_link")
    aside = model.body("robot0:r_gripper_finger_link").pos[1] + finger.pos[1] + finger.size[1]
    return np.array([finger.size[2], aside])


def friction_with_table(model: Any) -> float:
    """Coefficient of friction of object and table: the larger of the two geoms', as MuJoCo combines them."""
    table = model.geom(model.body("table0").geomadr[0])
    return float(max(model.geom("object0").friction[0], table.friction[0]))


def place_of_rest(seen: np.ndarray, friction: float) -> np.ndarray:
    """Return where an object that slides on the table comes to rest (2,), if nothing pushes it: v² / 2 μ g ahead."""
    velocity = (seen[14:16] + seen[20:22]) / SECONDS  # the environment gives ways in a step, relative to the gripper
    return seen[3:5] + velocity * np.linalg.norm(velocity) / (2 * 9.81 * friction)


class PushPolicy:
    """Sampling-based contact MPC of a block that moves only while it is pushed."""

    def __init__(self, model: Any):
        block, tip, corner = model.geom("object0"), float(fingers(model).mean()), float(np.linalg.norm(fingers(model)))
        self.friction = friction_with_table(model)
        friction = max(block.friction[0], model.geom("robot0:r_gripper_finger_link").friction[0])
        half = block.size[:2]
        outline = box(-half[0], half[0], -half[1], half[1])
        system = PlanarPushing(outline, tip, friction=float(friction), length=0.02)
        cost = GoalCost.reach(5, 2, goal_weight=(100.0, 100.0, 0.01), input_weight=200.0)
        mpc = LCSMPCLayer(system, cost, 8, -0.02, 0.02, on_failure="mask", relaxation=1e-5)
        self.policy = SamplingPolicy(
            mpc,
            DiscPlaces(outline, corner, 24, gap=0.005, reach=0.02),
            PlanarTravel(outline, corner, step=0.032, clearance=0.01, tolerance=0.01),
            SamplingSettings(travel_price=0.5),
        )

    def reset(self) -> None:
        """Begin an episode."""
        self.policy.reset()

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """The action (4,) of the environment."""
        seen, goal = observation["observation"], observation["desired_goal"]
        rest = place_of_rest(seen, self.friction)
        if np.linalg.norm(rest - goal[:2]) < NEAR:
            return np.zeros(4)
        x = np.array([*rest, seen[13], *seen[:2]])
        u = self.policy.act(x, [*goal[:2], x[2]])
        return np.clip([*(u / STRIDE), (HEIGHT - seen[2]) / REACH, 0.0], -1.0, 1.0)


def sliding_system(model: Any, looks: int = 4, coarse: int = 11) -> LCSSequence:
    """Make the system of gripper and puck along a line: `looks` actions in steps of 10 ms, then 1.1 s of sliding.

    The state is place and velocity of the gripper's front, place of the mocap body, place and velocity of the puck's
    back. The weld is a spring at critical damping with the time constant of its `solref`. An action moves the mocap
    body to where the gripper is and `REACH` times the action on. With impulses λ₁ of the contact and λ₂ that ends the
    friction when the puck stands,

        v₊ = v − μ g h + λ₁ + λ₂,    0 ≤ λ₁ ⊥ gap₊ / h ≥ 0,    0 ≤ λ₂ ⊥ v₊ ≥ 0.
    """
    rate = 1 / model.eq_solref[0, 0]
    return LCSSequence.stack(
        [_sliding_stage(model, rate, 0.01, decides=k % 4 == 0) for k in range(4 * looks)]
        + [_sliding_stage(model, rate, 0.1, touches=False) for _ in range(coarse)]
    )


def _sliding_stage(model: Any, rate: float, h: float, decides: bool = False, touches: bool = True) -> LCSParams:
    """Make one stage of `sliding_system`, of h seconds."""
    decay, brake = np.exp(-rate * h), 9.81 * friction_with_table(model) * h
    # Of the gripper around the mocap body.
    spring = decay * np.array([[1 + rate * h, h], [-(rate**2) * h, 1 - rate * h]])
    A, B, C = np.eye(5), np.zeros((5, 1)), np.zeros((5, 2))
    toward = np.array([1.0, 0.0]) - spring[:, 0]
    A[:2, :2] = spring
    A[:2, 2] = toward
    if decides:
        A[:3, 0] += A[:3, 2]
        A[:3, 2], B[:3, 0] = 0.0, REACH * np.array([*toward, 1.0])
    A[3, 4] = h
    C[3:], d = [[h, h / 2], [1.0, 1.0]], np.array([0.0, 0.0, 0.0, -h * brake / 2, -brake])
    gap, speed = np.array([-1.0, 0.0, 0.0, 1.0, 0.0]) / h, np.eye(5)[4]
    rows = np.stack([gap, speed])
    D, E, F, c = rows @ A, rows @ B, rows @ C, rows @ d
    if not touches:
        D[0], E[0], F[0], c[0], C[:, 0], F[1, 0] = 0.0, 0.0, [1.0, 0.0], 1.0, 0.0, 0.0
    return LCSParams(*map(torch.from_numpy, (A, B, C, d, D, E, F, c)))


class SlidePolicy:
    """Contact MPC of a puck that slides on, behind a goal that the arm cannot reach.

    The closed fingers press on the puck from above, and drag it: to the goal, or onto the line along which they will
    hit it, with their flat front. They go behind it, and the MPC says how to hit it so that it stops at the goal.
    """

    def __init__(self, model: Any):
        self.half, self.radius = fingers(model), float(model.geom("object0").size[0])
        self.friction = friction_with_table(model)
        self.carry = SECONDS * np.exp(-SECONDS / model.eq_solref[0, 0])
        system = sliding_system(model)
        final = torch.zeros(5, 5, dtype=torch.float64)
        final[3, 3] = 1000.0
        effort = torch.tensor([[EFFORT]], dtype=torch.float64)
        cost = GoalCost(SOON * final, effort, final, -SOON * final[:, 3:4], -final[:, 3:4], goal_final=final[3:4, 3:4])
        self.mpc = LCSMPCLayer(system, cost, system.horizon, -1.0, 1.0, on_failure="mask", relaxation=1e-5)

    def reset(self) -> None:
        """Begin an episode."""
        self.act_now = self.mount

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """The action (4,) of the environment."""
        self.seen, self.goal = observation["observation"], observation["desired_goal"]
        self.gripper, self.puck, self.speed = self.seen[:3], self.seen[3:6], self.seen[20:23] / SECONDS
        self.moves = self.seen[14:17] / SECONDS + self.speed
        return np.append(np.clip(self.act_now(), -1.0, 1.0), 0.0)

    def go(self, xy: Any, z: float) -> np.ndarray:
        """The action (3,) after which the gripper is at a place, if that is not too far."""
        return (np.array([*xy, z]) - self.gripper - self.carry * self.speed) / FROM_REST

    def mount(self) -> np.ndarray:
        """Go above the puck, and press on it, off its centre by what the fingers will give way along y."""
        ahead = float(np.clip(LAG * (self.target()[1] - self.puck[1]), -LEAD, LEAD))
        apart = (self.puck - self.gripper)[:2] - [0.0, ahead]
        away = float(np.linalg.norm(apart))
        if away < 0.012 and self.gripper[2] < PRESSED:
            self.act_now = self.drag
            return self.drag()
        if away < 0.012:
            return np.array([*self.go(self.gripper[:2] + apart, 0.0)[:2], LAND])
        high = self.gripper[2] > CLEAR
        held = 1.0 if high else max(0.0, 1.0 - 0.07 / away)  # no nearer than 7 cm before it is above
        return self.go(self.gripper[:2] + held * apart, ABOVE)

    def target(self) -> np.ndarray:
        """Where the puck is dragged (2,): to the goal, or to the line along which it is hit."""
        return self.goal[:2] if self.goal[0] < REACHED else np.array([max(HIT, self.puck[0]), self.goal[1]])

    def drag(self) -> np.ndarray:
        """Press on the puck, and drag it."""
        if np.linalg.norm((self.puck - self.gripper)[:2]) > 0.03:
            self.act_now = self.mount
            return self.mount()
        left = self.target() - self.puck[:2]
        move = self.go(self.gripper[:2] + left, 0.0)
        if np.abs(left).max() < CLOSE and np.abs(self.moves[:2]).max() < STILL:
            if self.goal[0] < REACHED:
                return np.array([0.0, 0.0, PRESS])
            self.act_now = self.go_behind
            return self.go_behind()
        return np.array([*np.clip(move[:2], -PULL, PULL), PRESS])

    def go_behind(self) -> np.ndarray:
        """Rise, and go down behind the puck."""
        behind = self.puck[0] - self.radius - self.half[0]
        if self.gripper[0] < behind and self.gripper[2] < HEIGHT + 0.015:
            self.act_now = self.hit
            return self.hit()
        high = self.gripper[2] < CLEAR and self.gripper[0] > behind
        back = behind - GAP
        x, y = self.gripper[:2] if high else (back, self.puck[1])
        return self.go((x, y), ABOVE if self.gripper[0] > behind + 0.01 else HEIGHT)

    def hit(self) -> np.ndarray:
        """Hit the puck along x, by contact MPC."""
        left = self.goal[0] - self.puck[0]
        left *= np.interp(left, [0.35, 0.5], [0.87, 1.0])  # soft contacts give more; what is short is hit again
        rest = place_of_rest(self.seen, self.friction)
        if self.goal[0] - rest[0] < NEAR:
            return self.go(self.gripper[:2], HEIGHT)
        gap = self.puck[0] - self.radius - self.half[0] - self.gripper[0]
        front = -max(gap, 0.0)  # contacts are soft; what is pressed together does not spring apart
        x = torch.tensor([front, self.speed[0], front, 0.0, self.moves[0]], dtype=torch.float64)
        self.plan = self.mpc(x, torch.tensor([left], dtype=torch.float64))
        aside = self.go((0.0, self.puck[1] + np.clip(self.goal[1] - self.puck[1], -ASIDE, ASIDE)), HEIGHT)
        return np.array([float(self.plan.action[0]), *aside[1:]])
