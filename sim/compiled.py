"""Numba's decorator for the hot loops: compiled once, cached on disk, announced when it happens."""

import multiprocessing
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numba import njit as _njit
from numba.core import event

Function = TypeVar("Function", bound=Callable[..., Any])


class _Announcer(event.Listener):
    """Announces, once, that code is being compiled; code read from the cache makes no event.

    A process that another started is silent, unless it was told where the processes agree.
    """

    _announced = False
    once_in: Path | None = None  # file by which processes that work together announce it once

    def on_start(self, event: Any) -> None:
        if not self._announced:
            self._announced = True
            if self.once_in is None and multiprocessing.parent_process() is not None:
                return
            if self.once_in is not None:
                try:
                    self.once_in.open("x").close()
                except OSError:
                    return  # another process said it, or the folder is gone
            print(
                "compiling numerical code (once; later runs read it from disk)",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: Any) -> None:
        """Nothing: the output that follows shows that it is done."""


_announcer = _Announcer()
event.register("numba:compile", _announcer)  # type: ignore[no-untyped-call]


def announce_once_in(path: Path) -> None:
    """Announce compiling in one only of the processes that name this file; that one makes it."""
    _announcer.once_in = path


def njit(**options: Any) -> Callable[[Function], Function]:
    """`numba.njit` with the compiled code cached on disk; the function keeps its type."""
    decorator: Callable[[Function], Function] = _njit(cache=True, **options)
    return decorator
