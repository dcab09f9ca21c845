"""Backend `ipopt`: worker processes, threads, forks and crashes; and the registry of the backends."""

import os
import signal
import subprocess
import tempfile
import textwrap
from dataclasses import dataclass

import pytest
import torch

from difflcs import BackendNotFoundError, LCSMPCLayer, available_backends, register_backend
from difflcs.cli.bench import pushing_model, states_and_goals
from difflcs.errors import DTypeError
from difflcs.mpc import kkt
from difflcs.mpc.backends import Backend, IpoptBackend, ipopt
from difflcs.systems import pushing_cost
from tests.conformance.varied.generators import random_case
from tests.conftest import python, refuse


@pytest.fixture
def x0(build):
    return 0.2 * build.normal(5)(9, 4)


def make_layer(build, **options):
    options = {"backend": IpoptBackend(workers=2), "relaxation": 1e-4, **options}
    return LCSMPCLayer(build.params(3), build.cost(3), 3, -0.15, 0.15, **options)


def test_prices_and_limits_need_not_have_the_same_stages():
    problem = random_case(2, 2).problem()
    assert problem.price.ndim != problem.g.ndim
    result = IpoptBackend(workers=1).solve(problem, None)
    residual = kkt.residual(problem, result.primal, kkt.multipliers(problem, result.primal))
    assert bool(torch.isfinite(residual[result.solved]).all())


# --- worker processes -----------------------------------------------------------------------------------------------


def test_workers_give_the_bits_of_this_process(build, x0):
    alone, two, three = (make_layer(build, backend=IpoptBackend(workers=w))(x0) for w in (1, 2, 3))
    for name in ("x", "u", "lam", "status", "iterations"):
        assert torch.equal(getattr(alone, name), getattr(two, name))
        assert torch.equal(getattr(alone, name), getattr(three, name))


def test_workers_stay_between_calls_and_are_replaced_when_they_are_killed(build, x0):
    layer = make_layer(build)
    expected, old = layer(x0), ipopt.worker_pids()
    layer(x0)
    assert ipopt.worker_pids() == old
    assert len(old) >= 2
    for pid in old[:2]:
        os.kill(pid, signal.SIGKILL)
        os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)  # until it is dead; the backend buries it
    again = layer(x0)
    assert torch.equal(again.u, expected.u)
    assert bool(again.converged.all())
    assert not set(old[:2]) & set(ipopt.worker_pids())


def test_a_worker_that_dies_during_a_solve_costs_no_result(build, x0):
    """Stopped workers hold their tasks; killing them then makes the parent give the tasks to new ones."""
    layer = make_layer(build)
    expected = layer(x0)
    stopped = ipopt.worker_pids()[0]
    os.kill(stopped, signal.SIGSTOP)
    killer = subprocess.Popen(["sh", "-c", f"sleep 0.3; kill -KILL {stopped}"])
    again = layer(x0)
    killer.wait()
    assert torch.equal(again.u, expected.u)


def run_script(code, timeout=90):
    """What a script prints. A fresh process: a crash or a deadlock there is a failed test, not a lost test run."""
    head = """
        import warnings; warnings.simplefilter("error")
        import torch
        from difflcs import LCSMPCLayer, LCSModel, QuadraticCost
        from difflcs.mpc.backends import IpoptBackend
        torch.manual_seed(0)
        model = LCSModel(3, 2, 2, init_scale=0.4)
        eye = torch.eye(3).double()
        def layer(workers):
            return LCSMPCLayer(model, QuadraticCost(eye, torch.eye(2).double(), 3 * eye), 3, -0.1, 0.1,
                               backend=IpoptBackend(workers=workers), relaxation=1e-4)
        x0 = torch.randn(6, 3).double()
    """
    with tempfile.NamedTemporaryFile("w", suffix=".py") as script:
        script.write(textwrap.dedent(head) + textwrap.dedent(code))
        script.flush()
        return python(script.name, timeout=timeout).stdout.split()


@pytest.mark.slow
def test_several_threads_may_solve_at_once():
    """IPOPT in threads of one process crashes (casadi issue 3456); the backend must keep them apart."""
    assert run_script("""
        from concurrent.futures import ThreadPoolExecutor
        for workers in (1, 2):
            mpc = layer(workers)
            expected = [mpc(x).u.detach() for x in x0]
            batch = mpc(x0).u.detach()
            def work(i):
                x = x0[i % 6].clone().requires_grad_()
                alone = mpc(x)
                alone.u.sum().backward()
                assert torch.equal(alone.u.detach(), expected[i % 6]), i
                assert bool(torch.isfinite(x.grad).all())
                assert bool(alone.converged.all())
                if i % 3 == 0:
                    assert torch.equal(mpc(x0).u.detach(), batch)
            with ThreadPoolExecutor(6) as pool:
                list(pool.map(work, range(18)))
        print("fine")
    """) == ["fine"]


@pytest.mark.slow
def test_a_forked_child_starts_its_own_workers_and_none_runs_the_script_again_or_outlives_it():
    """A script without a main guard: workers do not import it."""
    started, *pids = run_script("""
        import os
        from difflcs.mpc.backends.ipopt import worker_pids
        print("started", flush=True)
        torch.set_num_threads(1)  # torch's own linear algebra hangs in a forked child otherwise
        mpc = layer(2)
        expected = mpc(x0).u.detach()
        pid = os.fork()
        if pid == 0:
            same = torch.equal(mpc(x0).u.detach(), expected)
            os._exit(0 if same else 3)
        assert torch.equal(mpc(x0).u.detach(), expected)
        _, status = os.waitpid(pid, 0)
        assert os.waitstatus_to_exitcode(status) == 0, status
        assert torch.equal(mpc(x0).u.detach(), expected)  # the child took nothing with it
        print(*worker_pids())
    """)
    assert started == "started"
    assert len(pids) == 2
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid), 0)


# --- options --------------------------------------------------------------------------------------------------------


def test_the_better_of_two_starts_is_kept():
    costs = []
    for options in ({}, {"second_start": None}, {"second_start": None, "start": 1.0, "mu_init": 0.1}):
        layer = LCSMPCLayer(pushing_model(8, 1), pushing_cost(), 5, -0.015, 0.015, IpoptBackend(workers=1, **options))
        costs.append(layer(*states_and_goals(8, 1)).objective)
    assert float((costs[1] - costs[2]).abs().max()) > 1e-3
    torch.testing.assert_close(costs[0], torch.minimum(costs[1], costs[2]))


# --- registry -------------------------------------------------------------------------------------------------------


def test_a_backend_whose_package_is_missing_gives_the_pip_line(build):
    @dataclass(frozen=True)
    class Absent(Backend):
        name = "absent"
        install = "pip install 'mine[solver]'"
        requires = ("torch", "no_such_package_for_difflcs")

        def solve(self, problem, guess):
            raise AssertionError

    register_backend(Absent)
    assert "absent" not in available_backends()
    said = r"'absent'.*'no_such_package_for_difflcs' is not.*pip install 'mine\[solver\]'"
    for backend in ("absent", Absent()):
        refuse(BackendNotFoundError, said, make_layer, build, backend=backend)


@pytest.mark.parametrize("backend", [None, 3, IpoptBackend])
def test_something_that_is_no_backend_is_refused(build, backend):
    refuse(DTypeError, "backend: expected a name or a Backend instance", make_layer, build, backend=backend)


@pytest.mark.parametrize("wrong", [int, "ipopt", IpoptBackend(), type("Nameless", (Backend,), {})])
def test_only_backend_classes_with_a_name_are_registered(wrong):
    before = available_backends()
    refuse(DTypeError, "subclass of Backend with a `name`", register_backend, wrong)
    assert available_backends() == before
