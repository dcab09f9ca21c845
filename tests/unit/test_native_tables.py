"""The tables that Python and the kernels share: fields of a problem, and how a solve can end."""

from __future__ import annotations

import dataclasses
import importlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import difflcs
from difflcs import LCSMPCLayer, LinearConstraints, QuadraticCost, Status
from difflcs._native import _kernels
from difflcs.lcs import SYSTEM, LCSParams, dimensions
from difflcs.mpc.problem import INPUTS, MPCProblem
from difflcs.status import solved
from tests.problems import Kind, random_problem

SOURCE = Path(difflcs.__file__).parent


def test_the_fields_of_a_problem_are_those_of_the_kernels_in_their_order():
    assert list(INPUTS.items()) == list(_kernels.mpc_fields().items())
    assert list(INPUTS) == [f.name for f in dataclasses.fields(MPCProblem)][: len(INPUTS)]
    assert dimensions(MPCProblem) == INPUTS


@pytest.mark.slow
def test_the_kernels_of_another_version_are_refused(monkeypatch):
    problem = importlib.import_module("difflcs.mpc.problem")
    fields = {name: dims for name, dims in INPUTS.items() if name != "q_final"}
    script = (
        "from difflcs._native import _kernels\n"
        f"_kernels.mpc_fields = lambda: {fields!r}\n"
        "import importlib.util, sys\n"
        f"spec = importlib.util.spec_from_file_location('again', {problem.__file__!r})\n"
        "module = importlib.util.module_from_spec(spec)\n"
        "sys.modules['again'] = module\n"
        "spec.loader.exec_module(module)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "other fields of the MPC problem" in done.stderr
    assert "pip install -e ." in done.stderr


def test_the_system_is_the_same_everywhere():
    assert list(SYSTEM) == [f.name for f in dataclasses.fields(LCSParams)]
    assert list(INPUTS.items())[: len(SYSTEM)] == list(SYSTEM.items())
    violation = list(_kernels.violation_fields().items())
    assert violation[: len(SYSTEM)] == list(SYSTEM.items())
    assert violation[len(SYSTEM) :] == [("x", ("n_x",)), ("u", ("n_u",)), ("x_next", ("n_x",)), ("gamma", ())]


def test_a_layer_finds_every_field_in_its_system_cost_and_bounds(build):
    lcs = build.pushing(0, 5)
    eye = torch.eye(9, dtype=torch.float64)
    cost = QuadraticCost(eye, eye[:6, :6], eye)
    rows = LinearConstraints(eye[:2], eye[:2, 0], E=eye[:2, :6])
    problem = LCSMPCLayer(lcs, cost, 2, -1.0, 1.0, constraints=rows)(torch.zeros(9, dtype=torch.float64)).problem
    found = {**lcs.tensors(), **cost.fields()}
    limits = {"u_min", "u_max", "G_x", "G_u", "g", "price", "x0"}
    assert {*found, *limits, "S"} == set(INPUTS)
    sizes = {"n_x": 9, "n_u": 6, "n_lam": 5, "n_c": 2}
    for name in INPUTS:
        value = getattr(problem, name) if name != "x0" else problem.x0[0]
        assert tuple(value.shape) == tuple(sizes[dim] for dim in INPUTS[name]), name


@pytest.mark.parametrize("name", INPUTS)
def test_the_kernels_name_the_field_that_does_not_fit(name):
    problem = random_problem(0, Kind(horizon=2, batch=1, rows=2))
    arrays = {k: getattr(problem, k).numpy() for k in INPUTS}
    arrays[name] = np.concatenate([arrays[name], arrays[name]])
    sizes = {"x": (1, 3, 4), "u": (1, 2, 2), "lam": (1, 2, 3)}
    solution = {k: np.zeros(size) for k, size in {**sizes, "mu": (1, 3, 2)}.items()}
    upstream = {f"{k}_bar": np.zeros(size) for k, size in sizes.items()}
    with pytest.raises(ValueError, match=r"wrong (shape|size)|inconsistent"):
        _kernels.vjp_mpc(
            inputs=list(arrays.values()),
            horizon=2,
            relaxation=1e-5,
            barrier=0.0,
            **solution,
            **upstream,
            objective_bar=np.zeros(1),
            solved=np.ones(1, np.int8),
            pivot=False,
            threads=1,
            gradients=[np.zeros_like(v) for v in arrays.values()],
        )


def test_the_parameters_of_ipopt_are_the_fields_and_the_two_numbers(build):
    ipopt = pytest.importorskip("difflcs.mpc.backends.ipopt")
    eye = torch.eye(9, dtype=torch.float64)
    mpc = LCSMPCLayer(build.pushing(0, 5), QuadraticCost(eye, eye[:6, :6], eye), 2, -1.0, 1.0)
    problem = mpc(torch.zeros(1, 9, dtype=torch.float64)).problem
    table = ipopt.parameters(problem)
    assert [name for name, *_ in table] == [*INPUTS, "relaxation", "barrier"]
    sizes = {name: size for name, *size in table}
    assert sizes["E"] == [5, 6, 1]
    assert sizes["g"] == [0, 1, 1]
    by_stage = {"E": problem.E.expand(1, 2, 5, 6), "g": torch.ones(1, 3, 4).double(), "G_x": torch.ones(4, 9).double()}
    by_stage |= {"G_u": torch.ones(4, 6).double(), "price": torch.ones(1, 4).double()}
    sizes = {name: size for name, *size in ipopt.parameters(dataclasses.replace(problem, **by_stage))}
    assert (sizes["E"], sizes["G_x"], sizes["g"], sizes["price"]) == ([5, 6, 2], [4, 9, 1], [4, 1, 3], [4, 1, 1])


def test_the_codes_are_those_of_the_kernels():
    assert {s.name: int(s) for s in Status} == _kernels.status_codes()
    assert all(s.advice for s in Status)


def test_what_is_solved_is_said_once():
    codes = torch.tensor([int(s) for s in Status], dtype=torch.int8)
    assert solved(codes).tolist() == [s.solved for s in Status]


def test_no_other_file_gives_codes_their_numbers():
    number = re.compile(r"\b(CONVERGED|MAX_ITER|INFEASIBLE|NUMERICAL|DEGENERATE|converged|infeasible)\b\s*[=:]\s*\d")
    for path in [*SOURCE.rglob("*.py"), *(Path(__file__).parents[2] / "difflcs" / "_native").glob("*.?pp")]:
        for line in path.read_text().splitlines():
            assert not number.search(line), f"{path.name}: {line}"
