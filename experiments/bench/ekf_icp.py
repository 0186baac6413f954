"""The whole fusion of wheels and laser at the laser's full rate."""

import statistics
from collections.abc import Iterator

from estimators.base import run as run_estimator
from experiments.bench.measure import Measurement
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream

_OFFICE = (
    "study=decristoforis2020_office",
    "seed=1000",
    "sensors.laser.rate_hz=75",
    "simulation.physics=kinematic",
    "route.distance_m=20",
)
_GOALS = {"ekf_icp": 20.0, "ekf_icp_paper": None, "icp_odometry": None}


def run() -> Iterator[Measurement]:
    """Real-time factors of the filters at 75 Hz and 721 beams, in an office."""
    recording = Experiment.compose(_OFFICE).simulate()
    note = f"721 beams, {len(recording.frame_stamps)} steps"
    for name, goal in _GOALS.items():
        experiment = Experiment.compose([*_OFFICE, f"estimator={name}"])
        prior = experiment.prior(recording)
        estimates = (
            run_estimator(experiment.estimator(), recording, prior, stream(repeat, "bench"))
            for repeat in range(3)
        )
        factor = recording.duration_s / statistics.median(e.step_seconds.sum() for e in estimates)
        yield Measurement(f"{name}.realtime_factor_75hz", factor, "x", goal, "higher", note)
