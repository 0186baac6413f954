"""Names in braces that stand for the files of a program's command line."""

import re
from collections.abc import Mapping

NAMES = ("log", "mcap", "npz", "map", "grid", "start", "seed", "out")
_NEEDED_BY = {"laser": ("log", "grid"), "map": ("map", "grid")}
_PLACE = re.compile(r"\{(\w+)\}")


def places_in(command: str) -> set[str]:
    """Names that stand in braces in a command."""
    return set(_PLACE.findall(command))


def needs_of(command: str) -> frozenset[str]:
    """The sensors, and `map`, from which the files that a command names are made."""
    places = places_in(command)
    return frozenset(need for need, of in _NEEDED_BY.items() if places.intersection(of))


def fill(word: str, places: Mapping[str, str]) -> str:
    """Replace each name in braces; a KeyError for one that is not in `places`."""
    return _PLACE.sub(lambda found: places[found[1]], word)
