"""What a method of the study is: whose, of which version, and what it reads."""

import importlib.metadata
import subprocess

from estimators.programs.program import AMCL_PROGRAM, MRPT_PROGRAM
from experiments.studies.peers.settings import LASER, PACKAGES, READS, TUNED

_PROGRAMS = {"mrpt": MRPT_PROGRAM, "nav2": AMCL_PROGRAM}  # whose version only they know


def sensor_of(name: str) -> str:
    """What a method reads beside the wheels."""
    return READS.get(name.removesuffix(TUNED), LASER)


def is_ours(name: str) -> bool:
    """Whether a method belongs to this project."""
    return name.removesuffix(TUNED) not in PACKAGES


def version_of(name: str) -> str:
    """A peer's package and version; `Estima` for ours."""
    if is_ours(name):
        return "Estima"
    package = PACKAGES[name.removesuffix(TUNED)]
    if package in _PROGRAMS:
        said = subprocess.run(
            [_PROGRAMS[package], "version"], capture_output=True, text=True, check=False, timeout=10
        )
        return said.stdout.strip() or package
    return f"{package} {importlib.metadata.version(package)}"
