"""LCS-RL with physics inside: what a task tells of its physics, the loss, what is refused, and that it learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from difflcs import rl
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError
from difflcs.physics import ContactLCS, PlanarPushing, PositionDrive, box
from difflcs.rl import ContactMethod, MujocoMethod, PhysicsFit, PhysicsFitSettings, PhysicsSpec, evaluate, get_task
from difflcs.rl.learning.physics_fit import physics_loss
from difflcs.rl.learning.trainer import configuration
from difflcs.rl.methods import Work
from tests.conformance.toy import Guess, Slide, make_task
from tests.conftest import F64, refuse

SCALE = torch.tensor([0.05, 0.05, 1.0, 0.2, 0.2], dtype=F64)


def pushing(**values):
    given = {"friction": 0.4, "compliance": 0.05, "drive": PositionDrive(0.8, 0.2), **values}
    return PlanarPushing(box(-0.03, 0.03, -0.02, 0.02), 0.01, **given)


def test_physics_is_found(build):
    lcs = ContactLCS(pushing(), ("friction", "gain", "drive_compliance"))
    x, u = 0.05 * build.normal(0)(40, 5), 0.01 * build.normal(1)(40, 2)
    x[:, 3] = -0.042
    true = pushing(friction=0.7, drive=PositionDrive(0.6, 0.5))
    x_next = true.params(x).step(x, u).x_next
    adam = torch.optim.Adam(lcs.parameters(), 0.05)
    for _ in range(150):
        adam.zero_grad()
        physics_loss(lcs, x, u, x_next, SCALE).backward()
        adam.step()
    found = lcs.summary()
    assert found["friction"][0] == pytest.approx(0.7, abs=0.07)
    assert found["gain"][0][0] == pytest.approx(0.6, abs=0.03)
    assert found["drive_compliance"][0][0] == pytest.approx(0.5, abs=0.1)


def test_a_description_of_physics_is_checked():
    for wrong, error in (
        ({"make_system": 3}, DTypeError),
        ({"make_cost": 3}, DTypeError),
        ({"scale": (1.0, 0.0)}, InvalidInputError),
        ({"horizon": 0}, InvalidInputError),
        ({"relaxation": -1.0}, InvalidInputError),
    ):
        refuse(error, next(iter(wrong)), PhysicsSpec, **{"make_system": lambda: None, "scale": (1.0,), **wrong})
    refuse(DTypeError, "physics: expected PhysicsSpec", make_task, physics=ContactLCS)


def test_the_policy_plans_with_what_the_description_says():
    task, method = make_task(), ContactMethod()
    spec = task.physics
    own = replace(task, physics=replace(spec, horizon=5, relaxation=0.01, make_cost=task.make_cost))
    for one, wanted in ((task, (task.horizon, 1e-3)), (own, (5, 0.01))):
        policy = method.policy(one, spec.make_system())
        assert (policy.horizon, policy.relaxation) == wanted


def test_a_task_without_physics_is_refused_and_its_place_stays_free(tmp_path):
    task, config = make_task(physics=None), rl.TrainConfig(task="toy", method=ContactMethod())
    refuse(InvalidInputError, "known physics, got toy without", rl.train, config, tmp_path, task=task)
    rl.RunDirectory.check_free(tmp_path)


def test_what_was_learned_of_another_object_is_refused():
    def task(width):
        guess = PlanarPushing(box(-width, width, -0.02, 0.02), 0.01, friction=0.4)
        return make_task(physics=PhysicsSpec(make_system=lambda: ContactLCS(guess), scale=(1.0,) * 5))

    learned = task(0.03).physics.make_system()
    state = {name: value + 0.1 for name, value in learned.state_dict().items()}
    method = ContactMethod()
    found = method.rebuild(task(0.03), configuration(learned), state, "here")
    torch.testing.assert_close(found.physics.friction.detach(), torch.tensor([0.4], dtype=F64) * torch.e**0.1)
    method.rebuild(task(0.03 + 1e-12), configuration(learned), state, "here")  # the rounding of another machine
    for other in (task(0.04), make_task()):
        with pytest.raises(CheckpointError, match="here: expected what is known of task toy"):
            method.rebuild(other, configuration(learned), state, "here")
    with pytest.raises(CheckpointError, match="expected tensors"):
        method.rebuild(task(0.03), configuration(learned), dict(list(state.items())[1:]), "here")
    broken = {**state, "change.friction": torch.full((1,), torch.nan, dtype=F64)}
    refuse(CheckpointError, "expected finite", method.rebuild, task(0.03), configuration(learned), broken, "here")


def test_it_learns_how_a_point_slides():
    task = make_task()
    envs = task.make_envs(5)
    trainer = ContactMethod(fit=PhysicsFitSettings(rollouts=5, learning_rate=0.1)).trainer(
        Work(task, 0, 10, task.make_envs)
    )
    assert isinstance(trainer, PhysicsFit)
    before = evaluate(envs, trainer.policy, 20, 3, 5).median_errors["position_error"]
    reports = [trainer.step() for _ in range(2)]
    guess = trainer.learned
    assert isinstance(guess, Guess)
    assert float(guess.gain.detach()) == pytest.approx(1.0, abs=0.02)
    assert float(guess.fade.detach()) == pytest.approx(0.5, abs=0.05)
    assert reports[-1].loss < 0.01 * reports[0].first_loss
    assert evaluate(envs, trainer.policy, 20, 3, 5).median_errors["position_error"] < before
    refuse(InvalidInputError, "all of them are done", trainer.step)
    trainer.env.close()
    envs.close()


RAIL = """<mujoco><option timestep=".01" gravity="0 0 0"/><worldbody><body>
  <joint name="rail" type="slide" axis="1 0 0" damping=".5" frictionloss="{}"/><geom size=".1" mass="{}"/></body>
  </worldbody><actuator><position joint="rail" kp="40" kv="6"/></actuator></mujoco>"""


class Rail(Slide):
    """The same task with a body on a rail, which a servo pulls against dry friction."""

    def move(self, action):
        import mujoco

        model = mujoco.MjModel.from_xml_string(RAIL.format(0.8, 2.0))
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = self.state
        data.ctrl[:] = self.state[:1] + action
        mujoco.mj_step(model, data, 3)
        return np.append(data.qpos, data.qvel)


def guess_rail():
    import mujoco

    from difflcs.physics.mujoco import LearnableMujocoLCS

    model = mujoco.MjModel.from_xml_string(RAIL.format(2.0, 1.0))
    return LearnableMujocoLCS(model, learn=["mass", "frictionloss"], motion="dynamic", seconds=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("simulated", [None, 30])
def test_a_mujoco_model_is_fitted_to_the_episodes_of_its_mpc(simulated):
    physics = PhysicsSpec(make_system=guess_rail, scale=(0.01, 0.2), relaxation=1e-3)
    task = make_task(env=Rail, physics=physics)
    how = {"simulated": simulated, "random": 1} if simulated else {"noise": 0.1, "steps": 25, "learning_rate": 0.1}
    fit = PhysicsFitSettings(rollouts=4, **how)
    trainer = MujocoMethod(fit=fit).trainer(Work(task, 0, 8, task.make_envs))
    for _ in range(2):
        trainer.step()
    found = trainer.learned.summary()
    assert found["mass *"] == pytest.approx([2.0], rel=1e-3 if simulated else 0.05)
    assert found["frictionloss *"] == pytest.approx([0.4], rel=1e-3 if simulated else 0.15)
    trainer.env.close()
    with pytest.raises(DTypeError, match="expected LearnableMujocoLCS, got Guess"):
        MujocoMethod().trainer(Work(make_task(), 0, 8, make_task().make_envs))


@pytest.mark.slow
def test_the_cube_is_pushed_before_anything_is_learned_and_after():
    task = get_task("cube")
    envs = task.make_envs(20)
    trainer = ContactMethod(fit=PhysicsFitSettings(rollouts=10, steps=30)).trainer(Work(task, 0, 10, task.make_envs))
    assert evaluate(envs, trainer.policy, 20, 5, task.episode_steps).successes >= 18  # a chance of 1e-3 at 0.97
    report = trainer.step()
    assert report.loss < report.first_loss
    assert evaluate(envs, trainer.policy, 20, 5, task.episode_steps).successes >= 18
    trainer.env.close()
    envs.close()
