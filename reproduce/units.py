"""The units of work: method × object × seed, each one training with its evaluations, and the key that identifies it.

Plain data and hashes; nothing here trains, and nothing here knows how units are distributed.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from difflcs.errors import InvalidInputError
from difflcs.rl.training import TrainConfig

OBJECTS = ("sugar_box", "fish_can", "mug", "wrench", "clamp", "banana")
"""The objects of Table I, in its order."""
METHODS = ("lcs-rl", "violation", "ppo", "pddm")
RECIPES = ("ours", "paper")
"""Ours: noise on the executed actions in the warm-up, imagined episodes in the main phase. The paper's: neither."""
STARTS = ("scratch", "cube")
"""What a training starts from: a random model, or the final LCS-RL model of the cube with the same seed."""
ARTEFACTS = ("table1", "curves", "transfer")
FIRST_SEED = 10
"""Seed of the first run of everything. The settings were tuned on the seeds 0 to 4, with other goals."""


@dataclass(frozen=True)
class Preset:
    """How much is computed.

    Attributes:
        name: its name, and that of its file of results.
        seeds: runs per method and object, with the seeds FIRST_SEED, FIRST_SEED + 1, ….
        goals: goals of every evaluation.
        evaluate_at: minutes of data at which to evaluate, the same for every unit; the last is the end.
        smoke: train on so little that nothing is learned.
    """

    name: str
    seeds: int
    goals: int
    evaluate_at: tuple[float, ...] = (0.0, 6.0, 12.0, 18.0, 24.0, 30.0)
    smoke: bool = False


PRESETS: Mapping[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset("smoke", seeds=1, goals=4, evaluate_at=(0.0, 0.2, 0.5), smoke=True),
        Preset("quick", seeds=1, goals=100),
        Preset("paper", seeds=10, goals=1000),
    )
}


@dataclass(frozen=True, order=True)
class Unit:
    """One training.

    Attributes:
        task: "cube" or one of `OBJECTS`.
        method: one of `METHODS`.
        recipe: one of `RECIPES`; "none" for PDDM, which has neither phase.
        seed: of the training.
        start: one of `STARTS`.
    """

    task: str
    method: str
    recipe: str
    seed: int
    start: str = "scratch"

    @property
    def init(self) -> Unit | None:
        """The unit whose model this one starts from."""
        return None if self.start == "scratch" else Unit("cube", "lcs-rl", "ours", self.seed)

    def __str__(self) -> str:
        recipe = ", the paper's recipe" if self.recipe == "paper" else ""
        start = "" if self.start == "scratch" else f", from the {self.start}'s model"
        return f"{self.task} {self.method}{recipe}{start}, seed {self.seed}"


def transfer(task: str, seed: int, start: str) -> Unit:
    """A training on an object that is compared in the transfer figure.

    From scratch it is LCS-RL. From the cube's model it is the main phase alone: that model takes the place of the
    warm-up, whose violation loss on little data would first undo what PPO has taught it.
    """
    scratch = Unit(task, "lcs-rl", "ours", seed)
    return scratch if start == "scratch" else Unit(task, "ppo", "ours", seed, start)


def choose(name: str, chosen: Sequence[str], known: Iterable[str]) -> tuple[str, ...]:
    """The chosen names in the known order; all of them if none is chosen.

    Raises:
        InvalidInputError: a name is unknown.
    """
    known = tuple(known)
    for word in chosen:
        if word not in known:
            raise InvalidInputError(f"{name}: expected some of {', '.join(known)}, got {word!r}; choose among these")
    return tuple(word for word in known if word in chosen) if chosen else known


def get_preset(name: str, seeds: int | None = None, goals: int | None = None) -> Preset:
    """Look a preset up, with other numbers of seeds or goals where they are given.

    Raises:
        InvalidInputError: no preset has this name, or a number is below one.
    """
    if name not in PRESETS:
        raise InvalidInputError(f"preset: expected one of {', '.join(PRESETS)}, got {name!r}; choose one of these")
    for label, number in (("seeds", seeds), ("goals", goals)):
        if number is not None and number < 1:
            raise InvalidInputError(f"{label}: expected at least 1, got {number}; pass a larger number")
    preset = PRESETS[name]
    return replace(preset, seeds=seeds or preset.seeds, goals=goals or preset.goals)


def matrix(
    artefacts: Sequence[str],
    seeds: int,
    objects: Sequence[str] = (),
    methods: Sequence[str] = (),
    recipes: Sequence[str] = (),
) -> list[Unit]:
    """The units that the artefacts need, each once, ordered so that the first seeds of everything come first.

    Args:
        artefacts: some of `ARTEFACTS`; none for all.
        seeds: runs per method and object.
        objects: some of `OBJECTS`; none for all. The cube is not one of them.
        methods: some of `METHODS`; none for all.
        recipes: some of `RECIPES`; none for what the artefact shows by default: both on the cube, ours on the objects.

    Returns:
        The units. What a unit starts from comes before it, whatever is chosen.

    Raises:
        InvalidInputError: a name is unknown, or nothing is left.
    """
    artefacts, objects = choose("artefacts", artefacts, ARTEFACTS), choose("objects", objects, OBJECTS)
    methods = choose("methods", methods, METHODS)
    on_cube, on_objects = choose("recipes", recipes, RECIPES), choose("recipes", recipes or ["ours"], RECIPES)
    found: list[Unit] = []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        if "curves" in artefacts:
            for method in reversed(methods):  # PDDM takes longest: a core is left to it
                found += [Unit("cube", method, recipe, seed) for recipe in _recipes(method, on_cube)]
        if "table1" in artefacts:
            for task in objects:
                for method in (m for m in methods if m in ("lcs-rl", "violation")):
                    found += [Unit(task, method, recipe, seed) for recipe in on_objects]
        if "transfer" in artefacts and "lcs-rl" in methods:
            for task in objects:
                found += [transfer(task, seed, start) for start in STARTS]
    if not found:
        raise InvalidInputError(
            f"units: expected at least one, got none from artefacts {', '.join(artefacts)} with methods "
            f"{', '.join(methods)}; choose other methods"
        )
    ordered: dict[Unit, None] = {}
    for unit in found:
        if unit.init is not None:
            ordered[unit.init] = None
        ordered[unit] = None
    return list(ordered)


def _recipes(method: str, chosen: Sequence[str]) -> Sequence[str]:
    # PPO without a warm-up is the paper's baseline.
    return chosen if method in ("lcs-rl", "violation") else ("paper" if method == "ppo" else "none",)


def config_of(unit: Unit, preset: Preset) -> TrainConfig:
    """The complete settings of a unit: the library's defaults but for the minutes and goals of the preset."""
    config = TrainConfig(
        task=unit.task,
        method=unit.method,
        minutes=30.0,
        seed=unit.seed,
    )
    if unit.recipe == "paper":
        config = replace(
            config,
            warmup_minutes=6.0,
            warmup=replace(config.warmup, noise=0.0),
            ppo=replace(config.ppo, natural=False, steps=20, minibatch=None),
            imagination=replace(config.imagination, iterations=0),
        )
    config = config.smoke() if preset.smoke else config
    return replace(
        config,
        minutes=preset.evaluate_at[-1],
        evaluate_at=preset.evaluate_at[:-1],
        evaluate_goals=preset.goals,
        final_goals=preset.goals,
    )


_UNUSED: Mapping[str, tuple[str, ...]] = {
    "lcs-rl": ("pddm", "mlp"),
    "violation": ("pddm", "mlp", "ppo", "imagination", "warmup_minutes"),
    "ppo": ("pddm", "mlp", "warmup", "warmup_minutes"),
    "pddm": ("mlp", "warmup", "warmup_minutes", "ppo", "imagination", "n_lam", "stiffness", "init_scale", "backend"),
}
"""Settings that a method never reads, which therefore do not make a unit another one."""
_UNUSED_FROM_A_MODEL = ("n_lam", "stiffness", "init_scale")


def settings_hash(unit: Unit, preset: Preset, sources: Mapping[str, Mapping[str, str]]) -> str:
    """Identifies what units that differ only in their seed have in common, except the code.

    Args:
        unit: the unit.
        preset: how much is computed.
        sources: task → `object_source` of it.

    Returns:
        12 hexadecimal digits.
    """
    config: dict[str, Any] = asdict(config_of(unit, preset))
    for name in ("seed", *_UNUSED[unit.method], *(_UNUSED_FROM_A_MODEL if unit.init else ())):
        config.pop(name, None)
    before = settings_hash(unit.init, preset, sources) if unit.init else None
    return _hash({"config": config, "source": dict(sources[unit.task]), "init": before}, 12)


def unit_key(unit: Unit, preset: Preset, sources: Mapping[str, Mapping[str, str]], code: str) -> str:
    """Identifies a unit and its result: 16 hexadecimal digits out of its settings, its object and the code."""
    return _hash({"settings": settings_hash(unit, preset, sources), "seed": unit.seed, "code": code}, 16)


def _hash(value: object, digits: int) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:digits]


def object_source(task: str) -> dict[str, str]:
    """Where the object of a task comes from on this machine, and the hash of its mesh.

    Raises:
        InvalidInputError: DIFFLCS_YCB_DIR is set, but the mesh is not there.
    """
    from difflcs_envs import DifflcsEnvsError
    from difflcs_envs.assets import find_ycb_mesh
    from difflcs_envs.ycb import YCB

    if task not in YCB:
        return {"source": "built_in", "sha256": ""}
    try:
        path = find_ycb_mesh(YCB[task])
    except DifflcsEnvsError as error:
        raise InvalidInputError(str(error)) from error
    if path is None:
        return {"source": "stand_in", "sha256": ""}
    return {"source": "ycb_mesh", "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


_ENTRIES = ("difflcs.rl.training", "difflcs_envs.vector")
"""What a unit starts from; what these import, directly or not, is the code that decides a result."""
_HARMLESS = frozenset(
    {
        "difflcs._files",
        "difflcs.errors",
        "difflcs.mpc.backends.ipopt",
        "difflcs.mpc.backends.relaxed",
        "difflcs.rl._optional",
        "difflcs_envs.assets",
        "difflcs_envs.errors",
        "difflcs_envs.trifinger.rendering",
    }
)
"""Imported, but without influence on a result: files, messages, pictures, other solvers."""
_MAIN_PHASE = frozenset(
    f"difflcs.rl.{name}" for name in ("critic", "imagination", "lookahead", "natural", "policy", "ppo")
)
_UNREACHED: Mapping[str, frozenset[str]] = {
    "lcs-rl": frozenset({"difflcs.rl.mlp", "difflcs.rl.pddm"}),
    "violation": _MAIN_PHASE | {"difflcs.rl.dynamics", "difflcs.rl.mlp", "difflcs.rl.pddm"},
    "ppo": frozenset({"difflcs.rl.mlp", "difflcs.rl.pddm"}),
    "pddm": _MAIN_PHASE | {"difflcs.rl.mlp"},
}
"""What a training imports for the other methods' sake."""


def code_version(method: str) -> str:
    """Hash of the code that decides a method's results: the modules that its training imports, and the C++ kernels.

    Python is hashed as syntax trees without docstrings: comments, documentation and formatting do not count. Nor do the
    defaults of settings (dataclasses named …Config): their values are in `settings_hash`. The C++ is hashed as text
    where its sources lie beside the installed package (in a wheel they do not). The hash is that of one minor version
    of Python.

    Args:
        method: one of `METHODS`.

    Returns:
        "<all methods' Python>.<the method's own>.<C++>", 8 hexadecimal digits each; see `shared_code`.
    """
    import difflcs
    import difflcs_envs

    roots = {p.__name__: Path(str(p.__file__)).parent for p in (difflcs, difflcs_envs)}
    trees: dict[str, str] = {}
    waiting = list(_ENTRIES)
    while waiting:
        name = waiting.pop()
        path = _module_file(name, roots)
        if path is None or name in trees or name in roots or name in _HARMLESS | _UNREACHED[method]:
            continue
        tree = ast.parse(path.read_text())
        waiting += _imports(tree)
        trees[name] = ast.dump(_without_defaults(_without_docstrings(tree)))
    native = {
        f"{name}/{path.relative_to(root)}": hashlib.sha256(path.read_bytes()).hexdigest()
        for name, root in roots.items()
        for path in sorted(root.rglob("*.?pp"))
    }
    own = {name: trees.pop(name) for name in frozenset().union(*_UNREACHED.values()) & trees.keys()}
    return ".".join(_hash(part, 8) for part in (trees, own, native))


def shared_code(version: str) -> tuple[str, str]:
    """What a `code_version` says of the code of all methods, environment and evaluation among it: Python, C++."""
    first, _, rest = version.partition(".")
    return first, rest.rpartition(".")[2]


def _module_file(name: str, roots: Mapping[str, Path]) -> Path | None:
    package, _, rest = name.partition(".")
    if package not in roots:
        return None
    path = roots[package] / rest.replace(".", os.sep)
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def _imports(tree: ast.Module) -> list[str]:
    """Names of what may be modules: `from a import b` names both a and a.b."""
    found: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return found


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            # Strings that stand alone: docstrings, and those below the fields of a dataclass.
            node.body = [
                child
                for child in node.body
                if not (
                    isinstance(child, ast.Expr)
                    and isinstance(child.value, ast.Constant)
                    and isinstance(child.value.value, str)
                )
            ]
    return tree


def _without_defaults(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.name.endswith("Config"):
            for field in node.body:
                if isinstance(field, ast.AnnAssign):
                    field.value = None
    return tree
