"""From plain mappings to the frozen dataclasses of this package, with errors that name the key."""

import dataclasses
import importlib
import math
from collections.abc import Callable, Mapping
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from sim.errors import InputError, require

T = TypeVar("T")


def build(cls: type[T], settings: Mapping[str, Any], where: str) -> T:
    """Make a dataclass from a mapping.

    Parameters
    ----------
    cls
        A dataclass whose fields are the allowed keys; a field may be a dataclass too.
    settings
        The mapping; numbers are checked to be numbers.
    where
        Its place in the configuration, for messages.

    Raises
    ------
    InputError
        For an unknown or missing key, or a value of the wrong type.
    """
    require(
        isinstance(settings, Mapping),
        f"{where} must be a mapping of keys to values, got {settings!r}",
    )
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    kinds = get_type_hints(cls)
    for key, value in settings.items():
        require(key in fields, f"unknown key {where}.{key}; known: {', '.join(fields)}")
        values[key] = _checked(value, kinds[key], f"{where}.{key}")
    for name, f in fields.items():
        bare = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        require(not bare or name in values, f"{where}.{name} is missing")
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
        require(
            math.isfinite(value) and (value > 0.0 or (value == 0.0 and name in not_negative)),
            f"{where}.{name} must be {wanted}, got {value}",
        )


def find(target: Any, where: str) -> Callable[..., Any]:
    """Import the class or function that a `_target_` names.

    Raises
    ------
    InputError
        If there is none.
    """
    require(
        isinstance(target, str) and "." in target,
        f"{where}._target_ must name a class or function, such as mine.Mine",
    )
    module_name, _, name = target.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise InputError(
            f"{where}._target_={target}: no module {error.name}; is its folder on PYTHONPATH?"
        ) from error
    found: Any = getattr(module, name, None)
    require(callable(found), f"{where}._target_={target}: {module_name} has no class {name}")
    return found  # type: ignore[no-any-return]


def _checked(value: Any, kind: Any, where: str) -> Any:
    kinds = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    if value is None and NoneType in kinds:
        return value
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if float in kinds:
        require(number, f"{where} must be a number, got {value!r}")
        return float(value)
    if int in kinds:
        require(
            number and float(value).is_integer(), f"{where} must be a whole number, got {value!r}"
        )
        return int(value)
    require(
        bool not in kinds or isinstance(value, bool),
        f"{where} must be true or false, got {value!r}",
    )
    part = next((k for k in kinds if isinstance(k, type) and dataclasses.is_dataclass(k)), None)
    return value if part is None or isinstance(value, part) else build(part, value, where)
