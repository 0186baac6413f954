"""What the figures draw: example runs, maps, clouds and walls, as arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.topological_map import from_recording
from experiments.papers.maximo2024.places import resequenced
from experiments.papers.maximo2024.settings import DRAWN_DESCRIPTOR, ITERATIONS, JUDGED_SEED
from experiments.papers.maximo2024.worlds import (
    Case,
    campus_runs,
    case_of,
    cluster_labels,
    localize,
    options,
)
from experiments.papers.results import Results
from experiments.runs.seeds import stream
from sim import se2
from sim.recording import Recording

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[np.generic]]

_REACH_M = 65.0  # of the clouds kept, from the middle of the nodes drawn
_CLOUD_GRID_M = 0.05


def write_examples(out: Results, names: list[str], campus: str) -> None:
    """Write the arrays of two routes and a campus, one file each.

    Parameters
    ----------
    names
        Oxford's route and UMH's.
    campus
        `campus`, or `campus_quick`.
    """
    for name in names:
        out.write_arrays(name, **route_arrays(case_of(name, JUDGED_SEED)))
    out.write_arrays(campus, **campus_arrays(campus))


def route_arrays(case: Case) -> Arrays:
    """Nodes, their clusters and queries; errors of M2 from three starts, particles of a fourth run.

    Returns
    -------
    dict
        `nodes_m` (N, 2), `clusters` (N,), `queries_m` (K, 2); `start_errors_m` (3, K), NaN before
        the start; at `ITERATIONS` `means_m` (4, 2) and `particles_m` (4, M, 2).
    """
    n = len(case.recording.frame_stamps)
    errors = np.full((3, n), np.nan)
    for i, start in enumerate((0, n // 4, n // 2)):
        part = resequenced(case.recording, np.arange(start, n))
        rng = stream(case.seed, "estimator/figure", start)
        errors[i, start:] = localize(case, options(case), rng, part).errors_m
    rng, part = stream(case.seed, "estimator/figure", 6), case.recording.cut(ITERATIONS[-1] + 1)
    found = localize(case, options(case), rng, part).estimate
    steps = list(ITERATIONS)
    return {
        "nodes_m": case.known_map.positions_m,
        "clusters": cluster_labels(case.known_map, case.seed),
        "queries_m": case.recording.truth_at(case.recording.frame_stamps)[:, :2],
        "start_errors_m": errors.astype(np.float32),
        "means_m": found.means[steps, :2],
        "particles_m": np.array(found.extras["particles"])[steps, :, :2].astype(np.float32),
    }


def campus_arrays(name: str) -> Arrays:
    """Nodes, their clusters, queries and walls; clouds of four nodes and of four queries.

    Returns
    -------
    dict
        `nodes_m` (N, 2), `clusters` (N,), `queries_m` (K, 2), `walls_m` (W, 2, 2); where the
        clouds were taken, `map_spots_m` and `query_spots_m` (4, 2), and what they show above
        ground, `map_clouds_m` and `query_clouds_m` (P, 2).
    """
    experiments = campus_runs(name, JUDGED_SEED)
    mapping, taking = (experiment.recording() for experiment in experiments)
    spacing_m = experiments[0].config["prior"]["map"]["spacing_m"]
    known = from_recording(mapping, DRAWN_DESCRIPTOR, spacing_m)
    # where there is most to see within 40 m
    seen = np.convolve(np.sum(known.slices_m < 40.0, axis=1), np.ones(4), "valid")
    nodes = known.positions_m[np.argmax(seen) + np.arange(4)]
    between = nodes + 0.4 * np.diff(nodes, axis=0, append=nodes[-1:])
    map_spots, map_clouds = _clouds(mapping, nodes)
    query_spots, query_clouds = _clouds(taking, between)
    assert taking.truth is not None
    assert taking.truth.world is not None
    return {
        "nodes_m": known.positions_m,
        "clusters": cluster_labels(known, JUDGED_SEED),
        "queries_m": taking.truth_at(taking.frame_stamps)[:, :2],
        "walls_m": taking.truth.world.walls.reshape(-1, 2, 2),
        "map_spots_m": map_spots,
        "map_clouds_m": map_clouds,
        "query_spots_m": query_spots,
        "query_clouds_m": query_clouds,
    }


def _clouds(recording: Recording, points_m: Array) -> tuple[Array, NDArray[np.float32]]:
    """Where the clouds nearest to points (4, 2) were taken, and what they show above ground."""
    lidar, clouds = recording.sensors.lidar3d, recording.clouds
    assert lidar is not None
    assert clouds is not None
    poses = recording.truth_at(clouds.stamps)
    rows = [int(np.argmin(np.hypot(*(poses[:, :2] - point).T))) for point in points_m]
    shown = []
    for row in rows:
        points = lidar.points_in_sensor(clouds.ranges_m[row])
        points = points[points[:, 2] + lidar.mount.z_m > 0.3]
        shown.append(se2.transform(poses[row], points[:, :2]))
    drawn = np.concatenate(shown)
    drawn = drawn[np.hypot(*(drawn - points_m.mean(axis=0)).T) < _REACH_M]
    cells = np.unique(np.round(drawn / _CLOUD_GRID_M), axis=0)  # a picture shows no more
    return poses[rows, :2], (_CLOUD_GRID_M * cells).astype(np.float32)
