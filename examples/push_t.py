"""Push-T (gym-pusht) by sampling-based contact MPC: `python examples/push_t.py --out push_t.gif` makes a film of it.

A disc of radius 15 px pushes a T, made of two boxes of 30 by 120 and 30 by 90 px, to a pose on a plane of 512 px. An
action is the target of the disc's PD controller, for ten substeps of 0.01 s. The disc is kinematic: nothing pushes it
back. Velocities are damped away in each substep, so the T moves only while it is pushed. Friction between disc and T is
zero: what the environment sets is an attribute that pymunk does not read. Lengths here are in units of 100 px.
"""

from __future__ import annotations

import math
import warnings
from collections import deque
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from difflcs import Animation, GoalCost, LCSMPCLayer
from difflcs.errors import MissingDependencyError
from difflcs.physics import PDDrive, PlanarPushing, Polygon, Union, box
from difflcs.physics.complementarity import Contacts
from difflcs.planning import Decision, DiscPlaces, Mode, PlanarTravel, SamplingPolicy, SamplingSettings, Workspace

if TYPE_CHECKING:
    from PIL import Image

PIXELS = 100.0
"""Pixels in a unit of length."""
RADIUS = 0.15
"""Radius of the disc."""
_BOXES = (box(-0.6, 0.6, 0.0, 0.3), box(-0.15, 0.15, 0.3, 1.2))
_CENTER = Union(_BOXES).centroid
CENTER_OF_MASS = (0.0, 0.45 - float(_CENTER[1]))
"""Centre of mass of the T from the centre of its area: the environment takes the mean of the centres of its boxes."""
GOAL = (256.0, 256.0, math.pi / 4)
"""Pose of the T's origin [px, px, rad]."""
GYRATION = math.sqrt(3000.0) / PIXELS
"""Radius of gyration as in the environment: twice the moment of the bar about the T's origin, with a mass of 1."""
DRIVE = PDDrive(stiffness=100.0, damping=20.0, substep=0.01, substeps=10)
SIDE = 5.12
"""Side of the square that actions are in."""
STEPS = 300
"""Limit of an episode, in steps of 0.1 s."""
GREEN, GREY, BLUE = (0, 158, 115), (150, 150, 150), (0, 114, 178)
"""Colours of a film: places from which a push would gain, those from which it would not, and the plan."""


def tee(scale: float = 1.0) -> Union:
    """Make the T in coordinates about the centre of its area, scaled about it by `scale`."""
    return Union(tuple(Polygon(scale * (part.vertices - _CENTER)) for part in _BOXES))


def tee_pushing(**changes: Any) -> PlanarPushing:
    """Make the system: state (x, y of the centre of the T's area, its yaw, x, y of the disc, its velocity).

    Args:
        changes: other values of fields of `PlanarPushing`.
    """
    defaults: dict[str, Any] = {
        "shape": tee(),
        "radius": RADIUS,
        "drive": DRIVE,
        "center_of_mass": CENTER_OF_MASS,
        "gyration": GYRATION,
        "friction": 0.0,
        "compliance": 0.02,
        "length": 1.0,
    }
    return PlanarPushing(**(defaults | changes))


def make_env(**options: Any) -> Any:
    """Make the environment as its authors publish it, with obs_type="state".

    Args:
        options: for `gymnasium.make`.

    Raises:
        MissingDependencyError: gym-pusht is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pygame, about pkg_resources
            import gym_pusht  # noqa: F401
            import gymnasium
    except ImportError as error:
        raise MissingDependencyError(
            f'expected the package gym-pusht, not installed ({error}); run: pip install "difflcs[scoreboard]"'
        ) from error
    return gymnasium.make("gym_pusht/PushT-v0", obs_type="state", max_episode_steps=STEPS, **options)


class Rigid(PlanarPushing):
    """Planar pushing without overlap: a disc inside the outline counts as touching it.

    If the outline is too large, a disc that touches nothing seems to be inside, and a plan would wait until it is
    pushed out. Without overlap the disc moves on until the body moves.
    """

    def contacts(self, x: Tensor) -> Contacts:
        """See `PlanarPushing`."""
        contacts = super().contacts(x)
        return contacts._replace(gap=contacts.gap.clamp_min(0.0))

    @classmethod
    def of(cls, system: PlanarPushing) -> Rigid:
        """Make a rigid copy of a system."""
        return cls(**{field.name: getattr(system, field.name) for field in fields(system)})


class DiscPolicy:
    """Sampling-based contact MPC for a disc that pushes a body on the square: an observation to the disc's target.

    The velocity of the disc, which the observation lacks, comes from the drive, as the past actions are known.

    Args:
        system: the system of the MPC, with state and action as in `tee_pushing`; its shape is about the centre of its
            area.
        center: (2,) this centre, from the origin whose pose is observed.
        goal: (3,) of the origin [px, px, rad].
        delay: steps by which actions come late. The plan begins at the state that the system predicts for then.
        turns: turns of the body about its centre that cover it, which all mean the same.

    Attributes:
        sampling: the policy inside, with its `decision`.
    """

    def __init__(
        self, system: PlanarPushing, center: ArrayLike, goal: ArrayLike = GOAL, *, delay: int = 0, turns: int = 1
    ):
        self.system, self.delay, self._period = Rigid.of(system), delay, 2 * math.pi / turns
        self.center, self.goal = np.asarray(center), goal
        shape = self.system.shape
        workspace = Workspace((0.0, 0.0), (SIDE, SIDE), step=1.2)
        cost = GoalCost.reach(7, 2, goal_weight=(1.0, 1.0, 0.3), goal_weight_final=(4.0, 4.0, 1.2), input_weight=0.01)
        self.sampling = SamplingPolicy(
            LCSMPCLayer(self.system, cost, 6, relaxation=1e-5, on_failure="mask"),
            DiscPlaces(shape, RADIUS, 32, gap=0.02, reach=0.2, workspace=workspace, margin=0.02),
            PlanarTravel(shape, RADIUS, SIDE, drive=DRIVE, clearance=0.08, tolerance=0.12, workspace=workspace),
            SamplingSettings(keep=0.6, smallest_gain=0.02, switch_price=0.02, travel_price=0.04),
            bounds=workspace.bounds,
            angles=(2,),
        )
        step = DRIVE.step()
        self._keeps, self._gives = float(step.A[1, 1]), float(step.b[1])
        self.reset()

    def reset(self) -> None:
        """Start an episode."""
        self.sampling.reset()
        self._velocity = np.zeros(2)
        self._under_way: deque[NDArray[np.float64]] = deque()

    def act(self, observation: ArrayLike) -> NDArray[np.float64]:
        """Compute an action.

        Args:
            observation: (5,) x, y of the disc, x, y [px] and angle [rad] of the body's origin.

        Returns:
            (2,) the target of the disc [px].
        """
        seen = np.asarray(observation, np.float64)
        disc = seen[:2] / PIXELS
        state = np.concatenate([from_origin(seen[2:], self.center), disc, self._velocity])
        if self.delay and not self._under_way:
            self._under_way.extend([disc] * self.delay)
        for target in self._under_way:
            state = self._predict(state, target)
        goal = from_origin(self.goal, self.center)
        goal[2] += self._period * np.round((state[2] - goal[2]) / self._period)
        target = np.clip(state[3:5] + self.sampling.act(state, goal), 0.0, SIDE)
        self._under_way.append(target)
        self._velocity = self._keeps * self._velocity + self._gives * (self._under_way.popleft() - disc)
        return target * PIXELS

    def _predict(self, state: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predict the state one step later."""
        with torch.no_grad():
            x, u = torch.from_numpy(state), torch.from_numpy(target - state[3:5])
            return self.system.params(x).step(x, u).x_next.numpy()


class PushTPolicy(DiscPolicy):
    """The policy for gym-pusht: its observation of obs_type="state" to its action.

        policy = PushTPolicy()
        observation, _ = env.reset(seed=0)
        policy.reset()
        ...
        observation, *_ = env.step(policy.act(observation))

    Args:
        system: see `DiscPolicy`; `tee_pushing()` by default.
        delay: likewise.
    """

    def __init__(self, system: PlanarPushing | None = None, delay: int = 0):
        super().__init__(tee_pushing() if system is None else system, _CENTER, delay=delay)


def from_origin(pose: ArrayLike, center: ArrayLike = _CENTER) -> NDArray[np.float64]:
    """Convert the pose (3,) of the body's origin in pixels to that of the centre of its area in units of length."""
    x, y, yaw = np.asarray(pose, np.float64)
    cos, sin = math.cos(yaw), math.sin(yaw)
    cx, cy = np.asarray(center).tolist()
    return np.array([x / PIXELS + cos * cx - sin * cy, y / PIXELS + sin * cx + cos * cy, yaw])


def picture(env: Any, policy: DiscPolicy, text: str = "", size: int = 340) -> Image.Image:
    """The environment as it draws itself, and on top what the policy decided last.

    Places where the disc could be are dots, the greener the more a push from there would gain; that to which it
    travels has a ring. Where it pushes, the planned path of the disc is a line.

    Args:
        env: of `make_env(render_mode="rgb_array")`.
        policy: after `act`.
        text: to write into the upper left corner.
        size: width and height [px].
    """
    from PIL import Image, ImageDraw

    frame = Image.fromarray(env.render()).resize((size, size), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(frame)
    decision = policy.sampling.decision
    if decision is not None:
        _draw(draw, decision, size)
    draw.text((6, 4), text, fill=(20, 20, 30), font_size=max(10, size // 24))
    return frame


def _draw(draw: Any, decision: Decision, size: int) -> None:
    scale, line = size / (SIDE * PIXELS), size / 340

    def dot(point: Tensor, radius: float, **colors: Any) -> None:
        x, y = (scale * PIXELS * point).tolist()
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), **colors)

    scores = decision.scores[1:]
    best = max(float(scores.max()), 1e-12)
    # Dots move with the T while the disc travels.
    for place, score in zip(decision.states[1:, 3:5], scores.tolist(), strict=True):
        share = min(max(score / best, 0.0), 1.0) ** 2
        color = tuple(round(share * a + (1 - share) * b) for a, b in zip(GREEN, GREY, strict=True))
        dot(place, line * (1.5 + 2.0 * share), fill=color)
    if decision.mode is Mode.TRAVEL and decision.target is not None:
        dot(decision.target[3:5], 7.0 * line, outline=BLUE, width=round(2 * line))
    else:
        path = (scale * PIXELS * decision.solution.x[0, :, 3:5]).tolist()
        draw.line([tuple(point) for point in path], fill=BLUE, width=round(2 * line))


@dataclass
class Options:
    """A film of Push-T."""

    out: Path = Path("push_t.gif")
    """Where the GIF goes."""
    seed: int = 0
    """Of the first episode; the next have the next."""
    episodes: int = 4
    """How many are played, one after another."""


def main(o: Options) -> None:
    """Play, and write the film at ten frames a second: real time."""
    env, policy, frames = make_env(render_mode="rgb_array"), PushTPolicy(), []
    for seed in range(o.seed, o.seed + o.episodes):
        observation, info = env.reset(seed=seed)
        policy.reset()
        success = ended = False
        while not (success or ended):
            action = policy.act(observation)
            decision = policy.sampling.decision
            assert decision is not None
            frames.append(picture(env, policy, str(decision.mode)))
            observation, _, success, ended, info = env.step(action)
        verdict = f"{'solved' if success else 'not solved'}, {100 * info['coverage']:.0f} % covered"
        frames += [picture(env, policy, verdict)] * 6
        print(f"seed {seed}: {verdict}")
    env.close()
    Animation(frames, fps=10).save(o.out)
    print(f"written: {o.out}")


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Options))
