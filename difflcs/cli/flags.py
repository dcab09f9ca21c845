"""Flags among the words of the command line, and errors that name flags."""

import contextlib
import io
import re
import sys
from collections.abc import Iterator, Sequence
from itertools import zip_longest

from difflcs.errors import InvalidInputError


def find_flags(words: Sequence[str]) -> frozenset[str]:
    """Return the flags among the words, without dashes in front; of `--a.no-b` both that and `a.b`."""
    flags = {word[2:].partition("=")[0].replace("_", "-") for word in words if word.startswith("--")}
    return frozenset(flags | {re.sub(r"(^|\.)no-", r"\1", flag) for flag in flags})


def flag_value(words: Sequence[str], flag: str) -> str | None:
    """Return the value of a flag, written as `--flag value` or `--flag=value`."""
    for word, following in zip_longest(words, words[1:]):
        if word == flag:
            return following
        if word.startswith(f"{flag}="):
            return word.partition("=")[2]
    return None


@contextlib.contextmanager
def errors_by_flag() -> Iterator[None]:
    """Raise errors of settings with the name of their flag; tyro would print its own name of the group.

    Raises:
        InvalidInputError: a setting of a group has a value that it cannot have.
    """
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            yield
    except InvalidInputError as error:
        raise _with_flag(error, []) from None
    except SystemExit as stop:
        # tyro exits while it handles an error of its own, which it raised while it handled that of the settings.
        outer = stop.__context__
        inner = None if outer is None else outer.__context__
        if not isinstance(inner, InvalidInputError):
            raise
        told = io.StringIO()
        # The root and the command's field are no part of a flag.
        raise _with_flag(inner, str(getattr(outer, "arg", "")).split(".")[2:]) from None
    finally:
        sys.stderr.write(told.getvalue())


def _with_flag(error: InvalidInputError, group: Sequence[str]) -> InvalidInputError:
    name, colon, rest = str(error).partition(": ")
    return InvalidInputError(f"--{'.'.join([*group, name]).replace('_', '-')}{colon}{rest}")
