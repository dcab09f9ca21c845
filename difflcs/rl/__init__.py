"""Training and evaluation of LCS-MPC policies; needs the extra `rl`."""

from difflcs.rl.checkpoint import Checkpoint, RunDirectory, load_checkpoint, save_checkpoint
from difflcs.rl.evaluate import Evaluation, evaluate, wilson_interval
from difflcs.rl.rollout import Rollouts, collect
from difflcs.rl.tasks import TASKS, Task, get_task
from difflcs.rl.training import Reporter, TrainConfig, load_model, train
from difflcs.rl.warmup import Warmup, WarmupConfig, fit, trust_region

__all__ = [
    "TASKS",
    "Checkpoint",
    "Evaluation",
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
    "save_checkpoint",
    "train",
    "trust_region",
    "wilson_interval",
]
