"""The runner: any end of an estimator is a row; BLAS has one thread unless more are asked for."""

import asyncio
import os
import signal

import joblib
import pytest
from threadpoolctl import threadpool_info

from estimators.odometry import Odometry
from experiments.runs.evaluate import evaluate, limit_blas
from experiments.runs.experiment import Experiment
from experiments.runs.processes import hold_interrupts
from experiments.runs.store import read_runs
from experiments.runs.targets import make
from experiments.sweeps.launch import sweep
from sim.errors import InputError
from tests.experiments.cli.test_cli import QUICK

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


@pytest.mark.slow
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


class OwnError(BaseException):
    pass


class Ends(Odometry):
    """Raises something in a step."""

    error: BaseException = OwnError("said")

    def step(self, frame):
        raise self.error


ENDS = [
    OwnError("said"),
    GeneratorExit(),
    KeyboardInterrupt("mine"),
    asyncio.CancelledError(),
    SystemExit(0),
]


@pytest.mark.parametrize("error", ENDS, ids=lambda error: type(error).__name__)
def test_whatever_an_estimator_raises_is_a_row(tmp_path, monkeypatch, error):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    monkeypatch.setattr(Ends, "error", error)
    target = f"estimator._target_={__name__}.Ends"
    with pytest.raises(Exception, match=f"1 of 1 runs; first: {type(error).__name__}"):
        sweep([*QUICK, "route=linear_1", "name=ends", target, "hydra/launcher=basic"])
    (found,) = read_runs(tmp_path / "runs" / "ends")[["status", "status_code"]].values.tolist()
    assert found == ["failed", type(error).__name__]


class Interrupts(Odometry):
    def step(self, frame):
        os.kill(os.getpid(), signal.SIGINT)
        return super().step(frame)


def test_an_interrupt_of_the_user_is_no_row():
    experiment = Experiment.compose([*QUICK, "route=linear_1"]).with_estimator_object(
        Interrupts(kr=1e-5, kl=1e-5)
    )
    with pytest.raises(KeyboardInterrupt):
        evaluate(experiment)
    with pytest.raises(KeyboardInterrupt), hold_interrupts() as check:
        evaluate(experiment, lambda: (check(), experiment.recordings())[1])


class Fails:
    def __init__(self):
        {}["nothing"]


def test_a_constructor_that_raises_is_named():
    with pytest.raises(InputError, match=r"Fails\) raised KeyError: 'nothing' \(test_evaluate"):
        make({"_target_": f"{__name__}.Fails"}, "estimator")
