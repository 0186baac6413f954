"""kr, kl, encoder gains and track where only the end poses of open-loop runs are known.

What identifies what: an end heading alone gives kr + kl; the full end pose also gives kr - kl,
since a wheel that slips changes the distance too.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from experiments.calibration.end_pose_model import EndPoseMethod, EndPoseModel
from experiments.calibration.result import CalibrationResult
from experiments.evaluation.statistics import Interval
from sim.arrays import Array
from sim.errors import require
from sim.robot.base import TICK_S
from sim.robot.drive import DifferentialDrive

Moments = tuple[Array, Array]

# both biases, as `sim.robot.slip` bounds them, and a track within a factor of ten
_GEOMETRY = ((-0.67, -0.67, -math.log(10.0)), (2.0, 2.0, math.log(10.0)))


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


def from_end_poses(
    manoeuvres: Sequence[Manoeuvre],
    nominal: DifferentialDrive,
    rng: np.random.Generator,
    *,
    method: EndPoseMethod = "sampled",
    geometry: bool = False,
) -> CalibrationResult:
    """Calibrate from commands and true end poses alone, as in puzzlebot2024.

    `sampled`: a synthetic likelihood. For each candidate the manoeuvres' end poses are simulated
    a few hundred times with common random numbers and mapped, like the real ones, to coordinates
    in which they are nearly normal. The samples' mean and covariance give the likelihood of the
    real ones. `linearised`: the mean is the command's and the covariance the analytic one of
    eq. (2), in x, y and heading. It mistakes the bend of the cloud of end poses for slip and so
    overestimates k where headings scatter by more than a few degrees.

    The maximum is found by Fisher scoring over (log kr, log kl[, biases, log track]); the
    intervals come from the Fisher information there.

    Parameters
    ----------
    manoeuvres
        At least one, each with its repetitions.
    nominal
        The robot that the commands were meant for; its track turned them into wheel speeds.
    rng
        For the samples; unused by `linearised`.
    geometry
        Estimate the two biases and the track jointly; else they are zero and nominal.

    Raises
    ------
    InputError
        If there are too few runs, a pose is not finite, or with `geometry` the manoeuvres do not
        both turn and advance.
    """
    wanted = 5 if geometry else 2
    n_runs = np.array([len(m.end_poses) for m in manoeuvres])
    require(
        n_runs.sum() >= wanted + 3,
        f"{n_runs.sum()} runs are too few for {wanted} unknowns; record at least {wanted + 3}",
    )
    for i, manoeuvre in enumerate(manoeuvres):
        require(
            np.all(np.isfinite(manoeuvre.end_poses)),
            f"manoeuvre {i} has an end pose that is not finite; leave it out",
        )
    rolled = sum(np.abs(m.profile).sum(axis=0) for m in manoeuvres)
    require(
        not geometry or np.all(rolled > 0.0),
        "wheel gains and track need both straights and turns; add the missing kind",
    )
    models = [
        EndPoseModel(
            m.profile, nominal, rng, method, turn_rad=float(np.abs(m.end_poses[:, 2]).max())
        )
        for m in manoeuvres
    ]
    seen = [model.coordinates(m.end_poses) for model, m in zip(models, manoeuvres, strict=True)]
    means = np.array([y.mean(axis=0) for y in seen])
    off = [y - mean for y, mean in zip(seen, means, strict=True)]
    scatters = np.array([part.T @ part / len(part) for part in off])

    def moments(unknowns: Array) -> Moments:
        bias = unknowns[2:4] if geometry else np.zeros(2)
        track_m = nominal.track_m * (math.exp(unknowns[4]) if geometry else 1.0)
        parts = [model.moments(np.exp(unknowns[:2]), bias, track_m) for model in models]
        mean, covariance = map(np.array, zip(*parts, strict=True))
        return mean, covariance

    start = np.zeros(wanted)
    start[:2] = math.log(_rough_k(manoeuvres, nominal))
    if geometry:
        start[2:] = _rough_geometry(manoeuvres, models, nominal.track_m)
    best, information = _fisher_scoring(moments, start, means, scatters, n_runs)
    half = 1.959964 * np.sqrt(np.diag(np.linalg.inv(information)))
    bounds = np.stack([best, best - half, best + half], axis=1)
    kr, kl = (Interval(*map(math.exp, bounds[i])) for i in (0, 1))
    right = left = track = None
    if geometry:
        right, left = (Interval(*map(float, bounds[i])) for i in (2, 3))
        track = Interval(*(nominal.track_m * math.exp(log_ratio) for log_ratio in bounds[4]))
    return CalibrationResult(method, kr, kl, right, left, track, int(n_runs.sum()))


def _rough_k(manoeuvres: Sequence[Manoeuvre], nominal: DifferentialDrive) -> float:
    """A first guess of k, m, from the scatter of the end headings: Var = (kr + kl) |ds| / b^2."""
    squares = travel = 0.0
    for manoeuvre in manoeuvres:
        heading = manoeuvre.end_poses[:, 2]
        ds = np.abs(nominal.wheel_speeds(*manoeuvre.profile.T)).sum(axis=0) * TICK_S
        squares += float(np.sum((heading - heading.mean()) ** 2)) * nominal.track_m**2
        travel += (len(heading) - 1) * float(ds.sum())
    require(
        squares > 0.0 and travel > 0.0,
        "the end headings do not scatter; give repetitions of manoeuvres that move the robot",
    )
    return squares / travel


def _rough_geometry(
    manoeuvres: Sequence[Manoeuvre], models: Sequence[EndPoseModel], track_m: float
) -> Array:
    """A first guess (3,) of the biases and of log(track / nominal), from the mean end poses.

    From the nominal geometry the likelihood of a robot that is far from it has other maxima, where
    slip explains what the track does.
    """
    ends = np.array([m.end_poses.mean(axis=0) for m in manoeuvres])

    def off(unknowns: Array) -> Array:
        track = track_m * math.exp(unknowns[2])
        found = [model.end_without_slip(unknowns[:2], track) for model in models]
        return np.asarray(found - ends).ravel()

    return np.asarray(scipy.optimize.least_squares(off, np.zeros(3), bounds=_GEOMETRY).x)


def _fisher_scoring(
    moments: Callable[[Array], Moments],
    start: Array,
    means: Array,
    scatters: Array,
    n_runs: NDArray[np.int64],
) -> tuple[Array, Array]:
    """Maximum (P,) of the Gaussian likelihood of all manoeuvres, and the information (P, P)."""

    def second(mean: Array) -> Array:
        """Second moments (M, 3, 3) of what was seen, about a mean."""
        off = means - mean
        return scatters + off[:, :, None] * off[:, None, :]

    def log_likelihood(mean: Array, covariance: Array) -> float:
        sign, log_det = np.linalg.slogdet(covariance)
        if np.any(sign <= 0.0):
            return -math.inf
        trace = np.trace(np.linalg.solve(covariance, second(mean)), axis1=1, axis2=2)
        return -0.5 * float(np.sum(n_runs * (log_det + trace)))

    # biases and track move the mean, which is far sharper than the scatter
    steps = np.array([1e-2, 1e-2, 1e-3, 1e-3, 1e-3])[: len(start)]
    unknowns = start
    mean, covariance = moments(unknowns)
    value = log_likelihood(mean, covariance)
    for _ in range(40):
        slopes = [
            [
                (ahead - behind) / (2.0 * step)
                for ahead, behind in zip(
                    moments(unknowns + shift), moments(unknowns - shift), strict=True
                )
            ]
            for shift, step in zip(np.diag(steps), steps, strict=True)
        ]
        J, D = (np.array(part) for part in zip(*slopes, strict=True))  # (P, M, 3), (P, M, 3, 3)
        precision = np.linalg.inv(covariance)
        W = precision @ D
        excess = precision @ second(mean) - np.eye(3)
        score = np.einsum("m,pmi,mij,mj->p", n_runs, J, precision, means - mean)
        score += 0.5 * np.einsum("m,pmij,mji->p", n_runs, W, excess)
        information = np.einsum("m,pmi,mij,qmj->pq", n_runs, J, precision, J)
        information += 0.5 * np.einsum("m,pmij,qmji->pq", n_runs, W, W)
        move = np.linalg.solve(information, score)
        move *= min(1.0, 2.0 / max(np.abs(move[:2]).max(), 1e-12))
        if score @ move < 1e-6:
            break
        for _ in range(12):
            trial = moments(unknowns + move)
            reached = log_likelihood(*trial)
            if reached > value:
                break
            move = move / 2.0
        else:
            break
        unknowns, (mean, covariance), value = unknowns + move, trial, reached
    return unknowns, information
