"""What imports what, and how long files and classes are, read from the sources."""

import ast
import functools
import graphlib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = {"difflcs": ROOT / "difflcs", "difflcs_envs": ROOT / "envs" / "difflcs_envs"}
MOST_LINES, MOST_CLASS_LINES = 500, 300
# The storeys of the library, from below: core, physics and planning, learning and the tools. A module imports from its
# own line and those above it here; what begins with "_" helps all, and knows errors alone. The zoo knows files only.
LAYERS = (
    ("errors",),
    ("lcs", "lcp", "records", "losses", "scales", "fit", "cost", "constraints", "status", "zoo"),
    ("systems",),
    ("mpc",),
    ("physics",),
    ("planning",),
    ("rl.tasks", "rl.settings", "rl.seeding", "rl.rollout"),
    ("rl.learning",),
    ("rl.methods",),
    ("rl.runs",),
    ("rl",),
    ("cli", "__main__"),
)


def module_name(package: str, path: Path) -> str:
    parts = path.relative_to(PACKAGES[package]).with_suffix("").parts
    return ".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)])


SOURCES = {
    module_name(package, path): path for package, folder in PACKAGES.items() for path in sorted(folder.rglob("*.py"))
}


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def imports(tree: ast.Module, types: bool = False) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Import statements that are run, with `types` those for type checkers too, and whether at the import."""
    functions, for_types = (
        {inner for outer in ast.walk(tree) if kind(outer) for inner in ast.walk(outer)}
        for kind in (lambda node: isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef), is_type_checking)
    )
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom) and (types or node not in for_types):
            yield node, node not in functions


def targets(node: ast.Import | ast.ImportFrom, module: str) -> Iterator[str]:
    """Modules of ours that a statement imports; names in a package that are modules are these."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
        return
    base = node.module or ""
    assert not node.level, f"{module}: expected imports by whole names"
    submodules = [f"{base}.{alias.name}" for alias in node.names]
    found = [name for name in submodules if name in SOURCES]
    yield from found
    if len(found) < len(submodules):
        yield base


@functools.cache
def graph(*, functions: bool, types: bool = False) -> dict[str, set[str]]:
    """Module → the modules of ours that it imports, at module level or in functions; `types`: for annotations, too."""
    edges: dict[str, set[str]] = {}
    for module, path in SOURCES.items():
        tree = ast.parse(path.read_text())
        edges[module] = {
            target
            for node, top in imports(tree, types)
            if top is not functions
            for target in targets(node, module)
            if target in SOURCES and target != module
        }
    return edges


def packages_of(edges: dict[str, set[str]], package: str, other: str) -> dict[str, set[str]]:
    return {
        module: {target for target in found if target.split(".")[0] == other}
        for module, found in edges.items()
        if module.split(".")[0] == package and any(target.split(".")[0] == other for target in found)
    }


def test_the_graph_has_what_is_known_to_be_in_it():
    edges = graph(functions=False)
    assert "difflcs.errors" in edges["difflcs.lcs"]
    assert {"difflcs.rl.tasks", "difflcs.rl.settings"} <= edges["difflcs.rl.methods.base"]
    assert "difflcs.zoo" in edges["difflcs.cli.commands"]
    assert "difflcs.rl.learning.policy" in graph(functions=True)["difflcs.rl.methods.phases"]
    assert "difflcs.rl.learning.policy" not in edges["difflcs.rl.methods.phases"]  # TorchRL takes seconds
    assert "difflcs.rl.learning.critic" in edges["difflcs.rl.learning.advantages"]
    assert "difflcs.rl.learning.model_rollouts" not in edges["difflcs.rl.learning.advantages"]  # for annotations alone


def layer_of(module: str) -> int | None:
    """Index in `LAYERS`; None for helpers and the root."""
    below = module.removeprefix("difflcs.") + "."
    return next((i for i, names in enumerate(LAYERS) if any(below.startswith(f"{name}.") for name in names)), None)


def test_no_circle_of_imports():
    graphlib.TopologicalSorter(graph(functions=False, types=True)).prepare()  # else it names a circle


def test_imports_go_one_way():
    edges, later = graph(functions=False), graph(functions=True)
    for module, other in ((m, o) for m in SOURCES if m.startswith("difflcs.") for o in edges[m] | later[m]):
        own, layer = layer_of(module), layer_of(other)
        assert own is None or layer is None or layer <= own, f"{module} imports {other}"
        assert own is not None or layer in (None, 0), f"the helper {module} imports {other}"


def test_the_library_knows_no_environment_and_one_file_of_these_knows_the_library():
    assert packages_of(graph(functions=False), "difflcs", "difflcs_envs") == {}
    known = packages_of(graph(functions=True), "difflcs", "difflcs_envs")
    assert set(known) <= {"difflcs.cli.commands", "difflcs.cli.doctor"}  # the command `assets`, and what works here
    assert set(packages_of(graph(functions=False), "difflcs_envs", "difflcs")) == {"difflcs_envs.tasks"}
    assert set(packages_of(graph(functions=True), "difflcs_envs", "difflcs")) <= {"difflcs_envs.tasks"}


@pytest.mark.parametrize("folder", ["benchmarks", "envs", "examples", "reproduce"])
def test_private_modules_of_the_library_stay_in_it(folder):
    for path in (ROOT / folder).rglob("*.py"):
        for node, _ in imports(ast.parse(path.read_text())):
            names = [f"{getattr(node, 'module', '') or ''}.{alias.name}".strip(".") for alias in node.names]
            assert not [name for name in names if name.startswith("difflcs.") and "._" in name], path


def test_files_and_classes_are_short():
    for module, path in SOURCES.items():
        text = path.read_text()
        assert len(text.splitlines()) <= MOST_LINES, module
        for node in (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.ClassDef)):
            assert node.end_lineno - node.lineno + 1 <= MOST_CLASS_LINES, f"{module}.{node.name}"
