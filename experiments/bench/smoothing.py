"""Landmark methods over one drive through rooms: batch, EKF-SLAM and the fixed-lag smoother."""

import time
from collections.abc import Callable, Iterator

import numpy as np

from estimators.base import run as run_estimator
from estimators.graph.least_squares import solve
from estimators.graph.smoother import Smoother
from experiments.bench.measure import Measurement, median_time_s
from experiments.runs.evaluate import limit_blas
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream

_DRIVE = (
    "world=rooms",
    "sensors=laser_stereo",
    "robot=robocom",
    "route.distance_m=60",
    "simulation.rays=exact",
)


def run() -> Iterator[Measurement]:
    """Processor times over the drive, with one BLAS thread."""
    experiment = Experiment.compose([*_DRIVE, "estimator=smoother"])
    recording = experiment.simulate()
    prior = experiment.prior(recording)
    batch = Smoother(kr=experiment.robot().kr, kl=experiment.robot().kl)
    run_estimator(batch, recording, prior, stream(0, "bench"))
    problem, start = batch.problem()
    size = f"{len(start)} poses, {len(np.unique(problem.landmark_rows))} landmarks"

    def steps(name: str) -> Callable[[], object]:
        online = Experiment.compose([*_DRIVE, f"estimator={name}"]).estimator()
        return lambda: run_estimator(online, recording, prior, stream(0, "bench"))

    whole = "all steps, one BLAS thread"
    timed: tuple[tuple[str, Callable[[], object], int, float, str], ...] = (
        ("smoother.solve_s", lambda: solve(problem, start), 5, 0.15, size),
        ("smoother.covariances_s", batch.finish, 5, 0.3, f"{size}, and every Frame"),
        ("ekf_slam.run_s", steps("ekf_slam"), 3, 0.35, whole),
        ("fixed_lag.run_s", steps("fixed_lag"), 3, 0.3, whole),
    )
    with limit_blas():
        for name, call, repeats, goal, note in timed:
            seconds = median_time_s(call, at_least_s=0.0, repeats=repeats, clock=time.process_time)
            yield Measurement(name, seconds, "s", goal, note=note)
