"""Graph SLAM among look-alike rooms: false closures, consistency and speed.

The rooms are all alike: 42 squares without furniture. A closure is false if it is off the true
motion by more than `FALSE_M` or `FALSE_RAD`. Of planted closures half lie anywhere; half are moved
by the same 0.5 m, as if each place had a twin there.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from estimators.base import run as run_estimator
from estimators.gaussian import Gaussian
from estimators.graph.graph_slam import GraphSlam
from estimators.graph.pose_graph import Edge
from experiments.bench.measure import Measurement
from experiments.evaluation.metrics import score, travelled_m
from experiments.runs.evaluate import limited_blas
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
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
            noise = self.graph.noise_of(newest)
            self.false.append(Edge(first, newest, Gaussian(expected + off, noise)))
        return [*found, *self.false[len(self.false) - number :]]


def run() -> Iterator[Measurement]:
    """Twenty judged drives of 300 m, five of them again with planted closures."""
    drives = pd.DataFrame([run_rooms(seed) for seed in _JUDGED])
    total, worst, mean = drives.sum(), drives.max(), drives.mean()
    recall, of = total["closed"] / total["revisits"], f"of {total['revisits']:g}"
    note = "20 drives of 300 m through look-alike rooms"
    factor = drives["realtime_factor"].min()
    yield from (
        Measurement("graph_slam.false_closures", total["false"], "", 0, note=note),
        Measurement("graph_slam.closures", total["closures"], ""),
        Measurement("graph_slam.revisits_closed", recall, "", note=of),
        Measurement("graph_slam.end_error_m", worst["end_m"], "m", 0.3, note="the worst, online"),
        Measurement("graph_slam.nees_3", mean["nees"], "", 1.5, note="online"),
        Measurement("graph_slam.revised_nees_3", mean["revised_nees"], "", 1.5),
        Measurement("graph_slam.realtime_factor_10hz", factor, "", 10, "higher", "the least"),
    )
    for share in (0.1, 0.25, 0.5):
        total = pd.DataFrame([run_rooms(seed, share) for seed in _JUDGED[:5]]).sum()
        note = f"of {total['planted']:g}; false candidates are {share:.0%} of all"
        name = f"graph_slam.false_of_planted_{share:.0%}"
        yield Measurement(name, total["false"], "", 0, note=note)


def run_rooms(seed: int, planted: float = 0.0) -> dict[str, float]:
    """Drive 300 m through look-alike rooms, with this share of false candidates.

    Returns
    -------
    dict
        `closures` believed by the end, those of them that are `false`, and false ones `planted`;
        `revisits`, key frames near an old one, and those of them `closed` within 5 m of travel;
        `end_m`, the error of the online position at the end; `nees` and `revised_nees`, means over
        3; `realtime_factor`, the duration over the processor time of all steps.
    """
    experiment = Experiment.compose([*_ROOMS, f"seed={seed}"])
    recording, robot = experiment.recording(), experiment.robot()
    estimator = Planted(planted, stream(seed, "bench"), kr=robot.kr, kl=robot.kl)
    prior, rng = experiment.prior(recording), stream(seed, "estimator/graph_slam")
    with limited_blas():
        begun = time.process_time()
        online = run_estimator(estimator, recording, prior, rng)
        seconds = time.process_time() - begun
        revised = score(recording, estimator.finish())
    scores = score(recording, online)
    return {
        **_judge_closures(estimator, recording),
        "end_m": scores["final_position_error_m"],
        "nees": scores["nees_mean"] / 3.0,
        "revised_nees": revised["nees_mean"] / 3.0,
        "realtime_factor": recording.duration_s / seconds,
    }


def _judge_closures(estimator: Planted, recording: Recording) -> dict[str, int]:
    closures = estimator.graph.closures
    stamps = np.nan_to_num(estimator.node_stamps, nan=recording.frame_stamps[0])
    truth = recording.truth_at(stamps)
    first, second = np.array([(e.first, e.second) for e in closures], int).reshape(-1, 2).T
    motions = np.reshape([edge.motion.mean for edge in closures], (-1, 3))
    off = np.abs(se2.between(se2.between(truth[first], truth[second]), motions))
    false = (np.hypot(off[:, 0], off[:, 1]) > FALSE_M) | (off[:, 2] > FALSE_RAD)
    driven_m, revisits = travelled_m(truth), []
    for node in range(1, len(truth)):
        old = truth[1:node][driven_m[node] - driven_m[1:node] > _APART_M]
        off = np.abs(se2.between(old, truth[node]))
        if np.any((np.hypot(off[:, 0], off[:, 1]) < _NEAR_M) & (off[:, 2] < _NEAR_RAD)):
            revisits.append(node)
    apart_m = np.abs(driven_m[second] - driven_m[revisits, None])
    return {
        "closures": len(closures),
        "false": int(false.sum()),
        "planted": len(estimator.false),
        "revisits": len(revisits),
        "closed": int((apart_m < 5.0).any(axis=1).sum()),
    }
