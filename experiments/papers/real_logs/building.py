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


def scored() -> tuple[pd.DataFrame, Recording, dict[str, Estimate]]:
    """Errors by log and method; the Intel log, and its estimates by name."""
    rows: list[Row] = []
    graphs = {
        name: carmen.read_carmen(DATA / path)
        for name, path in (
            ("intel", "intel_lab/intel-lab.flirt.log.gz"),
            ("fr079", "fr079_flirt/fr079.flirt.log.gz"),
        )
    }
    relations = {
        "intel": read_relations(DATA / "intel_lab/intel.relations.gz"),
        "fr079": read_relations(DATA / "fr079_flirt/fr079.relations.gz"),
    }
    building = carmen.to_recording(graphs["intel"])
    runs: list[tuple[str, str, Recording, dict[str, Any]]] = [
        ("intel", "SEQUENTIAL edges", building, {}),
        ("intel", "wheels, 910 scans", intel("sparse"), _WHEELED),
        ("fr079", "SEQUENTIAL edges", carmen.to_recording(graphs["fr079"]), {}),
    ]
    found: dict[str, Estimate] = {}
    for log, wheels, recording, options in runs:
        graph, scans = graphs[log], recording.log("laser").stamps
        judged = _shared(relations[log], scans, graph.scan_stamps)
        estimator = GraphSlam(**_OPTIONS | options)
        online = tracked(estimator, recording)
        paths = {"online": online, "revised": estimator.finish()}
        if recording is building:
            alone = GraphSlam(**_OPTIONS, loop_reach_m=1e-9, revisions=0)
            found = paths | {"chain": tracked(alone, recording)}
        at_scans = np.searchsorted(online.stamps, scans)
        for name, path in paths.items():
            errors = relation_errors(judged, scans, path.means[at_scans])
            row: Row = {"log": log, "wheels": wheels, "method": f"graph_slam, {name}"}
            rows.append({**row, **errors.summary()})
        errors = relation_errors(judged, graph.scan_stamps, graph.scan_poses)
        rows.append({"log": log, "wheels": wheels, "method": "FLIRT poses", **errors.summary()})
        mean_m = KUEMMERLE[log]["graph"][0]
        rows.append({"log": log, "method": "graph (printed)", "translation_mean_m": mean_m})
    return pd.DataFrame(rows), building, found


def _shared(relations: Relations, *stamps: Array) -> Relations:
    """Relations whose stamps are near ones of all these (T,), s."""
    kept = np.ones(len(relations.stamps), dtype=bool)
    for known in stamps:
        near = np.abs(known[nearest(known, relations.stamps)] - relations.stamps) <= _TOLERANCE_S
        kept &= near.all(axis=1)
    return Relations(relations.stamps[kept], relations.motion[kept])


def draw(recording: Recording, found: dict[str, Estimate], folder: Path) -> Path:
    """Grid maps along the chain of registrations and along the revised path."""
    page = figure(11.0, 6.0)
    titles = {"chain": "before", "revised": "after its loops are closed"}
    for ax, (name, title) in zip(page.subplots(1, 2), titles.items(), strict=True):
        path = found[name]
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


if __name__ == "__main__":
    table, log, estimates = scored()
    columns = ["log", "wheels", "method", "n_relations", "translation_mean_m", "translation_max_m"]
    print(table[columns].to_string(index=False))
    for folder in sys.argv[1:]:
        print(draw(log, estimates, Path(folder)))
