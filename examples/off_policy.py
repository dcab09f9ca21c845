"""Off-policy learning of an LCS by TorchRL's SAC, a study and no recommended method: `python examples/off_policy.py`.

The warm-up of LCS-RL fits a first model. Then rounds follow, in which twin critics are fitted to a replay buffer, and
the LCS takes natural steps along the critics' gradient, through the MPC, within a trust region:

- The buffer holds all real episodes, each with several goals: dynamics know nothing of goals, and the task's `outcome`
  says what reward another goal would have given.
- With `--imagined` it also holds episodes that an ensemble of networks plays, see "Model rollouts" in docs/training.md.
- Critics need the MPC's action at every next state. It is solved once a round for the whole buffer, not in every step.
- The policy is a Gaussian of fixed covariance around the MPC's action. So its entropy is constant, and alpha is zero.

Printed are success under noise in the real episodes, and without noise in the end.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack, closing
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import MultivariateNormal
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, ProbabilisticActor
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from difflcs.rl import LCSMPCPolicy, evaluate, get_method, get_task
from difflcs.rl.learning.advantages import RewardScale
from difflcs.rl.learning.model_rollouts import ModelRollouts, ModelRolloutSettings
from difflcs.rl.learning.optim import Natural, NaturalUpdate
from difflcs.rl.learning.optim.update import Deviation
from difflcs.rl.learning.surrogate import gaussian_kl, trimmed_mean
from difflcs.rl.methods.base import Work
from difflcs.rl.methods.phases import warmup_phase
from difflcs.rl.rollout import (
    append_episodes,
    collect,
    elapsed_fractions,
    ignore_solver_warnings,
    make_empty_record,
    mpc_actions,
    noisy_actions,
)
from difflcs.rl.seeding import Stream, episode_seeds, numbers


class KnownMean(TensorDictModuleBase):
    """The Gaussian of a policy: around the entry "mean" if there is one, else around the MPC's action."""

    def __init__(self, gaussian):
        super().__init__()
        self.gaussian = gaussian
        self.in_keys, self.out_keys = ["state", "goal"], ["loc", "scale_tril", "converged"]

    def forward(self, data):
        """Write mean and Cholesky factor."""
        if (mean := data.get("mean", None)) is not None:
            return self.gaussian.write(data, mean)
        with ignore_solver_warnings():
            return self.gaussian(data)


class Judge(nn.Module):
    """Features and action, clipped as it is executed → value of the action."""

    def __init__(self, n_features: int, bounds: tuple[Tensor, Tensor], width: int):
        super().__init__()
        self.bounds = bounds
        self.network = MLP(n_features + len(bounds[0]), 1, num_cells=[width, width], activation_class=nn.ReLU)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """(..., n_features), (..., n_u) → (..., 1)."""
        action = torch.clamp(action, *self.bounds) / self.bounds[1]
        return self.network(torch.cat([features, action], -1).float()).double()


@dataclass
class Options:
    """Train one model off-policy."""

    minutes: float = 3.0
    """Data in all."""
    warmup_minutes: float = 1.25
    """Data of the warm-up."""
    episodes: int = 10
    """Real episodes between rounds."""
    rounds: int = 3
    """Rounds before real episodes; twice as many follow the last ones."""
    copies: int = 2
    """Goals that each real episode is given in the buffer."""
    imagined: int = 60
    """Episodes of a round that the ensemble plays; 0: real ones alone."""
    first: int = 1000
    """Steps of the critics before the LCS moves."""
    critic_steps: int = 200
    """Steps of the critics in each later round."""
    actor_steps: int = 10
    """Steps of the LCS in each round."""
    std: float = 0.005
    """Standard deviation of the policy [m]."""
    target_kl: float = 0.1
    """KL divergence of a round that the step size aims at; at three times as much the round ends."""
    goals: int = 300
    """Goals of the evaluation."""
    seed: int = 20
    """Seed of the training."""
    evaluation_seed: int = 77
    """Seed of the goals."""


GAMMA, BATCH, SAMPLES, KEPT, FINAL_STEP, OUTLIER = 0.99, 256, 300, 4, 0.3, 2.0
"""Discount, batches of critics and actor, rounds of imagined episodes that are kept, last factor on the steps, KL
divergence of a sample that does not count."""


def main(o: Options) -> None:
    """Warm up, then learn off-policy, and evaluate."""
    torch.set_num_threads(1)
    torch.manual_seed(o.seed)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    task, rng = get_task("cube"), np.random.default_rng((o.seed, 1))
    steps, total = task.episode_steps, round(o.minutes * task.steps_per_minute / task.episode_steps)
    scale = RewardScale(3.0, task.failure_penalty, 0.1)
    with ExitStack() as opened:
        envs = opened.enter_context(closing(task.make_envs(100, threads=1)))
        work = Work(task, o.seed, total, lambda n: opened.enter_context(closing(task.make_envs(n, threads=1))))
        method = get_method("lcs-rl")()
        lcs = method.initial(work)
        mpc = method.policy(task, lcs)
        warmup = warmup_phase(work, lcs, mpc, method.warmup)
        while warmup.env_steps < o.warmup_minutes * task.steps_per_minute:
            warmup.step()
        print(f"warm-up: {evaluate(envs, mpc, o.goals, o.evaluation_seed, steps)}", flush=True)

        policy = LCSMPCPolicy(mpc, o.std)
        actor = ProbabilisticActor(
            KnownMean(policy.gaussian),
            in_keys=["loc", "scale_tril"],
            out_keys=["action"],
            distribution_class=MultivariateNormal,
            distribution_kwargs={"validate_args": False},
            return_log_prob=True,
        )
        judge = TensorDictModule(
            Judge(task.n_features, task.bounds, 128), ["features", "action"], ["state_action_value"]
        )
        loss = SACLoss(
            actor,
            judge,
            loss_function="l2",
            alpha_init=1e-9,
            fixed_alpha=True,
            reduction="none",
            scalar_output_mode="exclude",
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
        targets = SoftUpdate(loss, tau=0.01)
        adam = torch.optim.AdamW(loss.qvalue_network_params.flatten_keys().values(), 1e-3, weight_decay=1e-4)
        deviation = Deviation(policy, 0.01, (0.9, 0.99), (0.001, 0.01))
        update = NaturalUpdate(policy, Natural(), o.target_kl, 1.5, deviation)
        known = append_episodes(make_empty_record(envs, steps), warmup.buffer)
        models, imagined = None, []
        if o.imagined:
            models = ModelRollouts(envs, task.outcome, ModelRolloutSettings(rollouts=o.imagined), o.seed, steps)
            models.add(known)

        def transitions(episodes: TensorDict) -> TensorDict:
            """Transitions with the rewards of their goals, and the present MPC's actions at both ends."""
            state, goal = episodes["state"], episodes["goal"].unsqueeze(1).expand(-1, steps + 1, -1)
            ended = (torch.arange(1, steps + 1) == steps).expand(len(state), -1)
            reward, success = task.outcome(state[:, :-1], episodes["action"], state[:, 1:], goal[:, 1:], ended)
            with torch.no_grad(), ignore_solver_warnings():
                mean = mpc(state.flatten(0, 1), goal.flatten(0, 1)).action.view(*state.shape[:2], -1)
            features = task.features(state, goal, elapsed_fractions(steps).expand(state.shape[:2]))
            after = {
                "features": features[:, 1:],
                "mean": mean[:, 1:],
                "reward": scale(reward, success[:, -1]).unsqueeze(-1),
                "done": ended.unsqueeze(-1),
                "terminated": ended.unsqueeze(-1),
            }
            now = {"state": state[:, :-1], "goal": goal[:, :-1], "features": features[:, :-1], "old": mean[:, :-1]}
            return TensorDict({**now, "action": episodes["action"], "next": after}, ended.shape).flatten(0, 1)

        def learn(number: int, factor: float) -> None:
            """One round: fill the buffer, fit the critics, move the LCS."""
            parts = [known]
            for _ in range(o.copies - 1):
                other = known.clone()
                other["goal"] = other["goal"][torch.from_numpy(rng.permutation(len(other)))]
                parts.append(other)
            if models is not None:
                act = noisy_actions(mpc_actions(mpc), o.std, rng)
                seeds = numbers(o.imagined, o.seed, Stream.MODEL_ROLLOUT, number)
                imagined.append(collect(models.env, act, seeds, steps).select("state", "action", "goal"))
                del imagined[:-KEPT]
            data = transitions(torch.cat([*parts, *imagined]))
            buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data)))
            buffer.extend(data)
            for _ in range(o.critic_steps if number else o.first):
                error, _ = loss.qvalue_v2_loss(buffer.sample(BATCH))
                adam.zero_grad()
                error.mean().backward()
                adam.step()
                targets.step()
            old = buffer.sample(SAMPLES).select("state", "goal", "features", "old")
            guess = policy.solve(old.select("state", "goal")).detach()
            guess["guess"] = guess["plan"]
            update.measure(guess, rng)
            kl = 0.0
            for step in range(o.actor_steps):
                batch = buffer.sample(SAMPLES).select("state", "goal", "features", "old")
                value, _ = loss.actor_loss(batch)  # writes the policy's Gaussian into the batch
                moved = gaussian_kl(TensorDict({**batch.select("scale_tril"), "loc": batch["old"]}, len(batch)), batch)
                kl = trimmed_mean(moved.detach(), 0.97)
                if kl > 3 * o.target_kl and step:
                    break
                same = (moved < OUTLIER) & batch["converged"].squeeze(-1)  # the MPC is still in the same optimum
                update.step((value * same).mean(), factor)
            update.size.adapt(kl / factor**2)

        number, begun, done = 0, warmup.episodes, warmup.episodes
        while True:
            if models is not None:
                models.fit()
            last = done >= total
            factor = 1 - (1 - FINAL_STEP) * (done - begun) / max(total - begun, 1)
            for _ in range(o.rounds * (1 + last)):
                learn(number, factor)
                number += 1
            if last:
                break
            count = min(o.episodes, total - done)
            act = noisy_actions(mpc_actions(mpc), o.std, rng)
            episodes = collect(envs, act, episode_seeds(o.seed, Stream.TRAINING, done, count), steps)
            done, known = done + count, append_episodes(known, episodes)
            if models is not None:
                models.add(episodes)
            print(
                f"{done} episodes, {100 * float(episodes['success'].double().mean()):.0f} % of the newest", flush=True
            )
        print(f"after {o.minutes:g} minutes: {evaluate(envs, mpc, o.goals, o.evaluation_seed, steps)}", flush=True)


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Options))
