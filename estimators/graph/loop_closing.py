"""Closing loops with a laser: which places to compare, and which closures to believe.

Where the graph knows a key frame's pose by an older one to some decimetres, their scans are
registered. Where it does not, all old places within its uncertainty are compared with the new
path's last metres (`estimators.graph.place_search`), and the best must be well ahead of any other.
Only what would teach something counts (the information gain of ila2010). A closure is held until
enough others agree with it, over the more metres of new path the less is known: the joint
innovation of each pair must pass a chi-squared test (joint compatibility, neira2001; the largest
set of pairwise consistent closures, mangelson2018).

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
from estimators.graph.place_search import (
    CELL_M,
    WIDE_CELL_M,
    Patch,
    agreement,
    find_places,
    make_patch,
    refine,
)
from estimators.graph.pose_graph import Edge, PoseGraph
from estimators.laser.icp import PreparedScan
from estimators.laser.scan_matching import ScanMatcher
from sim import se2
from sim.arrays import Array, Ints
from sim.options import Count, NonNegative, Positive, options
from sim.sensors import Laser

_REACH_SIGMAS = 3.0
_CERTAIN_M, _CERTAIN_RAD = 0.6, 0.2  # up to these, at three sigma, scans are registered at once
_OLD_M, _NEW_M = 3.0, 5.0  # path of a patch: either way of an old key frame, and behind a new one
_EVERY_M = 1.0  # of new path, places are looked for; of old path, one is compared
_MIN_FIT = 0.45  # share of a patch's points that must lie on walls of the other
_MIN_AGREEMENT, _MIN_SEEN = 0.75, 0.4  # of what both could see; and how much that must be
_AHEAD = 0.9  # the second best place must have less than this share of the best one's score
_KEPT_PATCHES, _BENT = 100, 0.1  # m and rad, of key frames within a patch
# That a chain of registrations may be off by, beyond what it claims, and all closures of it alike
SLACK = np.diag(np.square([0.15, 0.15, 0.04]))
_LEAST_SEEN = 60  # points of a patch; with fewer, farther beams are drawn too
_NEIGHBOURS = 8  # key frames either way
_SAME_M, _SAME_RAD = 0.15, 0.05  # closures that miss the graph alike


@options("estimator")
class LoopOptions:
    """How loops are looked for and checked."""

    loop_reach_m: Positive = 3.0
    """Distance up to which two key frames may see the same place, m."""
    loop_gate_probability: Annotated[float, Field(gt=0.0, le=1.0)] = 1e-3
    """A closure is refused if only this share of all right ones misses the graph by more."""
    loop_min_gain: NonNegative = 2.0
    """Information about the relative pose that a closure must add online, nats."""
    loop_candidates: Count = 2
    """Older key frames that a new one is registered with, at most."""
    loop_support: Count = 3
    """Closures of the last 15 key frames that must be consistent before any is believed."""
    loop_support_m: NonNegative = 4.0
    """New path over which closures must agree where the graph knew the place badly, m."""


@dataclass(frozen=True)
class Seen:
    """A key frame: its scan, and how far the robot had driven by then, m."""

    scan: PreparedScan | None
    driven_m: float


class Patches:
    """Patches of the path, drawn when they are asked for.

    Attributes
    ----------
    key_frames
        Of all nodes of the graph.
    """

    def __init__(self, mount: Array) -> None:
        self.key_frames: list[Seen] = []
        self._mount, self._cell_m = mount, CELL_M
        self._drawn: dict[int, tuple[Patch, Array]] = {}

    @property
    def driven_m(self) -> Array:
        """(N,) way to each node."""
        return np.array([seen.driven_m for seen in self.key_frames])

    def anchors(self) -> Ints:
        """Old key frames with a patch, `_EVERY_M` apart."""
        driven_m = self.driven_m
        inside = driven_m < driven_m[-1] - _OLD_M - _NEW_M
        steps = np.floor(driven_m / _EVERY_M)
        return np.flatnonzero(inside & (np.diff(steps, prepend=-1.0) > 0.0))

    def old(self, graph: PoseGraph, node: int) -> Patch:
        """What was seen about an old key frame; drawn again if the graph has bent it."""
        members, poses = self._members(graph, node, _OLD_M, _OLD_M)
        if node in self._drawn:
            patch, then = self._drawn.pop(node)
            if np.abs(se2.difference(poses, then)).max() > _BENT:
                patch = self._draw(members, poses)
                then = poses
        else:
            patch, then = self._draw(members, poses), poses
        if len(self._drawn) >= _KEPT_PATCHES:
            del self._drawn[next(iter(self._drawn))]
        self._drawn[node] = patch, then
        return patch

    def new(self, graph: PoseGraph, node: int) -> Patch:
        """What was seen on the way to a key frame."""
        return self._draw(*self._members(graph, node, _NEW_M, 0.0))

    def bend(self, graph: PoseGraph, node: int, back_m: float, ahead_m: float) -> Array:
        """What a patch may be bent by, as covariance (3, 3): a third of its random walk."""
        members, poses = self._members(graph, node, back_m, ahead_m)
        x, y, turn = np.sum([np.diag(graph.noise[i]) for i in members.tolist()], axis=0) / 3.0
        lever = float(np.mean(poses[:, :2] ** 2)) if len(poses) else 0.0
        across = (min(x, 1.0) + min(y, 1.0)) / 2.0 + lever * turn
        return np.diag([across, across, turn])

    def _members(
        self, graph: PoseGraph, node: int, back_m: float, ahead_m: float
    ) -> tuple[Ints, Array]:
        """Key frames of a patch, and their poses (M, 3) in its frame."""
        driven_m = self.driven_m - self.key_frames[node].driven_m
        members = np.flatnonzero((driven_m >= -back_m) & (driven_m <= ahead_m))
        members = members[members > 0]  # the start has no scan
        return members, se2.between(graph.poses[node], graph.poses[members]).reshape(-1, 3)

    def _draw(self, members: Ints, poses: Array) -> Patch:
        scans = [self.key_frames[i].scan for i in members.tolist()]
        seen = [np.zeros((0, 2)) if scan is None else scan.points for scan in scans]
        patch = make_patch(poses, seen, self._mount, self._cell_m)
        if len(patch.points) < _LEAST_SEEN and self._cell_m < WIDE_CELL_M and len(members) > 1:
            wide = make_patch(poses, seen, self._mount, WIDE_CELL_M)
            if len(wide.points) >= _LEAST_SEEN:  # a hall: from now on all are drawn so
                self._cell_m = WIDE_CELL_M
                self._drawn.clear()
                return wide
        return patch


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

    def candidates(self, means: Array, covariances: Array) -> Ints:
        """Those of K relative poses that may close a loop, the nearest first.

        Parameters
        ----------
        means, covariances
            (K, 3), (K, 3, 3): a scan in the frame of each of K others, as believed.
        """
        away_m, turn = np.hypot(means[:, 0], means[:, 1]), np.abs(means[:, 2])
        sigma_m, sigma_rad = spreads(covariances)
        widest = self.laser.fov_rad / 2.0  # at more, two views share less than half
        near = away_m - _REACH_SIGMAS * sigma_m < self.how.loop_reach_m
        chosen = np.flatnonzero(near & (turn - _REACH_SIGMAS * sigma_rad < widest))
        order = np.argsort((away_m / self.how.loop_reach_m + turn / widest)[chosen], kind="stable")
        return np.asarray(chosen[order])

    def worthwhile(self, covariance: Array, noise: Array) -> bool:
        """Whether a measurement of this noise teaches enough about a motion of this covariance."""
        gain = np.linalg.slogdet(noise + covariance)[1] - np.linalg.slogdet(noise)[1]
        return bool(gain / 2.0 >= self.how.loop_min_gain)

    def find_place(
        self, graph: PoseGraph, patches: Patches, node: int, anchors: Ints
    ) -> tuple[int, Gaussian] | None:
        """The old place, of all within the uncertainty, where the newest key frame is.

        None if there is none, or two that differ explain the last metres about as well.

        Returns
        -------
        tuple
            The old key frame, and the newest in its frame.
        """
        motions, covariances = graph.newest_from(anchors, exact=True)
        new = patches.new(graph, node)
        found: list[tuple[float, int, Array]] = []
        for anchor, mean, P in zip(anchors.tolist(), motions, covariances, strict=True):
            expected = Gaussian(mean, P + SLACK)
            old = patches.old(graph, anchor)
            if old.cell_m != new.cell_m:
                return None  # this is where the cells become wider
            for place in find_places(new, old, expected, self.how.loop_reach_m, _MIN_FIT):
                fitting, seen = agreement(new, old, place.pose)
                if fitting > _MIN_AGREEMENT and seen > _MIN_SEEN:
                    found.append((place.score * fitting, anchor, place.pose))
        if not found:
            return None
        score, anchor, pose = max(found, key=lambda one: one[0])
        at = se2.compose(graph.poses[anchor], pose)
        for rival, other, its_pose in found:
            if rival > _AHEAD * score:
                off = se2.between(at, se2.compose(graph.poses[other], its_pose))
                if math.hypot(off[0], off[1]) > 1.0 or abs(off[2]) > 0.3:
                    return None
        refined = refine(new, patches.old(graph, anchor), pose)
        bend = patches.bend(graph, anchor, _OLD_M, _OLD_M) + patches.bend(graph, node, _NEW_M, 0.0)
        return anchor, Gaussian(refined.mean, refined.covariance + bend)

    def on_path(self, path: Patch, scan: PreparedScan, expected: Gaussian) -> Gaussian | None:
        """Pose of a scan in the frame of a patch, near where it is expected; None if unclear."""
        new = make_patch(np.zeros((1, 3)), [scan.points], self.laser.mount.pose, path.cell_m)
        found = find_places(new, path, expected, self.how.loop_reach_m, _MIN_FIT)
        if not found or (len(found) > 1 and found[1].score > _AHEAD * found[0].score):
            return None
        fitting, seen = agreement(new, path, found[0].pose)
        if fitting < _MIN_AGREEMENT or seen < _MIN_SEEN:
            return None
        return refine(new, path, found[0].pose)

    def fits(self, new: Patch, old: Patch, pose: Array) -> tuple[float, float]:
        """Share of points that fit, of those that either patch sees, and share that is seen."""
        return agreement(new, old, pose)

    def supported(self, graph: PoseGraph, among: list[Edge], edges: list[Edge]) -> list[Edge]:
        """Those edges that miss the graph by as much as others do, with both ends near theirs."""
        first, second = np.array([(e.first, e.second) for e in among], int).reshape(-1, 2).T
        measured = np.reshape([e.motion.mean for e in among], (-1, 3))
        ends = se2.compose(graph.poses[first], measured)
        off = se2.difference(ends, graph.poses[second])
        kept = []
        for k in range(len(among) - len(edges), len(among)):
            near = np.abs(first - first[k]) <= _NEIGHBOURS
            near &= (np.abs(second - second[k]) <= _NEIGHBOURS) & (second != second[k])
            apart = se2.difference(off, off[k])
            same = np.hypot(apart[:, 0], apart[:, 1]) < _SAME_M
            if np.any(near & same & (np.abs(apart[:, 2]) < _SAME_RAD)):
                kept.append(among[k])
        return kept

    def consistent(self, graph: PoseGraph, edges: list[Edge]) -> list[Edge]:
        """The largest set found in which each and each pair is consistent with the graph.

        Empty if another set, which contradicts it, has more than half as many members: a place
        may have a twin, and what follows will tell them apart.
        """
        off, S = graph.joint_innovation(edges)
        k = len(edges)
        S += np.tile(SLACK, (k, k))
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


def spreads(covariances: Array) -> tuple[Array, Array]:
    """Standard deviations (K,) of position, m, where it is widest, and of heading."""
    spread_m = np.linalg.eigvalsh(covariances[:, :2, :2])[:, 1]
    return np.sqrt(np.maximum(spread_m, 0.0)), np.sqrt(np.maximum(covariances[:, 2, 2], 0.0))


def certain(covariance: Array) -> bool:
    """Whether a relative pose is known well enough to register two scans from there."""
    sigma_m, sigma_rad = spreads(covariance[None])
    near = _REACH_SIGMAS * sigma_m < _CERTAIN_M
    return bool((near & (_REACH_SIGMAS * sigma_rad < _CERTAIN_RAD))[0])
