"""The race in `benchmarks/`: what its rivals are given, who is missing, and how an answer is judged."""

import dataclasses
import shutil

import numpy as np
import pytest
import race
import race_hard
import race_loops
import race_problems
import torch
from models import pushing_model
from race_problems import cart_pole, hard_cost
from rivals import admm, sampling
from rivals.problem import Condensed, sparse_program
from scipy.optimize import nnls

COUNT = 5


@pytest.fixture
def pushing():
    return race_problems.pushing(pushing_model(5, 0), count=COUNT, seed=0)


def test_a_rival_that_is_not_there_is_reported(tmp_path):
    absent = race.Process(race.Entry("absent", "layer", venv="nowhere"), tmp_path, str(tmp_path))
    assert "--install" in absent.missing
    broken = race.Process(race.Entry("broken", "no_such_rival"), tmp_path, str(tmp_path))
    assert "no_such_rival" in broken.missing
    broken.close()


def test_a_rival_solves_and_is_judged_by_the_optimality_conditions(tmp_path):
    problem = cart_pole(COUNT, horizon=10, seed=0)
    process = race.Process(race.CONTACT[2], tmp_path, str(tmp_path))
    assert not process.missing
    problem.save(f"{tmp_path}/0.npz")
    answer = process.ask(problem=f"{tmp_path}/0.npz", out=f"{tmp_path}/out.npz", seconds=100.0, few=COUNT)
    process.close()
    assert answer["solved"] == [True] * COUNT
    assert min(answer["times"]) > 0
    u = np.load(f"{tmp_path}/out.npz")["u"]
    said = np.ones(COUNT, bool)
    good = race.judge(problem, u, said, None)
    assert good.solved.all()
    assert float(np.nanmax(good.gradient_error)) < 1e-2
    # Neither other actions pass, nor the solver's own word alone, nor good actions against its word.
    assert not race.judge(problem, 0 * u, said, None).solved.any()
    assert race.judge(problem, u, np.arange(COUNT) > 0, None).solved.tolist() == [False] + [True] * (COUNT - 1)
    wrong = np.ones((COUNT, problem.n_x))
    assert float(np.nanmin(race.judge(problem, u, said, wrong).gradient_error)) > 0.1


def test_both_quadratic_programs_are_the_linear_mpc(pushing):
    none = {"C": pushing.C[:, :0], "D": pushing.D[:0], "E": pushing.E[:0], "F": pushing.F[:0, :0], "c": pushing.c[:0]}
    wide = {"u_min": np.full(6, -9.0), "u_max": np.full(6, 9.0), "q": pushing.q[0], "q_final": pushing.q_final[0]}
    linear = dataclasses.replace(pushing, **none, **wide)
    dense = Condensed.of(linear)
    z = np.linalg.solve(dense.H, -dense.f @ dense.at(linear.x0[1]))
    P, q, A, b, where = sparse_program(linear)
    b[: linear.n_x] += linear.A @ linear.x0[1]
    zero = np.zeros((len(b), len(b)))
    both = np.linalg.solve(np.block([[P, A.T], [A, zero]]), np.concatenate([-q, b]))
    np.testing.assert_allclose(both[where], z, rtol=0, atol=1e-9)
    found = race.BatchedBackend().solve(race.as_mpc(linear), None)
    assert bool(found.solved.all())
    np.testing.assert_allclose(found.primal.u[1].flatten(), z, rtol=0, atol=1e-7)


def test_hard_cost_is_that_of_the_exact_contact(pushing):
    mpc = race.as_mpc(pushing)
    u = mpc.clip(0.01 * torch.ones(COUNT, mpc.horizon, mpc.n_u, dtype=torch.float64))
    sharp = dataclasses.replace(mpc, relaxation=1e-12)
    torch.testing.assert_close(hard_cost(mpc, u), sharp.objective(sharp.rollout(u)[0], u), rtol=1e-5, atol=1e-6)
    assert float((hard_cost(mpc, u) - mpc.objective(mpc.rollout(u)[0], u)).abs().max()) > 0


def test_planners_for_contact_come_near_the_best_plan():
    problem = cart_pole(2, horizon=10, seed=0)
    tuned = race_hard.json.loads(race_hard.TUNED.read_text())["cart-pole, H 10"]
    best = race_hard.reference(problem)
    for label, row in tuned.items():
        if shutil.which("cc") or not label.startswith("C3+"):  # its iterations are compiled
            solver = race_hard.MODULES[row["module"]].Solver(problem, **row["settings"])
            u = np.concatenate([solver.one(i).u for i in range(2)])
            assert (race_hard.objectives(problem, u) < (1.2 if "3 iter" in label else 1.02) * best).all(), label
    costs = [sampling.Solver(problem).costs(problem.only(i), u[i : i + 1])[0] for i in range(2)]
    np.testing.assert_allclose(costs + problem.constant, race_hard.objectives(problem, u), rtol=1e-9)


def test_c3_projects_onto_the_nearest_point_that_complementarity_allows(pushing):
    solver = admm.Solver(pushing, iterations=1, weight=1.0, gap=0.5, project="exact", new=True)
    M, inverses = solver.supports(pushing.F)
    size = pushing.n_lam
    for target in np.random.default_rng(0).standard_normal((20, 2 * size)):
        pairs = inverses @ (target @ M)
        allowed = pairs[(pairs >= 0).all(1)]
        assert not (allowed[:, :size] * allowed[:, size:]).any()
        nearest = np.linalg.norm(allowed @ M.T - target, axis=1).min()
        modes = (M[:, [i + size * (mode >> i & 1) for i in range(size)]] for mode in range(2**size))
        assert nearest == pytest.approx(min(nnls(mode, target)[1] for mode in modes), rel=1e-9)


def test_a_rival_closes_the_loop_in_mujoco_and_samples_in_a_copy_of_it():
    loop = race_loops.Cube()
    tuned = race_loops.json.loads(race_loops.TUNED.read_text())["cube"]["C3, 10 iterations"]
    found = race_loops.play(loop, tuned["module"], tuned["settings"], range(2000, 2003), 100.0)
    assert max(found["cost"]) < 1  # nearer than at the start
    loop.begin(2000)
    actions = np.random.default_rng(0).uniform(-0.015, 0.015, (3, 6))
    foreseen = loop.imagine(actions)
    for action, state in zip(actions, foreseen[1:], strict=True):
        loop.move(action)
        np.testing.assert_array_equal(loop.seen["state"], state)
