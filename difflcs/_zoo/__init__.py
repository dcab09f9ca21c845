"""The models that ship with the package, one folder each: config.json, model.safetensors, card.json."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from difflcs.errors import CheckpointError

ROOT = Path(__file__).parent
PREFIX = "zoo:"
"""Before a name it says: the model of the zoo, whatever lies in the working directory."""


def names(root: Path = ROOT) -> tuple[str, ...]:
    """Names of the models, in alphabetical order."""
    return tuple(sorted(card.parent.name for card in root.glob("[!._]*/card.json")))


def find(name: str, root: Path = ROOT) -> Path:
    """The folder of a model.

    Args:
        name: "trifinger-cube" or "zoo:trifinger-cube".
        root: where the models lie.

    Raises:
        CheckpointError: no model has this name; the message lists those there are.
    """
    name = name.removeprefix(PREFIX)
    known = names(root)
    if name in known:
        return root / name
    near = difflib.get_close_matches(name, known, n=2)
    advice = f"did you mean {' or '.join(near)}?" if near else "`difflcs zoo` lists them"
    raise CheckpointError(f"zoo: expected one of {', '.join(known) or 'no models'}, got {name!r}; {advice}")


def resolve(source: str | os.PathLike[str]) -> Path:
    """The directory that a user means.

    "zoo:NAME" is always a model of the zoo. Otherwise a path that exists wins, then a model of the zoo of that name.

    Raises:
        CheckpointError: a name, not a path, that is neither.
    """
    text = os.fsdecode(source)
    if text.startswith(PREFIX):
        return find(text)
    path = Path(text)
    if os.path.exists(text) or path.name != text:  # only one word may be a name
        return path
    try:
        return find(text)
    except CheckpointError as error:
        raise CheckpointError(f"{text}: no such directory; {error}") from None
