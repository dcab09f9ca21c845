"""PPO through the MPC, on a small pushing system that needs no simulator."""

import math
from dataclasses import asdict, replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from difflcs import GoalCost, LCSModel, LCSMPCLayer
from difflcs.errors import CheckpointError, InvalidInputError

pytest.importorskip("torchrl")
from difflcs.rl.checkpoint import load_checkpoint, save_checkpoint
from difflcs.rl.evaluate import evaluate
from difflcs.rl.imagination import Imagination, ImaginationConfig
from difflcs.rl.phases import LCSRL
from difflcs.rl.policy import make_actor
from difflcs.rl.ppo import PPO, PPOConfig, _Effort, _trimmed_mean
from difflcs.rl.rollout import episode_seeds
from difflcs.rl.warmup import TRAINING_STREAM, Warmup, WarmupConfig

pytestmark = pytest.mark.usefixtures("one_thread")

STEPS = 6
U_MAX = 0.1
ROLLOUTS = 12


class Slide(gymnasium.Env):
    """x₊ = x + gain·u: what a model with another B must find out."""

    observation_space = spaces.Dict(
        {"state": spaces.Box(-10.0, 10.0, (1,), np.float64), "goal": spaces.Box(-1.0, 1.0, (1,), np.float64)}
    )
    action_space = spaces.Box(-U_MAX, U_MAX, (1,), np.float64)

    def __init__(self, breaks_at: int | None = None, reward: float | None = None):
        self.breaks_at, self.reward = breaks_at, reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.state, self.goal = 0, np.zeros(1), self.np_random.uniform(-0.3, 0.3, 1)
        return {"state": self.state.copy(), "goal": self.goal.copy()}, {}

    def step(self, action):
        error = float(abs(self.state - self.goal)[0])
        self.state = self.state + 0.5 * np.asarray(action)
        self.steps += 1
        broken = self.steps == self.breaks_at
        success = float(abs(self.state - self.goal)[0]) < 0.05
        last = self.steps >= STEPS
        completion = -10.0 * (last and not success)
        info = {"success": success, "physics_error": broken, "reward_completion": completion}
        reward = -20 * error + completion if self.reward is None else self.reward
        return {"state": self.state.copy(), "goal": self.goal.copy()}, reward, False, last or broken, info


def make_envs(count: int = ROLLOUTS, **kwargs) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Slide(**kwargs)] * count)


def features(state, goal, elapsed):
    return torch.cat([10 * (state - goal), 10 * (state - goal).abs(), elapsed.unsqueeze(-1)], -1)


def make_model(seed: int = 0) -> LCSModel:
    """x₊ = 0.97 x + 0.1 u: the effect of an action is underestimated five times, so that the MPC hardly acts."""
    lcs = LCSModel(1, 1, 1, init_scale=0.01, learn_c=False, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        lcs.A.fill_(0.97)
        lcs.B.fill_(0.1)
    return lcs


def make_mpc(lcs: LCSModel) -> LCSMPCLayer:
    cost = GoalCost.reach(1, 1, goal_weight=(1.0,), input_weight=3.0)
    return LCSMPCLayer(lcs, cost, horizon=3, u_min=-U_MAX, u_max=U_MAX, on_failure="mask")


def small_config(**changes) -> PPOConfig:
    return replace(PPOConfig(rollouts=ROLLOUTS, steps=4, std=0.03, value_first_epochs=10, value_epochs=3), **changes)


def make_ppo(seed: int = 0, iterations: int = 4, env=None, **changes) -> PPO:
    env = make_envs() if env is None else env
    total = iterations * ROLLOUTS
    config = small_config(**changes)
    return PPO(
        make_actor(make_mpc(make_model()), config),
        env,
        config,
        seed,
        features=features,
        total_episodes=total,
        episode_steps=STEPS,
    )


def collected(trainer: PPO):
    """Episodes of the seeds that the next iteration will use."""
    return trainer._collect(trainer.env, episode_seeds(trainer.seed, TRAINING_STREAM, 0, ROLLOUTS))


def parameters(trainer) -> list[torch.Tensor]:
    return [value.clone() for value in trainer.lcs.state_dict().values()]


def same(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


# --- learning ---


def test_ppo_learns():
    """From a model whose MPC hardly moves to one that reaches its goals."""
    lcs, env = make_model(), make_envs(40)
    config = small_config(
        rollouts=40, steps=10, learning_rate=0.02, std=0.04, target_kl=0.2, max_kl=0.6, value_first_epochs=60
    )
    actor = make_actor(make_mpc(lcs), config)
    trainer = PPO(actor, env, config, 0, features=features, total_episodes=320, episode_steps=STEPS)
    before = evaluate(env, trainer.policy, 60, 0, STEPS).success_rate
    reports = []
    while not trainer.done:
        reports.append(trainer.step())
    assert before < 0.35
    assert evaluate(env, trainer.policy, 60, 0, STEPS).success_rate > before + 0.4
    assert reports[-1].mean_return > reports[0].mean_return + 5
    assert reports[-1].env_steps == trainer.env_steps == 320 * STEPS
    assert all(report.solver_failures == 0 for report in reports)
    assert all(report.kl > 0 for report in reports)
    assert reports[0].explained_variance > 0.3
    with pytest.raises(InvalidInputError, match="all of them are done"):
        trainer.step()


def test_the_policy_explores_and_the_environment_gets_clipped_actions():
    trainer = make_ppo(std=0.2)
    rollouts, data, *_ = collected(trainer)
    noise = (data["action"] - data["loc"]).flatten()
    assert float(noise.std()) == pytest.approx(0.2, rel=0.2)
    torch.testing.assert_close(rollouts.actions, data["action"].clamp(-U_MAX, U_MAX))
    assert bool((data["action"].abs() > U_MAX).any())


def test_rewards_are_limited_and_end_with_the_penalty():
    trainer = make_ppo(cost_limit=1.0, failure_penalty=7.0, reward_scale=0.5)
    trainer.actor.set_std(0.1)
    rollouts, *_ = collected(trainer)
    rewards = trainer._rewards(rollouts)
    raw = -20 * (rollouts.states[:, :-1] - rollouts.goals.unsqueeze(1)).abs().squeeze(-1)
    expected = 0.5 * raw.clamp_min(-1.0)
    expected[:, -1] -= 0.5 * 7.0 * (~rollouts.success).double()
    torch.testing.assert_close(rewards, expected)
    assert bool((raw < -1).any())
    assert bool((~rollouts.success).any())


def test_advantages_are_the_papers():
    """Eq. adv_func written out, with a value of zero at the end of an episode."""
    trainer = make_ppo(gamma=0.9, zeta=0.8)
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(5, STEPS + 1, 3, generator=generator, dtype=torch.float64)
    rewards = torch.randn(5, STEPS, generator=generator, dtype=torch.float64)
    value = trainer.critic.network(inputs.float()).detach().double().squeeze(-1)
    value[:, -1] = 0
    delta = rewards + 0.9 * value[:, 1:] - value[:, :-1]
    expected = torch.zeros(5, STEPS, dtype=torch.float64)
    for t in range(STEPS):
        expected[:, t] = sum((0.9 * 0.8) ** k * delta[:, t + k] for k in range(STEPS - t))
    found = trainer.critic.advantages(inputs, rewards)
    torch.testing.assert_close(found["advantage"].squeeze(-1), expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(found["value_target"].squeeze(-1), expected + value[:, :-1], rtol=1e-5, atol=1e-5)
    returns = trainer.critic.returns(rewards)
    torch.testing.assert_close(returns[:, 0], sum(0.9**k * rewards[:, k] for k in range(STEPS)))


def prepared(trainer: PPO):
    """Data of one iteration, as `_improve` gets it."""
    rollouts, data, *_ = collected(trainer)
    data["advantage"] = trainer.critic.advantages(trainer._inputs(rollouts), trainer._rewards(rollouts))["advantage"]
    return data.flatten(0, 1), rollouts


def improve(trainer: PPO, data, rollouts):
    config = trainer.config
    return trainer._improve(data, rollouts, _Effort(config.steps, config.minibatch, config.value_epochs), 1.0)


def test_the_first_gradient_is_the_policy_gradient():
    """At the rollout's own parameters all ratios are 1: the gradient is that of −mean(A log π)."""
    trainer = make_ppo(steps=1)
    data, rollouts = prepared(trainer)
    outcome = improve(trainer, data, rollouts)
    found = [p.grad.clone() for p in trainer.lcs.parameters() if p.grad is not None]
    assert outcome.kl == pytest.approx(0, abs=1e-12)
    assert outcome.clip_fraction == 0

    lcs = make_model()  # the parameters before the step
    mean = make_mpc(lcs)(data["state"], data["goal"]).action
    log_prob = -0.5 * ((data["action"] - mean) / trainer.config.std).square().sum(-1)
    advantage = data["advantage"].squeeze(-1)
    advantage = (advantage - advantage.mean()) / advantage.std(correction=0)
    (-(advantage * log_prob).mean()).backward()
    expected = [p.grad for p in lcs.parameters() if p.grad is not None]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-8)
    assert any(bool(grad.any()) for grad in found)


def test_jumps_are_left_out():
    """Samples whose mean has moved too far have no say, however large their advantage."""
    trainer = make_ppo(steps=1, kl_quantile=1.0)
    data, rollouts = prepared(trainer)
    data["loc"][:5] += 1.0
    outcome = improve(trainer, data, rollouts)
    assert outcome.ignored == 5 / len(data)
    found = [p.grad.clone() for p in trainer.lcs.parameters() if p.grad is not None]
    other = make_ppo(steps=1, kl_quantile=1.0)
    again, rollouts = prepared(other)
    advantage = again["advantage"]
    keep = (advantage - advantage.mean()) / advantage.std(correction=0)
    keep[:5] = 0  # what the jumps are replaced by; the normalisation comes before
    mean = other.policy(again["state"], again["goal"]).action
    log_prob = -0.5 * ((again["action"] - mean) / other.config.std).square().sum(-1)
    (-(keep.squeeze(-1) * log_prob).mean()).backward()
    expected = [p.grad for p in other.lcs.parameters() if p.grad is not None]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-8)


def test_long_gradients_of_single_samples_are_clipped():
    """Against a loop over the samples; the deviation's gradient and the violation loss are not clipped."""
    options = {"steps": 1, "learn_std": True, "beta": 0.7, "violation_batch": 1000}
    trainer = make_ppo(sample_clip=1.5, **options)
    data, rollouts = prepared(trainer)
    improve(trainer, data, rollouts)
    found = {name: p.grad.clone() for name, p in trainer.lcs.named_parameters() if p.grad is not None}

    other = make_ppo(**options)
    advantage = data["advantage"].squeeze(-1)
    advantage = (advantage - advantage.mean()) / advantage.std(correction=0)
    parameters = {name: p for name, p in other.lcs.named_parameters() if p.requires_grad}
    gradients = []
    for i in range(len(data)):
        mean = other.policy(data["state"][i], data["goal"][i]).action
        log_prob = -0.5 * ((data["action"][i] - mean) / other.config.std).square().sum()
        loss = -0.7 * advantage[i] * log_prob / len(data)
        gradients.append(torch.autograd.grad(loss, parameters.values(), allow_unused=True, materialize_grads=True))
    lengths = torch.stack([torch.cat([g.flatten() for g in sample]).norm() for sample in gradients])
    limit = 1.5 * lengths[lengths > 0].median()
    factors = (limit / lengths).clamp_max(1.0)
    assert 0 < int((factors < 1).sum()) < len(data) // 2
    (0.3 * other._violation(rollouts, np.random.default_rng(0))).backward()
    for k, (name, p) in enumerate(parameters.items()):
        clipped = sum(factor * sample[k] for factor, sample in zip(factors, gradients, strict=True))
        torch.testing.assert_close(found[name], clipped + p.grad, rtol=1e-5, atol=1e-8)
    improve(other, data, rollouts)
    # One model for all samples or a copy for each: the same mathematics, by other products of matrices.
    stds = [t.actor.gaussian.log_std.grad for t in (trainer, other)]
    torch.testing.assert_close(*stds, rtol=1e-9, atol=0)
    assert any(not torch.allclose(found[name], p.grad, rtol=1e-2) for name, p in parameters.items())


def test_a_limit_that_no_sample_reaches_changes_nothing():
    limited, free = make_ppo(sample_clip=1e9), make_ppo()
    for trainer in (limited, free):
        trainer.step()
    for a, b in zip(parameters(limited), parameters(free), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("size", "sizes"), [(None, [72, 72, 72]), (30, [30, 30, 12]), (100, [72, 72, 72])])
def test_minibatches(size, sizes):
    """Every sample once before any is drawn again, each from its own last plan."""
    trainer = make_ppo(steps=3, minibatch=size, max_kl=100.0, natural=False)
    data, rollouts = prepared(trainer)
    seen = []
    trainer.actor.gaussian.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0].clone()))
    assert improve(trainer, data, rollouts).steps == 3
    assert [len(batch) for batch in seen] == sizes
    states = torch.cat([batch["state"] for batch in seen]).sort(0).values[:: 3 if sizes[0] == 72 else 1]
    torch.testing.assert_close(states, data["state"].sort(0).values, rtol=0, atol=0)
    for batch in seen:  # a guess belongs to its state
        torch.testing.assert_close(batch["guess", "x"][:, 0], batch["state"], rtol=0, atol=1e-9)


def test_trimmed_mean():
    assert _trimmed_mean(torch.tensor([17.0, 1.0, 2.0, 3.0]), 0.75) == 2.0
    assert _trimmed_mean(torch.tensor([17.0]), 0.5) == 17.0


@pytest.mark.parametrize(("kl", "factor"), [(0.04, 1.5), (0.06, 1.0), (0.14, 1.0), (0.16, 1 / 1.5), (math.nan, 1.0)])
def test_step_size_follows_the_kl(kl, factor):
    trainer = make_ppo()
    assert trainer._adapt(kl) == pytest.approx(factor * trainer.learning_rate)


def test_an_iteration_ends_at_the_kl_limit():
    trainer = make_ppo(max_kl=1e-6)
    data, rollouts = prepared(trainer)
    outcome = improve(trainer, data, rollouts)
    assert outcome.steps == 1
    assert outcome.kl > 1e-6


def test_steps_are_annealed():
    trainer = make_ppo(iterations=3, steps=1, final_step=0.1, learning_rate_factor=1.0)
    rates = []
    while not trainer.done:
        trainer.step()
        rates.append(trainer._optimiser.param_groups[0]["lr"] / trainer.config.natural_step)
    assert rates == pytest.approx([1.0, 0.7, 0.4])


def test_combined_loss():
    """Eq. total_loss: β = 0 is the violation loss alone, which learns the true gain; β = 1 ignores it."""
    gains = {}
    for beta in (0.0, 0.5):
        settings = {"steps": 50, "minibatch": None, "natural": False, "learning_rate": 0.02, "max_kl": 100.0}
        trainer = make_ppo(iterations=2, beta=beta, std=0.1, **settings)
        while not trainer.done:
            trainer.step()
        gains[beta] = abs(float(trainer.lcs.B.detach()) - 0.5)
    assert gains[0.0] < 0.15 < abs(0.1 - 0.5)
    calls = []
    trainer = make_ppo()
    trainer._violation = lambda *_: calls.append(1)
    trainer.step()
    assert calls == []


def test_a_gradient_that_is_not_finite_changes_nothing():
    trainer = make_ppo()
    data, rollouts = prepared(trainer)
    data["advantage"][3] = math.nan
    before = parameters(trainer)
    outcome = improve(trainer, data, rollouts)
    assert (outcome.steps, outcome.skipped) == (0, trainer.config.steps)
    assert same(before, parameters(trainer))


def test_learned_and_annealed_deviation():
    learned = make_ppo(learn_std=True, covariance="diagonal", std_learning_rate=0.5, std_range=(0.029, 0.031))
    learned.step()
    std = float(learned.actor.std)
    assert std != 0.03
    assert 0.029 - 1e-12 <= std <= 0.031 + 1e-12
    annealed = make_ppo(iterations=3, final_std=0.003)
    seen = []
    while not annealed.done:
        seen.append(annealed.step().std)
    assert seen == pytest.approx([0.03, 0.03 * 0.1 ** (1 / 3), 0.03 * 0.1 ** (2 / 3)])


def test_the_budget_is_met_exactly():
    actor = make_actor(make_mpc(make_model()), small_config())
    for total in (ROLLOUTS - 5, 2 * ROLLOUTS + 1, 3 * ROLLOUTS):
        trainer = PPO(
            actor, make_envs(), small_config(), 0, features=features, total_episodes=total + 7,
            episode_steps=STEPS, first_episode=7,
        )  # fmt: skip
        assert sum(trainer._sizes) == total
        assert max(trainer._sizes) <= ROLLOUTS
        assert max(trainer._sizes) - min(trainer._sizes) <= 1


# --- robustness ---


def test_broken_episodes_are_dropped():
    env = SyncVectorEnv([lambda: Slide(breaks_at=3), *[Slide] * (ROLLOUTS - 1)])
    trainer = make_ppo(env=env)
    report = trainer.step()
    assert report.unstable == 1
    assert len(trainer.critic.history[0][1]) == ROLLOUTS - 1
    assert all(bool(torch.isfinite(p).all()) for p in parameters(trainer))
    with pytest.raises(InvalidInputError, match="stable simulation"):
        make_ppo(env=make_envs(breaks_at=2)).step()


def test_rewards_that_are_not_finite_are_refused():
    with pytest.raises(InvalidInputError, match="finite rewards"):
        make_ppo(env=make_envs(reward=math.nan)).step()


def test_resumed_equals_uninterrupted_bitwise(tmp_path):
    options = {"learn_std": True, "covariance": "diagonal", "beta": 0.7}
    through = make_ppo(**options)
    while not through.done:
        through.step()
    first = make_ppo(**options)
    for _ in range(2):
        first.step()
    save_checkpoint(tmp_path, first.checkpoint())
    first.step()  # lost by the crash

    second = make_ppo(**options)
    second.restore(load_checkpoint(tmp_path))
    torch.manual_seed(7)  # the global generator must not matter
    state = torch.random.get_rng_state()
    while not second.done:
        second.step()
    assert torch.equal(state, torch.random.get_rng_state())  # nor be touched
    assert same(parameters(through), parameters(second))
    for name, value in through._tensors().items():
        assert torch.equal(value, second._tensors()[name]), name
    assert through.learning_rate == second.learning_rate


def test_seeds_differ_and_repeat():
    runs = [make_ppo(seed) for seed in (0, 0, 1)]
    for trainer in runs:
        trainer.step()
    assert same(parameters(runs[0]), parameters(runs[1]))
    assert not same(parameters(runs[0]), parameters(runs[2]))


@pytest.mark.parametrize("make", ["make_ppo", "make_lcsrl", "make_imagining"])
def test_restore_refuses_hostile_checkpoints(refuses_hostile_checkpoints, make):
    refuses_hostile_checkpoints(globals()[make]())


def test_restore_refuses_what_does_not_fit():
    trainer = make_ppo()
    trainer.step()
    checkpoint = trainer.checkpoint()
    other = make_ppo(value_width=8)
    before = parameters(other)
    with pytest.raises(CheckpointError, match=r"value\.0\.bias.*other settings"):
        other.restore(checkpoint)
    with pytest.raises(CheckpointError, match="counters"):
        trainer.restore(replace(checkpoint, state={**checkpoint.state, "episodes": -1}))
    with pytest.raises(CheckpointError, match="starts after 0 episodes"):
        trainer.restore(replace(checkpoint, state={**checkpoint.state, "first_episode": 3}))
    with pytest.raises(CheckpointError, match="history"):
        trainer.restore(replace(checkpoint, state={**checkpoint.state, "history": [1]}))
    assert same(before, parameters(other))
    assert other.iteration == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rollouts": 0}, "rollouts"),
        ({"learning_rate": -1.0}, "learning_rate"),
        ({"beta": 1.5}, "beta"),
        ({"kl_quantile": 0.0}, "kl_quantile"),
        ({"std": 0.0}, "std"),
        ({"std_range": (0.2, 0.1)}, "std_range"),
        ({"covariance": "full"}, "learn_std"),
        ({"final_std": 0.1, "learn_std": True}, "final_std"),
        ({"learning_rate_factor": 0.5}, "learning_rate_factor"),
        ({"minibatch": 0}, "minibatch"),
        ({"sample_clip": 0.0}, "sample_clip"),
    ],
)
def test_bad_settings_are_refused(change, message):
    with pytest.raises(InvalidInputError, match=message):
        PPOConfig(**change)


def test_bad_arguments_are_refused():
    options = {"features": features, "total_episodes": 20, "episode_steps": STEPS}
    mpc, config = make_mpc(make_model()), small_config()
    actor = make_actor(mpc, config)
    with pytest.raises(InvalidInputError, match="at least 12 environments, got 3"):
        PPO(actor, make_envs(3), config, 0, **options)
    with pytest.raises(InvalidInputError, match="use an LCSModel"):
        PPO(make_actor(make_mpc(mpc.lcs.params().detach()), config), make_envs(), config, 0, **options)
    with pytest.raises(InvalidInputError, match="learn_std=True"):
        PPO(actor, make_envs(), replace(config, learn_std=True), 0, **options)
    with pytest.raises(InvalidInputError, match="shorten the warm-up"):
        PPO(actor, make_envs(), config, 0, **options, first_episode=20)


# --- both phases ---


def make_lcsrl(seed: int = 0, imagine: bool = False) -> LCSRL:
    lcs = make_model()
    mpc = make_mpc(lcs)
    config = WarmupConfig(
        random_rollouts=2, rollouts_per_iteration=3, noise=0.02, first_epochs=3, epochs=2, minibatch=8
    )
    warmup = Warmup(lcs, mpc, make_envs(3), config, seed, STEPS)

    def make_main(first_episode: int, first_iteration: int) -> PPO:
        settings = ImaginationConfig(iterations=1, rollouts=5, networks=2, width=8, first_epochs=2)
        return PPO(
            make_actor(mpc, small_config()), make_envs(), small_config(), seed, features=features,
            total_episodes=8 + 2 * ROLLOUTS, episode_steps=STEPS, first_episode=first_episode,
            first_iteration=first_iteration,
            imagination=Imagination(make_envs(), reaches, settings, seed, STEPS) if imagine else None,
        )  # fmt: skip

    return LCSRL(warmup, 8 * STEPS, make_main)


def test_phases_follow_each_other():
    trainer = make_lcsrl()
    reports = [trainer.step() for _ in range(5)]
    assert [type(report).__name__ for report in reports] == ["Iteration"] * 3 + ["PPOIteration"] * 2
    assert [report.iteration for report in reports] == [1, 2, 3, 4, 5]
    assert [report.env_steps for report in reports] == [STEPS * n for n in (2, 5, 8, 8 + ROLLOUTS, 8 + 2 * ROLLOUTS)]


@pytest.mark.parametrize("imagine", [False, True])
@pytest.mark.parametrize("after", [1, 3, 4])
def test_phases_resume_bitwise(tmp_path, after, imagine):
    """Interrupted in the warm-up, right between the phases, and in the main phase."""
    through = make_lcsrl(imagine=imagine)
    for _ in range(5):
        through.step()
    first = make_lcsrl(imagine=imagine)
    for _ in range(after):
        first.step()
    save_checkpoint(tmp_path, first.checkpoint())
    second = make_lcsrl(imagine=imagine)
    second.restore(load_checkpoint(tmp_path))
    assert second.iteration == after
    for _ in range(5 - after):
        second.step()
    assert same(parameters(through), parameters(second))


def test_phases_refuse_a_foreign_checkpoint():
    trainer = make_lcsrl()
    checkpoint = trainer.checkpoint()
    with pytest.raises(CheckpointError, match="another method"):
        trainer.restore(replace(checkpoint, state={"episodes": 3}))


def test_every_setting_is_documented():
    """`difflcs train --help` shows the docstring below each field."""
    import inspect

    source = inspect.getsource(PPOConfig)
    for name in asdict(PPOConfig()):
        line = source.index(f"    {name}: ")
        assert source[line:].split("\n")[1].strip().startswith('"""'), name


# --- imagined episodes ---


def reaches(state, action, after, goal):
    """`Slide`'s outcome."""
    return -20 * (state - goal).abs().squeeze(-1), (after - goal).abs().squeeze(-1) < 0.05


def make_imagining(seed: int = 0, **changes) -> PPO:
    config, env = small_config(), make_envs()
    settings = ImaginationConfig(iterations=2, rollouts=10, networks=2, width=16, first_epochs=20, epochs=3)
    settings = replace(settings, **changes)
    return PPO(
        make_actor(make_mpc(make_model()), config), env, config, seed, features=features,
        total_episodes=4 * ROLLOUTS, episode_steps=STEPS,
        imagination=Imagination(env, reaches, settings, seed, STEPS),
    )  # fmt: skip


def test_imagined_episodes_follow_the_first_real_ones_and_count_as_no_data():
    trainer = make_imagining()
    reports = [trainer.step() for _ in range(2)]
    assert reports[0].imagined_success is None
    assert reports[0].model_loss is None
    assert reports[1].imagined_success is not None
    assert 0 < reports[1].model_loss < 2
    assert reports[1].imagination_seconds > 0
    assert [report.env_steps for report in reports] == [STEPS * ROLLOUTS, 2 * STEPS * ROLLOUTS]
    assert len(trainer.imagination) == 2 * ROLLOUTS


def test_imagined_iterations_become_fewer(monkeypatch):
    trainer = make_imagining(iterations=2, final_iterations=1)
    counts, iterate = [], trainer._iterate

    def counted(env, *arguments):
        counts[-1] += env is trainer.imagination.env
        return iterate(env, *arguments)

    monkeypatch.setattr(trainer, "_iterate", counted)
    while not trainer.done:
        counts.append(0)
        report = trainer.step()
        assert (report.imagined_success is None) == (counts[-1] == 0)
    assert counts == [0, 2, 1, 1]  # none before the first real episodes


def test_iterations_can_end_before_the_main_phase():
    trainer = make_imagining(iterations=1, final_iterations=0, real_step=0.5)
    reports = []
    while not trainer.done:
        reports.append(trainer.step())
    assert [report.imagined_success is None for report in reports] == [True, False, True, True]
    assert [report.model_loss is None for report in reports] == [True, False, True, True]


def test_steps_on_real_episodes_are_shorter_beside_imagined_ones(monkeypatch):
    trainer = make_imagining(iterations=2, final_iterations=2, real_step=0.25)
    trainer.config = replace(trainer.config, final_step=1.0)
    scales, improve_ = [], trainer._improve

    def remember(data, rollouts, effort, scale):
        scales.append(scale)
        outcome = improve_(data, rollouts, effort, scale)
        if scale < 1:
            trainer.learning_rate *= 7  # whatever the real episodes say
        return outcome

    monkeypatch.setattr(trainer, "_improve", remember)
    for _ in range(2):
        report = trainer.step()
    assert scales == [1.0, 1.0, 1.0, 0.25]
    assert trainer.learning_rate == report.learning_rate


@pytest.mark.parametrize("actions", [1, 8])
def test_imagination_learns_from_less_data(actions):
    def success(trainer):
        # Short steps: with the usual ones rounding decides in one training of twelve whether a late step ruins it.
        trainer.config = replace(trainer.config, target_kl=0.02)
        while not trainer.done:
            trainer.step()
        return evaluate(make_envs(60), trainer.policy, 60, 0, STEPS).success_rate

    settings = {"iterations": 12, "rollouts": 30, "first_epochs": 100, "actions": actions}
    seeds = range(3)
    alone = np.mean([success(make_ppo(seed)) for seed in seeds])
    imagining = np.mean([success(make_imagining(seed, **settings)) for seed in seeds])
    assert imagining > alone + 0.15


def test_imagined_iterations_have_an_effort_of_their_own(monkeypatch):
    trainer = make_imagining(iterations=1, rollouts=6, steps=4, steps_minibatch=STEPS * 3, value_epochs=2)
    trainer.step()
    batches, epochs = [], []
    trainer.actor.gaussian.register_forward_hook(lambda _, inputs, __: batches.append(len(inputs[0])))
    fit = trainer.critic._fit
    monkeypatch.setattr(trainer.critic, "_fit", lambda x, y, count, key: (epochs.append(count), fit(x, y, count, key)))
    trainer.step()
    imagined = [6] * STEPS + [6 * STEPS] + [STEPS * 3] * 4  # episodes in lockstep, the metric, gradient steps
    real = [ROLLOUTS] * STEPS + [ROLLOUTS * STEPS] + [ROLLOUTS * STEPS] * 4
    assert batches == imagined + real
    assert epochs == [2, trainer.config.value_epochs]


def test_the_first_iteration_does_not_depend_on_imagination():
    alone, imagining = make_ppo(), make_imagining()
    for trainer in (alone, imagining):
        trainer.step()
    assert same(parameters(alone), parameters(imagining))


def test_imagining_resumed_equals_uninterrupted_bitwise(tmp_path):
    through = make_imagining()
    while not through.done:
        through.step()
    first = make_imagining()
    for _ in range(2):
        first.step()
    save_checkpoint(tmp_path, first.checkpoint())
    second = make_imagining()
    second.restore(load_checkpoint(tmp_path))
    while not second.done:
        second.step()
    assert same(parameters(through), parameters(second))
    for name, value in through.checkpoint().tensors.items():
        assert torch.equal(value, second.checkpoint().tensors[name]), name


def test_a_checkpoint_without_imagination_is_refused():
    trainer = make_ppo()
    trainer.step()
    with pytest.raises(CheckpointError, match=r"imagination\.ensemble.*other settings"):
        make_imagining().restore(trainer.checkpoint())


def test_the_main_phase_remembers_the_warm_up():
    trainer = make_lcsrl(imagine=True)
    for _ in range(3):
        trainer.step()
    assert len(trainer.current.imagination) == 8
    trainer.step()
    assert len(trainer.current.imagination) == 8 + ROLLOUTS
