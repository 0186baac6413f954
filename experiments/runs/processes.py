"""Between processes: locks, and interrupts (Ctrl-C, SIGTERM) that wait for a safe place."""

import fcntl
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from sim.files import require_file


@contextmanager
def held_interrupts() -> Iterator[Callable[..., None]]:
    """Yield a function that raises the interrupt that has come meanwhile, if any.

    It takes any arguments, so that it can be called as progress is. The end of the context raises
    the interrupt too, in place of what that has caused. A second interrupt does not wait.

    Raised while compiled code returns, an interrupt can crash Python, or become an error of the
    run.
    """
    came = False

    def hold(*_: object) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    def check(*_: object, **__: object) -> None:
        if came:
            raise KeyboardInterrupt

    usual = [
        number
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is signal.default_int_handler
        and threading.current_thread() is threading.main_thread()
    ]
    for number in usual:
        signal.signal(number, hold)
    try:
        yield check
    finally:
        for number in usual:
            signal.signal(number, signal.default_int_handler)
        check()


@contextmanager
def locked(lock: Path) -> Iterator[None]:
    """Hold an exclusive lock, by a file that goes with it; the system frees it if its holder dies.

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
