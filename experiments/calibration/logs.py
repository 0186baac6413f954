"""Wheel geometry, kr and kl from real logs, where the only reference is another sensor.

`calibrate_wheels` finds diameters, axle and the laser's pose from wheel angles and scan matches
(the problem of Censi et al., "Simultaneous calibration of odometry and sensor parameters"), and
`slip_of_turns` finds kr and kl. `calibrate_track` finds the length of a tick and the effective
track from ticks and an overhead camera that sees no heading.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from experiments.evaluation.statistics import Interval
from sim import se2
from sim.arrays import Array
from sim.errors import require
from sim.formats.assemble import chain_motions
from sim.formats.khepera import WheelLaserLog
from sim.formats.lego import GEOMETRIC_TRACK_M, SCANNER_AHEAD_M, TICK_M, TickLog
from sim.robot.arc import arc_increment

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class WheelCalibration:
    """Diameters, axle and the laser's pose, with 95 % intervals, and the residuals.

    Attributes
    ----------
    diameter_right_m, diameter_left_m, axle_m, laser_x_m, laser_y_m, laser_yaw_rad
        The six parameters.
    kept
        (N,) intervals whose scan match is trusted.
    travel_m
        (N, 2) calibrated wheel travel.
    turn_residual_rad
        (N,) turn by the laser less turn by the wheels.
    """

    diameter_right_m: Interval
    diameter_left_m: Interval
    axle_m: Interval
    laser_x_m: Interval
    laser_y_m: Interval
    laser_yaw_rad: Interval
    kept: Mask
    travel_m: Array
    turn_residual_rad: Array

    @property
    def values(self) -> Array:
        """The six parameters, (6,)."""
        return np.array([part.value for part in vars(self).values() if isinstance(part, Interval)])


def calibrate_wheels(
    log: WheelLaserLog, diameter_m: float = 0.04, axle_m: float = 0.1
) -> WheelCalibration:
    """Fit the six parameters to the laser's displacements by trimmed least squares.

    Residuals are weighted by their own spread (median absolute deviation), failed scan matches,
    beyond six times that, are left out, and the fit is repeated. The laser's yaw may be anything:
    eight yaws are tried to start from.

    Parameters
    ----------
    diameter_m, axle_m
        Rough sizes to start from.

    Raises
    ------
    InputError
        If there are too few intervals, or the robot never turned.
    """
    require(
        len(log.durations_s) >= 12 and np.any(log.laser_motion[:, 2]),
        "at least 12 intervals with turns are needed to calibrate the wheels",
    )
    weights = 1.0 / np.array([diameter_m / 20.0, diameter_m / 20.0, 0.05])
    sizes = diameter_m, diameter_m, axle_m
    scale = np.array([*sizes, 0.1, 0.1, 1.0])
    some = np.zeros(len(log.durations_s), bool)
    some[:: max(1, len(some) // 400)] = True  # enough to choose the start
    yaws = np.arange(8) * math.pi / 4.0 - math.pi
    fits = [_fit(log, np.array([*sizes, 0.0, 0.0, yaw]), weights, some, scale) for yaw in yaws]
    fits = [fit for fit in fits if fit.x[:3].min() > 0.0]
    require(fits, "wheels and laser do not agree; are right and left swapped?")
    fit = min(fits, key=lambda found: float(found.cost))
    for _ in range(5):
        residual = _residual(log, fit.x)
        spread = 1.4826 * np.median(np.abs(residual), axis=0) + 1e-9
        kept = np.sqrt(np.sum((residual / spread) ** 2, axis=1)) < 6.0
        fit = _fit(log, fit.x, 1.0 / spread, kept, scale)
    values = np.append(fit.x[:5], se2.wrap(fit.x[5]))
    right, left, axle, x, y, yaw = fit_intervals(values, fit)
    travel, turns = log.rolled_rad * values[:2] / 2.0, _residual(log, values)[:, 2]
    return WheelCalibration(right, left, axle, x, y, yaw, kept, travel, turns)


def fit_intervals(
    values: Array,
    fit: optimize.OptimizeResult,
    alike: float = 1.0,
    unit: Array | float = 1.0,
    z: float = float(stats.norm.ppf(0.975)),
) -> list[Interval]:
    """Parameters (P,) of a least-squares fit with 95 % intervals, times their units.

    So many neighbouring residuals as `alike` count as one; `z` standard deviations either side.
    """
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * np.mean(fit.fun**2) * alike
    half = z * np.sqrt(np.diag(covariance))
    bounds = np.stack([values, values - half, values + half]) * unit
    return [Interval(*map(float, column)) for column in bounds.T]


def _fit(
    log: WheelLaserLog, start: Array, weights: Array, kept: Mask, scale: Array
) -> optimize.OptimizeResult:
    chosen = WheelLaserLog(log.durations_s[kept], log.rolled_rad[kept], log.laser_motion[kept])
    return optimize.least_squares(
        lambda unknowns: (_residual(chosen, unknowns) * weights).ravel(),
        start,
        x_scale=scale,
        loss="soft_l1",
    )


def _residual(log: WheelLaserLog, parameters: Array) -> Array:
    """Laser displacement measured less predicted, (N, 3)."""
    motion = arc_increment(log.rolled_rad * parameters[:2] / 2.0, float(parameters[2]))
    laser = parameters[3:]
    predicted = se2.compose(se2.inverse(laser), se2.compose(motion, laser))
    x, y, turn = (log.laser_motion - predicted).T
    return np.column_stack([x, y, se2.wrap(turn)])


@dataclass(frozen=True)
class SlipOfTurns:
    """kr and kl, m, and the number of blocks they come from."""

    kr: Interval
    kl: Interval
    n_blocks: int


def slip_of_turns(
    calibration: WheelCalibration,
    block: int,
    rng: np.random.Generator,
    n_resamples: int = 1000,
) -> SlipOfTurns:
    """Fit the kr/kl law to the residual variance of the turns against |ds|.

    A wheel error e turns the robot by e / axle, so Var(axle * residual) = kr |ds_r| + kl |ds_l|.
    Only the turn is used: scan matching resolves it to 0.1 mm of wheel travel, but distances only
    to 0.6 mm, above any slip of 8 mm steps. Residuals are summed over blocks of consecutive
    intervals with the same commands. Errors of the stamps and of the scans, which two neighbours
    share with opposite signs, cancel in long blocks but not in short ones. So a block of one gives
    an upper bound, and long blocks give the noise that builds up as the robot drives. Each
    command's mean residual (a bias, not noise) is subtracted.

    The estimate maximises the likelihood of zero-mean Gaussian sums; its interval comes from
    resampling the blocks.
    """
    travel = calibration.travel_m
    error = calibration.turn_residual_rad * calibration.axle_m.value
    commands = np.sign(np.round(travel / (0.02 * np.abs(travel).max())))
    squares, paths = [], []
    for command in np.unique(commands, axis=0):
        rows = np.flatnonzero(np.all(commands == command, axis=1) & calibration.kept)
        if not command.any() or len(rows) < 2 * block:
            continue
        off = error - error[rows].mean()
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            whole = run[: len(run) // block * block].reshape(-1, block)
            squares.append(off[whole].sum(axis=1) ** 2)
            paths.append(np.abs(travel[whole]).sum(axis=1))
    n = sum(map(len, squares))
    require(n >= 10, f"only {n} blocks of {block} intervals; use shorter blocks")
    square, path = np.concatenate(squares), np.concatenate(paths)
    picks = rng.integers(n, size=(n_resamples, n))
    spread = np.array([slip_law(square[pick], path[pick]) for pick in picks])
    bounds = [slip_law(square, path), *np.quantile(spread, [0.025, 0.975], axis=0)]
    kr, kl = (Interval(*map(float, column)) for column in np.transpose(bounds))
    return SlipOfTurns(kr, kl, n)


def slip_law(square: Array, path: Array) -> Array:
    """(kr, kl) >= 0 that make Gaussian sums of variance path @ k most likely."""
    k = np.full(2, float(square.sum() / path.sum()))
    for _ in range(10):  # iteratively reweighted: the score equations of the likelihood
        weighted = path * ((path @ k) ** -2.0)[:, None]
        normal, right_hand = path.T @ weighted, weighted.T @ square
        k = np.linalg.solve(normal, right_hand)
        if k.min() <= 0.0:  # with one at its bound, only the other is fitted
            k = np.where(k > 0.0, right_hand / np.diag(normal), 1e-15)
    return k


@dataclass(frozen=True)
class TrackCalibration:
    """Length of a tick and effective track, with 95 % intervals; start pose and error.

    Attributes
    ----------
    tick_m, track_m
        Ground travel per tick of either track; distance of the tracks that explains the turns.
    start
        (3,) pose of the axle at the first reading.
    rms_m
        RMS distance of the scanner's positions from the reference that they are fitted to.
    """

    tick_m: Interval
    track_m: Interval
    start: Array
    rms_m: float


def axle_at(scanner_m: Array, heading_rad: float) -> Array:
    """Pose (3,) of the axle behind the scanner at a position (2,)."""
    x, y = scanner_m - SCANNER_AHEAD_M * np.array([math.cos(heading_rad), math.sin(heading_rad)])
    return np.array([x, y, heading_rad])


def scanner_positions(log: TickLog, tick_m: float, track_m: float, start: Array) -> Array:
    """Positions (N, 2) of the scanner by dead reckoning of the axle from a start pose (3,)."""
    steps = arc_increment(np.diff(log.ticks, axis=0) * tick_m, track_m)
    axle = se2.compose(start, chain_motions(steps))
    return se2.compose(axle, np.array([SCANNER_AHEAD_M, 0.0, 0.0]))[:, :2]


def dead_reckoning_rms_m(
    log: TickLog, stamps: Array, positions: Array, tick_m: float, track_m: float, start: Array
) -> float:
    """RMS distance, m, of dead reckoning from reference positions (N, 2) at stamps (N,)."""
    off = _off_reference(log, stamps, positions, tick_m, track_m, start)
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def _off_reference(
    log: TickLog, stamps: Array, positions: Array, tick_m: float, track_m: float, start: Array
) -> Array:
    reached = scanner_positions(log, tick_m, track_m, start)
    inside = (stamps >= log.stamps[0]) & (stamps <= log.stamps[-1])
    at = [np.interp(stamps[inside], log.stamps, way) for way in reached.T]
    return np.asarray(np.stack(at, axis=1) - positions[inside])


def calibrate_track(
    log: TickLog,
    stamps: Array,
    positions: Array,
    heading_rad: float,
    tick_m: float = TICK_M,
    track_m: float = GEOMETRIC_TRACK_M,
) -> TrackCalibration:
    """Fit tick, track and start heading to reference positions (N, 2) at stamps (N,).

    The camera sees no heading, so the one at the start is fitted; the position there is the
    reference's first. Errors of dead reckoning build up, so neighbours are alike, and the intervals
    count only every twentieth reading.

    Parameters
    ----------
    heading_rad
        Rough heading at the start.
    """

    def residual(unknowns: Array) -> Array:
        tick, track = unknowns[0] * tick_m, unknowns[1] * track_m
        start = axle_at(positions[0], unknowns[2])
        return _off_reference(log, stamps, positions, tick, track, start).ravel()

    fit = optimize.least_squares(residual, np.array([1.0, 1.0, heading_rad]))
    tick, track, _ = fit_intervals(fit.x, fit, 20.0, np.array([tick_m, track_m, 1.0]))
    rms_m = float(np.sqrt(2.0 * np.mean(fit.fun**2)))
    return TrackCalibration(tick, track, axle_at(positions[0], fit.x[2]), rms_m)
