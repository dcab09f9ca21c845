"""Push-T of gym-pusht from outside: the scoreboard, learning from random pushing, the film."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCOREBOARD = ROOT / "benchmarks" / "scoreboard"
KEYS = {"success_rate", "ci_low", "ci_high", "episodes", "mean_steps", "milliseconds_per_step", "coverage"}

# Looked for, not imported: pygame warns while it is imported, and here a warning is an error.
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("gym_pusht") is None, reason='needs gym-pusht: pip install "difflcs[scoreboard]"'
)


def run(*words, ok=True):
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, text=True, timeout=300, check=False, cwd=ROOT
    )
    assert (done.returncode == 0) is ok, done.stderr[-2000:]
    return done.stdout if ok else done.stderr


@pytest.mark.slow  # starts processes that play
def test_the_scoreboard_prints_its_keys_and_goes_on_where_it_was(tmp_path):
    pytest.importorskip("tyro")
    out = tmp_path / "pusht.json"
    script, options = SCOREBOARD / "pusht.py", ["--smoke", "--json", "--variant", "noise 2 px", "--out", out]
    first = json.loads(run(script, "--episodes", 1, *options))
    assert set(first) >= KEYS
    assert (first["episodes"], first["mean_steps"], first["variant"]) == (1, 5, "noise 2 px")
    played = json.loads(out.read_text())["results"]["noise 2 px"]["rows"]
    second = json.loads(run(script, "--episodes", 2, *options))
    assert second["episodes"] == 2
    assert json.loads(out.read_text())["results"]["noise 2 px"]["rows"][:1] == played
    assert "name another file" in run(script, "--seed", 5, *options, ok=False)


def test_a_variant_that_is_none_is_refused():
    pytest.importorskip("tyro")
    assert "outline -20 %" in run(SCOREBOARD / "pusht.py", "--variant", "wrong", ok=False)


@pytest.mark.slow  # plays and learns
def test_random_pushing_teaches_the_centre_of_mass():
    pytest.importorskip("tyro")
    said = run(SCOREBOARD / "learn_pusht.py", "--steps", 300, "--iterations", 60)
    (line,) = [line for line in said.splitlines() if line.startswith("gyration")]
    before, after, true = (float(word) for word in line.replace(",", "").split() if word[0].isdigit())
    assert abs(after - true) < 0.3 * abs(before - true)


@pytest.mark.slow  # plays an episode
def test_the_film_is_a_gif(tmp_path):
    pytest.importorskip("PIL")
    pytest.importorskip("tyro")
    from PIL import Image

    film = tmp_path / "pusht.gif"
    assert "seed 3: solved" in run("-m", "difflcs", "render", "pusht", "--smoke", "--seed", 3, "--out", film)
    with Image.open(film) as picture:
        assert picture.n_frames > 20
        assert picture.info["duration"] == 100
    assert "--force" in run("-m", "difflcs", "render", "pusht", "--out", film, ok=False)
    assert "GIF or MP4" in run("-m", "difflcs", "render", "pusht", "--out", tmp_path / "film.avi", ok=False)
