"""Numba's decorator for the hot loops: compiled once, cached on disk, announced when it happens.

Numba, which takes half a second to import, is imported when such a function is first called. The
clocks `processor_s` and `wall_s` stand still meanwhile, so that methods are timed without it.
"""

import contextlib
import functools
import multiprocessing
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

if "numba" in sys.modules:  # else it comes later; what is compiled depends on it all the same
    import numba as numba  # dependencies are found by imports outside functions

Function = TypeVar("Function", bound=Callable[..., Any])

ANNOUNCED = "compiling numerical code (once; later runs read it from disk)"


class _Listener:
    """Listens to events of Numba, without importing it."""

    def notify(self, event: Any) -> None:
        (self.on_start if event.is_start else self.on_end)()

    def on_start(self) -> None:
        raise NotImplementedError

    def on_end(self) -> None:
        raise NotImplementedError


class _Announcer(_Listener):
    """Announces, once, that code is being compiled; code read from the cache makes no event.

    A process that another started is silent, unless there is a file to note it in.
    """

    _announced = False
    note: Path | None = None

    def on_start(self) -> None:
        self._note()
        if not self._announced and self.note is None and multiprocessing.parent_process() is None:
            print(ANNOUNCED, file=sys.stderr, flush=True)
        self._announced = True

    def on_end(self) -> None:
        self._note()

    def _note(self) -> None:
        if self.note is not None:
            with contextlib.suppress(OSError):  # the folder is gone
                self.note.touch()


class _Clock(_Listener):
    """Clock, s, that stands still while code is compiled or compiled code is read.

    Numba holds one lock for both, and makes an event of it.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s, self._held, self._since_s, self._still_s = now_s, 0, 0.0, 0.0

    def __call__(self) -> float:
        return self._now_s() - self._still_s

    def on_start(self) -> None:
        if self._held == 0:
            self._since_s = self._now_s()
        self._held += 1

    def on_end(self) -> None:
        self._held -= 1
        if self._held == 0:
            self._still_s += self._now_s() - self._since_s


_announcer = _Announcer()
processor_s = _Clock(time.process_time)
wall_s = _Clock(time.perf_counter)


def note_compiling(path: Path | None) -> None:
    """Say nothing of compiling, but touch this file whenever it begins or ends; None: say it."""
    _announcer.note = path


@functools.cache
def load_numba() -> Any:
    """Import Numba, with its events heard and the clocks still."""
    clocks = (processor_s, wall_s)
    for clock in clocks:
        clock.on_start()
    import numba
    from numba.core import event

    event.Listener.register(_Listener)
    event.register("numba:compile", _announcer)  # type: ignore[no-untyped-call]
    for clock in clocks:
        event.register("numba:compiler_lock", clock)  # type: ignore[no-untyped-call]
        clock.on_end()
    return numba


class _Compiled:
    """A function that Numba compiles when it is called, or when one that calls it is."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._options = function, options

    @functools.cached_property
    def dispatcher(self) -> Any:
        njit = load_numba().njit
        try:
            return njit(cache=True, **self._options)(self._function)
        except RuntimeError:  # neither the package's folder nor the user's cache can be written
            return njit(**self._options)(self._function)

    def __call__(self, *arguments: Any) -> Any:
        return self.dispatcher(*arguments)

    @property
    def _numba_type_(self) -> Any:  # of a global name in compiled code
        return self.dispatcher._numba_type_


def njit(**options: Any) -> Callable[[Function], Function]:
    """`numba.njit` with the compiled code cached on disk; the function keeps its type."""

    def compiled(function: Function) -> Function:
        return cast(Function, _Compiled(function, options))

    return compiled
