"""Every test writes to temporary folders: results go to one that a test run shares."""

import os

import pytest

# Before NumPy is loaded: threads of several workers' BLAS wait for one another, ten times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.fixture(scope="session", autouse=True)
def _results(tmp_path_factory, worker_id_or_none):
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if worker_id_or_none else base
    os.environ["ESTIMA_RESULTS"] = str(shared / "results")


@pytest.fixture(scope="session")
def worker_id_or_none():
    """Return xdist's worker, or None where one process runs all the tests."""
    return os.environ.get("PYTEST_XDIST_WORKER")
