"""The whole fusion of wheels and laser at the laser's full rate."""

from __future__ import annotations

import statistics

from estimators.base import run as run_estimator
from experiments.bench.measure import Measurement
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream

_LENGTH_M = 20.0
_GOAL = 20.0


def run() -> list[Measurement]:
    """Real-time factors of the filters at 75 Hz and 721 beams, in an office."""
    office = [
        "study=decristoforis2020_office",
        "seed=1000",
        "sensors.laser.rate_hz=75",
        "simulation.physics=kinematic",
        f"route.distance_m={_LENGTH_M}",
    ]
    recording = Experiment.compose(office).simulate()
    results = []
    for name in ("ekf_icp", "ekf_icp_paper", "icp_odometry"):
        experiment = Experiment.compose([*office, f"estimator={name}"])
        prior = experiment.prior(recording)
        factors = []
        for repeat in range(3):
            rng = stream(repeat, "bench")
            estimate = run_estimator(experiment.estimator(), recording, prior, rng)
            factors.append(recording.duration_s / estimate.step_seconds.sum())
        results.append(
            Measurement(
                f"{name}.realtime_factor_75hz",
                statistics.median(factors),
                "x",
                _GOAL if name == "ekf_icp" else None,
                "higher",
                f"721 beams, {len(recording.frame_stamps)} steps",
            )
        )
    return results
