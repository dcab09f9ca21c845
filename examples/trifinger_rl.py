"""The cube of trifinger-rl-datasets pushed to a place: `python examples/trifinger_rl.py --episodes 64`.

Simulator, task, reward and evaluation are those of the authors (`trifinger_rl_datasets.Evaluation`, PyBullet, torques
at 50 Hz that act 10 ms late, a pose of the cube that is 90 to 190 ms old, 750 steps). Only the random numbers are
seeded, for which the authors' `python -m trifinger_rl_datasets.evaluate_sim push trifinger_push.policy.PushPolicy` has
no option; and the environment is taken out of Gymnasium's wrappers, which since 1.0 hide what the evaluation asks for.

The reward of a step is sech²(15 d), with d [m] the distance of the cube's centre from the goal: at most 750 an episode.

- contact-mpc: that of `examples/trifinger_push`, from geometry and friction, no data;
- any other name is that of a policy class, as the evaluator takes it. The authors' expert is
  `trifinger_rl_example.example.TorchPushPolicy` of github.com/rr-learning/trifinger-rl-example, to be installed from
  there: it was trained by reinforcement learning in simulation.

Times are CPU times of the policy. The record of a policy is written after each episode.
"""

# The simulator and its packages are no dependency.
# pyright: reportMissingImports=false

import contextlib
import io
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from successes import success_figures

from difflcs.cli.bench import machine, save
from difflcs.errors import MissingDependencyError

OWN = "contact-mpc"
KEYS = ("success_rate", "return", "mean_momentary_success", "transient_success_rate")
"""Of the statistics of an episode, as the evaluation calls them."""


@dataclass
class Options:
    """Pushing of trifinger-rl-datasets."""

    episodes: int = 64
    """Episodes; the authors' evaluator has 64."""
    seed: int = 0
    """Seed of goals and of the cube's places."""
    policy: str = OWN
    """"contact-mpc", or a policy class as the evaluator takes it: package.module.Class."""
    out: Path = Path("benchmarks/results/trifinger_rl.json")
    """Record in which to write this policy's episodes, beside those of others."""


class Timed:
    """A policy with a clock."""

    def __init__(self, policy: Any) -> None:
        self.policy, self.reset = policy, policy.reset
        self.seconds: list[float] = []

    def get_action(self, observation: Any) -> Any:
        """Compute the action and time it; see `PolicyBase`."""
        start = time.process_time()
        action = self.policy.get_action(observation)
        self.seconds.append(time.process_time() - start)
        return action


def policy_class(name: str) -> Any:
    """Load a policy class by name.

    Raises:
        MissingDependencyError: trifinger-rl-datasets is not installed.
    """
    try:
        import trifinger_rl_datasets.evaluate_sim as evaluate
    except ImportError as error:
        raise MissingDependencyError(
            f"expected trifinger-rl-datasets, not installed ({error}); run: pip install trifinger-rl-datasets==1.0.3"
        ) from error
    return evaluate.load_policy_class("trifinger_push.policy.PushPolicy" if name == OWN else name)


def summary(rows: list[list[float]]) -> dict[str, Any]:
    """Compute the figures of a policy."""
    success, returns, momentary, transient, milliseconds = np.array(rows).T
    return {
        **success_figures(success),
        "mean_return": float(returns.mean()),
        "return_error": float(returns.std(ddof=min(1, len(rows) - 1)) / len(rows) ** 0.5),
        "median_return": float(np.median(returns)),
        "momentary_success": float(momentary.mean()),
        "transient_success": float(transient.mean()),
        "milliseconds_per_step": float(milliseconds.mean()),
    }


def main(o: Options) -> None:
    """Run the episodes, print and write the figures."""
    kind = policy_class(o.policy)
    import gymnasium
    from trifinger_rl_datasets import Evaluation
    from trifinger_simulation.tasks import move_cube

    torch.set_num_threads(1)
    wants = kind.get_policy_config()
    env: Any = gymnasium.make(
        "trifinger-cube-push-sim-expert-v0",
        disable_env_checker=True,
        visualization=False,
        flatten_obs=wants.flatten_obs,
        image_obs=wants.image_obs,
    ).unwrapped
    policy = Timed(kind(env.action_space, env.observation_space, env.sim_env.episode_length))
    rows: list[list[float]] = []

    class Recorded(Evaluation):
        """The authors' evaluation, with every episode kept."""

        def run_episode(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
            before = len(policy.seconds)
            with contextlib.redirect_stdout(io.StringIO()):
                result = super().run_episode(*args, **kwargs)
            milliseconds = 1e3 * float(np.mean(policy.seconds[before:]))
            rows.append([round(float(v), 4) for v in (*(result[key] for key in KEYS), milliseconds)])
            record = json.loads(o.out.read_text()) if o.out.exists() else {"results": {}}
            record["results"][o.policy] = {"machine": machine(), "seed": o.seed, **summary(rows), "rows": rows}
            save(o.out, record)
            return result

    np.random.seed(o.seed)  # noqa: NPY002 (from there the package draws the cube's places)
    move_cube.seed(o.seed)  # the goals
    Recorded(env).evaluate(policy, o.episodes)
    for name, value in summary(rows).items():
        print(f"{name:24s} {value:.4g}")


if __name__ == "__main__":
    main(tyro.cli(Options))
