"""The path of one robot as all particles of FastSLAM hold it."""

import math

import numpy as np

from estimators.base import Estimate
from estimators.gaussian import STILL, Gaussian, root, rotate, stack
from estimators.landmarks import particle_kernels as ekf
from estimators.particles import Lineages
from estimators.wheels import WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.recording import Frame


class ParticlePath:
    """What all particles hold of one robot's path.

    Attributes
    ----------
    poses
        (5, lanes) x, y, heading, and its cosine and sine; lanes beyond the last particle are moved
        along, and never looked at.
    drawn
        (M, 3) the same, as of the last draw.
    rolled, root
        Motion not yet drawn, and the root (3, K) of its covariance.
    stretch
        (lanes,) by which slip of Student's t is wider than normal slip.
    state
        Of `estimators.landmarks.particle_maps`, for the robot's camera.
    belief
        Moments of `drawn`.
    """

    def __init__(
        self,
        wheels: WheelPrediction,
        slip_dof: float | None,
        mount: Array,
        n_particles: int,
        n_blocks: int,
    ) -> None:
        self._wheels, self._slip_dof, self._n = wheels, slip_dof, n_particles
        self._mount, self.state = packed_mount(mount), ekf.new_state(n_blocks)
        self._lineages = Lineages(n_particles)
        self._filtered: list[Array] = []  # covariance of each draw under its weights then
        # of each Frame: its stamp, the draw it follows, and the motion since
        self._frames: list[tuple[float, int, Gaussian]] = []

    def scatter(self, start: Gaussian, rng: np.random.Generator, draws_start: bool) -> None:
        """Draw the particles from the start, or put all at its mean: `place` adds its covariance.

        No image tells of an error of a lone robot's start, which turns and shifts path and map as a
        whole; drawn, its spread would be lost as particles are resampled.
        """
        none = np.zeros((3, 3))
        spread, undrawn = (start.covariance, none) if draws_start else (none, start.covariance)
        self._start = Gaussian(start.mean, undrawn)
        turned = rotate(spread, -float(start.mean[2]))
        normals = rng.standard_normal((3, len(self.state) * ekf.LANES))
        drawn = se2.compose(start.mean, (root((turned + turned.T) / 2.0) @ normals).T)
        headings = drawn[:, 2]
        self.poses = np.stack([*drawn.T, np.cos(headings), np.sin(headings)])
        self.rolled, self.root = STILL, np.zeros((3, 2))
        self.stretch = np.ones(self.poses.shape[1])

    def place(self, belief: Gaussian) -> Gaussian:
        """Add to a belief the covariance that an error of the start gives it, if not drawn."""
        by_start = np.eye(3)
        x, y, _ = belief.mean - self._start.mean
        by_start[:2, 2] = -y, x
        covariance = belief.covariance + by_start @ self._start.covariance @ by_start.T
        return Gaussian(belief.mean, covariance)

    def roll(self, frame: Frame) -> None:
        """Add the Frame's arc to the motion that is not yet drawn."""
        motion, _, root_ = self._wheels.predict_in_full(frame)
        if self.rolled is STILL:
            self.rolled, self.root = motion, root_ if root_.shape[1] < 3 else np.zeros((3, 0))
        else:
            self.rolled, self.root = self.rolled.then(motion), np.zeros((3, 0))

    def normals(self, rng: np.random.Generator) -> Array:
        """Standard normal draws (3, lanes); two rows for a single arc, which has two wheels."""
        rolled, rank = np.zeros((3, 3)), self.root.shape[1] or 3
        covariance = self.rolled.covariance
        rolled[:, :rank] = self.root if rank < 3 else root((covariance + covariance.T) / 2.0)
        normals = np.zeros((3, self.poses.shape[1]))
        rng.standard_normal(out=normals[:rank])
        if self._slip_dof is not None:  # Student's t: a normal over the root of its own chi-square
            squares = rng.chisquare(self._slip_dof, len(self.stretch)) / self._slip_dof
            self.stretch = 1.0 / np.sqrt(squares)
        self.root = rolled
        return normals

    def move(self, normals: Array, mount: Array | None = None, state: Array | None = None) -> Array:
        """Poses (5, lanes) after the motion; writes the state of a camera, by default its own."""
        mount = self._mount if mount is None else mount
        state = self.state if state is None else state
        noise = normals if self._slip_dof is None else self.stretch * normals
        return ekf.move(self.poses, self.rolled.mean, self.root, noise, mount, state)

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the motion by the wheels alone."""
        self.poses = self.move(self.normals(rng))
        self.settle()

    def settle(self) -> None:
        """Take the poses as drawn."""
        self.drawn = np.ascontiguousarray(self.poses[:3, : self._n].T)
        self.drawn[:, 2] = se2.wrap(self.drawn[:, 2])
        self._lineages.append(self.drawn)
        self._filtered.append(np.zeros((3, 3)))
        self.rolled = STILL

    def weigh(self, weights: Array) -> None:
        """Take the moments of the last draw under weights (M,)."""
        self.belief = Gaussian(*ekf.moments(self.drawn, weights))
        self._filtered[-1] = self.belief.covariance

    def note(self, stamp: float) -> None:
        """Note a Frame."""
        self._frames.append((stamp, len(self._lineages) - 1, self.rolled))

    def resample(self, ancestors: Ints) -> None:
        """Give particle m the path of `ancestors[m]`, (M,)."""
        self._lineages.resample(ancestors)
        self.poses[:, : self._n] = np.take(self.poses, ancestors, axis=1)
        self.drawn = self.drawn[ancestors]

    def revised(self, best: int, weights: Array, known_map: dict[str, Array | Ints]) -> Estimate:
        """Path of one particle, with the covariances of its error.

        The path is a draw from the posterior, so its error has twice the posterior's covariance:
        the truth is another such draw. Two particles with one ancestor at some time say nothing of
        the spread then; in their place stands the spread that the filter had.
        """
        n = len(self._lineages)
        drawn: list[Gaussian] = []
        steps = zip(self._lineages.paths(), reversed(self._filtered), strict=True)
        for (poses, rows), filtered in steps:
            by_row = np.bincount(rows, weights, minlength=len(poses)).astype(np.float64)
            spread = ekf.moments(poses, by_row)[1] + float(by_row @ by_row) * filtered
            drawn.append(Gaussian(poses[rows[best]], 2.0 * spread))
        beliefs = [self.place(drawn[n - 1 - draw].then(since)) for _, draw, since in self._frames]
        stamps = np.array([stamp for stamp, _, _ in self._frames])
        return Estimate(stamps, *stack(beliefs), kind="revised", map=known_map)


def packed_mount(mount: Array) -> Array:
    """(4,) x, y, and cosine and sine of the yaw of a mount (3,)."""
    x, y, yaw = mount
    return np.array([x, y, math.cos(yaw), math.sin(yaw)])
