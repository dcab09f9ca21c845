"""Pushing the cube of trifinger-rl-datasets by sampling-based contact MPC, without data.

    cd benchmarks/scoreboard && python -m trifinger_rl_datasets.evaluate_sim push trifinger_push.PushPolicy

- fingers.py: geometry of a finger
- control.py: torques that lead the tips along references
- cube.py: where the cube is now, from a pose that is late
- places.py: which finger could push where, and how it gets there
- policy.py: `PushPolicy`, all of it together
"""

from typing import Any


def __getattr__(name: str) -> Any:
    """Import `PushPolicy` on demand: it needs the simulator's packages, the geometry does not."""
    if name == "PushPolicy":
        from trifinger_push.policy import PushPolicy

        return PushPolicy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
