"""Films benchmarks set by others, each played by the policy of the page Scoreboards.

    pip install gym-pushany gymnasium-robotics trifinger-rl-datasets
    python docs/figures/scoreboards.py pushany fetch_push fetch_slide trifinger_push trifinger_lift
    python docs/figures/scoreboards.py trifinger_turn --assets DIR
    python docs/figures/scoreboards.py leap_cube --judo DIR

Each needs the package of its benchmark. That of trifinger_turn is the folder `envs` of
github.com/asu-iris/Complementarity-Free-Dexterous-Manipulation, that of leap_cube is judo-rai, in a folder of its own.
"""

from __future__ import annotations

import contextlib
import io
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from difflcs import Animation
from difflcs_envs.rendering import select_gl_backend

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
sys.path.append(str(ROOT / "examples"))
WIDTH, HEIGHT = 280, 210

select_gl_backend()  # before MuJoCo is imported, by what is imported in the functions below


@dataclass
class Options:
    """Films of benchmarks set by others."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Which films; all that need no assets by default."""
    assets: Path = Path("envs")
    """Folder of the published models of trifinger_turn."""
    judo: Path | None = None
    """Folder in which Judo is installed, for leap_cube."""


class Camera:
    """Pictures of a MuJoCo scene from a place that turns about a point."""

    def __init__(self, model: Any, lookat: tuple[float, ...], distance: float, azimuth: float, elevation: float):
        import mujoco

        self.renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        self.camera = mujoco.MjvCamera()
        self.camera.lookat[:], self.camera.distance = lookat, distance
        self.camera.azimuth, self.camera.elevation = azimuth, elevation

    def picture(self, data: Any) -> np.ndarray:
        """Draw the scene without shadows, which would make the file larger."""
        import mujoco

        self.renderer.update_scene(data, self.camera)
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        return self.renderer.render()


def pushany(o: Options) -> None:
    """Three shapes of gym-pushany with two bodies in the way, in real time."""
    from push_any import PushAnyPolicy, StateEnv
    from push_t import STEPS, picture

    frames = []
    for name, seed in (("t", 8), ("4", 12), ("8", 20)):
        env = StateEnv(object_name=name, render_action=False)
        policy = PushAnyPolicy(env, 40.0)
        observation, _ = env.reset(seed=seed)
        policy.reset()
        for _ in range(STEPS):
            action = policy.act(observation)
            frames.append(picture(env, policy, size=HEIGHT))
            observation, _, success, _, _ = env.step(action)
            if success:
                break
        frames += [picture(env, policy, "solved" if success else "not solved", size=HEIGHT)] * 6
    save("pushany", frames, 10, 24)


def fetch(task: str, seeds: range) -> list[np.ndarray]:
    """Frames of FetchPush or FetchSlide, every second step of 0.04 s."""
    from fetch_policies import STEPS, PushPolicy, SlidePolicy, make_env

    env = make_env(task)
    model, posture = env.unwrapped.model, env.unwrapped.initial_qpos
    policy: Any = PushPolicy(model) if task == "push" else SlidePolicy(model, posture)
    camera = Camera(model, (1.35, 0.75, 0.45), 1.5, 140.0, -30.0)
    frames = []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        policy.reset()
        for step in range(STEPS):
            observation, *_ = env.step(policy.act(observation).astype(np.float32))
            if step % 2:
                goal = env.unwrapped.model.site("target0").id
                shift = env.unwrapped.data.site_xpos[goal] - env.unwrapped.model.site_pos[goal]
                env.unwrapped.model.site_pos[goal] = env.unwrapped.goal - shift
                frames.append(camera.picture(env.unwrapped.data))
        frames += [frames[-1]] * 5
    return frames


def fetch_push(o: Options) -> None:
    """FetchPush in real time."""
    save("fetch_push", fetch("push", range(5000, 5003)), 12.5, 32)


def fetch_slide(o: Options) -> None:
    """FetchSlide in real time."""
    save("fetch_slide", fetch("slide", range(5000, 5003)), 12.5, 32)


def trifinger_turn(o: Options) -> None:
    """Three fingers turn objects on a table, at twice the real speed."""
    import trifinger_turn as turning

    from difflcs.errors import ContactWarning

    warnings.simplefilter("ignore", ContactWarning)
    frames = []
    for name in ("cube", "mug"):
        model, servos, data, place, goal = turning.make_task(o.assets, name, 5000)
        model.body("goal").pos[:], model.body("goal").quat[:] = place, goal
        policy, held = turning.Policy(servos, data, place, goal, turning.Settings()), 0
        camera = Camera(model, (0.0, 0.0, 0.03), 0.55, 90.0, -40.0)
        for step in range(turning.DECISIONS):
            if held == turning.HELD:
                break
            turning.follow(model, data, policy.act(data))
            wrong, apart = 1 - float(data.qpos[3:7] @ goal) ** 2, float(np.linalg.norm(data.qpos[:3] - place))
            held = (held + 1) * (wrong < 0.04 and apart < 0.02)
            if step % 4 == 0:
                frames.append(camera.picture(data))
        frames += [frames[-1]] * 10
    save("trifinger_turn", frames, 12.5, 32)


def bullet(policy: Any, environment: str, steps: int, every: int) -> list[np.ndarray]:
    """Frames of an episode of trifinger-rl-datasets, in PyBullet."""
    import gymnasium
    import pybullet
    import trifinger_rl_datasets  # noqa: F401 (it registers the environment)
    from trifinger_simulation.tasks import move_cube

    options = {"disable_env_checker": True, "visualization": False, "flatten_obs": False, "image_obs": False}
    np.random.seed(5000)  # noqa: NPY002 (from there the package draws the cube's places)
    move_cube.seed(5000)
    env: Any = gymnasium.make(environment, **options).unwrapped
    view = pybullet.computeViewMatrix([0.0, -0.34, 0.52], [0.0, 0.0, 0.04], [0.0, 0.0, 1.0])
    lens = pybullet.computeProjectionMatrixFOV(45.0, WIDTH / HEIGHT, 0.05, 3.0)
    frames = []
    with contextlib.redirect_stdout(io.StringIO()):
        observation, _ = env.reset()
        policy.reset()
        for step in range(steps):
            observation, _, _, _, _ = env.step(policy.get_action(observation))
            if step % every == 0:
                shot = pybullet.getCameraImage(
                    WIDTH, HEIGHT, view, lens, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=0, shadow=0
                )
                frames.append(np.asarray(shot[2], np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3])
    return frames


def trifinger_push(o: Options) -> None:
    """The first five of 15 s of pushing in trifinger-rl-datasets, in real time."""
    from trifinger_push.policy import PushPolicy

    save("trifinger_push", bullet(PushPolicy(), "trifinger-cube-push-sim-expert-v0", 240, 4), 12.5, 32)


def trifinger_lift(o: Options) -> None:
    """Lifting in trifinger-rl-datasets."""
    from trifinger_lift import LiftPolicy

    save("trifinger_lift", bullet(LiftPolicy(), "trifinger-cube-lift-sim-expert-v0", 1500, 20), 25, 32)


def leap_cube(o: Options) -> None:
    """Twenty seconds of Judo's leap_cube, in real time; the cube above the hand shows the goal."""
    import leap_cube as leap

    from difflcs.errors import ContactWarning

    warnings.simplefilter("ignore", ContactWarning)
    episode = leap.Episode(leap.load_judo(o.judo), 5001)
    task, policy = episode.task, leap.Ours(episode.task, leap.Options())
    model = task.sim_model
    model.site_rgba[:, 3] = 0.0  # Judo's sites for traces, one of which is larger than the hand
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.25, 0.7
    model.geom("cube").rgba[:3], model.geom("cube_vis").rgba[:3] = (0.3, 0.6, 1.0), (0.3, 0.9, 0.6)
    camera = Camera(model, (-0.05, -0.03, 0.16), 0.52, 310.0, -30.0)
    frames: list[np.ndarray] = []
    while task.data.time < 20.0:
        episode.step(policy.control(task))
        if task.data.time >= 0.1 * len(frames):
            frames.append(camera.picture(task.data))
    save("leap_cube", frames, 10, 32)


def save(name: str, frames: list[Any], fps: float, colors: int) -> None:
    """Write a film."""
    path = FOLDER / f"{name}.gif"
    Animation(frames, fps, colors=colors).save(path)
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB, {len(frames)} frames", flush=True)


FILMS: dict[str, Callable[[Options], None]] = {
    film.__name__: film
    for film in (pushany, fetch_push, fetch_slide, trifinger_push, trifinger_lift, trifinger_turn, leap_cube)
}


def main(o: Options) -> None:
    """Make the films."""
    unknown = set(o.names) - FILMS.keys()
    if unknown:
        raise SystemExit(f"expected some of {', '.join(FILMS)}, got {', '.join(sorted(unknown))}")
    torch.set_num_threads(1)
    for name in o.names or list(FILMS)[:-2]:
        FILMS[name](o)


if __name__ == "__main__":
    main(tyro.cli(Options))
