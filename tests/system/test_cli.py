"""The command line, from outside."""

import contextlib
import errno
import importlib.util
import io
import json
import logging
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from difflcs import LCSModel, __main__, _storage, cli
from difflcs.cli import train as cli_train
from difflcs.rl import get_task, register_task
from difflcs.rl.methods import LCSRLMethod, ViolationMethod, get_method, method_names
from difflcs.rl.runs import progress
from difflcs.rl.runs.checkpoint import RunDirectory
from difflcs.rl.runs.training import TrainConfig
from tests.conftest import contents


def run(capsys, *arguments) -> tuple[int, str, str]:
    code = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def passes(capsys, *arguments) -> str:
    code, out, err = run(capsys, *arguments)
    assert code == 0, err
    return out


def fails(capsys, *arguments) -> str:
    code, _, err = run(capsys, *arguments)
    assert code == 2
    return err


@pytest.fixture(scope="module", autouse=True)
def _small_pictures(registries):
    """Films of a sixteenth of the pixels, which software draws."""
    register_task(replace(get_task("cube"), picture={"width": 160, "height": 120}))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished smoke run."""
    path = tmp_path_factory.mktemp("cli") / "run"
    assert cli.main(["train", "--method", "violation", "--smoke", "--out", str(path)]) == 0
    return path


HELP = {
    "": "zoo:trifinger-cube",
    "train": "--warmup.noise",
    "evaluate": "zoo:NAME",
    "render": "--force",
    "export": "controller.difflcs",
    "demo": "--smoke",
    "zoo": "--json",
    "assets": "sugar_box",
    "bench": "--ipopt-batch",
    "doctor": "--json",
}


def printed(capsys, *arguments) -> str:
    with pytest.raises(SystemExit) as exit_:
        cli.main([*arguments, "--help"])
    assert exit_.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", HELP)
def test_help(capsys, command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = printed(capsys, *command.split())
    assert HELP[command] in text
    words = [line for line in text.splitlines() if not line.startswith("usage")]
    assert max(map(len, words)) <= 80


def test_every_command_has_a_test_of_its_help(capsys):
    err = fails(capsys, "nonsense")
    assert all(command in err for command in HELP)


# --- the flags of train -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flags():
    """Flags of `difflcs train` by method."""
    found = {}
    for method in method_names():
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as text:
            patch.setenv("COLUMNS", "80")
            with pytest.raises(SystemExit):
                cli.main(["train", "--method", method, "--help"])
        found[method] = set(re.findall(r"^\W (--[a-z][a-z.-]*)", text.getvalue(), re.MULTILINE))
    return found


def settings_of(settings: Any, prefix: str = "") -> Iterator[str]:
    """Their flags; of what is on by default the one that turns it off."""
    for f in fields(settings):
        value = getattr(settings, f.name)
        if is_dataclass(value):
            yield from settings_of(value, f"{prefix}{f.name}.")
        else:
            yield f"--{prefix}{'no_' * (value is True)}{f.name}".replace("_", "-")


@pytest.mark.parametrize("method", method_names())
def test_each_methods_settings_show_with_that_method_only(flags, method):
    own = {name: set(settings_of(get_method(name)())) for name in method_names()}
    common = {flag for flag in settings_of(TrainConfig()) if not flag.startswith("--method")} | {"--method"}
    assert flags[method] == own[method] | common | {"--out", "--init", "--resume", "--force", "--smoke"}
    for other in own:
        assert not (own[other] - own[method]) & flags[method]


def test_the_default_is_lcs_rl_on_the_cube(capsys, flags, monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(cli_train, "train", lambda config, out, **_: seen.append((config, out)) or run_of(out))
    assert run(capsys, "train", "--task", "cube")[0] == 0
    assert run(capsys, "train")[0] == 0
    config, out = seen[0]
    assert config == seen[1][0] == TrainConfig() == TrainConfig(task="cube", method=LCSRLMethod())
    assert config.method.name == "lcs-rl"
    assert out == Path("runs/cube-lcs-rl-0")
    assert set(settings_of(LCSRLMethod())) <= flags["lcs-rl"]


def run_of(out: Path) -> SimpleNamespace:
    return SimpleNamespace(path=out, rows=lambda: [])


# --- mistakes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--method", "lcs-rl", "--minutes", "3"], "--minutes 30"),
        (["train", "--method", "pddm", "--init", "nowhere"], "init: expected none"),
        (["train", "--backend", "magic", "--smoke"], "magic"),
        (["train", "--minutes", "-1"], "minutes"),
        (["train", "--resume"], "difflcs train"),
        (["train", "--init", "nowhere"], "nowhere"),
        (["train", "--init", "zoo:teapot"], "trifinger-cube"),
        (["evaluate", "zoo:trifinger-cube", "--goals", "0"], "goals"),
        (["evaluate", "zoo:trifinger-cube", "--seed", "-1"], "seed"),
        (["render", "zoo:trifinger-cube", "--goal", "0.1"], "expected x [m], y [m], yaw [rad] for each goal"),
        (["render", "zoo:trifinger-cube", "--out", "video.avi"], "MP4"),
        (["evaluate", "turn_cube"], "expected a task with known physics"),
        (["bench", "--repeats", "0"], "repeats"),
        (["plot", "zoo:trifinger-cube", "--episodes", "0"], "episodes: expected at least 1"),
        (
            ["train", "--warmup.noise", "-1"],
            "difflcs: --warmup.noise: expected a finite 0 <= noise, got -1.0; change it\n",
        ),
        (["train", "--ppo.std", "0"], "difflcs: --ppo.std: expected a finite 0 < std, got 0.0; change it\n"),
        (
            ["train", "--warmup.adam.betas", "0.9", "2"],
            "difflcs: --warmup.adam.betas: expected a finite 0 <= betas < 1, got 2.0; change it\n",
        ),
        (["train", "--n-lam", "0"], "difflcs: --n-lam: expected a finite 1 <= n_lam <= 1000, got 0; change it\n"),
        (
            ["train", "--method", "violation", "--minutes", "1", "--evaluate-at", "0.5", "7", "8"],
            "difflcs: evaluate_at: expected minutes of data up to the 1 of the training, got 7, 8; leave them out, or "
            "raise minutes\n",
        ),
        (["trian"], "did you mean train"),
        (["train", "--method", "lcsrl"], "did you mean lcs-rl"),
        (["train", "--task", "cubes"], "did you mean cube"),
        (["train", "--backend", "batchd"], "did you mean batched"),
        (["evaluate", "zoo:trifinger-cub"], "did you mean trifinger-cube"),
        (["evaluate", "cubee"], "did you mean cube"),
        (["zoo", "trifingercube"], "did you mean trifinger-cube"),
        (["evaluate", "nowhere"], "difflcs train"),
        (["render", "nowhere"], "difflcs train"),
    ],
)
def test_mistakes_get_one_clean_message(capsys, tmp_path, arguments, message):
    if arguments[0] == "train":
        arguments = [*arguments, "--out", tmp_path / "run"]
    code, out, err = run(capsys, *arguments)
    assert code == 2
    assert err.startswith("difflcs: ")
    assert message in err
    assert not out
    assert "Traceback" not in err
    assert not (tmp_path / "run").exists()


def test_a_model_in_single_precision_is_refused_before_anything_is_written(capsys, tmp_path):
    LCSModel(9, 6, 3, dtype=torch.float32).save_pretrained(tmp_path / "model")
    err = fails(capsys, "train", "--smoke", "--init", tmp_path / "model", "--out", tmp_path / "run")
    assert "init: expected a model with n_x=9, n_u=6, float64, as task cube needs, got n_x=9, n_u=6, float32" in err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("words", ["train --help", "nonsense"])
def test_who_reads_the_output_may_stop(words):
    """As in `difflcs train --help | head`: no traceback. The reader ends before anything is written."""
    end, mine = os.pipe()
    os.close(end)
    command = [sys.executable, "-m", "difflcs", *words.split()]
    broken = {"stdout": mine, "stderr": subprocess.PIPE} if words != "nonsense" else {"stderr": mine}
    done = subprocess.run(command, **broken, text=True, timeout=120, check=False)
    os.close(mine)
    assert done.returncode == 141
    assert not done.stderr


def test_ctrl_c_while_the_command_is_imported(capsys, monkeypatch):
    monkeypatch.setattr(cli, "main", Mock(side_effect=KeyboardInterrupt))
    assert __main__.main(["train"]) == 130
    assert capsys.readouterr().err == "\ndifflcs: interrupted; nothing was changed\n"


def test_what_a_training_shows_without_a_terminal(capsys, tmp_path):
    words = "--method violation --smoke --minutes 0.5 --evaluate-at 0 0.3 --evaluate-goals 2 --final-goals 3".split()
    code, out, err = run(capsys, "train", *words, "--out", tmp_path / "my run")
    assert code == 0
    lines = err.splitlines()
    assert lines[0] == f"training: violation on cube, 0.5 min of data, in {tmp_path / 'my run'}"
    shown = [line for line in lines if line.startswith("iteration ")]
    assert shown[0].startswith("iteration 1, 0.2 of 0.5 min of data, loss ")
    assert len(shown) == len(RunDirectory.open(tmp_path / "my run").rows()) - 1
    assert [line for line in lines if line.startswith("evaluating")] == [f"evaluating {n} goals" for n in (3, 2, 3)]
    assert [line.partition(":")[0] for line in lines if line.startswith("after")] == [
        f"after {minutes} min of data" for minutes in ("0.0", "0.3", "0.5")
    ]
    assert f"evaluate it with: difflcs evaluate '{tmp_path / 'my run'}'" in out
    registered = type("Mine", (ViolationMethod,), {"__module__": "__main__"})()
    for mine in (cli_train.Train(method=registered), cli_train.Train(task="registered")):
        assert mine.program(mine) == f"python {sys.argv[0]}"
    assert logging.getLogger("difflcs").handlers == [difflcs_handler()]


def difflcs_handler() -> logging.Handler:
    """The one that the library has by itself: it shows nothing."""
    (handler,) = (h for h in logging.getLogger("difflcs").handlers if isinstance(h, logging.NullHandler))
    return handler


def test_a_long_evaluation_shows_lines_without_a_terminal(capsys, monkeypatch):
    monkeypatch.setattr(progress, "_SECONDS", 0.0)
    code, out, err = run(capsys, "evaluate", "zoo:trifinger-cube", "--smoke", "--json")
    assert code == 0
    assert json.loads(out)["goals"] == 4
    assert err.splitlines()[0] == "evaluating: 4 of 80 steps"
    assert err.splitlines()[-1] == "evaluating: 80 of 80 steps"


def test_a_missing_package_names_the_line_that_installs_it(capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "tyro" else find(name, *a))
    assert 'pip install "difflcs[rl,envs,viz]"' in fails(capsys, "evaluate", "nowhere")
    code, out, err = run(capsys, "--help")
    assert (code, "difflcs doctor" in out, "pip install" in err) == (0, True, True)


def test_evaluate(capsys, finished):
    out = passes(capsys, "evaluate", finished, "--goals", 3, "--seed", 5, "--json")
    record = json.loads(out)
    assert (record["goals"], record["seed"], record["solver_failures"]) == (3, 5, 0)
    assert 0 <= record["ci_low"] <= record["success_rate"] <= record["ci_high"] <= 1
    assert record["versions"]["mujoco"]
    assert "of 4 goals (95 % interval" in passes(capsys, "evaluate", finished, "--smoke", "--action-support")


def test_a_run_says_which_object_it_was_trained_on(capsys, tmp_path, monkeypatch):
    monkeypatch.delenv("DIFFLCS_YCB_DIR", raising=False)
    monkeypatch.setenv("DIFFLCS_CACHE_DIR", str(tmp_path / "cache"))
    path = tmp_path / "run"
    smoke = ["--method", "violation", "--smoke", "--minutes", 0.1, "--final-goals", 0]
    assert run(capsys, "train", "--task", "mug", *smoke, "--out", path)[0] == 0
    stored = json.loads((path / "config.json").read_text())["object"]
    assert (stored["name"], stored["source"], stored["mass"]) == ("mug", "stand_in", 0.05)
    assert json.loads(run(capsys, "evaluate", path, "--smoke", "--json")[1])["object"] == stored
    told = run(capsys, "evaluate", path, "--smoke")[1].partition("object: mug (")[2]
    assert "source stand_in" in told
    assert "mass 0.05" in told
    shutil.copytree(path, tmp_path / "other")
    config = json.loads((path / "config.json").read_text())
    (tmp_path / "other/config.json").write_text(json.dumps({**config, "object": {**stored, "source": "ycb_mesh"}}))
    shutil.rmtree(tmp_path / "other/model")
    err = fails(capsys, "train", "--out", tmp_path / "other", "--resume")
    assert "expected the environment it was started with" in err
    monkeypatch.setenv("DIFFLCS_YCB_DIR", str(tmp_path))
    assert "025_mug.stl" in fails(capsys, "evaluate", path, "--smoke")


def test_assets_download(capsys, tmp_path, monkeypatch):
    from difflcs_envs import AssetError, assets

    assert "sugar_box" in fails(capsys, "assets", "download", "teapot")
    calls = []
    monkeypatch.setattr(assets, "download", lambda names, folder, report: calls.append((names, folder)))
    assert run(capsys, "assets", "download")[0] == 0
    assert f"DIFFLCS_YCB_DIR={tmp_path}" in passes(capsys, "assets", "download", "mug", "clamp", "--folder", tmp_path)
    assert calls == [(None, None), (("mug", "clamp"), tmp_path)]
    monkeypatch.setattr(assets, "download", Mock(side_effect=AssetError("no network")))
    assert fails(capsys, "assets", "download") == "difflcs: no network\n"


def test_an_existing_run_is_not_overwritten(capsys, finished):
    before = contents(finished)
    assert "--resume" in fails(capsys, "train", "--method", "violation", "--smoke", "--out", finished)
    assert "--seed: expected 0" in fails(capsys, "train", "--smoke", "--out", finished, "--resume", "--seed", 3)
    for words in (["--minutes", 6], ["--minutes=6.0"], ["--final_goals", 300]):  # defaults, and not what the run has
        err = fails(capsys, "train", "--out", finished, "--resume", *words)
        assert f"{str(words[0]).partition('=')[0].replace('_', '-')}: expected " in err
    assert run(capsys, "train", "--out", finished, "--resume", "--seed", 0)[0] == 0
    assert run(capsys, "train", "--out", finished, "--resume")[0] == 0  # nothing left to do
    assert contents(finished) == before


def test_force_replaces_a_run_once_the_new_one_has_begun(capsys, tmp_path, monkeypatch):
    path = tmp_path / "run"
    short = ["--method", "violation", "--smoke", "--minutes", 0.1, "--final-goals", 0, "--out", path, "--force"]
    assert run(capsys, "train", *short)[0] == 0  # nothing there yet
    (path / "notes.txt").write_text("mine")
    before = contents(path)
    for arguments, message in (
        (["--backend", "magic"], "magic"),
        (["--init", "nowhere"], "nowhere"),
        (["--init", path], "outside the run"),
        (["--init", path / "model"], "outside the run"),
        (["--resume"], "force: expected without resume"),
    ):
        assert message in fails(capsys, "train", *short, *arguments)
        assert contents(path) == before
    with monkeypatch.context() as patch:  # interrupted before it begins
        patch.setattr("difflcs.rl.methods.ViolationMethod.trainer", Mock(side_effect=KeyboardInterrupt))
        assert run(capsys, "train", *short, "--seed", 1)[0] == 130
    assert contents(path) == before
    assert run(capsys, "train", *short, "--seed", 1)[0] == 0
    assert json.loads((path / "config.json").read_text())["config"]["seed"] == 1
    assert not (path / "notes.txt").exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("content", [None, "{}", "not json", '{"kind": "LCSModel"}'])
def test_force_never_replaces_what_is_not_a_run(capsys, tmp_path, content):
    path = tmp_path / "thesis"
    path.mkdir()
    (path / "chapter.tex").write_text("years of work")
    if content is not None:
        (path / "config.json").write_text(content)
    before = contents(path)
    assert "--force replaces runs only" in fails(capsys, "train", "--smoke", "--out", path, "--force")
    assert contents(path) == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis"]
    file = tmp_path / "file"
    file.write_text("text")
    assert run(capsys, "train", "--smoke", "--out", file, "--force")[0] == 2
    assert file.read_text() == "text"


def test_the_default_run_directory_says_what_is_in_it():
    config = TrainConfig(task="mug", method="ppo", seed=7)
    assert config.directory() == Path("runs/mug-ppo-7")
    assert config.directory("a/{seed}/{other}") == Path("a/7/{other}")


def test_bench(capsys):
    assert "forward + backward" in passes(capsys, "bench", "--smoke")
    record = json.loads(run(capsys, "bench", "--smoke", "--json")[1])
    for timing in record["timings"]:
        assert timing["ratio"] == pytest.approx(timing["ipopt"] / timing["batched"])
        assert min(timing["batched"], timing["threads"], timing["ipopt"]) > 0
    assert [timing["work"] for timing in record["timings"]] == ["forward", "forward + backward"]


def test_an_interrupted_training_says_how_to_go_on(capsys, finished, tmp_path, monkeypatch):
    """Interrupted before the final model; after any iteration: tests/conformance/test_methods.py."""
    path = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr("difflcs.lcs.LCSModel.save_pretrained", Mock(side_effect=KeyboardInterrupt))
        code, _, err = run(capsys, "train", "--method", "violation", "--smoke", "--out", path)
    assert code == 130
    assert f"difflcs train --out {path} --resume" in err
    out = passes(capsys, "evaluate", path, "--smoke")
    assert "not finished" in out
    assert run(capsys, "train", "--out", path, "--resume")[0] == 0
    model = "model/model.safetensors"
    assert (path / model).read_bytes() == (finished / model).read_bytes()


def test_render(capsys, finished, tmp_path):
    video = tmp_path / "new" / "video.mp4"
    code, out, err = run(capsys, "render", finished, "--goal", 0.04, 0.03, 0.3, "--out", video)
    if "OpenGL" in err:
        pytest.skip(err)
    assert code == 0
    assert "goal 0.04 0.03 0.3: " in out
    assert video.stat().st_size > 3_000
    assert [path.name for path in video.parent.iterdir()] == ["video.mp4"]
    before = video.read_bytes()
    assert "--force" in fails(capsys, "render", finished, "--out", video)
    assert "expected [-0.06" in fails(capsys, "render", finished, "--goal", 0.4, 0.03, 0.3, "--out", video, "--force")
    assert video.read_bytes() == before
    assert run(capsys, "render", "zoo:trifinger-cube", "--smoke", "--out", video, "--force")[0] == 0
    assert video.read_bytes() != before
    assert "reached" in run(capsys, "render", "cube", "--out", tmp_path / "cube.gif")[1]  # nothing is learned
    assert (tmp_path / "cube.gif").read_bytes()[:4] == b"GIF8"


def test_pictures_of_a_model(capsys, tmp_path, finished):
    assert run(capsys, "plot", finished, "--smoke", "--out", tmp_path / "run")[0] == 0
    assert run(capsys, "evaluate", "zoo:trifinger-cube", "--smoke", "--plot", tmp_path / "zoo")[0] == 0
    pictures = {str(p.relative_to(tmp_path)): p.read_bytes()[:4] for p in tmp_path.glob("*/*")}
    names = ("run/learning_curve", "run/fit", "run/episode", "zoo/fit", "zoo/episode")
    assert pictures == {f"{name}.png": b"\x89PNG" for name in names}


def test_demo(capsys, tmp_path):
    for attempt in range(2):  # the second continues, that is, only draws again
        out = passes(capsys, "demo", "--smoke", "--out", tmp_path / "demo")
        assert ("continuing it" in out) == (attempt == 1)
        assert "success before learning: " in out
        assert "success after 0.5 minutes of data: " in out
        assert (tmp_path / "demo/learning_curve.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("words", [["--resume"], ["--force", "--smoke"], ["--smoke"]])
def test_one_training_at_a_time_in_a_run(capsys, tmp_path, monkeypatch, words):
    path = tmp_path / "run"
    arguments = ["train", "--method", "violation", "--smoke", "--minutes", 0.1, "--final-goals", 0, "--out", path]
    seen = []

    class Second(cli_train.Progress):
        def started(self, done, total):
            if not seen:
                seen.append(None)
                before = contents(path)
                seen[0] = run(capsys, "train", "--out", path, *words)
                assert contents(path) == before
            super().started(done, total)

    monkeypatch.setattr(cli_train, "Progress", Second)
    assert run(capsys, *arguments)[0] == 0
    code, _, err = seen[0]
    assert code == 2
    assert str(path) in err
    assert ("in use" in err) == (words != ["--smoke"])
    assert not (path / ".lock").exists()
    assert run(capsys, "train", "--out", path, "--resume")[0] == 0  # finished: nothing to lock


# --- disks ------------------------------------------------------------------------------------------------------------


def learned(path: Path) -> list[tuple[str, bytes]]:
    """The final model and the last checkpoint, byte for byte."""
    last = max(path.glob("checkpoints/0*"))
    files = [path / "model/model.safetensors", last / "model.safetensors", last / "config.json"]
    return [(str(file.relative_to(path)), file.read_bytes()) for file in files]


@pytest.mark.parametrize("words", ["train --out", "plot cube --out", "render cube --out", "evaluate cube --plot"])
def test_a_place_that_cannot_be_written_is_reported_first(capsys, tmp_path, words):
    (tmp_path / "file").touch()
    err = fails(capsys, *words.split(), tmp_path / "file/video.mp4")
    assert err.startswith("difflcs: ")  # and nothing of ffmpeg or of the work before it
    assert re.search("expected a (place to write|folder) .* choose another", err)


def test_a_full_disk_leaves_the_last_checkpoint(capsys, finished, tmp_path, monkeypatch):
    path = tmp_path / "run"
    write, left = _storage.write_atomically, [5]  # config.json, then three files per checkpoint

    def full(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(_storage, "write_atomically", full)
        err = fails(capsys, "train", "--smoke", "--method", "violation", "--out", path)
    assert "No space left" in err
    assert "--resume" in err
    assert json.loads((path / "checkpoints/latest.json").read_text()) == {"checkpoint": "000000"}
    assert run(capsys, "train", "--out", path, "--resume")[0] == 0
    assert learned(path) == learned(finished)
