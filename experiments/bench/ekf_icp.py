"""The whole fusion of wheels and laser at the laser's full rate."""

import statistics
from collections.abc import Iterator
from statistics import geometric_mean

from estimators.base import Estimate
from experiments.bench.measure import Measurement
from experiments.evaluation.metrics import score
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim.recording import Recording

_OFFICE = (
    "study=decristoforis2020/office",
    "sensors.laser.rate_hz=75",
    "simulation.physics=kinematic",
    "route.distance_m=20",
)
_GOALS = {"ekf_icp": 20.0, "ekf_icp_paper": None, "icp_odometry": None}
_SPARING = ("estimator.register_distance_m=0.05", "estimator.register_turn_rad=0.05")
_SEEDS = range(1000, 1004)


def run() -> Iterator[Measurement]:
    """Real-time factors of the filters at 75 Hz and 721 beams, and a scan that may wait."""
    recordings = [Experiment.compose([*_OFFICE, f"seed={s}"]).simulate() for s in _SEEDS]
    recording = recordings[0]
    note = f"721 beams, {len(recording.frame_stamps)} steps"
    for name, goal in _GOALS.items():
        times = [_run(name, recording, repeat).step_seconds.sum() for repeat in range(3)]
        factor = recording.duration_s / statistics.median(times)
        yield Measurement(f"{name}.realtime_factor_75hz", factor, "x", goal, "higher", note)
    every, sparing = (
        [_run("ekf_icp", recording, 0, *options) for recording in recordings]
        for options in ((), _SPARING)
    )
    ratio = geometric_mean(
        score(recording, b)["ate_rmse_m"] / score(recording, a)["ate_rmse_m"]
        for recording, a, b in zip(recordings, every, sparing, strict=True)
    )
    mean_ms = statistics.median(1e3 * float(e.step_seconds.mean()) for e in sparing)
    note = (
        f"registered every 5 cm or 0.05 rad: {ratio:.2f} times the error of every scan, "
        f"{len(recordings)} offices at 75 Hz"
    )
    yield Measurement("ekf_icp.scan_ms_75hz", mean_ms, "ms", 0.12, note=note)


def _run(name: str, recording: Recording, repeat: int, *options: str) -> Estimate:
    experiment = Experiment.compose([*_OFFICE, f"estimator={name}", *options])
    prior = experiment.prior(recording)
    return run_over(recording, experiment.estimator(), prior, stream(repeat, "bench"))[0]
