"""What code is this: digests of the project's own source, so that results never mix silently."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SIMULATION = ("sim",)  # its formats are left out: they read and write, but decide no recording
EVERYTHING = ("sim", "estimators", "experiments")


@functools.cache
def code_version(folders: tuple[str, ...] = EVERYTHING) -> str:
    """Return 12 hex digits of the SHA-256 over the Python files of the folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            if folders == SIMULATION and path.parent.name == "formats":
                continue
            digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]
