"""Digests of a configuration: what runs and recordings are called."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from experiments.runs.columns import DEPENDENCIES
from experiments.runs.row import Row
from experiments.runs.schema import SIMULATED_KEYS, Config, Leaf, leaves
from experiments.runs.version import code_version
from sim.files import sha256_of

_NOT_IN_KEY = ("name", "picture", "recording")
_TEAM_KEYS = ("size", "robots")  # of the key `team`, those that decide what is read


def decides_recording(leaf: Leaf, *, from_file: bool) -> bool:
    """Whether a leaf of the configuration decides which recording is read."""
    of_team = leaf[0] == "team" and leaf[1] in _TEAM_KEYS
    return of_team or (leaf[0] in SIMULATED_KEYS and not from_file)


def leaf_digest(leaf: Leaf, value: Any) -> int:
    """Return 64 bits of a digest of a plain value and its place in the configuration."""
    return next(leaf_digests(leaf, [value]))


def leaf_digests(leaf: Leaf, values: Iterable[Any]) -> Iterator[int]:
    """Give the digest of each of many values of one leaf."""
    place = hashlib.blake2b(json.dumps(leaf).encode(), digest_size=8)
    for value in values:
        nested = isinstance(value, (list, dict))
        digest = place.copy()
        digest.update((json.dumps(value, sort_keys=True) if nested else json.dumps(value)).encode())
        yield int.from_bytes(digest.digest())


def run_key(config: Config) -> str:
    """Digest of the settings that decide the rows, and of a recording that is read.

    It is the sum of a digest for each leaf, modulo 2^64. So the keys of a product of values are
    sums too, and a sweep of a million runs knows them at once. Code and files decide the rows
    besides: see `experiments.runs.dependencies`.
    """
    settings = {key: value for key, value in config.items() if key not in _NOT_IN_KEY}
    total = leaf_digest((), _read(config))
    total += sum(leaf_digest(leaf, value) for leaf, value in leaves(settings))
    return f"{total % 2**64:016x}"


def recording_key(config: Config) -> str:
    """Digest of the settings that decide the recording's bits, or of its file."""
    made = {} if isinstance(config["recording"], str) else {k: config[k] for k in SIMULATED_KEYS}
    if (team := config.get("team")) is not None:
        made["team"] = {key: team.get(key) for key in _TEAM_KEYS}
    text = json.dumps({**made, "recording": _read(config)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def effective_config(config: Config) -> Config:
    """Settings without those of a simulation that a recording from a file takes the place of.

    A function that makes the recording or the map may read all of them.
    """
    places = (config["recording"], config["prior"].get("map"))
    made = any(isinstance(place, dict) and "_target_" in place for place in places)
    unused = () if config["recording"] is None or made else set(SIMULATED_KEYS) - {"seed"}
    return {key: value for key, value in config.items() if key not in unused}


def origin_columns(config: Config, choices: Mapping[str, str], checksum: str) -> Row:
    """Columns that state a row's origin: choices, keys, version, the recording's checksum.

    Settings that did not make the recording have no column.
    """
    stated = effective_config(config)
    brought = () if config["recording"] is None else ("world", "sensors", "route")
    shown = {key: value for key, value in stated.items() if key not in ("keep", "picture")}
    return {
        **{f"choice.{g}": n for g, n in choices.items() if g in stated and g not in brought},
        **{".".join(map(str, at)): _cell(value) for at, value in leaves(shown) if value != {}},
        "repeat": 0,
        "run_key": run_key(config),
        "code_version": code_version(),
        DEPENDENCIES: "",
        "recording_checksum": checksum,
    }


def _cell(value: Any) -> Any:
    """A value as a table's column holds it; a list becomes its text."""
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return str(value)
    return json.dumps(value) if isinstance(value, (list, tuple)) else value


def _read(config: Config) -> Any:
    """The recording's file by its bytes, wherever it lies; a function that makes one, as it is."""
    wanted = config["recording"]
    return sha256_of(Path(wanted)) if isinstance(wanted, str) else wanted
