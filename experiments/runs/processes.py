"""Between processes: locks, and interrupts (Ctrl-C, SIGTERM) that wait for a safe place."""

import fcntl
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sim.errors import InputError
from sim.files import require_file


class Interrupted(KeyboardInterrupt):
    """An interrupt that was held."""


def is_interrupt(error: BaseException) -> bool:
    """Whether the user interrupts; an estimator may raise a KeyboardInterrupt of its own."""
    held = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    return isinstance(error, Interrupted if held else KeyboardInterrupt)


@contextmanager
def hold_interrupts() -> Iterator[Callable[..., None]]:
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
            raise Interrupted
        came = True

    def check(*_: object, **__: object) -> None:
        if came:
            raise Interrupted

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
def hold_lock(lock: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold an exclusive lock, by a file that goes with it; the system frees it if its holder dies.

    The file is opened to be written, since a lock on a network file system asks for that. Who
    waited for one that is gone takes the next.

    Raises
    ------
    BlockingIOError
        If another process holds it, and this one shall not wait.
    InputError
        If the file cannot be made.
    """
    flags = fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB
    require_file(lock)  # a pipe would wait forever
    try:
        lock.parent.mkdir(parents=True, exist_ok=True)
        while True:
            handle = lock.open("w")
            fcntl.flock(handle, flags)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle.fileno()), lock.stat()):
                    break
            handle.close()
    except BlockingIOError:
        raise
    except OSError as error:
        raise InputError(
            f"{lock}: cannot lock it ({error.strerror}); make its folder writable, free some "
            "space, or choose another folder of results with ESTIMA_RESULTS"
        ) from error
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        handle.close()
