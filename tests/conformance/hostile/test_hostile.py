"""The quick tier of the campaign: every class over every target, nothing wrong in silence, and not by refusing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from difflcs.mpc.backends import BatchedBackend
from tests.conformance.hostile import campaign, checks, targets
from tests.conformance.varied.generators import random_case

SLOW_CLASSES = ("mpc-plain", "mpc-flat", "mpc-stiff")  # for the solvers that take 10 ms and more per problem
CELLS = [c for c in campaign.CELLS if c.target not in targets.SLOW_TARGETS or c.problems in SLOW_CLASSES]
HARD_CLASSES = ("mpc-skew-1e-8", "mpc-unstable", "mpc-extreme")  # most time is spent where most is refused
PARAMETERS = [
    pytest.param(
        c, id=c.name, marks=[pytest.mark.slow] * (c.target in targets.SLOW_TARGETS or c.problems in HARD_CLASSES)
    )
    for c in CELLS
]

# Least share of solved elements in the quick tier, so that refusing everything does not pass.
FLOORS = {
    "lcp-plain": 1.0,
    "lcp-skew-1e-2": 0.99,
    "lcp-skew-1e-4": 0.99,
    "lcp-skew-1e-6": 0.97,
    "lcp-skew-1e-8": 0.5,
    "lcp-nearly-singular": 0.98,
    "lcp-graded": 0.98,
    "lcp-degenerate": 0.98,
    "lcp-p-matrix": 0.98,
    "lcp-large": 1.0,
    "mpc-plain": 0.85,
    "mpc-flat": 0.95,
    "mpc-flat-tiny": 0.85,
    "mpc-flat-contact": 0.85,
    "mpc-no-effect": 0.9,
    "mpc-number-bounds": 0.95,
    "mpc-units": 0.85,
    "mpc-cost-scale": 0.9,
    "mpc-stuck": 0.95,
    "loss-plain": 1.0,
    "loss-at-bound": 1.0,
    "loss-scales": 1.0,
    "loss-tiny-gamma": 1.0,
    "form-plain": 0.7,
    "form-no-contact": 0.9,
    "form-prices": 0.6,
    "form-vertex": 0.7,
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("cell", PARAMETERS)
def test_nothing_is_wrong_in_silence(cell):
    # Most of these are refused, after three tries: half a second for each of the last ones.
    sizes = {"mpc-skew": 32, "mpc-unstable": 48, "form-zero-rows": 5}
    most = next((size for kind, size in sizes.items() if cell.problems.startswith(kind)), cell.size)
    cell = replace(cell, size=min(cell.size, most))
    record = campaign.run_chunk(cell, seed=0, number=0)
    assert record.silent == 0, f"{record.by_check}, reproduce: {campaign.reproduction(record)}"
    floor = FLOORS.get(cell.problems, 0.0)
    assert record.solved_share >= floor, f"{record.flagged} of {record.tried} refused"


@pytest.mark.parametrize(("problems", "chunks"), [("form-plain", 24), ("form-no-contact", 12)])
def test_every_form_and_size_is_solved(problems, chunks):
    """Each chunk has sizes and a form of its own: four elements of many rather than many of one."""
    cell, total = replace(next(c for c in campaign.CELLS if c.name == f"{problems}/batched"), size=4), None
    for number in range(chunks):
        record = campaign.run_chunk(cell, seed=1, number=number, gradients=False)
        assert record.silent == 0, f"{record.by_check}, chunk {number}"
        total = record if total is None else total.add(record) or total
    assert total.solved_share >= 0.75  # of the others some cannot be solved


def test_elements_whose_sweep_must_exchange_rows_change_no_gradient_of_others(monkeypatch):
    """At a nearly skew F the sweep of the gradients is done a second time, of these elements alone."""
    problem, rng = next(c for c in campaign.CELLS if c.name == "mpc-plain/batched").chunk(0, 0)
    F, bad = problem.inputs["F"].copy(), np.arange(problem.count) % 2 == 0
    K = rng.standard_normal(F.shape)
    F[bad] = (K - K.swapaxes(-1, -2) + 1e-10 * np.eye(F.shape[-1]))[bad]
    problem, fragile, vjp = replace(problem, inputs=problem.inputs | {"F": F}), [], BatchedBackend.vjp

    def spied(self, problem, result, grads, solved):
        fragile.append(result.fragile & solved)
        return vjp(self, problem, result, grads, solved)

    def gradients(problem):
        leaves = targets.leaves_of(problem)
        with targets.quiet():
            plan = targets.layer_of(problem, leaves)(leaves["x0"])
            (plan.x.sum() + plan.u.sum()).backward()
        return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}

    monkeypatch.setattr(BatchedBackend, "vjp", spied)
    together = gradients(problem)
    assert fragile[0].sum() > 4
    assert together["x0"][fragile[0]].any(-1).all()
    for part in (bad, ~bad):
        for name, gradient in gradients(problem.select(part)).items():
            assert torch.equal(gradient, together[name][torch.from_numpy(part)]), name
            assert gradient.isfinite().all()


def test_the_judges_see_a_wrong_answer():
    """Each condition, broken by hand, is seen: a judge that accepts everything proves nothing."""
    cell = next(c for c in campaign.CELLS if c.name == "mpc-cost-scale/batched")
    problem, _ = cell.chunk(1, 0)
    problem = problem.select(slice(0, 4))
    leaves = targets.leaves_of(problem)
    with targets.quiet():
        plan = targets.layer_of(problem, leaves)(leaves["x0"])
    x, u, lam, objective = (v.detach().numpy() for v in (plan.x, plan.u, plan.lam, plan.objective))

    def broken(**changes) -> set[str]:
        numbers = {"x": x, "u": u, "lam": lam, "objective": objective} | changes
        ratios = checks.judge_mpc(problem, **numbers)
        return {name for name, ratio in ratios.items() if ratio[0] > 1}

    assert broken() <= {"stationarity"}
    assert "start" in broken(x=x + np.eye(x.shape[1])[0][:, None] * 1e-12)
    assert "dynamics" in broken(x=x * np.where(np.arange(x.shape[1]) == 1, 1.001, 1)[:, None])
    assert {"bounds", "stationarity"} <= broken(u=u + 1.0)
    assert "complementarity" in broken(lam=1.001 * lam)
    assert "sign of lam" in broken(lam=-lam)
    assert broken(objective=objective * (1 + 1e-6)) >= {"objective"}
    assert "finite" in broken(u=np.full_like(u, np.nan))
    low, high = (problem.full()[k][:, None] for k in ("u_min", "u_max"))
    middle = 0.5 * (low + high)
    assert "stationarity" in broken(u=np.where(u < middle, high, low))

    lcp, _ = next(c for c in campaign.CELLS if c.name == "lcp-plain/exact").chunk(0, 0)
    zero = np.zeros_like(lcp.q)
    ratios = checks.judge_lcp(lcp, zero, np.maximum(lcp.q, 0), 0.0)
    assert ((ratios["equation"] > 1) == (lcp.q < 0).any(-1)).all()


def test_the_judge_of_forms_sees_a_wrong_plan():
    case = random_case(6, 2)
    problem = case.problem()
    x, u, lam, mu = (v.numpy().copy() for v in BatchedBackend(threads=1).solve(problem, None).primal)

    def broken(x, u, lam, mu) -> set[str]:
        cost, violation = (f(*map(torch.from_numpy, (x, u))).numpy() for f in (problem.objective, problem.violation))
        return {name for name, ratio in checks.judge_mpc(case, x, u, lam, cost, mu, violation).items() if ratio[0] > 1}

    assert not broken(x, u, lam, mu)
    assert broken(1.01 * x, u, lam, mu) >= {"start", "dynamics"}
    assert broken(x, u, lam, mu + 1e-3) >= {"rows", "stationarity"}
    assert "price" in broken(x, u, lam, -mu - 1e-9)
    moved = problem.clip(torch.from_numpy(u) + 0.1)
    x, lam = (v.numpy() for v in problem.rollout(moved))
    assert "stationarity" in broken(x, moved.numpy(), lam, mu)


def test_records_survive_a_cut_line(tmp_path):
    cell = next(c for c in campaign.CELLS if c.name == "lcp-plain/exact")
    record = campaign.run_chunk(cell, 0, 0, gradients=False)
    path = tmp_path / "results.jsonl"
    line = campaign.line(record)
    path.write_text(line + "\n" + line[: len(line) // 2])
    assert [r.tried for r in campaign.read(path)] == [record.tried]
    assert "| lcp-plain | 256 | 100.0 | 0 | 0 | 0 |" in campaign.markdown(campaign.read(path))
