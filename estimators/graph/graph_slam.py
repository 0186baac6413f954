"""Graph SLAM with a laser: key frames tied by registrations, and loops that close.

The nodes are key frames, taken by distance and turn (lu1997, grisetti2010). Consecutive ones are
tied by the wheels and by the registration of their scans, others by closures
(`estimators.graph.loop_closing`). What wheels and registrations are believed to err by follows from
how they disagree (`estimators.graph.residual_noise`), so that no option is needed for another robot
or building. After each set of closures that is believed, all poses x minimise

    |x_0 - m|^2_P + sum |between(x_i, x_j) - z_ij|^2_R + sum over closures rho(|...|^2_R),

with rho the bounded loss of dynamic covariance scaling (`estimators.graph.least_squares`). A
closure is withdrawn when the others deny it, and a loop when the path since then does not fit the
map that it made. `finish` registers all key frames that the solved graph shows to be near each
other, and solves again.

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
    SLACK,
    LoopOptions,
    LoopSearch,
    Patches,
    Seen,
    certain,
    within_gate,
)
from estimators.graph.pose_graph import Edge, PoseGraph, stacked
from estimators.graph.residual_noise import ResidualNoise
from estimators.laser.icp import PreparedScan
from estimators.laser.scan_matching import (
    FAILED,
    KeyFrameOptions,
    Match,
    MatcherOptions,
    ScanMatcher,
)
from estimators.lost import Unexplained
from estimators.wheels import EncoderTickOptions, WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import require
from sim.options import Positive, Probability, options
from sim.recording import Frame

_PATIENCE = 2  # scans in a row that may fail before the newest becomes a key frame
_HELD_M, _MOST_HELD = 15.0, 24  # how long closures wait for others, of path; and how many
_CONSIDERED = 8  # times the candidates whose uncertainty is looked at closely
_SEARCH_M = 1.0  # of path between two searches for places, and two checks of the map
_MOST_ANCHORS = 80
_FLOOR_SIGMA, _FLOOR_SHARE = 0.02, 0.05  # of wheels that scans deny: m and rad; and of the way
# Of scans that share little, some are registered wrongly: a tenth of those that share 0.65 in a
# hall of tables and chairs, by 0.2 m
_LEAST_OVERLAP, _OVERLAP, _WRONG = 0.7, 0.8, np.diag(np.square([0.3, 0.3, 0.06]))
_DENIED, _SEEN, _DENIALS = 0.5, 0.3, 4  # share that fits, and is seen; checks in a row
_SLACK_M = 10.0  # path of a chain that may be off by all of the slack
_FINE = np.diag(np.square([0.03, 0.03, 0.01]))  # what finish looks for, whatever the graph claims
_MISFIT_M, _MISFIT_RAD, _HELD_BY_M = 0.08, 0.025, 3.0  # closures that others replace
_WITHDRAWN = 2.0  # times robust_sigma, by which a closure misses the graph that lets go of it
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
    gate_probability: Probability | None = 1e-6
    """Leave a registration out if only this share of all should differ more from what the wheels
    say, which are never trusted beyond a twentieth of the way; null: all are used."""
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

    Belief extras: `registration_status`, `status` if a scan was not used, `lost`, `closures`, the
    number believed so far.
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
        self._noise = ResidualNoise()
        self._patches = Patches(self._laser.mount.pose)
        self._patches.key_frames.append(Seen(None, 0.0))  # node 0 is the start
        self._held: list[Edge] = []  # closures that wait for others
        self._groups: list[int] = []  # first key frames of closures where little was known
        self._in_key = self._by_wheels = STILL  # base_link in the newest node's frame
        self._last_tie: Gaussian | None = None  # of the newest key frame to the one before
        self._failures = self._denials = 0
        self._unexplained = Unexplained()
        self._searched_m = self._checked_m = 0.0
        self._path: list[_Placed] = []
        self._stamps, self._now = [math.nan], math.nan

    @property
    def map(self) -> dict[str, Any]:
        """The graph: `stamps` (N,) s of its nodes, NaN of the start, and K closures.

        Their nodes are `closures` (K, 2); `motions` (K, 3) and `covariances` (K, 3, 3) of the
        second in the frame of the first.
        """
        first, second, motions, covariances = stacked(self.graph.closures)
        return {
            "stamps": np.array(self._stamps),
            "closures": np.column_stack([first, second]),
            "motions": motions,
            "covariances": covariances,
        }

    def step(self, frame: Frame) -> Belief:
        """Move by the wheels; register a scan with the key frame; at a new one look for loops."""
        motion = loosen(self._wheels.predict(frame))
        self._in_key = self._in_key.then(self._noise.corrected(motion))
        self._by_wheels = self._by_wheels.then(motion)
        self._now = frame.stamp
        extras: dict[str, Any] = {}
        reading = frame.readings.get(self.laser)
        if reading is not None:
            scan = self._matcher.prepare(
                reading["ranges_m"], self._laser, motion.mean, frame.duration_s
            )
            status = self._see(scan)
            extras["registration_status"] = status
            if status not in ("first", "ok", "degenerate"):
                extras["status"] = status
            if scan is not None:  # without returns nothing denies the pose
                self._unexplained.note(frame.stamp, "status" in extras, 1)
        extras["closures"] = len(self.graph.closures)
        self._path.append(_Placed(frame.stamp, len(self.graph) - 1, self._in_key))
        belief = _symmetric(self.graph.newest.then(self._in_key))
        if reading is not None:
            extras["lost"] = self._unexplained.lost(frame.stamp, belief.covariance)
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
            self._close(closures)
        self._drop_misfits()
        keys = [
            Gaussian(*key) for key in zip(self.graph.poses, self.graph.marginals(), strict=True)
        ]
        path = [_symmetric(keys[placed.node].then(placed.in_key)) for placed in self._path]
        stamps = np.array([placed.stamp for placed in self._path])
        return Estimate(stamps, *stack(path), kind="revised", map=self.map)

    def _drop_misfits(self) -> None:
        """Let go of closures that the solved graph misses, where others hold its place."""
        graph, closures = self.graph, self.graph.closures
        first, second = np.array([(e.first, e.second) for e in closures], int).reshape(-1, 2).T
        measured = np.reshape([e.motion.mean for e in closures], (-1, 3))
        off = se2.between(measured, se2.between(graph.poses[first], graph.poses[second]))
        fits = (np.hypot(off[:, 0], off[:, 1]) < _MISFIT_M) & (np.abs(off[:, 2]) < _MISFIT_RAD)
        driven_m = self._patches.driven_m
        held = np.abs(driven_m[second][:, None] - driven_m[second[fits]]) < _HELD_BY_M
        kept = fits | ~held.any(axis=1)
        if not kept.all():
            graph.keep([e for e, good in zip(closures, kept, strict=True) if good])

    def _see(self, scan: PreparedScan | None) -> str:
        """Register a scan with the newest key frame; what came of it."""
        if scan is None:
            return "empty"
        key = self._patches.key_frames[-1].scan
        if key is None:
            self._add_key_frame(scan, None)
            return "first"
        found = _doubted(self._match(scan, key, self._in_key))
        if found.failed or not self._explained(found):
            on_path = self._match_path(scan)
            self._failures += 1
        else:
            on_path, self._failures = None, 0
        found = on_path or found
        status = found.status if found.failed or self._explained(found) else "gated"
        unused = status in (*FAILED, "gated")
        moved = self._in_key if unused else found.complete(self._in_key)
        leaves = self._failures >= _PATIENCE or self.left_key_frame(moved.mean)
        leaves |= not unused and found.overlap < _LEAST_OVERLAP
        if found.status == "ok" and (leaves or status == "gated"):
            self._noise.compare_wheels(self._by_wheels, found.motion)
        if unused:
            if leaves:
                self._add_key_frame(scan, None)
            return status
        # a patch of path knows a place to centimetres: where the wheels know more, they count
        shared = self.shared_noise if on_path is None else 0.0
        of_base = _scaled(found.motion, 1.0 - shared / 2.0)
        seen = dataclasses.replace(found, motion=of_base).complete(self._in_key)
        self._in_key = seen if on_path is None else self._in_key.fuse(seen)
        if leaves:
            own_noise = shared / 2.0 * found.known_covariance
            # in directions that the scans do not hold, the mean is that of the wheels
            tie = _scaled(Gaussian(moved.mean, found.motion.covariance), 1.0 - shared)
            self._compare_scans(scan, tie if status == "ok" else None)
            self._add_key_frame(scan, tie)
            self._in_key = Gaussian(STILL.mean, own_noise)
        return status

    def _match_path(self, scan: PreparedScan) -> Match | None:
        """Register a scan with the last metres of path, where one key frame shows too little."""
        newest = len(self.graph) - 1
        guess = Gaussian(self._in_key.mean, self._in_key.covariance + self._doubt())
        place = self._search.on_path(self._patches.new(self.graph, newest), scan, guess)
        if place is None:
            return None
        return Match(place, "ok", np.eye(3), np.zeros((3, 3)), 1.0)

    def _match(self, scan: PreparedScan, other: PreparedScan, guess: Gaussian) -> Match:
        """Register two scans, with the covariance that registrations have shown."""
        found = self._matcher.match(scan, other, guess, self._laser, self._rng)
        if found.failed:
            return found
        motion = _scaled(found.motion, self._noise.of_scans)
        return dataclasses.replace(found, motion=motion)

    def _compare_scans(self, scan: PreparedScan, tie: Gaussian | None) -> None:
        """Register a new key frame with the one before the last too, and see how far it is off."""
        first, self._last_tie = self._last_tie, tie
        if first is None or tie is None:
            return
        other = self._patches.key_frames[-2].scan
        if other is None:
            return
        around = first.then(tie)
        found = self._matcher.match(scan, other, around, self._laser, self._rng)
        if found.status == "ok":
            own = 1.0 / self._noise.of_scans
            direct = _scaled(found.motion, 1.0 - self.shared_noise)
            self._noise.compare_scans(direct, _scaled(first, own), _scaled(tie, own))

    def _explained(self, found: Match) -> bool:
        """Whether a registration differs from what was expected by no more than it may."""
        if self.gate_probability is None or not len(found.held):
            return True
        # against the wheels since the key frame too: a person who walks along with the robot drags
        # one registration after the other a little
        for expected in (self._in_key, self._noise.corrected(self._by_wheels)):
            off = found.held @ se2.difference(found.motion.mean, expected.mean)
            spread = found.motion.covariance + expected.covariance + self._doubt()
            if not within_gate(off, found.held @ spread @ found.held.T, self.gate_probability):
                return False
        return True

    def _doubt(self) -> Array:
        """Covariance (3, 3) below which wheels are not trusted where scans deny them."""
        x, y, turn = self._by_wheels.mean.tolist()
        sigma = _FLOOR_SIGMA + _FLOOR_SHARE * (math.hypot(x, y) + abs(turn))
        return np.diag([sigma**2] * 3)

    def _add_key_frame(self, scan: PreparedScan, registered: Gaussian | None) -> None:
        """Append a node, tied by the wheels and by its registration, and look for loops."""
        by_wheels = self._noise.corrected(self._by_wheels, alone=registered is None)
        measured = [Gaussian(by_wheels.mean, by_wheels.covariance + FLOOR)]
        if registered is not None:
            measured.append(registered)
        else:
            self._last_tie = None
        driven_m = self._patches.key_frames[-1].driven_m + math.hypot(*self._in_key.mean[:2])
        self.graph.add(self._in_key.mean, measured)
        self._patches.key_frames.append(Seen(scan, driven_m))
        self._stamps.append(self._now)
        self._in_key = self._by_wheels = STILL
        self._failures = 0
        self._close_loops()

    def _driven_m(self, node: int) -> float:
        return self._patches.key_frames[node].driven_m

    def _close_loops(self) -> None:
        """Hold the newest key frame's closures; believe those that enough others agree with."""
        now_m = self._driven_m(-1)
        self._held = [e for e in self._held if now_m - self._driven_m(e.second) < _HELD_M]
        found = self.propose_closures()
        if not found:
            return
        self._held = [*self._held, *found][-_MOST_HELD:]
        agreed = self._search.consistent(self.graph, self._held)
        if not agreed:
            return
        ends_m = [self._driven_m(edge.second) for edge in agreed]
        needed_m = max(edge.support_m for edge in agreed)
        believed = 0
        for edge in self.graph.closures[-self.loop_support :]:
            believed += now_m - self._driven_m(edge.second) < _HELD_M / 2.0
        enough = len({e.second for e in agreed}) + believed >= self.loop_support
        if enough and max(ends_m) - min(ends_m) >= needed_m:
            self._held = [edge for edge in self._held if edge not in agreed]
            if needed_m > 0.0:
                self._groups.append(min(edge.second for edge in agreed))
            self._close(agreed, _ONLINE_TOLERANCE)

    def _close(self, edges: list[Edge], tolerance: float = 1e-9) -> None:
        """Take closures in, and let go of those that the others deny."""
        self.graph.close(edges, tolerance)
        far = self.graph.misses() > _WITHDRAWN * self.robust_sigma
        if far.any():
            kept = [e for e, off in zip(self.graph.closures, far, strict=True) if not off]
            self.graph.keep(kept, tolerance)

    def _check_map(self, near: Ints) -> None:
        """Withdraw the last loop where the path since then does not fit the map that it made."""
        now_m = self._driven_m(-1)
        if not self._groups or now_m - self._checked_m < _SEARCH_M:
            return
        self._checked_m, newest = now_m, len(self.graph) - 1
        anchors = self._patches.anchors()
        anchors = anchors[np.isin(anchors, near)]
        if not len(anchors):
            return
        anchor = int(anchors[0])
        motions = se2.between(self.graph.poses[anchors], self.graph.poses[newest])
        anchor = int(anchors[np.argmin(np.hypot(motions[:, 0], motions[:, 1]))])
        pose = se2.between(self.graph.poses[anchor], self.graph.poses[newest])
        new, old = self._patches.new(self.graph, newest), self._patches.old(self.graph, anchor)
        fitting, seen = self._search.fits(new, old, pose)
        if seen < _SEEN or old.cell_m != new.cell_m:
            return
        self._denials = self._denials + 1 if fitting < _DENIED else 0
        if self._denials >= _DENIALS:
            since = self._groups.pop()
            self.graph.keep([e for e in self.graph.closures if e.second < since])
            self._denials, self._held = 0, []

    def propose_closures(self) -> list[Edge]:
        """Closures of the newest key frame that pass each on its own."""
        newest = len(self.graph) - 1
        motions, covariances = self.graph.newest_from(np.arange(newest - 1), exact=False)
        nodes = self._search.candidates(motions, covariances)
        if not len(nodes):
            return []
        nearest = nodes[: _CONSIDERED * self.loop_candidates]
        motions, covariances = self.graph.newest_from(nearest, exact=True)
        known = np.array([certain(P) for P in covariances])
        if known.any():
            self._check_map(nearest[known])
        typical = self.graph.noise[newest]
        worth = np.array([self._search.worthwhile(P, typical) for P in covariances])
        found = self._closures(newest, nearest[known], motions[known], covariances[known])
        now_m = self._driven_m(-1)
        if found or not worth.any() or now_m - self._searched_m < _SEARCH_M:
            return found
        self._searched_m = now_m
        anchors = self._patches.anchors()
        anchors = anchors[np.isin(anchors, nodes)][:_MOST_ANCHORS]
        return self._closures_of_place(newest, anchors, 0.0 if known.all() else self.loop_support_m)

    def _closures_of_place(self, newest: int, anchors: Ints, support_m: float) -> list[Edge]:
        """Where the newest key frame is, of all places that it may be at."""
        found = self._search.find_place(self.graph, self._patches, newest, anchors)
        if found is None:
            return []
        anchor, place = found
        at = se2.compose(self.graph.poses[anchor], place.mean)
        old = np.flatnonzero(self._patches.driven_m < self._driven_m(-1) - 8.0)
        motions = se2.between(self.graph.poses[old], at)
        facing = np.abs(motions[:, 2]) < 0.8
        order = np.argsort(np.where(facing, np.hypot(motions[:, 0], motions[:, 1]), np.inf))
        edges = []
        for k in order[: self.loop_candidates].tolist():
            expected = Gaussian(motions[k], place.covariance)
            edge = self._closure(int(old[k]), newest, expected, 0.0, support_m)
            edges += [edge] if edge is not None else []
        return edges or [Edge(anchor, newest, place, support_m)]

    def _revised_closures(self) -> list[Edge]:
        """More closures between key frames that the graph shows to be near each other."""
        graph = self.graph
        known = {(edge.first, edge.second) for edge in graph.closures}
        graph.marginals()
        found: list[Edge] = []
        for node in range(2, len(graph)):
            motions = se2.between(graph.poses[: node - 1], graph.poses[node])
            nodes = self._search.candidates(motions, np.zeros((len(motions), 3, 3)))
            nodes = nodes[: _CONSIDERED * self.loop_candidates]
            nodes = np.array([i for i in nodes.tolist() if (i, node) not in known], np.int64)
            if len(nodes):
                motions, covariances = graph.seen_from(nodes, node)
                sure = np.array([certain(P) for P in covariances])
                found += self._closures(node, nodes[sure], motions[sure], covariances[sure] + _FINE)
        return self._search.supported(graph, [*graph.closures, *found], found)

    def _closures(self, node: int, nodes: Ints, motions: Array, covariances: Array) -> list[Edge]:
        """Register a node with the first few of K others that would teach enough."""
        typical = self.graph.noise[node]
        worth = [self._search.worthwhile(P, typical) for P in covariances]
        found = [
            self._closure(int(nodes[k]), node, Gaussian(motions[k], covariances[k]))
            for k in np.flatnonzero(worth)[: self.loop_candidates]
        ]
        return [edge for edge in found if edge is not None]

    def _closure(
        self,
        first: int,
        second: int,
        expected: Gaussian,
        min_gain: float | None = None,
        support_m: float = 0.0,
    ) -> Edge | None:
        """Register two key frames; None if that fails or misses the graph by too much."""
        scan, other = (self._patches.key_frames[node].scan for node in (second, first))
        if scan is None or other is None:
            return None
        found = self._match(scan, other, expected)
        if found.failed:
            return None
        off = se2.difference(found.motion.mean, expected.mean)
        noise = found.motion.covariance
        apart_m = self._driven_m(second) - self._driven_m(first)
        spread = expected.covariance + noise + min(apart_m / _SLACK_M, 1.0) * SLACK
        if not within_gate(off, spread, self.loop_gate_probability):
            return None
        if min_gain is None and not self._search.worthwhile(expected.covariance, noise):
            return None
        mean = found.motion.mean - found.loose @ off  # nothing is known of it, so let it be
        return Edge(first, second, Gaussian(mean, noise), support_m)


def _doubted(found: Match) -> Match:
    """Trust a registration less if the scans share little: ties have no loss that bounds them."""
    doubt = max(_OVERLAP - found.overlap, 0.0) ** 2 * _WRONG
    motion = Gaussian(found.motion.mean, found.motion.covariance + doubt)
    return found if found.failed else dataclasses.replace(found, motion=motion)


def _scaled(motion: Gaussian, share: float) -> Gaussian:
    return Gaussian(motion.mean, share * motion.covariance)


def _symmetric(belief: Gaussian) -> Gaussian:
    return Gaussian(belief.mean, (belief.covariance + belief.covariance.T) / 2.0)
