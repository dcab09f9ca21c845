"""Tasks: what they are made of, what is refused, and how they are found."""

import os
from dataclasses import replace
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
import torch

from difflcs import GoalCost, LCSModel
from difflcs.errors import DTypeError, InvalidInputError, MissingDependencyError
from difflcs.rl.rollout import PolicyOutput, collect, noisy_actions, uniform_actions
from difflcs.rl.runs.figures import record_video
from difflcs.rl.tasks import ENTRY_POINTS, Quantity, get_task, register_task, task_names
from tests.conformance.toy import STEPS, U_MAX, Slide, make_task
from tests.conftest import python, refuse

TOY = make_task()


def test_bounds_are_a_number_or_one_for_each_action():
    low, high = TOY.bounds
    assert (low.tolist(), high.tolist(), low.dtype) == ([-U_MAX], [U_MAX], torch.float64)

    def make_cost() -> GoalCost:
        return GoalCost.reach(2, 2, goal_weight=(1.0,), input_weight=1.0)

    low, high = make_task(make_cost=make_cost, u_min=(-1, -2), u_max=3).bounds
    assert (low.tolist(), high.tolist()) == ([-1.0, -2.0], [3.0, 3.0])
    low[0] = 9.0
    assert make_task().bounds[0].tolist() == [-U_MAX]


def test_an_environment_of_an_id():
    gymnasium.register("difflcs-tests/Slide-v0", entry_point=Slide)
    task = make_task(env="difflcs-tests/Slide-v0", env_kwargs={"size": 2})
    assert isinstance(task.make_env().unwrapped, Slide)
    envs = task.make_envs(2, threads=3)  # which it does not take
    assert envs.reset(seed=[0, 1])[0]["state"].shape == (2, 2)
    envs.close()


def test_environments_that_cannot_be_made_say_why():
    for task, why in (
        (make_task(env=Mock(side_effect=RuntimeError("no light"))), "RuntimeError: no light"),
        (make_task(env="nowhere/None-v0"), "nowhere"),
        (make_task(env="no_such_module:None-v0"), "no_such_module"),
        (make_task(env_kwargs={"color": "red"}), "color"),
    ):
        for make in (task.make_env, lambda task=task: task.make_envs(2)):
            refuse(InvalidInputError, f"task toy: its environment cannot be made.*{why}", make)
    refuse(MissingDependencyError, "no_such_package", make_task(requires=("no_such_package",)).make_env)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"u_max": 2 * U_MAX}, r"within the action space .* \[-0.2\] to \[0.4\] and \[-0.2\] to \[0.2\]"),
        ({"u_min": -1.0}, "narrow the bounds"),
        ({"n_context": 1}, "n_context=0, .* got 1; change one"),
        ({"make_cost": lambda: GoalCost.reach(2, 2, goal_weight=(1.0,), input_weight=1.0)}, r"a Box of shape \(2,\)"),
    ],
)
def test_an_environment_that_would_clip_what_is_planned_is_refused(change, message):
    refuse(InvalidInputError, message, make_task(**change).make_envs, 2)
    envs, random = make_task(u_max=U_MAX / 2).make_envs(2), np.random.default_rng(0)  # narrower ones hold for all
    action = collect(envs, noisy_actions(uniform_actions(envs, random), 1.0, random), [0, 1], STEPS)["action"]
    assert action.max() == U_MAX / 2
    envs.close()


def test_every_episode_of_a_film_begins_the_policy_anew(tmp_path, monkeypatch):

    class Drawn(Slide):
        def render(self):
            return np.zeros((64, 64, 3), np.uint8)

    class Counted:
        def __init__(self):
            self.steps = []

        def begin(self, seed=0):
            self.steps.append(0)

        def __call__(self, state, goal, **_):
            self.steps[-1] += 1
            return PolicyOutput(torch.zeros(1, 1).double(), torch.ones(1, dtype=torch.bool))

    policy = Counted()
    record_video(Drawn(), policy, [(0.1,), (0.2,), (-0.1,)], tmp_path / "film.mp4", TOY)
    assert policy.steps == [STEPS] * 3
    monkeypatch.setattr("pathlib.Path.read_bytes", lambda path: b"cut")  # as where a disk is full
    with pytest.raises(OSError, match="no room"):
        record_video(Drawn(), policy, [(0.1,)], tmp_path / "film.mp4", TOY)
    record_video(Drawn(), policy, [(0.1,)], tmp_path / "film.gif", TOY)
    assert len(list(tmp_path.iterdir())) == 2


def test_the_cost_of_the_mpc_may_be_asked_for(build):
    task = make_task(make_cost=lambda: build.AskedCost(TOY.make_cost()))
    assert (task.n_x, task.n_u, task.n_goal) == (2, 1, 1)
    x, goal, lcs = torch.rand(4, 2).double(), torch.ones(4, 1).double(), LCSModel(2, 1, 1, init_scale=0.1)
    own, asked = (each.make_policy(lcs)(x, goal) for each in (TOY, task))
    torch.testing.assert_close(own.u, asked.u)
    torch.testing.assert_close(own.objective, asked.objective)


def test_what_a_picture_says():
    assert TOY.say({"position_error": 0.12345, "other": 1}) == "position error 0.123 m"
    assert TOY.say({}) == ""
    assert make_task(caption=lambda info: f"{info['a']}!").say({"a": 1}) == "1!"


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"name": ""}, InvalidInputError, "name"),
        ({"name": "a/b"}, InvalidInputError, "file names"),
        ({"name": 3}, InvalidInputError, "name"),
        ({"horizon": 0}, InvalidInputError, "horizon"),
        ({"horizon": 2.5}, InvalidInputError, "horizon"),
        ({"episode_steps": 0}, InvalidInputError, "episode_steps"),
        ({"step_seconds": 0.0}, InvalidInputError, "step_seconds"),
        ({"step_seconds": float("nan")}, InvalidInputError, "step_seconds"),
        ({"relaxation": 0.0}, InvalidInputError, "relaxation"),
        ({"failure_penalty": -1.0}, InvalidInputError, "failure_penalty"),
        ({"env": 3}, DTypeError, "env"),
        ({"make_cost": None}, DTypeError, "make_cost"),
        ({"make_cost": lambda: 3}, DTypeError, "GoalCost"),
        ({"make_cost": TOY.make_cost()}, DTypeError, "expected a function, got GoalCost"),
        ({"features": None}, DTypeError, "features"),
        ({"outcome": None}, DTypeError, "outcome"),
        ({"describe": None}, DTypeError, "describe"),
        ({"u_min": 0.2}, InvalidInputError, "u_min"),
        ({"u_min": 0.3}, InvalidInputError, "swap them"),
        ({"u_min": (-1.0, -1.0, -1.0)}, InvalidInputError, "u_min: expected one number or n_u=1"),
        ({"u_max": float("nan")}, InvalidInputError, "u_min"),
        ({"goal": (Quantity("x", "m"), Quantity("y", "m"))}, InvalidInputError, "goal: expected 1 entries"),
        ({"example_goals": ((0.1, 0.2),)}, InvalidInputError, "example_goals: expected 1 entries"),
    ],
)
def test_bad_values_are_refused(change, error, message):
    refuse(error, message, make_task, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": lambda state, *_: state[..., 0]}, r"features: expected \(2, n\) of .*got \(2,\); return"),
        (
            {"features": lambda state, goal: state},
            r"features: expected a function \(state, goal, elapsed\) → .*got function",
        ),
        ({"make_cost": lambda: GoalCost.reach(3, 1, goal_weight=(1.0,))}, r"with a state of shape \(3,\), as the cost"),
        ({"make_cost": lambda: GoalCost.reach(2, 1)}, r"with a goal of shape \(2,\), as the cost"),
    ],
)
def test_what_does_not_fit_its_environment_or_a_network_is_refused_with_it(change, message):
    task = make_task(**{**change, "goal": (), "example_goals": ()})
    refuse(InvalidInputError, message, lambda: task.make_envs(1).close() or task.n_features)


def test_a_registered_task_is_found_and_replaced_by_its_name():
    assert get_task(TOY) is TOY  # registered or not
    mine = make_task("unit-toy")
    assert register_task(mine) is mine
    assert get_task("unit-toy") is mine
    assert "unit-toy" in task_names()
    other = register_task(replace(mine, horizon=4))
    assert get_task("unit-toy") is other
    assert task_names().count("unit-toy") == 1
    refuse(DTypeError, "TaskSpec", register_task, {"name": "x"})


@pytest.mark.parametrize("name", ["no-such-task", "", "a" * 1000])
def test_an_unknown_name_gets_those_there_are(name):
    assert len(refuse(InvalidInputError, r"expected one of .*register_task", get_task, name)) < 2000


PACKAGES = {"good": "def register():\n    from tests.conformance.toy import make_task\n"
            "    from difflcs.rl.tasks import register_task\n    register_task(make_task('good'))\n",
            "raises": "def register():\n    raise RuntimeError('out of order')\n",
            "breaks": "import no_such_module_at_all\n"}  # fmt: skip


@pytest.mark.slow
def test_a_broken_entry_point_is_named_and_disturbs_no_other(tmp_path):
    for package, code in PACKAGES.items():
        (tmp_path / f"{package}_tasks.py").write_text(code)
        information = tmp_path / f"{package}_tasks-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}-tasks\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(f"[{ENTRY_POINTS}]\n{package} = {package}_tasks:register\n")
    code = (
        "from difflcs.rl.tasks import get_task, task_names\n"
        "assert get_task('good').name == 'good'; print(*task_names())\n"
        "try:\n    get_task('raises')\nexcept Exception as error:\n    print(error)\n"
    )
    path = os.pathsep.join([str(tmp_path), os.getcwd(), os.environ.get("PYTHONPATH", "")])
    done = python("-c", code, env={**os.environ, "PYTHONPATH": path})
    names, _, message = done.stdout.partition("\n")
    assert {"good", "cube"} <= set(names.split())
    assert "raises = raises_tasks:register could not be loaded: RuntimeError: out of order" in message
    assert "breaks = breaks_tasks:register could not be loaded: ModuleNotFoundError" in message
