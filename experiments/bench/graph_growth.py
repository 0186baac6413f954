"""What a step of graph SLAM costs after up to 5 km: time of a key frame, of a closure, and memory.

Laps of 100 m with a key frame each 0.5 m, every third of which closes the lap. The graph and its
scans are real, the drive is not: registrations cost the same at any length, and are left out.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator

import numpy as np

from estimators.gaussian import Gaussian
from estimators.graph.loop_closing import LoopOptions, LoopSearch, look_alike, signature
from estimators.graph.pose_graph import Edge, PoseGraph
from estimators.laser.icp import PreparedScan, prepare
from estimators.laser.scan_matching import MatcherOptions, ScanMatcher
from experiments.bench.growth import resident_mib
from experiments.bench.measure import Measurement, time_s
from experiments.runs.evaluate import limited_blas
from experiments.runs.seeds import stream
from sim.sensors import Laser

LENGTHS_M = (250, 500, 1000, 2000, 3500, 5000)
_KEY_FRAME_M, _LAP = 0.5, 200  # key frames of a lap
_TIMED = 20  # key frames before each length
_STEP = np.array([_KEY_FRAME_M, 0.0, 2.0 * math.pi / _LAP])
_NOISE = np.diag([1e-5, 1e-5, 1e-6])
_LASER = Laser(n_beams=181, fov_rad=math.pi)


def run() -> Iterator[Measurement]:
    """Times and memory after each of `LENGTHS_M`, on one graph that grows.

    A key frame is added, and its candidates are chosen; a closure is added, and the graph is
    solved; the memory is that of the graph and of the scans of its key frames.
    """
    with limited_blas():
        yield from _grow(stream(0, "bench"))


def _grow(rng: np.random.Generator) -> Iterator[Measurement]:
    graph = PoseGraph(Gaussian(np.zeros(3), 1e-6 * np.eye(3)), robust_sigma=5.0)
    search = LoopSearch(ScanMatcher(MatcherOptions()), _LASER, LoopOptions())
    scans = [_scan(rng)]
    marks = np.tile(signature(scans[0]), (1, 1))
    before_mib = resident_mib()  # with the compiled code
    for length_m in LENGTHS_M:
        n, before, seconds = round(length_m / _KEY_FRAME_M), len(graph), []
        while len(graph) < n:
            scan, begun = _scan(rng), time.process_time()
            motion = _STEP + rng.standard_normal(3) * np.sqrt(np.diag(_NOISE))
            graph.add(motion, [Gaussian(motion, _NOISE)])
            marks = np.vstack([marks, signature(scan)])
            scans.append(scan)
            if n - len(graph) < _TIMED:
                older = np.arange(len(graph) - 1)
                motions, covariances = graph.newest_from(older, exact=False)
                search.candidates(motions, covariances, look_alike(marks[-1], marks[:-1]))
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
