"""Push-T of gym-pusht from outside: the scoreboard, learning from random pushing, the film."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

SCOREBOARD = Path(__file__).resolve().parents[2] / "benchmarks" / "scoreboard"
KEYS = {"success_rate", "ci_low", "ci_high", "episodes", "mean_steps", "milliseconds_per_step", "coverage"}

# Looked for, not imported: pygame warns while it is imported, and here a warning is an error.
pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(
        importlib.util.find_spec("gym_pusht") is None, reason='needs gym-pusht: pip install "difflcs[scoreboard]"'
    ),
]


@pytest.fixture
def board(monkeypatch):
    pytest.importorskip("tyro")
    monkeypatch.syspath_prepend(str(SCOREBOARD))
    import pusht

    return pusht


def line_of(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


@pytest.mark.slow  # plays
def test_the_scoreboard_prints_its_keys_and_goes_on_where_it_was(board, capsys, tmp_path):
    out = tmp_path / "pusht.json"

    def play(episodes, **options):
        board.main(board.Options(episodes=episodes, variant="noise 2 px", json=True, smoke=True, out=out, **options))

    play(1)
    first = line_of(capsys)
    assert set(first) >= KEYS
    assert (first["episodes"], first["mean_steps"], first["variant"]) == (1, 5, "noise 2 px")
    played = json.loads(out.read_text())["results"]["noise 2 px"]["rows"]
    play(2)
    assert line_of(capsys)["episodes"] == 2
    assert json.loads(out.read_text())["results"]["noise 2 px"]["rows"][:1] == played
    with pytest.raises(ValueError, match="name another file"):
        play(1, seed=5)


def test_a_variant_that_is_none_is_refused(board):
    with pytest.raises(ValueError, match="outline -20 %"):
        board.main(board.Options(variant="wrong"))


@pytest.mark.slow  # plays and learns
def test_random_pushing_teaches_the_radius_of_gyration(board):
    from learn_pusht import learn

    found = learn(board.make_env(), seed=0, steps=300, iterations=60)
    before, after, true = (values["gyration"] for values in (found.before, found.after, found.true))
    assert abs(after - true) < 0.3 * abs(before - true)
    assert found.loss[1] < 0.3 * found.loss[0]


@pytest.mark.slow  # plays an episode
def test_the_film_is_a_gif(capsys, tmp_path):
    pytest.importorskip("tyro")
    Image = pytest.importorskip("PIL.Image")
    from difflcs.cli import main

    film = tmp_path / "pusht.gif"
    assert main(["render", "pusht", "--smoke", "--seed", "3", "--out", str(film)]) == 0
    assert "seed 3: solved" in capsys.readouterr().out
    with Image.open(film) as picture:
        assert picture.n_frames > 20
        assert picture.info["duration"] == 100
    assert main(["render", "pusht", "--out", str(film)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["render", "pusht", "--out", str(tmp_path / "film.avi")]) == 2
    assert "GIF or MP4" in capsys.readouterr().err
    assert main(["render", "pusht", "--out", str(film / "in_a_file.gif")]) == 2
    assert "choose another" in capsys.readouterr().err
