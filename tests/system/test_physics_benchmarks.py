"""Physics against MuJoCo: how far predictions of a step are off, and a box that is pushed to poses by them."""

from pathlib import Path

import numpy as np
import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _benchmarks(monkeypatch):
    pytest.importorskip("tyro")
    pytest.importorskip("mujoco")
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def test_a_box_is_pushed_to_poses_from_the_wrong_side():
    import box_to_pose

    policy, module = box_to_pose.make_policy()
    episodes = [box_to_pose.play(2000 + k, policy, module) for k in range(20)]
    assert sum(episode.success for episode in episodes) >= 19
    assert np.mean([episode.steps for episode in episodes]) < 45
    assert min(episode.steps for episode in episodes) > 0


# The largest error of a coordinate, as a part of how far it moves, by system and mode.
ERRORS = {
    ("pusher and box, slow, in contact", "quasi-static"): {"position": 0.06, "yaw": 0.15},
    ("pusher and box, slow", "quasi-static"): {"position": 0.15, "yaw": 0.35},
    ("pusher and box that coasts", "velocities"): {"position": 0.25, "yaw": 0.5, "velocity": 0.35},
    ("pusher and box on a floor", "quasi-static"): {"position": 0.3, "yaw": 0.6},
    ("pusher and box on a floor", "velocities"): {"position": 0.35, "yaw": 0.8},
    ("cart-pole, no contact", "velocities"): {"cart": 0.002, "pole": 0.01, "pole velocity": 0.03},
    ("box in the air", "velocities"): {"position": 0.02, "velocity": 1e-6},
    ("box sliding on a floor", "velocities"): {"position": 0.5, "velocity": 0.5},
}


def test_predictions_of_a_step_are_as_near_as_the_docs_say():
    import physics

    options = physics.Options(states=80, batch=10, repeats=1)
    found = {}
    for make in physics.CASES:
        for case in make(options.states, np.random.default_rng(1)):
            found[case.system, case.mode] = physics.measure(case, options)
    for key, limits in ERRORS.items():
        for name, limit in limits.items():
            error, moved = found[key][name]["error"], found[key][name]["moved"]
            assert error < limit * moved, (key, name, error, moved)
    assert torch.get_num_threads() == 1
