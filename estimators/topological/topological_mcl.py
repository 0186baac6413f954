"""Monte Carlo localization among the nodes of a topological map (maximo2024).

Particles sit on nodes and face a neighbour; they hop from node to node and are weighted by the
places whose descriptors are most like the one observed.
"""

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np

from estimators.base import Belief, Prior
from estimators.particles import Scheme, effective_sample_size, resample
from estimators.topological import descriptors as describers
from estimators.topological.node_weights import Weighting, node_log_weights, scale
from estimators.topological.place_refinement import Refiner
from estimators.topological.topological_map import Edges, TopologicalMap, load
from sim import se2
from sim.arrays import Array, Floats, Ints
from sim.errors import InputError, require
from sim.options import Count, Positive, Share, options
from sim.recording import Frame
from sim.robot.arc import arc_increment
from sim.sensors import Lidar3D, sensor_of

Motion = Literal["odometry", "paper"]
Resampling = Literal["ess", "always"]
Summary = Literal["mode", "mean"]

_ALL_AROUND = math.pi**2 / 3.0  # variance of an unknown heading, rad^2
_MOST_PARTICLES = 10_000_000
_MOST_HOPS = 100  # of one particle between two Frames
_LEAST_HEADING = 0.01  # variance of the heading on an edge, rad^2
_CARRIED_SHARE = 0.05  # error of the wheels' motion, as a share of it
_FACING_RAD = 0.8  # how far a robot's heading may be from its edge's


def _normalized(log_weights: Array) -> Array:
    """Finite log weights (M,) whose weights sum to one."""
    shifted = log_weights - log_weights.max()
    return np.asarray(shifted - math.log(np.exp(shifted).sum()))


def _sums(places: Ints, values: Array, n: int) -> Array:
    """Sum (n,) of the values at each place."""
    return np.asarray(np.bincount(places, values, minlength=n), np.float64)


@options("estimator")
class TopologicalMclOptions:
    """Options of the filter among the nodes of a topological map."""

    place: str = "place"
    """Name of the sensor of place descriptors that it reads."""
    lidar3d: str = "lidar3d"
    """Name of the 3D lidar whose clouds it describes where descriptors are missing."""
    weighting: Weighting = "M2"
    """M1, M2 or M3 of `node_log_weights` (maximo2024, eqs. (1)-(3))."""
    particles_per_node: Count = 4
    """Particles per node of the map; they face its neighbours in turn."""
    n_nearest: Count = 5
    """B: how many of the map's most similar descriptors count."""
    sigma_l_m: Positive | None = None
    """Spread about their places, m; null: the map's spacing."""
    sigma_m: Positive = 0.1
    """Spread of their descriptor distances, which sum to one."""
    motion: Motion = "odometry"
    """`paper`: one node at every observation, regardless of the wheels. `odometry`: along the
    graph by the wheels' travel."""
    p_stay: Share = 0.1
    """With `odometry`: chance at each node to be late by one, since the graph's edges are not what
    the robot drives."""
    p_skip: Share = 0.1
    """With `odometry`: chance at each node to be early by one."""
    p_turn: Share = 0.01
    """With `odometry`: chance at each node to turn round."""
    resampling: Resampling = "ess"
    """`always`, as the paper, or `ess`: when the effective sample size is below half."""
    scheme: Scheme = "systematic"
    """Scheme of resampling: see `estimators.particles.resample`; the paper's is multinomial."""
    injection: Share = 0.02
    """Share of the particles that is put, at every observation, at the B places instead. With
    none, a hypothesis once discarded never comes back."""
    estimate: Summary = "mode"
    """`mean`: of all particles, eq. (4). `mode`: of those at the heaviest node and its
    neighbours."""
    refine: bool = True
    """Register the level slice of the cloud with that of the mode's node, if the map has slices;
    the pose is then as good as the registration, not as the nodes' spacing. Where that fails the
    wheels carry the last one on."""
    map_path: str | None = None
    """A map's file, .npz; null: the prior's map."""

    def __post_init__(self) -> None:
        require(
            self.p_stay + self.p_skip <= 1.0,
            "estimator.p_stay and p_skip must not exceed 1 together",
        )


class TopologicalMcl(TopologicalMclOptions):
    """Global localization on a topological map by the descriptors of 3D lidar clouds.

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
        self._rng, self._map, self._graph = rng, known, Edges(known)
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
        if (start := prior.start) is not None:
            self._log_weights += self._log_prior(start.mean, start.covariance)
        self._observed = False
        self._belief, self._registered = self._summary({}), False

    def step(self, frame: Frame) -> Belief:
        """Move by the wheels; at an observation also weight, resample and, if asked, refine."""
        if self.motion == "odometry":
            if travel_m := float(frame.wheel_increments_m.sum()) / 2.0:
                self._along_m += travel_m
                self._cross_nodes(noisy=True)
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
            unlike = 0.0 * away if self.weighting == "M1" else scale(away) / self.sigma_m
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
