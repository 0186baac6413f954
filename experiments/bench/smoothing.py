"""Landmark methods over one drive through rooms: batch, EKF-SLAM and the fixed-lag smoother."""

import statistics
import time
from collections.abc import Iterator

import numpy as np

from estimators.graph.least_squares import solve
from estimators.graph.smoother import Smoother
from experiments.bench.measure import Measurement, time_s
from experiments.runs.evaluate import limited_blas, run_over
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
    batch.reset(prior, stream(0, "bench"))
    for frame in recording.frames():
        batch.step(frame)
    problem, start = batch.problem()
    note = f"{len(start)} poses, {len(np.unique(problem.landmark_rows))} landmarks"
    with limited_blas():
        solved, whole = (
            statistics.median(time_s(call, clock=time.process_time) for _ in range(5))
            for call in (lambda: solve(problem, start), batch.finish)
        )
    yield Measurement("smoother.solve_s", solved, "s", 0.15, note=note)
    yield Measurement("smoother.covariances_s", whole, "s", 0.3, note=f"{note}, and every Frame")
    for name, goal in (("ekf_slam", 0.35), ("fixed_lag", 0.3)):
        online = Experiment.compose([*_DRIVE, f"estimator={name}"]).estimator()
        seconds = [
            float(run_over(recording, online, prior, stream(0, "bench"))[0].step_seconds.sum())
            for _ in range(4)
        ]
        note = "all steps, one BLAS thread"
        yield Measurement(f"{name}.run_s", statistics.median(seconds[1:]), "s", goal, note=note)
