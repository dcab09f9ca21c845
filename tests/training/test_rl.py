"""Warm-up and evaluation, on a small contact system that needs no simulator."""

import math
from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from difflcs import GoalCost, LCSModel, LCSMPCLayer, LCSParams, solve_lcp, violation_loss
from difflcs.errors import CheckpointError, InvalidInputError, MissingDependencyError
from difflcs.rl import TASKS, TrainConfig, Warmup, WarmupConfig, collect, evaluate, fit, trust_region, wilson_interval
from difflcs.rl._optional import require
from difflcs.rl.checkpoint import load_checkpoint, save_checkpoint
from difflcs.rl.rollout import episode_seeds, mpc_actions, noisy_actions, uniform_actions
from difflcs.rl.training import goals_due
from difflcs.rl.warmup import config_from_dict
from difflcs_envs.tasks import pushing_cost

STEPS = 10
U_MAX = 0.1


def pusher() -> LCSParams:
    """A finger at x₁ pushes a block at x₀: x₀₊ = x₀ + λ, x₁₊ = x₁ + u, 0 ≤ λ ⊥ x₀ − x₁ − u + λ ≥ 0."""

    def matrix(*rows):
        return torch.tensor(rows, dtype=torch.float64)

    zero = torch.zeros(1, dtype=torch.float64)
    return LCSParams(
        A=matrix([1.0, 0.0], [0.0, 1.0]),
        B=matrix([0.0], [1.0]),
        C=matrix([1.0], [0.0]),
        d=torch.zeros(2, dtype=torch.float64),
        D=matrix([1.0, -1.0]),
        E=matrix([-1.0]),
        F=matrix([1.0]),
        c=zero,
    )


class PusherEnv(gymnasium.Env):
    """Push the block to a goal ahead of it."""

    observation_space = spaces.Dict(
        {key: spaces.Box(-10.0, 10.0, (size,), np.float64) for key, size in (("state", 2), ("goal", 1))}
    )
    action_space = spaces.Box(-U_MAX, U_MAX, (1,), np.float64)

    def __init__(self, breaks_at: int | None = None, length: int = STEPS):
        self.breaks_at, self.length = breaks_at, length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.state = self.np_random.uniform([0.05, -0.1], [0.15, 0.0])
        self.goal = self.np_random.uniform([0.2], [0.5])
        return self._observation(), {}

    def step(self, action):
        params, x, u = pusher(), torch.from_numpy(self.state), torch.from_numpy(np.asarray(action))
        lam = solve_lcp(params.F, params.gap(x, u)).lam
        self.state = params.next_state(x, u, lam).numpy()
        self.steps += 1
        broken = self.steps == self.breaks_at
        if broken:
            self.state = np.full(2, np.nan)
        error = abs(float(self.state[0] - self.goal[0]))
        info = {"success": error < 0.02, "position_error": error, "physics_error": broken}
        return self._observation(), -error, False, self.steps >= self.length or broken, info

    def _observation(self):
        return {"state": self.state.copy(), "goal": self.goal.copy()}


def make_envs(count: int, **kwargs) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: PusherEnv(**kwargs)] * count)


class Reach:
    """Stands in for the MPC: moves toward the goal within the bounds, and says that every third solve failed."""

    def __init__(self, lcs=None):
        self.lcs = lcs
        self.bounds = []

    def __call__(self, x0, goal, *, u_min=None, u_max=None):
        assert not torch.is_grad_enabled()
        low = torch.tensor([-U_MAX], dtype=torch.float64) if u_min is None else u_min
        high = torch.tensor([U_MAX], dtype=torch.float64) if u_max is None else u_max
        self.bounds.append((low, high))
        # The model decides too, so that a difference in parameters shows in the data.
        push = 0.0 if self.lcs is None else self.lcs.B.sum() * 1e-3
        action = torch.minimum(torch.maximum(goal - x0[:, 1:] + push, low), high)
        return SimpleNamespace(action=action, converged=torch.arange(len(x0)) % 3 != 2)


def small_config(**changes) -> WarmupConfig:
    base = WarmupConfig(
        random_rollouts=2, rollouts_per_iteration=3, noise=0.02, first_epochs=20, epochs=3, minibatch=16
    )
    return replace(base, **changes)


def make_trainer(seed=0, **changes) -> Warmup:
    lcs = LCSModel(2, 1, 1, init_scale=1e-2, learn_c=False, generator=torch.Generator().manual_seed(seed))
    return Warmup(lcs, Reach(lcs), make_envs(3), small_config(**changes), seed, STEPS)


# --- rollouts ---


def test_collect_returns_what_happened():
    env = make_envs(3)
    rng = np.random.default_rng(0)
    rollouts = collect(env, noisy_actions(mpc_actions(Reach()), 0.5, rng), [1, 2, 3], STEPS)
    assert rollouts.states.shape == (3, STEPS + 1, 2)
    assert rollouts.actions.shape == (3, STEPS, 1)
    assert rollouts.solver_failures == STEPS  # the third of three, at each step
    assert bool((rollouts.actions.abs() <= U_MAX).all())  # stored as executed, not as noised
    assert bool((rollouts.actions.abs() == U_MAX).any())
    params = pusher()
    x, u = rollouts.states[:, :-1], rollouts.actions
    lam = solve_lcp(params.F, params.gap(x, u)).lam
    torch.testing.assert_close(params.next_state(x, u, lam), rollouts.states[:, 1:])  # no reset between two steps
    torch.testing.assert_close(
        rollouts.errors["position_error"], (rollouts.states[:, -1, :1] - rollouts.goals).abs()[:, 0]
    )


def test_episodes_depend_on_their_seed_only():
    together = collect(make_envs(4), mpc_actions(Reach()), [7, 8, 9], STEPS)
    env = make_envs(2)
    for _ in range(2):  # used environments start afresh
        alone = [collect(env, mpc_actions(Reach()), [seed], STEPS) for seed in (7, 8, 9)]
    assert torch.equal(together.states, torch.cat([one.states for one in alone]))
    assert torch.equal(together.goals, torch.cat([one.goals for one in alone]))
    assert len(set(episode_seeds(0, 0, 0, 50) + episode_seeds(0, 1, 0, 50) + episode_seeds(1, 0, 0, 50))) == 150
    assert episode_seeds(0, 1, 3, 2) == episode_seeds(0, 1, 0, 5)[3:]


def test_a_broken_simulation_is_counted_not_fatal():
    env = SyncVectorEnv([lambda: PusherEnv(breaks_at=4), PusherEnv])
    rollouts = collect(env, mpc_actions(Reach()), [1, 2], STEPS)
    assert rollouts.stable.tolist() == [False, True]
    assert not rollouts.success[0]
    assert evaluate(make_envs(2, breaks_at=4), Reach(), 2, 0, STEPS).unstable == 2
    lcs = LCSModel(2, 1, 1, init_scale=1e-2)
    envs = SyncVectorEnv([lambda: PusherEnv(breaks_at=4), *[PusherEnv] * 2])
    trainer = Warmup(lcs, Reach(lcs), envs, small_config(), 0, STEPS)
    assert trainer.step().unstable == 1
    assert bool(torch.isfinite(trainer.states).all())
    assert len(trainer.states) == 1


@pytest.mark.parametrize("length", [STEPS - 1, STEPS + 1])
def test_episodes_of_another_length_are_refused(length):
    with pytest.raises(InvalidInputError, match=f"episodes of {STEPS} steps"):
        collect(make_envs(2, length=length), mpc_actions(Reach()), [1, 2], STEPS)


def test_same_step_autoreset_is_refused():
    env = SyncVectorEnv([PusherEnv], autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(InvalidInputError, match="autoreset"):
        collect(env, mpc_actions(Reach()), [1], STEPS)
    with pytest.raises(InvalidInputError, match="num_envs=1"):
        collect(make_envs(1), mpc_actions(Reach()), [1, 2], STEPS)


# --- evaluation ---


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Newcombe (1998), Table I, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_interval_known_values(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_wilson_interval_equals_scipy():
    stats = pytest.importorskip("scipy.stats")
    for successes, trials in [(0, 1), (1, 1), (13, 300), (195, 300), (300, 300)]:
        for confidence in (0.9, 0.95):
            reference = stats.binomtest(successes, trials).proportion_ci(confidence, "wilson")
            ours = wilson_interval(successes, trials, confidence)
            assert ours == pytest.approx((reference.low, reference.high), abs=1e-12)
            assert ours == pytest.approx(
                tuple(1 - v for v in wilson_interval(trials - successes, trials, confidence))[::-1]
            )
    with pytest.raises(InvalidInputError, match="trials=3"):
        wilson_interval(4, 3)


def test_evaluation_does_not_depend_on_the_number_of_environments():
    progress = []
    results = [evaluate(make_envs(n), Reach(), 7, 3, STEPS, after_step=progress.append) for n in (2, 7)]
    assert replace(results[0], solver_failures=0) == replace(results[1], solver_failures=0)
    assert results[0].goals == 7
    assert results[0].success_rate == results[0].successes / 7
    assert results[0].median_yaw_error is None
    assert sum(progress) == 2 * 7 * STEPS


def test_evaluation_bounds():
    policy = Reach()
    bound = torch.tensor([0.01], dtype=torch.float64)
    evaluate(make_envs(2), policy, 2, 0, STEPS, -bound, bound)
    assert policy.bounds[0] == (-bound, bound)


# --- warm-up ---


def test_trust_region():
    actions = torch.tensor([[[0.0, 0.09]], [[0.02, 0.09]], [[0.04, 0.06]]], dtype=torch.float64)
    limit = torch.full((2,), 0.1, dtype=torch.float64)
    low, high = trust_region(actions, 0.9, -limit, limit)
    std = math.sqrt((0.02**2 + 0.02**2) / 3)  # population
    assert low[0].item() == pytest.approx(0.02 - 0.9 * std)
    assert high[0].item() == pytest.approx(0.02 + 0.9 * std)
    assert trust_region(actions, 100.0, -limit, limit)[1].tolist() == limit.tolist()
    low, high = trust_region(limit.expand(5, 2), 0.9, -limit, limit)  # one action: a point, not an empty box
    assert low.tolist() == pytest.approx(limit.tolist())
    assert bool((low <= high).all())


def test_bounds_while_collecting():
    trainer = make_trainer(trust_region=0.5, trust_region_growth=2.0)
    trainer.step()
    assert trainer.policy.bounds == []  # random actions
    seen = trainer.actions.clone()
    for growth in (1.0, 2.0):
        expected = trust_region(seen, 0.5 * growth, trainer.low, trainer.high)
        trainer.policy.bounds.clear()
        trainer.step()
        assert all(torch.equal(a, b) for a, b in zip(trainer.policy.bounds[0], expected, strict=True))
        seen = trainer.actions.clone()
    off = make_trainer(trust_region=0.0)
    off.step()
    off.step()
    assert off.bounds == (off.low, off.high)


def test_a_pretrained_model_skips_the_random_episodes():
    lcs = LCSModel(2, 1, 1)
    trainer = Warmup(lcs, Reach(lcs), make_envs(3), small_config(), 0, STEPS, pretrained=True)
    assert trainer.step().env_steps == 3 * STEPS
    assert len(trainer.policy.bounds) == STEPS


def test_buffer_keeps_the_newest():
    trainer = make_trainer(buffer_rollouts=4)
    for _ in range(3):
        trainer.step()
    assert len(trainer.states) == len(trainer.actions) == 4
    assert trainer.env_steps == (2 + 3 + 3) * STEPS


def parameters(trainer: Warmup) -> list[torch.Tensor]:
    return [value.clone() for value in trainer.lcs.state_dict().values()]


def test_resumed_equals_uninterrupted_bitwise(tmp_path):
    through = make_trainer()
    for _ in range(4):
        through.step()
    first = make_trainer()
    for _ in range(2):
        first.step()
    save_checkpoint(tmp_path, first.checkpoint())
    first.step()  # lost by the crash

    second = make_trainer(seed=0)
    np.random.seed(7)  # noqa: NPY002  the global generators must not matter
    torch.manual_seed(7)
    second.restore(load_checkpoint(tmp_path))
    for _ in range(2):
        second.step()
    assert all(torch.equal(a, b) for a, b in zip(parameters(through), parameters(second), strict=True))
    assert torch.equal(through.states, second.states)
    assert all(torch.equal(a, b) for a, b in zip(through.bounds, second.bounds, strict=True))


def test_restore_refuses_another_model(tmp_path):
    trainer = make_trainer()
    trainer.step()
    checkpoint = trainer.checkpoint()
    lcs = LCSModel(2, 1, 3)
    other = Warmup(lcs, Reach(lcs), make_envs(3), small_config(), 0, STEPS)
    before = parameters(other)
    with pytest.raises(CheckpointError, match="other settings"):
        other.restore(checkpoint)
    with pytest.raises(CheckpointError, match="generators"):
        trainer.restore(replace(checkpoint, state={"episodes": 2}))
    assert all(torch.equal(a, b) for a, b in zip(before, parameters(other), strict=True))
    assert other.iteration == 0


def test_restore_refuses_hostile_checkpoints(refuses_hostile_checkpoints):
    refuses_hostile_checkpoints(make_trainer())


def test_seeds_differ_and_repeat():
    runs = [make_trainer(seed) for seed in (0, 0, 1)]
    for trainer in runs:
        trainer.step()
    assert torch.equal(runs[0].states, runs[1].states)
    assert not torch.equal(runs[0].states, runs[2].states)


def transitions(episodes: int, seed: int) -> list[torch.Tensor]:
    """States, actions and next states of uniformly random episodes."""
    envs = make_envs(episodes)
    seeds = episode_seeds(seed, 0, 0, episodes)
    rollouts = collect(envs, uniform_actions(envs, np.random.default_rng(seed)), seeds, STEPS)
    return [v.reshape(-1, v.shape[-1]) for v in (rollouts.states[:, :-1], rollouts.actions, rollouts.states[:, 1:])]


def make_pusher_model(seed: int) -> LCSModel:
    # One contact would do; spare ones avoid local minima (of seeds 0 to 3, some stall with 1 or 2, none with 3).
    return LCSModel(2, 1, 3, init_scale=1e-3, learn_c=False, generator=torch.Generator().manual_seed(seed))


def test_fit_learns_contact():
    data = transitions(20, seed=0)
    lcs = make_pusher_model(0)
    config = WarmupConfig(learning_rate_decay=0.998)
    before = float(violation_loss(lcs, *data, config.gamma, config.xi).detach())
    outcome = fit(lcs, *data, config, epochs=300, rng=np.random.default_rng(0))
    assert outcome.steps == 300 * (160 // 100)  # 200 transitions, 20 % held out, whole minibatches
    assert outcome.held_out_loss is not None
    assert max(outcome.loss, outcome.held_out_loss) < before / 100


def test_warmup_learns_to_push():
    """The whole loop with the real MPC, from a random model to one that pushes the block where it should be."""
    cost = GoalCost.reach(2, 1, goal_weight=(50.0,), input_weight=0.1, pairs=[(0, 1)], pair_weight=0.1)
    lcs = make_pusher_model(0)
    policy = LCSMPCLayer(lcs, cost, horizon=5, u_min=-U_MAX, u_max=U_MAX, backend="ipopt", on_failure="mask")
    config = small_config(random_rollouts=4, first_epochs=300, epochs=60, minibatch=50, learning_rate_decay=0.998)
    trainer = Warmup(lcs, policy, make_envs(4), config, 0, STEPS)
    unseen = transitions(8, seed=1)
    before = float(violation_loss(lcs, *unseen, config.gamma, config.xi).detach())
    for _ in range(5):
        assert math.isfinite(trainer.step().loss)
    assert float(violation_loss(lcs, *unseen, config.gamma, config.xi).detach()) < before / 100
    assert evaluate(make_envs(8), policy, 16, 0, STEPS).successes >= 14


# --- configuration ---


def test_pushing_cost_is_the_papers():
    rng = np.random.default_rng(0)
    x, u, goal = rng.normal(size=9), rng.normal(size=6), rng.normal(size=3)
    tips = ((x[3:].reshape(3, 2) - x[:2]) ** 2).sum()
    place, yaw = ((x[:2] - goal[:2]) ** 2).sum(), (x[2] - goal[2]) ** 2
    cost = pushing_cost()(torch.from_numpy(goal), horizon=1)
    X, U = torch.from_numpy(x), torch.from_numpy(u)
    stage = 0.5 * X @ cost.Q @ X + cost.q @ X + 0.5 * U @ cost.R @ U + cost.r @ U
    final = 0.5 * X @ cost.Q_final @ X + cost.q_final @ X
    expected = 10 * tips + 200 * place + 0.3 * yaw + 200 * (u**2).sum() + 6 * tips + 200 * place + 1.5 * yaw
    assert float(stage + final + cost.constant) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "cubes"}, "cube, sugar_box"),
        ({"method": "magic"}, "'violation'"),
        ({"warmup_minutes": 0.0}, "warmup_minutes"),
        ({"minutes": 0.0}, "minutes"),
        ({"minutes": math.nan}, "minutes"),
        ({"seed": -1}, "seed"),
        ({"evaluate_goals": 0}, "evaluate_goals"),
        ({"evaluate_at": (-1.0,)}, "evaluate_at"),
    ],
)
def test_bad_settings_are_refused(change, message):
    with pytest.raises(InvalidInputError, match=message):
        TrainConfig(**change)


def test_bad_warmup_settings_are_refused():
    for change in ({"minibatch": 0}, {"noise": -1.0}, {"held_out": 1.0}, {"xi": 0.0}):
        with pytest.raises(InvalidInputError, match=next(iter(change))):
            WarmupConfig(**change)
    with pytest.raises(CheckpointError, match="fields"):
        config_from_dict({"noise": 0.0}, WarmupConfig)


def test_evaluations_fall_due_once():
    config = TrainConfig(minutes=2.0, evaluate_at=(0.0, 0.5, 1.0, 1.1), evaluate_goals=60, final_goals=300)
    due = {now: goals_due(config, now - 100, now, 600.0) for now in range(0, 1300, 100)}
    assert {k: v for k, v in due.items() if v} == {0: 300, 300: 60, 600: 60, 700: 60, 1200: 300}


def test_tasks_name_their_environment():
    assert TASKS["cube"].env_id == "difflcs/TriFingerMoveCube-v0"
    assert TASKS["mug"].env_kwargs == {"object": "mug"}


def test_missing_packages_name_the_line_that_installs_them():
    require("torch")
    with pytest.raises(MissingDependencyError, match=r'pip install "difflcs\[rl,envs,viz\]"'):
        require("torch", "no_such_package")
