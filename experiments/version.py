"""What code is this: digests of the project's own source, so that results never mix silently."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Files that read and write logs are left out: they decide no simulated recording and no estimate
SIMULATION = ("sim",)
RUNS = (
    "sim",
    "estimators",
    "experiments/build.py",
    "experiments/metrics.py",
    "experiments/places.py",
    "experiments/run.py",
    "experiments/seeds.py",
)


@functools.cache
def code_version(parts: tuple[str, ...] = RUNS) -> str:
    """Return 12 hex digits of the SHA-256 over Python files and those of folders."""
    digest = hashlib.sha256()
    for part in parts:
        place = ROOT / part
        for path in [place] if place.is_file() else sorted(place.rglob("*.py")):
            if path.parent.name != "formats":
                digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]
