"""A user's folder of logs, for the study of peers: which files are logs, and what judges them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.calibration.from_log import calibrate_log, moved_base
from experiments.calibration.reference import names_of
from experiments.judging.jobs import Progress, Tables, tables_of
from experiments.judging.logs import known_start
from experiments.runs.calibration import Calibration, read_calibration
from experiments.studies.peers.logs import (
    POSES,
    Case,
    case_by_scans,
    methods_of,
    ordered,
    rows_of,
)
from experiments.trajectories.part import Part
from sim import se2
from sim.errors import InputError, naming, require
from sim.formats.detect import kind_of, read_any
from sim.formats.relations import read_relations
from sim.recording import Recording
from sim.sensors import Laser, StereoCamera

_BESIDE = (".relations", ".tum", ".md", ".txt", ".yaml", ".pgm")  # what belongs to a log
_PACKED = (".gz", ".xz")


def over_folder(folder: Path, on_progress: Progress) -> dict[str, pd.DataFrame]:
    """The table of all methods over a user's folder of logs.

    Raises
    ------
    InputError
        If something in it cannot be a log, before any method runs; or cannot be read.
    """
    found = own_logs(folder)
    for log in found:
        try:
            kind_of(log)
        except InputError as error:
            raise InputError(f"{error}; move it out of the folder of logs") from error
    return ordered(tables_of(over_own, [(str(log),) for log in found], on_progress))


def over_own(log: str) -> Tables:
    """Rows of all methods on a file of the user's."""
    case = own_case(Path(log))
    return {"logs": rows_of(case, methods_of(case))}


def own_logs(folder: Path) -> list[Path]:
    """Logs in a folder: its files and folders but for those that belong to one.

    Raises
    ------
    InputError
        If it is not a folder, or holds none.
    """
    require(folder.is_dir(), f"{folder}: not a folder; name one that holds logs")
    found = [
        path
        for path in sorted(folder.iterdir())
        if not path.name.startswith(".") and _bare(path).suffix not in _BESIDE
    ]
    require(
        bool(found),
        f"{folder}: holds no logs; put logs there (docs/formats.md), and beside LOG.npz "
        "LOG.relations or LOG.tum to judge by",
    )
    return found


def _bare(path: Path) -> Path:
    """The path without what says that it is packed."""
    return path.with_suffix("") if path.suffix in _PACKED else path


def own_case(log: Path) -> Case:
    """A user's log: of scans, or of landmarks with ids and a truth.

    `NAME.relations` beside it (or packed) has its relations, `NAME.tum` its reference poses, and
    `NAME.yaml` its calibration, where it cannot be calibrated by its own scans or landmarks.

    Raises
    ------
    InputError
        Naming the log, if it cannot be read or calibrated, or nothing judges it.
    """
    stem = _bare(log).stem.removesuffix(".tar")
    beside = {
        suffix: path
        for suffix in (".relations", ".tum", ".yaml")
        for path in (log.with_name(stem + suffix + packed) for packed in ("", *_PACKED))
        if path.is_file()
    }
    with naming(log):
        logged = read_any([log])
        if ".tum" in beside:
            logged = Part(truth=beside[".tum"]).of(logged)
        lasers, cameras = names_of(logged, Laser), names_of(logged, StereoCamera)
        require(
            "laser" in lasers or "stereo" in cameras,
            "has neither a laser `laser` nor a camera `stereo`; move it out of the folder",
        )
        require(
            logged.truth is not None or ".relations" in beside,
            f"nothing judges it; put {stem}.relations or {stem}.tum beside it",
        )
        by_scans = "laser" in lasers
        try:
            found = (
                read_calibration(beside[".yaml"])
                if ".yaml" in beside
                else calibrate_log(
                    dataclasses.replace(logged, truth=None) if by_scans else logged
                ).calibration
            )
        except InputError as error:
            raise InputError(
                f"cannot be calibrated ({error}); put a calibration of its robot beside it, "
                f"{stem}.yaml of `estima calibrate`"
            ) from error
        if ".relations" in beside:
            return case_by_scans(stem, logged, read_relations(beside[".relations"]), found)
        return _by_poses(stem, logged, found)


def _by_poses(name: str, logged: Recording, found: Calibration) -> Case:
    """A log with reference poses, from the true start."""
    calibrated = found.apply_to(logged)
    moved = moved_base(logged, calibrated)
    first = calibrated.truth_at(calibrated.frame_stamps[:1])[0]
    require(
        bool(np.isfinite(first).all()),
        "its reference begins after its first Frame; cut the log there with `estima convert`",
    )
    start = known_start(calibrated, se2.compose(first, se2.inverse(moved)))
    return Case(name, calibrated, found, start, POSES, moved)
