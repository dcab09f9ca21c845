"""FetchPush and FetchSlide of gymnasium-robotics by contact MPC: `python examples/fetch_policies.py push --json`.

An arm brings a block (push) or a puck (slide) on a table to a place, in 50 steps of 0.04 s. Each component of an action
moves the mocap body that the gripper is welded to, by at most 5 cm from where the gripper is. Success is the
environment's flag `is_success` after the last step: the object within 5 cm of its goal.

The policies are given the environment's observation and its MJCF: sizes, friction, stiffness of the weld. Nothing is
learned. They plan with contact LCSs: of a block that two closed fingers, taken for a disc, push about a plane, and of a
gripper that hits a puck, which slides on until friction stops it. The hit is tried beforehand in a copy of the scene in
MuJoCo. Settings were chosen with seeds from 1000 to 1219.

Figures are those of seeds 5000 and up, times CPU times of the policy. It needs `pip install gymnasium-robotics`.
"""

# What needs gymnasium-robotics is imported where it is used; MuJoCo is a compiled module without type stubs.
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from successes import success_figures, success_text

from difflcs import GoalCost, LCSMPCLayer, LCSParams, LCSSequence
from difflcs.physics import PlanarPushing, box
from difflcs.planning import DiscPlaces, PlanarTravel, SamplingPolicy, SamplingSettings

STEPS = 50  # of an episode
SECONDS, REACH = 0.04, 0.05  # of a step [s]; how far an action of 1 moves the mocap body [m]
STRIDE = 0.0325  # how far the gripper goes in each step at an action of 1 [m]
NEAR = 0.015  # from the goal, where the gripper stops [m]
FROM_REST = 0.0297  # how far it goes in a step from rest [m]
EFFORT, SOON = 1e-3, 5e-4  # weights of the actions, and of every stage, in parts of the final one
GAP, LEAD, LAG = 0.03, 0.022, 0.055  # run-up; lead of the fingers [m], in parts of the way, as they give way along y
ABOVE, CLEAR, PRESSED, SLIPPED = 0.468, 0.46, 0.4575, 0.452  # heights: over the puck, clear of it, on it, beside it [m]
LAND, PRESS, PULL = -0.4, -0.2, 0.9  # actions: down onto the puck, and pressing and dragging
REACHED, HIT = 1.2, 1.12  # x up to which the puck is dragged to the goal, and where it is hit otherwise [m]
CLOSE, STILL, ASIDE = 0.012, 0.06, 0.012  # end of a drag [m], [m/s]; how far off its centre a hit may be [m]
TRIALS, PLAYS, ENOUGH = 60, 3, 0.01  # hits tried, how often each, and the miss that is small enough [m]
BACK, FACE, SHAKE = 4, 0.014, 1e-4  # run-ups tried; how far off its centre the puck is hit, and laid anew [m]
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


def place_of_rest(place: np.ndarray, velocity: np.ndarray, friction: float, seconds: float = np.inf) -> np.ndarray:
    """Return where an object that slides on the table is after so many seconds (2,), if nothing pushes it."""
    speed, brake = float(np.linalg.norm(velocity[:2])), 9.81 * friction
    t = min(seconds, speed / brake)
    return place[:2] + velocity[:2] * (t - t**2 * brake / max(2 * speed, 1e-9))


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
        moves = (seen[14:17] + seen[20:23]) / SECONDS  # the environment gives ways in a step, relative to the gripper
        rest = place_of_rest(seen[3:6], moves, self.friction)
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


class Twin:
    """A copy of the scene in MuJoCo, set to what is observed, in which a hit is tried before it is made.

    Args:
        model: of the environment.
        posture: of all joints (nq,), in which the arm begins every episode.
    """

    def __init__(self, model: Any, posture: np.ndarray):
        self.model, self.data, self.posture = model, mujoco.MjData(model), posture
        self.link, self.site = model.body("robot0:gripper_link").id, model.site("robot0:grip").id
        puck = model.joint("object0:joint")
        self.q, self.v = int(puck.qposadr[0]), int(puck.dofadr[0])
        self.fingers = [int(model.joint(f"robot0:{side}_gripper_finger_joint").qposadr[0]) for side in "lr"]
        self.jacobian, self.kind = np.zeros((3, model.nv)), mujoco.mjtState.mjSTATE_INTEGRATION

    def reset(self) -> None:
        """Begin an episode."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.posture

    def observe(self, seen: np.ndarray) -> None:
        """Set puck and gripper to an observation (25,); the arm's joints follow by the least change."""
        model, data, velocity = self.model, self.data, seen[20:23] / SECONDS  # of the gripper
        turn, spin = data.qpos[self.q + 3 :][:4], data.qvel[self.v + 3 :][:3]
        data.qpos[self.q :][:3], data.qvel[self.v :][:3] = seen[3:6], seen[14:17] / SECONDS + velocity
        mujoco.mju_euler2Quat(turn, seen[11:14], "xyz")
        mujoco.mju_rotVecQuat(spin, seen[17:20] / SECONDS, turn * [1.0, -1.0, -1.0, -1.0])  # in the puck's frame
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, self.jacobian, None, self.site)
        soft = self.jacobian / model.dof_damping  # the joints of the base are damped so much that they stand
        inverse = soft.T @ np.linalg.inv(self.jacobian @ soft.T)
        mujoco.mj_integratePos(model, data.qpos, inverse @ (seen[:3] - data.site_xpos[self.site]), 1.0)
        data.qvel += inverse @ (velocity - self.jacobian @ data.qvel)
        mujoco.mj_forward(model, data)

    def step(self, action: np.ndarray) -> None:
        """Play an action as the environment does."""
        data = self.data
        data.mocap_pos[0] = data.xpos[self.link] + REACH * action[:3]
        data.mocap_quat[0] = data.xquat[self.link] + [1.0, 0.0, 1.0, 0.0]
        mujoco.mj_step(self.model, data, round(SECONDS / self.model.opt.timestep))
        data.qpos[self.fingers] = 0.0
        mujoco.mj_forward(self.model, data)

    def places(self) -> tuple[np.ndarray, ...]:
        """Place [m] and velocity [m/s] of the gripper, and those of the puck."""
        data = self.data
        mujoco.mj_jacSite(self.model, data, self.jacobian, None, self.site)
        puck = data.qpos[self.q :][:3].copy(), data.qvel[self.v :][:3].copy()
        return data.site_xpos[self.site].copy(), self.jacobian @ data.qvel, *puck

    def state(self) -> np.ndarray:
        """State to which `set_state` returns."""
        state = np.zeros(mujoco.mj_stateSize(self.model, self.kind))
        mujoco.mj_getState(self.model, self.data, state, self.kind)
        return state

    def set_state(self, state: np.ndarray, shift: np.ndarray) -> None:
        """Return to a state, in which the puck is laid aside by `shift` (2,) [m]."""
        mujoco.mj_setState(self.model, self.data, state, self.kind)
        self.data.qpos[self.q :][:2] += shift
        mujoco.mj_forward(self.model, self.data)


class Hit(NamedTuple):
    """How the puck is hit: steps of run-up more, part of the way that is asked of the MPC, way off its centre [m]."""

    back: int = 0
    part: float = 1.0
    aside: float = 0.0


class SlidePolicy:
    """Contact MPC of a puck that slides on, behind a goal that the arm cannot reach.

    The closed fingers press on the puck from above, and drag it: to the goal, or onto the line along which they will
    hit it, with their flat front. They go behind it, and the MPC says how to hit it so that it stops at the goal. How
    much of the way is asked of it, the run-up and the way off the puck's centre are those that do best in the twin.

    Args:
        model: of the environment.
        posture: of all joints (nq,), in which the arm begins every episode.
    """

    def __init__(self, model: Any, posture: np.ndarray):
        self.half, self.radius = fingers(model), float(model.geom("object0").size[0])
        self.friction, self.twin = friction_with_table(model), Twin(model, posture)
        self.carry = SECONDS * np.exp(-SECONDS / model.eq_solref[0, 0])
        system = sliding_system(model)
        final = torch.zeros(5, 5, dtype=torch.float64)
        final[3, 3] = 1000.0
        effort = torch.tensor([[EFFORT]], dtype=torch.float64)
        cost = GoalCost(SOON * final, effort, final, -SOON * final[:, 3:4], -final[:, 3:4], goal_final=final[3:4, 3:4])
        self.mpc = LCSMPCLayer(system, cost, system.horizon, -1.0, 1.0, on_failure="mask", relaxation=1e-5)

    def reset(self) -> None:
        """Begin an episode."""
        self.twin.reset()
        self.act_now, self.left, self.how, self.random = self.mount, STEPS, Hit(), np.random.RandomState(0)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """The action (4,) of the environment."""
        self.goal = observation["desired_goal"]
        self.twin.observe(observation["observation"])
        self.look()
        action = np.append(np.clip(self.act_now(), -1.0, 1.0), 0.0)
        self.twin.step(action)
        self.left -= 1
        return action

    def look(self) -> None:
        """Read places [m] and velocities [m/s] of gripper and puck off the twin."""
        self.gripper, self.speed, self.puck, self.moves = self.twin.places()
        self.gap = self.puck[0] - self.radius - self.half[0] - self.gripper[0]

    def go(self, xy: Any, z: float) -> np.ndarray:
        """The action (3,) after which the gripper is at a place, if that is not too far."""
        return (np.array([*xy, z]) - self.gripper - self.carry * self.speed) / FROM_REST

    def mount(self) -> np.ndarray:
        """Go above the puck, and press on it, off its centre by what the fingers will give way along y."""
        if self.arrived():
            return self.act_on(self.leave if self.goal[0] < REACHED else self.go_behind)
        ahead = float(np.clip(LAG * (self.target()[1] - self.puck[1]), -LEAD, LEAD))
        apart = (self.puck - self.gripper)[:2] - [0.0, ahead]
        away = float(np.linalg.norm(apart))
        if away < 0.012 and SLIPPED <= self.gripper[2] < PRESSED:
            return self.act_on(self.drag)
        if away < 0.012 and self.gripper[2] >= SLIPPED:
            return np.array([*self.go(self.gripper[:2] + apart, 0.0)[:2], LAND])
        high = self.gripper[2] > CLEAR
        held = 1.0 if high else max(0.0, 1.0 - 0.07 / away)  # no nearer than 7 cm before it is above
        return self.go(self.gripper[:2] + held * apart, ABOVE)

    def act_on(self, act: Any) -> np.ndarray:
        """Go on with another of the ways to act."""
        self.act_now = act
        return act()

    def target(self) -> np.ndarray:
        """Where the puck is dragged (2,): to the goal, or to the line along which it is hit."""
        return self.goal[:2] if self.goal[0] < REACHED else np.array([max(HIT, self.puck[0]), self.goal[1]])

    def arrived(self) -> bool:
        """Tell whether the puck stands where it is dragged to."""
        return bool(np.abs(self.target() - self.puck[:2]).max() < CLOSE and np.abs(self.moves[:2]).max() < STILL)

    def drag(self) -> np.ndarray:
        """Press on the puck, and drag it, while the fingers do not slip off."""
        if self.arrived() or np.linalg.norm((self.puck - self.gripper)[:2]) > 0.03 or self.gripper[2] < SLIPPED:
            return self.act_on(self.mount)
        move = self.go(self.gripper[:2] + self.target() - self.puck[:2], 0.0)
        return np.array([*np.clip(move[:2], -PULL, PULL), PRESS])

    def leave(self) -> np.ndarray:
        """Rise from the puck at its goal."""
        if np.abs(self.target() - self.puck[:2]).max() > 2 * CLOSE:
            return self.act_on(self.mount)
        return self.go(self.gripper[:2], ABOVE)

    def go_behind(self) -> np.ndarray:
        """Rise, and go down behind the puck."""
        behind = self.puck[0] - self.radius - self.half[0]
        if self.gripper[0] < behind and self.gripper[2] < HEIGHT + 0.015:
            self.rehearse()
            return self.act_on(self.hit)
        high = self.gripper[2] < CLEAR and self.gripper[0] > behind
        back = behind - GAP
        x, y = self.gripper[:2] if high else (back, self.puck[1])
        return self.go((x, y), ABOVE if self.gripper[0] > behind + 0.01 else HEIGHT)

    def rehearse(self) -> None:
        """Try hits in the twin, and take the one after which the puck ends nearest to its goal, in the worse play."""
        state, least, best, over = self.twin.state(), np.inf, Hit(), 0.0
        for trial in range(TRIALS):
            hit = best
            if trial > 0:  # ask for less by as much as the best one goes too far; at every other trial anywhere else
                part = best.part - over / (self.goal[0] - self.puck[0]) + 0.03 * self.random.randn()
                back, aside = best.back, best.aside + 0.002 * self.random.randn()
                if trial % 2:
                    back, aside = self.random.randint(BACK), self.random.uniform(-FACE, FACE)
                hit = Hit(back, float(np.clip(part, 0.5, 1.5)), aside)
            misses = []
            while len(misses) < PLAYS and np.linalg.norm(misses[-1:]) < least:
                self.twin.set_state(state, len(misses) * SHAKE * self.random.randn(2))
                misses.append(self.play(hit))
            away = np.linalg.norm(misses, axis=1)
            if away.max() < least:
                least, best, over = away.max(), hit, misses[int(away.argmax())][0]
            if least < ENOUGH:
                break
        self.twin.set_state(state, np.zeros(2))
        self.look()
        self.how = best

    def play(self, how: Hit) -> np.ndarray:
        """Play a hit in the twin: how far beyond the goal the puck is at the end of the episode (2,) [m]."""
        self.how, left = how, self.left
        self.look()
        while left > 0 and not (self.gap > 0.005 and self.moves[0] > max(self.speed[0], 0.0) + 0.05):  # it is hit
            self.twin.step(np.append(np.clip(self.hit(), -1.0, 1.0), 0.0))
            self.look()
            left -= 1
        return place_of_rest(self.puck, self.moves, self.friction, left * SECONDS) - self.goal[:2]

    def hit(self) -> np.ndarray:
        """Hit the puck along x, by contact MPC."""
        off = np.clip(self.goal[1] - self.puck[1], -ASIDE, ASIDE) + self.how.aside
        aside = self.go((0.0, self.puck[1] + off), HEIGHT)[1:]
        if self.how.back > 0:
            self.how = self.how._replace(back=self.how.back - 1)
            return np.array([-1.0, *aside])
        if self.goal[0] - place_of_rest(self.puck, self.moves, self.friction)[0] < NEAR:
            return self.go(self.gripper[:2], HEIGHT)
        left = self.how.part * (self.goal[0] - self.puck[0])
        front = -max(self.gap, 0.0)  # contacts are soft; what is pressed together does not spring apart
        x = torch.tensor([front, self.speed[0], front, 0.0, self.moves[0]], dtype=torch.float64)
        plan = self.mpc(x, torch.tensor([left], dtype=torch.float64))
        return np.array([float(plan.action[0]), *aside])


@dataclass
class Options:
    """FetchPush or FetchSlide by contact MPC."""

    task: tyro.conf.Positional[Literal["push", "slide"]]
    """FetchPush-v4 or FetchSlide-v4."""
    episodes: int = 500
    """Episodes, of seeds `seed`, `seed` + 1, …"""
    seed: int = 0
    """Seed of the first episode."""
    json: bool = False
    """Print a line of JSON."""


def make_env(task: str) -> Any:
    """Make the environment as it is published, for MuJoCo 4 as well."""
    import gymnasium_robotics
    from gymnasium_robotics.utils import mujoco_utils

    # With MuJoCo 4 the kinds of joints are no longer equal to their numbers, which an assertion there expects.
    kinds = SimpleNamespace(**{name: int(kind) for name, kind in mujoco.mjtJoint.__members__.items()})
    mujoco_utils.mujoco = SimpleNamespace(**{**vars(mujoco), "mjtJoint": kinds})
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make("FetchPush-v4" if task == "push" else "FetchSlide-v4")


def play(env: Any, policy: Any, seed: int) -> tuple[bool, int, float, float]:
    """Play an episode: success, steps until the object first was at its goal, final distance [m], CPU time [s]."""
    observation, _ = env.reset(seed=seed)
    policy.reset()
    seconds, first, info = 0.0, STEPS, {}
    for step in range(STEPS):
        start = time.process_time()
        action = policy.act(observation)
        seconds += time.process_time() - start
        observation, _, _, _, info = env.step(action.astype(np.float32))
        if info["is_success"]:
            first = min(first, step + 1)
    away = float(np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"]))
    return bool(info["is_success"]), first, away, seconds


def main(o: Options) -> None:
    """Play the episodes, print the figures."""
    torch.set_num_threads(1)
    env = make_env(o.task)
    model, posture = env.unwrapped.model, env.unwrapped.initial_qpos
    policy = PushPolicy(model) if o.task == "push" else SlidePolicy(model, posture)
    episodes = np.array([play(env, policy, seed) for seed in range(o.seed, o.seed + o.episodes)])
    env.close()
    success, first, away, seconds = episodes.T
    figures = {
        **success_figures(success),
        "mean_steps": float(first.mean()),
        "final_mm": 1e3 * float(np.median(away)),
        "milliseconds_per_step": 1e3 * float(seconds.sum()) / (STEPS * len(episodes)),
        "failed": [o.seed + int(i) for i in np.flatnonzero(success == 0)],
    }
    if o.json:
        print(json.dumps({"task": o.task, **figures}))
        return
    print(
        f"{o.task}: {success_text(figures)}, at the goal after {first.mean():.1f} steps, {figures['final_mm']:.0f} mm "
        f"from it at the end, {figures['milliseconds_per_step']:.1f} ms a step; failed: {figures['failed']}"
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
