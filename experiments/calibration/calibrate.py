"""kr, kl, encoder gains and track from recorded runs, with 95 % intervals.

Two sources of knowledge are judged apart. Where the wheels' true travel is known, each
interval's encoder error speaks for itself (`from_wheel_truth`). Where only the end poses of
open-loop runs are known, as in puzzlebot2024, the candidates' end poses are simulated and
compared with the real ones (`from_end_poses`). What identifies what: an end heading alone gives
kr + kl; the full end pose also gives kr - kl, since a wheel that slips changes the distance too.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from sim import se2
from sim.compiled import njit
from sim.errors import InputError
from sim.recording import Recording
from sim.robot import (
    SLIP_TIME_CONSTANT_S,
    DifferentialDrive,
)
from sim.route import TICK_S, OpenLoop

Array = NDArray[np.float64]
EndPoseMethod = Literal["sampled", "linearised"]

SHORTEST_INTERVAL_S = 0.02
_KNOTS = 24
_SAMPLES = 256
_LOG_CHART_UP_TO_RAD = 4.5  # beyond it the logarithm nears its pole at 2 pi


@dataclass(frozen=True)
class Measured:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float

    def covers(self, truth: float) -> bool:
        """Whether the interval contains a value."""
        return self.low <= truth <= self.high


@dataclass(frozen=True)
class CalibrationResult:
    """What the runs tell of the robot.

    Attributes
    ----------
    method
        `wheel_truth`, `sampled` or `linearised`.
    kr, kl
        Slip variance per metre, m.
    bias_right, bias_left
        The encoder reads (1 + bias) times the ground travel; None if taken to be zero.
    track_m
        Effective distance of the wheels; None if taken to be the nominal one.
    n_used
        Intervals or runs that went into it.
    """

    method: str
    kr: Measured
    kl: Measured
    bias_right: Measured | None
    bias_left: Measured | None
    track_m: Measured | None
    n_used: int

    def as_json(self) -> str:
        """One JSON object: each parameter with its interval, null where it was not estimated."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    def as_text(self) -> str:
        """One line a parameter."""
        units = {"kr": "m", "kl": "m", "bias_right": "", "bias_left": "", "track_m": "m"}
        lines = [f"{self.method.replace('_', ' ')}, from {self.n_used} samples"]
        for name, unit in units.items():
            found: Measured | None = getattr(self, name)
            if found is not None:
                interval = f"[{found.low:.4g}, {found.high:.4g}]"
                lines.append(f"  {name:<10} {found.value:12.5g} {interval:>26} {unit}".rstrip())
        return "\n".join(lines)


@dataclass(frozen=True)
class Manoeuvre:
    """One open-loop command and the true end poses of its repetitions.

    Attributes
    ----------
    profile
        (N, 2) commanded body velocities at ticks of 1/300 s, m/s and rad/s.
    end_poses
        (n, 3) relative to the start of each run, m, m, rad; headings unwrapped.
    """

    profile: Array
    end_poses: Array

    @classmethod
    def of_route(cls, route: OpenLoop, robot: DifferentialDrive, end_poses: ArrayLike) -> Manoeuvre:
        """The manoeuvre that a route commands to a robot."""
        return cls(route.profile(robot), np.asarray(end_poses, dtype=np.float64))


# --- wheel truth ---------------------------------------------------------------------------------


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
    k = sum(e^2) / sum(|ds|): the likelihood's maximum for equal intervals. The mean of e^2 / |ds|
    would be another one, but intervals that begin or end near rest, where |ds| is itself noise,
    then carry as much weight as all others and bias it, six times at the tick's length. The
    interval of k is that of a chi-square with the intervals' effective degrees of freedom, or
    with those that the scatter of e^2 shows, if they are fewer.

    With `geometry` the bias is regressed jointly, e = bias ds with weights 1 / |ds|, and its
    degree of freedom is taken off; the track is regressed from the true turns.

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
        If intervals are too short, do not match, or hold too little travel.
    """
    encoder, ground = np.asarray(encoder_m, float), np.asarray(ground_m, float)
    if interval_s < SHORTEST_INTERVAL_S - 1e-9:
        raise InputError(
            f"interval_s={interval_s:g} is too short: below {SHORTEST_INTERVAL_S:g} s the encoder "
            "noise inflates the travel; use longer intervals"
        )
    if encoder.shape != ground.shape or encoder.ndim != 2 or encoder.shape[1] != 2:
        raise InputError(
            f"encoder and ground increments must both be (N, 2), got {encoder.shape} and "
            f"{ground.shape}"
        )
    wheels = [_wheel(encoder[:, i], ground[:, i], geometry) for i in (0, 1)]
    track = None
    if geometry and turns_rad is not None:
        track = _track(ground, np.asarray(turns_rad, float))
    (kr, bias_right), (kl, bias_left) = wheels
    return CalibrationResult("wheel_truth", kr, kl, bias_right, bias_left, track, len(encoder))


def _wheel(encoder_m: Array, ground_m: Array, geometry: bool) -> tuple[Measured, Measured | None]:
    """K of one wheel, m, and its bias."""
    travel = np.abs(ground_m)
    total_m = float(travel.sum())
    if total_m <= 0.0:
        raise InputError("a wheel never rolled; calibrate from runs that move both wheels")
    dof = total_m**2 / float(np.sum(travel**2))  # the number of intervals, if they are equal
    if dof < 3.0:
        raise InputError(
            f"too little travel: {dof:.1f} effective intervals of wheel truth, at least 3 are "
            "needed; record longer runs"
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
    measured_bias = Measured(bias, bias - half, bias + half) if geometry else None
    return Measured(k, float(low), float(high)), measured_bias


def _track(ground_m: Array, turns_rad: Array) -> Measured | None:
    """Track, m, by which the wheels' true difference turns the robot; None if it never turned."""
    difference, power = ground_m[:, 0] - ground_m[:, 1], float(np.sum(turns_rad**2))
    if power < 1e-6:
        return None
    track = float(difference @ turns_rad) / power
    residual = difference - track * turns_rad
    error = math.sqrt(float(np.sum((residual * turns_rad) ** 2))) / power
    half = float(stats.t.ppf(0.975, max(len(turns_rad) - 1, 1))) * error + 1e-9 * track
    return Measured(track, track - half, track + half)


# --- end poses -----------------------------------------------------------------------------------


def from_end_poses(
    manoeuvres: Sequence[Manoeuvre],
    nominal: DifferentialDrive,
    rng: np.random.Generator,
    *,
    method: EndPoseMethod = "sampled",
    geometry: bool = False,
    n_samples: int = _SAMPLES,
) -> CalibrationResult:
    """Calibrate from commands and true end poses alone, the situation of puzzlebot2024.

    `sampled`: a synthetic likelihood. For each candidate the manoeuvres' end poses are simulated
    a few hundred times with common random numbers, mapped like the real ones to coordinates in
    which they are nearly normal, and the real ones are judged by the samples' mean and
    covariance. `linearised`: the mean is the command's and the covariance the analytic one of
    eq. (2), in x, y and heading. It takes the bend of the end poses' cloud for slip and so
    overestimates k where headings scatter by more than a few degrees.

    The maximum is found by Fisher scoring over (log kr, log kl[, biases, log track]); the
    intervals come from the Fisher information there.

    Parameters
    ----------
    manoeuvres
        At least one, each with its repetitions.
    nominal
        The robot that the commands were meant for: its track turned them into wheel speeds.
    rng
        For the samples; unused by `linearised`.
    geometry
        Estimate the two biases and the track jointly, else they are taken as zero and nominal.

    Raises
    ------
    InputError
        If there are too few runs, or a pose is not finite.
    """
    wanted = 5 if geometry else 2
    n_runs = np.array([len(m.end_poses) for m in manoeuvres])
    if n_runs.sum() < wanted + 3:
        raise InputError(
            f"{n_runs.sum()} runs are too few for {wanted} unknowns; record at least {wanted + 3}"
        )
    for i, manoeuvre in enumerate(manoeuvres):
        if not np.all(np.isfinite(manoeuvre.end_poses)):
            raise InputError(f"manoeuvre {i} has an end pose that is not finite; leave it out")
    models = [_Model(m, nominal, rng, method, n_samples) for m in manoeuvres]
    seen = [model.coordinates(m.end_poses) for model, m in zip(models, manoeuvres, strict=True)]
    means = np.array([y.mean(axis=0) for y in seen])
    scatters = np.array(
        [(y - mean).T @ (y - mean) / len(y) for y, mean in zip(seen, means, strict=True)]
    )

    def moments(unknowns: Array) -> tuple[Array, Array]:
        k = np.exp(unknowns[:2])
        bias = unknowns[2:4] if geometry else np.zeros(2)
        track_m = nominal.track_m * (math.exp(unknowns[4]) if geometry else 1.0)
        parts = [model.moments(k, bias, track_m) for model in models]
        return np.array([p[0] for p in parts]), np.array([p[1] for p in parts])

    start = np.zeros(wanted)
    start[:2] = math.log(_rough_k(manoeuvres, nominal))
    best, information = _fisher_scoring(moments, start, means, scatters, n_runs)
    half = 1.959964 * np.sqrt(np.diag(np.linalg.inv(information)))
    low, high = best - half, best + half

    def measured(i: int, change: Callable[[float], float]) -> Measured:
        return Measured(change(best[i]), change(low[i]), change(high[i]))

    right = left = track = None
    if geometry:
        right, left = measured(2, float), measured(3, float)
        track = measured(4, lambda log_ratio: nominal.track_m * math.exp(log_ratio))
    kr, kl = measured(0, math.exp), measured(1, math.exp)
    return CalibrationResult(method, kr, kl, right, left, track, int(n_runs.sum()))


def _rough_k(manoeuvres: Sequence[Manoeuvre], nominal: DifferentialDrive) -> float:
    """A first guess of k, m, from the scatter of the end headings: Var = (kr + kl) |ds| / b^2."""
    squares = travel = 0.0
    for manoeuvre in manoeuvres:
        heading = manoeuvre.end_poses[:, 2]
        ds = np.abs(nominal.wheel_speeds(*manoeuvre.profile.T)).sum(axis=0) * TICK_S
        squares += float(np.sum((heading - heading.mean()) ** 2)) * nominal.track_m**2
        travel += (len(heading) - 1) * float(ds.sum())
    if squares <= 0.0 or travel <= 0.0:
        raise InputError(
            "the end headings do not scatter; give repetitions of manoeuvres that move the robot"
        )
    return squares / travel


def _fisher_scoring(
    moments: Callable[[Array], tuple[Array, Array]],
    start: Array,
    means: Array,
    scatters: Array,
    n_runs: NDArray[np.int64],
) -> tuple[Array, Array]:
    """Maximum (P,) of the Gaussian likelihood of all manoeuvres, and the information (P, P)."""

    def log_likelihood(mean: Array, covariance: Array) -> float:
        off = means - mean
        second = scatters + off[:, :, None] * off[:, None, :]
        sign, log_det = np.linalg.slogdet(covariance)
        if np.any(sign <= 0.0):
            return -math.inf
        trace = np.trace(np.linalg.solve(covariance, second), axis1=1, axis2=2)
        return -0.5 * float(np.sum(n_runs * (log_det + trace)))

    steps = np.full(len(start), 1e-2)
    steps[2:] = 1e-3  # biases and track move the mean, which is far sharper than the scatter
    unknowns = start.copy()
    mean, covariance = moments(unknowns)
    value = log_likelihood(mean, covariance)
    information = np.eye(len(start))
    for _ in range(40):
        by_mean, by_covariance = [], []
        for i, step in enumerate(steps):
            ahead, behind = unknowns.copy(), unknowns.copy()
            ahead[i] += step
            behind[i] -= step
            (mean_ahead, cov_ahead), (mean_behind, cov_behind) = moments(ahead), moments(behind)
            by_mean.append((mean_ahead - mean_behind) / (2.0 * step))
            by_covariance.append((cov_ahead - cov_behind) / (2.0 * step))
        J, D = np.array(by_mean), np.array(by_covariance)  # (P, M, 3), (P, M, 3, 3)
        precision = np.linalg.inv(covariance)
        W = precision @ D
        off = means - mean
        excess = precision @ (scatters + off[:, :, None] * off[:, None, :]) - np.eye(3)
        score = np.einsum("m,pmi,mij,mj->p", n_runs, J, precision, off)
        score += 0.5 * np.einsum("m,pmij,mji->p", n_runs, W, excess)
        information = np.einsum("m,pmi,mij,qmj->pq", n_runs, J, precision, J)
        information += 0.5 * np.einsum("m,pmij,qmji->pq", n_runs, W, W)
        move = np.linalg.solve(information, score)
        move *= min(1.0, 2.0 / max(np.abs(move[:2]).max(), 1e-12))
        if score @ move < 1e-6:
            break
        for _ in range(12):
            trial_mean, trial_covariance = moments(unknowns + move)
            trial = log_likelihood(trial_mean, trial_covariance)
            if trial > value:
                break
            move = move / 2.0
        else:
            break
        unknowns, mean, covariance, value = unknowns + move, trial_mean, trial_covariance, trial
    return unknowns, information


class _Model:
    """End poses of one manoeuvre as the candidates would have them.

    The wheels roll between two dozen knots: what the command and the biases make them roll, less
    sqrt(k) times the slip's Brownian motion over the travel, delayed by the lag of the wheels'
    speed loop as in `sim.robot.Slip`. Within an interval the path is an arc.
    """

    def __init__(
        self,
        manoeuvre: Manoeuvre,
        nominal: DifferentialDrive,
        rng: np.random.Generator,
        method: EndPoseMethod,
        n_samples: int,
    ) -> None:
        if method not in ("sampled", "linearised"):
            raise InputError(f"method must be sampled or linearised, got {method!r}")
        self._commands_m = nominal.wheel_speeds(*manoeuvre.profile.T) * TICK_S
        self._knots = _knots(self._commands_m)
        heading_rad = float(manoeuvre.profile[:, 1].sum() * TICK_S)
        self._linearised = method == "linearised"
        self._log_chart = abs(heading_rad) < _LOG_CHART_UP_TO_RAD
        if not self._linearised:
            self._noise = _slip_paths(self._commands_m, self._knots, n_samples, rng)

    def coordinates(self, poses: Array) -> Array:
        """Coordinates (n, 3) of end poses (n, 3)."""
        if self._linearised:
            return poses
        charted: Array = _charts(poses, self._log_chart)
        return charted

    def moments(self, k: Array, bias: Array, track_m: float) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3) of the coordinates."""
        travel = _mean_travel(self._commands_m, self._knots, bias, TICK_S / SLIP_TIME_CONSTANT_S)
        found: tuple[Array, Array]
        if self._linearised:
            found = _linearised_moments(travel, k, track_m)
        else:
            scale = np.sqrt(k) * (1.0 + bias) ** -1.5
            found = _sampled_moments(travel, self._noise, scale, track_m, self._log_chart)
        return found


def _knots(commands_m: Array) -> NDArray[np.int64]:
    """Ticks (S + 1,) that cut the run: evenly, and where the robot comes to rest between moves."""
    n_ticks = len(commands_m)
    speed = np.abs(commands_m).max(axis=1)
    # a rounded plateau is no turning point: a minimum must lie below its surroundings clearly
    change = np.diff(speed) / max(float(speed.max()), 1e-12)
    turning_points = np.flatnonzero((change[:-1] <= 0.0) & (change[1:] > 1e-6)) + 1
    even = np.linspace(0, n_ticks, _KNOTS + 1).round().astype(np.int64)
    return np.unique(np.concatenate([even, turning_points]))


def _slip_paths(
    commands_m: Array, knots: NDArray[np.int64], n_samples: int, rng: np.random.Generator
) -> Array:
    """Slip (n, S, 2) of the ground travel between knots for k = 1, in m^(1/2).

    The encoder error of a tick, of variance |ds|, reaches the ground through the lag: by tick n
    the share 1 - (1 - a)^(n - m) of the error of tick m has. So the increments are normal with a
    covariance known beforehand. The samples come in antithetic pairs and are whitened: their
    first two moments are exact, and the sampling error is left to the arcs' curvature alone.
    """
    n_intervals = len(knots) - 1
    half = max(n_samples // 2, 2 * n_intervals + 2)
    z = rng.standard_normal((half, 2 * n_intervals))
    chol = np.linalg.cholesky(z.T @ z / half)
    z = np.linalg.solve(chol, z.T).T
    z = np.concatenate([z, -z]).reshape(2 * half, n_intervals, 2)
    ticks = np.arange(len(commands_m))
    keep = 1.0 - TICK_S / SLIP_TIME_CONSTANT_S
    settled = 1.0 - keep ** np.maximum(knots[:, None] - 1 - ticks[None, :], 0)
    response = np.diff(settled, axis=0)  # (S, N): what tick m's error moves in each interval
    paths = np.empty_like(z)
    for i in (0, 1):
        covariance = (response * np.abs(commands_m[:, i])) @ response.T
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        paths[:, :, i] = z[:, :, i] @ root.T
    return paths


@njit()
def _linearised_moments(travel: Array, k: Array, track_m: float) -> tuple[Array, Array]:
    """Pose (3,) and analytic covariance (3, 3) after wheel travels (S, 2).

    puzzlebot2024, eq. (2), with the second form of eq. (6), its last row's sign settled.
    """
    n_intervals = len(travel)
    pose = np.zeros(3)
    ends = np.empty((n_intervals, 2))
    by_wheels = np.empty((n_intervals, 3, 2))
    for s in range(n_intervals):
        forward = (travel[s, 0] + travel[s, 1]) / 2.0
        half = (travel[s, 0] - travel[s, 1]) / (2.0 * track_m)
        cos, sin = np.cos(pose[2] + half), np.sin(pose[2] + half)
        for w in range(2):
            swing = (0.5 - w) * forward / track_m
            by_wheels[s, 0, w] = cos / 2.0 - swing * sin
            by_wheels[s, 1, w] = sin / 2.0 + swing * cos
            by_wheels[s, 2, w] = (1.0 - 2.0 * w) / track_m
        chord = forward * (1.0 - half**2 / 6.0 + half**4 / 120.0)
        pose[0] += chord * cos
        pose[1] += chord * sin
        pose[2] += 2.0 * half
        ends[s] = pose[:2]
    covariance = np.zeros((3, 3))
    for s in range(n_intervals):
        for w in range(2):
            column = by_wheels[s, :, w].copy()
            # a turn swings all that follows about the interval's end
            column[0] -= (pose[1] - ends[s, 1]) * by_wheels[s, 2, w]
            column[1] += (pose[0] - ends[s, 0]) * by_wheels[s, 2, w]
            variance = k[w] * abs(travel[s, w])
            for i in range(3):
                for j in range(3):
                    covariance[i, j] += variance * column[i] * column[j]
    return pose, covariance


@njit()
def _chart(x: float, y: float, heading: float, log_chart: bool) -> tuple[float, float, float]:
    """Coordinates in which end poses are nearly normal.

    The position is turned back by half the heading, so the crescent of a straight run becomes a
    blob; the logarithm also divides by the chord's shortening, which makes it exact for a steady
    slip but has a pole at 2 pi.
    """
    half = heading / 2.0
    cos, sin = np.cos(half), np.sin(half)
    stretch = 1.0
    if log_chart and abs(half) > 1e-4:
        stretch = half / sin
    return stretch * (cos * x + sin * y), stretch * (cos * y - sin * x), heading


@njit()
def _charts(poses: Array, log_chart: bool) -> Array:
    """Coordinates (n, 3) of poses (n, 3)."""
    out = np.empty_like(poses)
    for n in range(len(poses)):
        out[n] = _chart(poses[n, 0], poses[n, 1], poses[n, 2], log_chart)
    return out


@njit()
def _mean_travel(
    commands_m: Array, knots: NDArray[np.int64], bias: Array, lag_share: float
) -> Array:
    """Ground travel (S, 2) between knots without noise, through the lag of `sim.robot.Slip`."""
    travel = np.zeros((len(knots) - 1, 2))
    for i in range(2):
        lag = 0.0
        for s in range(len(knots) - 1):
            for tick in range(knots[s], knots[s + 1]):
                rolling = commands_m[tick, i] - lag
                lag += lag_share * (bias[i] * rolling - lag)
                travel[s, i] += rolling
    return travel


@njit(fastmath=True)
def _sampled_moments(
    travel: Array, noise: Array, scale: Array, track_m: float, log_chart: bool
) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of the coordinates of simulated end poses."""
    n_samples, n_intervals = noise.shape[0], noise.shape[1]
    ends = np.empty((n_samples, 3))
    for n in range(n_samples):
        x, y, heading = 0.0, 0.0, 0.0
        for s in range(n_intervals):
            right = travel[s, 0] - scale[0] * noise[n, s, 0]
            left = travel[s, 1] - scale[1] * noise[n, s, 1]
            half = (right - left) / (2.0 * track_m)
            chord = 0.5 * (right + left) * (1.0 - half**2 / 6.0 + half**4 / 120.0)
            x += chord * np.cos(heading + half)
            y += chord * np.sin(heading + half)
            heading += 2.0 * half
        ends[n] = _chart(x, y, heading, log_chart)
    mean = np.zeros(3)
    for n in range(n_samples):
        mean += ends[n] / n_samples
    covariance = np.zeros((3, 3))
    for n in range(n_samples):
        for i in range(3):
            for j in range(3):
                covariance[i, j] += (ends[n, i] - mean[i]) * (ends[n, j] - mean[j]) / n_samples
    return mean, covariance


# --- recordings and the report's own procedure ---------------------------------------------------


def calibrate_recordings(
    recordings: Sequence[Recording],
    method: Literal["wheel_truth", "end_poses"] = "wheel_truth",
    *,
    geometry: bool = True,
    interval_s: float = 0.05,
    rng: np.random.Generator | None = None,
) -> CalibrationResult:
    """Calibrate from recordings.

    Parameters
    ----------
    recordings
        For `wheel_truth`, any runs whose truth holds the wheels' travel. For `end_poses`,
        repetitions of open-loop manoeuvres; those with the same commands belong together.
    interval_s
        Shortest interval over which wheel travel is netted.
    rng
        For the samples of `end_poses`; seeded with 0 if None.

    Raises
    ------
    InputError
        If the truth is missing, runs are not repeated, or there is too little travel.
    """
    if not recordings:
        raise InputError("no recordings to calibrate from; give at least one")
    if method == "wheel_truth":
        parts = [_wheel_intervals(r, i, interval_s) for i, r in enumerate(recordings)]
        encoder, ground, turns = (np.concatenate(p) for p in zip(*parts, strict=True))
        return from_wheel_truth(encoder, ground, turns, interval_s=interval_s, geometry=geometry)
    if method != "end_poses":
        raise InputError(f"method must be wheel_truth or end_poses, got {method!r}")
    groups: dict[bytes, tuple[Array, list[Array]]] = {}
    for i, recording in enumerate(recordings):
        profile, end = _command_profile(recording, i), end_pose(recording, i)
        groups.setdefault(profile.tobytes(), (profile, []))[1].append(end)
    if min(len(ends) for _, ends in groups.values()) < 2:
        raise InputError(
            "end poses need open-loop runs with the same commands, at least 2 of each; "
            "give repetitions, or use the wheel truth"
        )
    manoeuvres = [Manoeuvre(profile, np.array(ends)) for profile, ends in groups.values()]
    believed = recordings[0].robot
    nominal = DifferentialDrive(believed.wheel_radius_m, believed.track_m)
    rng = np.random.default_rng(0) if rng is None else rng
    return from_end_poses(manoeuvres, nominal, rng, geometry=geometry)


def _wheel_intervals(recording: Recording, i: int, interval_s: float) -> tuple[Array, Array, Array]:
    """Increments of encoder (N, 2), ground (N, 2) and heading (N,) over netted intervals."""
    truth = recording.truth
    if truth is None or len(truth.wheel_travel_m) == 0:
        raise InputError(
            f"recording {i} has no true wheel travel; record it in simulation, or calibrate from "
            "end poses"
        )
    inside = (truth.stamps >= recording.wheels.stamps[0] - 1e-9) & (
        truth.stamps <= recording.wheels.stamps[-1] + 1e-9
    )
    stamps = truth.stamps[inside]
    rows = [0] if len(stamps) else []
    for row in range(1, len(stamps)):
        if stamps[row] - stamps[rows[-1]] >= interval_s - 1e-9:
            rows.append(row)
    if len(rows) < 2:
        raise InputError(f"recording {i} is shorter than one interval of {interval_s:g} s")
    encoder = np.stack(
        [
            np.interp(stamps[rows], recording.wheels.stamps, recording.wheels.position_m[:, w])
            for w in (0, 1)
        ],
        axis=1,
    )
    heading = np.unwrap(truth.poses[inside, 2])[rows]
    ground = truth.wheel_travel_m[inside][rows]
    return np.diff(encoder, axis=0), np.diff(ground, axis=0), np.diff(heading)


def _command_profile(recording: Recording, i: int) -> Array:
    """Commanded body velocities (N, 2) at ticks."""
    log = recording.commands
    if log is None or len(log.stamps) == 0:
        raise InputError(f"recording {i} has no commands; end poses say nothing without them")
    n_ticks = round((recording.frame_stamps[-1] - recording.frame_stamps[0]) / TICK_S)
    middles = recording.frame_stamps[0] + (np.arange(n_ticks) + 0.5) * TICK_S
    rows = np.searchsorted(log.stamps, middles, side="right") - 1
    profile: Array = np.where(rows[:, None] >= 0, log.velocity[np.maximum(rows, 0)], 0.0)
    return profile


def end_pose(recording: Recording, i: int = 0) -> Array:
    """True end pose (3,) of recording number i relative to its start; heading unwrapped."""
    if recording.truth is None or len(recording.truth.poses) < 2:
        raise InputError(f"recording {i} has no true poses to calibrate from")
    poses = recording.truth.poses
    end: Array = se2.between(poses[0], poses[-1])
    end[2] = np.unwrap(poses[:, 2])[-1] - poses[0, 2]
    return end


def report_gradient_descent(
    final_ideal: float,
    final_real: ArrayLike,
    time_s: float,
    *,
    rate: float = 0.01,
    n_iterations: int = 100,
) -> Array:
    """The report's own procedure, kept to show what it returns; not an estimator of kr or kl.

    It fits k so that (k + k) v comes near v, where v is the deviation of the end over the time,
    by gradient descent from k = 1. The data cancel: the minimum is 1/2 whatever they are, and
    they only set how fast the descent gets there, (1 - 8 rate mean(v^2)) a step.

    Parameters
    ----------
    final_ideal, final_real
        Promised and real end positions (n,), m or rad.
    time_s
        Duration, s.

    Returns
    -------
    Array
        (n_iterations + 1,) values of k, the first one 1.
    """
    v = (np.atleast_1d(np.asarray(final_real, float)) - final_ideal) / time_s
    slope = float(np.mean(v**2))
    k = np.empty(n_iterations + 1)
    k[0] = 1.0
    for i in range(n_iterations):
        k[i + 1] = k[i] - rate * 4.0 * (2.0 * k[i] - 1.0) * slope
    return k
