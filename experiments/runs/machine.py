"""The machine that made a result, without the name of the computer or its user."""

import os
import platform
from contextlib import suppress
from pathlib import Path


def machine() -> dict[str, str | int]:
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
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
