"""Off-policy learning of an LCS by TorchRL's SAC, a study and no recommended method.

    python examples/off_policy.py train --method lcs-sac --task cube --minutes 3 --seed 22 --out RUN
    python examples/off_policy.py evaluate RUN

This is the command `difflcs` with the method that this file registers, so runs are logged, resumed and evaluated like
all others. The warm-up of LCS-RL fits a first model. Then rounds follow, in which twin critics are fitted to a replay
buffer, and the LCS takes natural steps along the critics' gradient, through the MPC, within a trust region:

- The buffer holds all real episodes, each with several goals: dynamics know nothing of goals, and the task's `outcome`
  says what reward another goal would have given.
- With `--imagined` it also holds episodes that an ensemble of networks plays, see "Model rollouts" in docs/training.md.
- Critics need the MPC's action at every next state. It is solved once a round for the whole buffer, not in every step.
- The policy is a Gaussian of fixed covariance around the MPC's action. So its entropy is constant, and alpha is zero.
"""

from __future__ import annotations

import logging
import sys
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import MultivariateNormal
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, ProbabilisticActor
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from difflcs import cli
from difflcs.errors import InvalidInputError
from difflcs.rl import LCSMethod, LCSMPCPolicy, Trainer, bounded, collect, register_method
from difflcs.rl.learning.advantages import RewardScale
from difflcs.rl.learning.lcsrl import LCSRL
from difflcs.rl.learning.model_rollouts import ModelRollouts, ModelRolloutSettings
from difflcs.rl.learning.optim import Natural, NaturalUpdate
from difflcs.rl.learning.optim.update import Deviation
from difflcs.rl.learning.state_tree import StatefulAdam
from difflcs.rl.learning.surrogate import OUTLIER_KL, gaussian_kl, trimmed_mean
from difflcs.rl.learning.warmup import WarmupReport, WarmupSettings
from difflcs.rl.methods.base import Work
from difflcs.rl.methods.phases import warmup_phase
from difflcs.rl.rollout import (
    append_episodes,
    elapsed_fractions,
    episodes_from_state,
    episodes_to_state,
    ignore_solver_warnings,
    make_empty_record,
    mpc_actions,
    noisy_actions,
)
from difflcs.rl.seeding import Stream, episode_seeds, numbers, seeded
from difflcs.rl.settings import group

GAMMA, BATCH, SAMPLES, KEPT, FINAL_STEP = 0.99, 256, 300, 4, 0.3
"""Discount, batches of critics and actor, rounds of imagined episodes that are kept, last factor on the steps."""


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


@dataclass(frozen=True)
class SACReport:
    """Report of one iteration.

    Attributes:
        iteration: its number, those of the warm-up included.
        env_steps: environment steps collected so far.
        success: share of its episodes that ended at the goal, under the policy's noise.
        kl: KL divergence of the last round.
        critic_loss: mean of the last one hundred steps of the critics.
        step_size: length of a natural step.
    """

    iteration: int
    env_steps: int
    success: float
    kl: float
    critic_loss: float
    step_size: float


class OffPolicy(Trainer):
    """The rounds after the warm-up, see `Trainer`.

    Args:
        lcs: the model, trained in place.
        mpc: acts by it.
        work: task, seed, amount of data.
        settings: settings.
        first_episode: episodes collected before, by the warm-up.
        first_iteration: iterations done before.
    """

    def __init__(self, lcs, mpc, work: Work, settings: SACMethod, first_episode: int, first_iteration: int):
        super().__init__(lcs, mpc, work.seed, work.task.episode_steps)
        if work.total_episodes <= first_episode:
            raise InvalidInputError(f"minutes: expected more than the warm-up's {first_episode} episodes; train longer")
        logging.getLogger("torchrl").setLevel(logging.WARNING)
        self.mpc, self.task, self.settings, self.total = mpc, work.task, settings, work.total_episodes
        self.first_episode, self.first_iteration = first_episode, first_iteration
        self.episodes, self.iteration, self.round = first_episode, first_iteration, 0
        self.envs = work.make_envs(min(settings.episodes, self.total - first_episode))
        self.scale = RewardScale(3.0, self.task.failure_penalty, 0.1)
        networks = ModelRolloutSettings(rollouts=max(1, settings.imagined))
        self.models = ModelRollouts(self.envs, self.task.outcome, networks, self.seed, self.episode_steps)
        self.imagined = make_empty_record(self.envs, self.episode_steps)
        self.actor = LCSMPCPolicy(mpc, settings.std)
        with seeded((self.seed, Stream.VALUE, first_iteration)):
            mean: Any = KnownMean(self.actor.gaussian)
            judge = Judge(self.task.n_features, self.task.bounds, 128)
            self.loss = SACLoss(
                ProbabilisticActor(
                    mean,
                    in_keys=["loc", "scale_tril"],
                    out_keys=["action"],
                    distribution_class=MultivariateNormal,
                    distribution_kwargs={"validate_args": False},
                    return_log_prob=True,
                ),
                TensorDictModule(judge, ["features", "action"], ["state_action_value"]),
                loss_function="l2",
                alpha_init=1e-9,
                fixed_alpha=True,
                reduction="none",
                scalar_output_mode="exclude",
            )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
        self.targets = SoftUpdate(self.loss, tau=0.01)
        critics = self.loss.qvalue_network_params.flatten_keys().values()
        self.adam = StatefulAdam(critics, 1e-3, weight_decay=1e-4)
        deviation = Deviation(self.actor, 0.01, (0.9, 0.99), (0.001, 0.01))
        self.update = NaturalUpdate(self.actor, Natural(), settings.target_kl, 1.5, deviation)

    def remember(self, episodes: TensorDict) -> None:
        """Add the real episodes of the warm-up."""
        self.models.add(episodes)

    def step(self, after_step=None) -> SACReport:
        """One iteration: rounds of learning, then real episodes; after the last ones twice as many rounds."""
        own = self.settings
        learned = self._learn(own.rounds)
        count = min(own.episodes, self.total - self.episodes)
        rng = np.random.default_rng((self.seed, Stream.NOISE, self.iteration))
        act = noisy_actions(mpc_actions(self.policy), own.std, rng)
        seeds = episode_seeds(self.seed, Stream.TRAINING, self.episodes, count)
        report = None if after_step is None else lambda: after_step(count)
        episodes = collect(self.envs, act, seeds, self.episode_steps, report)
        self.models.add(episodes)
        self.episodes, self.iteration = self.episodes + count, self.iteration + 1
        if self.episodes >= self.total:
            learned = self._learn(2 * own.rounds)
        success = float(episodes["success"].double().mean())
        return SACReport(self.iteration, self.env_steps, success, *learned, self.update.size.value)

    def _learn(self, rounds: int) -> tuple[float, float]:
        """Some rounds on all data so far; returns KL divergence and critics' loss of the last one."""
        if self.settings.imagined:
            self.models.fit()
        done = (self.episodes - self.first_episode) / (self.total - self.first_episode)
        outcome = (0.0, 0.0)
        for _ in range(rounds):
            with seeded((self.seed, Stream.LOSS, self.round)):
                outcome = self._one_round(1 - (1 - FINAL_STEP) * done)
            self.round += 1
        return outcome

    def _one_round(self, factor: float) -> tuple[float, float]:
        """Fill the buffer, fit the critics, move the LCS."""
        own, rng = self.settings, np.random.default_rng((self.seed, Stream.LOSS, self.round))
        parts = [self.models.episodes]
        for _ in range(own.copies - 1):
            other = parts[0].clone()
            other["goal"] = other["goal"][torch.from_numpy(rng.permutation(len(other)))]
            parts.append(other)
        if own.imagined:
            act = noisy_actions(mpc_actions(self.policy), own.std, rng)
            seeds = numbers(own.imagined, self.seed, Stream.MODEL_ROLLOUT, self.round)
            played = collect(self.models.env, act, seeds, self.episode_steps)
            self.imagined = append_episodes(self.imagined, played, KEPT * own.imagined)
        episodes: Any = torch.cat([*parts, self.imagined])  # pyright: ignore[reportCallIssue, reportArgumentType]
        data = self._transitions(episodes)
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data)))
        buffer.extend(data)
        errors = []
        for _ in range(own.critic_steps if self.round else own.first):
            error, _ = self.loss.qvalue_v2_loss(buffer.sample(BATCH))
            self.adam.zero_grad()
            error.mean().backward()
            self.adam.step()
            self.targets.step()
            errors.append(float(error.detach().mean()))
        old = buffer.sample(SAMPLES).select("state", "goal", "features", "old")
        guess = self.actor.solve(old.select("state", "goal")).detach()
        guess["guess"] = guess["plan"]
        self.update.measure(guess, rng)
        kl = 0.0
        for step in range(own.actor_steps):
            batch = buffer.sample(SAMPLES).select("state", "goal", "features", "old")
            value, _ = self.loss.actor_loss(batch)  # writes the policy's Gaussian into the batch
            moved = gaussian_kl(TensorDict({**batch.select("scale_tril"), "loc": batch["old"]}, len(batch)), batch)
            kl = trimmed_mean(moved.detach(), 0.97)
            if kl > 3 * own.target_kl and step:
                break
            same = (moved < OUTLIER_KL) & batch["converged"].squeeze(-1)  # the MPC is still in the same optimum
            self.update.step((value * same).mean(), factor)
        self.update.size.adapt(kl / factor**2)
        return kl, float(np.mean(errors[-100:]))

    def _transitions(self, episodes: TensorDict) -> TensorDict:
        """Transitions with the rewards of their goals, and the present MPC's actions at both ends."""
        steps, task = self.episode_steps, self.task
        state, goal = episodes["state"], episodes["goal"].unsqueeze(1).expand(-1, steps + 1, -1)
        ended = (torch.arange(1, steps + 1) == steps).expand(len(state), -1)
        reward, success = task.outcome(state[:, :-1], episodes["action"], state[:, 1:], goal[:, 1:], ended)
        with torch.no_grad(), ignore_solver_warnings():
            mean = self.mpc(state.flatten(0, 1), goal.flatten(0, 1)).action.view(*state.shape[:2], -1)
        features = task.features(state, goal, elapsed_fractions(steps).expand(state.shape[:2]))
        after = {
            "features": features[:, 1:],
            "mean": mean[:, 1:],
            "reward": self.scale(reward, success[:, -1]).unsqueeze(-1),
            "done": ended.unsqueeze(-1),
            "terminated": ended.unsqueeze(-1),
        }
        now = {"state": state[:, :-1], "goal": goal[:, :-1], "features": features[:, :-1], "old": mean[:, :-1]}
        return TensorDict({**now, "action": episodes["action"], "next": after}, ended.shape).flatten(0, 1)

    def _critics(self) -> dict[str, dict[str, Tensor]]:
        own = {"now": self.loss.qvalue_network_params, "targets": self.loss.target_qvalue_network_params}
        return {name: {".".join(k): v.data for k, v in p.items(True, True)} for name, p in own.items()}

    def state_dict(self) -> dict[str, Any]:
        """See `Trainer`."""
        return {
            **super().state_dict(),
            "settings": {"first_episode": self.first_episode, "first_iteration": self.first_iteration},
            "round": self.round,
            "critics": self._critics(),
            "adam": self.adam.state_dict(),
            "update": self.update.state_dict(),
            "models": self.models.state_dict(),
            "imagined": {"episodes": episodes_to_state(self.imagined)},
        }

    def load_state_dict(self, state) -> None:
        """See `Trainer`."""
        super().load_state_dict(state)
        self.round = state["round"]
        for name, tensors in self._critics().items():
            for key, tensor in tensors.items():
                tensor.copy_(state["critics"][name][key])
        self.adam.load_state_dict(state["adam"])
        self.update.load_state_dict(state["update"])
        self.models.load_state_dict(state["models"])
        self.imagined = episodes_from_state(state["imagined"]["episodes"])


@register_method
@dataclass(frozen=True)
class SACMethod(LCSMethod):
    """The warm-up of LCS-RL, and then SAC with the MPC as the actor."""

    warmup_minutes: float = bounded(1.25, above=0, maximum=1e6)
    """Data of the warm-up [min]."""
    warmup: WarmupSettings = group(WarmupSettings, keep_support=True)
    """Settings of the warm-up."""
    episodes: int = bounded(10, minimum=1, maximum=1000)
    """Real episodes between rounds."""
    rounds: int = bounded(3, minimum=1)
    """Rounds before real episodes; twice as many follow the last ones."""
    copies: int = bounded(2, minimum=1)
    """Goals that each real episode is given in the buffer."""
    imagined: int = bounded(60, minimum=0, maximum=1000)
    """Episodes of a round that the ensemble plays; 0: real ones alone."""
    first: int = bounded(1000, minimum=1)
    """Steps of the critics before the LCS moves."""
    critic_steps: int = bounded(200, minimum=1)
    """Steps of the critics in each later round."""
    actor_steps: int = bounded(10, minimum=1)
    """Steps of the LCS in each round."""
    std: float = bounded(0.005, above=0)
    """Standard deviation of the policy [units of the action]."""
    target_kl: float = bounded(0.1, above=0)
    """KL divergence of a round that the step size aims at; at three times as much the round ends."""

    name: ClassVar[str] = "lcs-sac"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "the warm-up of LCS-RL, then SAC with the MPC as the actor (examples/off_policy.py)"
    reports: ClassVar[tuple[type, ...]] = (WarmupReport, SACReport)

    def trainer(self, work: Work) -> Trainer:
        """See `Method`."""
        lcs = self.initial(work)
        mpc = self.policy(work.task, lcs)
        main: Any = lambda *begun: OffPolicy(lcs, mpc, work, self, *begun)  # noqa: E731
        warmup_steps = round(self.warmup_minutes * work.task.steps_per_minute)
        return LCSRL(warmup_phase(work, lcs, mpc, self.warmup), warmup_steps, main)

    def smoke(self) -> Self:
        """See `Method`."""
        few = {"episodes": 3, "rounds": 1, "imagined": 4, "first": 20, "critic_steps": 5, "actor_steps": 1}
        return replace(super().smoke(), **few)


if __name__ == "__main__":
    sys.exit(cli.main(sys.argv[1:]))
