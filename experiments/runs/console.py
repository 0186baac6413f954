"""What people see in the terminal: progress, and the one line that ends a failed command."""

from __future__ import annotations

import importlib
import sys
import textwrap
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from sim.errors import InputError

_QUIET_S = 2.0  # what ends sooner needs no progress
_LINE_EVERY_S = 10.0  # where the output is a file


class RunFailedError(Exception):
    """A run failed; its row says how."""


@contextmanager
def progress(
    label: str, total: float | None = None, unit: str = "", *, summary: bool = False
) -> Iterator[Progress]:
    """Give a function that takes the amount done, and how much of it failed.

    It shows a bar on a terminal, and a line now and then elsewhere. Nothing is shown for the first
    two seconds.

    Parameters
    ----------
    total
        The amount when all is done; None if nobody knows.
    unit
        What is counted, such as runs; then their rate is shown too.
    summary
        Leave the last state as a line, even if all took less than two seconds.
    """
    shown = Progress(label, total, unit)
    try:
        yield shown
    finally:
        shown.stop(summary)


class Progress:
    """A bar on a terminal, a line now and then elsewhere."""

    def __init__(self, label: str, total: float | None, unit: str) -> None:
        self._label, self._total, self._unit = label, total, unit
        self._begun = time.monotonic()
        self._next_line = self._begun + _QUIET_S
        self._line = self._printed = ""
        self._bar: Any = None

    def __call__(self, done: float, failed: int = 0) -> None:
        """Show that so much is done, and how much of it failed."""
        now = time.monotonic()
        self._line = self._state(done, failed, now - self._begun)
        if now < self._next_line:
            return
        if sys.stderr.isatty():
            self._draw(done)
        else:
            self._next_line = now + _LINE_EVERY_S
            self._print()

    def stop(self, summary: bool = False) -> None:
        """Remove the bar; leave the last state as a line if it is wanted."""
        if self._bar is not None:
            self._bar.stop()
        if summary and self._line != self._printed:
            self._print()

    def _state(self, done: float, failed: int, spent_s: float) -> str:
        amount = f"{done:.3g}" if isinstance(done, float) else str(done)
        parts = [f"{amount} of {self._total:g}" if self._total else amount]
        if self._unit:
            parts[0] += f" {self._unit}"
            parts.append(f"{done / max(spent_s, 1e-9):.2g} a second")
        else:
            parts[0] += f" after {spent_s:.0f} s"
        if self._total and 0 < done < self._total:
            left_s = (self._total - done) * spent_s / done
            parts.append(f"{left_s / 60:.0f} min left" if left_s > 90 else f"{left_s:.0f} s left")
        if failed:
            parts.append(f"{failed} failed")
        return ": ".join(filter(None, [self._label, ", ".join(parts)]))

    def _print(self) -> None:
        print(self._line, file=sys.stderr, flush=True)
        self._printed = self._line

    def _draw(self, done: float) -> None:
        if self._bar is None:
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn
            from rich.progress import Progress as Bar

            columns = (BarColumn(20), TextColumn("{task.description}", markup=False))
            self._bar = Bar(*columns, console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task("", total=self._total)
            self._bar.start()
        self._bar.update(self._task, completed=done, description=self._line)


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
