"""Where results come from: the machine, and digests of the code, so that versions never mix."""

import functools
import hashlib
import importlib.util
import json
import os
import platform
import re
import shlex
from collections.abc import Iterable
from contextlib import suppress
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any

from experiments.runs.paths import SOURCE

# Without the files that read and write logs: they affect no simulated recording and no estimate
SIMULATION = ("sim",)
RUNS = (
    "sim",
    "estimators",
    "experiments/evaluation/metrics.py",
    "experiments/papers/maximo2024/places.py",
    *(
        f"experiments/runs/{name}.py"
        for name in (
            *("compose", "evaluate", "experiment", "key", "objects"),
            *("schema", "seeds", "targets"),
        )
    ),
)


@functools.cache
def code_version(parts: tuple[str, ...] = RUNS) -> str:
    """Return 12 hex digits of the SHA-256 over Python files and those of folders."""
    digest = hashlib.sha256()
    for part in parts:
        place = SOURCE / part
        for path in [place] if place.is_file() else sorted(place.rglob("*.py")):
            if path.parent.name != "formats":
                digest.update(str(path.relative_to(SOURCE)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def version_with(targets: Iterable[str], command: Any = None) -> str:
    """Return the code's version, followed by + and a digest of what is from elsewhere, if any.

    Parameters
    ----------
    targets
        What the configuration names by `_target_`.
    command
        Of a program that is the estimator; the files among its words count.
    """
    found = {target: digest for target in sorted(targets) if (digest := source_digest(target))}
    for path in command_files(command):
        found[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest()
    elsewhere = f"+{hashlib.sha256(repr(found).encode()).hexdigest()[:12]}" if found else ""
    return code_version() + elsewhere


def command_files(command: Any) -> list[Path]:
    """Files among the words of a command: a list, a line, or a list as a row has it (JSON)."""
    try:
        if isinstance(command, str):
            command = json.loads(command) if command[:1] == "[" else shlex.split(command)
        words = [word for word in command or () if isinstance(word, str)]
        return [Path(word) for word in words if Path(word).is_file()]
    except (ValueError, TypeError, OSError):  # no command; the estimator says so
        return []


@functools.cache
def source_digest(target: str) -> str:
    """Digest of the source behind a target such as `mine.Mine`.

    It covers all files of a package; of a single module, also those in its folder that it imports.
    Empty for what `code_version` covers, and for what is not found.
    """
    module, top = target.rpartition(".")[0], target.partition(".")[0]
    if top in ("", "sim", "estimators"):
        return ""
    spec, file = importlib.util.find_spec(top), f"{module.replace('.', '/')}.py"
    files: list[Path] = []
    if top == "experiments":
        files = [] if file in RUNS else [SOURCE / file]
    elif spec is not None and spec.submodule_search_locations is not None:
        places = map(Path, spec.submodule_search_locations)
        files = [path for place in places for path in sorted(place.rglob("*.py"))]
    elif spec is not None and spec.origin:
        files = _with_imports(Path(spec.origin))
    content = (path.name.encode() + b"\0" + path.read_bytes() for path in files if path.is_file())
    return hashlib.sha256(b"".join(content)).hexdigest()[:12] if files else ""


def _with_imports(module: Path) -> list[Path]:
    """A module's file and those in its folder that it imports, itself or through others."""
    finder = ModuleFinder([str(module.parent)])
    with suppress(OSError, SyntaxError, ValueError):  # it will not run
        finder.run_script(str(module))
    files = (getattr(each, "__file__", None) for each in finder.modules.values())
    return sorted({module, *(Path(file) for file in files if file)})


def describe_machine() -> dict[str, str | int]:
    """Processor, core count and versions."""
    import numba
    import numpy as np

    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count() or 1,
        "system": platform.system(),
        "architecture": platform.machine(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def _cpu_model() -> str:
    """Name of the processor, from the kernel if it gives one, else from the platform."""
    info = Path("/proc/cpuinfo")
    named = re.search(r"^model name\s*: (.*)$", info.read_text() if info.exists() else "", re.M)
    return named[1].strip() if named else platform.processor() or platform.machine()
