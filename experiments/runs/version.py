"""Where results come from: the machine, and a digest of the code."""

import functools
import hashlib
import os
import platform
import re
from pathlib import Path

from experiments.runs.paths import SOURCE


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
    """Name of the processor, from the kernel if it gives one, else from the platform."""
    info = Path("/proc/cpuinfo")
    named = re.search(r"^model name\s*: (.*)$", info.read_text() if info.exists() else "", re.M)
    return named[1].strip() if named else platform.processor() or platform.machine()
