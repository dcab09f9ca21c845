"""The method improve: PPO from a model that works already, replaced only by what is better."""

from dataclasses import dataclass
from typing import ClassVar

from difflcs.rl.learning.ppo_settings import PPOSettings
from difflcs.rl.methods.ppo import PPOMethod
from difflcs.rl.settings import group


@dataclass(frozen=True)
class ImproveMethod(PPOMethod):
    """PPO from the model of --init, which it replaces only where it is better in the robot's own episodes."""

    ppo: PPOSettings = group(PPOSettings, gain=1.65)
    """Settings of PPO."""

    name: ClassVar[str] = "improve"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "PPO from the model of --init, which only a better one replaces"
