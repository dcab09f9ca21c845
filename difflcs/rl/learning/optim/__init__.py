"""Rules by which PPO moves a policy."""

from difflcs.rl.learning.optim.natural import Natural, NaturalGradient
from difflcs.rl.learning.optim.update import AdamUpdate, NaturalUpdate, StepSize, UpdateRule

__all__ = ["AdamUpdate", "Natural", "NaturalGradient", "NaturalUpdate", "StepSize", "UpdateRule"]
