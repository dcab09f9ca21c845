"""Push-T of gym-pusht, gym-pushany and Fetch from outside: scoreboards, learning from random pushing, the film."""

import importlib.util
import json
import math
from types import SimpleNamespace

import fetch_policies as fetch
import numpy as np
import push_t
import pusht as board
import pytest
import torch

from difflcs.physics import PDDrive

KEYS = {"success_rate", "ci_low", "ci_high", "episodes", "mean_steps", "milliseconds_per_step", "coverage"}


def line_of(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_step_of_the_disc_is_predicted_as_the_environment_makes_it_and_tells_scale_and_friction():
    hypotheses = [[0.8, 0.0], [1.0, 0.0], [1.0, 0.5], [1.25, 0.0]]
    predict = push_t.DiscContact(push_t.tee_pushing())
    seen = push_t.ContextFilter(predict, hypotheses, 0.01, hopeless=10.0, angles=(2,))
    # From below, left of the middle: the disc is away, then pushes, and the body turns beyond half a turn.
    x = np.array([0.0, 0.0, math.pi - 0.01, -0.3, 1.5, 0.0, 0.0])
    truth = np.array(hypotheses[2:3])
    for step in range(6):
        sent = np.array([0.05, -0.6 if step else 0.0])
        x_next = predict(x, sent, truth)[0]
        seen.update(x, sent, x_next)
        if not step:
            np.testing.assert_allclose(seen.probabilities, 0.25)
        A, b, _ = push_t.DRIVE.step()
        disc = A.numpy() @ x[3:].reshape(2, 2) + np.outer(b.numpy(), sent)
        x_next[2] = (x_next[2] + math.pi) % (2 * math.pi) - math.pi
        x = np.concatenate([x_next, disc.ravel()])
    assert seen.best == 2
    np.testing.assert_allclose(seen.mean, [1.0, 0.5], atol=1e-2)


@pytest.mark.slow  # plays
def test_predictions_are_those_of_pymunk():
    env, policy, errors = push_t.make_env(), push_t.PushTPolicy(), []
    observation, _ = env.reset(seed=1000)
    for shape in env.unwrapped.agent.shapes | env.unwrapped.block.shapes:
        shape.friction = 0.3**0.5
    for _ in range(25):
        velocity = np.array(env.unwrapped.agent.velocity) / push_t.PIXELS
        target = policy.act(observation)
        x = np.concatenate([push_t.from_origin(observation[2:]), observation[:2] / push_t.PIXELS, velocity])
        observation, *_ = env.step(target)
        predicted = push_t.DiscContact(policy.told)(x, target / push_t.PIXELS - x[3:5], np.array([[1.0, 0.3]]))[0]
        happened = push_t.from_origin(observation[2:])
        error = predicted - happened
        error[2] = (error[2] + math.pi) % (2 * math.pi) - math.pi
        moved = np.abs(happened[:2] - x[:2]).max()
        if moved > 0.02:
            errors.append(np.abs(error).max())
    assert len(errors) > 5
    assert np.median(errors) < 1e-6
    assert max(errors) < 0.02  # where pymunk's own iterations have not converged


@pytest.mark.slow  # plays
def test_the_scoreboard_prints_its_keys_and_goes_on_where_it_was(capsys, tmp_path, monkeypatch):
    out = tmp_path / "pusht.json"

    def play(**options):
        board.main(board.Options(1, variant="noise 2 px", json=True, smoke=True, out=out, **options))

    play()
    first = line_of(capsys)
    assert set(first) >= KEYS
    assert (first["episodes"], first["mean_steps"], first["variant"]) == (1, 5, "noise 2 px")
    monkeypatch.setattr(board, "play", None)
    play()  # from the record
    assert line_of(capsys) == first
    with pytest.raises(ValueError, match="name another file"):
        play(seed=5)


@pytest.mark.skipif(importlib.util.find_spec("gym_pushany") is None, reason="needs gym-pushany: pip install it")
@pytest.mark.slow  # plays
def test_the_scoreboard_of_shapes_prints_its_keys_and_knows_turns_that_mean_the_same(capsys):
    import push_any

    push_any.main(push_any.Options(json=True, smoke=True, obstacles=2))
    assert set(line_of(capsys)) >= KEYS - {"coverage"}
    shapes = {"t": 1, "0": 2, "4": 1, "5": 2, "rectangle": 2, "reg7": 7}
    for name, turns in shapes.items():
        env = push_any.StateEnv(object_name=name)
        env.reset(seed=0)
        assert push_any.count_turns(env.block, push_any.pushing(env.block)[1]) == turns
    seeds = push_any.find_seeds(push_any.Options(3, obstacles=2))
    for seed in seeds:
        env.reset(seed=seed)
        assert len(env.obstacles) == 2
    for pose, reached in (([256, 256, 1.0], True), ([60, 256, 0.0], True), ([20, 256, 0.0], False)):
        env.goal_pose = np.array(pose)
        assert env.within_reach is reached


def test_a_variant_that_is_none_is_refused():
    with pytest.raises(ValueError, match="outline -20 %"):
        board.main(board.Options(variant="wrong"))


@pytest.mark.slow  # plays and learns
def test_random_pushing_teaches_the_radius_of_gyration():
    found = board.learn(board.make_env(), seed=0, steps=300, iterations=60)
    before, after = (values["gyration"] for values in found.values)
    assert abs(after - board.GYRATION) < 0.3 * abs(before - board.GYRATION)
    assert found.loss[1] < 0.3 * found.loss[0]


@pytest.mark.slow  # plays an episode
def test_the_film_is_a_gif(capsys, tmp_path):
    from PIL import Image

    film = tmp_path / "push_t.gif"
    push_t.main(push_t.Options(film, seed=3, episodes=1))
    assert "seed 3: solved" in capsys.readouterr().out
    with Image.open(film) as picture:
        assert picture.n_frames > 20
        assert picture.info["duration"] == 100


def test_the_tee_is_that_of_the_environment():
    system = push_t.tee_pushing()
    # Moments that pymunk gives: twice that of a bar of 120 × 30 about the middle of its upper edge, for a mass of 1.
    bar = (120**2 + 30**2) / 12 + 15**2
    assert pytest.approx(2 * bar / 100**2) == push_t.GYRATION**2
    assert isinstance(system.drive, PDDrive)
    area, centroid, _ = push_t.tee().moments()
    assert float(area) == pytest.approx(0.63)
    torch.testing.assert_close(centroid, torch.zeros(2, dtype=torch.float64))
    # The mean of the centres of both boxes, from the origin of the T, through the middle of the bar.
    middle = push_t.from_origin([0.0, 0.0, 0.0])[1]
    assert pytest.approx(middle + push_t.CENTER_OF_MASS[1]) == 0.5 * (0.15 + 0.75)
    turned = push_t.from_origin([100.0, 200.0, math.pi / 2])
    assert turned == pytest.approx([1.0 - middle, 2.0, math.pi / 2])


def test_a_policy_for_push_t_sends_the_disc_to_places_in_the_plane():
    policy = push_t.PushTPolicy()
    target = policy.act([400.0, 400.0, 256.0, 256.0, 0.0])
    assert target.shape == (2,)
    assert ((target >= 0) & (target <= 512)).all()
    assert policy.sampling.decision.mode == "travel"


def test_a_picture_shows_what_was_decided():
    env, policy = SimpleNamespace(render=lambda: np.zeros((96, 96, 3), np.uint8)), push_t.PushTPolicy()
    plain = push_t.picture(env, policy)
    policy.act([400.0, 400.0, 256.0, 256.0, 0.0])
    assert push_t.picture(env, policy) != plain


def test_actions_that_come_late_are_planned_from_where_things_will_be():
    late, seen = push_t.PushTPolicy(delay=1), [400.0, 400.0, 256.0, 256.0, 0.0]
    sent = late.act(seen)
    torch.testing.assert_close(
        late.sampling.decision.states[0, 3:5], torch.tensor([4.0, 4.0], dtype=torch.float64)
    )  # nothing is under way
    late.sampling.reset()
    late.act(seen)
    expected = 4.0 + push_t.DRIVE.step().b[0] * (torch.from_numpy(sent) / 100 - 4.0)
    torch.testing.assert_close(late.sampling.decision.states[0, 3:5], expected)


# --- Fetch tasks ------------------------------------------------------------------------------------------------------


def test_a_puck_that_is_hit_slides_as_far_as_friction_lets_it():
    geoms = SimpleNamespace(friction=np.array([0.1])), SimpleNamespace(friction=np.array([0.05]))
    model = SimpleNamespace(
        eq_solref=np.array([[0.02, 1.0]]),
        body=lambda name: SimpleNamespace(geomadr=[1]),
        geom=lambda of: geoms[of if of == 1 else 0],
    )
    system = fetch.sliding_system(model)
    x = system.A.new_zeros(5)
    x[4] = 0.8
    x[:3] = -1.0  # the gripper is far
    for k in range(system.horizon):
        x = system.stage(k).step(x, x.new_zeros(1)).x_next
    start, velocity = np.zeros(3), np.array([0.8, 0.0, 0.0])
    assert x[3] == pytest.approx(0.8**2 / (2 * 9.81 * 0.1), abs=2e-3)
    assert fetch.place_of_rest(start, velocity, 0.1)[0] == pytest.approx(0.8**2 / (2 * 9.81 * 0.1))
    assert fetch.place_of_rest(start, velocity, 0.1, 0.2)[0] == pytest.approx(0.16 - 0.2**2 * 0.981 / 2)
    assert abs(x[4]) < 1e-3
