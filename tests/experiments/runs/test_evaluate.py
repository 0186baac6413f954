"""The runner: BLAS has one thread unless the user asks for more, in workers too."""

import joblib
import pytest
from threadpoolctl import threadpool_info

from experiments.runs.evaluate import limit_blas
from sim.errors import InputError

NAME = "ESTIMA_BLAS_THREADS"


def threads():
    with limit_blas():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.mark.parametrize("of_blas", ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"])
def test_blas_has_one_thread_unless_more_are_asked_for(monkeypatch, of_blas):
    monkeypatch.setenv(of_blas, "2")  # as joblib sets it in its workers
    monkeypatch.delenv(NAME, raising=False)
    assert threads() == {1}
    monkeypatch.setenv(NAME, "")
    assert threads() == {1}
    monkeypatch.setenv(NAME, "2")
    assert threads() == {2}


def test_workers_are_limited_too(monkeypatch):
    monkeypatch.delenv(NAME, raising=False)
    with joblib.parallel_config("loky", inner_max_num_threads=2):
        found = joblib.Parallel(n_jobs=2)(joblib.delayed(threads)() for _ in range(2))
    assert found == [{1}, {1}]


@pytest.mark.parametrize("value", ["0", "-1", "two", "1.5"])
def test_a_wrong_number_of_threads_is_named(monkeypatch, value):
    monkeypatch.setenv(NAME, value)
    with pytest.raises(InputError, match=f"{NAME} must be a whole number, at least 1"):
        limit_blas()
