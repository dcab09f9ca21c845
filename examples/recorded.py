"""Episodes that are recorded in a file, and not played again."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

Episode = dict[str, Any]


class Recorded:
    """Episodes by their object and seed: played once, or read from a file, a line of JSON each.

    Args:
        play: object and seed → an episode, with "object" and "seed".
        out: the file, to which each episode that is played is added; None: none.
    """

    def __init__(self, play: Callable[[str, int], Episode], out: Path | None):
        lines = out.read_text().splitlines() if out is not None and out.exists() else []
        self._known = {(e["object"], e["seed"]): e for e in map(json.loads, lines)}
        self._play, self._out = play, out

    def episodes(self, keys: Iterable[tuple[str, int]]) -> list[Episode]:
        """Return the episodes of some objects and seeds."""
        return [self._episode(*key) for key in keys]

    def _episode(self, name: str, seed: int) -> Episode:
        if (name, seed) not in self._known:
            self._known[name, seed] = episode = self._play(name, seed)
            if self._out is not None:
                with self._out.open("a") as file:
                    file.write(json.dumps(episode) + "\n")
        return self._known[name, seed]
