"""Success rate of a policy, with its confidence interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from difflcs._checks import check_positive_int
from difflcs.errors import InvalidInputError
from difflcs.records import LCSModule, LCSParams
from difflcs.rl.rollout import Policy, action_bounds, check_env, collect, mpc_actions
from difflcs.rl.runs.delay import delay_actions, make_predictor
from difflcs.rl.seeding import Stream, episode_seeds
from difflcs.rl.tasks import Quantity
from difflcs.zoo import success_text

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv
    from tensordict import TensorDict


@dataclass(frozen=True)
class Evaluation:
    """Outcome of one evaluation.

    Attributes:
        success_rate: successes per goal.
        ci_low: lower end of the Wilson 95 % interval.
        ci_high: its upper end.
        successes: goals reached.
        goals: goals tried, one episode each.
        seed: what the goals and initial states were drawn from.
        median_errors: name → median over the goals of each error that the environment reports after the last step, in
            its units.
        solver_failures: MPC solves that did not converge.
        solves: MPC solves.
        unstable: episodes in which the simulation broke down; they count as failures.
    """

    success_rate: float
    ci_low: float
    ci_high: float
    successes: int
    goals: int
    seed: int
    median_errors: Mapping[str, float]
    solver_failures: int
    solves: int
    unstable: int

    def __str__(self) -> str:
        return success_text(vars(self)) + (f", {self.unstable} episodes unstable" if self.unstable else "")

    def summary(self) -> str:
        """Success and what went wrong, in one line."""
        return f"success {self}, {self.solver_failures} of {self.solves} solves failed"


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a binomial proportion.

    (p̂ + z²/2n ± z·sqrt(p̂(1 − p̂)/n + z²/4n²)) / (1 + z²/n). Unlike p̂ ± z·sqrt(p̂(1 − p̂)/n) it stays within [0, 1] and
    does not shrink to a point at 0 or n successes.

    Args:
        successes: 0 … trials.
        trials: at least 1.
        confidence: in (0, 1).

    Returns:
        Lower and upper end.
    """
    check_positive_int("trials", trials)
    if not 0 <= successes <= trials:
        raise InvalidInputError(f"successes: expected 0 to trials={trials}, got {successes}")
    if not 0 < confidence < 1:
        raise InvalidInputError(f"confidence: expected a number between 0 and 1, got {confidence}")
    z2 = NormalDist().inv_cdf(0.5 + confidence / 2) ** 2
    rate = successes / trials
    centre = rate + z2 / (2 * trials)
    half = math.sqrt(z2 * (rate * (1 - rate) / trials + z2 / (4 * trials**2)))
    scale = 1 + z2 / trials
    # Exact at the ends, where rounding would leave ±1e-17.
    low = 0.0 if successes == 0 else (centre - half) / scale
    high = 1.0 if successes == trials else (centre + half) / scale
    return low, high


def evaluate(
    env: VectorEnv,
    policy: Policy,
    goals: int,
    seed: int,
    episode_steps: int = 20,
    u_min: Tensor | None = None,
    u_max: Tensor | None = None,
    after_step: Callable[[int], object] | None = None,
    delay: int = 0,
    model: LCSModule | LCSParams | None = None,
    errors: Sequence[Quantity] = (),
) -> Evaluation:
    """Run one noise-free episode per goal; every solve starts cold.

    The same call gives the same result bit for bit. A smaller evaluation uses the first goals of a larger one with the
    same seed. Another number of environments changes the solver's rounding (1e-15, which contact may amplify), and the
    random numbers of a policy that draws them for the whole batch, as PDDM does.

    Args:
        env: vector of environments, stepped in lockstep.
        policy: an `LCSMPCLayer`, or another policy that maps states and goals to actions, see `Policy`.
        goals: number of episodes.
        seed: of the goals and the initial states.
        episode_steps: steps of one episode.
        u_min: lower bounds (n_u,) of the MPC; the policy's own if None.
        u_max: upper bounds (n_u,).
        after_step: called with the number of episodes stepped, for progress bars.
        delay: steps by which actions come late, see `difflcs.rl.runs.delay`.
        model: predicts the state at which a late action will be executed, such as `policy.lcs`; None: plans begin at
            the state as observed.
        errors: those of the task, which the environment has to report.

    Returns:
        The success rate with its interval, and what went wrong.

    Raises:
        InvalidInputError: a number does not fit, or the environment, which reports each of `errors`; see `collect`.
    """
    goals, seed = check_positive_int("goals", goals), check_positive_int("seed", seed, minimum=0)
    delay = check_positive_int("delay", delay, minimum=0)
    parts: list[TensorDict] = []
    for first in range(0, goals, check_env(env).num_envs):
        count = min(env.num_envs, goals - first)
        report = None if after_step is None else lambda count=count: after_step(count)
        act = mpc_actions(policy, u_min, u_max)
        if delay:
            n_u = len(action_bounds(env)[0])
            act = delay_actions(act, n_u, delay, None if model is None else make_predictor(model))
        parts.append(collect(env, act, episode_seeds(seed, Stream.EVALUATION, first, count), episode_steps, report))
    successes = sum(int(part["success"].sum()) for part in parts)
    low, high = wilson_interval(successes, goals)
    names: Any = parts[0]["errors"].keys()  # pyright: ignore[reportAttributeAccessIssue]
    reported = {name: torch.cat([part["errors", name].abs() for part in parts]) for name in sorted(names)}
    unstable = sum(int((~part["stable"]).sum()) for part in parts)
    if (missing := [e.name for e in errors if e.name not in reported]) and unstable < goals:
        raise InvalidInputError(
            f"env: expected {', '.join(missing)} in the info of its last step, as `errors` of the task has them, got "
            f"{', '.join(reported) or 'none'}; report them under names that end in `_error`, or drop them from the task"
        )
    return Evaluation(
        success_rate=successes / goals,
        ci_low=low,
        ci_high=high,
        successes=successes,
        goals=goals,
        seed=seed,
        median_errors={name: float(values.nanquantile(0.5)) for name, values in reported.items()},
        solver_failures=sum(int(part["failures"].sum()) for part in parts),
        solves=goals * episode_steps,
        unstable=unstable,
    )
