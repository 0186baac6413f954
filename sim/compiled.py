"""Numba's decorator for the hot loops: compiled once, cached on disk, announced when it happens."""

import sys
from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit as _njit
from numba.core import event

Function = TypeVar("Function", bound=Callable[..., Any])


class _Announcer(event.Listener):
    """Announces, once, that code is being compiled; code read from the cache makes no event."""

    _announced = False

    def on_start(self, event: Any) -> None:
        if not self._announced:
            self._announced = True
            print(
                "compiling numerical code (once; later runs read it from disk)",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: Any) -> None:
        """Nothing: the output that follows shows that it is done."""


event.register("numba:compile", _Announcer())  # type: ignore[no-untyped-call]


def njit(**options: Any) -> Callable[[Function], Function]:
    """`numba.njit` with the compiled code cached on disk; the function keeps its type."""
    decorator: Callable[[Function], Function] = _njit(cache=True, **options)
    return decorator
