"""A task with a context, by the common code of all trainings."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from difflcs import GoalCost, rl
from difflcs.rl.rollout import append_context, contexts, transitions, uniform_actions
from tests.training import slide
from tests.training.slide import STEPS, U_MAX, Gain, Gains

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
    assert context is not None
    errors = []
    for given in (context, context.flip(0)):
        with torch.no_grad():
            found = models.ensemble(append_context(x, given).float().unsqueeze(0), u.float().unsqueeze(0))[0, :, :1]
        errors.append(float((found - x_next).square().mean().sqrt()))
    assert errors[0] < 0.5 * errors[1]
