"""Closing loops with a laser: which key frames to compare, and which closures to believe.

A key frame is compared with an older one where the uncertainty of their relative pose lets the two
see the same place (a Mahalanobis gate), where that would teach something (the information gain of
ila2010), and where the scans look alike. The scans are registered from several starts, which must
agree. A closure is held until enough others agree with it: the joint innovation of each pair must
pass a chi-squared test (joint compatibility, neira2001; the largest set of pairwise consistent
closures, mangelson2018).

Sources: Ila, Porta and Andrade-Cetto, Information-based compact pose SLAM, T-RO 26, 2010; Neira and
Tardos, Data association in stochastic mapping using the joint compatibility test, T-RA 17, 2001;
Mangelson et al., Pairwise consistent measurement set maximization for robust multi-robot map
merging, ICRA 2018.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import chdtri

from estimators.gaussian import Gaussian
from estimators.graph.pose_graph import Edge, PoseGraph
from estimators.laser.icp import PreparedScan
from estimators.laser.scan_matching import ScanMatcher
from sim import se2
from sim.arrays import Array, Ints
from sim.options import Count, NonNegative, Positive, options
from sim.sensors import Laser

N_QUANTILES = 16
_QUANTILES = np.linspace(0.03, 0.97, N_QUANTILES)
_ALIKE = 0.5  # mean difference of log quantiles; scans of one place differ less
_REACH_SIGMAS = 3.0
_START_M, _START_RAD, _MOST_STEPS = 0.5, 0.06, 3  # between starts, and their number either way
_START = np.diag([(_START_M / 2.0) ** 2, (_START_M / 2.0) ** 2, _START_RAD**2])
_MOST_TURN_RAD = 0.5  # of a start's heading from the expected one
_SAME_M, _SAME_RAD = 0.1, 0.03  # results of two starts that differ by less are one
_RIVAL = 0.9  # another result with this share of the best one's overlap makes it ambiguous


@options("estimator")
class LoopOptions:
    """How loops are looked for and checked."""

    loop_reach_m: Positive = 3.0
    """Distance up to which two key frames may see the same place, m."""
    loop_gate_probability: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-3
    """A closure is refused if only this share of all right ones misses the graph by more."""
    loop_min_gain: NonNegative = 2.0
    """Information about the relative pose that a closure must add online, nats."""
    loop_candidates: Count = 5
    """Older key frames that a new one is registered with, at most."""
    loop_support: Count = 3
    """Closures of the last 15 key frames that must be consistent before any is believed."""


@dataclass(frozen=True)
class LoopSearch:
    """Looks for loops, and checks them.

    Attributes
    ----------
    matcher, laser
        How scans are registered, and what took them.
    how
        The method's options.
    """

    matcher: ScanMatcher
    laser: Laser
    how: LoopOptions

    def candidates(self, means: Array, covariances: Array, alike: NDArray[np.bool_]) -> Ints:
        """Those of K relative poses that may close a loop, the nearest first.

        Parameters
        ----------
        means, covariances
            (K, 3), (K, 3, 3): a scan in the frame of each of K others, as believed.
        alike
            (K,) whether the scans look alike.
        """
        away_m, turn = np.hypot(means[:, 0], means[:, 1]), np.abs(means[:, 2])
        spread_m = np.linalg.eigvalsh(covariances[:, :2, :2])[:, 1]
        sigma_m, sigma_rad = np.sqrt(np.maximum([spread_m, covariances[:, 2, 2]], 0.0))
        widest = self.laser.fov_rad / 2.0  # at more, two views share less than half
        near = away_m - _REACH_SIGMAS * sigma_m < self.how.loop_reach_m
        facing = turn - _REACH_SIGMAS * sigma_rad < widest
        chosen = np.flatnonzero(near & facing & alike)
        order = np.argsort((away_m / self.how.loop_reach_m + turn / widest)[chosen], kind="stable")
        return np.asarray(chosen[order])

    def worthwhile(self, covariance: Array, noise: Array) -> bool:
        """Whether a measurement of this noise teaches enough about a motion of this covariance."""
        gain = np.linalg.slogdet(noise + covariance)[1] - np.linalg.slogdet(noise)[1]
        return bool(gain / 2.0 >= self.how.loop_min_gain)

    def register(
        self, scan: PreparedScan, other: PreparedScan, expected: Gaussian, rng: np.random.Generator
    ) -> Gaussian | None:
        """Pose of a scan in the frame of another, from several starts; None if they disagree."""
        found = [
            self.matcher.match(scan, other, Gaussian(start, _START), self.laser, rng)
            for start in _starts(expected)
        ]
        found = [match for match in found if not match.failed]
        if not found:
            return None
        best = max(found, key=lambda match: match.overlap)
        for match in found:
            x, y, turn = se2.between(best.motion.mean, match.motion.mean).tolist()
            same = math.hypot(x, y) < _SAME_M and abs(turn) < _SAME_RAD
            if not same and best.status == "ok" and match.overlap > _RIVAL * best.overlap:
                return None
        return best.motion

    def consistent(self, graph: PoseGraph, edges: list[Edge]) -> list[Edge]:
        """The largest set found in which each and each pair is consistent with the graph.

        Empty if another set, which contradicts it, has more than half as many members: a place
        may have a twin, and what follows will tell them apart.
        """
        off, S = graph.joint_innovation(edges)
        k = len(edges)
        agree = np.empty((k, k), dtype=bool)
        for a in range(k):
            for b in range(a + 1):
                both = np.unique(np.r_[3 * a : 3 * a + 3, 3 * b : 3 * b + 3])
                agree[a, b] = agree[b, a] = within_gate(
                    off[both], S[np.ix_(both, both)], self.how.loop_gate_probability
                )
        best = _largest_clique(agree, np.flatnonzero(agree.diagonal()))
        against = agree.diagonal() & ~agree[:, best].all(axis=1)
        rival = _largest_clique(agree, np.flatnonzero(against))
        if 2 * len(rival) > len(best):
            return []
        return [edges[i] for i in sorted(best)]


def _largest_clique(agree: NDArray[np.bool_], of: Ints) -> list[int]:
    """The largest set found, greedily from each of these, whose members all agree."""
    order = of[np.argsort(-agree[np.ix_(of, of)].sum(axis=1), kind="stable")].tolist()
    best: list[int] = []
    for seed in order:
        members = [seed]
        for other in order:
            if other != seed and agree[other, members].all():
                members.append(other)
        best = max(best, members, key=len)
    return best


def within_gate(off: Array, covariance: Array, probability: float) -> bool:
    """Whether more than this share of all innovations (D,) of this covariance are larger."""
    squared = float(off @ np.linalg.solve(covariance, off))
    return squared < float(chdtri(len(off), probability))


def signature(scan: PreparedScan) -> Array:
    """What a scan looks like, from any heading: logarithms (16,) of quantiles of its ranges."""
    return np.asarray(np.log(np.quantile(scan.ranges_m, _QUANTILES)), dtype=np.float64)


def look_alike(one: Array, others: Array) -> NDArray[np.bool_]:
    """Whether signatures (K, 16) are like another one (16,)."""
    return np.asarray(np.abs(others - one).mean(axis=1) < _ALIKE)


def _starts(expected: Gaussian) -> Array:
    """Starts (K, 3) that cover what the motion may be, the expected one first.

    They fill the ellipse of the position out to three standard deviations, each with the heading
    that goes with its place; there is one either way at least.
    """
    P = expected.covariance
    variances, axes = np.linalg.eigh(P[:2, :2])
    half = np.maximum(_REACH_SIGMAS * np.sqrt(np.maximum(variances, 0.0)), _START_M / 4.0)
    steps = np.clip(np.ceil(half / _START_M), 1, _MOST_STEPS).astype(int)
    grids = [np.linspace(-1.0, 1.0, 2 * n + 1) for n in steps]
    offsets = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, 2)
    away = np.hypot(offsets[:, 0], offsets[:, 1])
    order = np.argsort(away, kind="stable")
    moved = (offsets * half)[order[away[order] < 1.0 + 1e-9]] @ axes.T
    turns = moved @ np.linalg.solve(P[:2, :2] + 1e-12 * np.eye(2), P[:2, 2])
    turns = np.clip(turns, -_MOST_TURN_RAD, _MOST_TURN_RAD)
    return np.asarray(expected.mean + np.column_stack([moved, turns]), dtype=np.float64)
