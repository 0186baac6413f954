"""Numba's decorator for the hot loops: compiled once, cached on disk, announced when it happens.

The clocks `processor_s` and `wall_s` stand still meanwhile, so that methods are timed without it.
"""

import contextlib
import multiprocessing
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numba import njit as _njit
from numba.core import event

Function = TypeVar("Function", bound=Callable[..., Any])

ANNOUNCED = "compiling numerical code (once; later runs read it from disk)"


class _Announcer(event.Listener):
    """Announces, once, that code is being compiled; code read from the cache makes no event.

    A process that another started is silent, unless there is a file to note it in.
    """

    _announced = False
    note: Path | None = None

    def on_start(self, event: Any) -> None:
        self._note()
        if not self._announced and self.note is None and multiprocessing.parent_process() is None:
            print(ANNOUNCED, file=sys.stderr, flush=True)
        self._announced = True

    def on_end(self, event: Any) -> None:
        self._note()

    def _note(self) -> None:
        if self.note is not None:
            with contextlib.suppress(OSError):  # the folder is gone
                self.note.touch()


class _Clock(event.Listener):
    """Clock, s, that stands still while code is compiled or compiled code is read.

    Numba holds one lock for both, and makes an event of it.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s, self._held, self._since_s, self._still_s = now_s, 0, 0.0, 0.0

    def __call__(self) -> float:
        return self._now_s() - self._still_s

    def on_start(self, event: Any) -> None:
        if self._held == 0:
            self._since_s = self._now_s()
        self._held += 1

    def on_end(self, event: Any) -> None:
        self._held -= 1
        if self._held == 0:
            self._still_s += self._now_s() - self._since_s


_announcer = _Announcer()
processor_s = _Clock(time.process_time)
wall_s = _Clock(time.perf_counter)
event.register("numba:compile", _announcer)  # type: ignore[no-untyped-call]
for _clock in (processor_s, wall_s):
    event.register("numba:compiler_lock", _clock)  # type: ignore[no-untyped-call]


def note_compiling(path: Path | None) -> None:
    """Say nothing of compiling, but touch this file whenever it begins or ends; None: say it."""
    _announcer.note = path


def njit(**options: Any) -> Callable[[Function], Function]:
    """`numba.njit` with the compiled code cached on disk; the function keeps its type."""

    def decorate(function: Function) -> Function:
        try:
            compiled: Function = _njit(cache=True, **options)(function)
        except RuntimeError:  # neither the package's folder nor the user's cache can be written
            compiled = _njit(**options)(function)
        return compiled

    return decorate
