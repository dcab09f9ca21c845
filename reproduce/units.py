"""The units of work: one training of one method on one object with one seed, and what decides its result.

This is the only file of reproduce/ that trains: it knows the settings of the paper's recipe, and calls `difflcs.rl`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

from difflcs.errors import InvalidInputError
from difflcs.rl import RunDirectory, TrainConfig, get_method, get_task, train

Artefact = Literal["table1", "curves", "transfer"]
Object = Literal["sugar_box", "fish_can", "mug", "wrench", "clamp", "banana"]
Method = Literal["lcs-rl", "violation", "ppo", "pddm"]
Recipe = Literal["ours", "paper"]
PresetName = Literal["paper", "quick", "smoke"]

Names = Sequence[str]

OBJECTS: Names = get_args(Object)
"""The objects of Table I, in its order."""
_BOTH = get_args(Recipe)
METHODS: Mapping[str, Names] = {"lcs-rl": _BOTH, "violation": _BOTH, "ppo": ("paper",), "pddm": ("none",)}
"""Methods of the figures → their recipes. Ours is what the library does by default, the paper's is `PAPER`."""
PAPER: Mapping[str, Any] = {
    "warmup_minutes": 6.0,
    "warmup": {"noise": 0.0},
    "ppo": {"update": "adam", "steps": 20, "minibatch": None},
    "models": {"iterations": 0},
}
"""Settings of the paper, for every method those that it has."""
COMPARED = ("violation", "lcs-rl")
"""The methods of Table I."""
TRANSFER = {"scratch": "lcs-rl", "cube": "ppo"}
"""Starts → methods of the transfer figure. From scratch is from a random model; from the final LCS-RL model of the cube
with the same seed it is the main phase alone: a warm-up on little data would first undo what PPO has taught."""
FIRST_SEED = 10
"""Seed of the first run of everything. The settings were tuned on the seeds 0 to 4, with other goals."""


@dataclass(frozen=True)
class Preset:
    """How much is computed."""

    name: str
    """Also that of its file of results."""
    seeds: int
    """Runs per method and object, with the seeds FIRST_SEED, FIRST_SEED + 1, …."""
    goals: int
    """Of every evaluation."""
    evaluate_at: tuple[float, ...] = (0.0, 6.0, 12.0, 18.0, 24.0, 30.0)
    """Minutes of data at which to evaluate, the same for every unit; the last is the end."""
    smoke: bool = False
    """Train on so little that nothing is learned."""


PRESETS: Mapping[str, Preset] = {
    "paper": Preset("paper", seeds=10, goals=1000),
    "quick": Preset("quick", seeds=1, goals=100),
    "smoke": Preset("smoke", seeds=1, goals=4, evaluate_at=(0.0, 0.2, 0.5), smoke=True),
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
        return None if self.start == "scratch" else Unit("cube", "lcs-rl", "ours", self.seed)

    def __str__(self) -> str:
        recipe = ", the paper's recipe" if self.recipe == "paper" else ""
        start = "" if self.start == "scratch" else f", from the {self.start}'s model"
        return f"{self.task} {self.method}{recipe}{start}, seed {self.seed}"


def matrix(artefacts: Names, seeds: int, objects: Names = (), methods: Names = (), recipes: Names = ()) -> list[Unit]:
    """The units that artefacts need, each once: the first seeds of everything, and what a unit starts from, come first.

    None of `artefacts`, `objects` (the cube is not one), `methods` stands for all; of `recipes` for both on the cube
    and ours on the objects.
    """
    artefacts, objects, methods = artefacts or get_args(Artefact), objects or OBJECTS, methods or list(METHODS)
    found: list[Unit] = []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        if "curves" in artefacts:
            for method in reversed([name for name in METHODS if name in methods]):  # PDDM takes longest
                known = METHODS[method]  # one recipe alone is in the figure whatever is chosen
                found += [Unit("cube", method, r, seed) for r in known if r in (recipes or known) or len(known) == 1]
        for task in [name for name in OBJECTS if name in objects]:
            if "table1" in artefacts:
                chosen = [method for method in COMPARED if method in methods]
                found += [Unit(task, method, recipe, seed) for method in chosen for recipe in recipes or ["ours"]]
            if "transfer" in artefacts and "lcs-rl" in methods:
                found += [Unit(task, method, "ours", seed, start) for start, method in TRANSFER.items()]
    if not found:
        raise InvalidInputError(
            f"units: expected at least one, got none from {artefacts} with {methods}; choose others"
        )
    return list(dict.fromkeys(one for unit in found for one in (unit.init, unit) if one is not None))


def config_of(unit: Unit, preset: Preset) -> TrainConfig:
    """All settings of a unit: the library's defaults but for the recipe, and the preset's minutes and goals."""
    method = get_method(unit.method)()
    method = _changed(method, PAPER) if unit.recipe == "paper" else method
    return TrainConfig(
        task=unit.task,
        method=method.smoke() if preset.smoke else method,
        minutes=preset.evaluate_at[-1],
        seed=unit.seed,
        evaluate_at=preset.evaluate_at[:-1],
        evaluate_goals=preset.goals,
        final_goals=preset.goals,
    )


def _changed(settings: Any, changes: Mapping[str, Any]) -> Any:
    """The settings with others in place of those that they have; a mapping changes a group of settings."""
    known = {name: new for name, new in changes.items() if hasattr(settings, name)}
    groups = {name: _changed(getattr(settings, name), new) for name, new in known.items() if isinstance(new, Mapping)}
    return replace(settings, **known | groups)


def describe_object(task: str) -> Mapping[str, Any]:
    """What is pushed on this machine, in JSON types: where its shape comes from, the hash of its mesh, its mass."""
    spec = get_task(task)
    env = spec.make_env()
    try:
        return spec.describe(env)
    finally:
        env.close()


def key_of(unit: Unit, preset: Preset, objects: Mapping[str, Mapping[str, Any]]) -> str:
    """Identifies the result of a unit, but for the seed; a result with another key is stale.

    It is a hash of settings, version of the method, object (task → `describe_object`), and key of what it starts from.
    """
    config = config_of(unit, preset)
    settings = config.to_json()
    del settings["seed"]
    init = key_of(unit.init, preset, objects) if unit.init else None
    parts = json.dumps([settings, config.method.version, dict(objects[unit.task]), init], sort_keys=True)
    return hashlib.sha256(parts.encode()).hexdigest()[:12]


def train_unit(unit: Unit, preset: Preset, out: Path, init: Path | None) -> RunDirectory:
    """Train a unit on one core, from the run directory `init` or from scratch; or go on with what is in `out`."""
    resume = (out / "config.json").is_file()
    make_envs = partial(get_task(unit.task).make_envs, threads=1)
    return train(config_of(unit, preset), out, make_envs=make_envs, init=None if resume else init, resume=resume)
