"""Closed loops in MuJoCo, ours beside planners made for contact: `python benchmarks/race_loops.py`. See docs/race.md.

Every planner is a backend of the same layer, so it gets the same system at each decision, the same cost, horizon and
bounds. Sampling in MuJoCo itself has a second simulation. `--tune 12` draws settings on seeds from 3000; the figures
are of seeds from 5000.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

import json
import math
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
import tyro
from race_hard import MODULES, Draw, draws, sampled
from race_hard import TUNED as TUNED_PLANS
from race_problems import hard_cost
from rivals.problem import INPUTS, Problem
from rivals.run import cpu
from rivals.sampling import Solver as Sampling
from torch import Tensor

import difflcs_envs
from difflcs import LCSModel, LCSMPCLayer
from difflcs.cli.bench import machine, save
from difflcs.errors import ContactWarning
from difflcs.mpc.backends import Backend, BatchedBackend
from difflcs.mpc.backends.base import Result
from difflcs.mpc.problem import MPCProblem
from difflcs.mpc.solution import Primal
from difflcs.rl import wilson_interval
from difflcs.systems import pushing_cost
from difflcs_envs.hand.model import build_model
from difflcs_envs.tasks import HORIZON, hand_cost, hand_system
from difflcs_envs.trifinger.task import ACTION_LIMIT

sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))
import box_to_pose  # pyright: ignore[reportMissingImports]

TUNED = Path(__file__).parent / "rivals" / "tuned_loops.json"
OURS = {"difflcs": {}, 'difflcs `"fast"`': {"effort": "fast"}}
SEED, TUNING_SEED = 5000, 3000
COARSE = 0.005  # [s] steps of the second simulation of the hand
ROLLOUTS = {"cube": (256, 32), "box": (64, 0), "hand": (64, 20)}  # on the LCS, and in MuJoCo
SLOW = "IMPACT-like", "C3, 10 iterations"  # 10 s a decision with the hand
LEFT_OUT = {"cube": (), "box": SLOW, "hand": (*SLOW, "C3, 10 iterations, exact")}  # of 3^56 supports


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


class Planner(Backend):
    """A planner as a backend, which counts its CPU time.

    Args:
        module: "ours", "simulated" (sampling in MuJoCo), or a file in `rivals/`.
        settings: of its `Solver`, or of `BatchedBackend`.
        imagine: simulates actions (H, n_u) from where the robot is, returns the states (H+1, n_x).

    Attributes:
        seconds: CPU time [s] of what it prepares for each new system, and of planning.
        met: problems that ours was given, and its actions.
    """

    name = "race"

    def __init__(self, module: str, settings: dict[str, Any], imagine: Callable[[np.ndarray], np.ndarray]):
        self.module, self.settings, self.imagine = module, settings, imagine
        self.ours = BatchedBackend(threads=1, **settings) if module == "ours" else None
        self.solver: Any = None
        self.met: list[tuple[MPCProblem, Tensor]] = []
        self.random, self.seconds = np.random.default_rng(0), np.zeros(2)

    def solve(self, problem: MPCProblem, guess: Primal | None) -> Result:
        """Plan for each problem; the states of a rival's plan are those that its actions cause."""
        if self.ours is not None:
            seconds, result = cpu(self.ours.solve, problem, guess)
            self.seconds[1] += seconds
            self.met.append((problem, result.primal.u))
            return result
        self.prepare(problem)
        if isinstance(self.solver, Sampling):
            self.solver.random, self.solver.guess = self.random, None if guess is None else guess.u.numpy()
        seconds, u = cpu(lambda: np.concatenate([self.solver.one(i).u for i in range(problem.batch)]))
        self.seconds[1] += seconds
        u = problem.clip(torch.from_numpy(np.nan_to_num(u)))
        x, lam = problem.rollout(u)
        zero = torch.zeros(problem.batch)
        return Result(Primal(x, u, lam, problem.no_multipliers()), zero.to(torch.int8), zero.int(), zero, zero)

    def prepare(self, problem: MPCProblem) -> None:
        """Make the solver, or keep the last one if only the state is new."""
        arrays = {name: getattr(problem, name).numpy().copy() for name in INPUTS}
        x0, last = arrays.pop("x0"), None if self.solver is None else self.solver.problem
        if last is not None and all(np.array_equal(value, getattr(last, name)) for name, value in arrays.items()):
            last.x0 = x0
            return
        kind: Any = Simulated if self.module == "simulated" else MODULES[self.module].Solver
        none = {"constant": np.zeros(problem.batch), "weight": np.zeros(problem.n_u)}
        given = Problem(**arrays, **none, x0=x0, horizon=problem.horizon, relaxation=problem.relaxation)
        seconds, self.solver = cpu(lambda: kind(given, **self.settings))
        self.seconds[0] += seconds
        self.solver.imagine = self.imagine


class Simulated(Sampling):
    """Sampling whose rollouts are those of MuJoCo."""

    imagine: Callable[[np.ndarray], np.ndarray]

    def states(self, data: dict[str, np.ndarray], u: np.ndarray) -> np.ndarray:
        """Simulate action sequences one after another."""
        return np.stack([self.imagine(actions) for actions in u])


# --- tasks ------------------------------------------------------------------------------------------------------------


class Loop:
    """A task as a Gymnasium environment, the layer that plans for it, and a second simulation.

    Attributes:
        limit: decisions of an episode.
        hold: decisions in a row at the goal after which it has succeeded; 0: it must be there at the end.
    """

    limit: int
    hold: int
    layer: LCSMPCLayer
    env: Any

    def begin(self, seed: int) -> None:
        """Begin an episode."""
        self.guess: Primal | None = None
        self.seen, self.info = self.env.reset(seed=seed)

    def look(self) -> tuple[Tensor, Tensor]:
        """Return state and goal."""
        return torch.from_numpy(self.seen["state"]), torch.from_numpy(self.seen["goal"])

    def plan(self) -> np.ndarray:
        """Return the next action, warm from the last plan."""
        plan = self.layer(*self.look(), guess=self.guess)
        self.guess = plan.shift() if bool(plan.converged) else None
        return plan.action.numpy()

    def move(self, u: np.ndarray) -> None:
        """Execute an action."""
        self.seen, _, _, _, self.info = self.env.step(u)

    def error(self) -> float:
        """Return the distance to the goal, 1 where it begins to count as reached; inf: the object is lost."""
        raise NotImplementedError

    def imagine(self, u: np.ndarray) -> np.ndarray:
        """Simulate actions (H, n_u) from where the robot is: states (H+1, n_x)."""
        raise NotImplementedError

    def play(self, seed: int, limit: int) -> tuple[bool, float, int, float]:
        """Play an episode: success, cost, decisions, and their CPU time [s].

        The cost is the mean distance to the goal over all decisions of the limit, 0 after a success, in parts of the
        first distance, at most 2 of them.
        """
        self.begin(seed)
        first, errors, held, used = max(self.error(), 1.0), [], 0, 0.0
        while len(errors) < limit and not (self.hold and held == self.hold):
            seconds, u = cpu(self.plan)
            used += seconds
            self.move(u)
            errors.append(self.error())
            held = held + 1 if errors[-1] < 1 else 0
            if math.isinf(errors[-1]):
                break
        success, parts = held >= max(self.hold, 1), np.minimum(np.array(errors) / first, 2.0)
        rest = 0.0 if success else parts[-1] * (limit - len(parts))
        return success, float(parts.sum() + rest) / limit, len(parts), used


class Cube(Loop):
    """Three fingers push a cube, planned with the learned LCS of the zoo, which stays the same."""

    limit, hold = 20, 0

    def __init__(self) -> None:
        self.env = gymnasium.make("difflcs/TriFingerMoveCube-v0").unwrapped
        self.twin, lcs = self.env.sibling().physics, LCSModel.from_pretrained("zoo:trifinger-cube")
        limit = ACTION_LIMIT
        self.layer = LCSMPCLayer(lcs, pushing_cost(), HORIZON, -limit, limit, relaxation=1e-5, on_failure="mask")

    def error(self) -> float:
        """See `Loop`."""
        task = self.env.task
        return max(self.info["position_error"] / task.position_tolerance, self.info["yaw_error"] / task.yaw_tolerance)

    def imagine(self, u: np.ndarray) -> np.ndarray:
        """See `Loop`; where it becomes unstable it stays."""
        self.twin.set_full_state(self.env.physics.get_full_state())
        x = [self.seen["state"]]
        for action in u:
            after = self.twin.step(action)
            x.append(x[-1] if after is None else after)
        return np.array(x)


class Box(Loop):
    """A sphere pushes a box to poses, planned from the places of examples/box_to_pose.py."""

    limit, hold = box_to_pose.STEPS, 1

    def __init__(self) -> None:
        self.policy, module = box_to_pose.make_policy()
        self.layer, self.scene = self.policy.mpc, box_to_pose.Scene(module)

    def begin(self, seed: int) -> None:
        """See `Loop`."""
        self.policy.reset()
        self.scene.start(seed)

    def plan(self) -> np.ndarray:
        """See `Loop`."""
        x, (*place, yaw) = self.scene.state, self.scene.goal
        return self.policy.act(x, [*place, x[2] + box_to_pose.wrapped(yaw - x[2])])

    def move(self, u: np.ndarray) -> None:
        """See `Loop`."""
        self.scene.step(u)

    def error(self) -> float:
        """See `Loop`."""
        return self.scene.error()


class Hand(Loop):
    """A hand of four fingers turns a cube by a quarter, planned with its MuJoCo model at each state."""

    limit, hold, pace = 100, 21, 0.5

    def __init__(self) -> None:
        self.env = gymnasium.make("difflcs/HandTurnObject-v0", horizon=self.limit).unwrapped
        self.module, self.coarse, high = hand_system(build_model("cube")), build_model("cube"), 0.1 * self.pace
        self.coarse.opt.timestep, self.twin = COARSE, mujoco.MjData(self.coarse)
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
        mujoco.mj_copyState(self.coarse, self.env.data, self.twin, mujoco.mjtState.mjSTATE_INTEGRATION)
        qpos = [self.twin.qpos.copy()]
        for action in u:
            self.twin.ctrl[:] = self.twin.qpos[:16] + action
            mujoco.mj_step(self.coarse, self.twin, round(0.1 / COARSE))
            qpos.append(self.twin.qpos.copy())
        return self.module.state.to_state(np.array(qpos)).numpy()


TASKS: dict[str, Callable[[], Loop]] = {"cube": Cube, "box": Box, "hand": Hand}


# --- the race ---------------------------------------------------------------------------------------------------------


def rivals(task: str) -> dict[str, tuple[str, Draw]]:
    """List the rivals of a task: module, and how random settings are drawn."""
    lcs, simulated = ROLLOUTS[task]
    draw, out = partial(sampled, methods=("cem", "mppi")), ("C3+, 100 iterations", *LEFT_OUT[task])
    found = {label: row for label, row in draws().items() if row[0] != "sampling" and label not in out}
    found[f"sampling on the LCS, {lcs} rollouts"] = ("sampling", partial(draw, rollouts=lcs))
    if simulated:
        found[f"sampling in MuJoCo, {simulated} rollouts"] = ("simulated", partial(draw, rollouts=simulated))
    return found


@torch.no_grad()
def play(
    loop: Loop, module: str, settings: dict[str, Any], seeds: range, seconds: float, limit: int | None = None
) -> dict[str, list[float]]:
    """Play an episode of at most `limit` decisions for each seed, at least one, until the CPU time is used up.

    Returns:
        Success, cost, decisions, and milliseconds of CPU of a decision: all, what a rival prepares for each new system,
        and the solver.
    """
    loop.layer.backend = planner = Planner(module, settings, loop.imagine)
    rows, until = [], time.process_time() + seconds
    for seed in seeds:
        if time.process_time() > until and rows:
            break
        planner.seconds[:], planner.solver = 0, None
        success, cost, decisions, used = loop.play(seed, limit or loop.limit)
        rows.append([float(success), cost, decisions, *(1e3 * v / decisions for v in (used, *planner.seconds))])
    names = "success", "cost", "decisions", "all_ms", "prepare_ms", "solve_ms"
    return {name: [float(v) for v in column] for name, column in zip(names, zip(*rows, strict=True), strict=True)}


@torch.no_grad()
def tune(loop: Loop, label: str, module: str, draw: Draw, seconds: float) -> dict[str, Any]:
    """Try settings for some CPU seconds, those of single plans, then random ones; the best three play for as long.

    They are compared by the costs of their plans under hard contact for problems that ours meets in three episodes, in
    parts of what doing nothing costs more than ours; with the cube, and in MuJoCo, by 20 decisions of these episodes.
    """
    first, others = range(TUNING_SEED, TUNING_SEED + 3), range(TUNING_SEED + 3, TUNING_SEED + 23)
    play(loop, "ours", {}, first, math.inf, 20)
    met = [(problem.select(torch.arange(0, len(u), 16)), u[::16]) for problem, u in loop.layer.backend.met[::6]]
    ours, idle = (torch.cat([hard_cost(problem, part * u) for problem, u in met]) for part in (1, 0))
    gain = (idle - ours).clamp_min(0.1 * float((idle - ours).mean()))

    def score(settings: dict[str, Any]) -> float:
        if module == "simulated" or isinstance(loop, Cube):
            return float(np.mean(play(loop, module, settings, first, math.inf, 20)["cost"]))
        plans = [Planner(module, settings, loop.imagine).solve(problem, None).primal.u for problem, _ in met]
        costs = torch.cat([hard_cost(problem, u) for (problem, _), u in zip(met, plans, strict=True)])
        return float(((costs - ours) / gain).nan_to_num(3.0).clamp(-1.0, 3.0).mean())

    random, until, tried = np.random.default_rng(0), time.process_time() + seconds, []
    known = [family[label]["settings"] for family in json.loads(TUNED_PLANS.read_text()).values() if label in family]
    while time.process_time() < until or len(tried) < 3:
        settings = known.pop() if known else draw(random)
        if "growth" in settings and not isinstance(loop, Cube):
            settings["growth"] = 1.0  # else there is a factor for each iteration of each new system
        tried.append((score(settings), settings))
    tried.sort(key=lambda pair: pair[0])
    half = max(20, loop.limit // 2)
    again = [(np.mean(play(loop, module, each, others, seconds / 3, half)["cost"]), each) for _, each in tried[:3]]
    cost, settings = min(again, key=lambda pair: pair[0])
    print(f"{label:36s} {len(tried)} drawn, cost {cost:.3f}: {settings}", flush=True)
    return {"module": module, "settings": settings}


def main(o: Options) -> None:
    """Tune, or play; what is in the files stays if it is not made anew."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ContactWarning)
    difflcs_envs.register_envs()
    tuned = json.loads(TUNED.read_text()) if TUNED.exists() else {}
    results = json.loads(o.out.read_text())["results"] if o.out.exists() else {}
    for task in o.tasks:
        loop, rows = TASKS[task](), {label: {"module": "ours", "settings": each} for label, each in OURS.items()}
        for label, (module, draw) in rivals(task).items() if o.tune else ():
            if not o.only or label in o.only:
                tuned.setdefault(task, {})[label] = tune(loop, label, module, draw, o.tune)
                TUNED.write_text(json.dumps(tuned, indent=1) + "\n")
        for label, row in (rows | tuned[task]).items() if not o.tune else ():
            if not o.only or label in o.only:
                found = play(loop, seeds=range(SEED, SEED + o.episodes), seconds=o.seconds, **row)
                n, won = len(found["success"]), round(sum(found["success"]))
                figures = {"episodes": n, "interval": wilson_interval(won, n)}
                figures["cost_half"] = 1.96 * float(np.std(found["cost"], ddof=1)) / math.sqrt(n)
                figures |= {name: float(np.mean(values)) for name, values in found.items()}
                results.setdefault(task, {})[label] = figures
                print(f"{task:6s} {label:36s} {figures}", flush=True)
                save(o.out, {"machine": {**machine(), "mujoco": mujoco.__version__}, "results": results})


if __name__ == "__main__":
    main(tyro.cli(Options))
