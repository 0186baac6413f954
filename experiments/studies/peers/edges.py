"""Logs in which a graph's edges between scans stand for the wheels.

Such edges come from a scan matcher that knew the robot: to calibrate them as wheels makes all
methods worse. So only their noise is that of `estima calibrate`. The Intel log with the robot's own
wheels stands beside: it has a clock at some scans only, so few relations judge it.
"""

import dataclasses

from experiments.calibration.from_log import calibrate_log
from experiments.judging.jobs import Tables
from experiments.judging.logs import GRAPHS, relations_of
from experiments.runs.calibration import Wheels
from experiments.studies.peers.logs import Case, case_by_scans, methods_of, rows_of
from sim.formats import carmen

LOGS = {"intel, edges": "intel", "fr079": "fr079"}  # to the names of their graphs


def case_of(name: str) -> Case:
    """One of `LOGS`: wheels and mount as logged, noise as calibrated."""
    logged = carmen.to_recording(carmen.read_carmen(GRAPHS[LOGS[name]]))
    blind = dataclasses.replace(logged, truth=None)
    as_logged = Wheels(gain_right=1.0, gain_left=1.0, track_m=logged.robot.track_m, delay_s=0.0)
    noise = dataclasses.replace(calibrate_log(blind).calibration, wheels=as_logged, sensors={})
    return case_by_scans(name, logged, relations_of(LOGS[name]), noise)


def over_edges(name: str) -> Tables:
    """Rows of all methods on one of `LOGS`."""
    case = case_of(name)
    return {"logs": rows_of(case, methods_of(case))}
