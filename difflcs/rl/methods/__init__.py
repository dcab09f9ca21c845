"""Methods of learning, one file each. Other packages register theirs by `register_method`."""

from difflcs.rl.methods.base import LCSMethod, Method, Work, get_method, method_names, register_method
from difflcs.rl.methods.contact_lcs import ContactMethod
from difflcs.rl.methods.frame_lcs import FrameMethod
from difflcs.rl.methods.improve import ImproveMethod
from difflcs.rl.methods.lcs_rl import LCSRLMethod
from difflcs.rl.methods.mujoco_lcs import MujocoMethod
from difflcs.rl.methods.pddm import PDDMMethod
from difflcs.rl.methods.ppo import PPOMethod
from difflcs.rl.methods.ppo_mlp import PPOMLPMethod
from difflcs.rl.methods.violation import ViolationMethod

__all__ = [
    "ContactMethod",
    "FrameMethod",
    "ImproveMethod",
    "LCSMethod",
    "LCSRLMethod",
    "Method",
    "MujocoMethod",
    "PDDMMethod",
    "PPOMLPMethod",
    "PPOMethod",
    "ViolationMethod",
    "Work",
    "get_method",
    "method_names",
    "register_method",
]

DEFAULT_METHOD = LCSRLMethod.name
"""The method of `difflcs train` without `--method`."""

for _method in (
    LCSRLMethod,
    ViolationMethod,
    PPOMethod,
    ImproveMethod,
    PPOMLPMethod,
    PDDMMethod,
    ContactMethod,
    FrameMethod,
    MujocoMethod,
):
    register_method(_method)
