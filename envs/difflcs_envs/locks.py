"""One process at a time, where several could write the same files."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from difflcs_envs.errors import extra


@contextlib.contextmanager
def one_at_a_time(path: Path, waiting: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Hold the lock at a path, which the system ends with its process. Without a lock if none can be written.

    Args:
        path: of the lock.
        waiting: called once if another process holds it.
    """
    with extra():
        import filelock
    lock = filelock.FileLock(path)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(blocking=False)
        except filelock.Timeout:
            waiting()
            lock.acquire()
    try:
        yield
    finally:
        if lock.is_locked:
            with contextlib.suppress(OSError):
                path.unlink()  # before the release: who has opened it already sees that it is gone, and tries again
            lock.release()
