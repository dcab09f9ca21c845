"""Training and evaluation of LCS-MPC policies; needs the extra `rl`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from difflcs.rl._optional import require

require("gymnasium")  # a clear error, before the modules below import it

# ruff: noqa: E402
from difflcs._storage import write_atomically
from difflcs.rl.checkpoint import RunDirectory, load_checkpoint, save_checkpoint
from difflcs.rl.contact_method import (
    ContactMethod,
    PhysicsFit,
    PhysicsFitSettings,
)  # behind methods: it is not the default
from difflcs.rl.critic import CriticSettings
from difflcs.rl.dynamics import Ensemble, EnsembleSettings
from difflcs.rl.evaluate import Evaluation, evaluate, wilson_interval
from difflcs.rl.lcs_rl import LCSRL
from difflcs.rl.methods import (
    LCSMethod,
    LCSRLMethod,
    Method,
    PDDMMethod,
    PPOMethod,
    PPOMLPMethod,
    ViolationMethod,
    Work,
    get_method,
    method_names,
    register_method,
)
from difflcs.rl.mlp import MLPController
from difflcs.rl.model_rollouts import ModelRollouts, ModelRolloutSettings
from difflcs.rl.optim import Natural, NaturalGradient
from difflcs.rl.pddm import PDDM, PDDMSettings
from difflcs.rl.ppo import PPO
from difflcs.rl.ppo_settings import PPOSettings, make_ppo
from difflcs.rl.rollout import collect
from difflcs.rl.settings import Adam, Epochs, Rollouts, Settings, ViolationLoss, bounded, group
from difflcs.rl.tasks import PhysicsSpec, Quantity, TaskSpec, get_task, register_task, task_names
from difflcs.rl.trainer import Trainer
from difflcs.rl.training import Reporter, TrainConfig, load_model, load_policy, train
from difflcs.rl.warmup import Warmup, WarmupSettings, action_support, fit

if TYPE_CHECKING:
    from difflcs.rl.policy import LCSMPCPolicy, MLPPolicy, make_actor

__all__ = [
    "LCSRL",
    "PDDM",
    "PPO",
    "Adam",
    "ContactMethod",
    "CriticSettings",
    "Ensemble",
    "EnsembleSettings",
    "Epochs",
    "Evaluation",
    "LCSMPCPolicy",
    "LCSMethod",
    "LCSRLMethod",
    "MLPController",
    "MLPPolicy",
    "Method",
    "ModelRolloutSettings",
    "ModelRollouts",
    "Natural",
    "NaturalGradient",
    "PDDMMethod",
    "PDDMSettings",
    "PPOMLPMethod",
    "PPOMethod",
    "PPOSettings",
    "PhysicsFit",
    "PhysicsFitSettings",
    "PhysicsSpec",
    "Quantity",
    "Reporter",
    "Rollouts",
    "RunDirectory",
    "Settings",
    "TaskSpec",
    "TrainConfig",
    "Trainer",
    "ViolationLoss",
    "ViolationMethod",
    "Warmup",
    "WarmupSettings",
    "Work",
    "action_support",
    "bounded",
    "collect",
    "evaluate",
    "fit",
    "get_method",
    "get_task",
    "group",
    "load_checkpoint",
    "load_model",
    "load_policy",
    "make_actor",
    "make_ppo",
    "method_names",
    "register_method",
    "register_task",
    "save_checkpoint",
    "task_names",
    "train",
    "wilson_interval",
    "write_atomically",
]


def __getattr__(name: str) -> Any:
    # TorchRL takes seconds to import; warm-up and evaluation do without it.
    if name in ("LCSMPCPolicy", "MLPPolicy", "make_actor"):
        from difflcs.rl import policy

        return getattr(policy, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
