"""The one exception for input that a user can mend, and text that is safe to show."""

import difflib
import re
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
# What controls a terminal or turns the direction of text, and what XML 1.0 forbids
_UNPRINTABLE = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufeff\ufffe\uffff]"
)
_LISTED = 12  # names that a message lists
_BEGIN, _END = 1500, 500  # characters of a long message that are kept: its remedy comes last


class InputError(Exception):
    """Wrong input, in one line that names the file, key or line and the remedy.

    The command line prints it as it is and exits with code 2. What the message quotes from a file
    is made printable, and cut if it is long.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


def one_line(text: str) -> str:
    """Make a text of somebody else's one printable line, cut in its middle if it is long."""
    line = printable(" ".join(text.splitlines()))
    return line if len(line) <= _BEGIN + _END else f"{line[:_BEGIN]} ... {line[-_END:]}"


def printable(text: str) -> str:
    """Replace by ? what would control a terminal, and what XML 1.0 forbids."""
    return _UNPRINTABLE.sub("?", text)


def nearest(name: str, known: Iterable[str], place: str = "", there: str = "there are: ") -> str:
    """Say which of the known names is spelled most like one, and which others there are.

    Examples
    --------
    >>> nearest("sart", ["map", "start"])
    'did you mean start? there are: start, map'
    """
    names, first = list(known), str(name).partition(".")[0]
    near = difflib.get_close_matches(str(name), names, n=3)  # a file's may be any value
    near = near or difflib.get_close_matches(first, names, n=3)
    listed = [f"{place}{one}" for one in dict.fromkeys([*near, *names])]
    meant = f"did you mean {listed[0]}? " if near else ""
    more = f" and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
    return f"{meant}{there}{', '.join(listed[:_LISTED]) or 'none'}{more}"


def describe_unknown(key: str, known: Iterable[str], where: str = "") -> str:
    """Say that a key of a place is unknown, which may be meant, and which are known there.

    Examples
    --------
    >>> describe_unknown("sart", ["map", "start"], "prior")
    'unknown key prior.sart; did you mean prior.start? known: prior.start, prior.map'
    """
    place = f"{where}." if where else ""
    return f"unknown key {place}{key}; {nearest(key, known, place, 'known: ')}"


@contextmanager
def blaming(where: str) -> Iterator[None]:
    """What a user's own code raises becomes an InputError: where it is named, what, which line.

    Examples
    --------
    >>> with blaming("sensors.sonar"):
    ...     1 / 0
    Traceback (most recent call last):
    sim.errors.InputError: sensors.sonar raised ZeroDivisionError: division by zero (<doctest sim.errors.blaming[0]>:2)
    """  # noqa: E501 the message is one line
    try:
        yield
    except (InputError, KeyboardInterrupt):
        raise
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        reason = " ".join(str(error).split()) or "nothing said"
        place = f"{Path(last.filename).name}:{last.lineno}"
        raise InputError(f"{where} raised {type(error).__name__}: {reason} ({place})") from error


@contextmanager
def naming(where: object) -> Iterator[None]:
    """Put a place, such as a file, before the message of an InputError."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def how_to_install(extra: str) -> str:
    """Say how an extra of the package is installed, in a clone and elsewhere."""
    return f"`make setup EXTRAS={extra}` in a clone, else `pip install 'estima[{extra}]'`"


def required(value: T | None, complaint: str) -> T:
    """Return the value.

    Raises
    ------
    InputError
        With the complaint, if the value is None.
    """
    if value is None:
        raise InputError(complaint)
    return value


def require(holds: object, complaint: str) -> None:
    """Check a condition.

    Raises
    ------
    InputError
        With the complaint, if the condition does not hold.
    """
    if not holds:
        raise InputError(complaint)
