"""Digests of a configuration and of the files that it names: what decides rows and recordings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from experiments.runs.schema import SIMULATED_KEYS, Leaf, leaves
from sim.errors import InputError
from sim.worlds import grid_file

TEAM_KEYS = ("size", "robots")  # of the key `team`, those that decide what is read


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

    A word without a suffix or a slash is no file, but the name of a sensor or a method.
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
        If it cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from error


def decides_recording(leaf: Leaf, *, from_file: bool) -> bool:
    """Whether a leaf of the configuration decides which recording is read."""
    of_team = leaf[0] == "team" and leaf[1] in TEAM_KEYS
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
