"""Scores of an Estimate against the truth.

Poses are (T, 3) m, m, rad at the same stamps. Squares are pooled before the root is taken.
"""

import math

import numpy as np
from numpy.typing import NDArray

from estimators.base import Estimate
from sim import se2
from sim.arrays import Array
from sim.errors import require
from sim.recording import Recording

_CHI2_3DOF = {50: 2.365973884375338, 90: 6.251388631170325, 95: 7.814727903251179}  # quantiles
CHI2_95_2DOF = 5.991464547107979  # 95 % quantile of chi-square with two degrees of freedom
_SINGULAR = 1e-10  # least eigenvalue of a correlation matrix that can be trusted
RPE_DISTANCES_M = (1.0, 10.0)
_REMARKED_PAUSE_S = 1.0  # without a pose
_SPARSE = 5.0  # times the longest step of the recording: a path that chooses its poses
LONGEST_GAP_S = 0.25  # of the truth, over which it is interpolated
# Belief extras that `score` reads, of estimators that have them
SCORED_EXTRAS = ("dispersion_m", "registration_status", "associations")
_USED = ("first", "ok", "degenerate")  # registration statuses
_AGAIN = -2  # of associations: the landmark had just counted


def unused_share(estimate: Estimate) -> float | None:
    """Share of the scans that were not registered or gated, and of the sightings rejected.

    None for a method that does not say.
    """
    extras = estimate.extras
    scans = [s for s in extras.get("registration_status", ()) if s is not None]
    images = [np.asarray(a) for a in extras.get("associations", ()) if a is not None]
    used = np.array([status in _USED for status in scans], bool)
    if not scans and images:
        seen = np.concatenate(images)
        used = seen[seen != _AGAIN] >= 0
    return 1.0 - float(used.mean()) if len(used) else None


def longest_pause_s(stamps: Array, start: float, end: float) -> float:
    """Longest time from start to end without a stamp, s; the stamps increase."""
    inside = stamps[(stamps > start) & (stamps < end)]
    return float(np.diff([start, *inside, end]).max(initial=0.0))


def describe_pause(recording: Recording, stamps: Array) -> str:
    """Say what a path leaves out, if it is much: whoever chooses its poses chooses what is scored.

    It counts what can be scored: the time between the first and the last Frame with a truth.
    """
    frames = recording.frame_stamps
    start, end, own_s = frames[0], frames[-1], float(np.diff(frames).max(initial=0.0))
    if recording.truth is not None:
        known = recording.truth.stamps
        start, end = max(start, known[0]), min(end, known[-1])
        own_s = max(own_s, float(np.diff(known).max(initial=0.0)))
    pause_s = longest_pause_s(stamps, start, end)
    usual_s = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    if pause_s > max(_REMARKED_PAUSE_S, own_s):
        return f"no pose for {pause_s:.3g} s of the recording"
    if usual_s > _SPARSE * own_s:
        return f"a pose every {usual_s:.3g} s, where the recording allows one every {own_s:.3g} s"
    return ""


def position_errors_m(truth: Array, means: Array) -> Array:
    """Distances (T,) between true and estimated positions, m."""
    return np.asarray(np.hypot(*(means[:, :2] - truth[:, :2]).T))


def heading_errors_rad(truth: Array, means: Array) -> Array:
    """Wrapped heading errors (T,), rad."""
    return se2.wrap(means[:, 2] - truth[:, 2])


def rms(errors: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else math.nan


def alignment(truth: Array, means: Array) -> Array:
    """Pose (3,) that brings the estimated positions closest to the true ones: SE(2), no scale.

    It minimises the sum of squared distances (Kabsch in the plane). The rotation is zero if the
    positions have no spread.
    """
    centre_truth, centre_means = truth[:, :2].mean(axis=0), means[:, :2].mean(axis=0)
    a, b = means[:, :2] - centre_means, truth[:, :2] - centre_truth
    angle = math.atan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    rotated = se2.transform(np.array([0.0, 0.0, angle]), centre_means[None])[0]
    return np.array([*(centre_truth - rotated), angle])


def align(truth: Array, means: Array) -> Array:
    """Estimated poses (T, 3) after `alignment`."""
    return se2.compose(alignment(truth, means), means)


def pairs_by_distance(truth: Array, distance_m: float) -> NDArray[np.int64]:
    """Pairs (P, 2) of rows between which the truth travelled at least the distance.

    Consecutive, without overlap, the first one from the start, as in evo.
    """
    steps = np.hypot(*np.diff(truth[:, :2], axis=0).T)
    rows, travelled = [0], 0.0
    for i, step in enumerate(steps):
        travelled += float(step)
        if travelled >= distance_m:
            rows.append(i + 1)
            travelled = 0.0
    return np.array([rows[:-1], rows[1:]], dtype=np.int64).T.reshape(-1, 2)


def relative_errors(truth: Array, means: Array, pairs: NDArray[np.int64]) -> Array:
    """Errors (P, 3) of the motion between paired rows: true motion to estimated motion."""
    first, second = pairs.T
    true_motion = se2.between(truth[first], truth[second])
    return se2.between(true_motion, se2.between(means[first], means[second]))


def nees(truth: Array, means: Array, covariances: Array) -> Array:
    """Normalised estimation error squared (T,); NaN where the covariance is singular.

    Its mean is 3 for a consistent filter. A singular covariance, such as the zero one of a known
    start, predicts no error, so its stamp is left out, as is one that is not finite.
    """
    error = se2.difference(means, truth)
    sigma = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    finite = np.isfinite(error).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    usable = finite & np.all(sigma > 0.0, axis=1)
    values, scale = np.full(len(error), np.nan), sigma[usable]
    correlation = covariances[usable] / (scale[:, :, None] * scale[:, None, :])
    eigenvalues, vectors = np.linalg.eigh((correlation + correlation.transpose(0, 2, 1)) / 2)
    projected = np.einsum("tij,ti->tj", vectors, error[usable] / scale)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.sum(projected**2 / eigenvalues, axis=1)
    values[usable] = np.where(eigenvalues[:, 0] > _SINGULAR, squares, np.nan)
    return values


def ellipse_area_m2(covariances: Array) -> Array:
    """Areas (T,) of the 95 % position ellipses, m^2: pi chi2 sqrt(det)."""
    block = covariances[:, :2, :2]
    with np.errstate(over="ignore", invalid="ignore"):  # of one that diverged
        determinant = block[:, 0, 0] * block[:, 1, 1] - block[:, 0, 1] * block[:, 1, 0]
    return np.asarray(math.pi * CHI2_95_2DOF * np.sqrt(np.maximum(determinant, 0.0)))


def in_ellipse(truth: Array, mean: Array, covariance: Array) -> bool:
    """Whether a true position lies in the 95 % ellipse of a pose's (3,) covariance (3, 3).

    puzzlebot2024 asks it of the real robot and the ideal one's ellipse. That of a singular
    covariance, as of identical particles, is a line or a point, and contains nothing.
    """
    off, block = truth[:2] - mean[:2], covariance[:2, :2]
    if np.linalg.matrix_rank(block, hermitian=True) < 2:
        return False
    return bool(off @ np.linalg.solve(block, off) <= CHI2_95_2DOF)


def travelled_m(path: Array) -> Array:
    """Distance (T,) travelled along a path (T, 2) or poses (T, 3) to each of its rows, m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])


def at_distances(truth: Array, distances_m: Array) -> NDArray[np.int64]:
    """First row at which the truth has travelled each distance; -1 where it never has."""
    rows = np.searchsorted(travelled_m(truth), distances_m)
    return np.where(rows < len(truth), rows, -1)


def nees_at_distances(truth: Array, means: Array, covariances: Array, distances_m: Array) -> Array:
    """NEES (D,) where the truth has first travelled each distance; NaN where it never does."""
    rows = at_distances(truth, distances_m)
    return np.where(rows >= 0, nees(truth, means, covariances)[rows], np.nan)


def score(
    recording: Recording,
    estimate: Estimate,
    longest_gap_s: float = LONGEST_GAP_S,
    after_s: float = 0.0,
) -> dict[str, float]:
    """Score an estimate against its recording's truth; units are in the keys.

    Stamps outside the truth's span are left out, and so are those in a gap of the truth longer than
    `longest_gap_s`: they have no true pose. Those of the first `after_s` of the recording do not
    count either: something may have been calibrated on them. `stamps_scored` and `stamps_left_out`
    count both kinds. A score that does not apply has no key: all but the times without a truth, the
    error over 10 m of a shorter run, the NEES without a usable covariance. NaN means that the
    estimate itself is not finite.

    Raises
    ------
    InputError
        If no stamp of the estimate has a true pose.
    """
    row = {"duration_s": float(np.ptp(estimate.stamps)) if len(estimate.stamps) else 0.0}
    if len(estimate.step_seconds):
        row["step_time_us"] = float(1e6 * np.median(estimate.step_seconds))
    if estimate.cpu_seconds is not None:
        row["cpu_time_us"] = 1e6 * estimate.cpu_seconds / max(len(estimate.stamps), 1)
    dispersions = [v for v in estimate.extras.get("dispersion_m", ()) if v is not None]
    if dispersions:
        row["dispersion_final_m"] = float(dispersions[-1])
    if (unused := unused_share(estimate)) is not None:
        row["unused_share"] = unused
    if recording.truth is None:
        return row
    truth = recording.truth_at(estimate.stamps, longest_gap_s)
    late = estimate.stamps >= recording.frame_stamps[0] + after_s
    require(late.any(), f"scoring.after_s={after_s:g} is beyond the end of the recording")
    known = np.isfinite(truth).all(axis=1) & late
    require(
        known.any() or np.isfinite(recording.truth_at(estimate.stamps)).any(),
        "no estimate lies within the truth's time span; are the clocks the same?",
    )
    require(
        known.any(),
        f"no estimate lies within {longest_gap_s:g} s between two true poses; raise "
        "scoring.longest_gap_s",
    )
    row |= {"stamps_scored": float(known.sum()), "stamps_left_out": float((~known).sum())}
    covariances = estimate.covariances[known]
    return row | path_scores(truth[known], estimate.means[known], covariances)


def path_scores(truth: Array, means: Array, covariances: Array) -> dict[str, float]:
    """Scores of poses (T, 3) and covariances (T, 3, 3) against the true poses at their stamps.

    Covariances that are all zeros are unknown: their scores are left out.
    """
    fitted, off = align(truth, means), position_errors_m(truth, means)
    values = nees(truth, means, covariances)
    counted = np.isfinite(values)
    row = {
        "distance_m": float(np.sum(np.hypot(*np.diff(truth[:, :2], axis=0).T))),
        "ate_rmse_m": rms(off),
        "ate_mean_m": float(np.mean(off)),
        "ate_aligned_rmse_m": rms(position_errors_m(truth, fitted)),
        "heading_rmse_rad": rms(heading_errors_rad(truth, means)),
        "heading_aligned_rmse_rad": rms(heading_errors_rad(truth, fitted)),
        "final_position_error_m": float(off[-1]),
        "final_heading_error_rad": float(abs(heading_errors_rad(truth[-1:], means[-1:])[0])),
    }
    if covariances.any():
        row["nees_counted_share"] = float(np.mean(counted))
        row["ellipse_area_final_m2"] = float(ellipse_area_m2(covariances[-1:])[0])
    if counted.any():
        row["nees_mean"] = float(np.mean(values[counted]))
        row["nees_median"] = float(np.median(values[counted]))
        row |= {
            f"inside_{percent}_share": float(np.mean(values[counted] <= most))
            for percent, most in _CHI2_3DOF.items()
        }
        variances = np.diagonal(covariances[counted], axis1=1, axis2=2)
        row["sharpness_m"] = rms(np.sqrt(variances[:, 0] + variances[:, 1]))
    if row.get("ellipse_area_final_m2", 0.0) > 0.0:
        row["final_in_ellipse"] = float(in_ellipse(truth[-1], means[-1], covariances[-1]))
    for distance in RPE_DISTANCES_M:
        pairs = pairs_by_distance(truth, distance)
        if len(pairs):
            errors = relative_errors(truth, means, pairs)
            row[f"rpe_{distance:g}m_rmse_m"] = rms(np.hypot(errors[:, 0], errors[:, 1]))
            row[f"rpe_{distance:g}m_heading_rmse_rad"] = rms(errors[:, 2])
    return row
