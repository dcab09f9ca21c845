"""`difflcs doctor` tells the truth, and never fails itself."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from difflcs import available_backends, cli, doctor
from difflcs._native import _kernels

OPTIONAL = (
    "gymnasium", "mujoco", "torchrl", "tensordict", "tensorboard", "tqdm", "tyro", "cvxpy", "cvxpylayers", "trimesh",
    "coacd", "matplotlib", "imageio", "imageio_ffmpeg", "PIL", "rich", "scipy", "packaging",
)  # fmt: skip


@pytest.fixture(scope="module")
def checks():
    return doctor.examine()


def by_name(checks):
    return {check.name: check for check in checks}


def test_this_machine(checks):
    found = by_name(checks)
    assert doctor.healthy(checks)
    assert _kernels.isa() in found["kernels"].text
    assert all(found[name].status == "ok" for name in ("packages", "kernels", "files", "zoo", "batched", "ipopt"))
    assert set(available_backends()) <= set(found)
    assert {check.status for check in checks} <= {"ok", "missing", "failed"}
    assert all(check.text for check in checks)
    assert all(check.remedy for check in checks if check.status == "missing")


def test_the_environments_are_tried(checks):
    pytest.importorskip("mujoco")
    found = by_name(checks)
    assert found["simulation"].status == "ok"
    assert found["YCB meshes"].status in ("ok", "missing")
    assert found["pictures"].status == "ok" or "OpenGL" in found["pictures"].text


def test_text_and_json(checks, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "examine", lambda: checks)
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "The library works" in text
    assert all(check.name in text for check in checks)
    assert max(len(line) for line in text.splitlines()) <= 110  # only one long word may stand out
    assert cli.main(["doctor", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["ok"] is True
    assert [check["name"] for check in record["checks"]] == [check.name for check in checks]


@pytest.mark.parametrize("error", [RuntimeError("no such instruction set"), ImportError("libc"), ValueError()])
def test_a_broken_core_is_exit_code_1(capsys, monkeypatch, error):
    def fail():
        raise error

    monkeypatch.setitem(doctor._LIBRARY, "kernels", fail)
    monkeypatch.setattr(doctor, "_environments", list)
    assert cli.main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert "!!  kernels" in text
    assert "does NOT work" in text
    assert str(error) in text


def test_missing_extras_are_no_failure_and_say_what_to_install(monkeypatch):
    monkeypatch.setattr(doctor, "_version", lambda _: None)
    found = by_name([doctor._check("extras", "rl", lambda: doctor._extra("rl")), *doctor._environments()])
    for name, extra in (("rl", "rl"), ("simulation", "envs"), ("pictures", "envs"), ("video", "viz")):
        assert (found[name].status, found[name].remedy) == ("missing", f'pip install "difflcs[{extra}]"')
    assert "torchrl" in found["rl"].text
    assert doctor.healthy(list(found.values()))


def test_a_package_that_is_too_old_is_named(monkeypatch):
    monkeypatch.setattr(doctor, "_version", lambda package: "0.1.5")
    with pytest.raises(doctor._MissingError, match=r"torchrl >= [\d.]+ \(found 0\.1\.5\)"):
        doctor._extra("rl")
    assert doctor._release("2.13.0+cpu") > doctor._release("2.4")


@pytest.mark.parametrize(
    ("state", "status", "words"),
    [
        ({"mug": True, "clamp": True}, "ok", "all 2"),
        ({"mug": True, "clamp": False}, "missing", "stand-ins for clamp"),
        ({"mug": True, "clamp": None}, "missing", "lacks clamp"),
    ],
)
def test_meshes(state, status, words):
    check = doctor._check("environments", "YCB meshes", lambda: doctor._meshes(state, "FOLDER"))
    assert check.status == status
    assert words in check.text
    assert ("difflcs assets download clamp" in check.remedy) == (status == "missing")


def test_a_crash_or_a_hang_in_the_other_process_is_reported(monkeypatch):
    pytest.importorskip("mujoco")
    crash = doctor._check("environments", "pictures", lambda: str(doctor._in_process("import os; os.abort()")))
    assert crash.status == "failed"
    monkeypatch.setattr(doctor, "_TIMEOUT", 0.2)
    hang = doctor._check("environments", "pictures", lambda: str(doctor._in_process("import time; time.sleep(60)")))
    assert (hang.status, hang.text) == ("failed", "no answer within 0.2 s")


def test_it_works_with_nothing_but_the_hard_dependencies():
    """Without tyro, too: `difflcs doctor` is what one calls to learn that it is missing."""
    code = f"""
import importlib.machinery, sys
find = importlib.machinery.PathFinder.find_spec
hidden = {OPTIONAL!r}
class Finder:
    find_distributions = importlib.machinery.PathFinder.find_distributions
    @staticmethod
    def find_spec(name, path=None, target=None):
        return None if name.partition(".")[0] in hidden else find(name, path, target)
sys.meta_path[:] = [Finder if f is importlib.machinery.PathFinder else f for f in sys.meta_path]
from difflcs import doctor, __main__
doctor._version = lambda package: None
assert __main__.main(["train"]) == 2
sys.exit(__main__.main(["doctor", "--json"]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr.count("error:") == 1
    assert "expected the package(s) gymnasium, not installed; run: pip install" in done.stderr  # of `difflcs train`
    every = json.loads(done.stdout)["checks"]
    found = {check["name"]: check for check in every if check["group"] == "solvers"}
    assert found["ipopt"]["status"] == "ok"
    assert found["relaxed"]["status"] == "missing"
    assert "pip install" in found["relaxed"]["remedy"]
    assert {check["status"] for check in every if check["group"] in ("extras", "environments")} == {"missing"}
