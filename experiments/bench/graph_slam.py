"""Graph SLAM among look-alike rooms: false closures, consistency and speed.

The rooms are all alike: 42 squares without furniture. A closure is false if it is off the true
motion by more than `FALSE_M` or `FALSE_RAD`. Of planted closures half lie anywhere; half are moved
by the same 0.5 m, as if each place had a twin there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimators.base import Estimate
from estimators.gaussian import Gaussian
from estimators.graph.graph_slam import GraphSlam
from estimators.graph.pose_graph import Edge
from experiments.bench.measure import Measurement
from experiments.evaluation.metrics import nees, position_errors_m
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
from sim.arrays import Array
from sim.recording import Recording

FALSE_M, FALSE_RAD = 0.1, 0.03
_NEAR_M, _NEAR_RAD, _APART_M = 2.0, 0.8, 10.0  # of a revisit: to an old key frame; and path between
_TWIN_M = 0.5  # along x in map
_ROOMS = (
    "world=rooms",
    "world.objects_per_room=0",
    "robot=robocom",
    "sensors=lms291",
    "sensors.laser.rate_hz=10",
    "sensors.laser.n_beams=181",
    "route.speed_mps=0.7",
    "world.n_x=7",
    "world.n_y=6",
    "route.distance_m=300.0",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
    "prior.sigma_position_m=1e-3",
    "prior.sigma_heading_rad=1e-4",
)
_JUDGED = range(1100, 1120)  # seeds 1000 to 1012 have been looked at


class Planted(GraphSlam):
    """Graph SLAM to whose candidates false ones are added, this share of all."""

    def __init__(self, share: float, chance: np.random.Generator, **options: Any) -> None:
        super().__init__(**options)
        self._share, self._chance = share, chance
        self.false: list[Edge] = []

    def proposed(self) -> list[Edge]:
        """True candidates and planted ones."""
        found = super().proposed()
        number = self._chance.poisson(len(found) * self._share / (1.0 - self._share))
        newest = len(self.graph) - 1
        for _ in range(number):
            first = int(self._chance.integers(newest))
            expected = se2.between(self.graph.poses[first], self.graph.poses[newest])
            anywhere = self._chance.uniform([-3.0, -3.0, -1.5], [3.0, 3.0, 1.5])
            heading = self.graph.poses[first, 2]
            twin = _TWIN_M * np.array([np.cos(heading), -np.sin(heading), 0.0])
            off = twin if self._chance.random() < 0.5 else anywhere
            noise = self.graph.noise[newest]
            self.false.append(Edge(first, newest, Gaussian(expected + off, noise)))
        return [*found, *self.false[len(self.false) - number :]]


@dataclass(frozen=True)
class RoomRun:
    """A drive through look-alike rooms.

    Attributes
    ----------
    closures, false, planted
        Closures believed by the end, those of them that are false, and false ones planted.
    revisits, closed
        Key frames near an old one, and those of them within 5 m of travel of a closure.
    end_m
        Error of position at the end, online.
    nees, revised_nees
        Mean NEES / 3.
    realtime_factor
        Duration of the recording over processor time of all steps.
    """

    closures: int
    false: int
    planted: int
    revisits: int
    closed: int
    end_m: float
    nees: float
    revised_nees: float
    realtime_factor: float


def run_rooms(seed: int, planted: float = 0.0) -> RoomRun:
    """Drive 300 m through look-alike rooms, with this share of false candidates."""
    experiment = Experiment.compose([*_ROOMS, f"seed={seed}"])
    recording, robot = experiment.recording(), experiment.robot()
    estimator = Planted(planted, stream(seed, "bench"), kr=robot.kr, kl=robot.kl)
    rng = stream(seed, "estimator/graph_slam")
    online, revised = run_over(recording, estimator, experiment.prior(recording), rng)
    assert revised is not None
    return RoomRun(
        *_judged_closures(estimator, recording),
        end_m=float(_errors_m(recording, online)[-1]),
        nees=_nees(recording, online),
        revised_nees=_nees(recording, revised),
        realtime_factor=recording.duration_s / float(online.step_seconds.sum()),
    )


def _judged_closures(estimator: Planted, recording: Recording) -> tuple[int, int, int, int, int]:
    """Closures, false ones, planted ones, revisits and those closed; see `RoomRun`."""
    closures = estimator.graph.closures
    stamps = np.nan_to_num(estimator.node_stamps, nan=recording.frame_stamps[0])
    truth = recording.truth_at(stamps)
    false, closed_at = 0, []
    for edge in closures:
        off = se2.between(se2.between(truth[edge.first], truth[edge.second]), edge.motion.mean)
        false += bool(np.hypot(off[0], off[1]) > FALSE_M or abs(off[2]) > FALSE_RAD)
        closed_at.append(edge.second)
    moved = np.hypot(*np.diff(truth[:, :2], axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(moved)])
    revisits = []
    for node in range(1, len(truth)):
        old = truth[1:node][travelled[node] - travelled[1:node] > _APART_M]
        off = se2.between(old, truth[node])
        near = np.hypot(off[:, 0], off[:, 1]) < _NEAR_M
        if np.any(near & (np.abs(off[:, 2]) < _NEAR_RAD)):
            revisits.append(node)
    at_m = travelled[np.array(closed_at, int)]
    closed = sum(bool(np.any(np.abs(at_m - travelled[node]) < 5.0)) for node in revisits)
    return len(closures), false, len(estimator.false), len(revisits), closed


def _errors_m(recording: Recording, estimate: Estimate) -> Array:
    return position_errors_m(recording.truth_at(estimate.stamps), estimate.means)


def _nees(recording: Recording, estimate: Estimate) -> float:
    truth = recording.truth_at(estimate.stamps)
    return float(np.nanmean(nees(truth, estimate.means, estimate.covariances)) / 3.0)


def run() -> Iterator[Measurement]:
    """Twenty judged drives of 300 m, five of them again with planted closures."""
    runs = [run_rooms(seed) for seed in _JUDGED]
    note = "20 drives of 300 m through look-alike rooms"
    n_revisits = sum(r.revisits for r in runs)
    yield Measurement("graph_slam.false_closures", sum(r.false for r in runs), "", 0, note=note)
    yield Measurement("graph_slam.closures", sum(r.closures for r in runs), "")
    recall = sum(r.closed for r in runs) / n_revisits
    yield Measurement("graph_slam.revisits_closed", recall, "", note=f"of {n_revisits}")
    end_m = max(r.end_m for r in runs)
    yield Measurement("graph_slam.end_error_m", end_m, "m", 0.3, note="the worst, online")
    mean = float(np.mean([r.nees for r in runs]))
    yield Measurement("graph_slam.nees_3", mean, "", 1.5, note="online")
    mean = float(np.mean([r.revised_nees for r in runs]))
    yield Measurement("graph_slam.revised_nees_3", mean, "", 1.5)
    factor = min(r.realtime_factor for r in runs)
    yield Measurement("graph_slam.realtime_factor_10hz", factor, "", 10, "higher", "the least")
    for share in (0.1, 0.25, 0.5):
        found = [run_rooms(seed, share) for seed in _JUDGED[:5]]
        note = f"of {sum(r.planted for r in found)}; false candidates are {share:.0%} of all"
        bent = sum(r.false for r in found)
        yield Measurement(f"graph_slam.false_of_planted_{share:.0%}", bent, "", 0, note=note)
