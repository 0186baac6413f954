"""kr, kl, encoder gains and track where the wheels' true travel is known."""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from experiments.calibration.result import CalibrationResult
from experiments.evaluation.statistics import Interval
from sim.arrays import Array
from sim.errors import require

SHORTEST_INTERVAL_S = 0.02


def from_wheel_truth(
    encoder_m: ArrayLike,
    ground_m: ArrayLike,
    turns_rad: ArrayLike | None = None,
    *,
    interval_s: float,
    geometry: bool = True,
) -> CalibrationResult:
    """Calibrate from the wheels' true travel.

    With e = encoder - ground, Var(e) = k |ds|, each wheel's estimate is
    k = sum(e^2) / sum(|ds|), the maximum likelihood for equal intervals. The mean of e^2 / |ds|
    would be another estimate, but there the intervals near rest, where |ds| is itself noise, weigh
    as much as all others and bias it, sixfold at the length of a tick. The interval of k is that of
    a chi-square with the effective degrees of freedom of the intervals, or with those that the
    scatter of e^2 shows, if fewer.

    With `geometry` the bias is regressed jointly, e = bias ds with weights 1 / |ds|, and its
    degree of freedom is subtracted; the track is regressed from the true turns.

    Parameters
    ----------
    encoder_m, ground_m
        (N, 2) increments of the right and left wheel over intervals, m.
    turns_rad
        (N,) true change of heading over the intervals, unwrapped, or None.
    interval_s
        Length of the intervals, at least 0.02 s.

    Raises
    ------
    InputError
        If intervals are too short, do not match, or have too little travel.
    """
    encoder, ground = np.asarray(encoder_m, float), np.asarray(ground_m, float)
    require(
        interval_s >= SHORTEST_INTERVAL_S - 1e-9,
        f"interval_s={interval_s:g} is too short: below {SHORTEST_INTERVAL_S:g} s the encoder "
        "noise inflates the travel; use longer intervals",
    )
    require(
        encoder.shape == ground.shape and encoder.ndim == 2 and encoder.shape[1] == 2,
        f"encoder and ground increments must both be (N, 2), got {encoder.shape} and "
        f"{ground.shape}",
    )
    (kr, right), (kl, left) = (_wheel(encoder[:, i], ground[:, i], geometry) for i in (0, 1))
    turned = geometry and turns_rad is not None
    track = _track(ground, np.asarray(turns_rad, float)) if turned else None
    return CalibrationResult("wheel_truth", kr, kl, right, left, track, len(encoder))


def _wheel(encoder_m: Array, ground_m: Array, geometry: bool) -> tuple[Interval, Interval | None]:
    """K of one wheel, m, and its bias."""
    travel = np.abs(ground_m)
    total_m = float(travel.sum())
    require(total_m > 0.0, "a wheel never rolled; calibrate from runs that move both wheels")
    dof = total_m**2 / float(np.sum(travel**2))  # the number of intervals, if they are equal
    require(
        dof >= 3.0,
        f"too little travel: {dof:.1f} effective intervals of wheel truth, at least 3 are "
        "needed; record longer runs",
    )
    error = encoder_m - ground_m
    bias = float(np.sum(error * np.sign(ground_m))) / total_m if geometry else 0.0
    residual = error - bias * ground_m
    left = dof - 1.0 if geometry else dof
    k = float(np.sum(residual**2)) / total_m * dof / left
    scatter = float(np.sum((residual**2 - k * travel) ** 2))
    shown = min(left, 2.0 * (k * total_m) ** 2 / scatter) if scatter > 0.0 else left
    low, high = shown * k / stats.chi2.ppf([0.975, 0.025], shown)
    half = float(stats.t.ppf(0.975, left)) * math.sqrt(k / total_m)
    of_bias = Interval(bias, bias - half, bias + half) if geometry else None
    return Interval(k, float(low), float(high)), of_bias


def _track(ground_m: Array, turns_rad: Array) -> Interval | None:
    """Track, m, by which the wheels' true difference turns the robot; None if it never turned."""
    difference, power = ground_m[:, 0] - ground_m[:, 1], float(np.sum(turns_rad**2))
    if power < 1e-6:
        return None
    track = float(difference @ turns_rad) / power
    residual = difference - track * turns_rad
    error = math.sqrt(float(np.sum((residual * turns_rad) ** 2))) / power
    half = float(stats.t.ppf(0.975, max(len(turns_rad) - 1, 1))) * error + 1e-9 * track
    return Interval(track, track - half, track + half)
