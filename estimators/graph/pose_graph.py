"""A chain of poses tied by relative poses, with loops that close: estimates and covariances.

The newest pose is where things happen, so its covariance with every other is kept while the chain
grows, as a filter does it: O(N) a pose. Only closures cost a sparse least-squares solution
(`estimators.graph.least_squares`), from which the covariances of chosen poses follow without a
dense inverse. The loss of closures is dynamic covariance scaling, which lets go of those that the
rest of the graph contradicts.

Source: Yang et al., Graduated non-convexity for robust spatial perception, RA-L 5, 2020.
"""

from dataclasses import dataclass

import numpy as np

from estimators.gaussian import Gaussian, compose, stack
from estimators.graph.least_squares import LeastSquaresOptions, Problem, information_at, solve
from estimators.graph.matrices import Factor, inverse, times, transpose, whitening_of
from sim import se2
from sim.arrays import Array, Ints

_NARROWED = 8.0  # by this factor the loss of closures is narrowed from one solution to the next


@dataclass(frozen=True, eq=False)
class Edge:
    """The measured pose of node `second` in the frame of node `first`.

    `support_m` is the way over which others must agree before it is believed.
    """

    first: int
    second: int
    motion: Gaussian
    support_m: float = 0.0


class PoseGraph:
    """Nodes 0, 1, 2 ... with poses in map; each is tied to the one before, and some to others.

    Parameters
    ----------
    start
        Pose of node 0; its covariance is positive definite.
    robust_sigma
        Mahalanobis distance from which on a closure counts less.

    Attributes
    ----------
    poses
        (N, 3) m, m, rad in map.
    noise
        (3, 3) covariance of each node's last tie to the one before.
    closures
        Edges that tie nodes to others than the one before.
    """

    def __init__(self, start: Gaussian, robust_sigma: float) -> None:
        self._start, self._robust_sigma = start, robust_sigma
        self.poses = start.mean[None].copy()
        self._chain: list[Edge] = []
        self.noise = [start.covariance]
        self.closures: list[Edge] = []
        # Covariances of each node: its own, and with the newest. Own ones may be those of a time
        # with fewer closures, and so too large, unless they are current.
        self._own, self._cross = start.covariance[None].copy(), start.covariance[None].copy()
        self._current = np.ones(1, dtype=bool)
        self._solved: Factor | None = None  # covers the nodes of the last solution
        self._now: Factor | None = None  # covers all nodes

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def newest(self) -> Gaussian:
        """Pose of the last node."""
        return Gaussian(self.poses[-1], self._own[-1])

    def add(self, motion: Array, measured: list[Gaussian]) -> None:
        """Append a node.

        Parameters
        ----------
        motion
            (3,) from the last node, where the new one is put.
        measured
            One or more independent measurements of that motion.
        """
        n = len(self)
        self._chain += [Edge(n - 1, n, one) for one in measured]
        self.noise.append(measured[-1].covariance)
        noise = inverse(np.sum([inverse(one.covariance) for one in measured], axis=0))
        pose, by_pose, by_motion = compose(self.poses[-1], motion)
        own = by_pose @ self._own[-1] @ by_pose.T + by_motion @ noise @ by_motion.T
        own = (own + own.T) / 2.0
        self.poses = np.vstack([self.poses, pose])
        self._cross = np.concatenate([self._cross @ by_pose.T, own[None]])
        self._own = np.concatenate([self._own, own[None]])
        self._current = np.append(self._current, True)
        self._now = None

    def newest_from(self, nodes: Ints, *, exact: bool) -> tuple[Array, Array]:
        """Pose (K, 3) of the last node in the frame of each of these, and covariance (K, 3, 3).

        Without `exact` covariances may be too large, and cost next to nothing.
        """
        if exact:
            self._refresh(nodes)
        return self._from(nodes, len(self) - 1, self._cross[nodes])

    def seen_from(self, nodes: Ints, node: int) -> tuple[Array, Array]:
        """Pose (K, 3) of a node in the frame of each of these, and exact covariance (K, 3, 3)."""
        self._refresh(np.append(nodes, node))
        columns = self._information().columns(np.array([node]))
        return self._from(nodes, node, columns.reshape(-1, 3, 3)[nodes])

    def _from(self, nodes: Ints, node: int, cross: Array) -> tuple[Array, Array]:
        """As above, with the covariances (K, 3, 3) of the nodes with the one."""
        first, second = self.poses[nodes], np.tile(self.poses[node], (len(nodes), 1))
        by_first, by_second = se2.between_jacobians(first, second)
        mixed = by_first @ cross @ transpose(by_second)
        covariances = by_first @ self._own[nodes] @ transpose(by_first)
        covariances += by_second @ self._own[node] @ transpose(by_second)
        return se2.between(first, second), covariances + mixed + transpose(mixed)

    def joint_innovation(self, edges: list[Edge]) -> tuple[Array, Array]:
        """What K edges miss the graph by, (3 K,), and its joint covariance, their noise included.

        Edges of the graph itself must not be among them.
        """
        first, second, measured, noise = stacked(edges)
        nodes, places = np.unique(np.concatenate([first, second]), return_inverse=True)
        by_first, by_second = se2.between_jacobians(self.poses[first], self.poses[second])
        J = np.zeros((len(edges), 3, len(nodes), 3))
        k = np.arange(len(edges))
        J[k, :, places[: len(edges)]], J[k, :, places[len(edges) :]] = by_first, by_second
        flat = J.reshape(3 * len(edges), -1)
        S = flat @ self._information().joint(nodes) @ flat.T
        S.reshape(len(edges), 3, len(edges), 3)[k, :, k] += noise
        off = se2.difference(measured, se2.between(self.poses[first], self.poses[second]))
        return off.ravel(), S

    def close(self, edges: list[Edge], tolerance: float = 1e-9) -> None:
        """Take closures in, and move all nodes to the least-squares solution.

        A closure of a long loop may miss the graph by hundreds of its standard deviations, where
        the bounded loss is flat. So the loss is widened to begin with until it pulls with all of
        them, then narrowed (graduated non-convexity, yang2020). `tolerance` is the share of the
        cost that a last step may still gain.
        """
        self.closures += edges
        self._settle(max(self._robust_sigma, self._farthest(edges)), tolerance)

    def keep(self, closures: list[Edge], tolerance: float = 1e-9) -> None:
        """Let go of all other closures, and move all nodes to the least-squares solution."""
        self.closures = closures
        self._settle(self._robust_sigma, tolerance)

    def _settle(self, sigma: float, tolerance: float) -> None:
        """Solve with a loss of this width, then with ever narrower ones."""
        while True:
            how = LeastSquaresOptions(robust="dcs", robust_sigma=sigma)
            solution = solve(self._problem(), self.poses, how, tolerance=tolerance)
            self.poses = solution.poses
            if sigma == self._robust_sigma:
                break
            sigma = max(sigma / _NARROWED, self._robust_sigma)
        n = len(self)
        assert isinstance(solution.information, Factor)
        self._solved = self._now = solution.information
        self._cross = self._solved.columns(np.array([n - 1])).reshape(n, 3, 3)
        self._own[-1] = (self._cross[-1] + self._cross[-1].T) / 2.0
        self._current = np.arange(n) == n - 1

    def misses(self, edges: list[Edge] | None = None) -> Array:
        """Mahalanobis distances (K,) of edges from the graph, by their own noise; of closures."""
        first, second, measured, noise = stacked(self.closures if edges is None else edges)
        off = se2.difference(measured, se2.between(self.poses[first], self.poses[second]))
        return np.asarray(np.sqrt(np.sum(times(whitening_of(noise), off) ** 2, axis=1)))

    def _farthest(self, edges: list[Edge]) -> float:
        return float(self.misses(edges).max(initial=0.0))

    def marginals(self) -> Array:
        """(N, 3, 3) covariance of every node."""
        self._refresh(np.arange(len(self)))
        return self._own.copy()

    def chained(self) -> Array:
        """(N, 3) poses of the nodes by their ties to the one before alone."""
        motions: list[Gaussian] = []
        for edge in self._chain:
            if edge.second == len(motions):
                motions[-1] = motions[-1].fuse(edge.motion)
            else:
                motions.append(edge.motion)
        return se2.chain(np.array([m.mean for m in motions]).reshape(-1, 3), self.poses[0])

    def _refresh(self, nodes: Ints) -> None:
        stale = np.asarray(nodes)[~self._current[nodes]]
        if len(stale) and self._solved is not None:
            self._own[stale] = self._solved.marginals(stale)
            self._current[stale] = True

    def _information(self) -> Factor:
        if self._now is None:
            how = LeastSquaresOptions(robust="dcs", robust_sigma=self._robust_sigma)
            self._now = information_at(self._problem(), self.poses, how)
        return self._now

    def _problem(self) -> Problem:
        edges = self._chain + self.closures
        first, second, motions, covariances = stacked(edges)
        return Problem(
            prior_mean=self._start.mean,
            prior_covariance=self._start.covariance,
            first=first,
            second=second,
            motions=motions,
            motion_covariances=covariances,
            doubtful=np.arange(len(edges)) >= len(self._chain),
        )


def stacked(edges: list[Edge]) -> tuple[Ints, Ints, Array, Array]:
    """First and second node (E,), motions (E, 3) and covariances (E, 3, 3)."""
    ends = np.array([(edge.first, edge.second) for edge in edges], np.int64).reshape(-1, 2)
    return ends[:, 0], ends[:, 1], *stack([edge.motion for edge in edges])
