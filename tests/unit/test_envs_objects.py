"""The objects: meshes, rest poses, convex parts, stand-ins, and how they lie, slide and turn."""

import json
import math
import pickle
import time
from concurrent.futures import ThreadPoolExecutor

import coacd
import numpy as np
import pytest
import trimesh

from difflcs_envs import MeshError
from difflcs_envs.trifinger import meshes
from difflcs_envs.trifinger.env import TriFingerMoveCubeEnv, TriFingerMoveObjectEnv, TriFingerTurnCubeEnv
from difflcs_envs.trifinger.model import FINGER_YAWS
from difflcs_envs.trifinger.section import cross_section
from difflcs_envs.ycb import YCB
from tests.conftest import refuse

OUTWARD = np.stack([-np.sin(FINGER_YAWS), np.cos(FINGER_YAWS)], axis=1)
REST = np.zeros(6)


pytestmark = pytest.mark.usefixtures("stand_ins")


def make(name="mug", **arguments):
    return TriFingerMoveObjectEnv(**{"object": str(name), "reset_noise": 0.0, **arguments})


def stand_in(name, **arguments):
    return make(name, object_source="stand_in", **arguments)


def bracket():
    """An L of 60 x 60 x 30 mm: not convex, watertight."""
    outline = 0.001 * np.array([[0, 0], [60, 0], [60, 20], [20, 20], [20, 60], [0, 60]])
    flat = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    n = len(outline)
    vertices = np.concatenate([np.c_[outline, np.zeros(n)], np.c_[outline, np.full(n, 0.03)]])
    sides = [f for i in range(n) for j in [(i + 1) % n] for f in ([i, j, n + j], [i, n + j, n + i])]
    faces = [f[::-1] for f in flat] + [[n + a, n + b, n + c] for a, b, c in flat] + sides
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.fixture
def stl(tmp_path):
    def write(mesh, name="thing.stl"):
        path = tmp_path / name
        mesh.export(path)
        return path

    return write


# --- meshes ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_any_mesh(stl):
    mesh = bracket()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(1.0, [1, 2, 3], [0.1, 0.2, 0.3]))
    env = make(stl(mesh))
    thing = env.object
    assert (thing.name, thing.source, thing.mass) == ("thing", "mesh", 0.05)
    assert len(thing.solid.parts) > 1
    # It lies on its large face, whose height above the centre is 15 mm, with its centre of mass at the origin.
    assert thing.rest_height == pytest.approx(0.015, abs=2e-4)
    assert thing.height == pytest.approx(0.03, abs=2e-4)
    assert thing.tip_height == pytest.approx(0.015, abs=2e-4)
    np.testing.assert_allclose(trimesh.Trimesh(thing.solid.vertices, thing.solid.faces).center_mass, 0, atol=1e-9)
    body = env.model.body("object")
    assert body.mass[0] == pytest.approx(0.05)
    expected = np.sort(np.linalg.eigvalsh(0.05 * mesh.moment_inertia / mesh.volume))
    np.testing.assert_allclose(np.sort(body.inertia), expected, rtol=1e-6)
    env.reset(seed=0)
    assert np.isfinite(env.step(REST)[1])
    assert pickle.loads(pickle.dumps(env)).object.describe() == thing.describe()


@pytest.mark.parametrize(
    ("break_it", "arguments", "message"),
    [
        (lambda m: m.update_faces(np.arange(len(m.faces)) > 5), {}, "watertight"),
        (lambda m: m.apply_scale(1000), {}, "mesh_scale=0.001"),
        (lambda m: m.apply_scale(0.001), {}, "metres"),
        (lambda m: m.apply_scale([1, 1, 0]), {}, "watertight|empty"),
        (lambda m: m.update_faces(np.arange(len(m.faces)) < 2), {}, "at least 4 triangles"),
    ],
)
def test_bad_meshes(stl, break_it, arguments, message):
    mesh = trimesh.creation.box((0.06, 0.04, 0.03)).subdivide()
    break_it(mesh)
    refuse(MeshError, message, make, stl(mesh), **arguments)


def test_inside_out_and_debris_are_mended(stl):
    box = trimesh.creation.box((0.06, 0.04, 0.03)).subdivide().subdivide()
    crumb = trimesh.creation.box((0.001, 0.001, 0.001)).apply_translation([0, 0, 0.1])
    crumb.update_faces(np.arange(len(crumb.faces)) > 0)  # open: the whole is not watertight
    box.invert()
    env = make(stl(trimesh.util.concatenate([box, crumb])))
    np.testing.assert_allclose(np.sort(env.object.solid.size), [0.03, 0.04, 0.06], atol=1e-6)


def test_missing_and_unreadable_files(tmp_path):
    refuse(MeshError, "does not exist", make, tmp_path / "none.stl")
    (tmp_path / "text.stl").write_text("hello")
    refuse(MeshError, r"cannot be read|empty", make, tmp_path / "text.stl")
    (tmp_path / "text.txt").write_text("hello")
    refuse(MeshError, "mesh file such as", make, tmp_path / "text.txt")


def test_an_object_too_large_for_the_hand(stl):
    refuse(ValueError, r"stand around, got thing of 440 x 440 mm", make, stl(trimesh.creation.box((0.44, 0.44, 0.05))))


def test_a_mesh_that_would_take_minutes_is_refused_at_once(stl, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.03)  # 81 920 triangles: 42 s before
    start = time.monotonic()
    with pytest.raises(MeshError, match=r"at most 20000 triangles, got 81920: ball\..*Decimate.*face_count=5000"):
        meshes.make_solid(ball, "ball")
    refuse(MeshError, r"at most 20000 triangles, got 81920: .*thing\.stl", make, stl(ball))
    with (tmp_path / "huge.stl").open("wb") as file:
        file.truncate(1 << 40)
    refuse(MeshError, r"at most 32 MB, got 1048576 MB: .*huge\.stl.*Simplify", make, tmp_path / "huge.stl")
    assert time.monotonic() - start < 10


@pytest.mark.parametrize(("pose", "height"), [("lying", 15), (0, 15), (2, 20), (4, 30), ("upright", 30)])
def test_rest_poses_of_a_box(stl, pose, height):
    env = make(stl(trimesh.creation.box((0.04, 0.03, 0.06))), rest_pose=pose)
    assert env.object.rest_height == pytest.approx(1e-3 * height)
    assert env.object.solid.size[0] >= env.object.solid.size[1] - 1e-9 or pose == "upright"  # stored upright: kept
    env.reset(seed=0)
    before = env.data.xpos[env.model.body("object").id].copy()
    for _ in range(10):
        env.step(REST)
    assert np.linalg.norm(env.data.xpos[env.model.body("object").id] - before) < 1e-4


def test_there_are_as_many_rest_poses_as_stable_faces():
    box = trimesh.creation.box((0.06, 0.04, 0.03))
    heights = [round(1e3 * pose.height) for pose in meshes.rest_poses(box.vertices, np.zeros(3))]
    assert heights == [15, 15, 20, 20, 30, 30]
    for pose in meshes.rest_poses(box.vertices, np.zeros(3)):
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose.rotation) == pytest.approx(1)
        assert (box.vertices @ pose.rotation.T)[:, 2].min() == pytest.approx(-pose.height)
    needle = trimesh.creation.box((0.1, 0.1, 0.002)).vertices
    assert len(meshes.rest_poses(needle, np.zeros(3))) == 2  # on edge it falls over


@pytest.mark.slow
def test_parts_are_cached_and_a_damaged_cache_is_mended(stl, tmp_path, monkeypatch):
    monkeypatch.setenv("DIFFLCS_CACHE_DIR", str(tmp_path / "cache"))
    calls = []
    decompose = coacd.run_coacd
    monkeypatch.setattr(coacd, "run_coacd", lambda *a, **k: calls.append(a) or decompose(*a, **k))
    path = stl(bracket())
    first = make(path).object.describe()
    (cached,) = (tmp_path / "cache" / "parts").iterdir()
    assert make(path).object.describe() == first
    assert len(calls) == 1
    make(path, mesh_parts=2)
    assert len(calls) == 2  # other settings, other parts
    cached.write_bytes(cached.read_bytes()[:-100])
    assert make(path).object.describe() == first
    assert len(calls) == 3
    with ThreadPoolExecutor(4) as pool:
        cached.unlink()
        assert all(r == first for r in pool.map(lambda _: make(path).object.describe(), range(4)))
    assert len(calls) == 4  # the others wait
    assert all(not p.name.startswith(".") for p in cached.parent.iterdir())


@pytest.mark.slow
def test_a_cache_that_cannot_be_written_is_done_without(stl, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DIFFLCS_CACHE_DIR", str(tmp_path / "file"))
    assert len(make(stl(bracket())).object.solid.parts) > 1


# --- stand-ins ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(YCB))
def test_stand_ins_have_size_mass_and_rest(name):
    entry = YCB[name]
    env = stand_in(name)
    env.reset(seed=0)
    assert env.object.source == "stand_in"
    assert env.object.describe()["source"] == "stand_in"
    json.dumps(env.object.describe())
    outline = env.object.outline
    np.testing.assert_allclose(np.ptp(outline, axis=0), entry.size[:2], atol=0.004)
    assert env.object.height == entry.size[2]
    body = env.model.body("object")
    assert body.mass[0] == pytest.approx(0.05)
    start = env.data.qpos[:7].copy()
    energy = []
    for _ in range(10):
        env.step(REST)
        energy.append(0.5 * env.data.qvel[:6] @ env.data.qvel[:6])
    assert np.linalg.norm(env.data.qpos[:3] - start[:3]) < 1e-4  # drift within 1 s
    assert 2 * math.acos(min(1.0, abs(env.data.qpos[3:7] @ start[3:7]))) < np.deg2rad(0.5)
    assert env.physics.max_penetration() < 1e-4
    assert energy[-1] < 1e-6
    assert max(energy[5:]) <= max(energy[:5]) + 1e-9
    assert stand_in(name, object_mass="true").model.body("object").mass[0] == pytest.approx(entry.mass)


@pytest.mark.parametrize("name", list(YCB))
def test_objects_slide_and_turn_when_pushed(name):
    env = stand_in(name, horizon=100, osc_kp=2500.0)
    state = start = env.reset(seed=0)[0]["state"]
    deepest = 0.0
    for step in range(25):
        action = np.zeros((3, 2))
        action[0] = -0.012 * OUTWARD[0]
        if step >= 12:
            action[1] = -0.012 * OUTWARD[1]
        state = env.step(action.ravel())[0]["state"]
        deepest = max(deepest, env.physics.max_penetration())
        assert env.data.xmat[env.model.body("object").id][8] > np.cos(np.deg2rad(20))  # it does not topple
    assert np.linalg.norm(state[:2] - start[:2]) > 0.02
    assert deepest < 0.001


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "noise", "episodes"),
    [
        (TriFingerMoveCubeEnv, 0.0, 20),
        (TriFingerMoveCubeEnv, 0.003, 20),
        (TriFingerMoveCubeEnv, 0.005, 20),
        (TriFingerTurnCubeEnv, 0.005, 60),  # rarely, three fingers jam the cube, which cannot give way
    ],
)
def test_no_deep_contact_under_noisy_pushing(make, noise, episodes):
    """Commands as exploration gives them: all tips towards the cube, with noise, clipped to ±15 mm."""
    env = make()
    rng = np.random.default_rng(0)
    deepest = 0.0
    for seed in range(episodes):
        state = env.reset(seed=seed)[0]["state"]
        for _ in range(20):
            inwards = (state[:2] - state[3:].reshape(3, 2)).ravel()
            state = env.step(np.clip(0.5 * inwards + noise * rng.standard_normal(6), -0.015, 0.015))[0]["state"]
            deepest = max(deepest, env.physics.max_penetration())
    assert 0 < deepest < 0.001


# --- arguments ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"object": "teapot"}, r"object out of sugar_box, .*got 'teapot'"),
        ({"object": 3}, r"a name or a path, got 3"),
        ({"object_source": "photo"}, r"object_source.*'photo'"),
        ({"object_source": "mesh"}, r"difflcs assets download mug"),
        ({"object_mass": "heavy"}, r"object_mass.*'heavy'"),
        ({"object_mass": -1.0}, r"object_mass.*-1"),
        ({"object_source": "stand_in", "rest_pose": "upright"}, r"rest_pose.*need the mesh"),
        ({"mesh_parts": 0}, r"mesh_parts"),
        ({"mesh_scale": 0.0}, r"mesh_scale"),
        ({"reward_weights": {"time": 1.0}}, r"tips, position, yaw, action, got also \['time'\]"),
        ({"reward_weights": {"tips": -1.0}}, r"reward_weights\['tips'\]"),
    ],
)
def test_bad_arguments(arguments, message):
    refuse(ValueError, message, make, **arguments)


def test_what_an_own_mesh_does_not_have_is_refused(stl):
    path = stl(trimesh.creation.box((0.06, 0.04, 0.03)))
    refuse(ValueError, "no mass is published", make, path, object_mass="true")
    refuse(ValueError, "Only YCB objects", make, path, object_source="stand_in")
    refuse(ValueError, r"stable poses of thing.stl.*0: 15.0 mm.*got 9", make, path, rest_pose=9)


@pytest.mark.parametrize("name", ["extra_large_clamp", "wrench", "banana"])
def test_tips_start_clear_of_long_objects_whatever_the_noise(name):
    env = stand_in(name, reset_noise=0.1)
    for seed in range(40):
        state = env.reset(seed=seed)[0]["state"]
        c, s = np.cos(state[2]), np.sin(state[2])
        outline = env.object.outline @ [[c, s], [-s, c]] + state[:2]
        for tip, outward in zip(state[3:].reshape(3, 2), OUTWARD, strict=True):
            assert tip @ outward >= (outline @ outward).max() + 0.0095
        assert env.physics.max_penetration() < 1e-4


# --- turning --------------------------------------------------------------------------------------


def test_turning_task():
    env = TriFingerTurnCubeEnv()
    goals = np.array([env.reset(seed=seed)[0]["goal"] for seed in range(200)])
    np.testing.assert_array_equal(goals[:, :2], 0.0)
    assert goals[:, 2].max() > 1.4
    assert goals[:, 2].min() < -1.4
    assert np.abs(goals).max() <= 1.5
    assert env.object.describe()["pinned"]
    _, info = env.reset(seed=0, options={"goal": [0, 0, 1.5], "state": [0, 0, 1.4, *(0.0977 * OUTWARD).ravel()]})
    assert info["success"]
    assert info["yaw_error"] == pytest.approx(0.1)
    for bad in ([0.01, 0, 0], [0, 0, 1.6]):
        refuse(ValueError, "task space", env.reset, options={"goal": bad})
        refuse(ValueError, "turns about the middle", env.reset, options={"state": [*bad, *(0.0977 * OUTWARD).ravel()]})


def test_the_pivot_turns_and_stays():
    env = TriFingerTurnCubeEnv(reset_noise=0.0, horizon=100)
    tips = 0.0977 * OUTWARD
    tips[0] += [0.025, 0.0]
    state = env.reset(seed=0, options={"state": [0, 0, 0, *tips.ravel()]})[0]["state"]
    for _ in range(10):
        state = env.step(np.concatenate([[0, -0.012], np.zeros(4)]))[0]["state"]
    np.testing.assert_array_equal(state[:2], 0.0)
    assert state[2] < -0.2
    assert env.physics.max_penetration() < 0.001


# --- physics against the measured facts -----------------------------------------------------------


def test_pulling_at_the_end_of_the_reach_stays_finite():
    env = TriFingerMoveCubeEnv(reset_noise=0.0, horizon=200)
    env.reset(seed=0)
    for _ in range(60):
        observation, _, _, _, info = env.step(0.015 * OUTWARD.ravel())
        assert not info["physics_error"]
    assert observation in env.observation_space
    for _ in range(20):  # and the tips come back
        observation = env.step(-0.015 * OUTWARD.ravel())[0]
    assert np.all(np.linalg.norm(observation["state"][3:].reshape(3, 2), axis=1) < 0.2)


# --- cross sections ---------------------------------------------------------------------------------------------------


def area(polygon):
    x, y = polygon.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def test_the_cross_section_of_what_is_no_prism_is_that_at_the_height_of_the_tips(stl):
    """A cone without its top: its section narrows with the height, and 4 mm below the tips counts too."""
    ring = np.linspace(0, 2 * math.pi, 64, endpoint=False)
    circle = np.c_[np.cos(ring), np.sin(ring)]
    frustum = np.concatenate([np.c_[0.03 * circle, np.zeros(64)], np.c_[0.015 * circle, np.full(64, 0.04)]])
    env = make(stl(trimesh.convex.convex_hull(frustum)))
    (found,) = cross_section(env.object)
    assert env.object.tip_height == pytest.approx(0.02, abs=1e-6)
    assert np.linalg.norm(found, axis=1).max() == pytest.approx(0.03 - 0.015 * 16 / 40, abs=1e-4)
    assert area(found) > 0  # counterclockwise
    env.close()


def test_the_cross_section_of_a_bracket_is_the_bracket(stl):
    env = make(stl(bracket()))
    parts = cross_section(env.object)
    assert len(parts) >= 2
    corners = np.concatenate(parts)
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.06, 0.06], atol=1e-3)
    # The notch stays free: no part contains its middle, seen from the corner of the bracket.
    corner = corners.min(axis=0)
    for part in parts:
        side, to = np.roll(part, -1, 0) - part, corner + 0.04 - part
        assert (side[:, 0] * to[:, 1] - side[:, 1] * to[:, 0]).min() < 0
    env.close()
