"""`torch.nn.utils` and `torch.autocast` at every public entry point: right values and gradients, or a typed error.

Right is what the same entry point gives for `LCSParams` built here from the matrices as the tool defines them.
"""

import warnings

import pytest
import torch
from torch import nn
from torch.func import functional_call
from torch.nn import utils
from torch.nn.utils import parametrizations, parametrize, prune
from torch.optim.swa_utils import AveragedModel

import difflcs
from difflcs import _storage
from difflcs.errors import DTypeError, InvalidInputError
from difflcs.mpc import Primal
from difflcs.physics import Circle, ContactLCS, PlanarPushing
from difflcs.scales import ScaledLCS
from tests.conftest import draw, refuse

HORIZON, CHANGED = 3, ("A", "C", "G", "H")


DATA = X, U, NEXT, GOAL = draw(4, 4, seed=1), draw(4, 2, seed=2), draw(4, 4, seed=3), 0.3 * draw(4, 2, seed=4)


class Larger(nn.Module):
    def forward(self, X):
        return 1.2 * X


def enlarge(module, name):
    return parametrize.register_parametrization(module, name, Larger())


def of_each(function, **options):
    return lambda lcs: [function(lcs, name, **options) for name in CHANGED] and lcs


def averaged(lcs):
    ema = AveragedModel(of_each(parametrizations.weight_norm)(lcs), avg_fn=lambda old, new, _: 0.3 * old + 0.7 * new)
    for _ in range(2):
        stir(lcs)
        ema.update_parameters(lcs)
    return ema.module


TOOLS = {
    "none": lambda lcs: lcs,
    "parametrize": of_each(enlarge),
    "weight_norm": of_each(parametrizations.weight_norm),
    "spectral_norm": of_each(parametrizations.spectral_norm),
    "orthogonal": of_each(parametrizations.orthogonal),
    "prune": of_each(prune.l1_unstructured, amount=0.4),
    "prune twice": lambda lcs: of_each(prune.random_unstructured, amount=0.2)(TOOLS["prune"](lcs)),
    "old weight_norm": of_each(utils.weight_norm),
    "old spectral_norm": of_each(utils.spectral_norm),
    "averaged": averaged,
    "hooks of gradients": of_each(lambda lcs, name: getattr(lcs, name).register_hook(lambda grad: grad / 2)),
}


def stir(module, seed=9):
    with torch.no_grad():
        for p in module.parameters():
            p.add_(0.1 * draw(*p.shape, seed=seed))


def make(tool="none", dtype=torch.float64):
    """A model that the tool has changed, and whose parameters were changed after that, as by an optimiser."""
    model = difflcs.LCSModel(4, 2, 3, init_scale=0.4, generator=torch.Generator().manual_seed(0), dtype=dtype).eval()
    with warnings.catch_warnings(), torch.random.fork_rng():
        warnings.simplefilter("ignore", FutureWarning)  # of old tools
        torch.manual_seed(0)
        model = TOOLS[tool](model)
    stir(model)
    return model


def matrix(model, name):
    """A matrix as the tools define it."""
    own = {**dict(model.named_parameters()), **dict(model.named_buffers())}
    part = {end: own.get(f"{name}_{end}") for end in ("orig", "mask", "g", "v", "u")}
    if part["mask"] is not None:
        return part["orig"] * part["mask"]
    if part["g"] is not None:
        return part["g"] * part["v"] / part["v"].norm(dim=1, keepdim=True)
    return getattr(model, name) if part["u"] is None else part["orig"] / (part["u"] @ part["orig"] @ part["v"])


def right(model):
    fields = {name: matrix(model, name) for name in difflcs.LCSModel.parameter_names}
    G, H = fields.pop("G"), fields.pop("H")
    F = G @ G.mT + model.stiffness * torch.eye(3, dtype=G.dtype) + H - H.mT
    return difflcs.LCSParams(**fields, F=F)


def layer(lcs, **options):
    cost = difflcs.GoalCost.reach(4, 2, goal_weight=(10.0, 10.0), input_weight=0.1, dtype=getattr(lcs, "B", X).dtype)
    options = {"cost": cost, "horizon": HORIZON, "u_min": -1.0, "u_max": 1.0} | options
    return difflcs.LCSMPCLayer(lcs, **options)


def plans(solution):
    return solution.u, solution.lam, solution.objective


def policy_of(lcs):
    from difflcs.rl.learning.policy import LCSMPCPolicy

    return LCSMPCPolicy(layer(lcs), std=0.5)


def observed(x=X, goal=GOAL):
    from tensordict import TensorDict

    return TensorDict({"state": x, "goal": goal}, batch_size=[len(x)])


ENTRIES = {
    "step": lambda lcs, x, u, *_: (lcs.step if isinstance(lcs, difflcs.LCSParams) else lcs)(x, u),
    "rollout": lambda lcs, x, u, *_: (lcs.rollout(x, u[:, None].expand(-1, 2, -1)),),
    "params": lambda lcs, x, u, *_: (lcs if isinstance(lcs, difflcs.LCSParams) else lcs.params()).step(x, u),
    "violation": lambda lcs, x, u, y, _: (difflcs.violation_loss(lcs, x, u, y),),
    "violation of each": lambda lcs, x, u, y, _: (difflcs.violation_loss(lcs, x, u, y, "auto", reduction="none"),),
    "prediction": lambda lcs, x, u, y, _: (difflcs.prediction_loss(lcs, x, u, y),),
    "layer": lambda lcs, x, u, y, goal: plans(layer(lcs)(x, goal)),
    "call of a layer": lambda lcs, x, u, y, goal: plans(layer(difflcs.LCSModel(4, 2, 3))(x, goal, lcs=lcs)),
    "policy": lambda lcs, x, u, y, goal: (policy_of(lcs).solve(observed(x, goal))["loc"],),
}


class Entry(nn.Module):
    def __init__(self, model, function):
        super().__init__()
        self.model, self.function = model, function

    def forward(self):
        return self.function(self.model)


def value_and_gradient(outputs, leaves):
    outputs = [v for v in outputs if v.requires_grad]
    total = sum((v * draw(*v.shape, seed=i).to(v)).sum() for i, v in enumerate(outputs))
    return [*outputs, *torch.autograd.grad(total, leaves, materialize_grads=True)]


every_tool = pytest.mark.parametrize("tool", TOOLS)


@every_tool
@pytest.mark.parametrize("entry", ENTRIES)
def test_every_entry_point_has_the_value_and_gradient_of_the_matrices_as_they_are(tool, entry):
    model = make(tool)
    leaves = {f"model.{k}": (p + 0.01).detach().requires_grad_() for k, p in model.named_parameters()}
    ways = [lambda m: ENTRIES[entry](m, *DATA), lambda m: ENTRIES[entry](right(m), *DATA)]
    for replaced in (False, True, False):
        of = list(leaves.values() if replaced else model.parameters())
        outputs = [functional_call(Entry(model, way), leaves, ()) if replaced else way(model) for way in ways]
        torch.testing.assert_close(*(value_and_gradient(v, of) for v in outputs))
        stir(model)


@every_tool
def test_jacobians_of_a_policy_are_those_of_its_actions(tool):
    model, data = make(tool), observed()
    of, policy = list(model.parameters()), policy_of(model)
    for _ in range(2):
        for _ in range(2):  # the second plan is made with what the first has prepared
            torch.testing.assert_close(policy.act(observed())["loc"], layer(right(model))(X, GOAL).action.detach())
        data["guess"] = policy.act(observed())["plan"]
        guess = Primal(*(data["guess"][name] for name in ("x", "u", "lam")))
        rows = layer(right(model))(X, GOAL, guess=guess).action.flatten()
        rows = [torch.autograd.grad(v, of, retain_graph=True, materialize_grads=True) for v in rows]
        expected = torch.stack([torch.cat([g.flatten() for g in row]) for row in rows]).view(4, 2, -1) / 0.5
        torch.testing.assert_close(policy.jacobian(data), expected)
        stir(model)


@every_tool
def test_controllers_and_files_hold_the_matrices_as_they_are(tool, tmp_path):
    model, scales = make(tool), difflcs.suggest_scales(X, U, NEXT)
    for _ in range(2):
        expected = right(model)
        with torch.no_grad():
            model.save_pretrained(tmp_path)
        saved = difflcs.LCSModel.from_pretrained(tmp_path)
        assert saved.c.requires_grad
        for name, value in saved.params().tensors().items():
            torch.testing.assert_close(value, getattr(expected, name))
        for given, system in ((model, expected), (ScaledLCS(model, scales), scales.params(expected))):
            actions = [layer(lcs).controller().step(X[0], GOAL[0]) for lcs in (given, system)]
            torch.testing.assert_close(*map(torch.from_numpy, actions))
        stir(model)


COST, ROWS = ("Q", "R", "Q_final", "goal_to_q", "goal_to_q_final", "goal_stage", "goal_final"), ("G", "g", "weight")
FIELDS = {
    "Q": torch.diag(torch.tensor([20.0, 20.0, 0.0, 0.0])).double(),
    "R": 0.2 * torch.eye(2).double() + 0.05,
    "goal_to_q": -20 * torch.eye(4, 2).double() + 0.1,
    "goal_stage": 20 * torch.eye(2).double() + 0.1,
    "G": draw(2, 4, seed=5),
    "g": draw(2, seed=6),
    "weight": 1 + draw(2, seed=7).abs(),
    "u_max": torch.tensor([0.2, 0.4]).double(),
    "stages": torch.tensor([[0.2, 0.4], [0.3, 0.1], [0.3, 0.5]]).double(),
}
FIELDS |= {"Q_final": FIELDS["Q"], "goal_to_q_final": FIELDS["goal_to_q"], "goal_final": FIELDS["goal_stage"]}


def problem(values, staged):
    limits = {"u_min": None, "u_max": None, "bounds": difflcs.StageBounds(-1.0, values["stages"])} if staged else {}
    rows = difflcs.LinearConstraints(values["G"], values["g"], weight=values["weight"])
    cost = difflcs.GoalCost(*(values[name] for name in COST))
    return layer(make(), **({"u_max": values["u_max"], "cost": cost, "constraints": rows} | limits))


TWO = {"parametrize": enlarge, "prune": lambda part, name: prune.l1_unstructured(part, name, 1)}


@pytest.mark.parametrize(
    ("name", "tool"), [(name, tool) for name in FIELDS for tool in TWO if (name, tool) != ("weight", "prune")]
)
@pytest.mark.filterwarnings("ignore::difflcs.errors.DegenerateWarning")  # of an action that just touches its bound
def test_costs_bounds_and_constraints_too(name, tool):
    staged, raw = name == "stages", nn.Parameter(FIELDS[name].clone())
    mpc, field = problem(FIELDS | {name: raw}, staged), "u_max" if staged else name
    part = mpc.cost if name in COST else mpc.constraints if name in ROWS else mpc.bounds if staged else mpc
    TWO[tool](part, field)
    for _ in range(2):
        expected = problem(FIELDS | {name: matrix(part, field)}, staged)
        found, wanted = (value_and_gradient(plans(each(X, GOAL)), [raw]) for each in (mpc, expected))
        torch.testing.assert_close(found, wanted)
        actions = [each.controller().step(X[0], GOAL[0]) for each in (mpc, expected)]
        torch.testing.assert_close(*map(torch.from_numpy, actions))
        with torch.no_grad():
            for _ in range(2):
                torch.testing.assert_close(mpc(X, GOAL).u, wanted[0])
            raw.mul_(1.2)


@pytest.mark.parametrize("tool", TWO)
def test_parts_of_a_module_that_are_never_called(tool):
    discs = [ContactLCS(PlanarPushing(Circle(0.1), 0.02, n_discs=2, friction=0.5), ("friction",)) for _ in range(2)]
    changed, plain = (lcs.change for lcs in discs)
    TWO[tool](changed, "friction")
    (raw,) = changed.parameters()
    x = torch.tensor([0.0, 0.0, 0.3, -0.13, 0.0, 0.01, 0.13]).double()
    for _ in range(2):
        with torch.no_grad():
            raw.add_(torch.tensor([0.2, -0.1]))
            plain.friction.copy_(matrix(changed, "friction"))
        values = [difflcs.violation_loss(lcs, x, draw(4), x + 0.01, "auto") for lcs in discs]
        torch.testing.assert_close(*values)
        found, expected = (torch.autograd.grad(v, p)[0] for v, p in zip(values, (raw, plain.friction), strict=True))
        torch.testing.assert_close(found, expected * (matrix(changed, "friction") / raw).detach())


def test_what_a_training_keeps_can_be_read(tmp_path):
    from difflcs.rl.learning import dynamics, mlp, trainer

    state = trainer.learned_state(make("prune"))
    difflcs.LCSModel.from_config(state["settings"], state["plain"], "checkpoint")
    network = mlp.MLPController(lambda *_: X, 4, -torch.ones(2), torch.ones(2), 8, 10)
    parametrizations.weight_norm(network.layers[0])
    trainer.save_learned(network, tmp_path, "network")
    again = mlp.MLPController.from_config(*_storage.load_record(tmp_path, "network"), "network", lambda *_: X)
    torch.testing.assert_close(again.mean(X, GOAL, X[:, 0]), network.mean(X, GOAL, X[:, 0]))
    ensemble = dynamics.Ensemble(4, 2, 2, 8)
    prune.l1_unstructured(ensemble.weights, "0", 3)
    with pytest.raises(InvalidInputError, match="ensemble: expected weights that are parameters"):
        ensemble.fit(X, U, NEXT, epochs=1, minibatch=2, learning_rate=0.1, generator=torch.Generator())


@pytest.mark.parametrize("name", ["C", "Q"])
def test_hooks_that_nobody_knows_are_refused_where_they_compute_a_matrix(name):
    model, cost = difflcs.LCSModel(4, 2, 3), difflcs.GoalCost.reach(4, 2)
    part, mpc = model if name == "C" else cost, layer(model, cost=cost)
    part.register_forward_pre_hook(lambda *_: None)  # of a profiler, say
    mpc(X, X)
    value = getattr(part, name).detach()
    delattr(part, name)
    setattr(part, name, value)
    uses = [lambda: mpc(X, X), mpc.controller]
    for use in [*uses, lambda: difflcs.violation_loss(model, X, U, NEXT), model.params] if part is model else uses:
        refuse(InvalidInputError, rf"attributes in the place of \['{name}'\].*parametrize", use)


def test_an_average_is_refused_where_its_module_is_meant():
    refuse(DTypeError, "lcs: expected", layer, AveragedModel(difflcs.LCSModel(4, 2, 3)))


def test_a_normalisation_that_moves_with_every_look_gives_one_matrix_a_call():
    model = of_each(parametrizations.spectral_norm)(difflcs.LCSModel(4, 2, 3, init_scale=0.4)).train()
    F = model.params().F.detach()
    assert float(torch.linalg.eigvalsh(F + F.mT).min()) >= 2 * model.stiffness - 1e-12


MORE = {
    "lcp": lambda lcs, x, *_: difflcs.solve_lcp(lcs.params().F, x[:, :3])[:2],
    "gap": lambda lcs, x, u, *_: (lcs.params().gap(x, u), lcs.params().next_state(x, u, x[:, :3])),
    "F": lambda lcs, *_: (lcs.F,),
    "reference": lambda lcs, x, *_: plans(layer(lcs)(x, reference=x[:, None, :2].expand(-1, HORIZON + 1, -1))),
    "cost": lambda lcs, x, u, y, goal: (layer(lcs).cost(lcs.B).q, layer(lcs).cost.stage(x, u, lcs.B)),
    "scaled": lambda lcs, x, u, y, goal: plans(layer(ScaledLCS(lcs, difflcs.suggest_scales(x, u, y)))(x, goal)),
}


@pytest.mark.parametrize(
    ("tool", "dtype"), [("none", "bfloat16"), ("none", "float16"), ("orthogonal", "bfloat16"), ("prune", "float16")]
)
@pytest.mark.parametrize("entry", ENTRIES | MORE)
def test_autocast_changes_no_number(entry, tool, dtype):
    model, function = make(tool, torch.float32), (ENTRIES | MORE)[entry]
    data, of = [v.float() for v in DATA], list(model.parameters())
    expected = value_and_gradient(function(model, *data), of)
    with torch.autocast("cpu", getattr(torch, dtype)):
        outputs = function(model, *data)
        found = value_and_gradient(outputs, of) if tool == "none" else None  # steps back through a tool are torch's
    torch.testing.assert_close(found or value_and_gradient(outputs, of), expected)


gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU that torch can use")


@gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("entry", ENTRIES | MORE)
def test_on_a_gpu_values_and_gradients_are_those_of_the_cpu(entry, dtype):
    model, function, data = make(dtype=dtype), (ENTRIES | MORE)[entry], [v.to(dtype) for v in DATA]
    expected = value_and_gradient(function(model, *data), list(model.parameters()))
    model.cuda()
    with torch.device("cuda"):
        outputs = function(model, *(v.cuda() for v in data))
    found = value_and_gradient(outputs, list(model.parameters()))
    assert all(v.is_cuda for v in (*outputs, *found))
    torch.testing.assert_close([v.cpu() for v in found], expected)


@gpu
def test_on_a_gpu_physics_and_reports_are_those_of_the_cpu():
    x = torch.tensor([0.0, 0.0, 0.3, -0.13, 0.0, 0.01, 0.13]).double() + 0.01 * draw(20, 7)
    u, learned = 0.01 * draw(20, 4), ("friction", "gain", "outline")
    physics = PlanarPushing(Circle(0.1), 0.02, n_discs=2, friction=0.5)
    found = []
    for to in (lambda v: v, lambda v: v.cuda()):
        lcs, *rows = map(to, (ContactLCS(physics, learned), x, u, x + 0.01))
        report, (left, _) = difflcs.fit_report(lcs, *rows), difflcs.Transitions(*rows).split(0.5)
        loss = difflcs.violation_loss(lcs, *left, "auto")
        found.append([loss, report.gain, *torch.autograd.grad(loss, list(lcs.parameters()))])
    assert all(v.is_cuda for v in found[1])
    torch.testing.assert_close([v.cpu() for v in found[1]], found[0])
