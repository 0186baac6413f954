"""Recordings and estimates into the files that other tools open, by the ending of the name."""

from pathlib import Path

import numpy as np

from estimators.base import Estimate
from experiments.trajectories.odometry import write_odometry_csv, write_odometry_json
from sim.errors import InputError, required
from sim.formats.tum import write_tum
from sim.recording import Recording, save

_BAGS = (".mcap", ".bag", ".db3", "")


def write_recording(path: Path, recording: Recording) -> None:
    """Write a Recording: .npz, a bag, .log (CARMEN), or .tum (its truth).

    Raises
    ------
    InputError
        If the ending is not known, or the format cannot hold the recording.
    """
    if path.suffix == ".npz":
        save(recording, path)
    elif path.suffix in _BAGS:
        from sim.formats.rosbag_out import write_bag

        write_bag(path, recording)
    elif path.suffix == ".log":
        from sim.formats.carmen import write_carmen

        write_carmen(path, recording)
    elif path.suffix == ".tum":
        truth = required(
            recording.truth, f"{path}: the recording has no reference trajectory to write"
        )
        write_tum(path, truth.stamps, truth.poses)
    else:
        raise InputError(
            f"{path}: unknown ending {path.suffix!r}; known: .npz .mcap .bag .db3 .log .tum"
        )


def write_estimate(path: Path, estimate: Estimate, recording: Recording | None = None) -> None:
    """Write an Estimate: .tum (also for evo), .csv, .json, or a bag with the Recording beside it.

    Raises
    ------
    InputError
        If the ending is not known, or the file cannot be written.
    """
    if path.suffix == ".tum":
        write_tum(path, estimate.stamps, estimate.means)
    elif path.suffix == ".csv":
        write_odometry_csv(estimate, path)
    elif path.suffix == ".json":
        write_odometry_json(estimate, path)
    elif path.suffix in _BAGS:
        from sim.formats.rosbag import Track
        from sim.formats.rosbag_out import write_bag

        known = estimate.map if isinstance(estimate.map, dict) else {}
        landmarks = np.asarray(known.get("landmarks", np.zeros((0, 3))), float)
        track = Track(estimate.stamps, estimate.means, estimate.covariances, landmarks)
        write_bag(path, recording, {"estimate": track})
    else:
        raise InputError(
            f"{path}: unknown ending {path.suffix!r}; known: .tum .csv .json .mcap .bag .db3"
        )
