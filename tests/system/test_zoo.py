"""Models that ship with the package: names, cards, how they are added, and that they are as good as their cards say."""

import json
import re
import shlex
from dataclasses import asdict, replace
from typing import Any

import pytest
import torch

from difflcs import LCSModel, cli, zoo
from difflcs.cli import train as cli_train
from difflcs.errors import CheckpointError
from difflcs.rl.methods import PPOMethod, get_method, method_names
from difflcs.rl.runs.checkpoint import RunDirectory
from difflcs.rl.runs.evaluate import wilson_interval
from difflcs.rl.runs.trained import TrainedPolicy
from difflcs.rl.runs.training import TrainConfig, load_model
from difflcs.rl.tasks import get_task, task_names
from reproduce import add_to_zoo as adding
from tests.conftest import contents, refuse

CUBE = "trifinger-cube"
OBJECT = {"name": "mug", "source": "ycb_mesh", "mass": 0.05, "sha256": "abc"}


def make_run(path, *, method="lcs-rl", finished=True, evaluated=True, init=None, **settings: Any):
    """A run directory as `difflcs train` leaves it, without the training."""
    config = TrainConfig(task="mug", method=get_method(method)(**settings), minutes=30.0, seed=3)
    versions = {"difflcs": "0.1.0", "mujoco": None}
    content = {"kind": "run", "config": config.to_json(), "init": init, "versions": versions, "object": OBJECT}
    run = RunDirectory.create(path, content)
    for last in (False, True):
        row = {"iteration": int(last), "minutes": 30.0 * last}
        for name, value in (("success_rate", 0.9), ("ci_low", 0.88), ("ci_high", 0.92), ("goals", 1000)):
            row[f"evaluation_{name}"] = value if evaluated and last else None
        row["evaluation_solver_failures"] = 7 if evaluated and last else None
        run.append(row)
    if finished:
        LCSModel(9, 6, 2, generator=torch.Generator().manual_seed(1)).save_pretrained(run.model)
    return run


def test_the_cube_is_there_and_everything_is_small():
    assert CUBE in zoo.names()
    assert list(zoo.names()) == sorted(zoo.names())
    files = [path for name in zoo.names() for path in zoo.path(name).iterdir()]
    assert {path.name for path in files} == {"config.json", "model.safetensors", "card.json"}
    assert sum(path.stat().st_size for path in files) < 1_000_000


@pytest.mark.parametrize("name", zoo.names())
def test_every_model_fits_its_card(name):
    card = zoo.card(name)
    assert card.name == name
    known = get_task(card.task).model_name
    assert name == (known if card.method == "lcs-rl" else f"{known}-{card.method}")
    assert card.task in task_names()
    assert card.method in method_names()
    assert card.goals >= 300
    assert (card.ci_low, card.ci_high) == pytest.approx(
        wilson_interval(round(card.success_rate * card.goals), card.goals)
    )
    assert card.object_source in ("built_in", "ycb_mesh", "stand_in")
    assert card.object["mass"] > 0
    assert card.command.startswith(f"difflcs train --task {card.task} --method {card.method} ")
    assert not re.search(r"/(home|root|tmp|work|Users)\b", (zoo.path(name) / "card.json").read_text())
    if get_method(card.method).takes_init:
        model = LCSModel.from_pretrained(name)
        assert (model.n_x, model.n_u, model.A.dtype) == (9, 6, torch.float64)
    else:
        refuse(CheckpointError, "LCSModel", LCSModel.from_pretrained, name)
    assert TrainedPolicy.open(f"zoo:{name}").finished
    assert hash(card) == hash(zoo.card(f"zoo:{name}"))


@pytest.mark.parametrize("name", zoo.names())
def test_the_command_of_a_card_trains_that_very_model(monkeypatch, name):
    """What is a default today was one when it was trained, and the command says the rest."""
    card, seen = zoo.card(name), []
    monkeypatch.setattr(cli_train, "train", lambda config, out, **_: seen.append(config) or RunDirectory(out))
    assert cli.main(shlex.split(card.command)[1:]) == 0
    assert json.loads(json.dumps(seen[0].to_json())) == card.settings
    assert (seen[0].task, seen[0].method.name, seen[0].seed) == (card.task, card.method, card.seed)


@pytest.mark.parametrize("name", [n for n in zoo.names() if zoo.card(n).object_source == "built_in"])
def test_evaluation_finds_what_the_card_says(capsys, name):
    assert cli.main(["evaluate", f"zoo:{name}", "--goals", "40", "--json"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    low, high = wilson_interval(found["successes"], 40, confidence=0.99)
    assert low <= zoo.card(name).success_rate <= high
    assert found["run"] == f"zoo:{name}"
    assert found["card"]["success_rate"] == zoo.card(name).success_rate
    assert found["object"] == found["trained_on"]
    assert "trained on" not in captured.err


def test_evaluation_says_when_the_object_is_another(capsys, monkeypatch):
    card = zoo.card(CUBE)
    monkeypatch.setattr(zoo, "card", lambda _: replace(card, object={**card.object, "source": "ycb_mesh"}))
    assert cli.main(["evaluate", f"zoo:{CUBE}", "--smoke"]) == 0
    captured = capsys.readouterr()
    trained, _, here = captured.err.partition(", here it is cube (")
    assert "was trained on cube (" in trained
    assert "source ycb_mesh" in trained
    assert "source built_in" in here
    assert "do not compare" in captured.err
    assert f"its card: {100 * card.success_rate:.1f} % of {card.goals} goals" in captured.out


def test_a_path_that_exists_wins_over_a_name_but_not_over_the_prefix(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = LCSModel.from_pretrained(CUBE)
    LCSModel(2, 1, 1).save_pretrained(CUBE)
    assert LCSModel.from_pretrained(CUBE).n_x == 2
    assert torch.equal(LCSModel.from_pretrained(f"zoo:{CUBE}").A, shipped.A)
    assert torch.equal(LCSModel.from_pretrained(zoo.path(CUBE)).A, shipped.A)


@pytest.mark.parametrize("name", ["trifinger-cub", "zoo:trifinger-cub"])
def test_an_unknown_name_gets_the_names_there_are_and_the_nearest(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = refuse(CheckpointError, "did you mean trifinger-cube", LCSModel.from_pretrained, name)
    assert all(known in message for known in zoo.names())


def test_a_path_is_never_taken_for_a_name(tmp_path):
    refuse(CheckpointError, "a file is missing", LCSModel.from_pretrained, tmp_path / "trifinger-cub")
    refuse(CheckpointError, "`difflcs zoo` lists them", LCSModel.from_pretrained, "zoo:../secrets")


def test_a_finished_run_becomes_a_model_with_its_card(tmp_path):
    run = make_run(tmp_path / "run", init="/home/somebody/runs/cube-7/model")
    root = tmp_path / "zoo"
    card = adding.add(run.path, root=root)
    assert zoo.names(root) == ("trifinger-mug",)
    assert json.loads((root / "trifinger-mug/card.json").read_text()) == json.loads(json.dumps(asdict(card)))
    assert (card.name, card.task, card.method, card.minutes, card.seed) == ("trifinger-mug", "mug", "lcs-rl", 30.0, 3)
    assert (card.success_rate, card.ci_low, card.ci_high, card.goals) == (0.9, 0.88, 0.92, 1000)
    assert (card.object_source, card.object, card.solver_failures) == ("ycb_mesh", OBJECT, 7)
    assert card.command == "difflcs train --task mug --method lcs-rl --minutes 30 --seed 3 --init cube-7"
    assert torch.equal(LCSModel.from_pretrained(root / "trifinger-mug").A, load_model(run.path).A)
    assert "90.0 % of 1000 goals (95 % interval 88.0 to 92.0 %)" in str(card)
    violation = adding.add(make_run(tmp_path / "violation", method="violation").path, root=root)
    assert violation.name == "trifinger-mug-violation"


def test_nothing_is_overwritten_without_force(tmp_path):
    root = tmp_path / "zoo"
    run = make_run(tmp_path / "run").path
    adding.add(run, root=root)
    before = contents(root)
    refuse(CheckpointError, "--force", adding.add, run, root=root)
    assert contents(root) == before
    other = make_run(tmp_path / "other", n_lam=4).path
    assert adding.add(other, root=root, force=True).settings["settings"]["n_lam"] == 4


@pytest.mark.parametrize(
    ("settings", "message"), [({"finished": False}, "--resume"), ({"evaluated": False}, "--final-goals 1000")]
)
def test_what_cannot_be_added(tmp_path, capsys, settings, message):
    run, before = make_run(tmp_path / "run", **settings), zoo.names()
    assert adding.main([str(run.path)]) == 2
    assert message in capsys.readouterr().err
    assert zoo.names() == before


def test_the_command_on_a_card_gives_the_settings_back(monkeypatch):
    usual = PPOMethod()
    method = replace(
        usual,
        n_lam=5,
        models=replace(usual.models, ensemble=replace(usual.models.ensemble, learning_rate=1e-7)),
        ppo=replace(usual.ppo, std_range=(0.002, 0.02), update="adam", minibatch=None),
    )
    config = TrainConfig(task="mug", method=method, minutes=12.5, evaluate_at=())
    words = shlex.split(adding.training_command(config))
    assert words[:6] == ["difflcs", "train", "--task", "mug", "--method", "ppo"]
    seen = []
    monkeypatch.setattr(cli_train, "train", lambda config, out, **_: seen.append(config) or RunDirectory(out))
    assert cli.main(words[1:]) == 0
    assert seen == [config]


def test_the_list(capsys):
    assert cli.main(["zoo"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(zoo.names())
    assert max(map(len, lines)) <= 100
    assert cli.main(["zoo", "--json"]) == 0
    assert [card["name"] for card in json.loads(capsys.readouterr().out)] == list(zoo.names())
    assert cli.main(["zoo", CUBE]) == 0
    assert zoo.card(CUBE).command in capsys.readouterr().out


def test_a_training_starts_from_a_model_of_the_zoo(capsys, tmp_path):
    out = tmp_path / "run"
    arguments = "train --smoke --minutes 0.1 --final-goals 0 --method violation".split()
    assert cli.main([*arguments, "--out", str(out), "--init", f"zoo:{CUBE}"]) == 0
    assert json.loads((out / "config.json").read_text())["init"] == f"zoo:{CUBE}"
    assert cli.main(["train", "--out", str(out), "--resume"]) == 0
    assert cli.main(["evaluate", f"zoo:{CUBE}", "--smoke", "--action-support"]) == 2
    assert "drop the flag" in capsys.readouterr().err
