"""A content-addressed cache of recordings: a sweep simulates each of them once."""

from __future__ import annotations

import fcntl
import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from experiments.runs.version import SIMULATION, code_version
from sim.errors import InputError
from sim.recording import Recording, load, save


def key_of(settings: dict[str, Any]) -> str:
    """Digest of the settings and of the simulator's code: what decides a recording's bits."""
    text = json.dumps({"settings": settings, "code": code_version(SIMULATION)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def cached(folder: Path, settings: dict[str, Any], make: Callable[[], Recording]) -> Recording:
    """Recording of the settings, from the cache or made now and kept.

    Safe under several processes: the second one waits for the first and reads its file. A file
    that does not match its checksum is thrown away and made again.
    """
    path = folder / f"{key_of(settings)}.npz"
    with _locked(path.with_suffix(".lock")):
        if path.exists():
            try:
                return load(path)
            except InputError as error:
                print(f"estima: {error}; it is made anew", file=sys.stderr)
                path.unlink(missing_ok=True)
        recording = make()
        save(recording, path)
    return recording


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold an exclusive lock, which the system frees even if the process is killed."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = path.open("w")
    except OSError as error:
        raise InputError(
            f"{path}: cannot write to the cache ({error.strerror}); free some space, or make "
            f"{path.parent} a link to a larger disk"
        ) from error
    with handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
