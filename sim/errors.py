"""The one exception for input that a user can mend."""

from typing import TypeVar

T = TypeVar("T")


class InputError(Exception):
    """Wrong input, in one line that names the file, key or line and the remedy.

    The command line prints it as it is and exits with code 2.
    """


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
