"""`difflcs doctor` tells the truth, and never fails itself."""

import json
import re
from importlib import metadata
from unittest.mock import Mock

import pytest

from difflcs import available_backends, cli
from difflcs.cli import doctor
from tests.conftest import python

OPTIONAL = (
    "gymnasium", "mujoco", "torchrl", "tensordict", "tensorboard", "tqdm", "tyro", "cvxpy", "cvxpylayers", "trimesh",
    "coacd", "matplotlib", "imageio", "imageio_ffmpeg", "PIL", "rich", "scipy", "packaging",
)  # fmt: skip


@pytest.fixture(scope="module")
def checks():
    return doctor.examine()


def by_name(checks):
    return {check.name: check for check in checks}


@pytest.fixture
def versions(monkeypatch):
    """Other versions of packages than those installed; None is missing."""
    found, changed = metadata.version, {}

    def version(package):
        if changed.get(package, "") is None:
            raise metadata.PackageNotFoundError(package)
        return changed.get(package) or found(package)

    monkeypatch.setattr(metadata, "version", version)
    return changed


def test_this_machine(checks):
    found = by_name(checks)
    assert doctor.healthy(checks)
    assert re.search(r"instruction set (baseline|avx2|avx512) ", found["kernels"].text)
    assert all(found[name].status == "ok" for name in ("packages", "kernels", "files", "zoo", "batched", "ipopt"))
    assert set(available_backends()) <= set(found)
    assert {check.status for check in checks} <= {"ok", "missing", "failed"}
    assert all(check.text for check in checks)
    assert all(check.remedy for check in checks if check.status == "missing")
    assert 0 < float(re.findall(r"([\d.]+) ms", found["batched"].text)[0]) < 60_000
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
def test_a_broken_core_is_exit_code_1(capsys, monkeypatch, versions, error):
    versions.update(mujoco=None)  # the environments are not tried
    monkeypatch.setattr(doctor, "solve_lcp", Mock(side_effect=error))
    monkeypatch.setenv("COLUMNS", "68")  # where the remedy would break at a hyphen
    assert cli.main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert "!!  kernels" in text
    assert "does NOT work" in text
    assert str(error) in text
    assert isinstance(error, RuntimeError) or "--force-reinstall" in text


def test_missing_extras_are_no_failure_and_say_what_to_install(versions):
    versions.update(dict.fromkeys(("torchrl", "gymnasium", "mujoco", "imageio-ffmpeg")))
    found = by_name(doctor.examine(("extras", "environments")))
    for name, extra in (("rl", "rl"), ("simulation", "envs"), ("pictures", "envs"), ("video", "viz")):
        assert (found[name].status, found[name].remedy) == ("missing", f'pip install "difflcs[{extra}]"')
    assert "torchrl" in found["rl"].text
    assert doctor.healthy(list(found.values()))


@pytest.mark.parametrize(("version", "status"), [("0.1.5", "missing"), ("0.13.0+cpu", "ok")])
def test_a_package_that_is_too_old_is_named(versions, version, status):
    """By numbers, not by letters: 0.13 is newer than 0.9."""
    versions.update(torchrl=version)
    check = by_name(doctor.examine(["extras"]))["rl"]
    assert check.status == status
    assert bool(re.search(r"torchrl >= 0\.9 \(found 0\.1\.5\)", check.text)) == (status == "missing")


@pytest.mark.parametrize(
    ("lacking", "chosen", "status", "words"),
    [
        ((), True, "ok", "all 8 in DIFFLCS_YCB_DIR={}"),
        (("clamp",), False, "missing", "stand-ins for clamp"),
        (("clamp",), True, "missing", "DIFFLCS_YCB_DIR={} lacks clamp"),
    ],
)
def test_meshes(tmp_path, monkeypatch, lacking, chosen, status, words):
    """In the folder that the user has chosen, or where downloads go."""
    from difflcs_envs import ycb

    folder = tmp_path if chosen else tmp_path / "ycb"
    for name in set(ycb.YCB) - set(lacking):
        mesh = folder / ycb.YCB[name].code / "google_16k" / "nontextured.stl"
        mesh.parent.mkdir(parents=True)
        mesh.touch()
    monkeypatch.setenv("DIFFLCS_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("DIFFLCS_YCB_DIR", raising=False)
    if chosen:
        monkeypatch.setenv("DIFFLCS_YCB_DIR", str(folder))
    monkeypatch.setattr(doctor, "_PICTURE", "print('{}')")  # takes seconds, and says nothing of meshes
    check = by_name(doctor.examine(["environments"]))["YCB meshes"]
    assert check.status == status
    assert words.format(folder) in check.text
    assert ("difflcs assets download clamp" in check.remedy) == (status == "missing")


@pytest.mark.parametrize("code", ["import os; os.abort()", "import time; time.sleep(60)"])
def test_a_crash_or_a_hang_in_the_other_process_is_reported(tmp_path, monkeypatch, code):
    (tmp_path / "gymnasium.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(doctor, "TIMEOUT", 0.5 if "sleep" in code else 60.0)
    said = "no answer within 0.5 s" if "sleep" in code else "the process ended with code -6"
    found = by_name(doctor.examine(["environments"]))
    for name in ("simulation", "pictures"):
        assert (found[name].status, found[name].text) == ("failed", said)


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
from importlib import metadata
def version(package):
    raise metadata.PackageNotFoundError(package)
metadata.version = version
from difflcs import __main__
assert __main__.main(["train"]) == 2
sys.exit(__main__.main(["doctor", "--json"]))
"""
    done = python("-c", code)
    assert done.stderr.count("difflcs: ") == 1
    assert "expected the package(s) gymnasium, not installed; run: pip install" in done.stderr  # of `difflcs train`
    every = json.loads(done.stdout)["checks"]
    found = {check["name"]: check for check in every if check["group"] == "solvers"}
    assert found["ipopt"]["status"] == "ok"
    assert found["relaxed"]["status"] == "missing"
    assert "pip install" in found["relaxed"]["remedy"]
    assert {check["status"] for check in every if check["group"] in ("extras", "environments")} == {"missing"}
