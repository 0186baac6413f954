"""Fit of all the beams of a scan to the walls of a known map.

Particles are too few for the likelihood of a whole scan, which is sharper than their spacing. So
they tell the hypotheses apart, by a few beams, and this fit says where in one of them the robot is.

The pose minimises the squared distances of the beams' ends from the lines of their nearest walls,
weighted by the noise of the range across the wall, together with a Gaussian guess. A beam that is
too far from every wall does not count: people, and furniture that the map lacks. How far is
lowered from step to step, so that a heading off by a few degrees still finds the walls.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import KDTree

from estimators.gaussian import STILL, Gaussian, compose, rotate
from estimators.on_a_map.likelihood_field import LikelihoodField
from estimators.on_a_map.walls import Nearest
from sim import se2
from sim.arrays import Array
from sim.compiled import njit
from sim.sensors import Laser
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World

_GATES_M = np.array([0.3, 0.3, 0.15, 0.08, 0.04, 0.0, 0.0, 0.0])  # one a step; then the noise's own
_GATE_SIGMAS = 3.0
_PAST_M = 0.03  # how far past the end of a wall a beam may still be of it
_NEIGHBOURS = 3.0  # cells about one, of which its wall's direction is worked out
_BLOCKS = 24  # of neighbouring beams, which share what the map errs by
_LEAST_SIGMA_M = 1e-3
_FLOOR, _CELL_FLOOR = 0.2, 0.3  # of the range noise, and of a cell's: a wall is not exact
_MIN_BEAMS, _MIN_SHARE = 20, 0.3
_BIAS_SIGMAS = np.array([0.01, 0.005])  # of a laser never seen: m, and a share of the range
# Variance of the start of the straight line that fits a random walk over a unit of time
_RANDOM_WALK = 2.0 / 15.0
_MAX_MAHALANOBIS = 26.1  # chi^2 of 8, 99.9 %


class _Beams(NamedTuple):
    """Ranges (B,), m, rays (2, B) in base_link, ages (B,), s, and the laser's place (2,) there."""

    ranges_m: Array
    rays: Array
    ages_s: Array
    mount: Array


class _Walls(NamedTuple):
    """Lines (W, 5), the nearest to each cell of a table, and the table's corner and cell, m."""

    lines: Array
    nearest: Nearest
    origin: Array
    cell_m: float


class _Noise(NamedTuple):
    """Standard deviations of ranges and of walls, and the variance that neighbours share."""

    range_m: float
    wall_m: float
    shared_m2: float


class WallFit:
    """Fit of scans to the walls of a map.

    What the laser errs by, always and as a share of the range, is estimated beside the pose, and
    what a scan says of it is known to the next. So is, of a laser that sweeps, by how much the
    robot moved otherwise during the sweep than the wheels say.

    Where the walls are exact, the pose that was fitted is the next scan's guess, taken there by
    the wheels: the errors of scans are independent. Those of a grid's cells are not.

    Parameters
    ----------
    field
        Of the map's walls (W, 4).
    """

    def __init__(
        self, field: LikelihoodField, known_map: World | OccupancyGrid, laser: Laser
    ) -> None:
        self._laser, self._cell_sigma_m = laser, 0.0
        self._exact, self._fitted = isinstance(known_map, World), False
        self._turn_rad = 0.0  # in the last Frame
        if isinstance(known_map, OccupancyGrid):
            lines = _lines_of_cells(field.walls[:, :2], known_map.resolution_m)
            self._cell_sigma_m = known_map.resolution_m / math.sqrt(12.0)
        else:
            lines = _lines_of(field.walls)
        self._walls = _Walls(lines, field.nearest, field.origin_m, field.cell_m)
        self._ages_s = -laser.beam_offsets_s
        # of the pose, while it is fitted, and the biases
        self._state = np.zeros(5)
        self._covariance = np.diag(np.square([0.0, 0.0, 0.0, *_BIAS_SIGMAS]))

    def roll(self, motion: Gaussian) -> None:
        """Take the pose that was fitted on by the wheels.

        They say how far the robot turned in a Frame, not when in it: sideways that leaves the slip
        within the Frame, and how the turn has changed since the Frame before.
        """
        length_m, _, turn_rad = motion.mean
        unsteady_rad2 = motion.covariance[2, 2] / 12.0 + ((turn_rad - self._turn_rad) / 6.0) ** 2
        self._turn_rad = turn_rad
        if not self._fitted:
            return
        motion = Gaussian(motion.mean, motion.covariance.copy())
        motion.covariance[1, 1] += length_m**2 * unsteady_rad2
        pose, by_pose, by_motion = compose(self._state[:3], motion.mean)
        self._state = np.concatenate([pose, self._state[3:]])
        self._covariance[:3] = by_pose @ self._covariance[:3]
        self._covariance[:, :3] = self._covariance[:, :3] @ by_pose.T
        self._covariance[:3, :3] += by_motion @ motion.covariance @ by_motion.T

    def fit(
        self,
        guess: Gaussian,
        ranges_m: Array,
        bearings_rad: Array,
        slip_per_s: Array,
        *,
        learn: bool = True,
    ) -> Gaussian | None:
        """Fuse a guess of the pose of base_link with a scan.

        The range's standard deviation is the laser's, or that of the residuals of the beams that
        count, if it is larger.

        Parameters
        ----------
        ranges_m, bearings_rad
            (N,) of a scan taken to its stamp by the wheels.
        slip_per_s
            (3, 3) variance of the wheels' motion in a second.
        learn
            Whether the next scan knows what this one says of the laser's bias by a grid: not if it
            is taken at the same place, where the map errs alike.

        Returns
        -------
        Gaussian
            Its covariance is widened by what the means of neighbouring beams have more than their
            noise. None if too few beams meet walls, or where they do contradicts the guess.
        """
        seen = self._laser.returned(ranges_m)
        rays = np.stack([np.cos(bearings_rad[seen]), np.sin(bearings_rad[seen])])
        x, y, yaw = self._laser.mount.pose
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        sigma_m = max(self._laser.sigma_range_m, _LEAST_SIGMA_M)
        beams = _Beams(ranges_m[seen], turn @ rays, self._ages_s[seen], np.array([x, y]))
        noise = _Noise(
            sigma_m,
            math.hypot(_FLOOR * sigma_m, _CELL_FLOOR * self._cell_sigma_m),
            len(beams.ages_s) / _BLOCKS * self._cell_sigma_m**2,
        )
        fitted = None
        if self._fitted and _mahalanobis(self._state[:3], guess) < _MAX_MAHALANOBIS:
            fitted = self._moved(self._state, self._covariance, beams, noise, slip_per_s)
        if fitted is None:
            state = np.concatenate([guess.mean, self._state[3:]])
            covariance = np.asarray(block_diag(guess.covariance, self._covariance[3:, 3:]))
            fitted = self._moved(state, covariance, beams, noise, slip_per_s)
        self._fitted = self._exact and fitted is not None
        if fitted is None:
            return None
        if self._exact or learn:
            self._state, self._covariance = fitted
        mean, covariance = fitted
        rest = _RANDOM_WALK * float(np.max(self._ages_s)) * slip_per_s
        return Gaussian(mean[:3], covariance[:3, :3]).then(Gaussian(STILL.mean, rest))

    def _moved(
        self, state: Array, covariance: Array, beams: _Beams, noise: _Noise, slip_per_s: Array
    ) -> tuple[Array, Array] | None:
        """A state (5,) as the beams correct it, and its covariance; None if they do not fit."""
        prior = self._prior(state, covariance, slip_per_s)
        moved, information, n, misfit = _fit(state, prior, beams, self._walls, noise)
        if n < max(_MIN_BEAMS, _MIN_SHARE * len(beams.ages_s)):
            return None
        if moved @ prior @ moved > _MAX_MAHALANOBIS:
            return None
        mean = state + moved[:5]
        mean[2] = se2.wrap(mean[2])
        found = (np.linalg.inv(information) * max(misfit, 1.0))[:5, :5]
        return mean, (found + found.T) / 2.0

    def _prior(self, state: Array, covariance: Array, slip_per_s: Array) -> Array:
        """Information (5, 5), or (8, 8) of a laser that sweeps: pose, biases, velocity in map."""
        sweep_s = float(np.max(self._ages_s))
        if sweep_s == 0.0:
            return _inverse(covariance)
        velocity = rotate(slip_per_s, state[2]) / sweep_s
        return np.asarray(block_diag(_inverse(covariance), _inverse(velocity)))


def _mahalanobis(pose: Array, guess: Gaussian) -> float:
    off = se2.difference(pose, guess.mean)
    return float(off @ _inverse(guess.covariance) @ off)


def _inverse(covariance: Array) -> Array:
    """Also of what is known exactly."""
    return np.asarray(np.linalg.inv(covariance + 1e-12 * np.eye(len(covariance))))


def _lines_of(walls: Array) -> Array:
    """Lines (W, 5) of walls (W, 4): normal, distance from the origin, and ends along it."""
    along = walls[:, 2:] - walls[:, :2]
    along = along / np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-12)[:, None]
    return _lines(np.stack([along[:, 1], -along[:, 0]], axis=1), walls[:, :2], walls[:, 2:])


def _lines_of_cells(middles: Array, cell_m: float) -> Array:
    """Lines (W, 5) through occupied cells (W, 2), by total least squares of those about each."""
    pairs = KDTree(middles).query_pairs((_NEIGHBOURS + 0.01) * cell_m, output_type="ndarray")
    to = np.concatenate([np.arange(len(middles)), pairs[:, 0], pairs[:, 1]])
    near = middles[np.concatenate([np.arange(len(middles)), pairs[:, 1], pairs[:, 0]])]
    counts = np.bincount(to)
    through = np.stack([np.bincount(to, part) / counts for part in near.T], axis=1)
    x, y = (near - through[to]).T
    xx, xy, yy = (np.bincount(to, part) for part in (x * x, x * y, y * y))
    direction_rad = np.arctan2(2.0 * xy, xx - yy) / 2.0
    normals = np.stack([-np.sin(direction_rad), np.cos(direction_rad)], axis=1)
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=1)
    feet = through + np.sum((middles - through) * along, axis=1)[:, None] * along
    return _lines(normals, feet - cell_m * along, feet + cell_m * along)


def _lines(normals: Array, starts: Array, ends: Array) -> Array:
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=1)
    first, last = (np.sum(along * points, axis=1) for points in (starts, ends))
    off = np.sum(normals * starts, axis=1)
    return np.column_stack([normals, off, np.minimum(first, last), np.maximum(first, last)])


@njit(error_model="numpy")
def _fit(
    guess: Array, prior: Array, beams: _Beams, walls: _Walls, noise: _Noise
) -> tuple[Array, Array, int, float]:
    """Gauss-Newton from a guess (5,) of pose and biases, of information `prior` (K, K).

    Of eight unknowns the last three are the velocity, in map, that the scan's own lacks.

    Returns
    -------
    moved
        (K,) from the guess.
    information
        (K, K) at the last step.
    n
        Number of beams that count.
    misfit
        How many times its variance the mean residual of neighbouring beams has, on average.
    """
    rows, columns = walls.nearest.shape
    ranges_m, rays, mount, sigma_m = beams.ranges_m, beams.rays, beams.mount, noise.range_m
    n_beams, k = len(ranges_m), len(prior)
    moved, A, gradient, slope = np.zeros(k), np.empty((k, k)), np.empty(k), np.empty(k)
    sums, weights, ratios = np.empty(_BLOCKS), np.empty(_BLOCKS), np.empty(n_beams)
    n = 0
    for step in range(len(_GATES_M)):
        gate_m2 = (_GATES_M[step] / _GATE_SIGMAS) ** 2
        x0, y0, heading, bias, scale = guess + moved[:5]
        cos, sin = math.cos(heading), math.sin(heading)
        A[:], gradient[:] = prior, prior @ moved
        sums[:] = weights[:] = 0.0
        n = 0
        for b in range(n_beams):
            age = beams.ages_s[b]
            if k == 8:
                x0 = guess[0] + moved[0] - age * moved[5]
                y0 = guess[1] + moved[1] - age * moved[6]
                cos, sin = math.cos(heading - age * moved[7]), math.sin(heading - age * moved[7])
            true_m = ranges_m[b] - bias - scale * ranges_m[b]
            a, c = mount[0] + true_m * rays[0, b], mount[1] + true_m * rays[1, b]
            dx, dy = cos * a - sin * c, sin * a + cos * c
            x, y = x0 + dx, y0 + dy
            column = (x - walls.origin[0]) / walls.cell_m
            row = (y - walls.origin[1]) / walls.cell_m
            if not (0.0 <= column < columns and 0.0 <= row < rows):
                continue
            wall = walls.nearest[int(row), int(column)]
            if wall < 0:
                continue
            n1, n2, off, first, last = walls.lines[wall]
            along = n1 * y - n2 * x
            if along < first - _PAST_M or along > last + _PAST_M:
                continue
            residual = n1 * x + n2 * y - off
            across = n1 * (cos * rays[0, b] - sin * rays[1, b])
            across += n2 * (sin * rays[0, b] + cos * rays[1, b])
            variance = (sigma_m * across) ** 2 + noise.wall_m**2 + gate_m2
            if abs(residual) > _GATE_SIGMAS * math.sqrt(variance):
                continue
            ratios[n] = abs(residual) / math.sqrt(variance)
            n += 1
            weight = 1.0 / (variance + noise.shared_m2)
            slope[0], slope[1], slope[2] = n1, n2, n2 * dx - n1 * dy
            slope[3], slope[4] = -across, -across * ranges_m[b]
            for i in range(k - 5):
                slope[5 + i] = -age * slope[i]
            for i in range(k):
                gradient[i] += weight * residual * slope[i]
                for j in range(i + 1):
                    A[i, j] += weight * slope[i] * slope[j]
            block = b * _BLOCKS // n_beams
            # outwards, whichever side of its wall a line's normal points to
            sums[block] += math.copysign(weight, across) * residual
            weights[block] += weight
        if n < _MIN_BEAMS:
            break
        for i in range(k):
            for j in range(i):
                A[j, i] = A[i, j]
        if step < len(_GATES_M) - 1:
            moved -= np.linalg.solve(A, gradient)
            if gate_m2 == 0.0:
                sigma_m *= max(1.4826 * np.median(ratios[:n]), 1.0)
    squares, counted = 0.0, -float(k)  # the unknowns follow as many
    for block in range(_BLOCKS):
        if weights[block] > 0.0:
            squares += sums[block] * sums[block] / weights[block]
            counted += 1.0
    return moved, A, n, squares / counted if counted >= 1.0 else 1.0
