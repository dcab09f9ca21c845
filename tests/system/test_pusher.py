"""The example of Gymnasium's Pusher-v5."""

from pathlib import Path

import pytest


@pytest.mark.slow
def test_the_arm_does_better_than_nothing(monkeypatch, capsys):
    pytest.importorskip("mujoco")
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "examples"))
    import pusher

    monkeypatch.setattr(pusher, "STEPS", 40)
    means = []
    for still in (False, True):
        pusher.main(pusher.Options(episodes=2, seed=100, still=still))
        means.append(float(capsys.readouterr().out.split("mean return ")[1].split(" ")[0]))
    assert means[0] > means[1]
