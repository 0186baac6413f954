"""From the nearest node of a topological map to a pose: registration of level slices.

maximo2024, sec. 5, leaves this to future work.
"""

import math
from dataclasses import dataclass

import numpy as np

from estimators.gaussian import rotate
from estimators.laser.icp import PreparedScan, Registration, prepare, register
from estimators.laser.icp_covariance import censi
from estimators.topological.topological_map import TopologicalMap, level_slice
from sim import se2
from sim.arrays import Array, Floats
from sim.errors import require
from sim.sensors import Lidar3D

_TURNS = 3  # headings tried, the best of the correlation
_HEADING_WINDOW_RAD = 0.15
_GOOD_OVERLAP = 0.8  # no other turn or node is tried after a registration this good


@dataclass(frozen=True)
class Refinement:
    """A pose (3,) of base_link in map with its covariance (3, 3), or None of both.

    The status is `ok`, or why a pose is missing: that of the last registration, or `far` if it
    leads farther from the node than two spacings.
    """

    pose: Array | None
    covariance: Array | None
    status: str


class Refiner:
    """Registers level slices of clouds with those of a map's nodes, which it keeps prepared."""

    def __init__(self, known_map: TopologicalMap, lidar: Lidar3D) -> None:
        require(
            known_map.slices_m.shape[1] == lidar.n_azimuths,
            f"the map's slices have {known_map.slices_m.shape[1]} beams, the lidar has "
            f"{lidar.n_azimuths} azimuths; build the map with this lidar or set "
            "estimator.refine=false",
        )
        self._map, self._lidar = known_map, lidar
        self._bearings = lidar.azimuths_rad
        self._reach_m = 2.0 * max(known_map.spacing_m, 1.0)
        self._prepared: dict[int, PreparedScan] = {}

    def refine(self, cloud_ranges_m: Floats, node: int, others: list[int]) -> Refinement:
        """Register a cloud (rings, azimuths) with a node, or if that fails with other nodes."""
        ranges = level_slice(self._lidar, cloud_ranges_m)
        source = prepare(ranges, self._bearings, self._lidar.max_range_m)
        best, best_node, status = None, node, "no heading"
        for candidate in [node, *others]:
            if not math.isfinite(self._map.headings_rad[candidate]):
                continue
            for turn in find_turns_rad(ranges, self._map.slices_m[candidate]):
                found = register(
                    source,
                    self._target(candidate),
                    np.array([0.0, 0.0, turn]),
                    gate_m=max(2.0, self._reach_m / 2.0),
                    heading_window_rad=_HEADING_WINDOW_RAD,
                )
                if found.status != "ok":
                    status = found.status
                elif np.hypot(*found.T_target_source[:2]) > self._reach_m:
                    status = "far"
                elif best is None or found.overlap > best.overlap:
                    best, best_node = found, candidate
                    if best.overlap > _GOOD_OVERLAP:
                        return self._posed(best, source, best_node)
        if best is None:
            return Refinement(None, None, status)
        return self._posed(best, source, best_node)

    def _target(self, node: int) -> PreparedScan:
        """Return a node's slice, prepared when it is first asked for."""
        if node not in self._prepared:
            ranges_m, reach_m = self._map.slices_m[node], self._lidar.max_range_m
            self._prepared[node] = prepare(ranges_m, self._bearings, reach_m)
        return self._prepared[node]

    def _posed(self, found: Registration, source: PreparedScan, node: int) -> Refinement:
        """From the motion of the lidar to the pose of base_link in map."""
        mount = self._lidar.mount.pose
        at_node = np.append(self._map.positions_m[node], self._map.headings_rad[node])
        T_map_lidar = se2.compose(at_node, se2.compose(mount, found.T_target_source))
        heading = float(se2.compose(at_node, mount)[2])
        R = rotate(censi(found, source, self._prepared[node]), heading)
        back = se2.inverse(mount)
        by_lidar = se2.compose_jacobians(T_map_lidar, back)[0]
        covariance = by_lidar @ R @ by_lidar.T
        pose = se2.compose(T_map_lidar, back)
        pose[2] = se2.wrap(pose[2])
        return Refinement(pose, (covariance + covariance.T) / 2.0, "ok")


def find_turns_rad(source_m: Floats, target_m: Floats, n_turns: int = _TURNS) -> list[float]:
    """Headings of the source in the target's frame at which their outlines are most alike.

    Peaks of the circular correlation of inverse ranges (A,), which count near walls most and
    what was not seen for nothing.
    """
    outlines = []
    for ranges in (source_m, target_m):
        near = 1.0 / np.maximum(ranges.astype(np.float64), 1.0)
        outlines.append(np.fft.rfft(near - near.mean()))
    n = len(source_m)
    score = np.fft.irfft(outlines[1] * np.conj(outlines[0]), n)
    peaks = np.flatnonzero((score >= np.roll(score, 1)) & (score > np.roll(score, -1)))
    if not len(peaks):
        return [0.0]
    chosen: list[float] = []
    for peak in peaks[np.argsort(-score[peaks], kind="stable")]:
        turn = math.remainder(2.0 * math.pi * float(peak) / n, 2.0 * math.pi)
        apart = [abs(math.remainder(turn - other, 2.0 * math.pi)) for other in chosen]
        if all(gap > _HEADING_WINDOW_RAD for gap in apart):
            chosen.append(turn)
        if len(chosen) == n_turns:
            break
    return chosen
