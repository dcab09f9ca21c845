"""How fast the environments are, against bare MuJoCo in the same run: `python benchmarks/env.py [--smoke]`.

Every speed is a ratio to 50 x `mj_step` (one action of 0.1 s without a controller) from the same states with the same
torques; absolute times of a shared machine mean little. Times are processor times, so that other work on the machine
does not count; the best of several rounds counts. The gain by several threads is also given in wall-clock time, which
needs an idle machine.
"""

# MuJoCo is a compiled module without type stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

import difflcs_envs
from difflcs.bench import save
from difflcs_envs.trifinger.env import TriFingerEnv
from difflcs_envs.trifinger.native import NATIVE_VARIABLE
from difflcs_envs.trifinger.physics import SUBSTEPS
from difflcs_envs.vector import TriFingerVectorEnv, available_cores

EPISODE = 20
TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "cube": ("difflcs/TriFingerMoveCube-v0", {}),
    "mug": ("difflcs/TriFingerMoveObject-v0", {"object": "mug"}),
    "sugar_box": ("difflcs/TriFingerMoveObject-v0", {"object": "sugar_box"}),
    "turn_cube": ("difflcs/TriFingerTurnCube-v0", {}),
}


def pushing_actions(rounds: int) -> np.ndarray:
    """Fingers that close in on the object and keep pushing, with noise: contact for most of an episode."""
    rng = np.random.default_rng(0)
    yaws = np.deg2rad([0.0, -120.0, -240.0])
    inward = np.stack([np.sin(yaws), -np.cos(yaws)], axis=1).ravel()
    return np.clip(0.008 * inward + rng.normal(0, 0.005, (rounds, EPISODE, 6)), -0.015, 0.015)


def bare_seconds(env: TriFingerEnv, states: list[np.ndarray], controls: list[np.ndarray]) -> float:
    """Time of the physics alone, from every state of an episode with the torques that were last applied in it."""
    total = 0.0
    for full_state, control in zip(states, controls, strict=True):
        env.physics.set_full_state(full_state)
        env.data.ctrl[:] = control
        start = time.thread_time()
        mujoco.mj_step(env.model, env.data, SUBSTEPS)
        total += time.thread_time() - start
    return total / len(states)


def single(env_id: str, arguments: dict[str, Any], rounds: int) -> dict[str, float]:
    """Microseconds of a step and of a reset of a single environment, and of the bare physics between them."""
    env: TriFingerEnv = gymnasium.make(env_id, **arguments).unwrapped  # pyright: ignore[reportAssignmentType]
    twin: TriFingerEnv = gymnasium.make(env_id, **arguments).unwrapped  # pyright: ignore[reportAssignmentType]
    best = {"step": np.inf, "bare": np.inf, "reset": np.inf}
    for actions in pushing_actions(rounds):
        start = time.thread_time()
        env.reset(seed=0)
        best["reset"] = min(best["reset"], time.thread_time() - start)
        states, controls, total = [], [], 0.0
        for action in actions:
            states.append(env.physics.get_full_state())
            start = time.thread_time()
            env.step(action)
            total += time.thread_time() - start
            controls.append(env.data.ctrl.copy())
        bare = bare_seconds(twin, states, controls)
        if total / EPISODE + bare < best["step"] + best["bare"]:  # both from the same, least disturbed round
            best["step"], best["bare"] = total / EPISODE, bare
    return {name: 1e6 * seconds for name, seconds in best.items()}


def vector_seconds(
    env_id: str, arguments: dict[str, Any], num_envs: int, threads: int, rounds: int
) -> tuple[float, float]:
    """Processor and wall-clock time of one step of one environment in a vector."""
    envs = gymnasium.make_vec(env_id, num_envs=num_envs, threads=threads, **arguments)
    assert isinstance(envs, TriFingerVectorEnv)
    processor = wall = np.inf
    for actions in pushing_actions(rounds):
        envs.reset(seed=[0] * num_envs)
        start = time.process_time(), time.perf_counter()
        for action in actions:
            envs.step(np.tile(action, (num_envs, 1)))
        processor = min(processor, time.process_time() - start[0])
        wall = min(wall, time.perf_counter() - start[1])
    return processor / EPISODE / num_envs, wall / EPISODE / num_envs


def render_milliseconds(rounds: int) -> float | None:
    """Time of one picture of 320 x 240; None where nothing can be drawn."""
    env = gymnasium.make("difflcs/TriFingerMoveCube-v0", render_mode="rgb_array")
    env.reset(seed=0)
    try:
        env.render()
    except difflcs_envs.RenderingError:
        return None
    best = np.inf
    for _ in range(rounds):
        start = time.perf_counter()
        env.render()
        best = min(best, time.perf_counter() - start)
    env.close()
    return 1e3 * best


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description="Benchmark of the environments.")
    parser.add_argument("--rounds", type=int, default=30, help="episodes per measurement; the best counts")
    parser.add_argument("--num-envs", type=int, default=32, help="environments of a vector")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/env.json"), help="where the JSON goes")
    parser.add_argument("--smoke", action="store_true", help="everything tiny: seconds instead of a minute")
    options = parser.parse_args()
    rounds, num_envs = (2, 4) if options.smoke else (options.rounds, options.num_envs)
    difflcs_envs.register_envs()
    cores = available_cores()
    versions = {"python": sys.version.split()[0], "mujoco": mujoco.__version__, "gymnasium": gymnasium.__version__}
    record: dict[str, Any] = {"machine": platform.machine(), "cores": cores, "num_envs": num_envs, "versions": versions}
    print(f"{cores} cores, {versions}, vectors of {num_envs}; x = speed relative to {SUBSTEPS} x mj_step on one core")
    for name, (env_id, arguments) in TASKS.items():
        env: TriFingerEnv = gymnasium.make(env_id, **arguments).unwrapped  # pyright: ignore[reportAssignmentType]
        native = single(env_id, arguments, rounds)
        os.environ[NATIVE_VARIABLE] = "0"
        python = single(env_id, arguments, max(2, rounds // 5))
        del os.environ[NATIVE_VARIABLE]
        row: dict[str, Any] = {
            "object": env.object.describe(),
            "native": env.physics.lane is not None,
            "bare_us": native["bare"],
            "step_ratio": native["bare"] / native["step"],
            "python_step_ratio": python["bare"] / python["step"],
            "reset_in_steps": native["reset"] / native["step"],
        }
        print(
            f"{name} ({env.object.source.replace('_', ' ')}): bare {row['bare_us']:.0f} us, "
            f"step {row['step_ratio']:.2f} x, in Python {row['python_step_ratio']:.2f} x, "
            f"reset = {row['reset_in_steps']:.2f} steps"
        )
        for threads in sorted({1, cores}):
            processor, wall = vector_seconds(env_id, arguments, num_envs, threads, max(2, rounds // 5))
            row[f"vector_{threads}_per_core"] = 1e-6 * native["bare"] / processor
            row[f"vector_{threads}_wall"] = 1e-6 * native["bare"] / wall
            print(
                f"    vector, {threads} thread(s): {row[f'vector_{threads}_per_core']:.2f} x per core, "
                f"{row[f'vector_{threads}_wall']:.2f} x by the clock"
            )
        record[name] = row
    record["render_ms"] = render_milliseconds(rounds)
    if record["render_ms"] is not None:
        print(f"picture of 320 x 240: {record['render_ms']:.1f} ms")
    if not options.smoke:
        save(options.out, record)


if __name__ == "__main__":
    main()
