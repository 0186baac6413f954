"""What people see in the terminal: progress, and a word when something is compiled."""

from __future__ import annotations

import importlib
import sys
import textwrap
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from sim.errors import InputError

_QUIET_S = 2.0  # what ends sooner needs no progress
_LINE_EVERY_S = 10.0  # where the output is a file


class RunFailedError(Exception):
    """A run failed; its row says how."""


@contextmanager
def progress(label: str, total: float | None = None) -> Iterator[Callable[[float], None]]:
    """Give a function that takes the amount done; it shows a bar, or lines where there is none.

    Nothing is shown for the first two seconds.
    """
    shown = _Progress(label, total)
    try:
        yield shown.update
    finally:
        shown.stop()


class _Progress:
    """A bar on a terminal, a line now and then elsewhere."""

    def __init__(self, label: str, total: float | None) -> None:
        self._label, self._total = label, total
        self._begun = time.monotonic()
        self._next_line = self._begun + _QUIET_S
        self._bar: Any = None

    def update(self, done: float) -> None:
        now = time.monotonic()
        if now - self._begun < _QUIET_S:
            return
        if sys.stderr.isatty():
            self._draw(done)
        elif now >= self._next_line:
            self._next_line = now + _LINE_EVERY_S
            share = f" of {self._total:g}" if self._total else ""
            print(
                f"{self._label}: {done:.3g}{share} after {now - self._begun:.0f} s", file=sys.stderr
            )

    def stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _draw(self, done: float) -> None:
        if self._bar is None:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

            self._bar = Progress(
                TextColumn(self._label),
                BarColumn(),
                TextColumn("{task.completed:.3g}" + (" of {task.total:g}" if self._total else "")),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(self._label, total=self._total)
        self._bar.update(self._task, completed=done)


def end(error: BaseException) -> NoReturn:
    """End the program with one line for what the user can mend: code 2 for input, 1 for failures.

    An internal error ends with its trace and code 3.
    """
    chain: list[BaseException] = [error]
    while (before := chain[-1].__cause__ or chain[-1].__context__) is not None:
        chain.append(before)
    for link in chain:
        if isinstance(link, InputError):
            _say(str(link), 2)
        if isinstance(link, RunFailedError):
            _say(f"the run failed: {link}", 1)
        if isinstance(link, KeyboardInterrupt):
            _say("interrupted; what was finished is kept", 1)
        if isinstance(link, _configuration_errors()):
            lines = [line.strip() for line in str(link).splitlines() if line.strip()]
            text = textwrap.shorten(" ".join(lines), 600, placeholder=" ...")
            _say(f"configuration: {text}; see estima run --cfg job", 2)
    traceback.print_exception(error)
    sys.exit(3)


def _configuration_errors() -> tuple[type[Exception], ...]:
    """Errors of Hydra and OmegaConf, if they have been imported at all."""
    if "hydra" not in sys.modules:
        return ()
    hydra, omegaconf = (importlib.import_module(f"{n}.errors") for n in ("hydra", "omegaconf"))
    return (hydra.HydraException, omegaconf.OmegaConfBaseException)


def _say(message: str, code: int) -> NoReturn:
    print(f"estima: {message}", file=sys.stderr)
    sys.exit(code)
