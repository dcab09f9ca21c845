"""Training and evaluation of LCS-MPC policies; needs the extra `rl`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from difflcs.rl._optional import require

require("gymnasium")  # a clear error, before the modules below import it

# ruff: noqa: E402
from difflcs.rl._trifinger import TASKS, Task, get_task
from difflcs.rl.checkpoint import Checkpoint, RunDirectory, load_checkpoint, save_checkpoint
from difflcs.rl.dynamics import Ensemble
from difflcs.rl.evaluate import Evaluation, evaluate, wilson_interval
from difflcs.rl.imagination import Imagination, ImaginationConfig
from difflcs.rl.mlp import MLPConfig, MLPController
from difflcs.rl.natural import NaturalGradient
from difflcs.rl.pddm import PDDM, PDDMConfig
from difflcs.rl.phases import LCSRL
from difflcs.rl.ppo import PPO, PPOConfig
from difflcs.rl.rollout import Rollouts, collect
from difflcs.rl.training import Reporter, TrainConfig, load_model, load_policy, train
from difflcs.rl.warmup import Warmup, WarmupConfig, fit, trust_region

if TYPE_CHECKING:
    from difflcs.rl.policy import LCSMPCPolicy, MLPPolicy, make_actor

__all__ = [
    "LCSRL",
    "PDDM",
    "PPO",
    "TASKS",
    "Checkpoint",
    "Ensemble",
    "Evaluation",
    "Imagination",
    "ImaginationConfig",
    "LCSMPCPolicy",
    "MLPConfig",
    "MLPController",
    "MLPPolicy",
    "NaturalGradient",
    "PDDMConfig",
    "PPOConfig",
    "Reporter",
    "Rollouts",
    "RunDirectory",
    "Task",
    "TrainConfig",
    "Warmup",
    "WarmupConfig",
    "collect",
    "evaluate",
    "fit",
    "get_task",
    "load_checkpoint",
    "load_model",
    "load_policy",
    "make_actor",
    "save_checkpoint",
    "train",
    "trust_region",
    "wilson_interval",
]


def __getattr__(name: str) -> Any:
    # TorchRL takes seconds to import; warm-up and evaluation do without it.
    if name in ("LCSMPCPolicy", "MLPPolicy", "make_actor"):
        from difflcs.rl import policy

        return getattr(policy, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
