"""Wheel geometry, kr and kl from real logs, where the only reference is another sensor.

`calibrate_wheels` finds diameters, axle and the laser's pose from wheel angles and scan matches
(the problem of Censi et al., "Simultaneous calibration of odometry and sensor parameters"), and
`slip_of_turns` what the wheels' noise is. `calibrate_track` finds the length of a tick and the
effective track from ticks and an overhead camera that sees no heading.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from experiments.evaluation.statistics import Interval
from sim import se2
from sim.errors import InputError
from sim.formats.assemble import chained
from sim.formats.khepera import WheelLaserLog
from sim.formats.lego import GEOMETRIC_TRACK_M, SCANNER_AHEAD_M, TICK_M, TickLog
from sim.robot import arc_increment

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_TRIM_SIGMAS = 6.0  # a scan match farther off than this has failed
_ROUNDS = 5
_LEAST_K = 1e-15


@dataclass(frozen=True)
class WheelCalibration:
    """Diameters, axle and the laser's pose, with 95 % intervals, and what is left over.

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
        parameters = dataclasses.fields(self)[:6]
        return np.array([getattr(self, parameter.name).value for parameter in parameters])


def calibrate_wheels(
    log: WheelLaserLog, diameter_m: float = 0.04, axle_m: float = 0.1
) -> WheelCalibration:
    """Fit the six parameters to the laser's displacements by trimmed least squares.

    Residuals are weighted with their own spread (median absolute deviation), intervals beyond
    six of it are left out, and the fit is repeated. The laser's yaw may be anything: eight
    headings are tried as the start.

    Parameters
    ----------
    diameter_m, axle_m
        Rough sizes to start from.

    Raises
    ------
    InputError
        If there are too few intervals, or the robot never turned.
    """
    if len(log.durations_s) < 12 or not np.any(log.laser_motion[:, 2]):
        raise InputError("at least 12 intervals with turns are needed to calibrate the wheels")
    weights = 1.0 / np.array([diameter_m / 20.0, diameter_m / 20.0, 0.05])
    starts = [
        np.array([diameter_m, diameter_m, axle_m, 0.0, 0.0, yaw])
        for yaw in np.arange(8) * math.pi / 4.0 - math.pi
    ]
    scale = np.array([diameter_m, diameter_m, axle_m, 0.1, 0.1, 1.0])
    some = np.zeros(len(log.durations_s), bool)
    some[:: max(1, len(some) // 400)] = True  # enough to choose the start by
    fits = [_fit(log, start, weights, some, scale) for start in starts]
    fits = [fit for fit in fits if fit.x[:3].min() > 0.0]
    if not fits:
        raise InputError("wheels and laser do not agree; are the wheels the right way round?")
    fit = min(fits, key=lambda found: float(found.cost))
    for _ in range(_ROUNDS):
        residual = _residual(log, fit.x)
        spread = 1.4826 * np.median(np.abs(residual), axis=0) + 1e-9
        kept = np.sqrt(np.sum((residual / spread) ** 2, axis=1)) < _TRIM_SIGMAS
        fit = _fit(log, fit.x, 1.0 / spread, kept, scale)
    values = np.append(fit.x[:5], se2.wrap(fit.x[5]))
    right, left, axle, x, y, yaw = _intervals(values, fit)
    travel, turns = log.rolled_rad * values[:2] / 2.0, _residual(log, values)[:, 2]
    return WheelCalibration(right, left, axle, x, y, yaw, kept, travel, turns)


def _intervals(
    values: Array, fit: optimize.OptimizeResult, alike: float = 1.0, unit: Array | float = 1.0
) -> list[Interval]:
    """Parameters (P,) of a least-squares fit with 95 % intervals, times their units.

    `alike` neighbouring residuals count as one.
    """
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * float(np.mean(fit.fun**2)) * alike
    half = float(stats.norm.ppf(0.975)) * np.sqrt(np.diag(covariance))
    bounds = np.stack([values, values - half, values + half]) * unit
    return [Interval(*map(float, column)) for column in bounds.T]


def _fit(
    log: WheelLaserLog, start: Array, weights: Array, kept: Mask, scale: Array
) -> optimize.OptimizeResult:
    chosen = WheelLaserLog(log.durations_s[kept], log.rolled_rad[kept], log.laser_motion[kept])

    def weighted(parameters: Array) -> Array:
        return (_residual(chosen, parameters) * weights).ravel()

    return optimize.least_squares(weighted, start, x_scale=scale, loss="soft_l1")


def _residual(log: WheelLaserLog, parameters: Array) -> Array:
    """Laser displacement seen less foreseen, (N, 3)."""
    motion = arc_increment(log.rolled_rad * parameters[:2] / 2.0, float(parameters[2]))
    laser = parameters[3:]
    foreseen = se2.compose(se2.inverse(laser), se2.compose(motion, laser))
    residual: Array = log.laser_motion - foreseen
    residual[:, 2] = se2.wrap(residual[:, 2])
    return residual


@dataclass(frozen=True)
class SlipOfTurns:
    """kr and kl, m, and the number of blocks that show them."""

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
    The turn is used alone: scan matching sees it to 0.1 mm of wheel travel, but distances only
    to 0.6 mm, above any slip of 8 mm steps. Residuals are summed over blocks of consecutive
    intervals with the same commands. Errors of the stamps and of the scans, which two neighbours
    share with opposite signs, cancel in long blocks and do not in short ones, so the figure of a
    block of one is an upper reading and that of long blocks what builds up as the robot drives.
    Each command's mean residual (a bias, not noise) is taken off.

    The estimate is the maximum of the likelihood of zero-mean Gaussian sums; its interval comes
    from resampling the blocks.
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
    square = np.concatenate(squares) if squares else np.zeros(0)
    if len(square) < 10:
        raise InputError(f"only {len(square)} blocks of {block} intervals; use shorter blocks")
    path = np.concatenate(paths)
    k = _law(square, path)
    picks = rng.integers(len(square), size=(n_resamples, len(square)))
    spread = np.array([_law(square[pick], path[pick]) for pick in picks])
    low, high = np.quantile(spread, [0.025, 0.975], axis=0)
    kr, kl = (Interval(float(k[i]), float(low[i]), float(high[i])) for i in (0, 1))
    return SlipOfTurns(kr, kl, len(square))


def _law(square: Array, path: Array) -> Array:
    """(kr, kl) >= 0 that make Gaussian sums of variance path @ k most likely."""
    k = np.full(2, float(square.sum() / path.sum()))
    for _ in range(10):  # iteratively reweighted: the score equations of the likelihood
        weighted = path * ((path @ k) ** -2.0)[:, None]
        normal, right_hand = path.T @ weighted, weighted.T @ square
        k = np.linalg.solve(normal, right_hand)
        if k.min() <= 0.0:  # at the bound of one, the other stands alone
            k = np.where(k > 0.0, right_hand / np.diag(normal), _LEAST_K)
    return k


@dataclass(frozen=True)
class TrackCalibration:
    """Length of a tick, effective track, start heading, with 95 % intervals, and the errors.

    Attributes
    ----------
    tick_m, track_m
        Ground travel per tick of either track; distance that explains the turns.
    start
        (3,) pose of the axle at the first reading.
    rms_m
        RMS distance of the scanner's positions from the reference that was fitted.
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
    axle = se2.compose(start, chained(steps))
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
    at = np.stack([np.interp(stamps[inside], log.stamps, reached[:, i]) for i in (0, 1)], axis=1)
    off: Array = at - positions[inside]
    return off


def calibrate_track(
    log: TickLog,
    stamps: Array,
    positions: Array,
    heading_rad: float,
    tick_m: float = TICK_M,
    track_m: float = GEOMETRIC_TRACK_M,
) -> TrackCalibration:
    """Fit tick, track and start heading to reference positions (N, 2) at stamps (N,).

    The camera sees no heading, so the start's is fitted; its position is the reference's first.
    Errors of dead reckoning build up: neighbours are alike, and the intervals count every
    twentieth reading only.

    Parameters
    ----------
    heading_rad
        Rough heading at the start.
    """

    def residual(unknowns: Array) -> Array:
        tick, track, heading = unknowns
        start = axle_at(positions[0], heading)
        off = _off_reference(log, stamps, positions, tick * tick_m, track * track_m, start)
        return off.ravel()

    fit = optimize.least_squares(residual, np.array([1.0, 1.0, heading_rad]))
    tick, track, _ = _intervals(fit.x, fit, 20.0, np.array([tick_m, track_m, 1.0]))
    rms_m = float(np.sqrt(2.0 * np.mean(fit.fun**2)))
    return TrackCalibration(tick, track, axle_at(positions[0], float(fit.x[2])), rms_m)
