"""A topological map: places with a position, a descriptor and neighbours (maximo2024, sec. 2.2).

It is built from a mapping run, or from your own arrays, and stored as an `.npz` without pickles.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.topological import descriptors as describers
from sim import se2
from sim.arrays import Array, Floats, Ints
from sim.errors import InputError, require, required
from sim.files import require_file, write_whole
from sim.npz import UNREADABLE, read_arrays
from sim.recording import Recording
from sim.sensors import Lidar3D

FORMAT_VERSION = 1


@dataclass(frozen=True)
class TopologicalMap:
    """N nodes and the edges between neighbours.

    Attributes
    ----------
    positions_m
        (N, 2) m in map: where base_link stood. Two nodes may share a position.
    descriptors
        (N, D) float32, finite.
    edges
        (E, 2) node numbers of neighbours, each pair once, the smaller number first. The graph
        may fall into parts.
    descriptor
        What made the descriptors: a name of `estimators.topological.descriptors.KINDS`, or empty
        for your own network, compared by Euclidean distance.
    headings_rad
        (N,) heading of base_link at each node; NaN where it is not known.
    slices_m
        (N, A) float32 horizontal ranges of a level slice of each node's cloud, by
        counter-clockwise bearing in the sensor frame from -pi; (0, 0) without clouds.
    """

    positions_m: Array
    descriptors: Floats
    edges: Ints
    descriptor: str = ""
    headings_rad: Array = field(default_factory=lambda: np.zeros(0))
    slices_m: Floats = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    def __post_init__(self) -> None:
        n = len(self.positions_m)
        require(n > 0, "a topological map needs at least one node")
        _check_positions(self.positions_m)
        require(
            self.descriptors.ndim == 2 and len(self.descriptors) == n and self.descriptors.size,
            f"descriptors must have shape ({n}, D), one row a position, "
            f"got {self.descriptors.shape}",
        )
        _check_finite("descriptor", self.descriptors)
        require(
            self.edges.ndim == 2 and self.edges.shape[1] == 2,
            f"edges must have shape (E, 2), got {self.edges.shape}",
        )
        first, second = self.edges.T
        wrong = (first < 0) | (second >= n) | (first >= second)
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                f"edge {row} joins {first[row]} and {second[row]}; give two different nodes "
                f"from 0 to {n - 1}, the smaller number first"
            )
        require(
            self.descriptor in ("", *describers.KINDS),
            f"unknown descriptor {self.descriptor!r}; known: {', '.join(describers.KINDS)}",
        )
        if len(self.headings_rad) == 0:
            object.__setattr__(self, "headings_rad", np.full(n, np.nan))
        require(
            self.headings_rad.shape == (n,),
            f"headings must have shape ({n},), got {self.headings_rad.shape}",
        )
        require(
            self.slices_m.ndim == 2 and len(self.slices_m) in (0, n),
            f"slices must have shape ({n}, A), got {self.slices_m.shape}",
        )
        for f in dataclasses.fields(self):
            if isinstance(array := getattr(self, f.name), np.ndarray):
                array.setflags(write=False)

    def __len__(self) -> int:
        """N."""
        return len(self.positions_m)

    @cached_property
    def spacing_m(self) -> float:
        """Median distance between neighbours that are apart, m; 0 if there are none."""
        ends = self.positions_m[self.edges]
        lengths = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
        return float(np.median(lengths[lengths > 0.0])) if np.any(lengths > 0.0) else 0.0

    def moved(self, T_new_old: Array) -> TopologicalMap:
        """Return the map as seen from another map frame."""
        return dataclasses.replace(
            self,
            positions_m=se2.transform(T_new_old, self.positions_m),
            headings_rad=se2.wrap(self.headings_rad + T_new_old[2]),
        )


class Edges:
    """The map's edges in both directions, in the order of their tails.

    A node without neighbours has an endless edge to itself, so that every particle has one.

    Attributes
    ----------
    tail, head, reverse
        (F,) node numbers, and the edge that leads back.
    length_m, heading_rad
        (F,) from tail to head. Nodes in the same place are a hundredth of the median apart.
    first_out, degree
        (N,) the edges that leave node i are the `degree[i]` from `first_out[i]` on.
    """

    def __init__(self, known_map: TopologicalMap) -> None:
        n, joined = len(known_map), known_map.edges
        alone = np.setdiff1d(np.arange(n), joined)
        tail = np.concatenate([joined[:, 0], joined[:, 1], alone])
        head = np.concatenate([joined[:, 1], joined[:, 0], alone])
        order = np.argsort(tail, kind="stable")
        self.tail, self.head = tail[order], head[order]
        # the k-th edge by (tail, head) leads back along the k-th by (head, tail)
        self.reverse = np.empty(len(order), np.int64)
        self.reverse[np.lexsort((self.head, self.tail))] = np.lexsort((self.tail, self.head))
        self.first_out = np.searchsorted(self.tail, np.arange(n))
        self.degree = np.bincount(self.tail, minlength=n)
        way = known_map.positions_m[self.head] - known_map.positions_m[self.tail]
        lone = self.head == self.tail
        self.length_m = np.maximum(np.hypot(*way.T), 0.01 * known_map.spacing_m)
        self.length_m[lone | (known_map.spacing_m == 0.0)] = np.inf
        self.heading_rad = np.arctan2(way[:, 1], way[:, 0])
        self.heading_rad[lone] = np.nan_to_num(known_map.headings_rad[self.tail[lone]])

    def next(self, edges: Ints, uniform: Array) -> Ints:
        """Edge after each, past its head: any but the one back, which is left for dead ends."""
        node, back = self.head.take(edges), self.reverse.take(edges)
        others = self.degree.take(node) - 1
        chosen = self.first_out.take(node) + (uniform * others).astype(np.int64)
        chosen += chosen >= back
        return np.where(others > 0, chosen, back)

    def before(self, edges: Ints, uniform: Array) -> Ints:
        """Edge before each, for driving backwards."""
        return np.asarray(self.reverse[self.next(self.reverse[edges], uniform)])


def from_arrays(
    positions_m: ArrayLike,
    descriptors: ArrayLike,
    *,
    break_m: float | None = None,
    join_m: float | None = None,
    descriptor: str = "",
    headings_rad: ArrayLike = (),
    slices_m: ArrayLike | None = None,
) -> TopologicalMap:
    """Map of the places along a route, in its order.

    Parameters
    ----------
    positions_m, descriptors
        (N, 2) m and (N, D), of any network.
    break_m
        Successive nodes are neighbours up to this distance; None: all are.
    join_m
        Other nodes within this of each other are neighbours too, where the route meets itself;
        None: none are. Of those, only pairs at least three steps apart along the route count.
    """
    positions = np.array(positions_m, np.float64)
    features = np.array(descriptors, np.float32)
    _check_positions(positions)
    steps = np.hypot(*np.diff(positions, axis=0).T)
    first = np.flatnonzero(steps <= (np.inf if break_m is None else break_m))
    edges = np.stack([first, first + 1], axis=1)
    if join_m is not None and len(positions) > 3:
        from scipy.spatial import cKDTree

        pairs = cKDTree(positions).query_pairs(join_m, output_type="ndarray")
        edges = np.concatenate([edges, pairs[pairs[:, 1] - pairs[:, 0] > 2]])
    return TopologicalMap(
        positions,
        features,
        np.unique(edges, axis=0).astype(np.int64).reshape(-1, 2),
        descriptor,
        np.array(headings_rad, np.float64),
        np.zeros((0, 0), np.float32) if slices_m is None else np.array(slices_m, np.float32),
    )


def from_files(
    positions: str,
    descriptors: str,
    break_m: float | None = None,
    join_m: float | None = None,
) -> TopologicalMap:
    """Map from two files of arrays (`.npy`, or numbers as `.csv`), as `from_arrays`."""
    return from_arrays(
        read_array(Path(positions)), read_array(Path(descriptors)), break_m=break_m, join_m=join_m
    )


def read_array(path: Path) -> Array:
    """Read a table of numbers from `.npy` or, comma-separated, from `.csv`; a heading is skipped.

    Raises
    ------
    InputError
        If the file is missing or holds something else.
    """
    require_file(path)
    try:
        if path.suffix == ".npy":
            table = np.load(path, allow_pickle=False)
        else:
            with path.open() as lines:
                heading = any(c.isalpha() and c not in "eEnaif" for c in lines.readline())
            table = np.loadtxt(path, delimiter=",", skiprows=int(heading), ndmin=2)
    except (OSError, ValueError, EOFError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: not a table of numbers ({reason}); give .npy or .csv") from error
    require(
        np.issubdtype(table.dtype, np.number),
        f"{path}: holds {table.dtype}, not numbers; give .npy or .csv of numbers",
    )
    return np.asarray(table, np.float64)


def from_recording(
    recording: Recording,
    descriptor: str = "scan_context",
    spacing_m: float = 5.0,
    join_m: float | None = None,
) -> TopologicalMap:
    """Map of a mapping run: a node each time the robot has gone `spacing_m`.

    Parameters
    ----------
    recording
        A run with 3D clouds, or with place descriptors of one's own, and with its true poses
        (GPS, in the paper).
    descriptor
        Name of `estimators.topological.descriptors.KINDS`; ignored if the run has place
        descriptors.
    spacing_m
        Least distance between successive nodes.
    join_m
        As in `from_arrays`; None: 0.75 times the spacing, which also closes a loop.
    """
    require(spacing_m > 0.0, f"spacing_m of a topological map must be positive, got {spacing_m}")
    log = required(
        recording.logs.get("place") or recording.logs.get("lidar3d"),
        "a topological map needs a recording with 3D clouds or place descriptors",
    )
    poses = recording.truth_at(log.stamps)
    rows: list[int] = []
    for row in np.flatnonzero(np.isfinite(poses).all(axis=1)):
        if not rows or np.hypot(*(poses[row, :2] - poses[rows[-1], :2])) >= spacing_m:
            rows.append(int(row))
    require(rows, "none of the clouds of the recording has a true pose; no map can be built")
    slices = None
    if "place" in recording.logs:
        features, descriptor = log["descriptor"][rows], ""
    else:
        lidar, kind = recording.sensor("lidar3d", Lidar3D), describers.kind(descriptor)
        turns = log["ranges_m"][rows]
        features = np.array([kind.describe(lidar, turn) for turn in turns])
        slices = [level_slice(lidar, turn) for turn in turns]
    return from_arrays(
        poses[rows, :2],
        features,
        join_m=0.75 * spacing_m if join_m is None else join_m,
        descriptor=descriptor,
        headings_rad=poses[rows, 2],
        slices_m=slices,
    )


def level_slice(lidar: Lidar3D, ranges_m: Floats) -> Floats:
    """Horizontal ranges (A,) m of the ring nearest to level, the upper one of two: a planar scan.

    Rings that look down end on the ground, off the walls.
    """
    elevations = lidar.elevations_rad
    ring = int(np.argmin(np.abs(elevations - 1e-6)))
    return np.asarray((ranges_m[ring] * np.cos(elevations[ring])).astype(np.float32))


_ARRAYS = ("positions_m", "descriptors", "edges", "headings_rad", "slices_m")


def save(known_map: TopologicalMap, path: Path) -> None:
    """Write a map as `.npz`; the file appears whole or not at all."""
    arrays = {name: getattr(known_map, name) for name in _ARRAYS}
    name = np.frombuffer(known_map.descriptor.encode(), np.uint8)
    with write_whole(path) as part, part.open("wb") as file:
        np.savez(
            file,
            allow_pickle=False,
            topological_map=np.array(FORMAT_VERSION),
            descriptor=name,
            **arrays,
        )


def load(path: str | Path) -> TopologicalMap:
    """Read a map.

    Raises
    ------
    InputError
        If the file is missing, damaged, or does not hold a topological map.
    """
    try:
        archive = read_arrays(Path(path))
        version = int(archive["topological_map"])
        name = archive["descriptor"].tobytes().decode()
        arrays = {key: archive[key] for key in _ARRAYS}
    except (InputError, *UNREADABLE) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{path}: not a topological map ({reason}); build it again from its mapping run"
        ) from error
    require(
        version == FORMAT_VERSION, f"{path}: format {version}, this version reads {FORMAT_VERSION}"
    )
    try:
        return TopologicalMap(descriptor=name, **arrays)
    except (InputError, *UNREADABLE) as error:
        raise InputError(f"{path}: {error}") from error


def _check_positions(positions_m: Array) -> None:
    require(
        positions_m.ndim == 2 and positions_m.shape[1] == 2,
        f"positions must have shape (N, 2), got {positions_m.shape}",
    )
    _check_finite("position", positions_m)


def _check_finite(what: str, values: NDArray[np.floating]) -> None:
    bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    if bad.any():
        raise InputError(f"{what} {int(np.argmax(bad))} of the map holds NaN or inf; leave it out")
