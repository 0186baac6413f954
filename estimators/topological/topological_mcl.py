"""Monte Carlo localization among the nodes of a topological map (maximo2024).

Particles sit on nodes and face a neighbour; they hop from node to node and are weighted by the
places whose descriptors are most like the one observed.
"""

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np

from estimators.base import Belief, Prior
from estimators.options import (
    require_choices,
    require_counts,
    require_positive,
    require_shares,
)
from estimators.particles import Scheme, effective_sample_size, resample
from estimators.topological import descriptors as describers
from estimators.topological.place_refinement import Refiner
from estimators.topological.topological_map import TopologicalMap, load
from sim import se2
from sim.arrays import Array, Floats, Ints
from sim.errors import InputError, require
from sim.recording import Frame
from sim.robot.arc import arc_increment
from sim.sensors import Lidar3D, sensor_of

Weighting = Literal["M1", "M2", "M3"]
Motion = Literal["odometry", "paper"]
Resampling = Literal["ess", "always"]
Summary = Literal["mode", "mean"]

_ALL_AROUND = math.pi**2 / 3.0  # variance of an unknown heading, rad^2
_MOST_PARTICLES = 10_000_000
_MOST_HOPS = 100  # of one particle between two Frames
_LEAST_HEADING = 0.01  # variance of the heading on an edge, rad^2
_CARRIED_SHARE = 0.05  # error of the wheels' motion, as a share of it
_FACING_RAD = 0.8  # how far a robot's heading may be from its edge's


def node_log_weights(
    nodes_m: Array,
    nearest_m: Array,
    descriptor_distances: Array,
    weighting: Weighting,
    sigma_l_m: float,
    sigma_m: float,
) -> Array:
    """Log weights (N,) of a particle at each node (maximo2024, eqs. (1)-(3)).

    With v_j the way from the node to place j of the B most alike, and h_j their descriptors'
    distances, scaled to sum to one over the B:

    - M1: sum_j exp(-|v_j|^2 / sigma_l^2)
    - M2: sum_j exp(-|v_j|^2 / sigma_l^2) exp(-h_j^2 / sigma_m^2)
    - M3: the product of M2's terms in place of their sum.

    Parameters
    ----------
    nodes_m, nearest_m
        (N, 2) and (B, 2) m.
    descriptor_distances
        (B,) not negative, not yet scaled.
    sigma_l_m, sigma_m
        Spread in metres, and of the scaled distances.

    Notes
    -----
    Eqs. (2) and (3) print Sigma_l in the descriptor's factor; the text has a Sigma_m of its own,
    which is used here, with sigma_m as a spread. In M3 that factor is the same for every
    particle and cancels, so M3 is a Gaussian of variance sigma_l^2 / (2 B) about the centroid of
    the B places: one look-alike among them drags it away.
    """
    away = (nodes_m[:, :1] - nearest_m[:, 0]) ** 2 + (nodes_m[:, 1:] - nearest_m[:, 1]) ** 2
    exponents = away / -(sigma_l_m**2)
    if weighting != "M1":
        exponents -= (_scaled(descriptor_distances) / sigma_m) ** 2
    if weighting == "M3":
        return np.asarray(exponents.sum(axis=1))
    highest = exponents.max(axis=1)
    return np.asarray(highest + np.log(np.exp(exponents - highest[:, None]).sum(axis=1)))


def _scaled(distances: Array) -> Array:
    """Scale distances (B,) to sum to one; those that are all zero stay so."""
    total = float(distances.sum())
    return distances / total if total > 0.0 else distances


def _normalized(log_weights: Array) -> Array:
    """Finite log weights (M,) whose weights sum to one."""
    shifted = log_weights - log_weights.max()
    return np.asarray(shifted - math.log(np.exp(shifted).sum()))


def _sums(places: Ints, values: Array, n: int) -> Array:
    """Sum (n,) of the values at each place."""
    return np.asarray(np.bincount(places, values, minlength=n), np.float64)


class Graph:
    """The map's edges in both directions, in the order of their tails.

    A node without neighbours has an endless edge to itself, so that every particle has one.

    Attributes
    ----------
    tail, head, reverse
        (F,) node numbers, and the edge that leads back.
    length_m, heading_rad
        (F,) from tail to head. Nodes in the same place are a hundredth of the median apart.
    first_out, degree
        (N,) the edges that leave node i are the `degree[i]` from `first_out[i]` on.
    """

    def __init__(self, known_map: TopologicalMap) -> None:
        n, joined = len(known_map), known_map.edges
        alone = np.setdiff1d(np.arange(n), joined)
        tail = np.concatenate([joined[:, 0], joined[:, 1], alone])
        head = np.concatenate([joined[:, 1], joined[:, 0], alone])
        order = np.argsort(tail, kind="stable")
        self.tail, self.head = tail[order], head[order]
        # the k-th edge by (tail, head) leads back along the k-th by (head, tail)
        self.reverse = np.empty(len(order), np.int64)
        self.reverse[np.lexsort((self.head, self.tail))] = np.lexsort((self.tail, self.head))
        self.first_out = np.searchsorted(self.tail, np.arange(n))
        self.degree = np.bincount(self.tail, minlength=n)
        way = known_map.positions_m[self.head] - known_map.positions_m[self.tail]
        lone = self.head == self.tail
        self.length_m = np.maximum(np.hypot(*way.T), 0.01 * known_map.spacing_m)
        self.length_m[lone | (known_map.spacing_m == 0.0)] = np.inf
        self.heading_rad = np.arctan2(way[:, 1], way[:, 0])
        self.heading_rad[lone] = np.nan_to_num(known_map.headings_rad[self.tail[lone]])

    def next(self, edges: Ints, uniform: Array) -> Ints:
        """Edge after each, past its head: any but the one back, which is left for dead ends."""
        node, back = self.head.take(edges), self.reverse.take(edges)
        others = self.degree.take(node) - 1
        chosen = self.first_out.take(node) + (uniform * others).astype(np.int64)
        chosen += chosen >= back
        return np.where(others > 0, chosen, back)

    def before(self, edges: Ints, uniform: Array) -> Ints:
        """Edge before each, for driving backwards."""
        return np.asarray(self.reverse[self.next(self.reverse[edges], uniform)])


class TopologicalMcl:
    """Global localization on a topological map by the descriptors of 3D lidar clouds.

    Parameters
    ----------
    weighting
        M1, M2 or M3 of `node_log_weights`.
    particles_per_node
        Particles, over the map's nodes; they face its neighbours in turn.
    n_nearest
        B: how many of the map's most similar descriptors count.
    sigma_l_m
        Spread about their places, m; None for the map's spacing.
    sigma_m
        Spread of their descriptor distances, which sum to one.
    motion
        `paper`: one node at every observation, regardless of the wheels. `odometry`: along the
        graph by the wheels' travel.
    p_stay, p_skip, p_turn
        With `odometry`: chance at each node to be late by one, to be early by one, and to turn
        round, since the graph's edges are not what the robot drives.
    resampling
        `always`, as the paper, or `ess`: when the effective sample size is below half.
    scheme
        As in `estimators.particles.resample`; the paper's is multinomial.
    injection
        Share of the particles that is put, at every observation, at the B places instead. With
        none, a hypothesis once discarded never comes back.
    estimate
        `mean`: of all particles, eq. (4). `mode`: of those at the heaviest node and its
        neighbours.
    refine
        Register the level slice of the cloud with that of the mode's node, if the map has
        slices; the pose is then as good as the registration, not as the nodes' spacing. Where that
        fails the wheels carry the last one on.
    map_path
        A map's file; None for the prior's map.

    Notes
    -----
    Without refinement the covariance is that of the particles and of an even spread over a
    spacing, as the robot is near a node rather than on it.

    Belief extras: `particles` (M, 3), `log_weights` (M,), `ess` before resampling, `mode_share`
    of the weight at the mode, `node`, `dispersion_m` (mean distance of the particles from their
    estimate, sec. 4.1), and `refinement` (`ok`, or why not) where it was tried. An
    observation that holds NaN, or a cloud that saw nothing, is passed over with a `status`.
    """

    needs = frozenset({"place|lidar3d", "map"})  # one of the two sensors
    maps = (TopologicalMap,)
    global_or_grid = True

    def __init__(
        self,
        weighting: Weighting = "M2",
        particles_per_node: int = 4,
        n_nearest: int = 5,
        sigma_l_m: float | None = None,
        sigma_m: float = 0.1,
        motion: Motion = "odometry",
        p_stay: float = 0.1,
        p_skip: float = 0.1,
        p_turn: float = 0.01,
        resampling: Resampling = "ess",
        scheme: Scheme = "systematic",
        injection: float = 0.02,
        estimate: Summary = "mode",
        refine: bool = True,
        map_path: str | None = None,
        place: str = "place",
        lidar3d: str = "lidar3d",
    ) -> None:
        self.place, self.lidar3d = place, lidar3d
        require_choices(
            weighting=(weighting, Weighting),
            motion=(motion, Motion),
            resampling=(resampling, Resampling),
            scheme=(scheme, Scheme),
            estimate=(estimate, Summary),
        )
        require_counts(particles_per_node=particles_per_node, n_nearest=n_nearest)
        require_positive(sigma_m=sigma_m)
        if sigma_l_m is not None:
            require_positive(sigma_l_m=sigma_l_m)
        require_shares(p_stay=p_stay, p_skip=p_skip, p_turn=p_turn, injection=injection)
        require(p_stay + p_skip <= 1.0, "estimator.p_stay and p_skip must not exceed 1 together")
        self.weighting, self.n_nearest = weighting, n_nearest
        self.particles_per_node = particles_per_node
        self.sigma_l_m, self.sigma_m, self.motion = sigma_l_m, sigma_m, motion
        self.p_stay, self.p_skip, self.p_turn = p_stay, p_skip, p_turn
        self.resampling, self.scheme, self.injection = resampling, scheme, injection
        self.estimate, self.refine, self.map_path = estimate, refine, map_path

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Spread the particles over the nodes, weighted by the prior's pose if it has one."""
        known = prior.map if self.map_path is None else load(Path(self.map_path))
        require(
            isinstance(known, TopologicalMap),
            "topological_mcl needs a topological map; set estimator.map_path, or prior.map "
            "to the function that makes one",
        )
        n_particles = self.particles_per_node * len(known)
        require(
            n_particles <= _MOST_PARTICLES,
            f"estimator.particles_per_node={self.particles_per_node} makes {n_particles} particles "
            f"on a map of {len(known)} nodes; at most {_MOST_PARTICLES} are held",
        )
        self._rng, self._map, self._graph = rng, known, Graph(known)
        require(
            {self.place, self.lidar3d} & set(prior.sensors),
            "topological_mcl needs place descriptors or a 3D lidar; choose sensors=lidar3d",
        )
        has_lidar = self.lidar3d in prior.sensors
        self._lidar = sensor_of(prior.sensors, self.lidar3d, Lidar3D) if has_lidar else None
        self._track_m = prior.robot.track_m
        self._kind = describers.KINDS.get(known.descriptor)
        self._node_of_state = np.concatenate([self._graph.tail, self._graph.head])
        headings = np.tile(self._graph.heading_rad, 2)
        self._poses = np.column_stack([known.positions_m[self._node_of_state], headings])
        self._squares = np.einsum("nd,nd->n", known.descriptors, known.descriptors)
        self._sigma_l_m = self.sigma_l_m or known.spacing_m or 1.0
        self._near_m = 1.5 * max(known.spacing_m, 1.0)
        self._refiner = (
            Refiner(known, self._lidar)
            if self.refine and known.slices_m.size and self._lidar is not None
            else None
        )
        copy, node = np.indices((self.particles_per_node, len(known))).reshape(2, -1)
        self._edge = self._graph.first_out[node] + copy % self._graph.degree[node]
        self._along_m = np.zeros(len(node))
        if self.motion == "odometry":  # anywhere about the node, not on it
            reach = self._graph.length_m[self._edge] / 2.0
            reach[np.isinf(reach)] = 0.0
            self._along_m = reach * rng.uniform(-1.0, 1.0, len(node))
            self._cross_nodes(noisy=False)
        self._log_weights = np.full(len(node), -math.log(len(node)))
        if prior.mean is not None and prior.covariance is not None:
            self._log_weights += self._log_prior(prior.mean, prior.covariance)
        self._observed = False
        self._belief, self._registered = self._summary({}), False

    def step(self, frame: Frame) -> Belief:
        """Move by the wheels; at an observation also weight, resample and, if asked, refine."""
        if self.motion == "odometry":
            self._roll(frame.wheel_increments_m)
            self._belief = self._carried(frame.wheel_increments_m)
        descriptor, fault = self._descriptor(frame)
        if descriptor is None:
            extras = {"status": fault} if fault else {}
            return Belief(self._belief.mean.copy(), self._belief.covariance.copy(), extras)
        if self.motion == "paper" and self._observed:
            self._edge = self._graph.next(self._edge, self._rng.random(len(self._edge)))
        self._observed = True
        self._weigh(descriptor)
        ess = effective_sample_size(self._log_weights)
        if self.resampling == "always" or ess < 0.5 * len(self._edge):
            self._resample()
        belief = self._summary({"ess": ess})
        turn = frame.readings.get(self.lidar3d)
        if self._refiner is not None and turn is not None:
            belief = self._refined(turn["ranges_m"], belief)
        self._belief = belief
        return Belief(belief.mean.copy(), belief.covariance.copy(), belief.extras)

    def _descriptor(self, frame: Frame) -> tuple[Floats | None, str]:
        """Descriptor of the Frame's place, or None and why if something is wrong with it."""
        place, turn = frame.readings.get(self.place), frame.readings.get(self.lidar3d)
        if place is not None:
            observed = place["descriptor"]
        elif turn is None:
            return None, ""
        else:
            if self._kind is None or self._lidar is None:
                raise InputError(
                    "the map's descriptors come from elsewhere, but the recording has clouds "
                    "only; give it place descriptors, or build the map from clouds"
                )
            if not np.isfinite(turn["ranges_m"]).any():
                return None, "empty cloud"
            observed = self._kind.describe(self._lidar, turn["ranges_m"])
        size = self._map.descriptors.shape[1]
        require(
            observed.shape == (size,),
            f"the map's descriptors have {size} numbers, the recording's have shape "
            f"{observed.shape}; describe both by the same network",
        )
        if not np.isfinite(observed).all():
            return None, "descriptor not finite"
        return observed.astype(np.float32, copy=False), ""

    def _weigh(self, descriptor: Floats) -> None:
        """Find the B places most alike, inject particles there, weight all."""
        nearest, away = self._nearest(descriptor)
        n, rng = len(self._edge), self._rng
        n_new = rng.binomial(n, self.injection) if self.injection > 0.0 else 0
        if n_new:
            slots = rng.choice(n, n_new, replace=False)
            unlike = 0.0 * away if self.weighting == "M1" else _scaled(away) / self.sigma_m
            node = nearest[resample(-(unlike**2), n_new, rng, "multinomial")]
            out = (rng.random(n_new) * self._graph.degree[node]).astype(np.int64)
            self._edge[slots] = self._graph.first_out[node] + out
            self._along_m[slots] = 0.0
            self._log_weights = _normalized(self._log_weights)
            self._log_weights[slots] = -math.log(n)
        positions = self._map.positions_m
        node = self._node_of_state.take(self._states())
        held = np.flatnonzero(np.bincount(node, minlength=len(positions)))
        by_node = np.empty(len(positions))
        by_node[held] = node_log_weights(
            positions[held], positions[nearest], away, self.weighting, self._sigma_l_m, self.sigma_m
        )
        self._log_weights = _normalized(self._log_weights + by_node.take(node))

    def _nearest(self, descriptor: Floats) -> tuple[Ints, Array]:
        """Node numbers (B,) of the most alike descriptors, and their distances."""
        database = self._map.descriptors
        n_nearest = min(self.n_nearest, len(database))
        if self._kind is not None:
            away = self._kind.distances(descriptor, database)
            nearest = np.argpartition(away, n_nearest - 1)[:n_nearest]
            return nearest, away[nearest]
        # |d - q|^2 = |d|^2 - 2 d.q + |q|^2 finds them in one product; their distances are then
        # taken exactly
        rough = self._squares - 2.0 * (database @ descriptor)
        nearest = np.argpartition(rough, n_nearest - 1)[:n_nearest]
        return nearest, describers.euclidean(descriptor, database[nearest])

    def _resample(self) -> None:
        """Draw the particles by their weights; those on the same edge are drawn as one."""
        n = len(self._edge)
        if self.motion == "paper":
            mass = _sums(self._edge, np.exp(self._log_weights), len(self._graph.tail))
            held = np.flatnonzero(mass)
            if self.scheme == "multinomial":  # its copies of each come in one draw
                self._edge = np.repeat(held, self._rng.multinomial(n, mass[held] / mass.sum()))
            else:
                self._edge = held[resample(np.log(mass[held]), n, self._rng, self.scheme)]
        else:
            kept = resample(self._log_weights, n, self._rng, self.scheme)
            self._edge, self._along_m = self._edge.take(kept), self._along_m.take(kept)
        self._log_weights = np.full(n, -math.log(n))

    def _states(self) -> Ints:
        """Number (M,) of each particle's edge, plus that of all edges if it is past its middle."""
        if self.motion == "paper":
            return self._edge
        past = self._along_m > 0.5 * self._graph.length_m.take(self._edge)
        return np.asarray(self._edge + len(self._graph.tail) * past)

    def _roll(self, wheel_increments_m: Array) -> None:
        """Move along the edges by the wheels' mean travel."""
        travel_m = float(wheel_increments_m.sum()) / 2.0
        if travel_m != 0.0:
            self._along_m += travel_m
            self._cross_nodes(noisy=True)

    def _cross_nodes(self, *, noisy: bool) -> None:
        """Pass particles that are over an end of their edge on to the next one."""
        graph, rng = self._graph, self._rng
        for _ in range(_MOST_HOPS):
            over = np.flatnonzero(self._along_m >= graph.length_m.take(self._edge))
            under = np.flatnonzero(self._along_m < 0.0)
            if not len(over) and not len(under):
                return
            old = self._edge[over]
            self._along_m[over] -= graph.length_m[old]
            new = graph.next(old, rng.random(len(over)))
            if noisy and len(over):
                chance = rng.random((2, len(over)))
                early = chance[0] > 1.0 - self.p_skip
                new[early] = graph.next(new[early], rng.random(int(early.sum())))
                late = chance[0] < self.p_stay
                new[late] = old[late]
                turned = chance[1] < self.p_turn
                new[turned] = graph.reverse[old[turned]]
            self._edge[over] = new
            self._edge[under] = graph.before(self._edge[under], rng.random(len(under)))
            self._along_m[under] += graph.length_m[self._edge[under]]
        self._along_m = np.clip(self._along_m, 0.0, graph.length_m[self._edge])

    def _log_prior(self, mean: Array, covariance: Array) -> Array:
        """Log densities (M,) of a first belief, as wide as the nodes are apart at least."""
        spread = covariance[:2, :2] + self._sigma_l_m**2 * np.eye(2)
        off = self._poses[self._states(), :2] - mean[:2]
        turn = se2.wrap(self._graph.heading_rad[self._edge] - mean[2])
        squares: Array = np.sum(off * np.linalg.solve(spread, off.T).T, axis=1)
        squares += turn**2 / (covariance[2, 2] + _FACING_RAD**2)
        return -0.5 * squares

    def _summary(self, extras: dict[str, Any]) -> Belief:
        """Mean and covariance of the particles, or of their mode.

        Particles that sit on the same node and face the same way are summed first.
        """
        known, state = self._map, self._states()
        mass = _sums(state, np.exp(self._log_weights), len(self._poses))
        held = np.flatnonzero(mass)
        shares, poses, nodes = mass[held], self._poses[held], self._node_of_state[held]
        every = shares / shares.sum()
        mode, mode_mass = self._mode(_sums(nodes, shares, len(known)))
        if self.estimate == "mode":
            near = np.zeros(len(known), bool)
            near[self._about(mode)] = True
            shares = shares * near[nodes]
        shares = shares / shares.sum()
        centre = shares @ poses[:, :2]
        off = poses[:, :2] - centre
        cos, sin = shares @ np.cos(poses[:, 2]), shares @ np.sin(poses[:, 2])
        certainty = min(math.hypot(cos, sin), 1.0)  # of the heading; 0 where it is unknown
        spread = -2.0 * math.log(max(certainty, 1e-300))
        covariance = np.zeros((3, 3))
        covariance[:2, :2] = off.T @ (shares[:, None] * off)
        covariance[[0, 1], [0, 1]] += known.spacing_m**2 / 12.0
        covariance[2, 2] = min(max(spread, _LEAST_HEADING), _ALL_AROUND)
        extras |= {
            "mode_share": mode_mass / mass.sum(),
            "node": mode,
            "dispersion_m": float(every @ np.hypot(*off.T)),
            "particles": self._poses.take(state, axis=0),
            "log_weights": self._log_weights.copy(),
        }
        return Belief(np.array([*centre, math.atan2(sin, cos)]), covariance, extras)

    def _mode(self, mass: Array) -> tuple[int, float]:
        """Node with the greatest mass (N,) of itself and its neighbours, and that mass."""
        first, second = self._map.edges.T
        about = mass + _sums(first, mass[second], len(mass))
        about += _sums(second, mass[first], len(mass))
        mode = int(np.argmax(about))
        return mode, float(about[mode])

    def _about(self, node: int) -> Ints:
        """A node and its neighbours."""
        graph, first = self._graph, self._graph.first_out[node]
        return np.append(graph.head[first : first + graph.degree[node]], node)

    def _carried(self, wheel_increments_m: Array) -> Belief:
        """The last belief moved on by the wheels."""
        moved = arc_increment(wheel_increments_m, self._track_m)
        by_pose, by_motion = se2.compose_jacobians(self._belief.mean, moved)
        sigma = _CARRIED_SHARE * math.hypot(moved[0], moved[1])
        Q = np.diag(np.square([sigma, sigma, _CARRIED_SHARE * moved[2]]))
        covariance = by_pose @ self._belief.covariance @ by_pose.T + by_motion @ Q @ by_motion.T
        return Belief(se2.compose(self._belief.mean, moved), (covariance + covariance.T) / 2.0)

    def _refined(self, cloud_ranges_m: Floats, belief: Belief) -> Belief:
        """Register the cloud with the mode's node.

        If that fails, the last registered pose is carried on by the wheels, as long as it stays
        near the particles' mean; else the belief remains as it was.
        """
        assert self._refiner is not None
        mode = int(belief.extras["node"])
        others = [int(i) for i in self._about(mode) if i != mode]
        found = self._refiner.refine(cloud_ranges_m, mode, others)
        extras = {**belief.extras, "refinement": found.status}
        if found.pose is not None and found.covariance is not None:
            self._registered = True
            return Belief(found.pose, found.covariance, extras)
        apart = np.hypot(*(self._belief.mean[:2] - belief.mean[:2]))
        if self._registered and self.motion == "odometry" and apart <= self._near_m:
            return Belief(self._belief.mean, self._belief.covariance, extras)
        self._registered = False
        return Belief(belief.mean, belief.covariance, extras)
