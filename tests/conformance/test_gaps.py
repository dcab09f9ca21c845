"""A few hundred scenes of the campaign of gaps, and what two shapes alone do not show."""

import mujoco
import numpy as np
import pytest
import torch

from difflcs.physics.mujoco import MujocoLCS
from tests.conformance import gaps

CUBE = " ".join(f"{v:g}" for v in (0.05 * gaps.CUBE).ravel())
MESHES = f'<asset><mesh name="cube" vertex="{CUBE}"/><mesh name="slab" vertex="{CUBE}" scale="6 6 1"/>'
SIDES = "0 1 3 0 3 2 4 6 7 4 7 5 0 4 5 0 5 1 2 3 7 2 7 6 0 2 6 0 6 4 1 5 7 1 7 3"  # with which MuJoCo needs no hull
MESHES += f'<mesh name="seen" vertex="{CUBE}" face="{SIDES}"/></asset>'
THINGS = {"cylinder": 'type="cylinder" size=".05 .05"', "cube": 'type="mesh" mesh="cube"'}
THINGS["box"] = 'type="box" size=".05 .05 .05"'
TABLES = {"box": 'type="box" size=".3 .3 .05"', "cylinder": 'type="cylinder" size=".3 .05"'}
TABLES["slab"] = 'type="mesh" mesh="slab"'


def load(bodies, rest=""):
    return mujoco.MjModel.from_xml_string(f"<mujoco>{MESHES}{rest}<worldbody>{bodies}</worldbody></mujoco>")


@pytest.mark.parametrize("pair", gaps.PAIRS, ids="-".join)
def test_gaps_normals_and_points_are_right(pair):
    first = gaps.PAIRS.index(pair)
    judged = [gaps.judge(first + k * len(gaps.PAIRS)) for k in range(8)]
    assert not [j for j in judged if j and j.wrong()]
    assert sum(j is not None for j in judged) >= 6


@pytest.mark.parametrize("thing", THINGS)
@pytest.mark.parametrize("table", TABLES)
def test_what_lies_on_a_table_rests_on_several_points(thing, table):
    body = f'<body pos="0 0 .0499"><freejoint/><geom {THINGS[thing]}/></body>'
    model = load(f'<geom {TABLES[table]} pos="0 0 -.05"/>{body}')
    module = MujocoLCS(model, motion="dynamic", seconds=0.05)
    x = module.state.to_state(model.qpos0)
    found = module.contacts(x)
    torch.testing.assert_close(found.gap[:4], torch.full((4,), -1e-4, dtype=x.dtype), atol=1e-8, rtol=0)
    after = module.params(x).step(x, x.new_zeros(0)).x_next[6:]
    assert after[:3].norm() < 0.01
    assert after[3:].norm() < 0.01


def test_the_nearest_of_many_pairs_are_those_of_all_pairs():
    random, kinds = np.random.default_rng(0), ("sphere", "capsule", "ellipsoid", "cylinder")
    text = ""
    for k in range(24):
        place, turn = random.uniform(-0.25, 0.25, 3), random.normal(size=4)
        geom = f'<geom type="{kinds[k % 4]}" size=".03 .05 .04"/>' if k % 5 else f"<geom {THINGS['cube']}/>"
        pose = f'pos="{" ".join(map(str, place))}" quat="{" ".join(map(str, turn))}"'
        text += f"<body {pose}><freejoint/>{geom}</body>"
    model = load(text)
    few, all_of_them = (MujocoLCS(model, motion="dynamic", contacts=k) for k in (7, 1200))
    x = few.state.to_state(model.qpos0)
    nearest = all_of_them.contacts(x).gap.sort().values
    assert float(nearest[-1]) == all_of_them.contacts(x).gap.max()
    torch.testing.assert_close(few.contacts(x).gap.sort().values, nearest[:7], rtol=0, atol=1e-12)


SETTINGS = {
    "a gap": ('gap=".05"', "", {}),
    "a pair": ('contype="0" conaffinity="0"', '<contact><pair geom1="a" geom2="b" gap=".2"/></contact>', {}),
    "names": ('contype="0" conaffinity="0"', "", {"pairs": [("a", "b")]}),
    "another algorithm": ("", '<option ccd_iterations="3"><flag nativeccd="disable"/></option>', {}),
    "a mesh for the eye": ('type="mesh" mesh="seen" contype="0" conaffinity="0"', "", {"pairs": [("a", "b")]}),
    "a short distance": ("", "", {"distance": 1e-3}),
}


@pytest.mark.parametrize("case", SETTINGS)
def test_gaps_do_not_depend_on_settings_of_the_model(case):
    attributes, rest, options = SETTINGS[case]
    cylinder = attributes if "mesh" in attributes else f"{THINGS['cylinder']} {attributes}"
    body = f'<body pos="0 0 .0995"><freejoint/><geom name="b" {cylinder}/><geom size=".01" pos=".3 0 0"/></body>'
    model = load(f'<geom name="a" {cylinder}/>{body}', rest)
    module = MujocoLCS(model, motion="dynamic", **options)
    gap = module.contacts(module.state.to_state(model.qpos0)).gap
    assert gap.min().item() == pytest.approx(-5e-4, abs=1e-8)
    assert (gap < 0).sum() == 4
