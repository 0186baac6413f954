"""Locks between processes, which the system frees even if their holder is killed."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from sim.files import require_file


@contextmanager
def locked(lock: Path) -> Iterator[None]:
    """Hold an exclusive lock, by a file that goes with it.

    The file is opened to be written, since a lock on a network file system asks for that. Who
    waited for one that is gone takes the next.
    """
    with _held(lock):
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def _held(lock: Path) -> TextIO:
    while True:
        require_file(lock)  # a pipe would wait for ever
        handle = lock.open("w")
        fcntl.flock(handle, fcntl.LOCK_EX)
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle.fileno()), lock.stat()):
                return handle
        handle.close()
