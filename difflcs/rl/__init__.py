"""Training and evaluation of LCS-MPC policies; needs the extra `rl`."""

from typing import TYPE_CHECKING, Any

from difflcs._optional import require
from difflcs._storage import write_atomically

require("gymnasium")  # a clear error, before the modules below import it

# ruff: noqa: E402
from difflcs.rl import methods
from difflcs.rl.learning.critic import CriticSettings
from difflcs.rl.learning.dynamics import Ensemble, EnsembleSettings
from difflcs.rl.learning.lcsrl import LCSRL
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.learning.model_rollouts import ModelRollouts, ModelRolloutSettings
from difflcs.rl.learning.optim import Natural, NaturalGradient
from difflcs.rl.learning.pddm import PDDM, PDDMSettings
from difflcs.rl.learning.physics_fit import PhysicsFit, PhysicsFitSettings
from difflcs.rl.learning.ppo import PPO
from difflcs.rl.learning.ppo_settings import PPOSettings, make_ppo
from difflcs.rl.learning.trainer import Trainer
from difflcs.rl.learning.warmup import Warmup, WarmupSettings, action_support, fit
from difflcs.rl.methods import *  # noqa: F403
from difflcs.rl.rollout import collect
from difflcs.rl.runs.checkpoint import RunDirectory, load_checkpoint, save_checkpoint
from difflcs.rl.runs.evaluate import Evaluation, evaluate, wilson_interval
from difflcs.rl.runs.trained import TrainedPolicy
from difflcs.rl.runs.training import Reporter, TrainConfig, load_model, load_policy, train
from difflcs.rl.settings import Adam, Epochs, Rollouts, Settings, ViolationLoss, bounded, group
from difflcs.rl.tasks import PhysicsSpec, Quantity, TaskSpec, get_task, register_task, task_names

if TYPE_CHECKING:
    from difflcs.rl.learning.policy import LCSMPCPolicy, MLPPolicy, make_actor

__all__ = [
    "LCSRL",
    "PDDM",
    "PPO",
    "Adam",
    "CriticSettings",
    "Ensemble",
    "EnsembleSettings",
    "Epochs",
    "Evaluation",
    "LCSMPCPolicy",
    "MLPController",
    "MLPPolicy",
    "ModelRolloutSettings",
    "ModelRollouts",
    "Natural",
    "NaturalGradient",
    "PDDMSettings",
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
    "TrainedPolicy",
    "Trainer",
    "ViolationLoss",
    "Warmup",
    "WarmupSettings",
    "action_support",
    "bounded",
    "collect",
    "evaluate",
    "fit",
    "get_task",
    "group",
    "load_checkpoint",
    "load_model",
    "load_policy",
    "make_actor",
    "make_ppo",
    "register_task",
    "save_checkpoint",
    "task_names",
    "train",
    "wilson_interval",
    "write_atomically",
]
__all__ += methods.__all__


def __getattr__(name: str) -> Any:
    # TorchRL takes seconds to import; warm-up and evaluation do without it.
    if name in ("LCSMPCPolicy", "MLPPolicy", "make_actor"):
        from difflcs.rl.learning import policy

        return getattr(policy, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
