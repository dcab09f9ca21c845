"""The environments as tasks of `difflcs`, for its trainings, evaluations and pictures.

The one file of this package that imports `difflcs`, which finds it by the entry point group `difflcs.tasks`. No
environment is imported here, and no simulation.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from difflcs.cost import GoalCost
from difflcs.rl.tasks import PhysicsSpec, Quantity, TaskSpec, register_task
from difflcs.systems import pushing_cost
from difflcs_envs.hand import task as hand
from difflcs_envs.trifinger.task import ACTION_LIMIT, ACTION_SIZE, EPISODE_STEPS, MOVE, TURN, MoveTask, checked_task
from difflcs_envs.ycb import YCB

STATE_SIZE = 9  # object x, y [m], yaw [rad], then x, y [m] of three fingertips
STEP_SECONDS = 0.1
HORIZON = 8  # steps that the MPC plans ahead
MOVE_GOALS = ((0.04, 0.03, 0.3), (-0.04, 0.03, -0.3), (0.0, -0.05, 0.4), (0.05, -0.02, 0.0))  # [m, m, rad] to show
HAND_GOAL = (-0.02, 0.0, 0.036, 0.99792, 0.0, 0.0, 0.06453)  # a cube, a quarter turn from where seed 0 starts
HAND_GUESS = {"object_mass": 3.0, "friction": 0.5, "servo_gain": 0.5}  # factors by which `hand_unknown` is told wrong
TURN_GOALS = ((0.0, 0.0, 0.8), (0.0, 0.0, -0.8), (0.0, 0.0, 1.4), (0.0, 0.0, -0.3))


def contact_cost() -> GoalCost:
    """Cost of an MPC that knows where the object is touched.

    Stage: 35 Σ‖tip − object − 0.8 (object − goal)‖² + 200 ‖object − goal‖² + 2 (yaw − goal yaw)² + 60 ‖u‖²; final: 40,
    200 and 10. Against the cost of the task (`pushing_cost`): tips are drawn behind the object, as seen from the goal;
    they are drawn with more than three times the weight, or they wander past it; and the yaw counts seven times as
    much, or plans of a few steps leave it for later, when there is no time left.

    Returns:
        A `GoalCost` of goals (x [m], y [m], yaw [rad]).
    """
    behind, (tips, tips_final) = 0.8, (35.0, 40.0)
    reach = GoalCost.reach(
        STATE_SIZE,
        ACTION_SIZE,
        goal_weight=(200.0, 200.0, 2.0),
        goal_weight_final=(200.0, 200.0, 10.0),
        input_weight=60.0,
    )
    places, goals = torch.zeros(6, STATE_SIZE, dtype=torch.float64), torch.zeros(6, 3, dtype=torch.float64)
    for row in range(6):
        places[row, 3 + row], places[row, row % 2], goals[row, row % 2] = 1.0, -(1 + behind), behind
    terms: dict[str, Tensor] = {"R": reach.R}
    for weight, names in (
        (tips, ("Q", "goal_to_q", "goal_stage")),
        (tips_final, ("Q_final", "goal_to_q_final", "goal_final")),
    ):
        extra = (places.mT @ places, places.mT @ goals, goals.mT @ goals)
        terms |= {name: getattr(reach, name) + 2 * weight * term for name, term in zip(names, extra, strict=True)}
    return GoalCost(**terms)


def contact_system(**env_kwargs: Any) -> Any:
    """Make the known physics of the object and the tips, as a `ContactLCS`.

    Known: the outline at the height of the tips and the centre of mass. Guessed, and the same for every object: tips
    make 70 % of a commanded step and give way; friction 0.5; the object begins to move when a tip is pressed into it by
    2 mm; and it turns as if its weight lay 1.4 times as far out as it does.

    Args:
        **env_kwargs: Arguments of the environment.
    """
    from difflcs.physics import ContactLCS, PlanarPushing, Polygon, PositionDrive, Union
    from difflcs.physics.learnable import LEARNABLE
    from difflcs_envs.trifinger.model import TIP_RADIUS, CubeObject
    from difflcs_envs.trifinger.objects import make_object
    from difflcs_envs.trifinger.section import cross_section

    arguments = {"object_source": "source", "rest_pose": "rest_pose", "mesh_parts": "parts", "mesh_scale": "mesh_scale"}
    options = {argument: env_kwargs[name] for name, argument in arguments.items() if name in env_kwargs}
    scene_object = make_object(env_kwargs["object"], **options) if "object" in env_kwargs else CubeObject()
    outline = Union(tuple(Polygon(torch.from_numpy(corners)) for corners in cross_section(scene_object)))
    guess = PlanarPushing(
        outline,
        radius=TIP_RADIUS - 0.002,
        n_discs=3,
        drive=PositionDrive(gain=torch.full((3, 2), 0.7, dtype=torch.float64), compliance=0.1),
        center_of_mass=(0.0, 0.0),
        gyration=1.4 * float(outline.gyration),
        friction=0.5,
        compliance=0.1,
        length=0.05,
        nearest=2,
    )
    return ContactLCS(guess, LEARNABLE[:-1])


def pushing_features(state: Tensor, goal: Tensor, elapsed: Tensor) -> Tensor:
    """Compute the inputs of the value network of a pushing task, scaled to about one.

    Args:
        state: (..., 9).
        goal: (..., 3).
        elapsed: (...) fraction of the episode that has passed; without it a value of truncated episodes is undefined.

    Returns:
        (..., 15): object pose, fingertips from the object, pose error, its norms, time.
    """
    place, yaw = state[..., :2], state[..., 2:3]
    to_place, to_yaw = place - goal[..., :2], yaw - goal[..., 2:]
    return torch.cat(
        [
            place / 0.05,
            yaw / 0.3,
            (state[..., 3:] - torch.cat([place] * 3, -1)) / 0.05,
            to_place / 0.05,
            to_yaw / 0.3,
            to_place.norm(dim=-1, keepdim=True) / 0.05,
            to_yaw.abs() / 0.3,
            (2 * elapsed - 1).unsqueeze(-1),
        ],
        -1,
    )


def caption(info: Mapping[str, Any]) -> str:
    """Caption a picture of a step: "off by 12 mm, 0.05 rad"."""
    return f"off by {1000 * info['position_error']:.0f} mm, {info['yaw_error']:.2f} rad"


def describe(env: Any) -> dict[str, Any]:
    """Describe the object of an environment or a vector, wrapped or not: name, source of its shape, mass, ..."""
    inner = env.unwrapped
    return (inner.envs[0].unwrapped if hasattr(inner, "envs") else inner).describe()


def contact_physics(env_kwargs: Mapping[str, Any]) -> PhysicsSpec:
    """Make the known physics of a pushing task, for methods that start from it."""
    return PhysicsSpec(
        make_system=functools.partial(contact_system, **env_kwargs),
        make_cost=contact_cost,
        horizon=3,
        relaxation=3e-4,
        scale=(0.05, 0.05, 1.0, *[0.25] * 6),
        told="outline of the object at the height of the tips, its centre of mass, radius of the tips",
    )


def _adapt_task(task: MoveTask, env_kwargs: Mapping[str, Any]) -> MoveTask:
    """Return a task with the numbers of an environment that is made with these arguments."""
    numbers = {name: env_kwargs.get(name, getattr(task, name)) for name in ("yaw_tolerance", "sparse_penalty")}
    near = env_kwargs.get("position_tolerance", task.position_tolerance)
    task = replace(task, position_tolerance=near)
    return checked_task(task, reward_weights=env_kwargs.get("reward_weights"), **numbers)


def trifinger_task(
    name: str, env: str, task: MoveTask, summary: str, goals: tuple[tuple[float, ...], ...], **env_kwargs: Any
) -> TaskSpec:
    """Make one task of the robot hand.

    Args:
        name: Name of the task.
        env: Name of the Gymnasium environment in the namespace `difflcs`.
        task: Goals and reward of that environment.
        summary: The task in one sentence.
        goals: Goals for pictures of the learned policy.
        **env_kwargs: Arguments of the environment. Their changes of goals and reward apply here, too.
    """
    judge = _adapt_task(task, env_kwargs)
    return TaskSpec(
        name=name,
        summary=summary,
        env=f"difflcs_envs:difflcs/{env}",
        env_kwargs=env_kwargs,
        make_cost=pushing_cost,
        u_min=-ACTION_LIMIT,
        u_max=ACTION_LIMIT,
        horizon=HORIZON,
        episode_steps=env_kwargs.get("horizon", EPISODE_STEPS),
        step_seconds=STEP_SECONDS,
        features=pushing_features,
        outcome=judge.judge,
        failure_penalty=judge.sparse_penalty,
        goal=(Quantity("x", "m"), Quantity("y", "m"), Quantity("yaw", "rad")),
        errors=(Quantity("position_error", "m"), Quantity("yaw_error", "rad")),
        caption=caption,
        picture={"width": 640, "height": 480},
        example_goals=goals,
        describe=describe,
        requires=("mujoco",),
        threaded=True,
        model_name=f"trifinger-{name.replace('_', '-')}",
        physics=None if task is not MOVE else contact_physics(env_kwargs),
    )


def hand_system(
    model: Any, learn: Sequence[str | tuple[str, str]] = (), object: str = "object", fingers: Any = (), **options: Any
) -> Any:
    """Make the system of a hand: at rest after each step, its servos give way, and each finger has contacts to spare.

    Args:
        model: MuJoCo's model, such as `difflcs_envs.hand.model.build_model`.
        learn: What is uncertain in it, see `LearnableMujocoLCS`; nothing: a `MujocoLCS` as the model is.
        object: The body in the hand.
        fingers: The bodies of each finger; nothing: those of `build_model`.
        options: Further ones of `MujocoLCS`, or in place of those here.
    """
    from difflcs.physics.mujoco import ContactGroup, LearnableMujocoLCS, MujocoLCS
    from difflcs_envs.hand.model import FINGERS, LINKS

    fingers = fingers or [[f"{finger}_{link}" for link in LINKS] for finger in FINGERS]
    options = {
        "motion": "quasi-dynamic",
        "contacts": [
            ContactGroup((object, "palm"), 3),
            *(ContactGroup([(object, link) for link in finger], 2) for finger in fingers),
            ContactGroup(None, 4, friction=False, distance=0.006),  # fingers with each other
        ],
        "distance": 0.03,
        "torsion": False,
        "compliance": 0.1,
        "length": 0.02,
        **options,
    }
    return LearnableMujocoLCS(model, learn=learn, **options) if learn else MujocoLCS(model, **options)


def hand_cost(system: Any) -> Any:
    """Make the cost of the hand: the object at its goal at the end of a plan, and on the way fingertips near it.

    Args:
        system: A `MujocoLCS`, whose rotations count from where those of the cost do.

    Returns:
        A `MujocoCost` of goals (place [m], quaternion w, x, y, z).
    """
    from difflcs.physics.mujoco import Distance, Effort, MujocoCost, Orientation, Position
    from difflcs_envs.hand.model import FINGERS

    return MujocoCost(
        system,
        [
            Position("body:object", weight=0.0, weight_final=1000.0),
            Orientation("body:object", weight=0.0, weight_final=18.75, reach=1.6),
            *(Distance("body:object", f"site:{finger}_tip", weight=1.0, weight_final=0.0) for finger in FINGERS),
            Effort(0.2),
        ],
    )


class HandCost:
    """`hand_cost` of an object, made when it is first asked for: MuJoCo is not imported to know its sizes."""

    n_x, n_u, n_goal, local = hand.STATE_SIZE, hand.ACTION_SIZE, hand.GOAL_SIZE, True

    def __init__(self, name: str):
        self._name, self._cost = name, None

    def at(self, x: Tensor, goal: Tensor | None = None, context: Tensor | None = None) -> Any:
        """See `CostModule`."""
        if self._cost is None:
            from difflcs_envs.hand.model import build_model

            self._cost = hand_cost(hand_system(build_model(self._name)))
        return self._cost.at(x, goal, context)


def hand_features(state: Tensor, goal: Tensor, elapsed: Tensor) -> Tensor:
    """Compute the inputs of the value network of the hand, scaled to about one.

    Args:
        state: (..., 22).
        goal: (..., 7).
        elapsed: (...) fraction of the episode that has passed.

    Returns:
        (..., 29): joints, place of the object from its goal, its quaternion and that of the goal with the sign of the
        other, squared sine of half the angle between them, time.
    """
    turned, aim = hand.rotation_to_quaternion(state[..., 19:]), goal[..., 3:]
    along = (turned * aim).sum(-1, keepdim=True)
    sign = torch.where(along < 0, -1.0, 1.0)
    apart = ((state[..., 16:19] - goal[..., :3]) / 0.02).clamp(-10, 10)
    return torch.cat(
        [state[..., :16], apart, turned, sign * aim, 1 - along * along, (2 * elapsed - 1).unsqueeze(-1)], -1
    )


def hand_task(name: str, summary: str, guess: Mapping[str, float] | None = None, **env_kwargs: Any) -> TaskSpec:
    """Make one task of turning an object in the hand.

    Args:
        name: Name of the task.
        summary: The task in one sentence.
        guess: Factors of `object_mass`, `friction` and `servo_gain` by which the physics that it is told is wrong.
        **env_kwargs: Arguments of the environment.
    """
    thing = env_kwargs.get("object", "cube")
    known = {"object_mass": 0.1, "friction": 0.5, "servo_gain": 1.0} | env_kwargs
    mass, friction, gain = (known[k] * (guess or {}).get(k, 1.0) for k in ("object_mass", "friction", "servo_gain"))

    def make_system() -> Any:
        from difflcs_envs.hand.model import build_model

        uncertain = [("mass", "object"), "friction", "gain", "compliance"]  # the last is chosen for plans, not measured
        return hand_system(build_model(thing, mass, friction, gain), uncertain)

    judge = replace(hand.TURN_OBJECT, sparse_penalty=env_kwargs.get("sparse_penalty", hand.TURN_OBJECT.sparse_penalty))
    return TaskSpec(
        name=name,
        summary=summary,
        env="difflcs_envs:difflcs/HandTurnObject-v0",
        env_kwargs=env_kwargs,
        make_cost=functools.partial(HandCost, thing),
        u_min=-hand.ACTION_LIMIT,
        u_max=hand.ACTION_LIMIT,
        horizon=4,
        relaxation=1e-3,
        episode_steps=env_kwargs.get("horizon", hand.EPISODE_STEPS),
        step_seconds=STEP_SECONDS,
        features=hand_features,
        outcome=judge.judge,
        failure_penalty=judge.sparse_penalty,
        goal=tuple(Quantity(axis, "m") for axis in "xyz") + tuple(Quantity(f"q{axis}", "1") for axis in "wxyz"),
        errors=(Quantity("position_error", "m"), Quantity("angle_error", "rad")),
        picture={"width": 640, "height": 480},
        example_goals=(HAND_GOAL,),
        describe=describe,
        requires=("mujoco",),
        physics=PhysicsSpec(
            make_system=make_system,
            scale=(*[0.1] * 16, *[0.01] * 3, *[0.2] * 3),
            told="MuJoCo's model of the hand and its object, with guesses of mass, friction and gain of the servos",
        ),
    )


def register_tasks() -> None:
    """Make the tasks known to `difflcs`, which calls this itself where this package is installed."""
    register_task(hand_task("hand", "Turn a cube in a hand of four fingers by a quarter."))
    register_task(
        hand_task("hand_unknown", "Turn a cube in the hand, with mass, friction and servos guessed wrong.", HAND_GUESS)
    )
    register_task(
        trifinger_task("cube", "TriFingerMoveCube-v0", MOVE, "Push a cube of 6 cm to a position and yaw.", MOVE_GOALS)
    )
    register_task(
        trifinger_task("turn_cube", "TriFingerTurnCube-v0", TURN, "Turn a cube on a pivot to a yaw.", TURN_GOALS)
    )
    for name in YCB:
        summary = f"Push a {name.replace('_', ' ')} of the YCB set to a position and yaw."
        register_task(trifinger_task(name, "TriFingerMoveObject-v0", MOVE, summary, MOVE_GOALS, object=name))
