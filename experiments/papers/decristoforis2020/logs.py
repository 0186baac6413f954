"""Recordings of real logs that conf/study/decristoforis2020/*.yaml name."""

import dataclasses
from pathlib import Path

from experiments.judging import logs
from sim.errors import required
from sim.formats.rawseeds import read_rawseeds
from sim.recording import Recording


def intel() -> Recording:
    """The Intel Research Lab's log, with the 910 poses of a mapper as its truth."""
    return dataclasses.replace(logs.intel("logged"), truth=logs.intel("sparse").truth)


def rawseeds(
    odometry: str | None,
    scans: str | None,
    truth: str | None,
    resolution_deg: float,
    m_per_tick: float | None,
) -> Recording:
    """A log of Rawseeds as its publishers distribute it.

    Parameters
    ----------
    odometry, scans, truth
        Files ODOMETRY_XYT, SICK_FRONT and GROUNDTRUTH; there may be no truth.
    resolution_deg, m_per_tick
        As in `sim.formats.rawseeds.read_rawseeds`.
    """
    remedy = "must name a CSV file of Rawseeds, such as Bicocca_2009-02-27b-"
    files = (
        Path(required(odometry, f"recording.odometry {remedy}ODOMETRY_XYT.csv")),
        Path(required(scans, f"recording.scans {remedy}SICK_FRONT.csv")),
    )
    return read_rawseeds(
        *files,
        None if truth is None else Path(truth),
        resolution_deg=resolution_deg,
        m_per_tick=m_per_tick,
    )
