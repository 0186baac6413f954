"""The whole fusion of wheels and laser at the laser's full rate."""

from __future__ import annotations

import statistics

from estimators.base import run as run_estimator
from experiments.bench.measure import Measurement
from experiments.runs.compose import compose
from experiments.runs.experiment import make_estimator, make_prior, simulate
from experiments.runs.seeds import stream

_LENGTH_M = 20.0
_GOAL = 20.0


def run() -> list[Measurement]:
    """Real-time factors of the filters at 75 Hz and 721 beams, in an office."""
    office = [
        "+study=decristoforis2020_office",
        "seed=1000",
        "sensors.laser.rate_hz=75",
        "simulation.physics=kinematic",
        f"route.distance_m={_LENGTH_M}",
    ]
    recording = simulate(compose(office))
    results = []
    for name in ("ekf_icp", "ekf_icp_paper", "icp_odometry"):
        config = compose([*office, f"estimator={name}"])
        factors = []
        for repeat in range(3):
            rng = stream(repeat, "bench")
            prior = make_prior(config, recording)
            estimate = run_estimator(make_estimator(config), recording, prior, rng)
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
