"""What every method has in common: it trains, goes on after any crash, refuses what is not its own, and repeats itself.

The methods of the library on a task of one's own, by the common code; a method of one's own is in docs/contributing.md.
"""

import json
from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from difflcs import LCSModel, cli
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError
from difflcs.rl.learning.ppo import PPOReport
from difflcs.rl.learning.state_tree import copy_state, flatten, unflatten
from difflcs.rl.learning.trainer import Trainer
from difflcs.rl.methods import Method, MujocoMethod, Work, get_method, method_names, register_method
from difflcs.rl.runs import training
from difflcs.rl.runs.checkpoint import RunDirectory, load_checkpoint, save_checkpoint
from difflcs.rl.runs.evaluate import evaluate
from difflcs.rl.runs.training import Reporter, TrainConfig, load_model, load_policy, stored_config, sum_seconds, train
from difflcs.rl.tasks import register_task
from tests.conformance.toy import STEPS, make_task
from tests.conftest import contents, refuse

pytestmark = pytest.mark.usefixtures("registered")

# The toy is no MuJoCo model; this method is contact-lcs besides, see tests/unit/test_contact_method.py.
NAMES = tuple(name for name in method_names() if name != MujocoMethod.name)
TOY = make_task()


@pytest.fixture(scope="module", autouse=True)
def registered(registries) -> None:
    """A task for this file alone."""
    register_task(TOY)


SLOW = [method.name for method in map(get_method, method_names()) if PPOReport in method.reports]
"""Methods that import TorchRL, and take longer."""


@pytest.fixture(params=[pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in NAMES])
def name(request) -> str:
    return request.param


def make_config(name: str, **changes: Any) -> TrainConfig:
    return replace(
        TrainConfig(task="toy", method=get_method(name)(), final_goals=4, evaluate_goals=3).smoke(), **changes
    )


def same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    (tensors, rest), (others, other_rest) = flatten(one), flatten(other)
    equal = all(torch.equal(value, others[key]) for key, value in tensors.items() if key in others)
    return tensors.keys() == others.keys() and rest == other_rest and equal


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Any:
    """A finished run of each method, trained when it is first asked for."""
    runs: dict[str, RunDirectory] = {}

    def get(name: str) -> RunDirectory:
        if name not in runs:
            path = str(tmp_path_factory.mktemp(name) / "run")  # directories may be strings
            runs[name] = train(make_config(name), path)
        return runs[name]

    return get


@pytest.fixture
def make_trainer():
    with ExitStack() as opened:

        def make(name: str, larger: bool = False, seed: int = 0) -> Trainer:
            task, config = make_task(size=2 + larger), make_config(name)
            episodes = round(config.minutes * task.steps_per_minute / STEPS)
            work = Work(task, seed, episodes, lambda count: opened.enter_context(closing(task.make_envs(count))))
            return config.method.trainer(work)

        yield make


# --- training ---------------------------------------------------------------------------------------------------------


def test_it_trains_and_says_what_it_did(name, finished):
    run = finished(name)
    rows = run.rows()
    method = stored_config(run).method
    assert method == make_config(name).method
    assert [row["iteration"] for row in rows] == [str(i) for i in range(len(rows))]
    assert len(rows) >= 3
    wanted = list(dict.fromkeys(f.name for report in method.reports for f in fields(report)))
    found = [column for column in rows[0] if column != "minutes" and not column.startswith("evaluation_")]
    assert found == wanted
    for column in found:
        assert any(row[column] for row in rows) or column in ("model_success", "model_loss"), column
    assert float(rows[-1]["minutes"]) >= 0.5
    steps = [int(row["env_steps"]) for row in rows]
    assert steps == sorted(steps)
    assert all(count % STEPS == 0 for count in steps)
    assert rows[-1]["evaluation_goals"] == "4"
    spent = sum_seconds(rows)
    assert set(spent) == {c.removesuffix("_seconds") for c in rows[0] if c.endswith("_seconds")}
    assert min(spent.values()) > 0
    files = {path.name for path in run.path.iterdir()}
    assert files == {"config.json", "log.csv", "tensorboard", "checkpoints", "model"}
    assert run.finished()
    stored = run.config()
    assert stored["config"]["method"] == name
    assert isinstance(method.version, int)


def test_an_iteration_returns_one_of_its_reports_and_counts_and_leaves_global_generators_alone(name, make_trainer):
    before = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    trainer = make_trainer(name)
    counted = []
    assert (trainer.iteration, trainer.env_steps) == (0, 0)
    for iteration in (1, 2):
        report = trainer.step(counted.append)
        assert type(report) in make_config(name).method.reports
        assert trainer.iteration == report.iteration == iteration
        assert trainer.env_steps == report.env_steps == sum(counted) == trainer.episodes * STEPS
    assert torch.equal(before[0], torch.random.get_rng_state())
    assert np.array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002


class Dies(Reporter):
    """Interrupts after each iteration."""

    def iterated(self, report: Any) -> None:
        raise KeyboardInterrupt


def test_resumed_after_every_iteration_it_is_the_same_bit_for_bit(name, finished, tmp_path):
    whole, path, interrupted = finished(name), tmp_path / "run", 0
    for attempt in range(20):
        torch.manual_seed(attempt)
        try:
            train(make_config(name), path, resume=attempt > 0, reporter=Dies())
            break
        except KeyboardInterrupt:
            interrupted += 1
    run = RunDirectory.open(str(path))
    assert interrupted == len(whole.rows()) - 1
    assert same(load_checkpoint(run.checkpoints), load_checkpoint(whole.checkpoints))
    assert (run.model / "model.safetensors").read_bytes() == (whole.model / "model.safetensors").read_bytes()
    assert (run.model / "config.json").read_bytes() == (whole.model / "config.json").read_bytes()
    timeless = [
        [{key: cell for key, cell in row.items() if not key.endswith("_seconds")} for row in one.rows()]
        for one in (run, whole)
    ]
    assert timeless[0] == timeless[1]


def test_a_row_whose_checkpoint_was_lost_is_not_written_twice(finished, tmp_path, monkeypatch):
    """Die between the row of an iteration and its checkpoint, twice at the same place; rows are not the method's."""
    name = "violation"
    whole, path, saved = finished(name), tmp_path / "run", []

    def dies(root, iteration, state):
        if iteration == 1 and len(saved) < 3:
            saved.append("lost")
            raise KeyboardInterrupt
        saved.append("kept")
        save_checkpoint(root, iteration, state)

    with monkeypatch.context() as patch:
        patch.setattr(training, "save_checkpoint", dies)
        for attempt in range(2):
            with pytest.raises(KeyboardInterrupt):
                train(make_config(name), path, resume=attempt > 0)
    assert saved == ["kept", "lost", "lost"]
    run = train(make_config(name), path, resume=True)
    assert [row["iteration"] for row in run.rows()] == [row["iteration"] for row in whole.rows()]
    events = EventAccumulator(str(run.tensorboard)).Reload()
    assert [event.step for event in events.Scalars("minutes")] == [int(row["env_steps"]) for row in run.rows()]


def test_a_state_decides_everything_that_follows(name, make_trainer):
    """Whatever a trainer did before, a state decides everything that follows; and another seed is another training."""
    one, other, third = make_trainer(name), make_trainer(name), make_trainer(name, seed=1)
    one.step()
    state = copy_state(one.state_dict())
    third.step()
    assert not same(*({"tensors": flatten(trainer.state_dict())[0]} for trainer in (one, third)))
    other.step()
    other.step()
    other.load(state)
    assert same(other.state_dict(), state)
    one.step()
    other.step()
    assert same(one.state_dict(), other.state_dict())


# --- what is refused --------------------------------------------------------------------------------------------------


def test_foreign_checkpoints_are_refused_and_change_nothing(name, make_trainer, finished):
    trainer = make_trainer(name)
    trainer.step()
    before = copy_state(trainer.state_dict())
    foreign = {other: load_checkpoint(finished(other).checkpoints) for other in NAMES if other != name}
    larger = make_trainer(name, larger=True)
    larger.step()
    foreign["of other sizes"] = copy_state(larger.state_dict())
    foreign["nothing"] = {}
    for source, state in foreign.items():
        refuse(CheckpointError, "expected", trainer.load, state)
        assert same(trainer.state_dict(), before), source


def test_states_with_anything_wrong_are_refused_and_change_nothing(name, make_trainer):
    """What `check_state` refuses: tests/unit/test_checkpoint.py."""
    trainer = make_trainer(name)
    trainer.step()
    before = copy_state(trainer.state_dict())
    tensors, rest = flatten(before)
    wrong = [(tensors, {key: value for key, value in rest.items() if key != gone}) for gone in rest]
    wrong += [({**tensors, "another": torch.zeros(1)}, rest), (tensors, {**rest, "another": 1})]
    for key, value in tensors.items():
        others = [value.unsqueeze(0), value.unsqueeze(-1), value.to(torch.complex64)]
        if value.is_floating_point() and value.numel():
            others.append(torch.full_like(value, torch.nan))
        wrong += [({**tensors, key: other}, rest) for other in others]
        wrong.append(({path: kept for path, kept in tensors.items() if path != key}, rest))
    for parts in wrong:
        refuse(CheckpointError, ".", trainer.load, unflatten(*parts))
    assert same(trainer.state_dict(), before)


def test_a_run_is_not_continued_with_the_checkpoints_of_another_method(name, finished, tmp_path):
    other = NAMES[NAMES.index(name) - 1]
    run = RunDirectory.create(tmp_path / "run", finished(name).config())
    run.checkpoints.mkdir()
    state = load_checkpoint(finished(other).checkpoints)
    save_checkpoint(run.checkpoints, state["iteration"], state)
    files = contents(run.path)
    refuse(CheckpointError, "another method", train, make_config(name), run.path, resume=True)
    if make_config(other).method.kind != make_config(name).method.kind:
        refuse(CheckpointError, ".", load_policy, run, TOY)
    assert contents(run.path) == files


def test_a_run_is_not_continued_with_another_configuration(finished):
    for change in ({"seed": 1}, {"minutes": 3.5}, {"evaluate_goals": 2}):
        with pytest.raises(CheckpointError, match=f"expected {next(iter(change))} = .*, got "):
            train(make_config("violation", **change), finished("violation").path, resume=True)


def test_a_model_to_start_from_is_taken_or_refused(name, tmp_path):
    sizes = {"right": (2, 1, 1), "wrong": (3, 1, 1)}
    for which, (n_x, n_u, n_lam) in sizes.items():
        LCSModel(n_x, n_u, n_lam, init_scale=0.01).save_pretrained(tmp_path / which)
    takes = make_config(name).method.takes_init
    for which, error in (("right", None), ("wrong", "init: expected a model with n_x=2")):
        out = tmp_path / f"from-{which}"
        if takes and error is None:
            run = train(make_config(name), out, init=str(tmp_path / which))
            assert load_model(run.path).n_lam == 1
            continue
        with pytest.raises(InvalidInputError, match=error if takes else f"none with method {name}"):
            train(make_config(name), out, init=tmp_path / which)
        assert not out.exists()


def test_only_what_learned_a_model_gives_one_and_a_policy_only_of_its_sizes(name, finished):
    run = finished(name)
    if make_config(name).method.takes_init:
        model = load_model(run.path)
        assert (model.n_x, model.n_u) == (TOY.n_x, TOY.n_u)
        assert all(bool(torch.isfinite(value).all()) for value in model.state_dict().values())
    else:
        for path in (run.path, run.model):
            refuse(CheckpointError, ".", load_model, path)
    refuse(CheckpointError, "expected", load_policy, run, make_task(size=3))


# --- evaluation -------------------------------------------------------------------------------------------------------


def test_an_evaluation_repeats_bit_for_bit(name, finished):
    envs = TOY.make_envs(3)
    results = [evaluate(envs, load_policy(finished(name), TOY), 7, 5, STEPS) for _ in range(2)]
    before = torch.random.get_rng_state()
    policy = load_policy(finished(name).path, TOY)
    assert torch.equal(torch.random.get_rng_state(), before)
    results += [evaluate(envs, policy, 7, 5, STEPS) for _ in range(2)]
    assert all(result == results[0] for result in results)
    assert results[0].goals == 7
    envs.close()


def test_an_unfinished_run_gives_the_policy_of_its_trainer(name, make_trainer, tmp_path):
    trainer = make_trainer(name)
    config = make_config(name)
    run = RunDirectory.create(tmp_path / "run", {"kind": "run", "config": config.to_json(), "init": None})
    envs = TOY.make_envs(4)
    for _ in range(2):
        trainer.step()
        save_checkpoint(run.checkpoints, trainer.iteration, trainer.state_dict())
        assert not run.finished()
        found = evaluate(envs, load_policy(run, TOY), 8, 0, STEPS)
        assert found == evaluate(envs, trainer.policy, 8, 0, STEPS)
    envs.close()


# --- settings ---------------------------------------------------------------------------------------------------------


def leaves(settings: Any, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for f in fields(settings):
        value = getattr(settings, f.name)
        found |= leaves(value, f"{prefix}{f.name}.") if is_dataclass(value) else {f"{prefix}{f.name}": value}
    return found


def test_smoke_is_valid_and_small(name):
    method = make_config(name).method
    usual, small = type(method)(), type(method)().smoke()
    assert type(small) is type(usual)
    assert small.smoke() == small
    before, after = leaves(usual), leaves(small)
    for key, value in after.items():
        if value != before[key]:
            assert 0 < value < before[key], key
    tiny = TrainConfig(task="toy", method=usual, minutes=0.1 if name != "lcs-rl" else 5.0)
    tiny, asked = tiny.smoke(), tiny.minutes
    assert (tiny.minutes <= asked, tiny.evaluate_goals, tiny.final_goals) == (True, 4, 4)


@pytest.mark.parametrize("method", [None, 3, Method, type("Nameless", (get_method("violation"),), {"name": None})])
def test_what_is_no_method_is_not_registered(method):
    before = method_names()
    refuse(DTypeError, "subclass of Method", register_method, method)
    assert method_names() == before


def test_an_unknown_method_gets_the_names_there_are():
    refuse(InvalidInputError, r"lcs-rl, violation, ppo.*register_method", get_method, "magic")
    refuse(InvalidInputError, "magic", TrainConfig, method="magic")


# --- a task of one's own, by the command line -------------------------------------------------------------------------


def test_the_commands_know_it(capsys, tmp_path):
    out = tmp_path / "run"
    words = ["train", "--task", "toy", "--method", "violation", "--n-lam", "2", "--smoke", "--out", str(out)]
    assert cli.main(words) == 0
    assert cli.main(["train", "--out", str(out), "--resume"]) == 0
    assert load_model(out).n_lam == 2
    capsys.readouterr()
    assert cli.main(["evaluate", str(out), "--goals", "5", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["method"], record["task"], record["backend"], record["goals"]) == ("violation", "toy", "batched", 5)
