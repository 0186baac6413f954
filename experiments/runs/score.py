"""Rows of trajectories that other programs made of a recording."""

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from estimators.base import Estimate
from experiments.evaluation.metrics import (
    LONGEST_GAP_S,
    RPE_DISTANCES_M,
    alignment,
    describe_pause,
    heading_errors_rad,
    longest_pause_s,
    pairs_by_distance,
    path_scores,
    position_errors_m,
    relative_errors,
    rms,
)
from experiments.evaluation.relations import relation_scores
from experiments.evaluation.time_sync import Rows, nearest_rows
from experiments.runs.columns import OF_THE_RUN, REVISED
from experiments.runs.paths import rows_folder
from experiments.runs.row import GAP, Outcome, Row, Status
from experiments.runs.store import write_run
from experiments.runs.version import code_version
from experiments.trajectories.read import read_trajectory
from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.files import sha256_of
from sim.formats.detect import read_any
from sim.formats.relations import read_relations
from sim.options import NonNegative, options
from sim.recording import Recording

_FEWEST_POSES = 3  # of fewer, figures say nothing, and stamps of another unit may meet by chance


@options("")
class Scoring:
    """How a trajectory is scored."""

    align: Literal["none", "start", "se2"] = "none"
    """How it is moved before: its first scored pose onto the true one, or by least squares of the
    positions, without scale."""
    match: Literal["interpolated", "nearest"] = "interpolated"
    """Which true pose belongs to a stamp; `nearest` as evo associates: the shorter trajectory's
    stamps with the other's."""
    tolerance_s: NonNegative = 0.01
    """Greatest difference of stamps that match, of `nearest`."""
    truth_gap_s: NonNegative = LONGEST_GAP_S
    """Longest gap of the truth in which `interpolated` takes a true pose."""
    offset_s: float = 0.0
    """Added to the trajectory's stamps."""
    revised: bool = False
    """Whether it is a revised path, not an online one."""
    cpu_seconds: NonNegative | None = None
    """Processor time of the whole run, if it is known."""


@dataclass(frozen=True)
class ScoredTrajectory:
    """A trajectory beside the truth.

    Attributes
    ----------
    estimate, truth
        The poses that are scored, moved and with the recording's clock, and the true ones (N, 3).
    moved_by
        (3,) T_map_trajectory that moved it, m, m, rad.
    n_given
        Poses of the trajectory.
    n_left_out
        Those that meet no true pose.
    longest_gap_s
        Longest time without a pose, between the recording's first Frame and its last.
    """

    estimate: Estimate
    truth: Array
    moved_by: Array
    n_given: int
    n_left_out: int
    longest_gap_s: float


def match_and_align(recording: Recording, given: Estimate, how: Scoring) -> ScoredTrajectory:
    """Match a trajectory with the truth, and move it.

    Raises
    ------
    InputError
        If the recording has no truth, or fewer than three poses meet it.
    """
    require(
        recording.truth is not None,
        "this recording has no truth to score against; give it one with `estima convert`, or "
        "relations",
    )
    stamps = given.stamps + how.offset_s
    rows: Rows
    if how.match == "nearest":
        rows, true_rows = _associated(stamps, recording.known_truth.stamps, how.tolerance_s)
        truth = recording.known_truth.poses[true_rows]
    else:
        known = recording.truth_at(stamps, how.truth_gap_s)
        rows = np.flatnonzero(np.isfinite(known).all(axis=1))
        truth = known[rows]
    start, end = recording.frame_stamps[[0, -1]]
    true_start, true_end = recording.known_truth.stamps[[0, -1]]
    require(
        len(rows) >= _FEWEST_POSES,
        f"{len(np.unique(rows))} of {len(stamps)} poses meet the truth, at least {_FEWEST_POSES} "
        f"must: the trajectory is from {stamps[0]:.13g} to {stamps[-1]:.13g} s, the truth from "
        f"{true_start:.13g} to {true_end:.13g} s; write stamps in seconds, set an offset, or raise "
        f"the gap of the truth that is bridged, {how.truth_gap_s:g} s",
    )
    means, covariances = given.means[rows], given.covariances[rows]
    T = np.zeros(3)
    if how.align != "none":
        to_start = se2.compose(truth[0], se2.inverse(means[0]))
        T = to_start if how.align == "start" else alignment(truth, means)
    cos, sin = math.cos(T[2]), math.sin(T[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    poses, covariances = se2.compose(T, means), turn @ covariances @ turn.T
    moved = Estimate(stamps[rows], poses, covariances, left_out=given.left_out)
    pause_s = longest_pause_s(stamps[rows], start, end)
    return ScoredTrajectory(
        moved, truth, T, len(stamps), len(stamps) - len(np.unique(rows)), pause_s
    )


def _associated(stamps: Array, true_stamps: Array, tolerance_s: float) -> tuple[Rows, Rows]:
    """Rows of both that belong together, as evo finds them: nearest stamps of the shorter one."""
    longer = len(stamps) > len(true_stamps)  # of equally many, those of the trajectory are sought
    short, long = (true_stamps, stamps) if longer else (stamps, true_stamps)
    rows = nearest_rows(long, short)
    near = np.abs(long[rows] - short) <= tolerance_s
    pair: tuple[Rows, Rows] = np.flatnonzero(near), rows[near]
    return (pair[1], pair[0]) if longer else pair


def statistics(errors: Array) -> dict[str, float]:
    """What evo says of errors: rmse, mean, median, std, min, max, sse."""
    size = np.abs(errors)
    found = {name: getattr(np, name)(size) for name in ("mean", "median", "std", "min", "max")}
    found = {"rmse": rms(size), **found, "sse": np.sum(np.square(size))}
    return {name: float(value) for name, value in found.items()}


def error_table(scored: ScoredTrajectory) -> dict[str, dict[str, float]]:
    """Statistics of each error; those over a distance only where the truth is that long."""
    truth, means = scored.truth, scored.estimate.means
    found = {
        "position error, m": statistics(position_errors_m(truth, means)),
        "heading error, rad": statistics(heading_errors_rad(truth, means)),
    }
    for distance in RPE_DISTANCES_M:
        pairs = pairs_by_distance(truth, distance)
        if len(pairs):
            errors = relative_errors(truth, means, pairs)
            lengths = np.hypot(errors[:, 0], errors[:, 1])
            found[f"position over {distance:g} m, m"] = statistics(lengths)
            found[f"heading over {distance:g} m, rad"] = statistics(errors[:, 2])
    return found


def row_of(
    recording: Recording,
    given: Estimate,
    scored: ScoredTrajectory | None,
    how: Scoring,
    *,
    files: tuple[Path, Path],
    estimator: str,
    name: str,
) -> Row:
    """Return the row of a trajectory, as a run over the recording from its file has one.

    Parameters
    ----------
    given, scored
        The trajectory, and beside the truth; None of a recording without one.
    files
        Of the recording and of the trajectory.
    estimator, name
        What made the trajectory, and the folder of the row.
    """
    settings = {f"trajectory.{key}": value for key, value in dataclasses.asdict(how).items()}
    del settings["trajectory.cpu_seconds"]
    checksum = recording.checksum
    origin = json.dumps([checksum, _digests_of(files[1]), settings, estimator])
    stamps = given.stamps + how.offset_s if scored is None else scored.estimate.stamps
    status, seed = Status(), recording.config.get("seed")
    if pause := describe_pause(recording, stamps):
        status = Status(Outcome.REMARK, GAP, pause)
    elif given.left_out:
        status = Status(Outcome.REMARK, "planar", given.left_out)
    row: Row = {
        "choice.estimator": estimator,
        "seed": seed if type(seed) is int else 0,
        "repeats": 1,
        "recording": str(files[0]),
        "name": name,
        "trajectory.file": str(files[1]),
        **settings,
        "repeat": 0,
        "run_key": hashlib.sha256(origin.encode()).hexdigest()[:16],
        "code_version": code_version(),
        "recording_checksum": checksum,
        **status.columns(),
        "duration_s": float(np.ptp(stamps)),
    }
    if how.cpu_seconds is not None:
        row["cpu_time_us"] = 1e6 * how.cpu_seconds / len(given.stamps)
    if scored is None:
        return row
    row |= {
        "stamps_scored": float(len(scored.truth)),
        "stamps_left_out": float(scored.n_left_out),
        "longest_gap_s": scored.longest_gap_s,
    }
    scores = path_scores(scored.truth, scored.estimate.means, scored.estimate.covariances)
    return row | {f"{_prefix(how, key)}{key}": value for key, value in scores.items()}


def _prefix(how: Scoring, key: str) -> str:
    return REVISED if how.revised and key not in OF_THE_RUN else ""


def score_files(
    path: Path,
    trajectories: Sequence[Path],
    how: Scoring,
    *,
    topic: str | None = None,
    estimator: str | None = None,
    name: str = "score",
    relations: Path | None = None,
) -> list[tuple[Path, Row, ScoredTrajectory | None]]:
    """Score trajectories of a recording's file, and write their rows to results/runs/NAME.

    Parameters
    ----------
    topic
        Of trajectories in bags.
    estimator
        What made the trajectory; None: each is called by its file.
    relations
        File of true relations between poses, to score by too; a recording without a truth has
        them alone.
    """
    folder = rows_folder(name)
    alone = len(trajectories) == 1 or (estimator is None and how.cpu_seconds is None)
    require(alone, "a name and a processor time belong to one trajectory; score them one by one")
    names = [estimator or trajectory.stem for trajectory in trajectories]
    require(
        len(set(names)) == len(names),
        f"two trajectories called {max(names, key=names.count)}; score and name them one by one",
    )
    recording, results = read_any([path]), []
    judged = None if relations is None else read_relations(relations)
    for trajectory, called in zip(trajectories, names, strict=True):
        given = read_trajectory(trajectory, topic)
        try:
            alone = recording.truth is None and judged is not None
            scored = None if alone else match_and_align(recording, given, how)
            files = (path, trajectory)
            row = row_of(recording, given, scored, how, files=files, estimator=called, name=name)
            if judged is not None:
                stamps = given.stamps + how.offset_s
                found = relation_scores(recording, judged, stamps, given.means)
                row |= {f"{_prefix(how, key)}{key}": value for key, value in found.items()}
        except InputError as error:
            raise InputError(f"{trajectory}: {error}") from error
        results.append((trajectory, row, scored))
    for _, row, _ in results:
        write_run([row], folder)
    return results


def as_text(row: Row, scored: ScoredTrajectory | None, how: Scoring) -> str:
    """Say what was scored, and the statistics of its errors."""
    by_relations = []
    if "n_relations" in row:
        metres, angle = (
            row[f"{_prefix(how, key)}{key}"]
            for key in ("relation_translation_m", "relation_rotation_rad")
        )
        said = f"  {row['n_relations']:.0f} relations: {metres:.6g} m, {angle:.6g} rad in the mean"
        by_relations.append(said)
    if scored is None:
        return "\n".join(by_relations)
    errors = error_table(scored)
    heads = list(next(iter(errors.values())))
    lines = [f"  {'':<24}" + "".join(f"{head:>13}" for head in heads)]
    for error, values in errors.items():
        lines.append(f"  {error:<24}" + "".join(f"{values[head]:>13.6g}" for head in heads))
    return "\n".join([describe_scoring(scored, how), *lines, *by_relations])


def describe_scoring(scored: ScoredTrajectory, how: Scoring) -> str:
    """Say what was scored: stamps, gaps, alignment."""
    stamps = scored.estimate.stamps
    matching = (
        f"the truth is interpolated at their stamps, over at most {how.truth_gap_s:g} s"
        if how.match == "interpolated"
        else f"each with the nearest true stamp within {how.tolerance_s:g} s"
    )
    x, y, heading = scored.moved_by
    moved = {
        "none": "not aligned",
        "start": "aligned at the first scored pose",
        "se2": "aligned by SE(2), least squares",
    }[how.align]
    if how.align != "none":
        moved += f": moved by ({x:.6g} m, {y:.6g} m, {heading:.6g} rad)"
    offset = f", {how.offset_s:+g} s on the stamps" if how.offset_s else ""
    n_again = len(scored.truth) + scored.n_left_out - scored.n_given
    again = f" ({n_again} of them again, with another true stamp)" if n_again else ""
    remark = f"\n  {scored.estimate.left_out}" if scored.estimate.left_out else ""
    return (
        f"  {scored.n_given} poses, {len(scored.truth)} scored{again} from {stamps[0]:.13g} to "
        f"{stamps[-1]:.13g} s, {scored.n_left_out} left out; {matching}{offset}\n"
        f"  longest time without a pose: {scored.longest_gap_s:.3g} s\n"
        f"  {'revised' if how.revised else 'online'} path, {moved}{remark}"
    )


def _digests_of(path: Path) -> list[str]:
    """Digests of a file, or of the files in a folder."""
    files = path.glob("*") if path.is_dir() else [path]
    return sorted(sha256_of(file) for file in files if file.is_file())
