"""Physics against MuJoCo: a box is pushed to poses by plans through its system."""

from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _examples(monkeypatch):
    pytest.importorskip("tyro")
    pytest.importorskip("mujoco")
    monkeypatch.syspath_prepend(str(EXAMPLES))


def test_a_box_is_pushed_to_poses_from_the_wrong_side():
    import box_to_pose

    policy, module = box_to_pose.make_policy()
    episodes = [box_to_pose.play(2000 + k, policy, module) for k in range(20)]
    assert sum(episode.success for episode in episodes) >= 19
    assert np.mean([episode.steps for episode in episodes]) < 45
    assert min(episode.steps for episode in episodes) > 0
