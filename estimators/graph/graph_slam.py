"""Graph SLAM with a laser: key frames tied by registrations, and loops that close.

The nodes are key frames, taken by distance and turn (lu1997, grisetti2010). Consecutive ones are
tied by the wheels and by the registration of their scans, others by closures
(`estimators.graph.loop_closing`). After each set of closures that is believed, all poses x minimise

    |x_0 - m|^2_P + sum |between(x_i, x_j) - z_ij|^2_R + sum over closures rho(|...|^2_R),

with rho the bounded loss of dynamic covariance scaling (`estimators.graph.least_squares`). `finish`
registers all key frames that the solved graph shows to be near each other, and solves again.

As in `estimators.laser.ekf_icp` each scan is modelled as seen from an apparent pose, whose error
enters all its registrations. The nodes are the apparent poses: between them registrations have the
share 1 - `shared_noise` of their covariance R and are independent, and base_link is off its
apparent pose by `shared_noise` R / 2. Closures have all of R: from farther apart two scans show
other walls, and share less of their errors.

Sources: Lu and Milios, Globally consistent range scan alignment for environment mapping, Autonomous
Robots 4, 1997; Grisetti et al., A tutorial on graph-based SLAM, ITSM 2, 2010.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from estimators.base import Belief, Estimate, Prior
from estimators.gaussian import STILL, Gaussian, stack
from estimators.graph.landmark_drive import FLOOR, loosen
from estimators.graph.loop_closing import (
    N_QUANTILES,
    LoopOptions,
    LoopSearch,
    look_alike,
    signature,
    within_gate,
)
from estimators.graph.pose_graph import Edge, PoseGraph
from estimators.laser.icp import PreparedScan
from estimators.laser.scan_matching import (
    FAILED,
    KeyFrameOptions,
    Match,
    MatcherOptions,
    ScanMatcher,
)
from estimators.wheels import EncoderTickOptions, WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import require
from sim.options import Positive, Probability, options
from sim.recording import Frame

_PATIENCE = 2  # scans in a row that may fail before the newest becomes a key frame
_HELD_FRAMES, _MOST_HELD = 15, 15  # how long closures wait for others, in key frames; and how many
_CONSIDERED = 8  # times the candidates whose uncertainty is looked at closely
_ONLINE_TOLERANCE = 1e-4  # of a solution that the next closure refines


@dataclass(frozen=True)
class _Placed:
    """A Frame: its stamp, its key frame, and base_link in the frame of that."""

    stamp: float
    node: int
    in_key: Gaussian


@options("estimator")
class GraphSlamOptions(EncoderTickOptions, KeyFrameOptions, MatcherOptions, LoopOptions):
    """Options of graph SLAM."""

    max_gap_m: Positive | None = 1.5
    """Leave out a line of which no three points in a row lie this near each other, m: door posts
    far behind one another do not make a wall. null: all lines are kept."""
    gate_probability: Probability | None = 1e-9
    """Leave a registration with the key frame out if only this share of all should differ more from
    what the wheels say; null: all are used."""
    shared_noise: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.75
    """Share of a registration's covariance that comes from the scans' own errors, half from
    each."""
    robust_sigma: Positive = 5.0
    """Mahalanobis distance from which on a closure counts less."""
    revisions: Annotated[int, Field(ge=0)] = 2
    """Searches for further closures in `finish`, each followed by a solution."""


class GraphSlam(GraphSlamOptions):
    """Key frames, closures, and a sparse least-squares solution whenever a loop closes.

    Notes
    -----
    Where the registration with the key frame fails, the wheels go on; after two such scans in a row
    the newest becomes a key frame. Directions that the scans do not constrain are left to the
    wheels.

    `graph` holds the key frames and closures so far.

    Belief extras: `registration_status`, `status` if a scan was not used, `closures`, the number
    believed so far.
    """

    needs = frozenset({"laser"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose; the first scan becomes a key frame."""
        self._laser, self._rng = prior.require_laser(self.laser, "graph_slam"), rng
        self._matcher = ScanMatcher(self, self.max_gap_m)
        self._search = LoopSearch(self._matcher, self._laser, self)
        start = prior.require_start("graph_slam")
        self._wheels = WheelPrediction(self, prior.robot.track_m)
        self.graph = PoseGraph(Gaussian(start.mean, start.covariance + FLOOR), self.robust_sigma)
        self._scans: list[PreparedScan | None] = [None]  # node 0 is the start
        self._signatures = np.full((1, N_QUANTILES), np.inf)
        self._held: list[Edge] = []  # closures that wait for others
        self._in_key = self._by_wheels = STILL  # base_link in the newest node's frame
        self._failures = 0
        self._path: list[_Placed] = []
        self._stamps, self._now = [math.nan], math.nan

    @property
    def node_stamps(self) -> Array:
        """(N,) s of the graph's nodes; NaN of the start."""
        return np.array(self._stamps)

    def step(self, frame: Frame) -> Belief:
        """Move by the wheels; register a scan with the key frame; at a new one look for loops."""
        motion = loosen(self._wheels.predict(frame))
        self._in_key, self._by_wheels = self._in_key.then(motion), self._by_wheels.then(motion)
        self._now = frame.stamp
        extras: dict[str, Any] = {}
        reading = frame.readings.get(self.laser)
        if reading is not None:
            status = self._see(self._matcher.prepare(reading["ranges_m"], self._laser))
            extras["registration_status"] = status
            if status not in ("first", "ok", "degenerate"):
                extras["status"] = status
        extras["closures"] = len(self.graph.closures)
        self._path.append(_Placed(frame.stamp, len(self.graph) - 1, self._in_key))
        belief = _symmetric(self.graph.newest.then(self._in_key))
        return Belief(belief.mean, belief.covariance, extras)

    def finish(self) -> Estimate:
        """All Frames on the graph as the whole drive shows it.

        Raises
        ------
        InputError
            Before the first Frame.
        """
        require(self._path, "the estimator has seen no Frame; step before finish")
        for _ in range(self.revisions):
            closures = self._revised_closures()
            if not closures:
                break
            self.graph.close(closures)
        keys = [
            Gaussian(*key) for key in zip(self.graph.poses, self.graph.marginals(), strict=True)
        ]
        path = [_symmetric(keys[placed.node].then(placed.in_key)) for placed in self._path]
        stamps = np.array([placed.stamp for placed in self._path])
        return Estimate(stamps, *stack(path), kind="revised")

    def _see(self, scan: PreparedScan | None) -> str:
        """Register a scan with the newest key frame; what came of it."""
        if scan is None:
            return "empty"
        key = self._scans[-1]
        if key is None:
            self._add_key_frame(scan, None)
            return "first"
        found = self._matcher.match(scan, key, self._in_key, self._laser, self._rng)
        status = found.status if found.failed or self._explained(found) else "gated"
        if status in (*FAILED, "gated"):
            self._failures += 1
            if self._failures >= _PATIENCE:
                self._add_key_frame(scan, None)
            return status
        self._failures = 0
        of_base = _scaled(found.motion, 1.0 - self.shared_noise / 2.0)
        self._in_key = dataclasses.replace(found, motion=of_base).complete(self._in_key)
        if self.left_key_frame(found.motion.mean):
            own_noise = self.shared_noise / 2.0 * found.known_covariance
            self._add_key_frame(scan, found.motion)
            self._in_key = Gaussian(STILL.mean, own_noise)
        return status

    def _explained(self, found: Match) -> bool:
        """Whether a registration differs from what was expected by no more than it may."""
        if self.gate_probability is None or not len(found.held):
            return True
        off = found.held @ se2.difference(found.motion.mean, self._in_key.mean)
        spread = found.held @ (found.motion.covariance + self._in_key.covariance) @ found.held.T
        return within_gate(off, spread, self.gate_probability)

    def _add_key_frame(self, scan: PreparedScan, registered: Gaussian | None) -> None:
        """Append a node, tied by the wheels and by its registration, and look for loops."""
        measured = [Gaussian(self._by_wheels.mean, self._by_wheels.covariance + FLOOR)]
        if registered is not None:
            measured.append(_scaled(registered, 1.0 - self.shared_noise))
        self.graph.add(self._in_key.mean, measured)
        self._scans.append(scan)
        self._stamps.append(self._now)
        self._signatures = np.vstack([self._signatures, signature(scan)])
        self._in_key = self._by_wheels = STILL
        self._failures = 0
        self._close_loops()

    def _close_loops(self) -> None:
        """Hold the newest key frame's closures; believe those that enough others agree with."""
        oldest = len(self.graph) - _HELD_FRAMES
        self._held = [edge for edge in self._held if edge.second >= oldest]
        found = self.propose_closures()
        if not found:
            return
        self._held = [*self._held, *found][-_MOST_HELD:]
        agreed = self._search.consistent(self.graph, self._held)
        believed = sum(e.second >= oldest for e in self.graph.closures[-self.loop_support :])
        if agreed and len(agreed) + believed >= self.loop_support:
            self._held = [edge for edge in self._held if edge not in agreed]
            self.graph.close(agreed, _ONLINE_TOLERANCE)

    def propose_closures(self) -> list[Edge]:
        """Closures of the newest key frame that pass each on its own."""
        newest = len(self.graph) - 1
        motions, covariances = self.graph.newest_from(np.arange(newest - 1), exact=False)
        nodes = self._candidates(newest, motions, covariances)
        return self._closures(newest, nodes, *self.graph.newest_from(nodes, exact=True))

    def _revised_closures(self) -> list[Edge]:
        """More closures between key frames that the graph shows to be near each other."""
        graph = self.graph
        known = {(edge.first, edge.second) for edge in graph.closures}
        graph.marginals()
        found = []
        for node in range(2, len(graph)):
            motions = se2.between(graph.poses[: node - 1], graph.poses[node])
            nodes = self._candidates(node, motions, np.zeros((len(motions), 3, 3)))
            nodes = np.array([i for i in nodes.tolist() if (i, node) not in known], np.int64)
            if len(nodes):
                found += self._closures(node, nodes, *graph.seen_from(nodes, node))
        return found

    def _candidates(self, node: int, motions: Array, covariances: Array) -> Ints:
        """Those of nodes 0 ... K - 1 that may close a loop with another, by its pose in theirs."""
        alike = look_alike(self._signatures[node], self._signatures[: len(motions)])
        nodes = self._search.candidates(motions, covariances, alike)
        return nodes[: _CONSIDERED * self.loop_candidates]

    def _closures(self, node: int, nodes: Ints, motions: Array, covariances: Array) -> list[Edge]:
        """Register a node with the first few of K others that would teach enough."""
        typical = self.graph.noise[node]
        worth = [self._search.worthwhile(P, typical) for P in covariances]
        found = [
            self._closure(int(nodes[k]), node, Gaussian(motions[k], covariances[k]))
            for k in np.flatnonzero(worth)[: self.loop_candidates]
        ]
        return [edge for edge in found if edge is not None]

    def _closure(self, first: int, second: int, expected: Gaussian) -> Edge | None:
        """Register two key frames; None if that fails or misses the graph by too much."""
        scan, other = self._scans[second], self._scans[first]
        if scan is None or other is None:
            return None
        found = self._search.register(scan, other, expected, self._rng)
        if found is None:
            return None
        off = se2.difference(found.mean, expected.mean)
        spread = expected.covariance + found.covariance
        explained = within_gate(off, spread, self.loop_gate_probability)
        if not (explained and self._search.worthwhile(expected.covariance, found.covariance)):
            return None
        return Edge(first, second, found)


def _scaled(motion: Gaussian, share: float) -> Gaussian:
    return Gaussian(motion.mean, share * motion.covariance)


def _symmetric(belief: Gaussian) -> Gaussian:
    return Gaussian(belief.mean, (belief.covariance + belief.covariance.T) / 2.0)
