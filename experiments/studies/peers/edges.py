"""The Intel log in which a graph's edges stand for the wheels, whose relations all have stamps.

The log with the robot's own wheels has no clock but at some scans, so few relations judge it.
"""

from experiments.judging.jobs import Tables
from experiments.judging.logs import GRAPHS, relations_of
from experiments.studies.peers.logs import _by_scans, methods_of, rows_of
from sim.formats import carmen

NAME = "intel, edges"


def over_edges() -> Tables:
    """Rows of all methods on that log."""
    logged = carmen.to_recording(carmen.read_carmen(GRAPHS["intel"]))
    case = _by_scans(NAME, logged, relations_of("intel"))
    return {"logs": rows_of(case, methods_of(case))}
