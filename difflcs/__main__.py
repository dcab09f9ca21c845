"""Entry of the command line, also of `python -m difflcs`: says what is missing before it imports what needs it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from difflcs.errors import MissingDependencyError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, see `difflcs.cli.main`.

    Args:
        arguments: words after `difflcs`; those of the process if None.

    Returns:
        Exit code; 2 where the extra `rl` is not installed.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        from difflcs import cli
    except MissingDependencyError as error:
        if words[:1] == ["doctor"]:  # it is there to say such things
            from difflcs import doctor

            return doctor.main("--json" in words)
        print(f"error: {error}", file=sys.stderr)
        return 2
    return cli.main(words)


if __name__ == "__main__":
    sys.exit(main())
