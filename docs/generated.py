"""What the documentation takes from the code and from records, so that nobody copies it by hand. A Sphinx extension.

What stands in a page between `<!-- generated: KIND ARGUMENTS -->` and `<!-- end -->` is written by

    python docs/generated.py

so that pages can be read in the repository, too; `--check` says which are out of date, and changes nothing. When the
site is built it is made anew. There are these kinds:

- `commands`: the command line's own help, one section per command.
- `settings CLASS`: a table of a dataclass's own fields with their defaults and docstrings.
- `methods`: a section for each method that is registered, with tables of its settings and of their groups.
- `docstring OBJECT`: a docstring that is written in Markdown, as those of the environments.
- `api MODULE [NAME ...]`: the reference of these public names of a module, or of all that are in its `__all__`; in the
  repository what each name is.
- `module MODULE NAME ...`: the same of functions, below the docstring of their module.
- `file PATH`: another Markdown file of the repository, without its title; in the repository a link.
- `table RECORD PART`: a table of `benchmarks/results/RECORD.json`; tables.py says which there are.
- `results FILE NUMBER [COLUMN ...]`: that table of `reproduce/results/FILE.md`, without these columns.
- `zoo`: the models of the zoo, from their cards.
- `tutorials`: the contents page of the notebooks; in the repository links to them.

A list between `<!-- cards -->` and `<!-- end -->` becomes cards in the site. Besides, the notebooks of tutorials/ are
copied to docs/tutorials, and docstrings are mended for reStructuredText.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import enum
import importlib
import importlib.util
import inspect
import io
import json
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
ROOT = DOCS.parent
MARKER = re.compile(r"^<!-- generated: (\w+) ?(.*?) -->$.*?^<!-- end -->$", re.MULTILINE | re.DOTALL)
CARDS = re.compile(r"^<!-- cards -->$(.*?)^<!-- end -->$", re.MULTILINE | re.DOTALL)


# --- command line -----------------------------------------------------------------------------------------------------


def help_text(*arguments: str) -> str:
    """What `difflcs ARGUMENTS --help` prints, 88 columns wide."""
    from difflcs import cli

    output, before = io.StringIO(), os.environ.copy()
    os.environ.update(COLUMNS="88", LINES="60", NO_COLOR="1")
    try:
        with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
            cli.main([*arguments, "--help"])
    finally:
        os.environ.clear()
        os.environ.update(before)
    return re.sub(r"\x1b\[[0-9;]*m", "", output.getvalue()).rstrip()


def command_names() -> list[str]:
    """The subcommands, from the usage line."""
    found = re.search(r"\{([\w,\- \n]+)\}", help_text())
    assert found, "difflcs --help lists no subcommands"
    return [name.strip() for name in found[1].split(",")]


def commands() -> str:
    """Markdown: the help of every subcommand."""
    parts = [f"```text\n{help_text()}\n```"]
    for name in command_names():
        parts.append(f"## difflcs {name}\n\n```text\n{help_text(name)}\n```")
    return "\n\n".join(parts)


# --- settings ---------------------------------------------------------------------------------------------------------


def resolve(name: str) -> Any:
    """The object of a dotted name."""
    module, _, rest = name.rpartition(".")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        return getattr(resolve(module), rest)


def field_docstrings(kind: type) -> dict[str, str]:
    """Field → the string that follows it in the class, or in a class it inherits from."""
    found = {}
    for owner in reversed([k for k in kind.__mro__ if is_dataclass(k)]):
        body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0].body  # pyright: ignore
        for field, after in pairwise(body):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
            ):
                found[field.target.id] = " ".join(inspect.cleandoc(after.value.value).split())  # pyright: ignore
    return found


def settings(name: str) -> str:
    """Markdown: a table of the fields of a dataclass that are no groups."""
    return settings_table([row for row in setting_rows(resolve(name)()) if "." not in row[0]])


def setting_rows(group: Any, prefix: str = "--") -> list[tuple[str, str, str]]:
    """Flag, default and meaning of every field; before those of a group, one row with `.*` that says what it is."""
    documented, rows = field_docstrings(type(group)), []
    for field in fields(group):
        value = getattr(group, field.name)
        flag = f"{prefix}{'no_' * (value is True)}{field.name}".replace("_", "-")
        if field.name not in documented:
            where = f"{type(group).__name__}.{field.name}"
            raise ValueError(f"{where}: expected a docstring below the field; write what it means")
        if is_dataclass(value):
            rows += [(f"{flag}.*", "", documented[field.name]), *setting_rows(value, f"{flag}.")]
        else:
            rows.append((flag, f"`{value!r}`", documented[field.name]))
    return rows


def settings_table(rows: list[tuple[str, str, str]]) -> str:
    """Markdown: a table of such rows."""
    lines = ['<div class="settings">', "", "| setting | default | meaning |", "|---|---|---|"]
    for flag, default, meaning in rows:
        text = meaning.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
        group = flag.endswith(".*")
        lines.append(f"| {f'**`{flag}`**' if group else f'`{flag}`'} | {default} | {f'*{text}*' if group else text} |")
    return "\n".join([*lines, "", "</div>"])


def methods() -> str:
    """Markdown: how many settings each method has, then a section for each. What was shown before is not repeated."""
    from difflcs.rl import get_method, method_names
    from difflcs.rl.methods import DEFAULT_METHOD

    own = [name for name in method_names() if get_method(name).__module__.startswith("difflcs.")]  # and nobody else's
    every = {name: setting_rows(get_method(name)()) for name in own}
    common = sum(not row[0].startswith("--method") for row in setting_rows(resolve("difflcs.rl.TrainConfig")()))
    counts = {name: sum(bool(row[1]) for row in rows) for name, rows in every.items()}
    distinct = common + len({row[0] for rows in every.values() for row in rows if row[1]})
    told = ", ".join(f"[{name}](#{name}) {count}" for name, count in counts.items())
    parts = [
        f"All methods share the {common} settings above. Besides, each has its own: {told}. A group of the same name "
        f"has the same settings in each of them, so that there are {distinct} flags in all."
    ]
    shown: dict[str, tuple[str, dict[str, tuple[str, str, str]]]] = {}  # of a group: where, and its rows by flag
    for name, rows in every.items():
        kind = get_method(name)
        only = "The method for which no `--method` is needed. " if name == DEFAULT_METHOD else ""
        parts.append(
            f'## {name}\n\n{kind.summary[0].upper()}{kind.summary[1:]}. {only}In Python: `get_method("{name}")`.'
        )
        own = {row[0]: row for row in rows if "." not in row[0]}
        if own and all(flag in shown and shown[flag][1][flag] == row for flag, row in own.items()):
            parts.append(
                f"{', '.join(f'`{flag}`' for flag in own)}: as with [{shown[min(own)][0]}](#{shown[min(own)][0]})."
            )
        elif own:
            parts.append(settings_table([*own.values()]))
        shown |= {flag: (name, {flag: row}) for flag, row in own.items() if flag not in shown}
        for flag, _, meaning in rows:
            if flag.count(".") != 1 or not flag.endswith(".*"):
                continue
            inside = {row[0]: row for row in rows if row[0].startswith(flag[:-1]) and row[0] != flag}
            title = f"### {name}: `{flag}`\n\n"
            if flag not in shown:
                shown[flag] = name, inside
                about = inspect.cleandoc(type(getattr(kind(), flag[2:-2])).__doc__ or meaning).replace("\n", " ")
                parts += [title + about, settings_table([*inside.values()])]
                continue
            where, before = shown[flag]
            changed = [row for key, row in inside.items() if row != before.get(key)]
            parts.append(
                f"{title}{meaning} As with [{where}](#{where}){', but for these defaults:' if changed else '.'}"
            )
            parts += [settings_table(changed)] * bool(changed)
    return "\n\n".join(parts)


# --- docstrings -------------------------------------------------------------------------------------------------------


def docstring(name: str) -> str:
    """Markdown: a docstring in Markdown, its headings one level down, its summary line bold."""
    summary, _, rest = inspect.cleandoc(resolve(name).__doc__).partition("\n\n")
    return f"**{summary}**\n\n" + re.sub(r"^(#+) ", r"#\1 ", rest, flags=re.MULTILINE)


def api(module: str, *names: str) -> str:
    """Markdown: autodoc of public names; nothing where the module does not exist."""
    if importlib.util.find_spec(module) is None:
        return ""
    owner = importlib.import_module(module)
    parts = []
    for name in names or owner.__all__:
        value = getattr(owner, name)
        options: list[str] = []
        if inspect.isclass(value) and issubclass(value, BaseException):
            kind, options = "autoexception", [":show-inheritance:"]
        elif inspect.isclass(value):
            kind = "autoclass"
            if is_dataclass(value) and issubclass(
                value, resolve("difflcs.rl.Settings")
            ):  # they have a page of their own
                options = [":exclude-members: " + ", ".join(f.name for f in fields(value))]
            if [*getattr(value, "__members__", {})]:
                options = [":undoc-members:"]
        elif inspect.isroutine(value):
            kind = "autofunction"
        else:
            kind = "autodata"
            options = [":no-value:"]
        parts += [f".. {kind}:: {module}.{name}", *(f"   {option}" for option in options), ""]
    return "```{eval-rst}\n" + "\n".join(parts) + "```"


def summary(value: Any) -> str:
    """Markdown: the first sentence of a docstring, on one line."""
    first = " ".join((inspect.getdoc(value) or "").partition("\n\n")[0].split())
    return first.replace("|", "\\|").replace("<", "&lt;")


SHOWN = (int, float, str, tuple, type(None))


def call(value: Any) -> str:
    """How a function or class is called, without types: `(x, u, *, gamma=0.1)`; "" for what nobody calls."""
    uncalled = (BaseException, enum.Enum)
    if not callable(value) or (inspect.isclass(value) and (issubclass(value, uncalled) or is_interface(value))):
        return ""
    plain = [one.replace(annotation=one.empty) for one in inspect.signature(value).parameters.values()]
    signature = inspect.Signature([one.replace(default=short(one.default)) for one in plain])
    text = str(signature).replace("Ellipsis", "…")
    if len(text) <= 240:
        return text
    needed = [one.name for one in plain if one.default is one.empty and one.kind is not one.VAR_KEYWORD]
    return f"({', '.join([*needed, '…'])})"


def short(default: Any) -> Any:
    """A default as a page shows it: numbers and words as they are, any other object as dots."""
    return default if default is inspect.Parameter.empty or isinstance(default, SHOWN) else ...


def is_interface(kind: type) -> bool:
    """Tell whether a class is one to write others of."""
    return getattr(kind, "_is_protocol", False) or inspect.isabstract(kind)


def api_summary(module: str, *names: str) -> str:
    """Markdown: a table of public names, for who reads it in the repository."""
    owner = importlib.import_module(module)
    rows = [
        f"| `{name}{call(getattr(owner, name))}` | {summary(getattr(owner, name))} |" for name in names or owner.__all__
    ]
    return "\n".join(["| name | meaning |", "|---|---|", *rows])


def module_functions(name: str, *names: str) -> str:
    """Markdown: autodoc of a module and some of its names."""
    return f"```{{eval-rst}}\n.. automodule:: {name}\n   :members: {', '.join(names)}\n```"


def mend_docstring(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Let docstrings stay plain text: formulas become literal blocks, Markdown tables reStructuredText tables."""
    out: list[str] = []
    i = 0
    while i < len(lines):
        line = lines[i]
        indent = len(line) - len(line.lstrip())
        if line.lstrip().startswith("|") and line.rstrip().endswith("|"):
            end = i
            while end < len(lines) and lines[end].lstrip().startswith("|"):
                end += 1
            out += _table([row.strip() for row in lines[i:end]], " " * indent)
            i = end
            continue
        starts_block = (
            line.startswith("    ") and i >= 2 and not lines[i - 1].strip() and not lines[i - 2].startswith(" ")
        )
        if starts_block and lines[i - 2].strip():
            out += ["::", ""]
            while i < len(lines) and (lines[i].startswith("    ") or not lines[i].strip()):
                out.append(lines[i])
                i += 1
            continue
        names = re.match(r"    (\w+(?:, \w+)+): ", line)  # of several attributes at once: one word for napoleon
        out.append(_inline(line.replace(names[1], names[1].replace(", ", ","), 1) if names else line))
        i += 1
    lines[:] = out


def _inline(line: str) -> str:
    line = re.sub(r"(?<!`)`([^`]+)`(?=\w)", r"`\1`\\ ", line)  # `MPCProblem`s
    parts = re.split(r"(`+[^`]+`+)", line)
    return "".join(p if p.startswith("`") else p.replace("|", r"\|") for p in parts)


def _table(rows: list[str], indent: str) -> list[str]:
    cells = [[c.strip() for c in re.split(r"(?<!\\)\|", row.strip("|"))] for row in rows]
    cells = [row for row in cells if not all(re.fullmatch(r":?-+:?", c) for c in row)]
    out = [f"{indent}.. list-table::", f"{indent}   :header-rows: 1", ""]
    for row in cells:
        for k, cell in enumerate(row):
            out.append(f"{indent}   {'* -' if k == 0 else '  -'} {_inline(cell)}")
    return [*out, ""]


def name_array_like(app: Any, what: str, name: str, obj: Any, options: Any, arguments: str, returns: str) -> Any:
    """NumPy's `ArrayLike` by its name instead of the many types that it stands for."""
    return arguments and ARRAY_LIKE.sub("ArrayLike", arguments), returns


ARRAY_LIKE = re.compile(r"[~\w.]*_Buffer \| .*?_NestedSequence\[[~\w.]*complex \|[^]]*\]")


def skip_member(app: Any, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """Fields of a named tuple are described under its attributes; what print(module) shows interests nobody."""
    return True if name == "extra_repr" or str(getattr(obj, "__doc__", "")).startswith("Alias for field") else None


# --- files of the repository ------------------------------------------------------------------------------------------


def repository_file(path: str) -> str:
    """Markdown: a file of the repository without its title, its links changed to work in the site."""
    file = ROOT / path
    if not file.exists():
        return f"`{path}` is not part of this copy."
    text = re.sub(r"\A\s*# .*\n", "", file.read_text())

    def link(found: re.Match[str]) -> str:
        image, label, target = found.groups()
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        place, _, anchor = target.partition("#")
        goal = (file.parent / place).resolve()
        relative = os.path.relpath(goal, DOCS)
        if image:
            return f"![{label}]({relative})"
        if goal.is_relative_to(DOCS) and goal.suffix in (".md", ".ipynb"):
            return f"[{label}]({relative}{'#' + anchor if anchor else ''})"
        name = str(goal.relative_to(ROOT)) if goal.is_relative_to(ROOT) else target
        return label if label.strip("`") == name else f"{label} (`{name}`)"

    code = re.compile(r"(^```.*?^```$|`[^`\n]+`(?!\]))", re.MULTILINE | re.DOTALL)
    parts = code.split(text)
    links = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
    return "".join(p if k % 2 else links.sub(link, p) for k, p in enumerate(parts))


def table(record: str, part: str) -> str:
    """Markdown: a table of what a benchmark has measured."""
    place = DOCS / "tables.py"
    spec = importlib.util.spec_from_file_location("tables", place)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = json.loads((ROOT / "benchmarks" / "results" / f"{record}.json").read_text())
    return module.TABLES[record][part](found)


def file_link(path: str) -> str:
    """Markdown: where the repository has the file."""
    return f"In the repository this is the file [{path}](../{path})."


def results(name: str, number: str, *left_out: str) -> str:
    """Markdown: a table of what reproduce/ has computed, without the columns of these names."""
    text = (ROOT / "reproduce" / "results" / f"{name}.md").read_text()
    found = re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE)[int(number) - 1]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in found.splitlines()]
    rows[1] = ["---"] * len(rows[0])
    kept = [k for k, head in enumerate(rows[0]) if head.replace(" ", "_") not in left_out]
    return "\n".join("| " + " | ".join(row[k] for k in kept) + " |" for row in rows)


def zoo() -> str:
    """Markdown: for each task of the zoo a picture, its models and the commands that made them."""
    from difflcs import zoo as models

    cards = [models.card(name) for name in models.names()]
    parts = []

    def source(card: models.ModelCard) -> str:
        return card.object_source.replace("_", " ")

    for task in sorted({card.task for card in cards}):
        mine = [card for card in cards if card.task == task]
        parts.append(f"## {task.replace('_', ' ').replace('-', ' ').capitalize()}")
        picture = f"figures/zoo/{mine[0].name}.png"
        if (DOCS / picture).exists():
            parts.append(f"![Steps of an episode of {mine[0].name}]({picture})")
        lines = ["| model | method | data | success | object |", "|---|---|---|---|---|"]
        lines += [f"| `{c.name}` | `{c.method}` | {c.minutes:g} min | {c.success_text} | {source(c)} |" for c in mine]
        parts += ["\n".join(lines), "\n".join(["```text", *(c.command for c in mine), "```"])]
    return "\n\n".join(parts)


def cards(items: str) -> str:
    """Markdown for sphinx-design: the items of a list, `- [title](page): text`, as cards."""
    parts = ["::::{grid} 1 2 2 2", ":gutter: 3", ""]
    for title, page, text in re.findall(r"^- \[(.*?)\]\((.*?)\): (.*?)$", items, re.MULTILINE):
        link = [f":link: {page.removesuffix('.md')}", ":link-type: doc"]
        parts += [f":::{{grid-item-card}} {title}", *link, "", text[0].upper() + text[1:], ":::", ""]
    return "\n".join([*parts, "::::"])


def titles() -> dict[str, str]:
    """Notebooks of tutorials/ and their titles."""
    found = {}
    for notebook in sorted((ROOT / "tutorials").glob("*.ipynb")):
        first = "".join(json.loads(notebook.read_text())["cells"][0]["source"])
        found[notebook.stem] = first.partition("\n")[0].lstrip("# ")
    return found


def tutorials() -> str:
    """Markdown: a contents page of the notebooks."""
    return "```{toctree}\n:maxdepth: 1\n\n" + "\n".join(f"tutorials/{name}" for name in titles()) + "\n```"


def tutorial_links() -> str:
    """Markdown: links to the notebooks themselves."""
    return "\n".join(f"- [{title}](../tutorials/{name}.ipynb)" for name, title in titles().items())


def copy_tutorials() -> None:
    """Copy tutorials/*.ipynb to docs/tutorials, where Sphinx reads them."""
    target = DOCS / "tutorials"
    target.mkdir(exist_ok=True)
    for old in target.iterdir():
        if not (ROOT / "tutorials" / old.name).exists():
            old.unlink()
    for notebook in sorted((ROOT / "tutorials").glob("*.ipynb")):
        copy = target / notebook.name
        if not copy.exists() or copy.read_bytes() != notebook.read_bytes():
            shutil.copyfile(notebook, copy)


# --- Sphinx -----------------------------------------------------------------------------------------------------------

KINDS: dict[str, Callable[..., str]] = {
    "commands": commands,
    "settings": settings,
    "methods": methods,
    "docstring": docstring,
    "api": api,
    "module": module_functions,
    "file": repository_file,
    "table": table,
    "results": results,
    "zoo": zoo,
    "tutorials": tutorials,
}
# What only Sphinx can read has another form in the repository.
IN_REPOSITORY: dict[str, Callable[..., str]] = KINDS | {
    "api": api_summary,
    "module": api_summary,
    "file": file_link,
    "tutorials": tutorial_links,
}


def fill(text: str) -> str:
    """A page as the site shows it, where the notebooks are copies in docs/tutorials."""
    text = CARDS.sub(lambda found: cards(found[1]), text)
    text = MARKER.sub(lambda found: KINDS[found[1]](*found[2].split()), text)
    return text.replace("](../tutorials/", "](tutorials/")


def refresh(text: str) -> str:
    """A page as the repository has it."""

    def new(found: re.Match[str]) -> str:
        start, body = found[0].partition("\n")[0], IN_REPOSITORY[found[1]](*found[2].split())
        return f"{start}\n\n{body}\n\n<!-- end -->"

    return MARKER.sub(new, text)


def main() -> int:
    """Bring the pages up to date, or say which are not."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--check", action="store_true", help="change nothing; exit code 1 if a page is out of date")
    check, stale = parser.parse_args().check, []
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text()
        new = refresh(text)
        if new != text:
            stale.append(str(page.relative_to(ROOT)))
            if not check:
                page.write_text(new)
    if stale:
        print(("out of date: " if check else "written: ") + ", ".join(stale))
    if stale and check:
        print("Run `python docs/generated.py`.")
    return int(bool(stale) and check)


def read_source(app: Any, docname: str, source: list[str]) -> None:
    """Fill a page before it is parsed."""
    source[0] = fill(source[0])


def always_read(app: Any, env: Any, added: set[str], changed: set[str], removed: set[str]) -> list[str]:
    """Pages with markers are read at every build: what they depend on is not a file that Sphinx watches."""
    pages = [name for name in env.found_docs if str(env.doc2path(name)).endswith(".md")]
    return [name for name in pages if MARKER.search(Path(env.doc2path(name)).read_text())]


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    copy_tutorials()
    app.connect("source-read", read_source)
    app.connect("env-get-outdated", always_read)
    app.connect("autodoc-process-docstring", mend_docstring, priority=400)  # before napoleon
    app.connect("autodoc-process-signature", name_array_like)
    app.connect("autodoc-skip-member", skip_member)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


if __name__ == "__main__":
    sys.exit(main())
