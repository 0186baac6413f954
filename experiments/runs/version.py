"""Where results come from: the machine, and a digest of the code."""

import functools
import hashlib
import os
import platform
import re
from pathlib import Path

from experiments.runs.paths import SOURCE

_CPU = ("model name", "cpu family", "model")  # in /proc/cpuinfo


@functools.cache
def code_version() -> str:
    """Return 12 hex digits of the SHA-256 over all of the project's Python files."""
    digest = hashlib.sha256()
    for part in ("sim", "estimators", "experiments"):
        for path in sorted((SOURCE / part).rglob("*.py")):
            digest.update(str(path.relative_to(SOURCE)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


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
    """Name of the processor, from the kernel if it gives one, else from the platform.

    A virtual machine may name all generations alike, which round differently: family and model
    tell them apart.
    """
    path = Path("/proc/cpuinfo")
    info = path.read_text() if path.exists() else ""
    parts = (re.search(rf"^{key}\s*: (.*)$", info, re.M) for key in _CPU)
    name, *numbers = [each[1].strip() if each else "" for each in parts]
    told = ", ".join(
        f"{key.removeprefix('cpu ')} {n}" for key, n in zip(_CPU[1:], numbers, strict=True) if n
    )
    if not name:
        return platform.processor() or platform.machine()
    return f"{name} ({told})" if told else name
