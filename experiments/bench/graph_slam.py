"""Graph SLAM: false closures among look-alike rooms, and its cost after up to 5 km.

The rooms are all alike: 42 squares without furniture. Of planted closures half lie anywhere; half
are moved by the same 0.5 m, as if each place had a twin there.

The cost is that of laps of 100 m with a key frame each 0.5 m, every third of which closes the lap.
The graph and its scans are real, the drive is not: registrations cost the same at any length, and
are left out.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from estimators.base import run as run_estimator
from estimators.gaussian import Gaussian
from estimators.graph.graph_slam import GraphSlam
from estimators.graph.loop_closing import LoopOptions, LoopSearch
from estimators.graph.pose_graph import Edge, PoseGraph
from estimators.laser.icp import PreparedScan, prepare
from estimators.laser.scan_matching import MatcherOptions, ScanMatcher
from experiments.bench.growth import resident_mib
from experiments.bench.measure import Measurement, time_s
from experiments.evaluation.map_quality import closure_errors
from experiments.evaluation.metrics import score
from experiments.runs.evaluate import limit_blas
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
from sim.sensors import Laser

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
LENGTHS_M = (250, 500, 1000, 2000, 3500, 5000)
_KEY_FRAME_M, _LAP = 0.5, 200  # key frames of a lap
_TIMED = 20  # key frames before each length
_STEP = np.array([_KEY_FRAME_M, 0.0, 2.0 * math.pi / _LAP])
_NOISE = np.diag([1e-5, 1e-5, 1e-6])
_LASER = Laser(n_beams=181, fov_rad=math.pi)
_JUDGED = range(1100, 1120)  # seeds 1000 to 1012 have been looked at


class GraphSlamWithFalseClosures(GraphSlam):
    """Graph SLAM to whose candidates false ones are added, this share of all."""

    def __init__(self, share: float, chance: np.random.Generator, **options: Any) -> None:
        super().__init__(**options)
        self._share, self._chance = share, chance
        self.false: list[Edge] = []

    def propose_closures(self) -> list[Edge]:
        """True candidates and planted ones."""
        found = super().propose_closures()
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


def run() -> Iterator[Measurement]:
    """Twenty judged drives of 300 m, five of them again with planted closures; then the growth."""
    drives = pd.DataFrame([run_rooms(seed) for seed in _JUDGED])
    total, worst, mean = drives.sum(), drives.max(), drives.mean()
    recall, of = (
        np.average(drives["revisits_closed"], weights=drives["revisits"]),
        f"of {total['revisits']:g}",
    )
    note = "20 drives of 300 m through look-alike rooms"
    factor, scan_ms = drives["realtime_factor"].min(), drives["scan_ms"].mean()
    yield from (
        Measurement("graph_slam.false_closures", total["false_closures"], "", 0, note=note),
        Measurement("graph_slam.closures", total["closures"], ""),
        Measurement("graph_slam.revisits_closed", recall, "", note=of),
        Measurement("graph_slam.end_error_m", worst["end_m"], "m", 0.3, note="the worst, online"),
        Measurement("graph_slam.nees_3", mean["nees"], "", 1.5, note="online"),
        Measurement("graph_slam.revised_nees_3", mean["revised_nees"], "", 1.5),
        Measurement("graph_slam.scan_ms", scan_ms, "ms", 3.0, note="online"),
        Measurement("graph_slam.realtime_factor_10hz", factor, "", 10, "higher", "the least"),
    )
    for share in (0.1, 0.25, 0.5):
        total = pd.DataFrame([run_rooms(seed, share) for seed in _JUDGED[:5]]).sum()
        note = f"of {total['planted']:g}; false candidates are {share:.0%} of all"
        name = f"graph_slam.false_of_planted_{share:.0%}"
        yield Measurement(name, total["false_closures"], "", 0, note=note)
    with limit_blas():
        yield from _grow(stream(0, "bench"))


def run_rooms(seed: int, planted: float = 0.0) -> dict[str, float]:
    """Drive 300 m through look-alike rooms, with this share of false candidates.

    Returns
    -------
    dict
        What `experiments.evaluation.map_quality.closure_errors` says in the end; false closures
        `planted`; `end_m`, the error of the online position at the end; `nees` and `revised_nees`,
        means over 3; `scan_ms`, processor time a scan; `realtime_factor`, the duration over the
        processor time of all steps.
    """
    experiment = Experiment.compose([*_ROOMS, f"seed={seed}"])
    recording, robot = experiment.recording(), experiment.robot()
    estimator = GraphSlamWithFalseClosures(planted, stream(seed, "bench"), kr=robot.kr, kl=robot.kl)
    prior, rng = experiment.prior(recording), stream(seed, "estimator/graph_slam")
    with limit_blas():
        begun = time.process_time()
        online = run_estimator(estimator, recording, prior, rng)
        seconds = time.process_time() - begun
        finished = estimator.finish()
    scores, revised = score(recording, online), score(recording, finished)
    return {
        **closure_errors(recording, finished.map),
        "planted": len(estimator.false),
        "end_m": scores["final_position_error_m"],
        "nees": scores["nees_mean"] / 3.0,
        "revised_nees": revised["nees_mean"] / 3.0,
        "scan_ms": 1e3 * seconds / len(recording.log("laser").stamps),
        "realtime_factor": recording.duration_s / seconds,
    }


def _grow(rng: np.random.Generator) -> Iterator[Measurement]:
    """Costs on one graph that grows: of a key frame with its candidates, and of a closure."""
    graph = PoseGraph(Gaussian(np.zeros(3), 1e-6 * np.eye(3)), robust_sigma=5.0)
    search = LoopSearch(ScanMatcher(MatcherOptions()), _LASER, LoopOptions())
    scans = [_scan(rng)]
    before_mib = resident_mib()  # with the compiled code
    for length_m in LENGTHS_M:
        n, before, seconds = round(length_m / _KEY_FRAME_M), len(graph), []
        while len(graph) < n:
            scan, begun = _scan(rng), time.process_time()
            motion = _STEP + rng.standard_normal(3) * np.sqrt(np.diag(_NOISE))
            graph.add(motion, [Gaussian(motion, _NOISE)])
            scans.append(scan)
            if n - len(graph) < _TIMED:
                older = np.arange(len(graph) - 1)
                motions, covariances = graph.newest_from(older, exact=False)
                search.candidates(motions, covariances)
                seconds.append(time.process_time() - begun)
        graph.close([_closure(k) for k in range(max(before, _LAP), n, 3)])
        closing = [
            time_s(graph.close, [_closure(n - 1)], 1e-4, clock=time.process_time) for _ in range(3)
        ]
        for what, value, unit, note in (
            ("key_frame_ms", 1e3 * statistics.median(seconds), "ms", f"{n} key frames"),
            ("closure_ms", 1e3 * min(closing), "ms", f"the solution too, of {len(graph.closures)}"),
            ("memory_mib", resident_mib() - before_mib, "MiB", "with the scans"),
        ):
            yield Measurement(f"graph_slam.at_{length_m}_m.{what}", value, unit, note=note)


def _closure(second: int) -> Edge:
    return Edge(second - _LAP, second, Gaussian(np.zeros(3), _NOISE))


def _scan(rng: np.random.Generator) -> PreparedScan:
    """A square room of 6 m, seen from its middle."""
    bearings = _LASER.bearings_rad
    walls_m = 3.0 / np.maximum(np.abs(np.cos(bearings)), np.abs(np.sin(bearings)))
    return prepare(walls_m + 0.01 * rng.standard_normal(len(bearings)), bearings)
