"""The scripts of reproduce/, from outside; they are no package, so that they are imported as their own scripts do."""

import contextlib
import io
import json
import math
import os
import signal
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path
from unittest.mock import Mock

import ablations
import dask
import deployment
import distributed
import fig_learning_curves
import fig_task
import fig_transfer
import masses
import numpy as np
import pandas as pd
import pytest
import recipes
import records
import report
import robustness
import runs
import small_models
import stats
import table1
import torch
import units
import worker
from rich.console import Console
from rich.progress import Progress
from units import OBJECTS, Preset, Unit

from difflcs.errors import CheckpointError, InvalidInputError
from difflcs.rl import TrainConfig, TrainedPolicy, evaluate, get_method, get_task
from tests.conftest import refuse

TINY = Preset("smoke", seeds=1, goals=2, final_goals=2, evaluate_at=(0.2, 0.5), smoke=True)
FIRST = units.FIRST_SEED
CUBE = Unit("cube", "lcs-rl", "ours", FIRST)
SCRATCH = Unit("mug", "lcs-rl", "ours", FIRST)
QUICK = [Unit(task, "violation", "ours", FIRST) for task in ("cube", "mug")]  # without TorchRL, which takes seconds
TRANSFER = Unit("mug", "ppo", "ours", FIRST, "cube")
KNOWN = {task: {"name": task, "source": "ycb_mesh", "sha256": "abc", "mass": 0.05} for task in ("cube", *OBJECTS)}
TIMES = ["machine", "train_seconds", "evaluation_seconds", "finished"]
"""Columns in which two results of the same unit may differ."""


pytestmark = pytest.mark.usefixtures("stand_ins")


def quietly(terminal=False):
    """A display, and the text that it shows."""
    stream = io.StringIO()
    return Progress(console=Console(file=stream, force_terminal=terminal, width=200), disable=not terminal), stream


def run_script(main, capsys, *arguments):
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as exit:  # of tyro: a word that is no choice
        code = exit.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def run_runs(arguments):
    return runs.command_line(runs.Runs, lambda options: runs.run(options, options.artefacts), arguments)


def run_fig_task(arguments):
    return runs.command_line(fig_task.DrawTask, fig_task.draw, arguments)


# --- the matrix and its keys ------------------------------------------------------------------------


def test_matrix_holds_every_unit_once_the_important_ones_first():
    preset = Preset("paper", seeds=3, goals=1, final_goals=1, slow=Preset("paper", seeds=1, goals=1, final_goals=1))
    found = units.matrix((), preset)
    assert len(found) == len(set(found))
    assert {unit.seed for unit in found} == {FIRST, FIRST + 1, FIRST + 2}
    # Cube: six of methods and recipes; objects: five, light ones, two transfers; both tasks of the ablations: all.
    assert len(found) == 3 * (6 + 6 * (5 + 1 + 2) + 2 * len(units.ABLATED)) + 1 * 2
    for position, unit in enumerate(found):
        assert unit.init is None or unit.init in found[:position]
    table = units.matrix(["table1"], preset)
    assert found[: len(table)] == table
    assert {(unit.method, unit.recipe) for unit in table} == {
        ("lcs-rl", "ours"), ("lcs-rl", "paper"),
        ("violation", "ours"), ("violation", "paper"), ("violation", "jin-posa"),
    }  # fmt: skip
    assert [unit.method for unit in found[-2:]] == ["pddm", "pddm"]  # what is slow comes last
    assert [unit.seed for unit in table] == sorted(unit.seed for unit in table)


def test_matrix_of_a_part():
    paper, one = units.PRESETS["paper"], units.PRESETS["paper"].with_amounts(1, None)
    slow = units.matrix(["curves"], paper, methods=["pddm"])
    assert {(unit.method, unit.seed - FIRST) for unit in slow} == {("pddm", seed) for seed in range(5)}
    assert len(units.matrix(["curves"], paper.with_amounts(10, None), methods=["pddm"], recipes=["authors"])) == 10
    masses = units.matrix(["masses"], one, objects=["mug"])
    assert masses == [Unit("mug", "lcs-rl", "paper", FIRST), Unit("mug", "lcs-rl", "light", FIRST)]
    assert [unit.spec.env_kwargs.get("object_mass") for unit in masses] == [None, 0.01]
    ablations = units.matrix(["ablations"], paper)
    assert {unit.task for unit in ablations} == set(units.ABLATION_TASKS)
    assert {unit.seed for unit in ablations} == set(range(FIRST, FIRST + units.ABLATION_SEEDS))
    # In each of them one part is missing: all differ from each other.
    configs = [units.config_of(unit, paper).method for unit in ablations if unit.task == "cube" and unit.seed == FIRST]
    tasks = [unit.changes.task for unit in ablations if unit.task == "cube" and unit.seed == FIRST]
    assert len({repr(pair) for pair in zip(configs, tasks, strict=True)}) == len(units.ABLATED) + 1


def test_config_is_the_default_recipe_but_for_what_the_unit_says():
    default = {name: recipes.changed(get_method(name)(), {"ppo": {"gain": None}}) for name in units.METHODS}
    for method in ("violation", "lcs-rl"):
        config = units.config_of(Unit("mug", method, "paper", 3), units.PRESETS["paper"])
        known = {name: new for name, new in recipes.PAPER.settings.items() if hasattr(default[method], name)}
        for name, new in known.items():
            mine, before = getattr(config.method, name), getattr(default[method], name)
            assert mine == (replace(before, **new) if isinstance(new, dict) else new)
        assert config.method == replace(default[method], **{name: getattr(config.method, name) for name in known})
        assert (config.task, config.seed, config.minutes) == ("mug", 3, 30.0)
        assert (config.evaluate_goals, config.final_goals) == (300, 1000)
        assert config.evaluation_seed == TrainConfig().evaluation_seed  # the same goals for every unit
    assert units.config_of(CUBE, units.PRESETS["paper"]).method == default["lcs-rl"]
    slow = units.config_of(replace(CUBE, method="pddm"), units.PRESETS["paper"])
    assert slow.method == default["pddm"]
    assert (slow.final_goals, slow.evaluate_at) == (300, (2.0, 6.0, 10.0, 20.0))


def test_a_recipe_changes_its_task_and_no_other():
    plain = get_task("mug")
    prior, without = Unit("mug", "violation", "jin-posa", 0).spec, Unit("mug", "lcs-rl", "no-penalty", 0).spec
    assert (plain.horizon, prior.horizon) == (8, 5)
    # The cost of a model whose action is the largest: nothing but the weight of the action differs, 200 and 0.001.
    x, u, goal = (torch.zeros(n, dtype=torch.float64) for n in (9, 6, 3))
    costs = [float(spec.make_cost().stage(x, u + 0.015, goal)) for spec in (plain, prior)]
    assert costs == pytest.approx([200 * 6 * 0.015**2, 0.001 * 6 * 0.015**2])
    assert float(prior.make_cost().stage(x + 0.01, u, goal)) == float(plain.make_cost().stage(x + 0.01, u, goal)) > 0
    far = torch.tensor([0.05, 0, 0], dtype=torch.float64)
    rewards = [float(spec.outcome(x, u, x, far, True)[0]) for spec in (plain, without)]
    assert rewards[1] - rewards[0] == pytest.approx(10)
    assert (plain.failure_penalty, without.failure_penalty) == (10, 0)
    env = without.make_env()
    env.reset(seed=0)
    infos = [env.step(np.zeros(6))[4] for _ in range(20)]
    assert not infos[-1]["success"]
    assert infos[-1]["reward_completion"] == 0
    env.close()


def test_the_same_model_is_deployed_in_several_ways(tmp_path, monkeypatch):
    (job,) = make_jobs([Unit("cube", "violation", "jin-posa", FIRST)], tmp_path).values()
    calls, measure = [], deployment.Deployments.measure

    def counted(self, run, protocol, goals):
        calls.append(protocol)
        if len(calls) == 2:
            raise KeyboardInterrupt  # after a checkpoint, before all ways of it are measured
        return measure(self, run, protocol, goals)

    monkeypatch.setattr(deployment.Deployments, "measure", counted)
    with pytest.raises(KeyboardInterrupt):
        worker.execute(job)
    rows = worker.execute(job)  # goes on where it stopped, and leaves nothing out
    assert calls == ["support", "task", "task", "support", "task"]
    assert list(rows.protocol) == ["support"] * 2 + ["task"] * 2
    assert list(rows["at"]) == [0.2, 0.5] * 2
    undisturbed = worker.execute(replace(job, work=tmp_path / "undisturbed"))
    pd.testing.assert_frame_equal(rows.drop(columns=TIMES), undisturbed.drop(columns=TIMES))


def test_key_changes_with_everything_that_decides_a_result_and_with_nothing_else(monkeypatch):
    def key(unit=CUBE, preset=TINY, objects=KNOWN):
        return units.key_of(unit, preset, objects)

    other = {**KNOWN, "cube": {**KNOWN["cube"], "mass": 0.06}}
    different = [
        key(),
        key(replace(CUBE, method="violation")),
        key(replace(CUBE, recipe="paper")),
        key(replace(CUBE, recipe="no-penalty")),  # the same settings, another task
        key(preset=replace(TINY, goals=3)),
        key(objects=other),
        key(TRANSFER),
        key(replace(TRANSFER, start="scratch")),
        key(TRANSFER, objects=other),  # the object is the same, but not what it starts from
    ]
    before = {method: key(replace(CUBE, method=method)) for method in units.METHODS}
    transferred = key(TRANSFER)
    with monkeypatch.context() as patch:
        patch.setattr(get_method("lcs-rl"), "version", 1001)
        changed = {method for method, old in before.items() if key(replace(CUBE, method=method)) != old}
        assert changed == {"lcs-rl"}
        different += [key(), key(TRANSFER)]  # its own method is the same, but not what it starts from
    assert len(set(different)) == len(different)
    assert key(replace(CUBE, seed=1)) == key()
    assert key(TRANSFER) == transferred


# --- computing --------------------------------------------------------------------------------------


def make_jobs(wanted, work, preset=TINY):
    return {job.unit: job for job in runs.make_jobs(wanted, preset, work)}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Results and runs of two units, computed in this process without interruption."""
    jobs = make_jobs(QUICK, tmp_path_factory.mktemp("undisturbed"))
    return {unit: worker.execute(job) for unit, job in jobs.items()}, jobs


def assert_same(jobs, undisturbed):
    """Whether what lies in the folders of units is, bit for bit, what was computed without interruption."""
    for unit, rows in undisturbed[0].items():
        pd.testing.assert_frame_equal(jobs[unit].result().drop(columns=TIMES), rows.drop(columns=TIMES))
        models = [
            folder / "run" / "model" / "model.safetensors"
            for folder in (jobs[unit].folder, undisturbed[1][unit].folder)
        ]
        assert models[0].read_bytes() == models[1].read_bytes()


@pytest.fixture(scope="module")
def local():
    """A client of one worker process, which may die twice of a unit; Dask would not wait for its next start."""
    options = {"distributed.scheduler.allowed-failures": 1, "distributed.deploy.lost-worker-timeout": "100 ms"}
    with dask.config.set(options), runs.connect(workers=1) as client:
        yield client


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # sockets of a killed Dask worker
def test_a_killed_worker_costs_nothing_but_time(local, undisturbed, tmp_path):
    jobs, stored, created = make_jobs(QUICK, tmp_path), [], []

    def kill(pid):
        # As soon as the first iteration is on disk. The rest of the unit takes longer.
        run, deadline = jobs[QUICK[0]].folder / "run", time.monotonic() + 240
        latest = run / "checkpoints" / "latest.json"
        while not latest.is_file() or json.loads(latest.read_text())["checkpoint"] == "000000":
            if time.monotonic() > deadline:
                return
            time.sleep(0.002)
        created.append((run / "config.json").stat().st_mtime_ns)
        os.kill(pid, signal.SIGKILL)

    (pid,) = local.run(os.getpid).values()
    killer = threading.Thread(target=kill, args=[pid])
    killer.start()
    failed = runs.compute(list(jobs.values()), local, stored.append, quietly()[0])
    killer.join()
    assert not failed
    assert created == [(jobs[QUICK[0]].folder / "run" / "config.json").stat().st_mtime_ns]  # resumed, not begun again
    assert_same(jobs, undisturbed)
    assert [rows.task[0] for rows in stored] == ["cube", "mug"]
    # All is finished: nothing is computed again.
    assert not runs.compute(list(jobs.values()), local, stored.append, quietly()[0], execute=None)
    assert len(stored) == 2


@pytest.fixture
def in_process():
    """A client of a Dask cluster in this process, for work that is only played."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0"
    ) as cluster, distributed.Client(cluster) as client:  # fmt: skip
        yield client


def played(broken=()):
    """Ends every unit at once; those on `broken` objects with a failure."""

    def execute(job):
        if job.unit.task in broken:
            raise ValueError("it [broke]")
        rows = unit_rows(job.unit, (0, 10, 20, 50), key=job.key, goals=2)
        (job.folder / "run").mkdir(parents=True)
        (job.folder / "run" / "config.json").write_text("{}")
        (job.folder / "run" / "received").write_text(str(job.init))
        records.write(job.folder / "result.csv", rows)
        return rows

    return execute


def test_failures_stop_what_depends_on_them_and_nothing_else_and_are_tried_again(in_process, tmp_path):
    jobs, stored = make_jobs(units.matrix(["transfer"], TINY, objects=["mug"], recipes=["ours"]), tmp_path), []
    display, text = quietly()
    failed = runs.compute(list(jobs.values()), in_process, stored.append, display, played(broken=["cube"]))
    assert "it [broke]" in (jobs[CUBE].folder / "error.txt").read_text()
    assert failed == {CUBE: "ValueError: it [broke]", TRANSFER: f"it starts from {CUBE}, which failed"}
    assert [rows.task[0] for rows in stored] == ["mug"]
    assert f"{CUBE}: FAILED: ValueError: it [broke]" in text.getvalue()
    assert f"{SCRATCH}: 50.0 % of 2 goals" in text.getvalue()
    display, text = quietly(terminal=True)
    with display:
        assert not runs.compute(list(jobs.values()), in_process, stored.append, display, played())
    assert [(rows.task[0], rows.start[0]) for rows in stored[1:]] == [("cube", "scratch"), ("mug", "cube")]
    assert "units" in text.getvalue()
    received = (jobs[TRANSFER].folder / "run" / "received").read_text()
    assert received == str(jobs[CUBE].folder / "run")  # of what it starts from


def test_only_what_is_missing_in_the_results_is_computed(tmp_path, capsys):
    jobs = make_jobs(units.matrix(["transfer"], TINY, objects=["mug"], recipes=["ours"]), tmp_path)

    def missing(*known):
        rows = [unit_rows(job.unit, (0, 10, 20, 50), key=job.key) for unit, job in jobs.items() if unit in known]
        return [job.unit for job in runs.still_missing(list(jobs.values()), rows)]

    assert missing() == list(jobs) == [SCRATCH, CUBE, TRANSFER]
    assert missing(*jobs) == []
    assert missing(SCRATCH) == [CUBE, TRANSFER]
    assert missing(SCRATCH, CUBE) == [CUBE, TRANSFER]  # the run that it starts from is not in the results
    assert missing(CUBE, TRANSFER) == [SCRATCH]
    stale = unit_rows(SCRATCH, (0, 10, 20, 50), key="0123456789ab")
    assert SCRATCH in [job.unit for job in runs.still_missing(list(jobs.values()), [stale])]

    arguments = ("--preset", "smoke", "--artefacts", "table1", "--objects", "mug", "--methods", "violation")
    preset = units.PRESETS["smoke"]
    (job,) = make_jobs([replace(SCRATCH, method="violation")], tmp_path / "elsewhere", preset).values()
    records.add(tmp_path, "smoke", unit_rows(job.unit, (0, 10, 20, 50), "stand_in", key=job.key))
    folders = ("--work", tmp_path / "work", "--results", tmp_path)
    code, out, err = run_script(run_runs, capsys, *arguments, "--missing", *folders)
    assert code == 0, err
    assert "1 units" in out
    assert "1 finished before" in out
    assert not (tmp_path / "work").exists()


def test_a_worker_that_would_compute_something_else_refuses(tmp_path):
    job = make_jobs([SCRATCH], tmp_path)[SCRATCH]
    other = replace(job, key="0123456789ab")  # as where other versions, settings or meshes are
    message = refuse(InvalidInputError, "install the same version of difflcs there", worker.execute, other)
    assert "set DIFFLCS_YCB_DIR" in message
    assert other.result() is None


def test_what_is_stale_or_foreign_is_not_taken_for_a_result(tmp_path, monkeypatch):
    job = make_jobs([CUBE], tmp_path)[CUBE]
    rows = played()(job)
    assert job.result() is not None
    with monkeypatch.context() as patch:  # another version of the method is computed anew, elsewhere
        patch.setattr(get_method("lcs-rl"), "version", 1001)
        newer = make_jobs([CUBE], tmp_path)[CUBE]
        assert newer.result() is None
        assert newer.folder != job.folder
    for content in (
        "",
        "rubbish",
        (job.folder / "result.csv").read_text().replace(job.key, "0123456789ab"),
        (job.folder / "result.csv").read_text().replace("lcs-rl", "ppo"),
    ):
        records.write(job.folder / "result.csv", rows)
        (job.folder / "result.csv").write_text(content)
        assert job.result() is None
    records.write(job.folder / "result.csv", rows)
    (job.folder / "run" / "config.json").unlink()
    assert job.result() is None


def test_ctrl_c_says_how_to_go_on(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(runs, "compute", Mock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr(runs, "connect", lambda *arguments: contextlib.nullcontext())
    code, _, err = run_script(run_runs, capsys, "--methods", "pddm", "--work", tmp_path, "--results", tmp_path)
    assert code == 130
    assert "the same command goes on" in err


def test_a_script_computes_and_draws(local, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(runs, "connect", lambda workers: contextlib.nullcontext(local))
    options = ["--rerun", "--preset", "smoke", "--objects", "mug", "--methods", "violation"]
    folders = ["--work", tmp_path / "work", "--results", tmp_path]
    code, out, err = run_script(table1.main, capsys, *options, *folders)
    assert code == 0, err
    assert "smoke: 1 units of 0.5 minutes of data, 1 seeds, 4 goals; 0 finished before" in out
    rows = records.read(tmp_path / "smoke-stand-in.csv")
    assert list(rows["at"]) == [0.0, 0.2, 0.5] * 2
    assert list(rows.protocol) == ["full"] * 3 + ["support"] * 3
    assert set(rows.version) == {str(get_method("violation").version)}
    # One seed: the interval is Wilson's, of its goals.
    line = next(line for line in (tmp_path / "table1-smoke-stand-in.md").read_text().splitlines() if "| mug" in line)
    last = rows[rows.protocol == "full"].iloc[-1]
    assert f"{100 * last.success:.1f} [{100 * last.ci_low:.1f}, {100 * last.ci_high:.1f}]" in line
    code, out, _ = run_script(table1.main, capsys, *options, *folders)
    assert "1 finished before" in out


# --- statistics -------------------------------------------------------------------------------------


def test_bootstrap_against_numbers_by_hand():
    # Of two seeds the mean of a resample is 40, 50, 50 or 60.
    assert stats.bootstrap([[40.0, 60.0]]) == (50.0, 40.0, 60.0)
    assert stats.bootstrap([[50.0] * 3]) == (50.0, 50.0, 50.0)
    # Seeds are drawn within each object: between two objects there is nothing to draw.
    assert stats.bootstrap([[10.0, 10.0], [90.0, 90.0]]) == (50.0, 50.0, 50.0)
    assert stats.bootstrap([[0.0, 40.0], [50.0, 100.0]], stats.IQM).value == 45.0
    found = stats.bootstrap([[3.0]])
    assert found.value == 3.0
    assert math.isnan(found.low)
    many = np.random.default_rng(0).normal(50.0, 10.0, 400)
    found = stats.bootstrap([many])
    assert found.high - found.low == pytest.approx(2 * 1.96 * many.std() / 20, rel=0.1)


def test_p_value_against_scipy():
    from scipy.stats import permutation_test

    for seeds in (4, 7, 10):
        apart = np.random.default_rng(seeds).normal(0.6, 1.0, seeds)
        theirs = permutation_test((apart,), np.mean, permutation_type="samples", n_resamples=np.inf)
        assert stats.p_value(apart) == pytest.approx(theirs.pvalue)
    assert stats.p_value([1.0, 2.0, 3.0]) == 0.25  # two of eight choices of signs
    assert stats.p_value([0.0, 0.0]) == 1.0
    assert stats.p_value([100 * 0.7 - 100 * 0.4, 30.0]) == 0.5  # but for rounding the same
    assert math.isnan(stats.p_value([1.0]))


# --- results ----------------------------------------------------------------------------------------


def unit_rows(unit, values, source="ycb_mesh", goals=1000, **changes):
    """Rows as of a finished unit; `values` are percent at 0, 6, 10 and 30 minutes."""
    base = dict(
        **asdict(unit), protocol="full", ci_low=0.0, ci_high=1.0, goals=goals, evaluation_seed=0, solver_failures=0,
        source=source, mass=0.05, version="1", key=f"{unit.method}{unit.recipe}{goals}", versions="difflcs=1",
        machine="a machine", train_seconds=20.0, evaluation_seconds=10.0, finished="2026-01-01T00:00:00+00:00",
    )  # fmt: skip
    points = zip((0.0, 6.0, 10.0, 30.0), values, strict=True)
    rows = [{**base, "at": at, "minutes": at, "success": value / 100, **changes} for at, value in points]
    return pd.DataFrame(rows)[list(records.COLUMNS)].astype(records.COLUMNS)


@pytest.fixture
def results(tmp_path):
    """Results of three seeds: violation-only peaks at 6 minutes with 40, 50, 60 %, LCS-RL ends with 70, 80, 90 %."""
    rows = []
    for seed in range(3):
        shift = 10 * seed
        for task in ("cube", "mug"):
            for unit, values in (
                (Unit(task, "violation", "ours", seed), (0, 40 + shift, 30 + shift, 10 + shift)),
                (Unit(task, "lcs-rl", "ours", seed), (0, 40 + shift, 50 + shift, 70 + shift)),
                (Unit(task, "violation", "paper", seed), (0, 20, 20, 20)),
            ):
                rows.append(unit_rows(unit, values))
        rows.append(unit_rows(Unit("mug", "violation", "jin-posa", seed), (0, 0, 0, 12), protocol="support"))
        rows.append(unit_rows(Unit("mug", "ppo", "ours", seed, "cube"), (30, 60, 70, 79 + shift)))
        rows.append(unit_rows(Unit("cube", "pddm", "ours", seed), (0, 2, 2, 4), goals=50))
    records.write(records.path_of(tmp_path, "paper"), pd.concat(rows))
    return tmp_path


def test_nothing_is_mixed_or_replaced_silently(results, capsys):
    unit = Unit("mug", "lcs-rl", "ours", 0)
    # Other numbers of goals stand beside each other; the larger amount is shown, and what is left out is said.
    records.add(results, "paper", unit_rows(unit, (0, 0, 0, 1), goals=300))
    cell = records.select(records.read(results / "paper.csv"), "mug", "lcs-rl", "ours")
    assert (list(cell.scores.index), cell.left_out) == ([0, 1, 2], 1)
    assert list(cell.at("final")) == [70.0, 80.0, 90.0]
    # The same unit computed by another version is not averaged with the others either, and replaces nothing.
    records.add(results, "paper", unit_rows(unit, (0, 0, 0, 2), version="2", key="another"))
    assert run_script(table1.main, capsys, "--results", results)[0] == 0
    markdown = (results / "table1.md").read_text()
    assert "LCS-RL, our recipe: version 1, 3 seeds × 1000 goals; 2 trainings of others left out (mug)" in markdown
    # Computed again, a unit replaces itself alone.
    records.add(results, "paper", unit_rows(unit, (0, 0, 0, 3)))
    rows = records.read(results / "paper.csv")
    cell = records.select(rows, "mug", "lcs-rl", "ours")
    assert list(cell.at("final")) == [3.0, 80.0, 90.0]
    assert len(rows[(rows.task == "mug") & (rows.method == "lcs-rl") & (rows.seed == 0)]) == 3 * 4
    # As soon as a newer version has as much, it is the one that is shown.
    for seed in range(3):
        unit = replace(unit, seed=seed)
        newer = unit_rows(unit, (0, 0, 0, 4), version="2", key="another", finished="2026-01-02T00:00:00+00:00")
        records.add(results, "paper", newer)
    cell = records.select(records.read(results / "paper.csv"), "mug", "lcs-rl", "ours")
    assert list(cell.at("final")) == [4.0, 4.0, 4.0]
    assert cell.left_out == 4


def test_only_what_can_be_compared_is(results):
    rows = records.read(results / "paper.csv")
    a, b = (records.select(rows, "mug", method, "ours") for method in ("lcs-rl", "violation"))
    assert report.paired(a, b, "final") == pytest.approx([60.0, 60.0, 60.0])
    assert len(report.paired(a, replace(b, rows=b.rows[b.rows.seed > 0]), "final")) == 2
    for column, value in (("goals", 300), ("evaluation_seed", 1), ("source", "stand_in"), ("mass", 0.1)):
        other = replace(b, rows=b.rows.assign(**{column: value}))
        assert report.paired(a, other, "final") == []
    assert report.paired(a, records.select(rows, "cube", "violation", "ours"), "final") == []
    assert report.paired(a, None, "final") == []


def test_the_tracked_readme_and_tables_are_those_of_the_tracked_results(tmp_path, monkeypatch, capsys):
    scripts = {
        "table1": table1, "fig_learning_curves": fig_learning_curves, "fig_transfer": fig_transfer,
        "ablations": ablations, "small_models": small_models, "robustness": robustness,
        "masses": masses,
    }  # fmt: skip
    text, tracked = report.README.read_text(), records.RESULTS
    readme = tmp_path / "README.md"
    readme.write_text(text)
    for path in [*tracked.glob("paper*.csv"), *tracked.glob("*.json")]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(report, "README", readme)
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    monkeypatch.setattr(report, "write_figure", lambda *_: None)  # laying them out takes seconds
    shown = [name for name in scripts if (tracked / f"{name}.md").exists()]
    assert set(shown) >= {"table1", "fig_learning_curves", "fig_transfer", "small_models"}
    for name, script in scripts.items():
        assert f"<!-- results: {name} -->" in text
        if hasattr(script, "Options"):
            code = script.draw_record(script.Options(results=tmp_path)) if name in shown else 0
        else:
            code, _, _ = run_script(script.main, capsys, "--results", tmp_path, "--preset", "paper")
        assert (code == 0) or name not in shown
        written = tmp_path / f"{name}.md"
        assert written.exists() == (name in shown)
        assert name not in shown or written.read_text() == (tracked / f"{name}.md").read_text()
    assert readme.read_text() == text, "run the scripts of reproduce/ to bring README.md up to date"


# --- other systems ----------------------------------------------------------------


def test_robustness_is_resumed_and_refuses_another_record(tmp_path, monkeypatch, capsys):
    measured, measure = [], robustness.measure

    def counted(condition, *rest):
        measured.append(condition.name)
        if len(measured) == 3:
            raise KeyboardInterrupt
        return measure(condition, *rest)

    monkeypatch.setattr(robustness, "measure", counted)
    options = robustness.Options(goals=2, smoke=True, results=tmp_path)
    with pytest.raises(KeyboardInterrupt):
        robustness.draw_record(options)
    assert robustness.draw_record(options) == 0
    assert measured[2] == measured[3]  # the one that was interrupted, none of those before
    assert len(measured) == len(set(measured)) + 1
    record = json.loads((tmp_path / "robustness-smoke.json").read_text())
    nominal = evaluate(get_task("cube").make_envs(2), TrainedPolicy.open(options.model).policy, 2, 0)
    assert record["results"][0]["reached"].count("1") == nominal.successes
    assert (tmp_path / "robustness-smoke.png").is_file()
    assert not (tmp_path / "robustness.json").exists()
    refuse(CheckpointError, "pass another --results", robustness.draw_record, replace(options, goals=1))
    (tmp_path / "robustness.json").write_text(json.dumps(record))
    with pytest.raises(CheckpointError, match="expected a record of runs/mine, got one of zoo:trifinger-cube"):
        robustness.draw_record(replace(options, smoke=False, model=Path("runs/mine")))
    for text, message in ((json.dumps(record)[:-9], "expected JSON"), ("[]", "expected machine, options")):
        (tmp_path / "robustness.json").write_text(text)
        refuse(CheckpointError, rf"robustness\.json: {message}", robustness.draw_record, replace(options, smoke=False))
    (tmp_path / "robustness.json").unlink()
    refuse(CheckpointError, r"robustness\.py --rerun", robustness.draw_record, replace(options, smoke=False))


# --- bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("main", "arguments", "message"),
    [
        (table1.main, ["--rerun", "--preset", "papers"], "invalid choice 'papers'"),
        (table1.main, ["--rerun", "--objects", "teapot"], "invalid choice 'teapot'"),
        (run_runs, ["--methods", "sac"], "invalid choice 'sac'"),
        (run_runs, ["--artefacts", "table2"], "invalid choice 'table2'"),
        (run_runs, ["--artefacts", "transfer", "--methods", "pddm"], "units: expected at least one"),
        (run_runs, ["--seeds", "0"], "seeds: expected"),
        (run_runs, ["--goals", "-1"], "goals: expected"),
        (run_runs, ["--workers", "0"], "workers: expected"),
        (table1.main, [], "python reproduce/table1.py --rerun --preset quick"),
        (table1.main, ["--seeds", "3"], "seeds: expected with --rerun alone"),
        (fig_transfer.main, ["--preset", "paper"], "reproduce/fig_transfer.py --rerun --preset paper"),
        (run_fig_task, ["--run", "zoo:trifinger-mug"], "expected a model of the cube, got one of mug"),
        (run_fig_task, ["--run", "nowhere"], "nowhere"),
    ],
)
def test_bad_input(main, arguments, message, tmp_path, capsys):
    folder = tmp_path / "results"
    code, _, err = run_script(main, capsys, *arguments, "--results", folder, "--work", tmp_path / "work")
    assert code == 2
    assert message in err
    assert not folder.exists()  # nothing written


@pytest.mark.parametrize("content", ["", "format,other\n1,2\n", "an older one"])
def test_results_of_another_version_stay_as_they_are(content, results, capsys):
    path = results / "paper.csv"
    if content == "an older one":
        content = path.read_text().replace("version,key", "settings,code")
    path.write_text(content)
    unit = Unit("mug", "lcs-rl", "ours", FIRST)
    for main, arguments in ((table1.main, []), (run_runs, ["--preset", "paper"])):
        code, _, err = run_script(main, capsys, *arguments, "--results", results, "--work", results / "work")
        assert code == 2
        assert "paper.csv: expected results with the columns task, method" in err
    refuse(CheckpointError, "Nothing was changed", records.add, results, "paper", unit_rows(unit, (1, 2, 3, 4)))
    assert path.read_text() == content
    assert not (results / "table1.md").exists()


# --- the task's figure ------------------------------------------------------------------------------


def test_the_task_is_drawn(undisturbed, tmp_path, monkeypatch, capsys):
    from difflcs_envs import RenderingError

    monkeypatch.setattr(fig_task, "TRIES", 4)  # the model has learned nothing
    monkeypatch.setattr(fig_task, "SIZE", (320, 240))

    try:
        from difflcs_envs.rendering import _make_gl_context

        _make_gl_context(64, 64).free()
    except RenderingError as error:
        pytest.skip(f"needs OpenGL: {error}")
    job = make_jobs([CUBE], tmp_path / "work")[CUBE]
    played()(job)
    assert fig_task.newest(job.work) == job.folder / "run"
    job = undisturbed[1][QUICK[0]]
    code, out, err = run_script(run_fig_task, capsys, "--results", tmp_path, "--run", job.folder / "run")
    assert code == 0, err
    assert f"model: {job.folder / 'run'}" in out
    assert (tmp_path / "fig_task.png").stat().st_size > 50_000
    assert fig_task.DrawTask().run == Path("zoo:trifinger-cube")  # without options
