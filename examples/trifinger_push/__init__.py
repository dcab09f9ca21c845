"""Pushing the cube of trifinger-rl-datasets by sampling-based contact MPC, without data.

    cd examples && python -m trifinger_rl_datasets.evaluate_sim push trifinger_push.policy.PushPolicy

- fingers.py: geometry of a finger, that of `trifinger_lift.py`
- control.py: torques that lead the tips along references
- cube.py: where the cube is now, from a pose that is late
- places.py: which finger could push where, and how it gets there
- policy.py: `PushPolicy`, all of it together
"""
