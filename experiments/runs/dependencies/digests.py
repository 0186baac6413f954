"""Digests of dependencies as they are now, and which of them have changed."""

import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from experiments.runs.dependencies.sources import read_source
from experiments.runs.paths import SOURCE, results
from sim.errors import InputError
from sim.yaml_file import read_yaml


def changed(digests: Mapping[str, str]) -> list[str]:
    """Names of the dependencies that are no longer what they were, or are gone."""
    return [name for name, digest in digests.items() if present_digest(name) != digest]


def present_digest(name: str) -> str | None:
    """Digest of a dependency as it is now; None if it is gone."""
    kind, _, called = name.partition(" ")
    if kind == "package" and called:
        return package_version(called)
    path = path_of(name)
    if kind == "program" and called:
        found = shutil.which(called)
        path = Path(found) if found else Path(called)
    with suppress(OSError, InputError):
        return digest_of(path)
    return None


def name_of(path: Path) -> str:
    """Name of a file as a dependency: from the results, the checkout or its surroundings."""
    if path.is_relative_to(results()):
        return f"results/{path.relative_to(results())}"
    if path.is_relative_to(SOURCE):
        return str(path.relative_to(SOURCE))
    beside = path.is_relative_to(SOURCE.parent / "shared")
    return os.path.relpath(path, SOURCE) if beside else str(path)


def path_of(name: str) -> Path:
    """Path of a file by its name as a dependency."""
    if name.startswith("results/"):
        return results() / name.removeprefix("results/")
    return SOURCE / name


def digest_of(path: Path) -> str:
    """Digest of a file: a source and YAML by what they say, any other by its bytes.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    state = path.stat()
    if not stat.S_ISREG(state.st_mode):  # a pipe would wait forever
        raise OSError(f"{path}: not a file")
    return _digest(path, state.st_mtime_ns, state.st_size)


@functools.cache
def _digest(path: Path, _mtime_ns: int, _size: int) -> str:
    content = path.read_bytes()
    if path.suffix == ".py":
        return read_source(content).digest
    if path.suffix in (".yaml", ".yml"):
        with suppress(InputError, TypeError, ValueError, RecursionError):
            heads = [line for line in content.splitlines() if line.startswith(b"# @")]  # Hydra's
            content = b"".join([*heads, json.dumps(read_yaml(path), default=str).encode()])
    return hashlib.sha256(content).hexdigest()[:16]


@functools.cache
def package_version(name: str) -> str | None:
    """Version of the package that a top-level module belongs to, or of Python; None if unknown."""
    if name == "python":
        return ".".join(platform.python_version_tuple()[:2])
    with suppress(importlib.metadata.PackageNotFoundError, ValueError):
        return importlib.metadata.version(name)
    every = importlib.metadata.distributions()
    return next((each.version for each in every if _provides(each, name)), None)


def _provides(distribution: importlib.metadata.Distribution, name: str) -> bool:
    """Whether a distribution has a top-level module.

    As `importlib.metadata.packages_distributions` finds it, which takes a third of a second for
    all names and files.
    """
    if declared := (distribution.read_text("top_level.txt") or "").split():
        return name in declared
    files = distribution.read_text("RECORD") or ""
    return bool(re.search(rf"^{re.escape(name)}(/|(\.[\w-]+)?\.(py|so|pyd),)", files, re.MULTILINE))
