"""The relations metric (Kuemmerle et al. 2009, "On measuring the accuracy of SLAM algorithms").

An estimate is judged by the motion between pairs of its poses whose true relation is known. So no
common frame is needed, and an early error does not count in all later poses.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from experiments.evaluation.time_sync import Rows, interpolate, nearest_rows
from sim import se2
from sim.arrays import Array
from sim.errors import require
from sim.formats.relations import Relations
from sim.recording import Recording

Association = Literal["near", "interpolated"]

TOLERANCE_S = 0.05  # between the stamp of a relation and that of a pose


@dataclass(frozen=True)
class RelationErrors:
    """Errors of an estimate's relations.

    Attributes
    ----------
    translation_m, rotation_rad
        (N,) lengths of the errors of the relations that could be judged.
    rows
        (N,) indices of those relations.
    """

    translation_m: Array
    rotation_rad: Array
    rows: Rows

    def summary(self) -> dict[str, float]:
        """Means, standard deviations and maxima, with the unit in the key."""
        found = {"n_relations": float(len(self.rows))}
        columns = {"translation": (self.translation_m, "m"), "rotation": (self.rotation_rad, "rad")}
        for name, (values, unit) in columns.items():
            found |= {
                f"{name}_mean_{unit}": float(np.mean(values)),
                f"{name}_std_{unit}": float(np.std(values)),
                f"{name}_max_{unit}": float(np.max(values)),
                f"{name}_squared_mean_{unit}2": float(np.mean(values**2)),
            }
        return found


def judged_relations(
    relations: Relations, *known_stamps: Array, tolerance_s: float = TOLERANCE_S
) -> Relations:
    """Relations between two different ones of each of these stamps (T,), s, or near them."""
    kept = np.ones(len(relations.stamps), dtype=bool)
    for known in known_stamps:
        rows = nearest_rows(known, relations.stamps)
        near = np.abs(known[rows] - relations.stamps) <= tolerance_s
        kept &= near.all(axis=1) & (rows[:, 0] != rows[:, 1])
    return Relations(relations.stamps[kept], relations.motion[kept])


def relation_scores(
    recording: Recording, relations: Relations, stamps: Array, poses: Array
) -> dict[str, float]:
    """Mean errors of poses (T, 3) at stamps (T,) by a log's relations, as columns of a row."""
    found = relation_errors(*counted(recording, relations, stamps, poses)).summary()
    return {
        "n_relations": found["n_relations"],
        "relation_translation_m": found["translation_mean_m"],
        "relation_rotation_rad": found["rotation_mean_rad"],
    }


def counted(
    recording: Recording, relations: Relations, stamps: Array, poses: Array
) -> tuple[Relations, Array, Array]:
    """Those of a log's relations, and of poses (T, 3) at stamps (T,), that count.

    Poses at scans count where there are such; of a log that was thinned, only those at scans whose
    stamps are known.
    """
    log, known = recording.logs.get("laser"), recording.config.get("stamps_known")
    at_scans = np.isin(stamps, [] if log is None else log.stamps)
    if at_scans.sum() >= 2:  # what lies between them may be guessed by wheels that were rebuilt
        stamps, poses = stamps[at_scans], poses[at_scans]
    if log is not None and known is not None:
        rows = np.array(known, np.int64)
        require(
            rows.ndim == 1 and len(rows) and rows.min() >= 0 and rows.max() < len(log.stamps),
            "stamps_known of the recording must be rows of its scans",
        )
        relations = judged_relations(relations, log.stamps[rows])
    return relations, stamps, poses


def relation_errors(
    relations: Relations,
    stamps: Array,
    poses: Array,
    association: Association = "near",
    tolerance_s: float = TOLERANCE_S,
) -> RelationErrors:
    """Judge poses (T, 3) at increasing stamps (T,) by relations.

    Parameters
    ----------
    association
        `near` takes the pose with the nearest stamp, if it is within the tolerance at both ends
        (0 for exact stamps). `interpolated` interpolates the poses at the relations' stamps within
        the trajectory's span; it adds errors of its own where a robot turns fast between sparse
        poses.

    Raises
    ------
    InputError
        If no relation can be judged.
    """
    order = np.argsort(stamps, kind="stable")
    stamps, poses = stamps[order], poses[order]
    require(len(stamps) >= 2, "relations need a trajectory of at least two poses")
    if association == "near":
        rows = nearest_rows(stamps, relations.stamps)
        known = np.all(np.abs(stamps[rows] - relations.stamps) <= tolerance_s, axis=1)
        ends = poses[rows]
    else:
        ends = interpolate(stamps, poses, relations.stamps)
        known = np.isfinite(ends).all(axis=(1, 2))
    require(known.any(), "no relation has both stamps in the trajectory; are the clocks the same?")
    error = se2.between(relations.motion[known], se2.between(ends[known, 0], ends[known, 1]))
    return RelationErrors(
        np.hypot(error[:, 0], error[:, 1]), np.abs(se2.wrap(error[:, 2])), np.flatnonzero(known)
    )
