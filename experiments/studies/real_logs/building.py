"""Graph SLAM on the Intel building and Freiburg 079, beside the poses published with the logs.

`python -m experiments.studies.real_logs.building` prints errors of relations beside those of the
FLIRT poses on the very same relations, each between two scans whose stamps are known and lie within
0.05 s of it. The FLIRT logs hold no wheels: there the log's SEQUENTIAL edges stand in for them. Its
poses and its LOOP edges are never input. The log of Intel with wheels has no clock but at the scans
that it shares with others; the rest of its stamps are guessed, and judge nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from estimators.base import Estimate
from estimators.graph.graph_slam import GraphSlam
from estimators.odometry import Odometry
from experiments.calibration.from_log import moved_base
from experiments.evaluation.relations import judged_relations, relation_errors
from experiments.judging.logs import (
    GRAPHS,
    freiburg,
    intel,
    intel_known_stamps,
    relations_of,
    track,
)
from experiments.runs.console import show
from experiments.runs.row import Row
from experiments.studies.real_logs.settings import KUEMMERLE, RESOLUTION_M
from experiments.viewing.map import grid_along
from sim import se2
from sim.arrays import Array
from sim.formats import carmen
from sim.recording import Recording

_ORIGIN = np.zeros(3)
# Of the Intel robot, as for `ekf_icp`
_WHEELED: dict[str, Any] = {"kr": 3e-3, "kl": 3e-3, "lateral_slip_m": 3e-3}


def scored(
    name: str,
    wheels: str,
    recording: Recording,
    known_stamps: Array | None = None,
    T_base_judged: Array = _ORIGIN,
    **options: Any,
) -> tuple[list[Row], Estimate]:
    """Errors of graph SLAM online and revised, and of the FLIRT poses; the revised estimate.

    Parameters
    ----------
    name
        `intel` or `fr079`.
    wheels
        What stands for them.
    known_stamps
        Of the scans that may be judged; None for all.
    T_base_judged
        (3,) Frame of the relations, in base_link.
    options
        Of `estimators.graph.graph_slam.GraphSlam`; none but what is believed of the wheels.
    """
    scans, graph = recording.log("laser").stamps, carmen.read_carmen(GRAPHS[name])
    known = scans if known_stamps is None else known_stamps
    judged = judged_relations(relations_of(name), known, graph.scan_stamps)
    online, revised = track(GraphSlam(**options), recording)
    assert revised is not None
    at_scans = np.searchsorted(online.stamps, scans)
    rows: list[Row] = [
        {
            "log": name,
            "wheels": wheels,
            "method": method,
            **relation_errors(judged, *path).summary(),
        }
        for method, path in {
            "graph_slam, online": (scans, se2.compose(online.means[at_scans], T_base_judged)),
            "graph_slam, revised": (scans, se2.compose(revised.means[at_scans], T_base_judged)),
            "FLIRT poses": (graph.scan_stamps, graph.scan_poses),
        }.items()
    ]
    mean_m = KUEMMERLE[name]["graph"][0]
    rows.append({"log": name, "method": "graph (printed)", "translation_mean_m": mean_m})
    return rows, revised


def closed_loops() -> tuple[pd.DataFrame, dict[str, NDArray[Any]]]:
    """Errors on all logs, and grids of Intel by its edges alone and with its loops closed."""
    edges = carmen.to_recording(carmen.read_carmen(GRAPHS["intel"]))
    rows, after = scored("intel", "SEQUENTIAL edges", edges)
    before, _ = track(Odometry(), edges)
    rows += scored("fr079", "SEQUENTIAL edges", freiburg())[0]
    wheels, logged = intel("calibrated"), intel("logged")
    T_base_logged = moved_base(logged, wheels)
    known = intel_known_stamps(wheels)
    rows += scored("intel", "wheels, calibrated", wheels, known, T_base_logged, **_WHEELED)[0]
    return pd.DataFrame(rows), _grids(edges, before=before, after=after)


def _grids(recording: Recording, **paths: Estimate) -> dict[str, NDArray[Any]]:
    """Occupancy (rows, columns) along each path in cells of `RESOLUTION_M`, and its origin (3,)."""
    found: dict[str, NDArray[Any]] = {}
    for name, path in paths.items():
        grid, _ = grid_along(
            recording, path.stamps, path.means, resolution_m=RESOLUTION_M, max_range_m=20.0
        )
        found |= {name: grid.probability, f"{name}_origin": grid.origin}
    return found


if __name__ == "__main__":
    shown = ["log", "wheels", "method", "n_relations", "translation_mean_m", "translation_max_m"]
    show(closed_loops()[0][shown].to_string(index=False))
