"""Digests of a configuration and of the files that it names: what decides rows and recordings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from experiments.runs.row import Row
from experiments.runs.schema import SIMULATED_KEYS, Config, Leaf, leaves
from experiments.runs.version import SIMULATION, code_version, source_digest, version_with
from sim.errors import InputError
from sim.files import require_file
from sim.worlds import grid_file

_NOT_IN_KEY = ("name", "picture", "recording")
_TEAM_KEYS = ("size", "robots")  # of the key `team`, those that decide what is read


def files_digest(tree: Any) -> dict[str, str]:
    """Digest of every file that a mapping names, and of the files in each folder it names.

    A grid's image counts with its YAML file.
    """
    if isinstance(tree, dict):
        return {k: v for value in tree.values() for k, v in files_digest(value).items()}
    if not isinstance(tree, str) or not Path(tree).name:
        return {}
    path = Path(tree)
    try:
        files = [path] if path.is_file() else sorted(path.glob("*")) if path.is_dir() else []
        files += [image for file in files if (image := grid_file.image_of(file)) is not None]
    except OSError:  # too long for a path, say
        return {}
    return {str(file): digest_of(file) for file in files if file.is_file()}


def files_of_options(options: Any) -> dict[str, str]:
    """Digest of every file that an estimator's options name, a list's items included.

    A word without a suffix or a slash is not a file, but the name of a sensor or a method.
    """
    found: dict[str, str] = {}
    for _, value in leaves({"": options}):
        for text in value if isinstance(value, list) else [value]:
            if isinstance(text, str) and ("/" in text or Path(text).suffix):
                found |= files_digest(text)
    return found


def digest_of(path: Path) -> str:
    """SHA-256 of a file.

    Raises
    ------
    InputError
        If it cannot be read, or is not a file.
    """
    require_file(path)
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from error


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
    """Digest of what decides the rows: configuration, recording, map, files named, code.

    It is the sum of a digest for each leaf, and one of files and code, modulo 2^64. So the keys of
    a product of values are sums too, and a sweep of a million runs knows them at once.
    """
    settings = {key: value for key, value in config.items() if key not in _NOT_IN_KEY}
    files = files_digest(config["prior"].get("map"))
    files |= files_of_options(config["estimator"])
    files |= files_digest(config.get("calibration"))
    total = leaf_digest((), [_recording_sources(config), files, version_of(config)])
    total += sum(leaf_digest(leaf, value) for leaf, value in leaves(settings))
    return f"{total % 2**64:016x}"


def recording_key(config: Config) -> str:
    """Digest of what decides the recording's bits: its settings, or a file's; and the code."""
    made = {} if isinstance(config["recording"], str) else {k: config[k] for k in SIMULATED_KEYS}
    if (team := config.get("team")) is not None:
        made["team"] = {key: team.get(key) for key in _TEAM_KEYS}
    settings = {**made, **_recording_sources(config)}
    text = json.dumps({"settings": settings, "code": code_version(SIMULATION)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def effective_config(config: Config) -> Config:
    """Settings without those of a simulation that a recording from a file takes the place of.

    A function that makes the recording or the map may read all of them.
    """
    places = (config["recording"], config["prior"].get("map"))
    made = any(isinstance(place, dict) and "_target_" in place for place in places)
    unused = () if config["recording"] is None or made else set(SIMULATED_KEYS) - {"seed"}
    return {key: value for key, value in config.items() if key not in unused}


def version_of(config: Config) -> str:
    """The code's version, and a digest of what the settings name from elsewhere."""
    return version_with(list_targets(effective_config(config)), config["estimator"].get("command"))


def origin_columns(config: Config, choices: Mapping[str, str], checksum: str) -> Row:
    """Columns that state a row's origin: choices, keys, versions, the recording's checksum.

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
        "code_version": version_of(config),
        "recording_checksum": checksum,
    }


def _cell(value: Any) -> Any:
    """A value as a table's column holds it; a list becomes its text."""
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return str(value)
    return json.dumps(value) if isinstance(value, (list, tuple)) else value


def list_targets(tree: Any) -> set[str]:
    """Every `_target_` of a configuration."""
    if not isinstance(tree, Mapping):
        return set()
    here = {tree["_target_"]} if isinstance(tree.get("_target_"), str) else set()
    return here.union(*(list_targets(value) for value in tree.values()))


def _recording_sources(config: Config) -> Config:
    """Files and code that decide the recording, besides the simulation's settings."""
    wanted = config["recording"]
    if isinstance(wanted, dict):  # its function may read all of the settings
        return {"recording": wanted, "files": files_digest(wanted)}
    if wanted is not None:
        return {"recording": digest_of(Path(wanted))}
    sources: Config = {  # an edited file: another world
        "world_files": list(files_digest(config["world"].get("path")).values()),
        "way": list(files_digest(config["route"].get("path")).values()),
        "feedback_files": files_of_options(config["route"].get("feedback")),
    }
    simulated = {key: config[key] for key in SIMULATED_KEYS}
    elsewhere = {target: source_digest(target) for target in sorted(list_targets(simulated))}
    if any(elsewhere.values()):  # a sensor, route or world of one's own, edited: another one
        sources["sources"] = elsewhere
    if any(target.startswith("estimators.") for target in elsewhere):  # one on board
        sources["code"] = code_version()
    return {name: source for name, source in sources.items() if source}
