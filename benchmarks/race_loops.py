"""Closed loops in MuJoCo, ours beside planners made for contact: `python benchmarks/race_loops.py`. See docs/race.md.

Every planner is a backend of the same layer: it gets the same system at each decision, the same cost, horizon and
bounds. Some sample in MuJoCo itself, whose second copy they are given. `--tune 60` draws the rivals' settings on seeds
below 4000; final figures are of seeds 5000 and up.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import json
import math
import sys
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from race_hard import MODULES, Draw, draws, sampled
from race_hard import TUNED as RACE_TUNED
from rivals import sampling
from rivals.problem import Problem
from rivals.run import cpu
from torch import Tensor

import difflcs_envs
from difflcs import GoalCost, LCSModel, LCSMPCLayer
from difflcs.cli.bench import machine, save
from difflcs.errors import ContactWarning
from difflcs.mpc.backends import Backend, BatchedBackend
from difflcs.mpc.backends.base import Result
from difflcs.mpc.problem import MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.rl import wilson_interval
from difflcs_envs.hand.model import build_model
from difflcs_envs.tasks import HORIZON, hand_cost, hand_system, pushing_cost
from difflcs_envs.trifinger.task import ACTION_LIMIT

sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))
import box_to_pose  # pyright: ignore[reportMissingImports]

TUNED = Path(__file__).parent / "rivals" / "tuned_loops.json"
OURS = {"difflcs": {}, 'difflcs `"fast"`': {"effort": "fast"}}
SEED, TUNING_SEED = 5000, 3000
COARSE = 0.005  # [s] steps of the second simulation of hand and box, in which rollouts are tried
ROLLOUTS = {"cube": (256, 4, 32), "box": (64, 4, 20), "hand": (64, 4, 20)}  # on the LCS, and twice in MuJoCo
LEFT_OUT = {"hand": ("IMPACT-like", "C3, 10 iterations, exact")}  # 10 s a decision, and 3^56 supports


@dataclass
class Options:
    """Closed loops in MuJoCo."""

    tasks: tuple[str, ...] = ("cube", "box", "hand")
    """Tasks to play; the others stay as they are in the file."""
    episodes: int = 100
    """Episodes of each planner, at most."""
    seconds: float = 150.0
    """CPU seconds of a planner on a task, after which no further episode begins."""
    only: tuple[str, ...] = ()
    """Labels of the planners that play; all if none is named."""
    tune: float = 0.0
    """CPU seconds in which settings of each planner are drawn for each task, on other seeds; then it ends."""
    out: Path = Path("benchmarks/results/race_loops.json")
    """Path of the JSON output."""


# --- planners ---------------------------------------------------------------------------------------------------------


def as_rival(problem: MPCProblem) -> Problem:
    """Convert a problem whose system and cost are the same at every stage."""
    names = [f.name for f in fields(Problem) if f.name not in ("horizon", "relaxation", "constant", "weight")]
    arrays = {name: getattr(problem, name).numpy().copy() for name in names}
    none = {"constant": np.zeros(problem.batch), "weight": np.zeros(problem.n_u)}
    return Problem(**arrays, horizon=problem.horizon, relaxation=problem.relaxation, **none)


class Planner(Backend):
    """A planner as a backend, which counts its CPU time.

    Args:
        module: "ours", "simulated" (sampling in MuJoCo), or a file in `rivals/`.
        settings: of its `Solver`, or of `BatchedBackend`.

    Attributes:
        seconds: CPU time [s] of what it prepares for each new system, and of planning.
        imagine: simulates actions (H, n_u) from where the robot is, returns the states (H+1, n_x).
    """

    name = "race"

    def __init__(self, module: str, settings: dict[str, Any]):
        self.module, self.settings, self.seconds = module, settings, np.zeros(2)
        self.ours = BatchedBackend(threads=1, **settings) if module == "ours" else None
        self.random, self.imagine = np.random.default_rng(0), lambda u: u
        self.last: Any = None

    def solve(self, problem: MPCProblem, guess: Primal | None) -> Result:
        """Plan for each problem; of a rival the states are those that its actions cause."""
        if self.ours is not None:
            seconds, result = cpu(lambda: self.ours.solve(problem, guess))  # pyright: ignore[reportOptionalMemberAccess]
            self.seconds[1] += seconds
            return result
        solver = self.prepared(as_rival(problem))
        if isinstance(solver, sampling.Solver):
            solver.random, solver.guess = self.random, None if guess is None else guess.u.numpy()
        seconds, u = cpu(lambda: np.concatenate([solver.one(i).u for i in range(problem.batch)]))
        self.seconds[1] += seconds
        u = problem.clip(torch.from_numpy(np.nan_to_num(u)))
        x, lam = problem.rollout(u)
        zero = torch.zeros(problem.batch)
        return Result(Primal(x, u, lam, problem.no_multipliers()), zero.to(torch.int8), zero.int(), zero, zero)

    def prepared(self, problem: Problem) -> Any:
        """Make the solver, or take the last one where nothing but the state is new."""
        if self.last is not None and all(
            np.array_equal(getattr(problem, f.name), getattr(self.last.problem, f.name))
            for f in fields(Problem)
            if f.name != "x0"
        ):
            self.last.problem.x0[:] = problem.x0
            return self.last
        kind: Any = Simulated if self.module == "simulated" else MODULES[self.module].Solver
        seconds, self.last = cpu(lambda: kind(problem, **self.settings))
        self.seconds[0] += seconds
        self.last.imagine = self.imagine
        return self.last


class Simulated(sampling.Solver):
    """Sampling whose rollouts are those of MuJoCo."""

    imagine: Callable[[np.ndarray], np.ndarray]

    def states(self, data: dict[str, np.ndarray], u: np.ndarray) -> np.ndarray:
        """Simulate action sequences one after another."""
        return np.stack([self.imagine(actions) for actions in u])


# --- tasks ------------------------------------------------------------------------------------------------------------


class Loop(ABC):
    """A task, the layer that plans for it, and a second simulation for rollouts.

    Attributes:
        limit: decisions of an episode.
        hold: decisions in a row at the goal after which it has succeeded; 0: whether it is there at the end counts.
    """

    limit: int
    hold: int
    layer: LCSMPCLayer
    guess: Primal | None = None
    env: Any
    planner: Planner

    def take(self, planner: Planner) -> None:
        """Plan with this one from now on."""
        self.planner = self.layer.backend = planner
        planner.imagine = self.imagine

    def begin(self, seed: int) -> None:
        """Begin an episode."""
        self.seen, self.info = self.env.reset(seed=seed)

    def look(self) -> tuple[Tensor, Tensor]:
        """Return state and goal."""
        return torch.from_numpy(self.seen["state"]), torch.from_numpy(self.seen["goal"])

    def move(self, u: np.ndarray) -> None:
        """Execute an action."""
        self.seen, _, _, _, self.info = self.env.step(u)

    @abstractmethod
    def error(self) -> float:
        """Return the distance to the goal, 1 where it begins to count as reached; inf: the object is lost."""

    @abstractmethod
    def imagine(self, u: np.ndarray) -> np.ndarray:
        """Simulate actions (H, n_u) from where the robot is: states (H+1, n_x)."""

    def plan(self) -> np.ndarray:
        """Return the next action, warm from the last plan."""
        plan = self.layer(*self.look(), guess=self.guess)
        self.guess = plan.shift() if bool(plan.converged) else None
        return plan.action.numpy()

    def play(self, seed: int, limit: int) -> tuple[bool, float, int, float]:
        """Play an episode: success, cost, decisions, and their CPU time [s].

        The cost is the mean distance to the goal over all decisions of the limit, 0 after a success, in parts of the
        first distance, at most 2 of them.
        """
        self.guess, self.planner.last, errors, held, used = None, None, [], 0, 0.0
        self.begin(seed)
        first = max(self.error(), 1.0)
        while len(errors) < limit and not (self.hold and held == self.hold):
            seconds, u = cpu(self.plan)
            used += seconds
            self.move(u)
            errors.append(self.error())
            held = held + 1 if errors[-1] < 1 else 0
            if math.isinf(errors[-1]):
                break
        success = held >= max(self.hold, 1)
        parts = np.minimum(np.array(errors) / first, 2.0)
        rest = 0.0 if success else parts[-1]
        return success, float(parts.sum() + rest * (limit - len(parts))) / limit, len(parts), used


class Cube(Loop):
    """Three fingers push a cube, planned with the learned LCS of the zoo, which stays the same."""

    limit, hold = 20, 0

    def __init__(self) -> None:
        self.env: Any = gymnasium.make("difflcs/TriFingerMoveCube-v0").unwrapped
        self.twin, lcs = self.env.sibling().physics, LCSModel.from_pretrained("zoo:trifinger-cube")
        self.layer = LCSMPCLayer(lcs, pushing_cost(), HORIZON, -ACTION_LIMIT, ACTION_LIMIT, on_failure="mask")

    def error(self) -> float:
        """See `Loop`."""
        task = self.env.task
        return max(self.info["position_error"] / task.position_tolerance, self.info["yaw_error"] / task.yaw_tolerance)

    def imagine(self, u: np.ndarray) -> np.ndarray:
        """See `Loop`."""
        self.twin.set_full_state(self.env.physics.get_full_state())
        x = [self.seen["state"]]
        for action in u:
            after = self.twin.step(action)
            x.append(x[-1] if after is None else after)
        return np.array(x)


class Box(Loop):
    """A sphere pushes a box to poses, as in examples/box_to_pose.py, with the same places for every planner.

    Who samples in MuJoCo has no places: the sphere is drawn to the box by its cost.
    """

    limit, hold, near = box_to_pose.STEPS, 1, 1.0

    def __init__(self) -> None:
        self.policy, self.module = box_to_pose.make_policy()
        self.layer, self.direct = self.policy.mpc, False
        weights = {"goal_weight": box_to_pose.WEIGHT, "goal_weight_final": box_to_pose.FINAL}
        weights |= {"input_weight": box_to_pose.EFFORT, "pair_weight": self.near, "pair_weight_final": self.near}
        self.costs = self.layer.cost, GoalCost.reach(5, 2, pairs=[(3, 0), (4, 1)], **weights)
        self.model = mujoco.MjModel.from_xml_string(box_to_pose.WORLD.format(joints="<freejoint/>"))
        self.coarse = mujoco.MjModel.from_xml_string(box_to_pose.WORLD.format(joints="<freejoint/>"))
        self.coarse.opt.timestep = COARSE
        self.data, self.tried = mujoco.MjData(self.model), mujoco.MjData(self.coarse)

    def take(self, planner: Planner) -> None:
        """See `Loop`."""
        super().take(planner)
        self.direct = planner.module == "simulated"
        self.layer.cost = self.costs[self.direct]

    def begin(self, seed: int) -> None:
        """See `Loop`."""
        mujoco.mj_resetData(self.model, self.data)
        random = np.random.default_rng(seed)
        x, y, yaw = random.uniform(-1, 1, 3) * [0.1, 0.1, math.pi]
        self.goal = random.uniform(-1, 1, 3) * [0.2, 0.2, math.pi]
        towards = (self.goal[:2] - [x, y]) / np.linalg.norm(self.goal[:2] - [x, y])
        turn = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)
        self.data.qpos[:] = [x, y, 0.05, *turn, *([x, y] + 0.12 * towards)]
        self.policy.reset()

    @staticmethod
    def state(data: Any) -> np.ndarray:
        """Read the state in the plane."""
        q = data.qpos
        return np.array([q[0], q[1], 2 * math.atan2(q[6], q[3]), q[7], q[8]])

    def look(self) -> tuple[Tensor, Tensor]:
        """See `Loop`; the goal's angle is the one nearest to the box's."""
        x = self.state(self.data)
        goal = [*self.goal[:2], x[2] + box_to_pose.wrapped(self.goal[2] - x[2])]
        return torch.from_numpy(x), torch.tensor(goal, dtype=torch.float64)

    def plan(self) -> np.ndarray:
        """Plan with places, or directly."""
        return super().plan() if self.direct else self.policy.act(*self.look())

    def move(self, u: np.ndarray) -> None:
        """See `Loop`."""
        self.simulate(self.model, self.data, u)

    def simulate(self, model: Any, data: Any, u: np.ndarray) -> None:
        """Execute an action, in steps of this model."""
        data.ctrl[:] = self.module.control(torch.from_numpy(self.state(data)), torch.from_numpy(u)).numpy()
        mujoco.mj_step(model, data, round(0.1 / model.opt.timestep))

    def error(self) -> float:
        """See `Loop`."""
        left = self.state(self.data)[:3] - self.goal
        apart, turned = math.hypot(left[0], left[1]), abs(box_to_pose.wrapped(left[2]))
        return max(apart / box_to_pose.NEAR, turned / box_to_pose.ALIGNED)

    def imagine(self, u: np.ndarray) -> np.ndarray:
        """See `Loop`."""
        mujoco.mj_copyState(self.model, self.data, self.tried, mujoco.mjtState.mjSTATE_INTEGRATION)
        x = [self.state(self.tried)]
        for action in u:
            self.simulate(self.coarse, self.tried, action)
            x.append(self.state(self.tried))
        x = np.array(x)
        x[:, 2] = np.unwrap(x[:, 2])
        return x


class Hand(Loop):
    """A hand of four fingers turns a cube by a quarter, planned with its MuJoCo model at each state."""

    limit, hold, pace = 100, 21, 0.5

    def __init__(self) -> None:
        self.env: Any = gymnasium.make("difflcs/HandTurnObject-v0", horizon=self.limit).unwrapped
        self.coarse, model = build_model("cube"), build_model("cube")
        self.coarse.opt.timestep, self.tried = COARSE, mujoco.MjData(self.coarse)
        self.module, high = hand_system(model), 0.1 * self.pace
        cost = hand_cost(self.module)
        self.layer = LCSMPCLayer(self.module, cost, 4, -high, high, relaxation=1e-3, on_failure="mask")

    def look(self) -> tuple[Tensor, Tensor]:
        """See `Loop`; rotations count from here."""
        return self.module.observe(self.env.data), torch.from_numpy(self.seen["goal"])

    def error(self) -> float:
        """See `Loop`."""
        lost = self.info["dropped"] or self.info.get("physics_error", False)
        return math.inf if lost else self.info["angle_error"] / 0.4

    def imagine(self, u: np.ndarray) -> np.ndarray:
        """See `Loop`."""
        mujoco.mj_copyState(self.env.model, self.env.data, self.tried, mujoco.mjtState.mjSTATE_INTEGRATION)
        x = [self.module.state.to_state(self.tried.qpos, self.tried.qvel).numpy()]
        for action in u:
            self.tried.ctrl[:] = self.tried.qpos[:16] + action
            mujoco.mj_step(self.coarse, self.tried, round(0.1 / COARSE))
            x.append(self.module.state.to_state(self.tried.qpos, self.tried.qvel).numpy())
        return np.array(x)


# --- the race ---------------------------------------------------------------------------------------------------------

TASKS: dict[str, Callable[[], Loop]] = {"cube": Cube, "box": Box, "hand": Hand}


def rivals(task: str) -> dict[str, tuple[str, Draw]]:
    """List the rivals of a task: module, and how random settings are drawn."""
    lcs, *simulated = ROLLOUTS[task]
    both = ("cem", "mppi")
    found = {
        k: v for k, v in draws().items() if v[0] != "sampling" and "100" not in k and k not in LEFT_OUT.get(task, ())
    }
    found |= {f"sampling on the LCS, {lcs} rollouts": ("sampling", sampled(both, lcs))}
    return found | {f"sampling in MuJoCo, {n} rollouts": ("simulated", sampled(both, n)) for n in simulated}


@torch.no_grad()
def play(
    loop: Loop, module: str, settings: dict[str, Any], seeds: range, seconds: float = math.inf, part: float = 1.0
) -> dict[str, list[float]]:
    """Play an episode, or a part of its decisions, for each seed, until the CPU time is used up.

    Returns:
        Success, cost, decisions, and milliseconds of CPU of a decision: all, what a rival prepares for each new system,
        and the solver.
    """
    planner, rows, until = Planner(module, settings), [], time.process_time() + seconds
    loop.take(planner)
    for seed in seeds:
        if time.process_time() > until and len(rows) > 1:
            break
        planner.seconds[:] = 0
        success, cost, decisions, used = loop.play(seed, round(part * loop.limit))
        rows.append([float(success), cost, decisions, *(1e3 * v / decisions for v in (used, *planner.seconds))])
    names = "success", "cost", "decisions", "all_ms", "prepare_ms", "solve_ms"
    return {name: [float(v) for v in column] for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def tune(loop: Loop, label: str, module: str, draw: Draw, seconds: float) -> dict[str, Any]:
    """Try the settings of single plans, then random ones: 20 decisions of three episodes; the best four play others."""
    random, until, tried = np.random.default_rng(0), time.process_time() + seconds, []
    known = [family[label]["settings"] for family in json.loads(RACE_TUNED.read_text()).values() if label in family]
    while time.process_time() < until or len(tried) < 3:
        settings = known.pop() if known else draw(random)
        first = play(loop, module, settings, range(TUNING_SEED, TUNING_SEED + 3), part=20 / loop.limit)
        tried.append((np.mean(first["cost"]), settings))
    tried.sort(key=lambda pair: pair[0])
    others = range(TUNING_SEED + 3, TUNING_SEED + 15)
    again = [(np.mean(play(loop, module, each, others, seconds / 4)["cost"]), each) for _, each in tried[:4]]
    cost, settings = min(again, key=lambda pair: pair[0])
    print(f"{label:36s} {len(tried)} drawn, cost {cost:.3f}: {settings}", flush=True)
    return {"module": module, "settings": settings}


def main(o: Options) -> None:
    """Tune, or play; what is in the files stays if it is not made anew."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    difflcs_envs.register_envs()
    tuned = json.loads(TUNED.read_text()) if TUNED.exists() else {}
    record = json.loads(o.out.read_text()) if o.out.exists() else {"results": {}}
    for task in o.tasks:
        loop = TASKS[task]()
        planners: dict[str, Any] = {label: ("ours", settings) for label, settings in OURS.items()}
        for label, (module, draw) in rivals(task).items():
            if o.tune and (not o.only or label in o.only):
                tuned.setdefault(task, {})[label] = tune(loop, label, module, draw, o.tune)
                TUNED.write_text(json.dumps(tuned, indent=1) + "\n")
            planners |= {label: (module, tuned[task][label]["settings"])} if not o.tune else {}
        for label, (module, settings) in planners.items():
            if not o.tune and (not o.only or label in o.only):
                found = play(loop, module, settings, range(SEED, SEED + o.episodes), o.seconds)
                record["results"].setdefault(task, {})[label] = figures(found)
                print(f"{task:6s} {label:36s} {record['results'][task][label]}", flush=True)
                save(o.out, {"machine": {**machine(), "mujoco": mujoco.__version__}, **record})


def figures(found: dict[str, list[float]]) -> dict[str, Any]:
    """Compute means with 95 % intervals: Wilson's of successes, normal of costs."""
    n, won = len(found["success"]), int(sum(found["success"]))
    half = 1.96 * float(np.std(found["cost"], ddof=1)) / math.sqrt(n) if n > 1 else math.inf
    mean = {name: float(np.mean(values)) for name, values in found.items()}
    return {"episodes": n, "interval": wilson_interval(won, n), "cost_half": half, **mean}


if __name__ == "__main__":
    main(tyro.cli(Options))
