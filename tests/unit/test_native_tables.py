"""The tables that Python and the kernels share: fields of a problem, and how a solve can end."""

import dataclasses
import re
import runpy
from pathlib import Path

import pytest

import difflcs
from difflcs import Status
from difflcs._native import _kernels
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.records import SYSTEM, LCSParams, dimensions

SOURCE = Path(difflcs.__file__).parent


def test_the_fields_of_a_problem_are_those_of_the_kernels_in_their_order():
    assert list(INPUTS.items()) == list(_kernels.mpc_fields().items())
    assert list(INPUTS) == [f.name for f in dataclasses.fields(MPCProblem)][: len(INPUTS)]
    assert dimensions(MPCProblem) == INPUTS


def test_the_kernels_of_another_version_are_refused(monkeypatch):
    fields = {name: dims for name, dims in INPUTS.items() if name != "q_final"}
    monkeypatch.setattr(_kernels, "mpc_fields", lambda: fields)
    with pytest.raises(ImportError, match=r"(?s)other fields of the MPC problem.*pip install -e \."):
        runpy.run_path(str(SOURCE / "mpc" / "problem.py"))


def test_the_system_is_the_same_everywhere():
    assert list(SYSTEM) == [f.name for f in dataclasses.fields(LCSParams)]
    assert list(INPUTS.items())[: len(SYSTEM)] == list(SYSTEM.items())
    violation = list(_kernels.violation_fields().items())
    assert violation[: len(SYSTEM)] == list(SYSTEM.items())
    assert violation[len(SYSTEM) :] == [("x", ("n_x",)), ("u", ("n_u",)), ("x_next", ("n_x",)), ("gamma", ())]


def test_the_codes_are_those_of_the_kernels():
    assert {s.name: int(s) for s in Status} == _kernels.status_codes()
    assert all(s.advice for s in Status)


def test_codes_and_tolerances_of_the_kernels_have_their_numbers_in_no_other_file():
    code = re.compile(r"\b(CONVERGED|MAX_ITER|INFEASIBLE|NUMERICAL|DEGENERATE|converged|infeasible)\b\s*[=:]\s*\d")
    tolerance = re.compile(rf"^_?({'|'.join(name.upper() for name in _kernels.tolerances())}) = [\d.]", re.MULTILINE)
    for path in (path for kind in ("py", "cpp", "hpp") for path in SOURCE.rglob(f"*.{kind}")):
        assert not code.search(path.read_text()), path.name
    for path in [*SOURCE.glob("*.py"), *(SOURCE / "mpc").rglob("*.py")]:
        assert not tolerance.search(path.read_text()), path.name
