"""Graph SLAM on the Intel building and Freiburg 079, beside the poses published with the logs.

`python -m experiments.papers.real_logs.building` prints errors of relations beside those of the
FLIRT poses on the very same relations, both of whose stamps lie within 0.05 s of a scan. The FLIRT
logs hold no wheels: there the log's SEQUENTIAL edges stand in for them. Its poses and its LOOP
edges are never input. A folder as the argument gets the figure of the building's map before and
after its loops are closed.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from estimators.base import Estimate
from estimators.graph_slam import GraphSlam
from estimators.odometry import Odometry
from experiments.evaluation.relations import relation_errors
from experiments.evaluation.time_sync import nearest
from experiments.papers.real_logs.logs import intel, tracked
from experiments.papers.real_logs.settings import DATA, KUEMMERLE
from experiments.runs.row import Row
from experiments.viewing.grid import draw_grid
from experiments.viewing.map import grid_along
from experiments.viewing.style import figure, save_figure
from sim.arrays import Array
from sim.formats import carmen
from sim.formats.relations import Relations, read_relations
from sim.recording import Recording

_TOLERANCE_S = 0.05
# Walls are no lines and people walk by: what the scans believe is ten times the laser's noise
_OPTIONS: dict[str, Any] = {"sigma_range_m": 0.1, "gate_probability": 1e-6, "kr": 1e-3, "kl": 1e-3}
_WHEELED: dict[str, Any] = {
    "kr": 3e-3,
    "kl": 3e-3,
    "lateral_slip_m": 3e-3,
}  # of the Intel robot, as for `ekf_icp`


def intel_by_edges() -> tuple[carmen.CarmenLog, Recording]:
    """The Intel log with the FLIRT poses, and a Recording whose wheels are its SEQUENTIAL edges."""
    log = carmen.read_carmen(DATA / "intel_lab/intel-lab.flirt.log.gz")
    return log, carmen.to_recording(log)


def freiburg_by_edges() -> tuple[carmen.CarmenLog, Recording]:
    """The same of Freiburg 079."""
    log = carmen.read_carmen(DATA / "fr079_flirt/fr079.flirt.log.gz")
    return log, carmen.to_recording(log)


def scored(
    name: str, wheels: str, recording: Recording, graph: carmen.CarmenLog, options: dict[str, Any]
) -> tuple[list[Row], Estimate]:
    """Errors of graph SLAM online and revised, and of the FLIRT poses; the revised estimate.

    Parameters
    ----------
    name
        `intel` or `fr079`.
    wheels
        What stands for them.
    options
        Of `estimators.graph_slam.GraphSlam`, beside those of all logs.
    """
    scans = recording.log("laser").stamps
    folder = {"intel": "intel_lab", "fr079": "fr079_flirt"}[name]
    relations = read_relations(DATA / folder / f"{name}.relations.gz")
    judged = _shared(relations, scans, graph.scan_stamps)
    estimator = GraphSlam(**_OPTIONS | options)
    online = tracked(estimator, recording)
    revised = estimator.finish()
    at_scans = np.searchsorted(online.stamps, scans)
    paths = {
        "graph_slam, online": (scans, online.means[at_scans]),
        "graph_slam, revised": (scans, revised.means[at_scans]),
        "FLIRT poses": (graph.scan_stamps, graph.scan_poses),
    }
    rows: list[Row] = []
    for method, path in paths.items():
        errors = relation_errors(judged, *path)
        rows.append({"log": name, "wheels": wheels, "method": method, **errors.summary()})
    mean_m = KUEMMERLE[name]["graph"][0]
    rows.append({"log": name, "method": "graph (printed)", "translation_mean_m": mean_m})
    return rows, revised


def _shared(relations: Relations, *stamps: Array) -> Relations:
    """Relations whose stamps are near ones of all these (T,), s."""
    kept = np.ones(len(relations.stamps), dtype=bool)
    for known in stamps:
        rows = nearest(known, relations.stamps)
        near = np.abs(known[rows] - relations.stamps) <= _TOLERANCE_S
        kept &= near.all(axis=1)
    return Relations(relations.stamps[kept], relations.motion[kept])


def draw(recording: Recording, before: Estimate, after: Estimate, folder: Path) -> Path:
    """Grid maps along two estimates, in one picture."""
    page = figure(11.0, 5.2)
    titles = {"by its edges alone": before, "with its loops closed": after}
    for ax, (title, path) in zip(page.subplots(1, 2), titles.items(), strict=True):
        grid, _ = grid_along(
            recording, path.stamps, path.means, resolution_m=0.05, max_range_m=20.0
        )
        draw_grid(ax, grid)
        low, high = grid.corners_m.min(axis=0), grid.corners_m.max(axis=0)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        ax.set_title(f"Intel Research Lab, {title}")
    picture = folder / "real_logs_building.png"
    save_figure(page, picture)
    return picture


def _main(folders: list[str]) -> None:
    graph, building = intel_by_edges()
    columns = ["log", "wheels", "method", "n_relations", "translation_mean_m", "translation_max_m"]
    rows, revised = scored("intel", "SEQUENTIAL edges", building, graph, {})
    print(pd.DataFrame(rows)[columns].to_string(index=False), flush=True)
    before = tracked(Odometry(_OPTIONS["kr"], _OPTIONS["kl"]), building)
    for folder in folders:
        print(draw(building, before, revised, Path(folder)), flush=True)
    log, recording = freiburg_by_edges()
    rows, _ = scored("fr079", "SEQUENTIAL edges", recording, log, {})
    print(pd.DataFrame(rows)[columns].to_string(index=False, header=False), flush=True)
    rows, _ = scored("intel", "wheels, calibrated", intel("calibrated"), graph, _WHEELED)
    print(pd.DataFrame(rows)[columns].to_string(index=False, header=False), flush=True)


if __name__ == "__main__":
    _main(sys.argv[1:])
