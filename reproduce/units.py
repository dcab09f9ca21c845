"""Units of work: one training of one method on one object with one seed, and all that decides its result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

from recipes import ABLATIONS, RECIPES, Protocol, Recipe, changed, changed_task

from difflcs.errors import InvalidInputError
from difflcs.rl import RunDirectory, TaskSpec, TrainConfig, get_method, get_task, train
from difflcs.rl.runs.training import Reporter

Artefact = Literal["table1", "masses", "curves", "transfer", "ablations"]
Object = Literal["sugar_box", "fish_can", "mug", "wrench", "clamp", "banana"]
Method = Literal["lcs-rl", "violation", "ppo", "pddm"]
PresetName = Literal["paper", "quick", "smoke"]

Names = Sequence[str]

OBJECTS: Names = get_args(Object)
"""The objects of Table I, in its order."""
METHODS: Mapping[str, Names] = {
    "lcs-rl": ("ours", "paper"),
    "violation": ("ours", "paper", "jin-posa"),
    "ppo": ("paper",),
    "pddm": ("ours", "authors"),
}
"""Methods of the figures → their recipes, see `recipes.RECIPES`."""
COMPARED = ("violation", "lcs-rl")
"""The methods of Table I."""
MASSES = ("paper", "light")
"""Recipes that differ in the mass of the objects alone."""
TRANSFER = {"scratch": "lcs-rl", "cube": "ppo"}
"""Starts → methods of the transfer figure. From scratch is from a random model; from the final LCS-RL model of the cube
with the same seed it is the main phase alone: a warm-up on little data would first undo what PPO has taught."""
ABLATED: Mapping[str, tuple[str, str]] = {
    **{name: ("lcs-rl", name) for name in ABLATIONS},
    "no-warm-up": ("ppo", "ours"),
}
"""Ablations → method and recipe."""
ABLATION_TASKS, ABLATION_SEEDS = ("cube", "banana"), 8
"""Tasks for the ablations of LCS-RL, and their number of seeds."""
FIRST_SEED = 1000
"""Seed of the first run of everything. Nothing was ever chosen by this seed or a later one."""


@dataclass(frozen=True)
class Preset:
    """Amounts to compute."""

    name: str
    """Also that of its file of results."""
    seeds: int
    """Runs per method and object, with the seeds FIRST_SEED, FIRST_SEED + 1, …."""
    goals: int
    """Of every evaluation on the way."""
    final_goals: int
    """Of the last evaluation, and of that before any data."""
    evaluate_at: tuple[float, ...] = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 25.0, 30.0)
    """Minutes of data at which to evaluate; the last is the end."""
    smoke: bool = False
    """Train on so little that nothing is learned."""
    recipes: Names = ()
    """Recipes on the objects, if none are asked for; none: all."""
    slow: Preset | None = None
    """The same for `SLOW`, whose evaluations take a hundred times as long as those of the others."""

    def of(self, method: str) -> Preset:
        """Return the amounts for a method."""
        return self.slow if self.slow is not None and method in SLOW else self

    def with_amounts(self, seeds: int | None, goals: int | None) -> Preset:
        """Replace the numbers of seeds and goals of everything by others, unless they are None."""
        slow = self.slow and self.slow.with_amounts(seeds, goals)
        amounts = {"goals": goals or self.goals, "final_goals": goals or self.final_goals}
        return replace(self, seeds=seeds or self.seeds, slow=slow, **amounts)


SLOW = ("pddm",)
_FEW = (2.0, 6.0, 10.0, 20.0, 30.0)
PRESETS: Mapping[str, Preset] = {
    "paper": Preset("paper", 10, 300, 1000, slow=Preset("paper", 5, 300, 300, _FEW)),
    "quick": Preset("quick", 1, 100, 100, recipes=("ours",), slow=Preset("quick", 1, 100, 100, _FEW)),
    "smoke": Preset("smoke", 1, 4, 4, (0.0, 0.2, 0.5), smoke=True, recipes=("ours",)),
}


@dataclass(frozen=True, order=True)
class Unit:
    """One training: a method by one of its recipes, on "cube" or one of `OBJECTS`, from one of the starts."""

    task: str
    method: str
    recipe: str
    seed: int
    start: str = "scratch"

    @property
    def init(self) -> Unit | None:
        """The unit whose final model this one starts from."""
        return None if self.start == "scratch" else Unit("cube", "lcs-rl", self.recipe, self.seed)

    @property
    def changes(self) -> Recipe:
        """Recipe of this unit."""
        return RECIPES[self.recipe]

    @property
    def protocols(self) -> Sequence[Protocol]:
        """Names of the deployments in which its models are evaluated."""
        return self.changes.protocols.get(self.method, ("full",))

    @property
    def spec(self) -> TaskSpec:
        """The task, with what the recipe changes of it."""
        return changed_task(self.task, self.changes.task)

    def __str__(self) -> str:
        recipe = "" if self.recipe == "ours" else f", {self.changes.label}"
        start = "" if self.start == "scratch" else f", from the {self.start}'s model"
        return f"{self.task} {self.method}{recipe}{start}, seed {self.seed}"


def matrix(
    artefacts: Names, preset: Preset, objects: Names = (), methods: Names = (), recipes: Names = ()
) -> list[Unit]:
    """List the units that artefacts need, each once and after the one it starts from: the most important first.

    These are Table I; then masses, curves, transfer, ablations; then what is slow. Of each the first seeds come first.
    None of `artefacts`, `objects` (the cube is not one), `methods` stands for all; of `recipes` for all on the cube and
    those of the preset on the objects.
    """
    artefacts, tasks = artefacts or get_args(Artefact), [name for name in OBJECTS if name in (objects or OBJECTS)]
    some = recipes or preset.recipes

    def wanted(method: str, chosen: Names, known: Names = ()) -> list[str]:
        known = known or METHODS[method]
        return [name for name in known if (not chosen or name in chosen) and method in (methods or METHODS)]

    def table1(seed: int) -> Iterator[Unit]:
        for task in tasks:
            yield from (Unit(task, method, r, seed) for method in COMPARED for r in wanted(method, some))

    def masses(seed: int) -> Iterator[Unit]:
        for task in tasks:
            yield from (Unit(task, "lcs-rl", r, seed) for r in wanted("lcs-rl", recipes, MASSES))

    def curves(seed: int) -> Iterator[Unit]:
        yield from (Unit("cube", method, r, seed) for method in METHODS for r in wanted(method, recipes))

    def transfer(seed: int) -> Iterator[Unit]:
        for task in tasks:
            for recipe in wanted("lcs-rl", some):
                yield from (Unit(task, method, recipe, seed, start) for start, method in TRANSFER.items())

    def ablations(seed: int) -> Iterator[Unit]:
        if seed < FIRST_SEED + ABLATION_SEEDS and (not recipes or "ours" in recipes):
            for task in (name for name in ABLATION_TASKS if name in ("cube", *tasks)):
                yield from (Unit(task, "lcs-rl", r, seed) for r in wanted("lcs-rl", (), ["ours"]))
                yield from (Unit(task, m, r, seed) for m, r in ABLATED.values() if wanted(m, (), [r]))

    needed: list[Unit] = []
    every = {"table1": table1, "masses": masses, "curves": curves, "transfer": transfer, "ablations": ablations}
    for name, units in every.items():
        if name in artefacts:
            for seed in range(FIRST_SEED, FIRST_SEED + max(preset.seeds, preset.of("pddm").seeds)):
                needed += (unit for unit in units(seed) if seed < FIRST_SEED + preset.of(unit.method).seeds)
    if not needed:
        raise InvalidInputError(
            f"units: expected at least one, got none from {artefacts} with {methods} and {recipes}; choose others"
        )
    needed.sort(key=lambda unit: unit.method in SLOW)
    return list(dict.fromkeys(one for unit in needed for one in (unit.init, unit) if one is not None))


def config_of(unit: Unit, preset: Preset) -> TrainConfig:
    """Build all settings of a unit: the library's defaults, the recipe's changes, the preset's minutes and goals.

    A unit that is not evaluated under the full bounds has no evaluations in its training, see `deployment`.
    """
    config = schedule_of(unit, preset)
    return config if "full" in unit.protocols else replace(config, evaluate_at=(), final_goals=0)


def schedule_of(unit: Unit, preset: Preset) -> TrainConfig:
    """Build the settings of a unit with all evaluations."""
    newest = changed(get_method(unit.method)(), {"ppo": {"gain": None}})  # as in the paper, whatever the recipe
    method, preset = changed(newest, unit.changes.settings), preset.of(unit.method)
    return TrainConfig(
        task=unit.task,
        method=method.smoke() if preset.smoke else method,
        minutes=preset.evaluate_at[-1],
        seed=unit.seed,
        evaluate_at=preset.evaluate_at[:-1],
        evaluate_goals=preset.goals,
        final_goals=preset.final_goals,
    )


def describe_object(task: str) -> Mapping[str, Any]:
    """Describe the object on this machine, in JSON types: the origin of its shape, the hash of its mesh, its mass."""
    spec = get_task(task)
    with closing(spec.make_env()) as env:
        return spec.describe(env)


def key_of(unit: Unit, preset: Preset, objects: Mapping[str, Mapping[str, Any]]) -> str:
    """Compute the key of a unit's result, without the seed; a result with another key is stale.

    It is a hash of settings, version of the method, object (task → `describe_object`), what the recipe changes of the
    task, ways of evaluating, and key of what it starts from.
    """
    config = schedule_of(unit, preset)
    settings = config.to_json()
    del settings["seed"]
    init = key_of(unit.init, preset, objects) if unit.init else None
    task = [dict(objects[unit.task]), dict(unit.changes.task), list(unit.protocols)]
    parts = json.dumps([settings, config.method.version, *task, init], sort_keys=True)
    return hashlib.sha256(parts.encode()).hexdigest()[:12]


def train_unit(
    unit: Unit, preset: Preset, out: Path, init: Path | None = None, reporter: Reporter | None = None
) -> RunDirectory:
    """Train a unit on one core, from the run directory `init` or from scratch; or go on with what is in `out`."""
    resume, spec = (out / "config.json").is_file(), unit.spec
    make_envs = partial(spec.make_envs, threads=1)
    start = None if resume else init
    config = config_of(unit, preset)
    return train(config, out, task=spec, make_envs=make_envs, init=start, resume=resume, reporter=reporter)
