"""Entry of the command line as a program, also of `python -m difflcs`, with complete output and exit codes."""

import os
import select
import sys
from collections.abc import Sequence

from difflcs import cli

_INTERRUPTED = 130
_READER_GONE = 141
"""Exit codes of a shell after Ctrl-C, and of a program whose output nobody reads any more: 128 plus the signal."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, see `difflcs.cli.main`.

    Args:
        arguments: words after `difflcs`; those of the process if None.

    Returns:
        Exit code; 2 where the extra `rl` is not installed, 130 after Ctrl-C, 141 where the output is piped into
        something that has ended.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        try:
            return cli.main(words)
        finally:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:  # None without a console
                    stream.flush()  # here and not when Python ends, where nobody could handle an error
    except KeyboardInterrupt:  # before the command line could say what to do, such as while it is imported
        print("\ndifflcs: interrupted; nothing was changed", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        if not _reader_gone():
            raise
        return _READER_GONE


def _reader_gone() -> bool:
    """Return whether the reader of our output has gone, as in `difflcs train --help | head`; then write no more."""
    gone = False
    for stream in (sys.stdout, sys.stderr):
        poll = select.poll()
        poll.register(stream.fileno(), select.POLLOUT)
        if any(event & select.POLLERR for _, event in poll.poll(0)):
            gone = True
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return gone


if __name__ == "__main__":
    sys.exit(main())
