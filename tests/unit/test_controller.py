"""The controller of one robot: the same plans as the layer's, an action for every step, files that are checked."""

import contextlib
import copy
import itertools
import pickle
import struct
import threading
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from difflcs import GoalCost, LCSMPCLayer, LCSParams, LCSSequence, QuadraticCost, SolveError, StageBounds, Status
from difflcs.errors import CheckpointError, DTypeError, InvalidInputError, NonFiniteError, ShapeError
from difflcs.mpc import MPCController
from difflcs.mpc.backends import BatchedBackend
from difflcs.mpc.export import export_controller
from tests.conformance.problems import PROBLEMS, layer_of
from tests.conftest import refuse

H = 5


def states(count, n_x=4, seed=0):
    return 0.1 * np.random.default_rng(seed).normal(size=(count, n_x))


@pytest.fixture
def plain(build):
    return LCSMPCLayer(build.params(0), build.cost(0), H, -0.3, 0.3)


@pytest.fixture
def reaching(build):
    return LCSMPCLayer(build.params(0), GoalCost.reach(4, 2, (10.0, 10.0), 20.0 * np.ones(2), 1.0), H, -0.3, 0.3)


# --- the same plans ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PROBLEMS)
def test_its_plans_are_those_of_the_layer_bit_for_bit_also_from_a_file(build, name, tmp_path):
    problem, solution = PROBLEMS[name](build), None
    mpc = layer_of(problem.select(slice(1)))
    mpc.controller().save(tmp_path / "c")
    controller = mpc.controller()
    loaded = MPCController.load(tmp_path / "c", on_failure="zero", time_limit=60.0)
    assert repr(loaded) == repr(controller).replace("time_limit=None", "time_limit=60.0")
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "c").read_bytes()
    refuse(InvalidInputError, "path: expected a place to write", loaded.save, tmp_path)
    for x in problem.inputs["x0"][:4]:
        solution = mpc(x, guess=None if solution is None else solution.shift())
        u, plan = controller.step(x.numpy()), controller.plan
        assert np.array_equal(loaded.step(x.numpy()), u)
        for field in ("x", "u", "lam", "mu"):
            found, expected = getattr(plan, field), getattr(solution, field).detach().numpy()
            assert np.array_equal(found, expected.reshape(found.shape)), field
        assert np.array_equal(u, plan.u[0])
        assert controller.status.solved
        assert (plan.iterations, plan.kkt_residual) == (int(solution.iterations), float(solution.kkt_residual))
        assert plan.objective == pytest.approx(float(solution.objective.detach()), rel=1e-12)
        assert plan.fallback is plan.late is False


@pytest.mark.parametrize("again", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))], ids=["copied", "pickled"])
def test_a_copy_begins_anew_and_leaves_the_first_as_it_is(build, reaching, again):
    goal, other = np.array([0.05, -0.05]), build.params(1)
    modules = LCSMPCLayer(build.params(0), build.AskedCost(reaching.cost), H, -0.3, 0.3)
    for mpc in (reaching, modules):
        first, twin, fresh = mpc.controller("zero"), mpc.controller("zero"), mpc.controller("zero")
        for x in states(3):
            for each in (first, twin):
                each.step(x, goal, lcs=other)
        copied = again(first)
        assert copied.status is None
        for x in states(3, seed=1):
            assert np.array_equal(copied.step(x, goal), fresh.step(x, goal))
            assert np.array_equal(first.step(x, goal), twin.step(x, goal))


def test_what_is_kept_without_contact_fits_every_set_of_active_bounds_and_other_numbers(build):
    mpc = LCSMPCLayer(build.params(0, n_lam=0), build.cost(0), H, -0.3, 0.3)
    controller, active = mpc.controller(), set()
    changes = {"lcs": build.params(1, n_lam=0)}, {"cost": build.cost(1)}, {"u_max": 0.01}, {}, {}
    for x, change in zip(20 * states(24), itertools.cycle(changes), strict=False):
        controller.reset()
        controller.step(x, **change)
        plan = controller.plan
        assert np.array_equal(plan.u, mpc(torch.from_numpy(x), **change).u.detach().numpy())
        assert plan.status.solved
        active.add((np.abs(plan.u) == 0.3).tobytes())
    assert len(active) > 3


def test_goals_and_references(reaching):
    controller, solution = reaching.eval().controller(), None
    rng = np.random.default_rng(1)
    for i, x in enumerate(states(10)):
        guess = None if solution is None else solution.shift()
        if i % 2:
            goal = 0.1 * rng.normal(size=2)
            solution = reaching(torch.from_numpy(x), torch.from_numpy(goal), guess=guess)
            u = controller.step(x, goal)
        else:
            reference = 0.1 * rng.normal(size=(H + 1, 2))
            solution = reaching(torch.from_numpy(x), reference=torch.from_numpy(reference), guess=guess)
            u = controller.step(x, reference=reference)
        assert u == pytest.approx(solution.action.detach().numpy(), rel=1e-9, abs=1e-12)
        assert controller.plan.objective == pytest.approx(float(solution.objective.detach()), rel=1e-12)


def test_the_controller_keeps_the_model_that_it_was_made_with(build):
    mpc = LCSMPCLayer(build.model(3), build.cost(0), H, -0.3, 0.3)
    controller, x = mpc.controller(), states(1)[0]
    before = controller.step(x)
    with torch.no_grad():
        mpc.lcs.B.mul_(2)
    controller.reset()
    assert np.array_equal(controller.step(x), before)
    assert not np.array_equal(mpc.controller().step(x), before)


class Leaning(torch.nn.Module):
    """A system whose offset grows with the state, and whose matrices with a mass."""

    n_x, n_u, n_lam = 4, 2, 3

    def __init__(self, params):
        super().__init__()
        self.base = params

    def params(self, x=None, context=None):
        base = self.base
        d = base.d + 0.1 * x
        B = base.B if context is None else base.B * context.unsqueeze(-1)
        return LCSParams(base.A, B, base.C, d, base.D, base.E, base.F, base.c)


def test_a_module_is_not_written_and_not_asked_at_a_state_that_is_none(build):
    mpc = LCSMPCLayer(Leaning(build.params(0)), build.cost(0), H, -0.3, 0.3)
    controller, context = mpc.controller(on_failure=[0.2, -0.9]), torch.ones(1).double()
    for bounds in ({}, {"u_max": 0.1}, {"u_max": 0.05}, {}):
        assert controller.step(NAN, context=context, **bounds).tolist() == [bounds.get("u_max", 0.2), -0.3]
        assert controller.status == Status.NUMERICAL
        if bounds:
            controller.step(states(1)[0], context=context, **bounds)
    refuse(InvalidInputError, "may depend on the state", controller.save, "never.difflcs")
    refuse(InvalidInputError, "may depend on the state", export_controller, mpc, "never")
    assert not Path("never").exists()


class Tilted:
    """A `CostModule` whose linear terms are the state and the goal."""

    def __init__(self, cost, constant=False):
        self.base, self.constant = cost, constant

    def at(self, x, goal=None, context=None):
        terms = {**self.base.tensors(), "constant_stage": 0.5 * (x**2).sum(-1)}
        terms["q"] = terms["q"] + (0 if self.constant else 0.1 * x)
        return QuadraticCost(**terms) if goal is None else QuadraticCost(**{**terms, "q_final": -goal})


@pytest.mark.parametrize("asked", ["both", "cost", "given"])
def test_each_step_may_have_a_system_a_cost_and_bounds_of_its_own(build, asked):
    lcs = Leaning(build.params(0)) if asked == "both" else build.params(0)
    stages = StageBounds(np.linspace(-0.3, -0.1, 2 * H).reshape(H, 2), 0.3, by_stage=("u_min",))
    limits = {"bounds": stages} if asked == "given" else {"u_min": -0.3, "u_max": 0.3}
    mpc = LCSMPCLayer(lcs, build.cost(0) if asked == "given" else Tilted(build.cost(0)), H, **limits)
    controller, solution = mpc.eval().controller(time_limit=100.0), None
    for i, x in enumerate(states(8)):
        context, own = np.array([1.0 + 0.1 * i]) if asked == "both" else None, {}
        goal = None if asked == "given" or i == 3 else 0.1 * torch.from_numpy(x)
        if i % 3 == 1:  # what is given counts for this step alone
            low = np.array([-0.02, -0.3 - 0.1 * i])
            own = {"lcs": build.params(i), "cost": Tilted(build.cost(i)), "u_min": low, "u_max": 0.01}
        if asked == "given" and i == 6:
            own = {"bounds": StageBounds(stages.u_min / (i + 1), 0.2, by_stage=("u_min",))}
        guess = None if solution is None else solution.shift()
        solution = mpc(torch.from_numpy(x), goal, guess=guess, context=context, **own)
        assert np.array_equal(controller.step(x, goal, context=context, **own), solution.action.numpy())
        assert controller.plan.objective == pytest.approx(float(solution.objective), rel=1e-12)
    held = controller.plan.u[1]
    controller.time_limit = 1e-9
    assert np.array_equal(controller.step(x, goal, context=context), held)
    assert controller.plan.late
    assert controller.plan.fallback


def test_a_cost_module_is_written_where_it_is_constant(build, tmp_path):
    mpc = LCSMPCLayer(build.params(0), Tilted(build.cost(0), constant=True), H, -0.3, 0.3).eval()
    x = states(1)[0]
    path = export_controller(mpc, tmp_path)
    assert np.array_equal(MPCController.load(path).step(x), mpc(torch.from_numpy(x)).action.numpy())
    mpc = LCSMPCLayer(build.params(0), Tilted(build.cost(0)), H, -0.3, 0.3)
    for write in (mpc.controller().save, lambda path: export_controller(mpc, path)):
        with pytest.raises(InvalidInputError, match=r"cost: .*may depend on the state; build a layer with cost=module"):
            write(tmp_path / "never")


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"lcs": LCSParams}, "lcs: expected LCSModel"),
        ({"lcs": "n_lam"}, r"expected C \(4, 3\) as in the first"),
        ({"cost": "goal"}, "goal: expected .*GoalCost"),
        ({"cost": "n_x"}, "n_x=4, n_u=2 like the LCS"),
        ({"u_min": 1.0}, "u_min: expected u_min <= u_max"),
        ({"u_max": torch.zeros(3, 2).double()}, "no batch dimension"),
    ],
)
def test_a_step_refuses_what_does_not_fit(build, plain, reaching, tmp_path, own, message):
    named = {"n_lam": build.params(0, n_lam=2), "goal": reaching.cost, "n_x": build.cost(0, n_x=5)}
    own = {name: named.get(value, value) if isinstance(value, str) else value for name, value in own.items()}
    controller, x = plain.controller(), states(1)[0]
    before = controller.step(x)
    refuse(InvalidInputError, message, controller.step, x, **own)
    controller.reset()
    assert np.array_equal(controller.step(x), before)
    controller.save(tmp_path / "c")
    with pytest.raises(InvalidInputError, match="expected none in a controller of a file"):
        MPCController.load(tmp_path / "c").step(x, **own)
    for goal in ([0.0, 0.0], None):
        with pytest.raises(ShapeError, match="cost: expected none where the layer has a GoalCost"):
            reaching.controller().step(x, goal, cost=plain.cost)


@pytest.mark.parametrize("change", ["sequence", "size", "F in place", "NaN"])
def test_a_module_whose_system_changes_its_form_or_breaks_is_refused(build, change):
    mpc = LCSMPCLayer(Leaning(build.params(0)), build.cost(0), H, -0.3, 0.3)
    controller, x = mpc.controller(), states(1)[0]
    before, plain, other = controller.step(x), mpc.lcs.params, build.params(0)
    if change == "sequence":
        other = LCSSequence.stack([other] * H)
    elif change == "size":
        mpc.lcs.n_lam, other = 2, build.params(0, n_lam=2)
    else:
        (other.A if change == "NaN" else other.F).numpy()[0, 0] = np.nan if change == "NaN" else -1.0
    mpc.lcs.params = lambda x, context: other
    if change in ("F in place", "NaN"):
        refuse(InvalidInputError, r"F \+ Fᵀ pos|A: expected finite", mpc.controller().step, x)
    refuse(InvalidInputError, r"expected (. \(.*as in the first|F \+ Fᵀ pos|finite).*; ", controller.step, x)
    mpc.lcs.params, mpc.lcs.n_lam = plain, Leaning.n_lam
    controller.reset()
    assert np.array_equal(controller.step(x), before)


# --- a step that is not solved ----------------------------------------------------------------------------------------

NAN = np.full(4, np.nan)


def test_hold_follows_the_last_plan_and_then_is_zero(plain):
    controller = plain.controller(on_failure="hold")
    controller.step(states(1)[0])
    planned = controller.plan.u
    assert np.abs(planned).min() > 0
    for wanted in [*planned[1:], np.zeros(2), np.zeros(2)]:
        assert np.array_equal(controller.step(NAN), wanted)
        assert controller.status == Status.NUMERICAL
        assert controller.plan.fallback


def test_zero_a_given_action_and_raise(build, plain):
    x = states(1)[0]
    for on_failure, wanted in (("zero", [0, 0]), ([0.1, -0.2], [0.1, -0.2]), (np.array([9.0, -9.0]), [0.3, -0.3])):
        controller = plain.controller(on_failure=on_failure)
        controller.step(x)
        assert controller.step(NAN).tolist() == wanted
    controller = plain.controller(on_failure="raise")
    controller.step(x)
    with pytest.raises(SolveError, match="NUMERICAL") as caught:
        controller.step(NAN)
    assert caught.value.status == (Status.NUMERICAL,)
    assert controller.step(x).shape == (2,)
    above = LCSMPCLayer(build.params(0), build.cost(0), H, 0.1, 0.3).controller(on_failure="zero")
    assert above.step(NAN).tolist() == [0.1, 0.1]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_no_number_that_is_none_reaches_the_solver(reaching, bad):
    controller, goal = reaching.controller(), np.array([0.1, 0.1])
    x = states(1)[0]
    first = controller.step(x, goal)
    wrong_state, wrong_goal = x.copy(), goal.copy()
    wrong_state[2], wrong_goal[1] = bad, bad
    for arguments in ((wrong_state, goal), (x, wrong_goal)):
        assert np.isfinite(controller.step(*arguments)).all()
        assert controller.status == Status.NUMERICAL
        assert controller.plan.iterations == 0
    controller.step(x, reference=np.full((H + 1, 2), bad))
    assert controller.status == Status.NUMERICAL
    controller.reset()
    assert np.array_equal(controller.step(x, goal), first)


def test_a_deadline_ends_the_step_with_the_fallback(plain):
    controller = plain.controller(on_failure=[0.05, 0.06], time_limit=1e-9)
    for x in states(3):
        assert controller.step(x).tolist() == [0.05, 0.06]
        assert controller.status == Status.MAX_ITER
        assert controller.plan.late
        assert controller.plan.fallback
    controller.time_limit = None
    controller.reset()
    controller.step(states(1)[0])
    assert controller.status == Status.CONVERGED
    assert not controller.plan.late
    controller.time_limit = 1e-9
    planned = controller.plan.u
    controller.step(states(1)[0])
    assert controller.time_limit == 1e-9
    assert controller.plan.late
    assert not np.array_equal(controller.plan.u, planned) or controller.plan.iterations == 0


def test_the_time_that_a_steps_own_system_takes_is_missing_in_no_later_step(build, plain, monkeypatch):
    controller, x, clock = plain.controller(time_limit=100.0), states(1)[0], itertools.count(0, 100)
    controller.step(x)
    with monkeypatch.context() as patch:
        patch.setattr("time.perf_counter", lambda: next(clock))
        for own in (build.params(1), None):  # None: back to the first one, which takes time as well
            controller.step(x, lcs=own)
            assert controller.plan.late
    controller.step(x)
    assert not controller.plan.late


def test_what_is_unfinished_can_be_acted_by_and_goes_on_in_the_next_step(build):
    x, steps = 0.3 * np.ones(4), {}
    for max_iter in range(1, 13):
        backend = BatchedBackend(effort="fast", max_iter=max_iter, time_limit=60.0)
        mpc = LCSMPCLayer(build.params(0), build.cost(0), H, -0.5, 0.5, backend, relaxation=1e-5)
        held, acting = mpc.controller(), mpc.controller("unfinished", time_limit=90.0)
        assert (held.time_limit, acting.time_limit) == (60.0, 90.0)
        steps[max_iter] = next((i for i in range(10) if held.step(x) is not None and held.status.solved), 10)
        u, plan = acting.step(x), acting.plan
        if max_iter == 2:
            assert u.any()
            assert plan.fallback
            assert plan.status == acting.status == Status.MAX_ITER
            for wanted in [*plan.u, np.zeros(2)]:  # without a new plan it follows the unfinished one
                assert np.array_equal(u, wanted)
                u = acting.step(NAN)
    assert steps[1] > 0
    assert any(0 < taken < 10 for taken in steps.values()), steps  # a cold start at each step would never end


def test_the_fallback_is_inside_the_bounds_of_the_first_stage(build):
    low = torch.tensor([[-0.01, -0.02]] + [[-1.0, -1.0]] * (H - 1), dtype=torch.float64)
    mpc = LCSMPCLayer(build.params(0), build.cost(0), H, bounds=StageBounds(low, -low))
    controller = mpc.controller(on_failure="hold")
    controller.step(states(1)[0])
    assert np.abs(controller.plan.u[1]).max() > 0.02
    held = controller.step(NAN)
    assert (np.abs(held) <= [0.01, 0.02]).all()
    assert held.any()


# --- more than one ----------------------------------------------------------------------------------------------------


def test_actions_and_plans_are_the_callers(plain):
    controller, (x, y) = plain.controller(), states(2)
    u = controller.step(x)
    plan, kept, first = controller.plan, u.copy(), controller.plan.u.copy()
    u[:] = 7
    plan.u[:] = 8
    assert np.array_equal(controller.plan.u, first)
    assert np.array_equal(controller.plan.u[0], kept)
    controller.step(y)
    assert u.tolist() == [7, 7]


def test_a_second_thread_is_refused(build):
    mpc = LCSMPCLayer(build.params(0, n_x=12, n_u=6, n_lam=12), build.cost(0, n_x=12, n_u=6), 10, -0.15, 0.15)
    controller = mpc.controller()
    controller.step(np.zeros(12))
    stop = threading.Event()

    def work():
        while not stop.is_set():
            with contextlib.suppress(RuntimeError):
                controller.step(0.2 * np.ones(12))

    def read():
        for _ in range(100000):
            _ = controller.plan

    thread = threading.Thread(target=work)
    thread.start()
    try:
        with pytest.raises(RuntimeError, match="one thread at a time"):
            read()
    finally:
        stop.set()
        thread.join()


# --- arguments --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (dict(x=np.zeros(5), goal=np.zeros(2)), ShapeError, r"x: expected shape \(4,\)"),
        (dict(x=np.zeros((1, 4)), goal=np.zeros(2)), ShapeError, "without a batch"),
        (dict(x="far", goal=np.zeros(2)), DTypeError, "x: expected real numbers"),
        (dict(x=np.zeros(4, complex), goal=np.zeros(2)), DTypeError, "x: expected real numbers"),
        (dict(x=None, goal=np.zeros(2)), DTypeError, "x: expected real numbers"),
        (dict(x=[[1], [1, 2]], goal=np.zeros(2)), DTypeError, "x: expected numbers"),
        (dict(x=np.zeros(4), goal=np.zeros(3)), ShapeError, "goal: expected shape"),
        (dict(x=np.zeros(4)), ShapeError, "goal: expected .* got none"),
        (dict(x=np.zeros(4), goal=np.zeros(2), reference=np.zeros((6, 2))), ShapeError, "got both"),
        (dict(x=np.zeros(4), reference=np.zeros((5, 2))), ShapeError, "reference: expected shape"),
        (dict(x=np.zeros(4), goal=np.zeros(2), context=torch.zeros(1)), ShapeError, "context: expected none"),
    ],
)
def test_arguments_that_do_not_fit(reaching, arguments, error, message):
    controller = reaching.controller()
    controller.step(np.zeros(4), np.zeros(2))
    before = controller.plan
    refuse(error, message, controller.step, **arguments)
    assert np.array_equal(controller.plan.u, before.u)


class Curved(GoalCost):
    """Not linear in the goal."""

    def at(self, goal, horizon):
        return super().at(goal**2, horizon)


def test_goals_options_and_layers_that_it_does_not_take(build, plain):
    params, cost = build.params(0), build.cost(0)
    refuse(ShapeError, "goal: expected none", plain.controller().step, np.zeros(4), np.zeros(2))
    refuse(ShapeError, "reference: expected none", plain.controller().step, np.zeros(4), reference=np.zeros((H + 1, 2)))
    refuse(InvalidInputError, "on_failure: expected 'hold'", plain.controller, on_failure="stop")
    refuse(ShapeError, "on_failure: expected shape", plain.controller, on_failure=np.zeros(3))
    refuse(NonFiniteError, "on_failure", plain.controller, on_failure=[np.nan, 0.0])
    for wrong in (0.0, -1.0, np.inf):
        refuse(InvalidInputError, "time_limit", plain.controller, time_limit=wrong)
    with pytest.raises(InvalidInputError, match="backend: expected 'batched'"):
        LCSMPCLayer(params, cost, H, -0.3, 0.3, backend="ipopt").controller()
    with pytest.raises(ShapeError, match="A: expected no batch dimension"):
        LCSMPCLayer(build.params(0, batch=(3,)), cost, H, -0.3, 0.3).controller()
    with pytest.raises(ShapeError, match="Q: expected no batch dimension"):
        LCSMPCLayer(params, build.cost(0, batch=(3,)), H, -0.3, 0.3).controller()
    with pytest.raises(InvalidInputError, match="got the subclass Curved"):
        LCSMPCLayer(params, Curved.reach(4, 2), H, -0.3, 0.3).controller()
    alone = LCSMPCLayer(build.params(0, batch=(1,)), cost, H, -0.3, 0.3).controller()
    assert alone.step(np.zeros(4)).shape == (2,)


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def saved(plain, tmp_path):
    path = tmp_path / "controller.difflcs"
    plain.controller().save(path)
    return path


def test_every_cut_and_every_flipped_bit_is_found(saved):
    content, rng = saved.read_bytes(), np.random.default_rng(0)
    places = [*range(40), *rng.integers(64, len(content), 20)]
    wrong = [content[:size] for size in places] + [content + b"\0"]
    for at in places:
        damaged = bytearray(content)
        damaged[at] ^= 1 << int(rng.integers(8))
        wrong.append(bytes(damaged))
    for damaged in wrong:
        saved.write_bytes(damaged)
        refuse(CheckpointError, ".", MPCController.load, saved)


def test_what_is_no_controller(saved, tmp_path):
    other = forged(entries(saved.read_bytes()), version=4)
    for content, message in (
        (b"", "0 bytes"),
        (b"A" * 100, "another kind of file"),
        (other, "expected version 3 of the format, got 4"),
    ):
        saved.write_bytes(content)
        refuse(CheckpointError, message, MPCController.load, saved)
    for path, message in ((tmp_path / "none", "none"), (tmp_path, "plain file")):
        refuse(CheckpointError, message, MPCController.load, path)


def entries(content):
    """Name → numbers of a file, in order."""
    at, found = 24, {}
    while at < len(content):
        name, count = struct.unpack_from("<16sQ", content, at)
        found[name.rstrip(b"\0").decode()] = list(struct.unpack_from(f"<{count}d", content, at + 24))
        at += 24 + 8 * count
    return found


def forged(values, version=3):
    """A file with a checksum that matches, whatever is in it."""
    body = b"".join(
        struct.pack(f"<16sQ{len(v)}d", name.encode(), len(v), *v) if isinstance(v, list) else v
        for name, v in values.items()
    )
    size = struct.pack("<Q", 24 + len(body))
    return b"\x89LCS\r\n\x1a\n" + struct.pack("<II", version, zlib.crc32(size + body)) + size + body


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("n_x", [0.0], "n_x: expected a number from 1"),
        ("n_x", [4.5], "n_x: expected a whole number"),
        ("n_x", [np.nan], "n_x: expected a number"),
        ("n_x", [1e18], "n_x: expected a number"),
        ("n_x", [5.0], "A: expected 25 numbers, got 16"),
        ("n_x", [99999.0], "A: expected"),
        ("n_lam", [-1.0], "n_lam"),
        ("horizon", [0.0], "horizon"),
        ("n_goal", [2.0], "goal_to_q: expected 8 numbers, got 0"),
        ("relaxation", [0.0], "relaxation"),
        ("shrink", [1.0], "shrink"),
        ("max_iter", [np.inf], "max_iter"),
        ("starts", [0.0], "starts"),
        ("step_seconds", [-1.0], "step_seconds"),
        ("tol", [], "tol: expected 1 numbers, got 0"),
        ("Q", [np.nan] * 16, "Q: expected finite numbers"),
        ("F", [np.inf] * 9, "F: expected finite numbers"),
        ("u_min", [0.5, 0.5], "u_min: expected at most u_max"),
        ("u_min", [np.inf, 0.0], "u_min: expected limits that can be met"),
        ("u_max", [np.nan, 1.0], "u_max: expected limits that can be met"),
        ("constant", [np.nan], "constant"),
        ("more", [1.0], "expected the end of the file"),
        ("B", struct.pack("<16sQ", b"B", 2**63), "B: expected its numbers, got the end"),
        ("C", b"", "expected the entry C, got another one"),
        ("constant", b"", "expected the entry constant, got the end"),
    ],
)
def test_numbers_that_no_controller_has(saved, name, value, message):
    content = saved.read_bytes()
    values = entries(content)
    assert forged(values) == content  # forging does nothing by itself
    values[name] = value
    saved.write_bytes(forged(values))
    refuse(CheckpointError, message, MPCController.load, saved)


def test_forged_numbers_that_are_allowed_end_with_a_status(saved):
    """F is not positive definite and the cost not convex: whatever comes, it is inside the bounds."""
    values = entries(saved.read_bytes())
    rng = np.random.default_rng(0)
    for _ in range(50):
        name = str(rng.choice(["A", "B", "C", "D", "E", "F", "Q", "R", "Q_final", "q", "d", "c", "u_max"]))
        scale = 10.0 ** rng.uniform(-300, 300)
        wild = {
            **values,
            name: [float(abs(v) if name == "u_max" else v) for v in scale * rng.normal(size=len(values[name]))],
        }
        saved.write_bytes(forged(wild))
        controller = MPCController.load(saved)
        for x in states(2):
            assert (controller.step(x) >= -0.3).all()
            assert controller.status in tuple(Status)
