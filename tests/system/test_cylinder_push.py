"""The example of Judo's cylinder_push, on a model like Judo's."""

from pathlib import Path

import pytest

BODY = """<body name="{0}"><joint name="{0}_x" damping="4" type="slide" axis="1 0 0"/>
  <joint name="{0}_y" damping="4" type="slide" axis="0 1 0"/>
  <geom name="{0}" type="cylinder" size=".25 .1" mass="1" friction=".01"/></body>"""
MODEL = f"""<mujoco><option timestep=".02"/><worldbody>{BODY.format("pusher")}{BODY.format("cart")}</worldbody>
  <actuator><position joint="pusher_x" kp="10" ctrlrange="-10 10"/>
  <position joint="pusher_y" kp="10" ctrlrange="-10 10"/>
</actuator></mujoco>"""


@pytest.mark.slow
def test_the_cylinder_comes_to_the_origin(monkeypatch, capsys, tmp_path):
    pytest.importorskip("mujoco")
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "examples"))
    import cylinder_push

    (tmp_path / "model.xml").write_text(MODEL)
    cylinder_push.main(cylinder_push.Options(tmp_path / "model.xml", episodes=1, seed=100))
    assert float(capsys.readouterr().out.split("worst ")[1].split(" cm")[0]) < 3
