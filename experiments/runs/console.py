"""Terminal output: progress, and the one line that ends a failed command."""

from __future__ import annotations

import errno
import math
import os
import re
import signal
import sys
import textwrap
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from experiments.runs.paths import option_names
from sim.errors import InputError, nearest, printable

if TYPE_CHECKING:
    from sim.recording import Recording

_QUIET_S = 2.0  # what ends sooner shows no progress
_LINE_EVERY_S = 10.0  # where the output is a file
# A time left is shown once there is a rate to judge it by
_RATED_S, _RATED_SHARE, _RATED_UNITS = 10.0, 0.05, 10


TRUSTING = "if you trust where it comes from, add --trust (docs/security.md)"


class RunFailedError(Exception):
    """A run failed; its row says how."""


@contextmanager
def progress(
    label: str, total: float | None = None, unit: str = "", *, summary: bool = False
) -> Iterator[Callable[..., None]]:
    """Yield a function that takes the amount done, and how much of it failed (by default none).

    It draws a bar on a terminal, and prints a line now and then elsewhere; of what is counted, only
    when more is done. Nothing is shown for the first two seconds, and no time left for the first
    ten, nor before a twentieth is done, or ten of a unit that is counted. With `restart` the rate,
    and so the time left, counts from there on.

    Parameters
    ----------
    total
        The amount when all is done, or about that; None if unknown, 1.0 if the amount is a share.
    unit
        What is counted, such as runs; their rate is then shown too.
    summary
        Print the last state, even if all took less than two seconds.
    """
    begun = time.monotonic()
    next_line, line, printed = begun + _QUIET_S, "", ""
    start, start_s, last = 0.0, begun, (0.0, 0)
    bar = _bar(total) if sys.stderr.isatty() else None

    def update(done: float, failed: int = 0, *, restart: bool = False) -> None:
        nonlocal next_line, line, printed, start, start_s, last
        now = time.monotonic()
        if restart:
            start, start_s = done, now
        rate = (done - start) / max(now - start_s, 1e-9)
        state = _state(done, total, unit, now - begun, rate)
        line = f"{label}: {state}" if label else state
        enough = _RATED_UNITS if unit else math.inf  # a first Frame may have to compile
        rated = done - start >= min(_RATED_SHARE * (total or math.inf), enough)
        if total and done < total and rated and now - start_s >= _RATED_S:
            line += f", {_time((total - done) / rate)} left"
        if failed:
            line += f", {failed} failed"
        if now < next_line:
            return
        if bar is not None:
            bar.start()
            bar.update(bar.task_ids[0], completed=done, description=line)
            return
        if unit and last == (done, failed):
            return
        next_line, printed, last = now + _LINE_EVERY_S, line, (done, failed)
        print(line, file=sys.stderr, flush=True)

    try:
        yield update
    finally:
        if bar is not None:
            bar.stop()
        if summary and line != printed:
            print(line, file=sys.stderr, flush=True)


def _bar(total: float | None) -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    description = TextColumn("{task.description}", markup=False)
    bar = Progress(BarColumn(20), description, console=Console(stderr=True), transient=True)
    bar.add_task("", total=total)
    return bar


def _state(done: float, total: float | None, unit: str, spent_s: float, rate: float) -> str:
    """The amount done, and after how long or at what rate."""
    amount = f"{done:.3g}" if isinstance(done, float) else str(done)
    if total == 1.0 and not unit:
        amount = f"{100 * done:.0f} %"
    elif total:
        amount += f" of {max(total, done):g}"
    if not unit:
        return f"{amount} after {spent_s:.0f} s"
    return f"{amount} {unit}, {rate:.2g} a second" if rate else f"{amount} {unit}"


def _time(s: float) -> str:
    return f"{s / 60:.0f} min" if s > 90 else f"{s:.0f} s"


def exit_with(error: BaseException) -> NoReturn:
    """End the program with one line for what the user can fix: code 2 for input, 1 for failures.

    So it ends after an interrupt, with that one's message and code 130.

    An internal error ends with its traceback and code 3.
    """
    chain: list[BaseException] = [error]
    while (before := chain[-1].__cause__ or chain[-1].__context__) is not None:
        chain.append(before)
    chain.sort(key=lambda link: not isinstance(link, KeyboardInterrupt))  # it may cause others
    for link in chain:
        if isinstance(link, InputError):
            _say(str(link), 2)
        programs = sys.modules.get("estimators.programs.program")
        if isinstance(link, (RunFailedError, getattr(programs, "ProgramError", RunFailedError))):
            _say(f"the run failed: {link}", 1)
        if isinstance(link, KeyboardInterrupt):
            for again in (signal.SIGINT, signal.SIGTERM):  # what is said is said whole
                signal.signal(again, signal.SIG_IGN)
            _say(str(link) or "interrupted; what a sweep, study or check has finished is kept", 130)
        if (refused := as_input_error(link)) is not None:
            _say(str(refused), 2)
        if isinstance(link, OSError) and link is error:
            _say_system(link)
        if isinstance(link, MemoryError):
            _say(f"not enough memory: {str(link) or 'nothing said'}; ask for less at once", 1)
        if isinstance(link, RecursionError) and _in_defaults(link):
            _say("configuration: the defaults of an option lead back to itself", 2)
    traceback.print_exception(error)
    sys.exit(3)


def as_input_error(error: BaseException) -> InputError | None:
    """What Hydra refuses, as an error of ours; None of another error."""
    if not isinstance(error, _configuration_errors()):
        return None
    if refusal := _refusal(error):
        return InputError(refusal)
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = textwrap.shorten(" ".join(lines), 600, placeholder=" ...")
    if deleted := re.search(r"Could not delete from config\. '([\w.]+)' does not exist", text):
        key = deleted.group(1)
        return InputError(f"~{key}: a key cannot be left out; set it, such as {key}=null")
    return InputError(f"configuration: {text.rstrip('.')}; see estima run --cfg job")


def _say_system(error: OSError) -> NoReturn:
    """End with what the system says of a file; or of the output, which may be a closed pipe."""
    if error.filename is not None:
        _say(f"{error.filename}: {error.strerror}; check its name and your rights", 2)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # else Python tries again when it ends
    if error.errno == errno.EPIPE:  # whoever reads has seen enough
        sys.exit(1)
    _say(f"cannot write or read ({error.strerror or error}); is the output full or closed?", 1)


def _in_defaults(error: BaseException) -> bool:
    """Whether an error comes from Hydra's search through the defaults of options."""
    frames = traceback.walk_tb(error.__traceback__)
    return any(f.f_globals.get("__name__") == "hydra._internal.defaults_list" for f, _ in frames)


def _refusal(error: BaseException) -> str | None:
    """Describe what Hydra could not find, with the alternatives; None for other errors."""
    missing, options = (getattr(error, name, None) for name in ("missing_cfg_file", "options"))
    if not (missing and options):
        return None
    group, _, name = missing.rpartition("/")
    every = sorted({*options, *option_names(group)})
    return no_option(group, name, every)


def no_option(group: str, name: str, options: Iterable[str]) -> str:
    """Say that a group has no such option, which may be meant, and what lists all."""
    others = nearest(name, options)
    remedy = f"; estima options {group} lists all" if others.endswith(" more") else ""
    return f"no {group} named {name}; {others}{remedy}"


def _configuration_errors() -> tuple[type[Exception], ...]:
    """Errors of Hydra, OmegaConf and YAML, if they have been imported."""
    names = ("hydra.errors.HydraException", "omegaconf.errors.OmegaConfBaseException")
    places = [name.rpartition(".") for name in (*names, "yaml.YAMLError")]
    return tuple(getattr(sys.modules[m], name) for m, _, name in places if m in sys.modules)


def pluralize(n: int, what: str) -> str:
    """A number of things, such as 1 run or 2 runs."""
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def enumerate_words(words: Sequence[str]) -> str:
    """Write words as an enumeration, such as a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def show(text: str) -> None:
    """Print text that may come from a file, with ? for what the terminal cannot or must not show.

    Those are characters that would control it, and those that its encoding lacks.
    """
    _write("\n".join(map(printable, text.split("\n"))), sys.stdout)


def read_log(log: Sequence[Path], robot: int | None = None, *, by_flag: bool = True) -> Recording:
    """Read a log of one robot, as `read_any` does; of several say which it is.

    Parameters
    ----------
    by_flag
        As for `describe_choice`.
    """
    from sim.formats.detect import read_any

    recording = read_any(log, robot)
    if robot is None:
        say_choice(log[0], recording, by_flag=by_flag)
    return recording


def say_choice(path: Path, recording: Recording, *, by_flag: bool = False) -> None:
    """Say which robot of several a recording is that nobody chose."""
    from sim.formats.detect import describe_choice

    if choice := describe_choice(path, recording, by_flag=by_flag):
        show(choice)


def warn(text: str) -> None:
    """Print text to the error stream, as `show` prints to the output."""
    _write("\n".join(map(printable, text.split("\n"))), sys.stderr)


def _say(message: str, code: int) -> NoReturn:
    _write(printable(" ".join(f"estima: {message}".splitlines())), sys.stderr)
    sys.exit(code)


def _write(text: str, stream: TextIO) -> None:
    """Print text with ? for what the stream's encoding lacks.

    Raises
    ------
    InputError
        If an estimator has closed the output.
    """
    if stream.closed:
        if stream is sys.stderr:
            return
        raise InputError(
            "the standard output is closed, by code of an estimator's or a sensor's: what was to "
            "be printed is lost, files are written"
        )
    encoding = stream.encoding or "utf-8"
    with suppress(OSError) if stream is sys.stderr else nullcontext():  # nowhere else to say it
        print(text.encode(encoding, "replace").decode(encoding), file=stream, flush=True)
