"""Sweeps of short runs, each under a name of its own."""

import pytest

from experiments.runs.paths import results
from experiments.sweeps.collect import collect
from tests.experiments.cli.test_cli import QUICK

SHORT = [*QUICK, "route=linear_1"]
ALONE = [*SHORT, "hydra/launcher=basic"]  # no workers, for what does not depend on them


def table_of(name):
    return collect(name)


def folder(name):
    return results() / "runs" / name


@pytest.fixture
def name(request):
    """Return a sweep's name of its own, cleared before and after."""
    own = f"test_{request.node.name}".replace("[", "_").replace("]", "")
    clear(own)
    yield own
    clear(own)


def clear(name):
    for path in sorted(folder(name).rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    if folder(name).exists():
        folder(name).rmdir()
