"""The study of GI10: what a team sees of a building by the distance that it drives, by strategy.

In a world all strategies have the same robots, slip streams and starts. What is seen is counted by
the truth: floor that a beam has crossed, from where the robots were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from estimators.base import Estimate
from experiments.evaluation.map_quality import landmark_errors
from experiments.evaluation.metrics import travelled_m
from experiments.judging.jobs import Progress, Tables, tables_of
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import FIRST_SEED, Profile, Results
from experiments.judging.sequential import run_worlds
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.studies.exploration import settings
from experiments.studies.exploration.claims import gi10
from experiments.viewing.team_figure import drive_of
from sim import se2
from sim.arrays import Array
from sim.sensors.laser import Laser
from sim.team import Team
from sim.worlds.grid import rasterize
from sim.worlds.grid_mapping import ScanGrid

_EVERY_S = 1.0  # the area is counted
_EVERY_M = 0.5  # of the curves that are kept


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run the study; write its tables, and two drives through one world for the figure.

    Parameters
    ----------
    profile
        `quick`: two worlds.
    """
    tables = run_worlds(
        *("exploration", ["GI10"], profile, _worlds, lambda t: list(gi10(t["runs"]))),
        on_progress=lambda share: on_progress(0.95 * share),
    )
    out.write_tables(**tables)
    for strategy in (settings.BASE, settings.BOTH):
        team = compose_experiment(FIRST_SEED[profile], strategy).recordings()
        out.write_arrays(f"drive_{strategy}", **drive_of(team.robots, settings.AFTER_M))
    on_progress(1.0)


def _worlds(seeds: Sequence[int]) -> Mapping[str, pd.DataFrame]:
    return tables_of(tables_from, [(seed, one) for one in settings.NAMES for seed in seeds])


REMADE = {"runs": 5.0, "coverage": 5.0}


def remake(_table: str, row: Cells) -> Remake:
    """The call that makes a row again."""
    return tables_from, (int(row["seed"]), row["strategy"])


def tables_from(seed: int, strategy: str) -> Tables:
    """What one exploration came to, and the area seen by the distance driven.

    The map is that of the paper's method, run over the drive.
    """
    experiment = compose_experiment(seed, strategy)
    team = experiment.recordings()
    driven_m, area_m2 = coverage(team, settings.RESOLUTION_M)
    labels: Row = {"seed": seed, "strategy": strategy}
    maps: list[Estimate] = []
    evaluate(experiment, lambda: team, on_estimate=lambda *one: maps.append(one[3] or one[2]))
    row: Row = {
        **labels,
        "area_m2": float(np.interp(settings.AFTER_M, driven_m, area_m2)),
        "driven_m": float(driven_m[-1]),
        "stopped": sum(robot.status != "ok" for robot in team.robots),
        **landmark_errors(team.robots[0], maps[0].map),
    }
    at = np.arange(0.0, driven_m[-1] + _EVERY_M, _EVERY_M)
    curve = pd.DataFrame({**labels, "driven_m": at, "area_m2": np.interp(at, driven_m, area_m2)})
    return {"runs": [row], "coverage": curve}


def compose_experiment(seed: int, strategy: str) -> Experiment:
    """The experiment of one strategy in one world."""
    return Experiment.compose(["study=exploration", f"seed={seed}", f"route.strategy={strategy}"])


def coverage(team: Team, resolution_m: float) -> tuple[Array, Array]:
    """Mean distance driven per robot (T,) m, and floor area seen by then (T,) m^2.

    Floor is what can be reached from the start, and seen what a beam has crossed, by the truth.
    """
    world = team.robots[0].known_world
    laser = team.robots[0].sensor("laser", Laser)
    ends, reach_m = world.walls.reshape(-1, 2), laser.max_range_m + 1.0
    low, high = ends.min(axis=0) - reach_m, ends.max(axis=0) + reach_m
    grid = ScanGrid.over(low, high, resolution_m)
    every = np.argwhere(grid.last_scan == 0)
    reached = rasterize(world, resolution_m, laser.mount.z_m).at(grid.middles_m(every))
    floor = (reached == 0.0).reshape(grid.last_scan.shape)
    until_s = max(robot.frame_stamps[-1] for robot in team.robots)
    stamps = np.arange(0.0, until_s + _EVERY_S, _EVERY_S)
    area_m2 = []
    for before, now in zip(stamps - _EVERY_S, stamps, strict=True):
        for robot in team.robots:
            log = robot.log("laser")
            rows = slice(*np.searchsorted(log.stamps, [before + 1e-9, now + 1e-9]))
            if rows.start < rows.stop:
                ranges_m = log.values["ranges_m"][rows]
                ranges_m = np.where(laser.returned(ranges_m), ranges_m, 2.0 * laser.max_range_m)
                poses = se2.compose(robot.truth_at(log.stamps[rows]), laser.mount.pose)
                grid.add(poses, ranges_m.astype(np.float32), laser.bearings_rad, laser.max_range_m)
        area_m2.append(resolution_m**2 * np.count_nonzero(floor & (grid.last_scan > 0)))
    truths = [robot.known_truth for robot in team.robots]
    driven_m = [np.interp(stamps, own.stamps, travelled_m(own.poses)) for own in truths]
    return np.mean(driven_m, axis=0), np.array(area_m2)
