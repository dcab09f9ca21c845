"""The command line: `difflcs train | evaluate | render | export | demo | zoo | assets | bench | doctor`.

Tasks and methods are known by their registries only.
"""

import sys
from collections.abc import Sequence

from difflcs import __version__
from difflcs._optional import require
from difflcs.errors import MissingDependencyError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after `difflcs`; those of the process if None.

    Returns:
        Exit code: 0, 1 if `doctor` finds the library broken, 2 after an error of ours or where the extra `rl` is not
        installed, 130 after Ctrl-C.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"difflcs {__version__}")
        return 0
    try:
        from difflcs.cli import commands

        require("tyro")
    except MissingDependencyError as error:
        if words[:1] == ["doctor"]:  # it is there to say such things
            from difflcs.cli import doctor

            return doctor.main("--json" in words)
        asked = words[:1] in ([], ["-h"], ["--help"])
        if asked:
            print("Without the extra rl: difflcs doctor, which says what works here, and difflcs --version.")
        print(f"difflcs: {error}", file=sys.stderr)
        return 0 if asked and words else 2
    return commands.run(words)
