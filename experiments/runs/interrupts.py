"""Interrupts (Ctrl-C, and SIGTERM where it ends a command alike) that wait for a safe place."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


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
