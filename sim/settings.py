"""From plain mappings to the frozen dataclasses of this package, with errors that name the key."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, TypeVar

from sim.errors import InputError

T = TypeVar("T")


def build(cls: type[T], settings: Mapping[str, Any], where: str) -> T:
    """Make a dataclass from a mapping.

    Parameters
    ----------
    cls
        A dataclass whose fields are the allowed keys.
    settings
        The mapping; numbers are checked to be numbers.
    where
        Its place in the configuration, for messages.

    Raises
    ------
    InputError
        For an unknown or missing key, or a value of the wrong type.
    """
    if not isinstance(settings, Mapping):
        raise InputError(f"{where} must be a mapping of keys to values, got {settings!r}")
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in settings.items():
        if key not in fields:
            raise InputError(f"unknown key {where}.{key}; known: {', '.join(fields)}")
        values[key] = _checked(value, str(fields[key].type), f"{where}.{key}")
    for name, f in fields.items():
        bare = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if bare and name not in values:
            raise InputError(f"{where}.{name} is missing")
    return cls(**values)


def check_numbers(
    where: str, settings: object, positive: tuple[str, ...] = (), not_negative: tuple[str, ...] = ()
) -> None:
    """Check that attributes are finite and positive, or at least not negative.

    Raises
    ------
    InputError
        Naming the first attribute that is not, as `where.name`.
    """
    for name in (*positive, *not_negative):
        value = getattr(settings, name)
        wanted = "a positive number" if name in positive else "zero or a positive number"
        if not (math.isfinite(value) and (value > 0.0 or (value == 0.0 and name in not_negative))):
            raise InputError(f"{where}.{name} must be {wanted}, got {value}")


def _checked(value: Any, annotation: str, where: str) -> Any:
    kind = annotation.split(" ", maxsplit=1)[0]
    if value is None and "None" in annotation:
        return value
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind == "float":
        if not number:
            raise InputError(f"{where} must be a number, got {value!r}")
        return float(value)
    if kind == "int":
        if not (number and float(value).is_integer()):
            raise InputError(f"{where} must be a whole number, got {value!r}")
        return int(value)
    if kind == "bool" and not isinstance(value, bool):
        raise InputError(f"{where} must be true or false, got {value!r}")
    return value
