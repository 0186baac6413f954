"""Options: frozen dataclasses whose fields hold default, bound and meaning, each of them once.

A class of options is decorated with `options`; a field's type states its bound, and the docstring
below the field its meaning, with unit and source::

    @options("estimator")
    class WheelOptions:
        kr: NonNegative = 1e-4
        '''Believed slip variance per metre of the right wheel, m (puzzlebot2024, eq. (5)).'''

The constructor, the configuration and `estima options` read the same fields. A method inherits its
options, `class Mcl(MclOptions)`: its options stay frozen, and it may keep a state of its own.
Options that several methods share stand in a class that theirs inherit.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar, cast, dataclass_transform, get_args, get_origin

from pydantic import ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from sim.errors import InputError

T = TypeVar("T")

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Probability = Annotated[float, Field(gt=0.0, lt=1.0)]
Count = Annotated[int, Field(ge=1)]

_CONFIG = ConfigDict(
    extra="forbid",
    strict=True,  # no text is taken for a number
    allow_inf_nan=False,
    arbitrary_types_allowed=True,
    use_attribute_docstrings=True,
)
_SIGNS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
_WHOLE = {
    (("gt", 0.0),): "a positive number",
    (("ge", 0.0),): "zero or a positive number",
    (("ge", 0.0), ("le", 1.0)): "a number in [0, 1]",
    (("gt", 0.0), ("lt", 1.0)): "a number between 0 and 1",
}


@dataclasses.dataclass(frozen=True)
class Option:
    """One option, as `estima options` shows it.

    Attributes
    ----------
    name, default
        Its key, and its default; `dataclasses.MISSING` where it has none.
    accepts
        The values that it accepts, in words.
    meaning
        What it means, with its unit and source; empty for one that is not documented.
    """

    name: str
    default: Any
    accepts: str
    meaning: str


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(Field,))
def options(where: str) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen dataclass that checks its fields' bounds; `where` is for messages.

    Raises
    ------
    InputError
        By the constructor, naming the field as `where.field` and what it accepts.
    """

    def decorate(cls: type[T]) -> type[T]:
        # as they are, also where `from __future__ import annotations` makes texts of them
        cls.__annotations__ = inspect.get_annotations(cls, eval_str=True)
        made: Any = checked_dataclass(frozen=True, kw_only=True, config=_CONFIG)(cls)
        construct = made.__init__

        @functools.wraps(construct)
        def checked(self: Any, *given: Any, **named: Any) -> None:
            try:
                construct(self, *given, **named)
            except ValidationError as error:
                raise InputError(_complaint(type(self), where, error)) from None

        made.__init__ = checked
        return cast("type[T]", made)

    return decorate


def described(target: Any) -> list[Option]:
    """Options of a class or function: of its signature, in order, with the fields' meanings."""
    fields: dict[str, Any] = {}
    for base in reversed(getattr(target, "__mro__", ())):
        own = vars(base).get("__pydantic_fields__", {})
        fields |= {name: field for name, field in own.items() if field.description}
    found = []
    for name, parameter in inspect.signature(target).parameters.items():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        bare = parameter.default is parameter.empty
        meaning = " ".join(fields[name].description.split()) if name in fields else ""
        found.append(
            Option(
                name,
                dataclasses.MISSING if bare else parameter.default,
                accepted(parameter.annotation),
                meaning,
            )
        )
    return found


def accepted(kind: Any) -> str:
    """Say what values a field's type accepts, such as "a number in [0, 1]"."""
    if isinstance(kind, str):
        return ""
    parts = get_args(kind)
    if get_origin(kind) is Annotated:
        bounds: list[tuple[str, float]] = []
        for extra in parts[1:]:
            for limit in getattr(extra, "metadata", [extra]):
                bounds += [(s, getattr(limit, s)) for s in _SIGNS if hasattr(limit, s)]
        whole = parts[0] is int
        if not whole and tuple(bounds) in _WHOLE:
            return _WHOLE[tuple(bounds)]
        said = " and ".join(f"{_SIGNS[sign]} {_shown(limit)}" for sign, limit in bounds)
        if [sign for sign, _ in bounds] == ["ge", "le"]:
            said = f"from {_shown(bounds[0][1])} to {_shown(bounds[1][1])}"
        return (
            f"{'a whole number' if whole else 'a number'}, {said}" if said else accepted(parts[0])
        )
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if type(None) in parts:
        others = [accepted(part) for part in parts if part is not type(None)]
        return f"{' or '.join(filter(None, others)) or 'a value'} or null"
    plain = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    return plain.get(kind, "")


def _shown(limit: float) -> str:
    """A bound; whole numbers in full."""
    return str(limit) if isinstance(limit, int) else f"{limit:g}"


def _complaint(cls: type, where: str, error: ValidationError) -> str:
    """One line about the first field that is wrong."""
    first = error.errors(include_url=False)[0]
    name = str(first["loc"][0]) if first["loc"] else ""
    known = {option.name: option for option in described(cls)}
    if name not in known:
        return f"unknown key {where}.{name}; known: {', '.join(known)}"
    if first["type"] == "missing":
        return f"{where}.{name} is missing"
    wanted = known[name].accepts
    return f"{where}.{name} must be {wanted or first['msg']}, got {first['input']!r}"
