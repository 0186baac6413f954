"""What a step of graph SLAM costs after up to 5 km: time of a key frame, of a closure, and memory.

Laps of 100 m with a key frame each 0.5 m, every third of which closes the lap. The graph and its
scans are real, the drive is not: registrations cost the same at any length, and are left out.
`python -m experiments.bench.graph_growth FOLDER` prints a table and draws the figure.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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
from experiments.viewing.style import CYCLE, save_figure, subplots
from sim.sensors import Laser

LENGTHS_M = (250, 500, 1000, 2000, 3500, 5000)
_KEY_FRAME_M, _LAP = 0.5, 200  # key frames of a lap
_TIMED = 20  # key frames before each length
_STEP = np.array([_KEY_FRAME_M, 0.0, 2.0 * math.pi / _LAP])
_NOISE = np.diag([1e-5, 1e-5, 1e-6])
_LASER = Laser(n_beams=181, fov_rad=math.pi)


@dataclass(frozen=True)
class Grown:
    """What it costs after this length.

    Attributes
    ----------
    key_frame_ms
        Processor time of adding a key frame and choosing its candidates.
    closure_ms
        The same of a closure and its solution.
    memory_mib
        Of the graph and of the scans of its key frames.
    """

    length_m: int
    n_key_frames: int
    n_closures: int
    key_frame_ms: float
    closure_ms: float
    memory_mib: float


def grown() -> Iterator[Grown]:
    """Cost after each of `LENGTHS_M`, on one graph that grows."""
    rng = stream(0, "bench")
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
        yield Grown(
            length_m,
            n,
            len(graph.closures),
            1e3 * statistics.median(seconds),
            1e3 * min(closing),
            resident_mib() - before_mib,
        )


def _closure(second: int) -> Edge:
    return Edge(second - _LAP, second, Gaussian(np.zeros(3), _NOISE))


def _scan(rng: np.random.Generator) -> PreparedScan:
    """A square room of 6 m, seen from its middle."""
    bearings = _LASER.bearings_rad
    walls_m = 3.0 / np.maximum(np.abs(np.cos(bearings)), np.abs(np.sin(bearings)))
    return prepare(walls_m + 0.01 * rng.standard_normal(len(bearings)), bearings)


def run() -> Iterator[Measurement]:
    """The same as measurements."""
    with limited_blas():
        for found in grown():
            name = f"graph_slam.at_{found.length_m}_m"
            note = f"{found.n_key_frames} key frames, {found.n_closures} closures"
            yield Measurement(f"{name}.key_frame_ms", found.key_frame_ms, "ms", note=note)
            yield Measurement(f"{name}.closure_ms", found.closure_ms, "ms", note="its solution too")
            yield Measurement(f"{name}.memory_mib", found.memory_mib, "MiB", note="with the scans")


def draw(found: list[Grown], picture: Path) -> None:
    """Time and memory over the length of the path."""
    page, (left, right) = subplots(9.0, 3.4, 1, 2)
    km = [one.length_m / 1e3 for one in found]
    left.plot(km, [one.closure_ms for one in found], "o-", color=CYCLE[1], label="a closure")
    left.plot(km, [one.key_frame_ms for one in found], "o-", color=CYCLE[0], label="a key frame")
    left.set(yscale="log", xlabel="length of the path, km", ylabel="processor time, ms")
    left.legend()
    right.plot(km, [one.memory_mib for one in found], "o-", color=CYCLE[0])
    right.set(xlabel="length of the path, km", ylabel="memory, MiB", ylim=(0.0, None))
    save_figure(page, picture)


def _main(folders: list[str]) -> None:
    with limited_blas():
        found = []
        for one in grown():
            found.append(one)
            print(one, flush=True)
    for folder in folders:
        draw(found, Path(folder) / "graph_growth.png")


if __name__ == "__main__":
    _main(sys.argv[1:])
