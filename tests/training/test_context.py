"""Any `LCSModule` in warm-up and PPO, and a context on its way from the environment to model, loss and critic."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv
from tensordict import TensorDict

from difflcs import GoalCost, LCSModel, LCSMPCLayer, LCSSequence, rl
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError
from difflcs.rl import Adam, Epochs, Rollouts, ViolationLoss, Warmup, WarmupSettings, collect, fit, make_actor, make_ppo
from difflcs.rl.learning.ppo import PPO
from difflcs.rl.rollout import append_context, contexts, mpc_actions, transitions, uniform_actions
from difflcs.rl.runs.checkpoint import load_checkpoint, save_checkpoint
from tests.conftest import refuse
from tests.training import slide
from tests.training.slide import STEPS, U_MAX, Gain, Gains, parameters, recorded, same

LOSS = ViolationLoss(gamma="auto", xi=0.1)


def make_envs(count: int = 4) -> SyncVectorEnv:
    return SyncVectorEnv([Gains] * count)


def make_warmup(lcs: Any) -> Warmup:
    settings = WarmupSettings(rollouts=Rollouts(first=4, each=3), epochs=Epochs(20, 10, 20), noise=0.1, loss=LOSS)
    return Warmup(lcs, slide.make_mpc(lcs), make_envs(), settings, 0, STEPS)


def features(state, goal, elapsed, context):
    return torch.cat([slide.features(state, goal, elapsed), context], -1)


def make_trainer(lcs: Any, iterations: int = 4, **changes: Any) -> PPO:
    options = {"features": features}
    changes = {"controller": slide.make_mpc(lcs), "violation": LOSS, **changes}
    return slide.make_ppo(0, iterations, make_envs(slide.ROLLOUTS), options=options, **changes)


# --- learning ---------------------------------------------------------------------------------------------------------


def test_the_violation_loss_beside_ppo_gets_the_context():
    """Eq. 7 with β = 0 is the violation loss alone, which finds the true effect."""
    adam = Adam(learning_rate=0.02, betas=(0.9, 0.99))
    lcs = Gain()
    trainer = make_trainer(
        lcs, iterations=2, beta=0.0, std=0.1, steps=60, minibatch=None, update="adam", adam=adam, max_kl=100.0
    )
    while not trainer.done:
        trainer.step()
    assert float(lcs.effect.detach()) == pytest.approx(1.0, abs=0.05)


# --- the way of a context ---------------------------------------------------------------------------------------------


def test_each_part_of_ppo_sees_the_context_of_its_own_sample():
    trainer = make_trainer(Gain(), steps=2, minibatch=30)
    seen, solved = recorded(trainer), []
    trainer.actor.gaussian.register_forward_hook(lambda _, inputs, __: solved.append(inputs[0].clone()))
    cold = slide.make_mpc(Gain())
    trainer.step()
    episodes, inputs, _, _ = seen.call_args.args
    context = episodes["context"].unsqueeze(1).expand(-1, STEPS + 1, -1)
    assert len(context.unique()) == slide.ROLLOUTS
    assert torch.equal(inputs[..., -1:], context)
    data = episodes["policy"].flatten(0, 1)
    assert torch.equal(data["context"], context[:, 1:].flatten(0, 1))
    with torch.no_grad():
        expected = cold(data["state"], data["goal"], context=data["context"]).action
    torch.testing.assert_close(data["loc"], expected, rtol=0, atol=1e-9)
    of_goal = dict(zip(episodes["goal"].squeeze(-1).tolist(), episodes["context"].squeeze(-1).tolist(), strict=True))
    for batch in solved:
        assert [of_goal[goal] for goal in batch["goal"].squeeze(-1).tolist()] == batch["context"].squeeze(-1).tolist()


def test_a_context_that_changes_is_refused():
    env = SyncVectorEnv([lambda: Gains(drifts=True)] * 2)
    with pytest.raises(InvalidInputError, match="same context in a whole episode, got another in step 1"):
        collect(env, mpc_actions(slide.make_mpc(Gain())), [1, 2], STEPS)


# --- the Jacobian -----------------------------------------------------------------------------------------------------


class Plain(LCSModel):
    """An `LCSModel` that nobody knows to be one."""

    def params(self, x=None, context=None):
        return super().params(x, context)


class Stages(Plain):
    """The same system at each stage, by stage."""

    def params(self, x=None, context=None):
        return LCSSequence.stack([super().params(x, context)] * 3)


@pytest.mark.parametrize("kind", [Plain, Stages])
def test_any_module_has_the_jacobian_of_a_model(kind):
    lcs = slide.make_model()
    other = kind(1, 1, 1, learn_c=False)
    other.load_state_dict(lcs.state_dict())
    actors = [make_actor(slide.make_mpc(module), slide.small_settings().std) for module in (lcs, other)]
    data = slide.drawn(actors[0], 20)
    wanted, found = (actor.jacobian(data) for actor in actors)
    assert bool(wanted.any())
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


def test_jacobian_of_a_system_for_each_sample():
    """Against central differences of the planned action, over more samples than are differentiated together."""
    lcs = Gain(wall=0.0)
    actor = make_actor(slide.make_mpc(lcs), 0.5, "full")
    with torch.no_grad():
        actor.gaussian.log_std.fill_(np.log(0.25))
    generator = torch.Generator().manual_seed(0)
    state, goal, context = (torch.rand(20, 1, generator=generator, dtype=torch.float64) for _ in range(3))
    data = TensorDict({"state": 0.3 * state - 0.2, "goal": 0.4 * goal - 0.3, "context": context}, [20])
    actor.act(data)
    data["guess"] = data["plan"].clone()
    found = actor.jacobian(data)
    columns = []
    for p in lcs.parameters():
        for i in range(p.numel()):
            ends = []
            for step in (1e-5, -1e-5):
                with torch.no_grad():
                    p.view(-1)[i] += step
                    ends.append(actor.mpc(data["state"], data["goal"], context=data["context"]).action)
                    p.view(-1)[i] -= step
            columns.append((ends[0] - ends[1]) / 2e-5 / 0.25)
    inside = (data["loc"].abs() < 0.99 * U_MAX).squeeze(-1)
    assert int(inside.sum()) > 5
    assert int((data["plan", "lam"].amax((1, 2)) > 1e-3).sum()) > 5
    assert bool(found[inside].any())
    torch.testing.assert_close(found[inside], torch.stack(columns, -1)[inside], rtol=1e-3, atol=1e-3)


# --- resuming ---------------------------------------------------------------------------------------------------------


class Tied(Gain):
    """One parameter under two names."""

    def __init__(self):
        super().__init__()
        self.again = self.effect


def test_tied_parameters_are_saved(tmp_path):
    first, second = make_warmup(Tied()), make_warmup(Tied())
    first.step()
    save_checkpoint(tmp_path, first.iteration, first.state_dict())
    second.load(load_checkpoint(tmp_path))
    assert same(parameters(first), parameters(second))
    assert len(list(second.learned.parameters())) == 3  # pyright: ignore[reportAttributeAccessIssue]


def test_load_refuses_another_module():
    state = make_warmup(Gain()).state_dict()
    assert state["learned"]["settings"] == {"class": "Gain", "n_x": 1, "n_u": 1, "n_lam": 1}
    refuse(CheckpointError, "other settings", make_warmup(Tied()).load, state)


# --- bad input --------------------------------------------------------------------------------------------------------


class Nothing(Gain):
    """No parameter that requires a gradient."""

    def __init__(self):
        super().__init__()
        self.requires_grad_(False)


class Detached(Gain):
    """Its system does not depend on its parameters."""

    def params(self, x=None, context=None):
        return super().params(x, context).detach()


class Wide(Gain):
    """Sizes of another environment."""

    n_u = 2


class NotAModule:
    """An `LCSModule`, but no `torch.nn.Module`."""

    n_x, n_u, n_lam = 1, 1, 1
    params = Gain.params


FIXED = LCSModel(1, 1, 1).params().detach()
BAD = [
    (Nothing(), InvalidInputError, "parameter that requires a gradient in Nothing, got 3"),
    (FIXED, InvalidInputError, "got fixed LCSParams"),
    (NotAModule(), DTypeError, r"torch\.nn\.Module with n_x, n_u, n_lam and params"),
]


def slide_warmup(lcs: Any) -> Warmup:
    settings = WarmupSettings(rollouts=Rollouts(2, 2), epochs=Epochs(2, 2, 20), loss=LOSS)
    return Warmup(lcs, None, make_envs(2), settings, 0, STEPS)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("lcs", "error", "message"), BAD)
def test_what_cannot_be_learned_is_refused(lcs, error, message):
    for make in (slide_warmup, make_trainer, lambda module: make_trainer(module, update="adam")):
        refuse(error, message, make, lcs)


def test_other_sizes_than_the_environments_are_refused():
    refuse(InvalidInputError, r"lcs: expected n_x=1, n_u=1 like the states .* n_u=2 of Wide", slide_warmup, Wide())
    settings, mpc = slide.small_settings(), LCSMPCLayer(LCSModel(2, 1, 1), GoalCost.reach(2, 1), 3, -1.0, 1.0)
    with pytest.raises(InvalidInputError, match=r"actor: expected n_x=1, n_u=1 .* got n_x=2"):
        make_ppo(make_actor(mpc, settings.std), make_envs(12), settings, 0, features=features, total_episodes=12)


@pytest.mark.parametrize("update", ["natural", "adam"])
def test_a_system_without_gradient_is_refused(update):
    refuse(InvalidInputError, "depends on the module's parameters", slide_warmup(Detached()).step)
    refuse(InvalidInputError, "depends on the module's parameters", make_trainer(Detached(), update=update).step)


def test_a_sequence_is_no_system_of_transitions():
    x = torch.zeros(4, 1, dtype=torch.float64)
    with pytest.raises(DTypeError, match=r"expected LCSParams, .*; transitions have no stages"):
        fit(Stages(1, 1, 1), x, x, x, WarmupSettings(), 1, np.random.default_rng(0))


# --- a task with a context --------------------------------------------------------------------------------------------


TASK = rl.TaskSpec(
    name="gains",
    env=Gains,
    make_cost=lambda: GoalCost.reach(1, 1, goal_weight=(1.0,), input_weight=0.1),
    u_min=-U_MAX,
    u_max=U_MAX,
    horizon=3,
    episode_steps=STEPS,
    step_seconds=0.2,
    n_context=1,
    features=lambda state, goal, elapsed, context: torch.cat([slide.features(state, goal, elapsed), context], -1),
    outcome=slide.outcome,
    physics=rl.PhysicsSpec(make_system=Gain, scale=(1.0,)),
)


@pytest.mark.parametrize(
    # lcs-rl is violation and ppo, one after the other; the physics of this task is no MuJoCo model.
    "method",
    sorted(
        method.name
        for method in map(rl.get_method, {*rl.method_names()} - {"violation", "ppo", "mujoco-lcs"})
        if method.__module__.startswith("difflcs.")  # examples register methods of their own
    ),
)
def test_every_method_trains_a_task_with_a_context(method, tmp_path):
    config = replace(rl.TrainConfig(task="gains", method=rl.get_method(method)()).smoke(), minutes=0.6)
    run = rl.train(config, tmp_path / "run", task=TASK)
    policy = rl.load_policy(run, TASK)
    envs = TASK.make_envs(4)
    again = rl.evaluate(envs, policy, 4, 0, STEPS)
    assert again.success_rate == pytest.approx(float(run.rows()[-1]["evaluation_success_rate"]))


def test_networks_see_the_context():
    """Model rollouts have the context of their start, and predict by it."""
    env = TASK.make_envs(40)
    rng = np.random.default_rng(0)
    episodes, unseen = (
        rl.collect(env, uniform_actions(env, rng), range(first, first + 40), STEPS) for first in (0, 100)
    )
    ensemble = rl.EnsembleSettings(networks=1, width=32, epochs=rl.Epochs(80, 3, 64))
    models = rl.ModelRollouts(env, slide.outcome, rl.ModelRolloutSettings(rollouts=10, ensemble=ensemble), 0, STEPS)
    models.add(episodes)
    models.fit()
    start, _ = models.env.reset(seed=3)
    known = {tuple(x): c for x, c in zip(episodes["state"][:, 0].tolist(), episodes["context"].tolist(), strict=True)}
    assert [known[tuple(x)] for x in start["state"].tolist()] == start["context"].tolist()

    actions = rng.uniform(-U_MAX, U_MAX, (10, 1))
    after, _, _, _, _ = models.env.step(actions)
    np.testing.assert_array_equal(after["context"], start["context"])
    before, taken = torch.from_numpy(start["state"]).unsqueeze(1), torch.from_numpy(actions)[:, None, None]
    seen = [v.expand(-1, STEPS, *v.shape[2:]) for v in (before, taken)]
    foreseen, _, _ = models.env.predict_alternatives(*seen, torch.from_numpy(start["goal"]))
    np.testing.assert_allclose(foreseen[:, 0, 0], after["state"], rtol=0, atol=1e-6)

    (x, u, x_next), context = transitions(unseen), contexts(unseen)
    errors = []
    for given in (context, context.flip(0)):
        with torch.no_grad():
            found = models.ensemble(append_context(x, given).float().unsqueeze(0), u.float().unsqueeze(0))[0, :, :1]
        errors.append(float((found - x_next).square().mean().sqrt()))
    assert errors[0] < 0.5 * errors[1]
