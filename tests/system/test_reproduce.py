"""The scripts of reproduce/, from outside; they are no package, so that they are imported as their own scripts do."""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

for package in ("distributed", "matplotlib", "mujoco", "rich", "scipy", "tensorboard", "tyro"):
    pytest.importorskip(package, reason="the extra [reproduce] is not installed")
FOLDER = Path(__file__).parents[2] / "reproduce"
sys.path.insert(0, str(FOLDER))

import fig_learning_curves  # noqa: E402
import fig_task  # noqa: E402
import fig_transfer  # noqa: E402
import pools  # noqa: E402
import records  # noqa: E402
import report  # noqa: E402
import runs  # noqa: E402
import table1  # noqa: E402
import units  # noqa: E402
import worker  # noqa: E402
from paper import TABLE1  # noqa: E402
from stats import compare, summarise  # noqa: E402
from units import OBJECTS, Preset, Unit  # noqa: E402

from difflcs.errors import DiffLCSError, InvalidInputError, ShapeError  # noqa: E402

TINY = Preset("smoke", seeds=1, goals=2, evaluate_at=(0.2, 0.5), smoke=True)
FIRST = units.FIRST_SEED
CUBE = Unit("cube", "lcs-rl", "ours", FIRST)
TRANSFER = Unit("mug", "ppo", "ours", FIRST, "cube")
SOURCES = {task: {"source": "ycb_mesh", "sha256": "abc"} for task in ("cube", *OBJECTS)}


@pytest.fixture(scope="module", autouse=True)
def stand_ins(tmp_path_factory):
    """No meshes, whatever this machine has: the same objects everywhere."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DIFFLCS_YCB_DIR", raising=False)
        patch.setenv("DIFFLCS_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


# --- the matrix and its keys ------------------------------------------------------------------------


def test_matrix_holds_every_unit_once_and_what_it_starts_from_first():
    found = units.matrix((), seeds=2)
    assert len(found) == len(set(found))
    assert {unit.seed for unit in found} == {FIRST, FIRST + 1}
    # Cube: two methods with two recipes each, two without; objects: two methods, and LCS-RL from the cube.
    assert len(found) == 2 * (2 * 2 + 2 + 6 * 2 + 6)
    for position, unit in enumerate(found):
        assert unit.init is None or unit.init in found[:position]


def test_matrix_of_a_part():
    assert units.matrix(["transfer"], 1, objects=["mug"]) == [Unit("mug", "lcs-rl", "ours", FIRST), CUBE, TRANSFER]
    table = units.matrix(["table1"], 1, objects=["banana", "mug"], methods=["violation"], recipes=["paper"])
    assert table == [Unit(task, "violation", "paper", FIRST) for task in ("mug", "banana")]
    assert {unit.method for unit in units.matrix(["curves"], 1, methods=["pddm"])} == {"pddm"}


def test_config_is_the_default_recipe_but_for_what_the_unit_says():
    config = units.config_of(Unit("mug", "violation", "paper", 3), units.PRESETS["paper"])
    default = units.TrainConfig()
    assert (config.task, config.method, config.seed, config.minutes) == ("mug", "violation", 3, 30.0)
    assert config.warmup == replace(default.warmup, noise=0.0)
    assert config.imagination == replace(default.imagination, iterations=0)
    assert config.ppo == replace(default.ppo, natural=False, steps=20, minibatch=None)
    assert config.warmup_minutes == 6.0
    assert units.config_of(CUBE, units.PRESETS["paper"]).ppo == default.ppo
    assert config.evaluate_goals == config.final_goals == 1000
    assert config.evaluation_seed == default.evaluation_seed  # the same goals for every unit


def test_key_changes_with_everything_that_decides_a_result_and_with_nothing_else(monkeypatch):
    def key(unit=CUBE, preset=TINY, sources=SOURCES, code="1.2"):
        return units.unit_key(unit, preset, sources, code)

    other = {**SOURCES, "cube": {"source": "stand_in", "sha256": ""}}
    different = [
        key(),
        key(code="1.3"),
        key(replace(CUBE, seed=1)),
        key(replace(CUBE, method="violation")),
        key(replace(CUBE, recipe="paper")),
        key(preset=replace(TINY, goals=3)),
        key(sources=other),
        key(TRANSFER),
        key(TRANSFER, sources=other),  # the object is the same, but not what it starts from
    ]
    assert len(set(different)) == len(different)
    assert units.settings_hash(CUBE, TINY, SOURCES) == units.settings_hash(replace(CUBE, seed=1), TINY, SOURCES)
    before = {method: key(replace(CUBE, method=method)) for method in ("lcs-rl", "violation", "ppo", "pddm")}
    of_unit = units.config_of

    def tuned(unit, preset):
        config = of_unit(unit, preset)
        return replace(config, ppo=replace(config.ppo, clip=0.123))

    monkeypatch.setattr(units, "config_of", tuned)
    changed = {method for method, old in before.items() if key(replace(CUBE, method=method)) != old}
    assert changed == {"lcs-rl", "ppo"}  # only these read PPO's settings


def test_code_version_sees_what_decides_a_method(monkeypatch):
    read = Path.read_text

    def version(file="", old="", new=""):
        def changed(path, *arguments, **keywords):
            text = read(path, *arguments, **keywords)
            if path.name != file:
                return text
            assert old in text
            return text.replace(old, new)

        monkeypatch.setattr(Path, "read_text", changed)
        return {method: units.code_version(method) for method in units.METHODS}

    known = version()

    def differ(*change):
        return {method for method, code in version(*change).items() if code != known[method]}

    assert not differ("warmup.py", '    """Settings of the warm-up.', '    # A comment.\n    """Other words.')
    assert not differ("warmup.py", "epochs: int = 15", "epochs: int = 16")  # in the hash of the settings
    assert differ("ppo.py", "config.reward_scale * rewards", "rewards") == {"lcs-rl", "ppo"}
    assert differ("dynamics.py", "relu_", "tanh_") == {"lcs-rl", "ppo", "pddm"}
    assert differ("pddm.py", "softmax", "log_softmax") == {"pddm"}
    assert differ("losses.py", "return ", "return 2 * ") == set(units.METHODS)
    assert len({units.shared_code(code) for code in known.values()}) == 1


# --- computing --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Records of two units, one starting from the other, computed in this process without interruption."""
    threads = torch.get_num_threads()
    work = tmp_path_factory.mktemp("undisturbed")
    specs = runs.make_specs([CUBE, TRANSFER], TINY, work)
    first = worker.execute(specs[CUBE])
    second = worker.execute({**specs[TRANSFER], "init": first["model"]})
    torch.set_num_threads(threads)
    assert first["error"] is None, first
    assert second["error"] is None, second
    return {CUBE: first, TRANSFER: second}


class Killer:
    """Kills the process of the first unit that reports, once, as soon as the first iteration is on disk."""

    def __init__(self, folders):
        self.folders, self.killed = folders, None

    def __call__(self, progress):
        for key, state in progress.items():
            if self.killed is None and "pid" in state:
                self._wait_for_checkpoint(Path(self.folders[key]) / "run" / "checkpoints" / "latest.json")
                self.killed = key
                os.kill(state["pid"], signal.SIGKILL)

    def _wait_for_checkpoint(self, latest):
        # Far finer than `compute` polls: the rest of the unit, TorchRL's import included, takes longer than this.
        deadline = time.monotonic() + 240
        while not latest.is_file() or json.loads(latest.read_text())["checkpoint"] == "000000":
            assert time.monotonic() < deadline, "the unit wrote no checkpoint"
            time.sleep(0.002)


def same(record, expected):
    """Whether two records tell of the same result, bit for bit."""
    return all(record.get(name) == expected[name] for name in ("curve", "model", "key", "settings", "object", "error"))


@pytest.mark.parametrize(
    "make_pool", [lambda: pools.LocalPool(1), lambda: pools.DaskPool("local:1")], ids=["local", "dask"]
)
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # sockets of a killed Dask worker
def test_a_killed_worker_costs_nothing_but_time(make_pool, undisturbed, tmp_path):
    specs = runs.make_specs([CUBE, TRANSFER], TINY, tmp_path)
    killer, stored = Killer({spec["key"]: spec["folder"] for spec in specs.values()}), []
    pool = make_pool()
    try:
        found = runs.compute(specs, pool, stored.append, observe=killer)
    finally:
        pool.close()
    assert killer.killed == specs[CUBE]["key"]
    assert found[CUBE]["resumed"]
    for unit, expected in undisturbed.items():
        assert same(found[unit], expected), (found[unit]["error"], unit)
    assert [Unit(**record["unit"]) for record in stored] == [CUBE, TRANSFER]
    # All is finished: nothing is computed again.
    assert runs.compute(specs, runs._NoPool(), stored.append) == found


@pytest.fixture
def cluster(tmp_path):
    """Address of a Dask scheduler with a worker, two processes started as on a cluster: elsewhere, by its own tools."""
    file = tmp_path / "scheduler.json"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    commands = (
        ["dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show"],
        ["dask_worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(elsewhere)],
    )
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{name}", "--scheduler-file", str(file), *options],
            cwd=elsewhere,
            stderr=subprocess.DEVNULL,
        )
        for name, *options in commands
    ]
    try:
        deadline, address = time.monotonic() + 120, None
        while address is None:
            assert time.monotonic() < deadline, "the scheduler did not start"
            time.sleep(0.1)
            with contextlib.suppress(OSError, ValueError):  # not there, or not whole yet
                address = json.loads(file.read_text())["address"]
        yield address
    finally:
        for process in reversed(processes):  # the worker first: it takes leave of its scheduler, and may hang without
            process.terminate()
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def test_a_cluster_that_runs_already(cluster, undisturbed, tmp_path):
    pool = runs.make_pool(runs.Compute(scheduler=cluster))
    try:
        pool._client.wait_for_workers(1, timeout=120)
        found = runs.compute(runs.make_specs([CUBE, TRANSFER], TINY, tmp_path / "work"), pool, lambda record: None)
    finally:
        pool.close()
    for unit, expected in undisturbed.items():
        assert same(found[unit], expected), (found[unit]["error"], unit)


class FakePool:
    """Ends every unit at once; those of `broken` methods with a failure."""

    slots = 2

    def __init__(self, broken=()):
        self.broken, self.ended, self.order = broken, [], []

    def submit(self, spec):
        self.order.append(Unit(**spec["unit"]))
        record = {"format": worker.FORMAT, "key": spec["key"], "unit": spec["unit"], "error": None, "model": {"a": "b"}}
        record = worker.failure(spec, "it broke") if self.order[-1].task in self.broken else record
        self.ended.append({**record, "received": spec["init"], "curve": [{"success": 0.5, "goals": 2}]})

    def finished(self):
        ended, self.ended = self.ended, []
        return ended

    def progress(self):
        return {}

    def close(self):
        pass


def test_failures_stop_what_depends_on_them_and_nothing_else_and_are_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "_POLL_SECONDS", 0)
    wanted = units.matrix(["transfer"], 1, objects=["mug"])
    specs = runs.make_specs(wanted, TINY, tmp_path)
    scratch = Unit("mug", "lcs-rl", "ours", FIRST)
    stored = []
    found = runs.compute(specs, FakePool(broken=["cube"]), stored.append)
    assert found[CUBE]["error"] == "it broke"
    assert "starts from cube lcs-rl" in found[TRANSFER]["error"]
    assert found[scratch]["error"] is None
    assert len(stored) == 1
    pool = FakePool()
    found = runs.compute(specs, pool, stored.append)
    assert pool.order == [CUBE, TRANSFER]  # the other one is finished
    assert found[TRANSFER]["received"] == {"a": "b"}  # the model of what it starts from
    assert not any(record["error"] for record in found.values())


def test_what_a_unit_starts_from_must_be_there(tmp_path):
    specs = runs.make_specs([CUBE, TRANSFER], TINY, tmp_path)
    with pytest.raises(InvalidInputError, match="starts, among them"):
        runs.compute({TRANSFER: specs[TRANSFER]}, FakePool(), lambda record: None)


def test_the_display_tells_failures_and_the_time_left(tmp_path, monkeypatch):
    import io

    from progress import Display
    from rich.console import Console

    monkeypatch.setattr(runs, "_POLL_SECONDS", 0)
    for terminal in (True, False):
        stream = io.StringIO()
        specs = runs.make_specs(units.matrix(["transfer"], 1, objects=["mug"]), TINY, tmp_path / str(terminal))
        with Display(3, 0.5, Console(file=stream, force_terminal=terminal, width=200)) as display:
            runs.compute(specs, FakePool(broken=["cube"]), lambda record: None, display)
            display.durations = {"lcs-rl": [10.0, 20.0]}
            assert display._left({}, [CUBE, CUBE], slots=2) == 15.0
        assert "FAILED: it broke" in stream.getvalue()
        assert "50.0 % of 2 goals" in stream.getvalue()


def test_an_error_in_a_unit_is_its_record(tmp_path, one_thread):
    spec = runs.make_specs([Unit("mug", "violation", "ours", FIRST)], TINY, tmp_path).popitem()[1]
    for change, message in (
        ({"source": {"source": "ycb_mesh", "sha256": "abc"}}, "set DIFFLCS_YCB_DIR there"),
        ({"code": "00000000.00000000.00000000"}, "install the same code there"),
    ):
        record = worker.execute({**spec, **change})
        assert message in record["error"]
        assert worker.finished_record(Path(spec["folder"]), spec["key"]) is None
        assert (Path(spec["folder"]) / "record.json").is_file()


def test_a_process_that_always_dies_is_a_failure(tmp_path, monkeypatch):
    script = tmp_path / "dies.py"
    script.write_text("import sys; print('last words', flush=True); sys.exit(7)")
    monkeypatch.setattr(pools.worker, "__file__", str(script))
    specs = runs.make_specs([CUBE], TINY, tmp_path)
    pool = pools.LocalPool(1)
    found = runs.compute(specs, pool, lambda record: None)
    assert "exit code 7" in found[CUBE]["error"]
    assert found[CUBE]["traceback"].count("last words") == pools.ATTEMPTS


def test_finished_units_of_accepted_code_count(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "_POLL_SECONDS", 0)
    with monkeypatch.context() as patch:
        patch.setattr(runs, "code_version", lambda method: "old")
        runs.compute(runs.make_specs([CUBE], TINY, tmp_path), FakePool(), lambda record: None)
    monkeypatch.setattr(runs, "code_version", lambda method: "new")
    for accept, submitted in ((("old",), 0), ((), 1)):
        pool = FakePool()
        runs.compute(runs.make_specs([CUBE], TINY, tmp_path, accept), pool, lambda record: None)
        assert len(pool.order) == submitted


# --- statistics -------------------------------------------------------------------------------------


def test_summary_against_numbers_by_hand():
    found = summarise([50.0, 60.0, 70.0])
    # t(0.975, 2 degrees of freedom) = 4.302653; 10 / sqrt(3) = 5.773503
    assert (found.n, found.mean, found.sd) == (3, 60.0, 10.0)
    assert found.low == pytest.approx(60 - 4.302653 * 5.773503, abs=1e-4)
    assert found.high == pytest.approx(60 + 4.302653 * 5.773503, abs=1e-4)
    assert summarise([3.0]).mean == 3.0
    assert math.isnan(summarise([3.0]).sd)


def test_comparison_against_scipy():
    from scipy.stats import ttest_rel

    a, b = [80.1, 85.3, 91.0, 78.2], [60.3, 70.9, 55.1, 72.4]
    found, expected = compare(a, b), ttest_rel(a, b)
    interval = expected.confidence_interval()
    assert found.p == pytest.approx(expected.pvalue)
    assert (found.difference.low, found.difference.high) == pytest.approx((interval.low, interval.high))
    assert compare([1.0, 2.0], [1.0, 2.0]).p == 1.0
    assert math.isnan(compare([1.0], [2.0]).p)
    with pytest.raises(ShapeError, match="as many seeds"):
        compare([1.0, 2.0], [1.0])


# --- results ----------------------------------------------------------------------------------------


def unit_rows(unit, values, source="ycb_mesh", goals=1000, **changes):
    """Rows as of a finished unit; `values` are percent at 0, 6, 10 and 30 minutes."""
    keys = {"key": f"{unit} {goals} {changes}", "settings": f"{unit.method}{unit.recipe}{goals}", **changes}
    base = records.Row(
        format=records.FORMAT, **asdict(unit), at=0.0, minutes=0.0, success=0.0, ci_low=0.0, ci_high=1.0, goals=goals,
        evaluation_seed=0, solver_failures=0, source=source, mass=0.05, settings="", code="c1", key="",
        versions="difflcs=1", machine="a machine", train_seconds=20.0, evaluation_seconds=10.0,
        finished="2026-01-01T00:00:00+00:00",
    )  # fmt: skip
    base = replace(base, **keys)
    points = zip((0.0, 6.0, 10.0, 30.0), values, strict=True)
    return [replace(base, at=at, minutes=at, success=value / 100) for at, value in points]


@pytest.fixture
def results(tmp_path):
    """Results of three seeds: violation-only peaks at 6 minutes with 40, 50, 60 %, LCS-RL ends with 70, 80, 90 %."""
    for seed in range(3):
        shift = 10 * seed
        for task in ("cube", "mug"):
            for unit, values in (
                (Unit(task, "violation", "ours", seed), (0, 40 + shift, 30 + shift, 10 + shift)),
                (Unit(task, "lcs-rl", "ours", seed), (0, 40 + shift, 50 + shift, 70 + shift)),
                (Unit(task, "violation", "paper", seed), (0, 20, 20, 20)),
            ):
                records.add(tmp_path, "paper", unit_rows(unit, values))
        transfer = Unit("mug", "ppo", "ours", seed, "cube")
        records.add(tmp_path, "paper", unit_rows(transfer, (30, 60, 70, 81 + shift)))
        records.add(tmp_path, "paper", unit_rows(Unit("cube", "pddm", "none", seed), (0, 1, 2, 3), goals=50))
    return tmp_path


def run_script(script, capsys, *arguments):
    code = script.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_table1_shows_ours_beside_the_paper(results, capsys):
    code, out, _ = run_script(table1, capsys, "--results", results)
    assert code == 0
    markdown, latex = ((results / f"table1.{suffix}").read_text() for suffix in ("md", "tex"))
    line = next(line for line in markdown.splitlines() if line.startswith("| mug"))
    assert line.split(" | ")[1:5] == ["50.0 ± 10.0", "32.5 ± 8.4", "80.0 ± 10.0", "44.6 ± 3.9"]  # peak
    assert line.split(" | ")[5:] == ["20.0 ± 10.0", "10.0 ± 6.3", "80.0 ± 10.0", "44.6 ± 3.9 |"]  # final
    assert "50.0 ± 10.0" in out
    assert "32.5 $\\pm$ 8.4" in latex
    assert "| mug | +30.0 [+30.0, +30.0] | < 0.001 | +60.0 [+60.0, +60.0] | < 0.001 |" in markdown
    assert "| banana | — | 28.4 ± 5.8 |" in markdown  # no results yet: the paper alone
    assert "Success on six objects, the paper's recipe" in markdown
    assert "3 seeds × 1000 goals" in markdown
    assert "12 trainings" not in markdown  # mug only: 9
    assert "9 trainings" in markdown


def test_learning_curves_are_drawn(results, capsys):
    code, out, _ = run_script(fig_learning_curves, capsys, "--results", results)
    assert code == 0
    assert "55 at 7 min, 30 at 30 min" in out
    assert "3.0 ± 0.0" in out  # PDDM
    assert "3 seeds × 50 goals" in out  # an unequal number of goals is said


def test_transfer_is_compared_at_equal_data(results, capsys):
    assert run_script(fig_transfer, capsys, "--results", results)[0] == 0
    line = next(line for line in (results / "fig_transfer.md").read_text().splitlines() if line.startswith("| mug"))
    cells = line.strip("| ").split(" | ")
    assert cells[1] == "30.0 ± 0.0"  # the cube's model without any data
    assert cells[2:6] == ["50.0 ± 10.0", "60.0 ± 0.0", "+10.0 [−14.8, +34.8]", "0.225"]  # 6 min
    assert cells[6:] == ["80.0 ± 10.0", "91.0 ± 10.0", "+11.0 [+11.0, +11.0]", "< 0.001"]  # final


def test_the_same_numbers_give_the_same_files(results, capsys):
    files = [results / f"fig_learning_curves.{suffix}" for suffix in ("png", "pdf", "md", "tex")]
    written = []
    for _ in range(2):
        assert run_script(fig_learning_curves, capsys, "--results", results)[0] == 0
        written.append([path.read_bytes() for path in files])
    assert written[0] == written[1]
    assert written[0][0].startswith(b"\x89PNG")
    assert written[0][1].startswith(b"%PDF")


def test_stand_ins_are_a_table_of_their_own(results, capsys):
    before = records.path_of(results, "paper").read_bytes()
    unit = Unit("banana", "lcs-rl", "ours", FIRST)
    path = records.add(results, "paper", unit_rows(unit, (1, 2, 3, 99), source="stand_in"))
    assert path.name == "paper-stand-in.csv"
    assert records.path_of(results, "paper").read_bytes() == before
    assert run_script(table1, capsys, "--results", results)[0] == 0
    assert "99.0" not in (results / "table1.md").read_text()
    assert "99.0" in (results / "table1-stand-in.md").read_text()
    assert "STAND-INS" in (results / "table1-stand-in.md").read_text()


def test_nothing_is_mixed_or_replaced_silently(results, capsys):
    unit = Unit("mug", "lcs-rl", "ours", 0)
    # Other numbers of goals stand beside each other; the larger amount is shown, and what is left out is said.
    records.add(results, "paper", unit_rows(unit, (0, 0, 0, 1), goals=300))
    cell = records.select(records.read(results / "paper.csv"), "mug", "lcs-rl", "ours")
    assert (cell.seeds, cell.left_out) == ((0, 1, 2), 1)
    assert cell.at(30.0) == {0: 70.0, 1: 80.0, 2: 90.0}
    assert run_script(table1, capsys, "--results", results)[0] == 0
    assert "1 trainings of other settings left out" in (results / "table1.md").read_text()
    # The same unit computed by other code replaces itself alone, and is not averaged with the others.
    records.add(results, "paper", unit_rows(unit, (0, 0, 0, 2), code="c2"))
    rows = records.read(results / "paper.csv")
    assert sum(row.unit == unit and row.goals == 1000 for row in rows) == 4
    assert records.select(rows, "mug", "lcs-rl", "ours").seeds == (1, 2)
    # Nor compared with what other code has computed.
    both = [records.select(rows, "mug", method, "ours") for method in ("lcs-rl", "violation")]
    assert report.paired(*both, "final").difference.n == 2

    def coded(cell, code):
        return replace(cell, rows=tuple(replace(row, code=code) for row in cell.rows))

    def compared(*codes):
        return report.paired(*(coded(cell, code) for cell, code in zip(both, codes, strict=True)), "final") is not None

    # What a method has of its own may differ between methods, but not what they have in common.
    assert compared("all.ppo.cpp", "all.warmup.cpp")
    assert not compared("all.ppo.cpp", "other.ppo.cpp")
    assert not compared("all.ppo.cpp", "all.ppo.other")


def test_records_round_trip(undisturbed, tmp_path):
    rows = records.rows_of(undisturbed[TRANSFER])
    path = records.add(tmp_path, "smoke", rows)
    assert records.read(path) == rows
    assert [row.at for row in rows] == [0.2, 0.5]
    assert rows[0].source == "stand_in"
    assert rows[0].unit == TRANSFER
    assert rows[-1].goals == TINY.goals
    assert rows[0].minutes >= rows[0].at


def test_readme_is_filled_between_its_marks_only(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text("before\n<!-- results: table1 -->\nold\n<!-- end -->\nafter\n")
    report.update_readme("table1", "new\n", readme)
    report.update_readme("table1-quick", "quick\n", readme)
    assert readme.read_text() == "before\n<!-- results: table1 -->\n\nnew\n\n<!-- end -->\nafter\n"
    readme.write_text("<!-- results: table1 -->\nold\n")
    with pytest.raises(records.ResultsError, match="put it back"):
        report.update_readme("table1", "new\n", readme)


def test_the_tracked_readme_and_tables_are_those_of_the_tracked_results(tmp_path, monkeypatch, capsys):
    names = {"table1": table1, "fig_learning_curves": fig_learning_curves, "fig_transfer": fig_transfer}
    text = (FOLDER / "README.md").read_text()
    for name in names:
        assert f"<!-- results: {name} -->" in text
    readme = tmp_path / "README.md"
    readme.write_text(text)
    for path in records.RESULTS.glob("paper*.csv"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(report, "README", readme)
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    for script in names.values():
        assert script.main(["--results", str(tmp_path), "--preset", "paper"]) in (0, 2)  # 2: no results of it yet
    assert readme.read_text() == text, "run the scripts of reproduce/ to bring README.md up to date"


# --- bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("script", "arguments", "message"),
    [
        (table1, ["--rerun", "--preset", "papers"], "preset: expected one of smoke, quick, paper, got 'papers'"),
        (table1, ["--preset", "papers"], "preset: expected one of"),
        (table1, ["--rerun", "--objects", "teapot"], "objects: expected some of sugar_box"),
        (runs, ["--methods", "sac"], "methods: expected some of lcs-rl"),
        (runs, ["--artefacts", "table2"], "artefacts: expected some of table1"),
        (runs, ["--artefacts", "transfer", "--methods", "pddm"], "units: expected at least one"),
        (runs, ["--seeds", "0"], "seeds: expected at least 1"),
        (runs, ["--workers", "0"], "workers: expected at least 1"),
        (runs, ["--dask", "remote"], "dask: expected local:N"),
        (runs, ["--dask", "local:x"], "dask: expected local:N"),
        (runs, ["--dask", "local:1", "--scheduler", "tcp://x:1"], "got both"),
        (runs, ["--scheduler", "somewhere"], "scheduler: expected an address"),
        (runs, ["--scheduler", "tcp://127.0.0.1:9"], "expected a Dask scheduler at tcp://127.0.0.1:9"),
        (table1, [], "compute them with: python reproduce/table1.py --rerun --preset quick"),
        (fig_transfer, ["--preset", "paper"], "reproduce/fig_transfer.py --rerun --preset paper"),
        (fig_task, [], "reproduce/fig_task.py --rerun"),
        (fig_task, ["--run", "nowhere"], "nowhere"),
    ],
)
def test_bad_input(script, arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pools, "_CONNECT_SECONDS", 0.5)
    folder = tmp_path / "results"
    code, _, err = run_script(script, capsys, *arguments, "--results", folder, "--work", tmp_path / "work")
    assert code == 2
    assert message in err
    assert not folder.exists()  # nothing written


@pytest.mark.parametrize("content", ["", "format,other\n1,2\n", "FORMAT"])
def test_results_of_another_version_stay_as_they_are(content, results, capsys):
    path = results / "paper.csv"
    if content == "FORMAT":
        content = path.read_text().replace("\n2,", "\n3,")
    path.write_text(content)
    unit = Unit("mug", "lcs-rl", "ours", FIRST)
    for script, arguments in ((table1, []), (runs, ["--preset", "paper"])):
        code, _, err = run_script(script, capsys, *arguments, "--results", results, "--work", results / "work")
        assert code == 2
        assert "paper.csv: expected results of format 2" in err
    with pytest.raises(records.ResultsError, match="Nothing was changed"):
        records.add(results, "paper", unit_rows(unit, (1, 2, 3, 4)))
    assert path.read_text() == content
    assert not (results / "table1.md").exists()


def test_errors_are_ours():
    for kind in (records.ResultsError, pools.SchedulerError, worker.UnitError):
        assert issubclass(kind, DiffLCSError)
    with pytest.raises(InvalidInputError):
        units.get_preset("large")


def test_the_paper_is_complete():
    assert set(TABLE1) == set(OBJECTS)
    assert TABLE1["wrench"]["lcs-rl", "final"] == (59.5, 6.6)
    assert all(len(cells) == 4 for cells in TABLE1.values())


# --- the task's figure ------------------------------------------------------------------------------


def test_the_task_is_drawn(undisturbed, tmp_path, capsys):
    from difflcs_envs import RenderingError

    record = undisturbed[CUBE]
    folder = tmp_path / "work" / record["key"]
    worker.write_json(folder / "record.json", record)
    try:
        from difflcs_envs.trifinger.rendering import _make_gl_context

        _make_gl_context(64, 64).free()
    except RenderingError as error:
        pytest.skip(f"needs OpenGL: {error}")
    code, out, err = run_script(fig_task, capsys, "--results", tmp_path, "--work", tmp_path / "work")
    assert code == 0, err
    assert f"model: cube lcs-rl, seed {FIRST}" in out
    assert (tmp_path / "fig_task.png").stat().st_size > 50_000
