"""Every key of conf/ changes a result, or is refused with a reason.

Each key of each class that an option names gets another value, and the recording or the estimate is
made again, as short as can be. The tables say where a key acts that does not act in the usual drive,
and which keys decide no result, with the reason.
"""

import types
from collections.abc import Iterable
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import pytest

from sim.options import find

pytestmark = pytest.mark.slow

DRIVE = ["simulation.physics=kinematic", "world=room", "route.distance_m=3"]
SPAN = ["+hydra.verbose=false"]


def values_of(kind: Any) -> Iterable[Any]:
    """Values that a type names."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    if get_origin(kind) in (Union, types.UnionType, Annotated):
        return [value for part in get_args(kind) for value in values_of(part)]
    return ()


def others(value: Any, kind: Any) -> list[Any]:
    """Other values that a key may take, the likely ones first."""
    named = [other for other in values_of(kind) if other != value]
    if named:
        return named
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, (int, float)):
        return [value * 2, value * 0.5, value + 1, value + 0.1, value - 1, 3, 0.3, -value, 0]
    if value is None:
        return [0.5, 2, 1.0, 0.01, [0.5, 1.0], "laser", "true", [[1, 1], [3, 1], [3, 3]]]
    if isinstance(value, str):
        return []
    return []


def kinds_of(target: str) -> dict[str, Any]:
    named = find(target, "key")
    try:
        return get_type_hints(named, include_extras=True)
    except NameError:
        return {}
