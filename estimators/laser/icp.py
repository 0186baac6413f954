"""Registration of two laser scans in the plane: ICP from points to points, planes or lines.

The lines are those of `estimators.laser.scan_lines`, cut from the whole scan; a plane goes through
a point, along its neighbours. By default no share of the matches is trimmed, and gates narrow only
after the increment has settled, so the few points that hold the robot along a corridor still count.

Poses `T_target_source` take points of the source scan into the frame of the target scan.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from estimators.laser.icp_iterations import Fit, Pair, Sample, Settings, Stage, align
from estimators.laser.icp_judgement import count_both_ways, judge
from estimators.laser.icp_start import (
    Planes,
    as_segments,
    heading_by_lines,
    planes_of,
    representatives,
)
from estimators.laser.scan_lines import PreparedScan, prepare
from sim.arrays import Array, Ints
from sim.compiled import njit
from sim.errors import InputError, require
from sim.options import Count, NonNegative, options

__all__ = ["PreparedScan", "Registration", "Rules", "prepare", "register", "split_directions"]

Metric = Literal["point_to_line", "point_to_plane", "point_to_point"]
Plane = Literal["matched_point", "centroid"]
Kernel = Literal["tukey", "huber", "none"]

# Errors of the heading, rad, that the second and the third stage may find: they bound how far
# those look. For the first it is that of the guess.
_TURN_THEN, _TURN_LAST = 0.01, 0.002
_SEARCHED_RAD, _GUESSED_RAD = 0.08, 0.2  # after a search of the heading, and without
_REST_M, _REST_RAD = 1e-5, 1e-5  # iterations end when the increment falls below both
# Tuning constants, in standard deviations; without a kernel every match within the gate counts
_WIDTHS = {"tukey": 6.0, "huber": 1.345, "none": math.inf}
_AGREEMENT = 6.0  # range standard deviations from a line of the other scan
MIN_POINTS = 3  # of a scan that can be registered
MIN_OVERLAP = 0.6  # share of the source's points that must agree with the target
MIN_OVERLAP_OF_CURVES = 0.4  # of scans cut at jump edges: a turn takes a third out of view
MIN_AGREEMENT = 0.5  # the same of those, in both scans, that bear on any one direction
UNKNOWN_M, UNKNOWN_RAD = 10.0, math.pi  # standard deviations of an unconstrained direction
MIN_INFORMATION_RATIO = 4.0  # times the spurious information that the noise of the lines makes


@options("estimator")
class Rules:
    """Which matches count, and when iterations end."""

    trim: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Share of the matches, those farthest apart, that is left out of each iteration."""
    kernel: Kernel = "tukey"
    """How matches within the last gate weigh by their distance: `tukey` leaves out those beyond 6
    standard deviations, `huber` weakens those beyond 1.345, `none` counts all alike."""
    max_iterations: Count = 100
    """Most iterations of each of the stages, whose gates narrow from one to the next."""
    stop_error_m: NonNegative = 0.0
    """Root mean square of the distances at which the pose is good enough (decristoforis2020, sec.
    II-C), m; 0: iterations end when the pose rests."""
    neighbours: Annotated[int, Field(ge=2, le=100)] = 6
    """Points of a plane, with its own (point to plane only); the paper gives no number. With 10
    and more, corners bend the planes, and registrations of successive scans (721 beams, 1 cm,
    tuning seeds) jump by decimetres now and then."""
    plane: Plane = "matched_point"
    """What a plane goes through: the `matched_point` (Chen and Medioni; PCL, Open3D and
    libpointmatcher do the same), or the `centroid` of the neighbours, which in corners and at the
    ends of walls lies off it. Noisy scans of one pose (ten places, 1 cm) then register up to 218,
    360 or 570 urad and 0.8, 1.9 or 2.5 mm apart on average, with 6, 12 or 20 neighbours; by the
    matched point 13, 9 or 8 urad and 0.04, 0.07 or 0.06 mm."""


DEFAULT_RULES = Rules()


@dataclass(frozen=True)
class Registration:
    """A registration and all that is needed to judge it; K points of the source, in its order.

    Attributes
    ----------
    T_target_source
        (3,) m, m, rad: takes points of the source into the frame of the target.
    metric
        `point_to_line`, `point_to_plane` or `point_to_point`.
    status
        `ok`; `empty` (a scan shows too little); `poor_overlap` (too few points agree, in all
        or of those that speak about some direction); `degenerate` (some direction is not held
        by the scans); `not_converged`.
    matches
        (K,) the target's line or point that each point was matched with, -1 for none.
    residuals_m
        (K,) distance to the line or plane (signed), or to the point; NaN without a match.
    weights
        (K,) weight of each squared residual, 1/m^2; 0 for a point that does not count.
    iterations, converged
        Iterations in all, and whether the increment fell below its bound.
    normal_matrix
        (3, 3) sum of w J^T J of the metric's residuals by (x, y, heading).
    information, information_noise
        (3, 3) information about the pose from the target's lines, and the spurious part that the
        noise of their directions adds even where there is none (all walls parallel, a circle).
    planes
        Of point to plane: that of each point of the target.
    """

    T_target_source: Array
    metric: Metric
    status: str
    matches: Ints
    residuals_m: Array
    weights: Array
    iterations: int
    converged: bool
    normal_matrix: Array
    information: Array
    information_noise: Array
    planes: Planes | None = None

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """(K,) points that count."""
        return self.weights > 0.0

    @property
    def overlap(self) -> float:
        """Share of the source's points that agree with the target."""
        return float(np.mean(self.inliers)) if len(self.weights) else 0.0


@njit(error_model="numpy", fastmath={"contract"})
def _register(
    pair: Pair, pose: Array, window: float, settings: Settings, stages: tuple[Stage, ...]
) -> tuple[Fit, int, bool, Array, Array, Array, Array, Array]:
    """All of a registration, from `pose`, in place."""
    source, target, n = pair.source, pair.target, len(pair.source.points)
    fit = Fit(np.zeros(n, np.int64), np.zeros(n), np.zeros(n))
    if window > 0.0:
        pose[2] = heading_by_lines(source, target, pose[2], window)
    guess = pose.copy()
    few, every = representatives(source), Sample(np.arange(n), np.ones(n))
    iterations, converged = 0, False
    for stage in stages:
        sample = few if pair.whole_lines and stage.coarse else every
        done, converged = align(pair, settings, stage, sample, guess, pose, fit)
        iterations += done
    normal, information, spurious = judge(pair, pose, fit)
    for matrix in (normal, information, spurious):
        matrix[0, 1], matrix[0, 2], matrix[1, 2] = matrix[1, 0], matrix[2, 0], matrix[2, 1]
    agreed, denied = count_both_ways(source, target, pose, _AGREEMENT * pair.noise_m)
    return fit, iterations, converged, normal, information, spurious, agreed, denied


def register(
    source: PreparedScan,
    target: PreparedScan,
    initial: ArrayLike | None = None,
    *,
    metric: Metric = "point_to_line",
    gate_m: float = 2.0,
    gate_rad: float | None = None,
    heading_window_rad: float | None = None,
    rules: Rules = DEFAULT_RULES,
) -> Registration:
    """Find the pose of the source scan in the frame of the target scan.

    Point to line minimises sum w (n.(R p + t) - d)^2 over the lines of the target (Chen and
    Medioni); w is one over the variance that the range noise has along the normal, so beams
    that graze a wall, which feel its distance most finely, count most. Point to plane minimises
    the same over the planes through the nearest points, each with the normal of its nearest
    neighbours and one variance for all (decristoforis2020, sec. II-C). Point to point minimises
    sum w |R p + t - q|^2 over the nearest points (Besl and McKay). The last two have the same
    points, stages and end of iterations.

    Parameters
    ----------
    initial
        (3,) first guess of T_target_source; none is needed up to some decimetres and degrees.
    gate_m, gate_rad
        Errors that the guess may have, as four standard deviations. The first is also the widest
        distance of a match to begin with; both say how far the first stage may look, and hold
        the pose to the guess where that shows nothing. By default 2 m and 0.2 rad, or 0.08 rad
        after a search of the heading.
    heading_window_rad
        Half the range of headings searched for agreement of the scans' lines before the first
        iteration; by default 30 degrees without an initial guess, and 0 (no search) with one.
    rules
        Which matches count, and when iterations end.
    """
    pose = np.zeros(3) if initial is None else np.array(initial, dtype=np.float64)
    if pose.shape != (3,) or not np.all(np.isfinite(pose)):
        raise InputError(
            f"an initial guess is three finite numbers (x, y, heading), got {initial!r}"
        )
    known = get_args(Metric)
    require(metric in known, f"metric must be one of {', '.join(known)}, got {metric!r}")
    whole_lines = metric == "point_to_line"
    too_few = min(len(source.points), len(target.points)) < MIN_POINTS
    if too_few or (whole_lines and len(target.lines) == 0):
        n, zero = len(source.points), np.zeros((3, 3))
        return Registration(
            pose, metric, "empty", np.full(n, -1), np.full(n, math.nan), np.zeros(n), 0, False,
            zero, zero, zero,
        )  # fmt: skip
    usual_window = math.pi / 6.0 if initial is None else 0.0
    window = usual_window if heading_window_rad is None else heading_window_rad
    if gate_rad is None:
        gate_rad = _SEARCHED_RAD if window > 0.0 else _GUESSED_RAD
    settings = Settings(
        rules.max_iterations, rules.trim, rules.stop_error_m, _REST_M, _REST_RAD,
        gate_m / 4.0, gate_rad / 4.0, np.zeros((3, 3)),
    )  # fmt: skip
    width, huber = _WIDTHS[rules.kernel], rules.kernel == "huber"
    reach_m, middle_m = 4.0 * gate_m / gate_rad, 0.5 / _TURN_THEN
    # each is coarse or not, with its kernel, gate, width, reach and slack
    if whole_lines:
        stages: tuple[Stage, ...] = (
            Stage(True, False, gate_m, 0.3, reach_m, 200.0),
            Stage(True, False, min(gate_m, 0.5), 0.1, middle_m, 200.0),
            Stage(False, huber, min(gate_m, 0.3), 3.0 * width, 0.3 / _TURN_LAST, 200.0),
            Stage(False, huber, min(gate_m, 0.3), width, math.inf, 1.0),
        )
    else:
        stages = (
            Stage(True, False, gate_m, 0.5, reach_m, 10.0),
            Stage(True, False, min(gate_m, 0.5), 0.2, middle_m, 10.0),
            Stage(False, huber, min(gate_m, 0.2), width, math.inf, 10.0),
        )
    surface = target.segments if whole_lines else as_segments(target)
    planes, of_points = surface, None
    if metric == "point_to_plane":
        of_points = planes_of(
            target.points, rules.neighbours, through_centroid=rules.plane == "centroid"
        )
        planes = surface._replace(normals=of_points.normals, distances_m=of_points.distances_m)
    pair = Pair(
        source, target, whole_lines, metric != "point_to_point", surface, planes,
        max(source.noise_m, target.noise_m),
    )  # fmt: skip
    guess = pose.copy()
    found = _judged(pair, metric, pose, window, settings, stages, of_points)
    if found.status == "degenerate" and source.curves:
        # it has wandered along what nothing holds, on a way that bends: hold it there
        settings = settings._replace(pinned=_pinned(found))
        found = _judged(pair, metric, guess, window, settings, stages, of_points)
    return found


def _judged(
    pair: Pair,
    metric: Metric,
    pose: Array,
    window: float,
    settings: Settings,
    stages: tuple[Stage, ...],
    planes: Planes | None,
) -> Registration:
    """Register from `pose`, in place, and judge what comes of it."""
    fit, iterations, converged, normal, information, spurious, agreed, denied = _register(
        pair, pose, window, settings, stages
    )
    pose[2] = math.remainder(pose[2], 2.0 * math.pi)
    status = "ok"
    min_overlap = MIN_OVERLAP_OF_CURVES if pair.source.curves else MIN_OVERLAP
    if np.count_nonzero(fit.weights) < min_overlap * len(fit.weights):
        status = "poor_overlap"
    elif not _positive_definite(information - MIN_INFORMATION_RATIO * spurious):
        status = "degenerate"
    elif not _positive_definite((1.0 - MIN_AGREEMENT) * agreed - MIN_AGREEMENT * denied):
        status = "poor_overlap"
    elif not converged:
        status = "not_converged"
    return Registration(
        pose, metric, status, fit.matches, fit.residuals, fit.weights, iterations, converged,
        normal, information, spurious, planes,
    )  # fmt: skip


def better_by(
    source: PreparedScan, target: PreparedScan, pose: ArrayLike, other: ArrayLike, noise_m: float
) -> float:
    """How many points more bear out one pose of the source than another.

    A point of either scan counts as far as its line lies across the way between the poses: for a
    pose if it is on a line of the other scan, against it if it stands before what that one saw.
    """
    at, instead = np.array(pose, float), np.array(other, float)
    way = at - instead
    way[2] = math.remainder(way[2], 2.0 * math.pi)
    way /= max(math.hypot(way[0], way[1]), abs(way[2]), 1e-9)
    gain = 0.0
    for each, sign in ((at, 1.0), (instead, -1.0)):
        agreed, denied = count_both_ways(source, target, each, _AGREEMENT * noise_m)
        borne_out = np.tril(agreed - denied)
        gain += sign * float(way @ (borne_out + np.tril(borne_out, -1).T) @ way)
    return gain


def split_directions(registration: Registration) -> tuple[Array, Array]:
    """Directions of the pose that the scans hold (3, 3 - D), and do not hold (3, D), D = 0 to 3.

    Not held are those in which the information of the target's lines is less than 4 times the
    spurious part that the noise of their directions adds. A column has length one in units of
    `UNKNOWN_M` and `UNKNOWN_RAD`; all are orthogonal in the information.
    """
    unit = np.array([UNKNOWN_M, UNKNOWN_M, UNKNOWN_RAD])
    information = registration.information * np.outer(unit, unit)
    spurious = registration.information_noise * np.outer(unit, unit)
    least = (1e-12 * np.trace(information) + 1e-300) * np.eye(3)
    root = np.linalg.inv(np.linalg.cholesky(information + least))
    share, basis = np.linalg.eigh(root @ (spurious + least) @ root.T)
    directions = root.T @ basis
    directions /= np.linalg.norm(directions, axis=0)
    loose = share > 1.0 / MIN_INFORMATION_RATIO
    return unit[:, None] * directions[:, ~loose], unit[:, None] * directions[:, loose]


def _pinned(found: Registration) -> Array:
    """Directions that the scans do not hold, as `Settings.pinned`."""
    held, loose = split_directions(found)
    rows = UNKNOWN_M * np.linalg.inv(np.hstack([held, loose]))[held.shape[1] :]
    return np.asarray(rows.T @ rows)


def _positive_definite(matrix: Array) -> bool:
    (a, _, _), (b, d, _), (c, e, f) = matrix.tolist()  # of some only the lower half is filled
    minor = a * d - b * b
    return bool(a > 0.0 < minor and minor * f - a * e * e - d * c * c + 2.0 * b * c * e > 0.0)
