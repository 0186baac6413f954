"""Every belief is checked, not only the first; what is wrong names the step and its time."""

import dataclasses

import numpy as np
import pytest

from estimators.base import Belief, Estimate, Prior, explain_unsound, run
from estimators.odometry import Odometry
from experiments.runs.evaluate import evaluate, status_of
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome
from sim.errors import InputError
from tests.fixtures import fakes

STEP = 7
WRONG = {
    "scalars": (lambda mean, cov: (1.0, 1.0), "got shapes () and ()"),
    "a row": (lambda mean, cov: (mean[None], cov), "got shapes (1, 3) and (3, 3)"),
    "ragged": (lambda mean, cov: ([1.0, [2.0], 3.0], cov), "inhomogeneous"),
    "text": (lambda mean, cov: (["1", "2", "3"], cov), "of real numbers"),
    "complex": (lambda mean, cov: (mean + 1j, cov), "of real numbers"),
    "negative": (lambda mean, cov: (mean, -np.eye(3)), "symmetric and positive semidefinite"),
    "skew": (lambda mean, cov: (mean, np.eye(3) + np.eye(3, k=1)), "symmetric and positive"),
    "indefinite": (
        lambda mean, cov: (mean, np.array([[1.0, 2, 0], [2, 1, 0], [0, 0, 1]])),
        "symmetric and positive semidefinite",
    ),
    "far": (lambda mean, cov: (mean + 1e13, cov), "farther away"),
    "infinite": (lambda mean, cov: (mean * np.inf, cov), "not finite"),
}


class Errs(Odometry):
    """Gives another belief than it should at one step."""

    def __init__(self, change, at=STEP):
        super().__init__(kr=1e-5, kl=1e-5)
        self.change, self.at = change, at

    def reset(self, prior, rng):
        super().reset(prior, rng)
        self.n = -1

    def step(self, frame):
        belief = super().step(frame)
        self.n += 1
        return Belief(*self.change(belief.mean, belief.covariance)) if self.n == self.at else belief


@pytest.fixture(scope="module")
def experiment():
    return Experiment.compose(
        ["world=room", "route.distance_m=2", "simulation.physics=kinematic", "prior.map=world"]
    )


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_belief_fails_the_run_and_names_its_step(wrong, experiment):
    change, said = WRONG[wrong]
    (row,) = evaluate(experiment.with_estimator_object(Errs(change)))
    assert row["status"] == "failed"
    assert said in row["status_detail"]
    assert f" s, step {STEP}" in row["status_detail"]


def test_a_right_one_passes(experiment):
    (row,) = evaluate(experiment.with_estimator_object(Errs(lambda mean, cov: (mean, cov))))
    assert row["status"] == "ok"
    lists = Errs(lambda mean, cov: (mean.tolist(), cov.tolist()))
    (row,) = evaluate(experiment.with_estimator_object(lists))
    assert row["status"] == "ok"


@pytest.mark.parametrize("wrong", [1, [], np.zeros((9, 3))], ids=["number", "list", "array"])
def test_what_finish_gives_is_an_estimate_or_none(wrong, experiment):
    estimator = Errs(lambda mean, cov: (mean, cov))
    estimator.finish = lambda: wrong
    (row,) = evaluate(experiment.with_estimator_object(estimator))
    assert row["status"] == "failed"
    said = f"Errs.finish must return an Estimate or None, got {type(wrong).__name__}"
    assert said in row["status_detail"]


def test_the_first_is_an_error_of_the_input():
    recording = fakes.circle()
    with pytest.raises(InputError, match=r"got shapes \(\) and \(\)"):
        run(
            Errs(WRONG["scalars"][0], 0), recording, fakes.tracking_prior(recording),
            np.random.default_rng(0),
        )  # fmt: skip


def test_times_are_seconds_from_the_start_whatever_clock_a_log_has():
    class Warns(Odometry):
        def step(self, frame):
            belief = super().step(frame)
            return Belief(belief.mean, belief.covariance, {"status": "poor_overlap"})

    drive = fakes.circle()
    wheels, clock_s = drive.wheels, 976052857.0
    late = dataclasses.replace(
        drive,
        frame_stamps=drive.frame_stamps + clock_s,
        wheels=dataclasses.replace(wheels, stamps=wheels.stamps + clock_s),
        sensors={"encoder": drive.sensors["encoder"]},
        logs={},
        truth=None,
    )
    prior = Prior(late.robot, late.sensors, np.zeros(3), 1e-6 * np.eye(3))
    online = run(Warns(kr=1e-5, kl=1e-5), late, prior, np.random.default_rng(0))
    assert online.status == "poor_overlap at 0.00 s"
    wrong = dataclasses.replace(online, covariances=online.covariances.copy(), status="ok")
    wrong.covariances[STEP] = np.nan
    at = f"{drive.frame_stamps[STEP] - drive.frame_stamps[0]:.2f} s, step {STEP}"
    assert explain_unsound(wrong).endswith(f"at {at}")


def test_a_revised_path_is_checked_too():
    recording = fakes.circle()
    online = fakes.estimate(recording)
    assert status_of(recording, online, online).outcome is not Outcome.FAILED
    bad = dataclasses.replace(
        online, covariances=online.covariances - 9 * np.eye(3), kind="revised"
    )
    status = status_of(recording, online, bad)
    assert status.outcome is Outcome.FAILED
    assert "revised: the covariance" in status.detail
    stamps = np.array([0.0, 0.0])
    twice = Estimate(stamps, np.zeros((2, 3)), np.zeros((2, 3, 3)))
    assert "not after the last at 0.00 s, step 1" in explain_unsound(twice)
    assert "shapes" in explain_unsound(dataclasses.replace(twice, means=np.zeros((2, 1))))


def test_what_a_status_leaves_open_is_passed_over():
    means = np.array([[np.nan] * 3, [0.0] * 3])
    open_ = Estimate(np.arange(2.0), means, np.tile(np.eye(3), (2, 1, 1)), status="lost at 0 s")
    assert explain_unsound(open_) == ""
    assert "not finite" in explain_unsound(dataclasses.replace(open_, status="ok"))
