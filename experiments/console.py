"""What people see in the terminal: progress, and a word when something is compiled."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_QUIET_S = 2.0  # what ends sooner needs no progress
_LINE_EVERY_S = 10.0  # where the output is a file


@contextmanager
def progress(label: str, total: float | None = None) -> Iterator[Callable[[float], None]]:
    """Give a function that takes the amount done; it shows a bar, or lines where there is none.

    Nothing is shown for the first two seconds.
    """
    begun = time.monotonic()
    shown: dict[str, Any] = {"bar": None, "task": None, "line": begun + _QUIET_S}

    def update(done: float) -> None:
        now = time.monotonic()
        if now - begun < _QUIET_S:
            return
        if not sys.stderr.isatty():
            if now >= shown["line"]:
                shown["line"] = now + _LINE_EVERY_S
                share = f" of {total:g}" if total else ""
                print(f"{label}: {done:g}{share} after {now - begun:.0f} s", file=sys.stderr)
            return
        if shown["bar"] is None:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            shown["bar"] = Progress(
                TextColumn(label),
                BarColumn(),
                TextColumn(
                    "{task.completed:g} of {task.total:g}" if total else "{task.completed:g}"
                ),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            shown["bar"].start()
            shown["task"] = shown["bar"].add_task(label, total=total)
        shown["bar"].update(shown["task"], completed=done)

    try:
        yield update
    finally:
        if shown["bar"] is not None:
            shown["bar"].stop()
