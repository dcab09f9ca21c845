"""The learned cube model of the zoo in a simulator that it has never seen: `python trifinger_zero_shot.py --goals 200`.

`trifinger-cube` was learned in this repository's MuJoCo environment. Here it plans, without a change, the paper's task
(bring the cube to a place and a yaw in 20 steps of 0.1 s) in the PyBullet simulator of trifinger-rl-datasets: the goals
and starts of `difflcs evaluate --seed S`, success within 2 cm and 0.2 rad after the last step. An action is how far
each tip is to go in the plane; torques of `trifinger_push.control` lead the tips there, at 50 Hz and 10 ms late.

What differs from where it was learned: the cube is 65 mm wide, not 60, and weighs 94 g, not 10 g; friction on the table
is 1, and 0.5 between tip and cube instead of 0.9; a tip touches at 14.5 mm instead of 9.5 mm; the mounts of the
fingers; and what the cube weighs bends the tips away from their targets, which an estimate of the load gives back in
part. Ways of observing:

- true: the pose of the cube as it is;
- camera: as the simulator's camera gives it, 90 to 190 ms late, brought to the present by `trifinger_push.cube`.

The same model in the MuJoCo environment, on the same goals, stands beside it. With `--out FILE` the record is written
after each goal, so that a run can be cut short.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from successes import success_figures

from difflcs import LCSModel
from difflcs.bench import machine
from difflcs.errors import MissingDependencyError
from difflcs.rl import evaluate, get_task, write_atomically
from difflcs.rl.seeding import Stream, episode_seeds

Array = NDArray[np.float64]

MODEL = "trifinger-cube"
SUBSTEPS = 5
"""Steps of the simulator in one of the task."""
LOAD_GAIN, LOAD_DECAY, LOAD_LIMIT = 250.0, 0.95, 1.2
"""Of the estimate of what a tip pushes against: growth [N/(m s)], what is left of it after a step of the simulator, and
most [N]. The cube takes 0.9 N to move."""
APPROACH = ((0.1, 40), (None, 30))
"""How the tips come down to their start: height [m] (None: that of pushing) and steps there."""


@dataclass
class Options:
    """A model of the zoo in another simulator."""

    goals: int = 200
    """Goals, one episode each."""
    seed: int = 0
    """Of goals and starts, as `difflcs evaluate` counts them."""
    json: bool = False
    """Print one line of JSON and nothing else."""
    out: Path | None = None
    """Record in which to write; nowhere if not given."""


class OtherSimulator:
    """The cube task in PyBullet; the state is that of the task: pose of the cube, x and y of each tip."""

    def __init__(self) -> None:
        try:
            import trifinger_rl_datasets  # noqa: F401
        except ImportError as error:
            raise MissingDependencyError(
                f"expected trifinger-rl-datasets, not installed ({error}); "
                f"run: pip install trifinger-rl-datasets==1.0.3"
            ) from error
        from trifinger_push.control import TipControl
        from trifinger_push.cube import HALF, CubeEstimator, planar_pose
        from trifinger_push.fingers import STEP
        from trifinger_push.places import PUSH_HEIGHT
        from trifinger_push.policy import FRICTION

        self.env: Any = gymnasium.make(
            "trifinger-cube-push-sim-expert-v0", disable_env_checker=True, visualization=False, flatten_obs=False
        ).unwrapped
        self.control, self.estimator = TipControl(), CubeEstimator(FRICTION)
        self.half, self.height, self.planar_pose, self.step_seconds = HALF, PUSH_HEIGHT, planar_pose, STEP
        self.yaw: float | None = None

    def start(self, state: Array) -> None:
        """A new simulation from a state of the task (9,)."""
        self.env.reset()
        x, y, yaw = state[:3]
        self.env.sim_env.platform.cube.set_state([x, y, self.half], [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
        self.control.reset()
        self.estimator.reset()
        self.load = np.zeros((3, 3))
        self.observation = self.env.step(self.env.action_space.low * 0)[0]
        for height, steps in APPROACH:
            tips = np.column_stack([state[3:].reshape(3, 2), np.full(3, self.height if height is None else height)])
            for _ in range(steps):
                self.hold(tips)

    def joints(self) -> tuple[Array, Array]:
        """Angles and velocities."""
        robot = self.observation["robot_observation"]
        return robot["position"].astype(float), robot["velocity"].astype(float)

    def hold(self, targets: Array, velocity: Array | None = None) -> None:
        """One step of the simulator with the tips led to targets (3, 3), where they have a velocity (3, 3)."""
        still = np.zeros((3, 3))
        load = LOAD_DECAY * self.load + LOAD_GAIN * self.step_seconds * (targets - self.tips())
        self.load = np.clip(load, -LOAD_LIMIT, LOAD_LIMIT)
        torque = self.control.torque(
            *self.joints(), (targets, still if velocity is None else velocity, still), self.load
        )
        self.observation = self.env.step(torque)[0]
        self.estimated = self.estimator.update(self.observation["camera_observation"], self.tips())

    def tips(self) -> Array:
        """Places (3, 3) of the tips."""
        return self.control.tips(self.joints()[0])[0]

    def state(self, true: bool) -> Array:
        """The task's state, with the true pose of the cube or the estimated one."""
        pose = self.estimated
        if true:
            position, quaternion = self.env.sim_env.platform.cube.get_state()
            pose = self.planar_pose(np.array(position), np.array(quaternion))
        # The yaw begins near 0; all four sides of a cube look alike to `planar_pose`.
        turn = (pose[2] + np.pi / 4) % (np.pi / 2) - np.pi / 4 if self.yaw is None else self.yaw
        turn = pose[2] + np.pi / 2 * round((turn - pose[2]) / (np.pi / 2))
        self.yaw = turn
        return np.concatenate([pose[:2], [turn], self.tips()[:, :2].ravel()])

    def step(self, action: Array) -> None:
        """One step of the task: increments of the tips (6,) [m]."""
        start = self.tips()
        start[:, 2] = self.height
        way = np.column_stack([action.reshape(3, 2), np.zeros(3)])
        for i in range(SUBSTEPS):
            self.hold(start + way * (i + 1) / SUBSTEPS, way / (SUBSTEPS * self.step_seconds))


def episode(simulator: OtherSimulator, policy: Any, start: Array, goal: Array, steps: int, true: bool) -> list[float]:
    """Success, distance [m] and angle [rad] to the goal after the last step, and how far the cube went [m]."""
    from difflcs_envs.trifinger.task import MOVE

    simulator.start(start)
    simulator.yaw = None
    for _ in range(steps):
        state = torch.from_numpy(simulator.state(true))
        with torch.no_grad():
            action = policy(state, torch.from_numpy(goal)).action.numpy()
        simulator.step(action)
    final = simulator.state(True)
    distance, angle = MOVE.errors(final, goal)
    success = MOVE.is_success(distance, angle)
    return [float(success), float(distance), float(angle), float(np.linalg.norm(final[:2] - start[:2]))]


def summary(rows: list[list[float]]) -> dict[str, Any]:
    """The figures of one way of observing."""
    success, distance, angle, way = np.array(rows).T
    return {
        **success_figures(success),
        "median_position_error": float(np.median(distance)),
        "median_yaw_error": float(np.median(angle)),
        "within_2_cm": float((distance <= 0.02).mean()),
        "median_way": float(np.median(way)),
    }


def measure(o: Options) -> dict[str, Any]:
    """All ways of observing, and the environment where the model was learned."""
    task = get_task("cube")
    policy = task.make_policy(LCSModel.from_pretrained(MODEL))
    envs: Any = task.make_envs(1)
    home = evaluate(envs, policy, o.goals, o.seed, task.episode_steps)
    results: dict[str, Any] = {
        "mujoco": {
            "success_rate": home.success_rate,
            "ci_low": home.ci_low,
            "ci_high": home.ci_high,
            "episodes": home.goals,
            "median_position_error": home.median_errors["position_error"],
            "median_yaw_error": home.median_errors["yaw_error"],
        }
    }
    starts = [envs.reset(seed=[s])[0] for s in episode_seeds(o.seed, Stream.EVALUATION, 0, o.goals)]
    envs.close()
    simulator = OtherSimulator()
    rows: dict[str, list[list[float]]] = {"true": [], "camera": []}
    for given in starts:
        start, goal = np.asarray(given["state"], float)[0], np.asarray(given["goal"], float)[0]
        for name, played in rows.items():
            found = episode(simulator, policy, start, goal, task.episode_steps, name == "true")
            played.append([round(v, 5) for v in found])
            results[name] = {**summary(played), "rows": played}
        if o.out is not None:
            record = {"machine": machine(), "model": MODEL, "seed": o.seed, "results": results}
            write_atomically(o.out, (json.dumps(record) + "\n").encode())
        if not o.json:
            print(f"{len(rows['true'])} goals: " + ", ".join(f"{n} {results[n]['success_rate']:.3f}" for n in rows))
    return results


def main(o: Options) -> None:
    """Play, print, write."""
    torch.set_num_threads(1)
    results = measure(o)
    for row in results.values():
        row.pop("rows", None)
    print(json.dumps({"model": MODEL, "seed": o.seed, **results}) if o.json else json.dumps(results, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Options))
