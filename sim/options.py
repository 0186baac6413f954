"""Options: frozen dataclasses whose fields hold default, bound and meaning, each of them once.

A class of options is decorated with `options`; a field's type states its bound, and the docstring
below the field its meaning, with unit and source::

    @options("estimator")
    class WheelOptions:
        kr: NonNegative = 1e-4
        '''Believed slip variance per metre of the right wheel, m (puzzlebot2024, eq. (5)).'''

The constructor, the configuration and `estima options` read the same fields. A method inherits its
options, `class Mcl(MclOptions)`: its options stay frozen, and it may keep a state of its own.
Options that several methods share stand in a class that theirs inherit. `build` makes such a class,
or a plain dataclass, from a mapping of a configuration.
"""

import ast
import dataclasses
import functools
import inspect
import itertools
import math
import textwrap
from collections.abc import Callable, Mapping
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import ConfigDict, Field, Strict, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from sim.errors import InputError, blaming, describe_unknown, nearest, require

T = TypeVar("T")

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Probability = Annotated[float, Field(gt=0.0, lt=1.0)]
Count = Annotated[int, Field(ge=1)]
Offset = Annotated[float, Field(ge=-100.0, le=100.0)]  # m, of what a robot carries
Turn = Annotated[float, Field(ge=-2.0 * math.pi, le=2.0 * math.pi)]
Acute = Annotated[float, Field(gt=0.0, lt=math.pi)]
# Of a YAML's lists; a text in an Annotated says what the type accepts
Point = Annotated[tuple[float, float], Strict(False), "a point [x, y]"]
Points = Annotated[tuple[Point, ...], Strict(False), "points [x, y], m"]

_CONFIG = ConfigDict(
    extra="forbid",
    strict=True,  # no text is taken for a number
    allow_inf_nan=False,
    arbitrary_types_allowed=True,
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

        # on the constructor, so that a subclass with a constructor of its own has its signature
        itself = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
        signature = inspect.signature(made)
        vars(checked)["__signature__"] = signature.replace(
            parameters=[itself, *signature.parameters.values()]
        )
        del made.__signature__
        made.__init__ = checked
        made.__setattr__ = _set_state
        made._options_place = where
        return cast("type[T]", made)

    return decorate


@functools.cache
def _option_names(cls: Any) -> frozenset[str]:
    """Names of the fields of all classes of options that a class inherits."""
    inherited: list[Any] = [base for base in cls.__mro__ if "_options_place" in vars(base)]
    return frozenset(name for base in inherited for name in base.__dataclass_fields__)


def _set_state(self: Any, name: str, value: Any) -> None:
    """Let a method keep a state, not change its options.

    The dataclass's own goes through every class that is inherited: 4 us a value, in every step.
    """
    cls: Any = type(self)
    if name in _option_names(cls) or "_options_place" in vars(cls):
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")
    object.__setattr__(self, name, value)


def build(cls: type[T], settings: Mapping[str, Any], where: str) -> T:
    """Make a dataclass, checked or plain, from a mapping.

    Parameters
    ----------
    cls
        Its fields are the allowed keys; a field may be a dataclass too.
    settings
        The mapping. A whole number such as 3.0 may stand for an integer.
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
    kinds = get_type_hints(cls)
    own: str | None = getattr(cls, "_options_place", None)
    values: dict[str, Any] = {}
    for key, value in settings.items():
        place = f"{where}.{key}"
        if key not in fields:
            raise InputError(describe_unknown(key, fields, where))
        values[key] = _fitted(value, kinds[key], place, check=own is None)
    for name, f in fields.items():
        bare = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        require(not bare or name in values, f"{where}.{name} is missing")
    try:
        return cls(**values)
    except InputError as error:
        raise InputError(str(error).replace(f"{own or where}.", f"{where}.")) from None


def find(target: Any, where: str) -> Callable[..., Any]:
    """Import the class or function that a `_target_` names.

    Raises
    ------
    InputError
        If there is none.
    """
    require(
        isinstance(target, str) and "." in target,
        f"{where}._target_ must name a class or function, such as mine.Mine"
        + ("; a file of walls is world=from_file world.path=FILE" if where == "world" else ""),
    )
    module_name, _, name = target.rpartition(".")
    with blaming(f"{where}._target_={target}"):  # what its module does when it is imported
        try:
            module: Any = __import__(module_name, fromlist=["_"])  # is seen by who records it
        except ModuleNotFoundError as error:
            raise InputError(
                f"{where}._target_={target}: no module {error.name} in the current folder, "
                "in that of --config-dir, or on PYTHONPATH"
            ) from error
    found: Any = getattr(module, name, None)
    if not callable(found):
        classes = (v for v in vars(module).values() if inspect.isclass(v))
        own = [v.__name__ for v in classes if v.__module__ == module.__name__]
        missing = f"{module_name} has no class {name}; {nearest(name, own)}"
        raise InputError(f"{where}._target_={target}: {missing}")
    try:
        inspect.signature(found)
    except ValueError as error:  # such as dict
        raise InputError(
            f"{where}._target_={target}: Python does not know its arguments"
        ) from error
    return found  # type: ignore[no-any-return]


def defaults(target: Any) -> dict[str, Any]:
    """Default of each option of a class or function, in order; `dataclasses.MISSING` for none.

    Raises
    ------
    ValueError
        If it has no signature.
    """
    return {
        name: dataclasses.MISSING if parameter.default is parameter.empty else parameter.default
        for name, parameter in inspect.signature(target).parameters.items()
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    }


def described(target: Any) -> list[Option]:
    """Options of a class or function: of its signature, in order, with the fields' meanings."""
    meanings: dict[str, str] = {}
    for base in reversed(getattr(target, "__mro__", ())):
        meanings |= _meanings(base) if "_options_place" in vars(base) else {}
    try:
        kinds = get_type_hints(target, include_extras=True)
    except NameError:  # of a stranger's class, whose types are not all imported at run time
        kinds = {}
    parameters = inspect.signature(target).parameters
    return [
        Option(
            name,
            default,
            accepted(kinds.get(name, parameters[name].annotation)),
            meanings.get(name, ""),
        )
        for name, default in defaults(target).items()
    ]


@functools.cache
def _meanings(cls: type) -> dict[str, str]:
    """Docstrings below the fields of a class, on one line each; reading them takes milliseconds."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
    except (OSError, SyntaxError):  # typed in
        return {}
    found = {}
    for field, said in itertools.pairwise(tree.body[0].body):  # type: ignore[attr-defined]
        match field, said:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                found[name] = " ".join(inspect.cleandoc(text).split())
    return found


def accepted(kind: Any) -> str:
    """Say what values a field's type accepts, such as "a number in [0, 1]"."""
    if isinstance(kind, str):
        return ""
    parts = get_args(kind)
    if get_origin(kind) is Annotated:
        for extra in parts[1:]:
            if isinstance(extra, str):
                return extra  # says it in words
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
        comma = "," if said.startswith("at ") else ""  # above 0, from 1 to 3 follow without
        return f"{accepted(parts[0])}{comma} {said}".rstrip()
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if type(None) in parts:
        others = [accepted(part) for part in parts if part is not type(None)]
        return f"{' or '.join(filter(None, others)) or 'a value'}, or null"
    plain = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    return plain.get(kind, "")


def _fitted(value: Any, kind: Any, where: str, *, check: bool) -> Any:
    """Value with the type of its field where a YAML has another; `check` that it is so."""
    kinds = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    part = next((k for k in kinds if isinstance(k, type) and dataclasses.is_dataclass(k)), None)
    if part is not None and not (isinstance(value, part) or (value is None and part is not kind)):
        return build(part, value, where)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if number and float in kinds:
        return float(value)
    if number and int in kinds and float(value).is_integer():
        return int(value)
    scalar = next((k for k in (float, int, bool) if k in kinds), None)
    if check and scalar is not None and not isinstance(value, tuple(_classes(kinds))):
        raise InputError(f"{where} must be {accepted(scalar)}, got {value!r}")
    return value


def _classes(kinds: tuple[Any, ...]) -> list[type]:
    """Classes of which a checked value may be; True is an int, and yet no number."""
    return [k for k in kinds if isinstance(k, type) and k not in (float, int)]


def _shown(limit: float) -> str:
    """A bound; whole numbers in full."""
    return str(limit) if isinstance(limit, int) else f"{limit:g}"


def _complaint(cls: type, where: str, error: ValidationError) -> str:
    """One line about the first field that is wrong."""
    first = error.errors(include_url=False)[0]
    name = str(first["loc"][0]) if first["loc"] else ""
    place = f"{where}.{name}" if where else name
    known = {option.name: option for option in described(cls)}
    if name not in known:
        return describe_unknown(name, known, where)
    if first["type"] == "missing" and len(first["loc"]) == 1:
        return f"{place} is missing"
    wanted = known[name].accepts or first["msg"].removeprefix("Input should be ")
    row = "".join(f"[{number}]" for number in first["loc"][1:2])  # of a list
    return f"{place}{row} must be {wanted}, got {first['input']!r}"
