"""Time of an instant of a team, with images and sightings of all its robots, by their number."""

import time
from collections.abc import Iterator

import numpy as np

from estimators.base import Prior, TeamEstimator
from experiments.bench.measure import Measurement
from experiments.runs.evaluate import limit_blas
from experiments.runs.experiment import Experiment
from sim.arrays import Array
from sim.team import Team

_SIZES = (1, 2, 3, 4, 5)
_RATE_HZ = 10.0
_WARM = 20  # instants that are not counted
_DRIVE = (
    "study=teams",
    "seed=50",
    "route.distance_m=30",
    *(f"sensors.{name}.rate_hz={_RATE_HZ:g}" for name in ("encoder", "stereo", "robots")),
)
_ARMS = {
    "fastslam": ("estimator=fastslam", "estimator.n_particles=200"),
    "ekf_slam": ("estimator=ekf_slam",),
}


def run() -> list[Measurement]:
    """Median and 99th percentile of an instant, of each estimator and size."""
    whole = Experiment.compose(_DRIVE).recordings()
    return [row for name in _ARMS for size in _SIZES for row in _measure(name, size, whole)]


def _measure(name: str, size: int, whole: Team) -> Iterator[Measurement]:
    experiment = Experiment.compose([*_DRIVE, *_ARMS[name], f"team.size={size}"])
    team = whole.first(size)
    with limit_blas():
        spent_ms = 1e3 * instant_s(experiment.team_estimator(), team, experiment.priors(team))
    where, (median, last) = f"teams.{name}.robots_{size}", np.quantile(spent_ms, [0.5, 0.99])
    yield Measurement(f"{where}_ms", float(median), "ms", note="median of an instant")
    yield Measurement(f"{where}_p99_ms", float(last), "ms", 1e3 / _RATE_HZ, note="in real time")


def instant_s(estimator: TeamEstimator, team: Team, priors: list[Prior]) -> Array:
    """Processor time (T,) s of each instant of a team that all of its robots have a Frame of."""
    estimator.reset_team(priors, np.random.default_rng(0))
    spent_s = []
    for frames in team.instants():
        begun = time.process_time()
        estimator.step_team(frames)
        if len(frames) == len(team):
            spent_s.append(time.process_time() - begun)
    return np.array(spent_s[_WARM:])
