"""A cache of recordings, addressed by a digest of their settings: a sweep simulates each once.

An entry says what else it depends on, and is made again when that has changed. The cache holds at
most $ESTIMA_CACHE_GIB (8 unless set); the least recently used go first.
"""

import dataclasses
import os
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from experiments.runs import paths
from experiments.runs.console import warn
from experiments.runs.dependencies.digests import changed
from experiments.runs.dependencies.recorder import Digests, note
from experiments.runs.processes import hold_lock
from sim.errors import InputError, require
from sim.files import require_file
from sim.recording import Recording, load, save

_LIMIT_GIB = 8.0
_TRIMS_PER_LIMIT = 64  # so often is the cache trimmed while as much is written as it holds
_ABANDONED_S = 3600.0  # what is still half-written then, nobody writes
_KEY, _DEPENDENCIES = "cache_key", "cache_dependencies"  # in the configuration of an entry


def folder() -> Path:
    """Folder of the cached recordings."""
    return paths.results() / "cache" / "recordings"


def fetch_or_make(key: str, make: Callable[[], tuple[Recording, Digests]]) -> Recording:
    """Recording of the key, from the cache, or made now and cached.

    Safe with several processes: the second waits for the first and reads its file. A file that
    does not match its checksum, or holds the recording of another key, is dropped and made again.

    Parameters
    ----------
    make
        Makes the recording, and says what it depends on.
    """
    path = folder() / f"{key}.npz"
    limit = limit_bytes()
    with hold_lock(path.with_suffix(".lock")):
        if path.exists():
            require_file(path)
            try:
                recording, dependencies = _entry(path, key)
                if not changed(dependencies):
                    os.utime(path)
                    note(dependencies)
                    return recording
                path.unlink(missing_ok=True)
            except InputError as error:
                warn(f"estima: {error}; making it again")
                path.unlink(missing_ok=True)
        recording, dependencies = make()
        note(dependencies)
        own = {_KEY: key, _DEPENDENCIES: dict(dependencies)}
        entry = dataclasses.replace(recording, config={**recording.config, **own})
        save(entry, path, durable=False)
        size = path.stat().st_size
    draw = zlib.crc32(key.encode()) / 2**32  # from 0 to 1: trimming looks at every file
    if draw * limit < size * _TRIMS_PER_LIMIT:
        trim(limit)
    return recording


def _entry(path: Path, key: str) -> tuple[Recording, Digests]:
    """Read a recording of the cache, which holds its key and dependencies, under its checksum."""
    entry = load(path)
    settings = dict(entry.config)
    require(settings.pop(_KEY, None) == key, f"{path}: the recording of another key")
    dependencies = settings.pop(_DEPENDENCIES, None)
    require(isinstance(dependencies, dict), f"{path}: does not say what it depends on")
    return dataclasses.replace(entry, config=settings), dependencies


def limit_bytes() -> float:
    """Size limit of the cache.

    Raises
    ------
    InputError
        If ESTIMA_CACHE_GIB is not a number from 0 on.
    """
    text = os.environ.get("ESTIMA_CACHE_GIB") or str(_LIMIT_GIB)
    with suppress(ValueError):
        if float(text) >= 0.0:
            return float(text) * 2**30
    raise InputError(f"ESTIMA_CACHE_GIB must be a number of GiB, zero or more, got {text!r}")


def files() -> list[tuple[Path, int]]:
    """Cached recordings and their sizes in bytes, the least recently used first."""
    found = []
    for path in folder().glob("*.npz"):
        with suppress(FileNotFoundError):  # another process dropped it
            found.append((path.stat().st_mtime_ns, path, path.stat().st_size))
    return [(path, size) for _, path, size in sorted(found)]


def trim(most_bytes: float) -> int:
    """Drop the least recently used recordings until the rest fit; return how many were dropped.

    One that a process is reading or writing right now stays. What a process that was killed left
    half-written goes too.
    """
    for part in folder().glob(".*.part*"):
        with suppress(OSError):  # gone, or not to be deleted
            if time.time() - part.stat().st_mtime > _ABANDONED_S:
                part.unlink()
    kept, dropped = files(), 0
    excess = sum(size for _, size in kept) - most_bytes
    for path, size in kept:
        if excess > 0.0 and _dropped(path):
            excess -= size
            dropped += 1
    return dropped


def _dropped(path: Path) -> bool:
    """Drop a recording, unless a process is reading or writing it; return whether it is gone."""
    try:
        with hold_lock(path.with_suffix(".lock"), wait=False):
            path.unlink(missing_ok=True)
    except BlockingIOError:
        return False
    except OSError as error:
        raise InputError(
            f"{path}: cannot delete it ({error.strerror}); make its folder writable"
        ) from error
    return True
