"""The example that turns objects in a hand."""

from pathlib import Path

import pytest


@pytest.mark.slow
def test_a_cylinder_is_turned_and_filmed(monkeypatch, capsys, tmp_path):
    pytest.importorskip("mujoco")
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "examples"))
    import hand_turn

    hand_turn.main(hand_turn.Options("cylinder", episodes=2, seed=100, out=tmp_path / "hand.gif"))
    assert "all 2/2" in capsys.readouterr().out
    assert (tmp_path / "hand.gif").stat().st_size > 10_000
