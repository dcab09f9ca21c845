"""Gymnasium's `Pusher-v5` without training: `python examples/pusher.py --episodes 100 --seed 5000`.

An arm of 7 joints, driven by torques, pushes a cylinder to a goal with its fork; 100 steps of 50 ms. The return is the
sum of −|object − goal| − ½ |object − fork| − 0.1 |torques|². From MuJoCo 3 on the fork passes through the object
(github.com/Farama-Foundation/Gymnasium/issues/1576); `harden` mends it, `--soft` leaves the environment as it is.

The controller knows model and state. It compares ways that geometry suggests, in MuJoCo, and improves the best one by
contact MPC: system and cost are linearised along the last plan, and a pass counts if the return in MuJoCo grows.
With `--soft` a bar of the fork is held inside the object, which slowly gives way; such a way is varied at random in
MuJoCo for the whole episode before it begins, and contact MPC improves it then only.
Settings were chosen with seeds below 1000. Times are CPU times of one core.
"""

from __future__ import annotations

import itertools
import json
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from torch import Tensor

from difflcs import CostSequence, LCSMPCLayer, LCSSequence
from difflcs.errors import ContactWarning
from difflcs.mpc import Primal
from difflcs.mpc.backends import BatchedBackend
from difflcs.physics.mujoco import (
    ContactGroup,
    Distance,
    MujocoCost,
    MujocoLCS,
    Orientation,
    Position,
    Posture,
)

PUSHER_XML = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "pusher_v5.xml"
STEPS, SUBSTEPS, SECONDS, JOINTS = 100, 5, 0.05, 7
MARGIN = 0.004  # at which MuJoCo's contacts of this model begin to act [m]; MujocoLCS leaves margins out
BUDGETS = ("object", 4), ("table", 2)  # contacts without friction, each with the fork
PALM = np.array([0.072, 0.0])  # where the object is to be in the fork, in front of the wrist [m]
# Middle of each bar of the fork, from the wrist [m], and the direction in which it pushes, in the fork's frame.
ASIDE = np.array([0.05, 0.1])
BARS = [(0 * ASIDE, 0.0), *((ASIDE * [1, side], turn) for side in (1, -1) for turn in (np.pi / 2, -np.pi / 2))]
DEEP, CREEP = 0.015, 0.045  # a bar's middle behind the object's [m]; how fast the object gives way [m/s]
TRIES = 300  # variations of ways that press


@dataclass
class Options:
    """Pusher-v5 by contact MPC."""

    episodes: int = 10
    """Episodes, of seeds `seed`, `seed` + 1, …"""
    seed: int = 0
    """Seed of the first episode."""
    soft: bool = False
    """Leave the object as soft as MuJoCo 3 and later take it."""
    still: bool = False
    """Do nothing, for comparison."""
    json: bool = False
    """Print a line of JSON at the end."""


def harden(model: Any) -> None:
    """Give the object of Pusher-v5 the weight in contacts that it has in MuJoCo 2.

    MuJoCo makes a contact as stiff as the inverse weights of its bodies say. The object weighs 8 mg, and its joints
    have an armature of 40 g. From MuJoCo 3 on the weight of a body with slides alone leaves out the armature.
    """
    model.body_invweight0[model.body("object").id] = [2 / 3 / 0.04, 0.0]
    model.dof_invweight0[model.body("object").dofadr[0] :][:2] = 1 / 0.04


Drive = Callable[[int, Any], np.ndarray]  # torques (7,) at a step, in the state of MuJoCo's data


class Way(NamedTuple):
    """Joint angles (n, 7) to pass; steps to the first, from there to the last, and over which it is smoothed."""

    angles: np.ndarray
    come: float
    carry: float
    smooth: float = 7.0

    def at(self, start: np.ndarray, horizon: int) -> np.ndarray:
        """Joint angles (H, 7) after each step, from those at the start (7,)."""
        times = np.r_[0, self.come + np.linspace(0, self.carry, len(self.angles))]
        return smoothed(np.vstack([start, self.angles]), times, round(self.smooth), horizon)

    def vary(self, change: np.ndarray, low: np.ndarray, high: np.ndarray) -> Way:
        """Move each angle and the logarithm of each time by `change` (7 n + 3,), within the limits of the joints."""
        angles = np.clip(self.angles + change[:-3].reshape(-1, JOINTS), low, high)
        times = np.array(self[1:]) * np.exp(change[-3:])
        return Way(angles, *np.clip(times, [8.0, 10.0, 2.0], [50.0, 150.0, 20.0]))


def smoothed(angles: np.ndarray, times: np.ndarray, width: int, horizon: int) -> np.ndarray:
    """Angles (H, 7) between those (n, 7) at times (n,), averaged twice over `width` steps."""
    at, weights = (
        np.arange(-width - 1, horizon + width + 1),
        np.convolve(np.ones(width) / width, np.ones(width) / width),
    )
    way = [np.convolve(np.interp(at, times, angle), weights, "same")[width : width + horizon] for angle in angles.T]
    return np.transpose(way)


class ForkWays:
    """Ways of the arm by geometry alone: the fork comes round the object, and carries it to the goal.

    Args:
        model: of the environment.
        module: system of the arm whose model has a site "palm" where the object is to be in the fork.
    """

    def __init__(self, model: Any, module: MujocoLCS):
        self.model, self.data, self.n_x = model, mujoco.MjData(model), module.n_x
        arm = Posture([model.joint(j).name for j in range(JOINTS)], goal=[0.0] * JOINTS, weight=0.05)
        terms = [Position("palm", weight=100.0), Orientation("tips_arm", weight=[1.0, 0.2, 0.5]), arm]
        self.cost = MujocoCost(module, terms)
        self.low, self.high = np.add(model.jnt_range[:JOINTS].T, [[0.03], [-0.03]])

    def reach(self, q: np.ndarray, point: np.ndarray, yaw: float) -> np.ndarray:
        """Find joint angles (7,) near q, within the limits, with the palm at a point and the fork at a yaw."""
        goal = torch.tensor([*point, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)], dtype=torch.float64)
        x = torch.zeros(self.n_x, dtype=torch.float64)
        for _ in range(40):  # Gauss–Newton
            x[:JOINTS] = torch.from_numpy(q)
            near = self.cost.at(x, goal)
            slope, curve = ((near.Q @ x + near.q)[:JOINTS]).numpy(), near.Q[:JOINTS, :JOINTS].numpy()
            free = ~((q <= self.low) & (slope > 0) | (q >= self.high) & (slope < 0))
            step = np.zeros(JOINTS)
            step[free] = -np.linalg.solve(curve[np.ix_(free, free)] + 0.01 * np.eye(free.sum()), slope[free])
            longest = abs(step).max()
            q = np.clip(q + step * min(1.0, 0.3 / longest), self.low, self.high)
            if longest < 1e-3:
                break
        return q

    def postures(self, start: np.ndarray, goal: np.ndarray, yaw: float, above: bool) -> Iterator[np.ndarray]:
        """Joint angles from the place of the object (3,) to the goal; `above`: the fork is lowered on the object."""
        behind = -0.018 * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        q = np.zeros(JOINTS)
        if above:
            yield (q := self.reach(q, np.r_[(start + behind)[:2], -0.13], yaw))
        for part in np.linspace(0.0, 1.0, 5):
            yield (q := self.reach(q, start + part * (goal - start) + (part == 0) * behind, yaw))

    def see(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Place of the object and, at its height, of the goal (3,); direction from one to the other [rad]."""
        self.data.qpos[:] = x[: self.model.nq]
        mujoco.mj_kinematics(self.model, self.data)
        start, goal = self.data.body("object").xpos.copy(), self.data.body("goal").xpos.copy()
        goal[2] = start[2]
        return start, goal, float(np.arctan2(*(goal - start)[1::-1]))

    def plans(self, x: np.ndarray, horizon: int) -> Iterator[Drive]:
        """Ways from a state x: several yaws of the fork, from above or not, and speeds."""
        start, goal, heading = self.see(x)
        for turn, above in itertools.product((-1.2, -0.6, 0.0, 0.6, 1.2), (False, True)):
            q = np.array([x[:JOINTS], *self.postures(start, goal, heading + turn, above)])
            for come, carry in itertools.product((13, 18, 24), (12, 18)):  # steps
                times = np.r_[0, [come] * above, come + 6 * above + np.linspace(0, carry, 5)]
                yield self.follow(smoothed(q, times, 7, horizon))

    def presses(self, x: np.ndarray) -> Iterator[Way]:
        """Ways from a state x on which one of the fork's bars is held inside the object, behind its middle."""
        start, goal, heading = self.see(x)
        for middle, push in BARS:
            yaw = (heading - push + np.pi) % (2 * np.pi) - np.pi
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            apart = turn @ (PALM - middle) - DEEP * np.array([np.cos(heading), np.sin(heading)])
            q, angles = np.zeros(JOINTS), []
            for part in (0.0, 0.5, 1.0):
                angles.append(q := self.reach(q, start + part * (goal - start) + [*apart, 0.0], yaw))
            yield Way(np.array(angles), 20.0, float(np.linalg.norm(goal - start)) / CREEP / SECONDS)

    def follow(self, way: np.ndarray) -> Drive:
        """Torques with which joints follow angles (H, 7), by inverse dynamics of the state they are in."""
        inertia, speed = np.zeros((self.model.nv, self.model.nv)), np.gradient(way, SECONDS, axis=0)
        change = np.gradient(speed, SECONDS, axis=0)

        def drive(k: int, data: Any) -> np.ndarray:
            mujoco.mj_forward(self.model, data)
            mujoco.mj_fullM(self.model, data, inertia)
            wanted = change[k] + 64.0 * (way[k] - data.qpos[:JOINTS]) + 12.8 * (speed[k] - data.qvel[:JOINTS])
            force = inertia[:JOINTS, :JOINTS] @ wanted + (data.qfrc_bias - data.qfrc_passive)[:JOINTS]
            return np.clip(force, -2.0, 2.0)

        return drive


class Played(NamedTuple):
    """Torques (H, 7) in MuJoCo: states (H + 1, n_x), distances (H, 2), and the return to the end of the episode."""

    plan: np.ndarray
    states: np.ndarray
    apart: np.ndarray
    value: float


class PusherPolicy:
    """Contact MPC of the return itself: system and cost are linearised along the last plan, and a pass must pay.

    Args:
        model: of the environment.
        horizon: steps of a plan.
        press: press on a soft object, by one plan for the whole episode.
    """

    def __init__(self, model: Any, horizon: int = 40, press: bool = False):
        spec = mujoco.MjSpec.from_file(str(PUSHER_XML))
        spec.body("object").geoms[0].size[0] += MARGIN
        spec.geom("table").pos[2] += MARGIN
        spec.body("tips_arm").add_site(name="palm", pos=[*PALM, 0.0])
        fork, budgets = "r_wrist_roll_link", [ContactGroup(of, n, friction=False) for of, n in BUDGETS]
        self.module = MujocoLCS(
            spec.compile(),
            motion="dynamic",
            seconds=SECONDS,
            pairs=[(fork, "object"), (fork, "table")],
            contacts=budgets,
            distance=0.3,
            limits=4,
        )
        self.apart = [MujocoCost(self.module, [Distance("object", other)]) for other in ("goal", "tips_arm")]
        any_cost = self.apart[0].at(torch.zeros(self.module.n_x, dtype=torch.float64))
        backend = BatchedBackend(restarts=1, threads=1)
        self.press, horizon = press, STEPS if press else horizon
        self.mpc = LCSMPCLayer(self.module, any_cost, horizon, -2.0, 2.0, backend, 1e-4, "mask")
        self.model, self.data, self.ways = model, mujoco.MjData(model), ForkWays(model, self.module)
        self.object, self.others = model.body("object").id, [model.body(name).id for name in ("goal", "tips_arm")]

    def reset(self, x: np.ndarray) -> None:
        """Begin an episode: take the best of many ways by geometry, and improve it."""
        self.left, self.trust = STEPS, 3.0
        self.plan = self.pressed(x) if self.press else self.best(x, self.ways.plans(x, self.mpc.horizon))
        for _ in range(8):
            self.improve(x)

    def best(self, x: np.ndarray, drives: Iterable[Drive]) -> np.ndarray:
        """The torques (H, 7) of which the return in MuJoCo is best."""
        return max((self.simulate(x, drive) for drive in drives), key=lambda played: played.value).plan

    def pressed(self, x: np.ndarray) -> np.ndarray:
        """The torques (H, 7) of a way that presses: the two best by geometry are varied, and the better one counts."""
        random, start = np.random.RandomState(0), x[:JOINTS]

        def play(way: Way) -> Played:
            return self.simulate(x, self.ways.follow(way.at(start, self.mpc.horizon)))

        ways = [(play(way), way) for way in self.ways.presses(x)]
        results = []
        for best, way in sorted(ways, key=lambda tried: -tried[0].value)[:2]:
            spread, last = 0.15, np.zeros(way.angles.size + 3)
            for k in range(TRIES // 2):  # all of it, or three tenths; and on in the direction that was good
                change = (
                    spread * random.randn(last.size) * (random.rand(last.size) < (0.3 if k % 2 else 1.0)) + 0.7 * last
                )
                new = way.vary(change, self.ways.low, self.ways.high)
                played = play(new)
                if better := played.value > best.value:
                    best, way = played, new
                spread, last = max(spread * (1.4 if better else 0.93), 0.005), change * better
            results.append(best)
        return max(results, key=lambda played: played.value).plan

    def act(self, x: np.ndarray) -> np.ndarray:
        """The torques (7,) at a state x, by one more pass unless the plan is for the whole episode."""
        if not self.press:
            self.improve(x)
        action, self.left = self.plan[0], self.left - 1
        self.plan = np.vstack([self.plan[1:], np.zeros((1, JOINTS))])
        return action

    def simulate(self, x: np.ndarray, drive: Drive) -> Played:
        """Play torques in MuJoCo."""
        data, states, apart, plan = self.data, [x], [], []
        data.qpos[:], data.qvel[:] = np.split(x, 2)
        for k in range(self.mpc.horizon):
            data.ctrl[:] = drive(k, data)
            plan.append(data.ctrl.copy())
            mujoco.mj_step(self.model, data, SUBSTEPS)
            mujoco.mj_kinematics(self.model, data)
            states.append(np.concatenate([data.qpos, data.qvel]))
            apart.append(np.linalg.norm(data.xpos[self.object] - data.xpos[self.others], axis=1))
        plan, apart = np.array(plan), np.array(apart)
        lengths, after = apart @ [1.0, 0.5], max(self.left - len(plan), 3)  # steps for which the last state stays
        value = -lengths.sum() - after * lengths[-1] - 0.1 * (plan**2).sum()
        return Played(plan, np.array(states), apart, float(value))

    def improve(self, x: np.ndarray) -> None:
        """Make a pass: solve near the plan, and go as far towards the solution as the return in MuJoCo grows."""
        _, states, apart, value = self.simulate(x, lambda k, _: self.plan[k])
        at, actions = torch.from_numpy(states), torch.from_numpy(self.plan)
        system = self.module.params(at[:-1], actions)
        error = at[1:] - system.step(at[:-1], actions).x_next
        system = LCSSequence(**{**system.tensors(), "d": system.d + error})
        guess = Primal(at, actions, at.new_zeros(len(actions), system.n_lam), at.new_zeros(len(at), 0))
        plan = self.mpc(at[0], lcs=system, cost=self.cost(at, apart), guess=guess).u.numpy()
        for part in (1.0, 0.3, 0.1):
            new = self.plan + part * (plan - self.plan)
            if self.simulate(x, lambda k, _, new=new: new[k]).value > value:
                self.plan, self.trust = new, float(np.clip(self.trust * (0.6 if part == 1.0 else 1.5), 0.3, 300.0))
                return
        self.trust = min(3.0 * self.trust, 300.0)

    def cost(self, at: Tensor, apart: np.ndarray) -> CostSequence:
        """The return near states (H + 1, n_x): w |r| becomes w r²/2|r|; leaving the states costs `trust`."""
        weights = torch.from_numpy([0.5, 0.25] / np.vstack([apart[:1], apart]))
        weights[-1] *= 1 + max(self.left - len(apart), 3)
        costs = [cost.at(at) for cost in self.apart]
        Q = sum(w[:, None, None] * cost.Q for w, cost in zip(weights.T, costs, strict=True))
        q = sum(w[:, None] * cost.q for w, cost in zip(weights.T, costs, strict=True))
        stay = torch.zeros(at.shape[1], dtype=at.dtype)
        stay[: JOINTS + 2] = 2 * self.trust
        Q, q = Q + torch.diag(stay), q - stay * at
        R = 0.2 * torch.eye(JOINTS, dtype=at.dtype)
        return CostSequence(Q[:-1], R, Q[-1], q[:-1], q_final=q[-1], by_stage=("Q", "q"))


def main(o: Options) -> None:
    """Play the episodes, and print the return of each and their mean."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)  # torsional friction is left out, and torques that limits stop
    env = gymnasium.make("Pusher-v5")
    model, data = env.unwrapped.model, env.unwrapped.data  # pyright: ignore[reportAttributeAccessIssue]
    if not o.soft:
        harden(model)
    policy, returns, finals, seconds, before = PusherPolicy(model, press=o.soft), [], [], [], []
    for seed in range(o.seed, o.seed + o.episodes):
        env.reset(seed=seed)
        started = time.process_time()
        if not o.still:
            policy.reset(np.r_[data.qpos, data.qvel])
        before.append(time.process_time() - started)
        total, started = 0.0, time.process_time()
        for _ in range(STEPS):
            action = np.zeros(JOINTS) if o.still else policy.act(np.r_[data.qpos, data.qvel])
            total += float(env.step(action.astype(np.float32))[1])
        seconds.append((time.process_time() - started) / STEPS)
        finals.append(float(np.linalg.norm(data.body("object").xpos - data.body("goal").xpos)))
        returns.append(total)
        print(f"seed {seed}: return {total:.1f}, {100 * finals[-1]:.1f} cm from the goal at the end", flush=True)
    mean, n = float(np.mean(returns)), len(returns)
    error = 1.96 * float(np.std(returns, ddof=1)) / n**0.5 if n > 1 else np.inf
    times = f"{np.mean(before):.1f} s before an episode, {1e3 * np.mean(seconds):.0f} ms a step"
    print(f"mean return {mean:.1f} [{mean - error:.1f}, {mean + error:.1f}]; {times}")
    if o.json:
        figures = {"return": mean, "ci_low": mean - error, "ci_high": mean + error, "episodes": o.episodes}
        times = {"milliseconds_per_step": 1e3 * float(np.mean(seconds)), "seconds_before": float(np.mean(before))}
        print(json.dumps({**figures, **times, "final_m": float(np.median(finals)), "soft": o.soft, "seed": o.seed}))


if __name__ == "__main__":
    main(tyro.cli(Options))
