"""The recipes: what each changes of a method's settings and of its task. Ours changes nothing: it is the default.

But in all of them the newest policy of PPO is handed out, with no test, see `units.schedule_of`.

Names and labels of all of them are here, so that a change of the paper's recipe is one change in one place.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

from difflcs.cost import GoalCost
from difflcs.rl import TaskSpec, get_method, get_task

Chosen = Literal["ours", "paper", "light", "jin-posa", "authors"]
"""Recipes to choose from on the command line."""
Protocol = Literal["full", "support", "task"]
"""How a model is deployed in an evaluation, see `PROTOCOLS`."""
PROTOCOLS: Mapping[Protocol, str] = {
    "full": "with full bounds",
    "support": "in its support",
    "task": "with the paper's MPC and full bounds",
}
"""full: as it was trained, with the full ±15 mm; LCS-RL in our recipe stays by itself within the actions that its model
was fitted to. support: the same within the bounds of its last episodes, as Jin and Posa deploy. task: with horizon and
cost of the paper and the full bounds, whatever it was trained with."""


@dataclass(frozen=True)
class Recipe:
    """Differences from the defaults of the library."""

    label: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Of the method, where it has them; a mapping changes a group of settings."""
    task: Mapping[str, float] = field(default_factory=dict)
    """Of the task: `horizon`, `action_weight` of the MPC, `sparse_penalty` of the reward, `object_mass` [kg]."""
    protocols: Mapping[str, Sequence[Protocol]] = field(default_factory=dict)
    """Method → the ways in which its models are evaluated; "full" alone if it is not here."""


_ADAM = {"update": "adam", "steps": 20, "minibatch": None}
_FIXED = get_method("lcs-rl")().ppo.covariance == "fixed"  # pyright: ignore[reportAttributeAccessIssue]
PAPER = Recipe(
    "the paper's recipe",
    # Learned Σ and a stochastic policy in both phases are the paper's; the size of the noise is that with which the
    # policy of the main phase starts. Contacts and horizon are those of the prior work, whose algorithm the warm-up is.
    # Episodes of an iteration are twice ours: without model rollouts the gradient of 30 is too noisy.
    settings={
        "n_lam": 5,
        "warmup_minutes": 6.0,
        "warmup": {"noise": 0.005, "keep_support": False},
        "ppo": {**_ADAM, "rollouts": 60, "covariance": "full"},
        "models": {"iterations": 0},
    },
    task={"horizon": 5},
    protocols={"violation": ["full", "support"]},
)
"""The paper's algorithm. What it leaves open is as in the prior work, or as ours."""
LIGHT = replace(PAPER, label=f"{PAPER.label}, objects of 10 g", task={**PAPER.task, "object_mass": 0.01})
"""The same where every object is as light as the cube: the paper names no masses."""
JIN_POSA = Recipe(
    "as Jin & Posa",
    settings={"n_lam": 5, "warmup": {"noise": 0.0, "action_support": 0.9, "action_support_growth": 1.001}},
    task={"horizon": 5, "action_weight": 0.001},
    protocols={"violation": ["support", "task"]},
)
"""The prior work: its horizon, contacts, weight of the action, and action support (examples/trifinger_task2 of
wanxinjin/Task-Driven-Hybrid-Reduction); it plans in the same support when it is evaluated."""
ABLATIONS: Mapping[str, Recipe] = {
    "adam": Recipe("Adam instead of the natural gradient", {"ppo": _ADAM}),
    "no-models": Recipe("without model rollouts", {"models": {"iterations": 0}}),
    "no-support": Recipe("without the kept action support", {"warmup": {"keep_support": False}}),
    "one-action": Recipe("one action per imagined state", {"models": {"actions": 1}}),
    "sigma": Recipe("learned Σ" if _FIXED else "fixed Σ", {"ppo": {"covariance": "diagonal" if _FIXED else "fixed"}}),
    "no-penalty": Recipe("without the penalty of failed episodes", task={"sparse_penalty": 0.0}),
    "horizon-5": Recipe("horizon 5", task={"horizon": 5}),
}
"""LCS-RL in our recipe but for one part. Without warm-up it is the method "ppo" in our recipe."""
RECIPES: Mapping[str, Recipe] = {
    "ours": Recipe("our recipe", protocols={"violation": ["full", "support"]}),
    "paper": PAPER,
    "light": LIGHT,
    "jin-posa": JIN_POSA,
    "authors": Recipe("networks drawn anew, as its authors do", {"pddm": {"keep_networks": False}}),
    **ABLATIONS,
}
"""All recipes by their names."""


def changed(settings: Any, changes: Mapping[str, Any]) -> Any:
    """Replace settings by others; a mapping changes a group of settings."""
    known = {name: new for name, new in changes.items() if hasattr(settings, name)}
    groups = {name: changed(getattr(settings, name), new) for name, new in known.items() if isinstance(new, Mapping)}
    return replace(settings, **known | groups)


def changed_task(name: str, changes: Mapping[str, float]) -> TaskSpec:
    """Apply a recipe's changes to a task."""
    spec = get_task(name)
    if "horizon" in changes:
        spec = replace(spec, horizon=int(changes["horizon"]))
    if "object_mass" in changes:
        spec = replace(spec, env_kwargs={**spec.env_kwargs, "object_mass": changes["object_mass"]})
    if "action_weight" in changes:
        spec = replace(spec, make_cost=partial(_weighted, spec.make_cost, changes["action_weight"]))
    if "sparse_penalty" in changes:
        from difflcs_envs.trifinger.task import MOVE

        penalty = changes["sparse_penalty"]
        judge = replace(MOVE, sparse_penalty=penalty).judge
        kwargs = {**spec.env_kwargs, "sparse_penalty": penalty}
        spec = replace(spec, outcome=judge, failure_penalty=penalty, env_kwargs=kwargs)
    return spec


def _weighted(make_cost: Any, action_weight: float) -> GoalCost:
    cost = make_cost()
    cost.R.diagonal().fill_(2 * action_weight)  # of ½ uᵀ R u
    return cost
