"""FastSLAM: a particle filter over the robot's path, with an EKF for each landmark (gil2008)."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimators import landmarks as ekf
from estimators.base import Belief, Estimate, Prior
from estimators.gaussian import STILL, Gaussian, compose, wheel_motion
from estimators.landmarks import LandmarkMaps, Maps
from estimators.options import require_choices, require_positive
from estimators.particles import (
    SCHEMES,
    Lineages,
    Scheme,
    in_place,
    normalize,
    resample,
    underflowed,
)
from estimators.stereo import NoiseAt, NoiseModel, StereoModel, slam_start
from sim import se2
from sim.errors import InputError
from sim.recording import Frame, LandmarkSet
from sim.robot import TravelWindow, wheel_variances

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Proposal = Literal["motion", "optimal"]
Association = Literal["known", "mahalanobis", "descriptor"]

_BLIND_IMAGES = 100  # images without a landmark after which the status says so
_PLACING = 4  # observations after which the proposal is linearised anew
_MOST_DRIFT_RAD = 0.1  # heading spread at which motion is drawn without waiting for an image


class FastSLAM:
    """Rao-Blackwellised SLAM: each particle is a path, and has a map of its own.

    At an image the motion since the last one is drawn, the landmarks seen are associated,
    weights get the product over the observations (gil2008, eq. (14)), the EKFs are updated by
    eqs. (3)-(8), and the particles are resampled. Between images they roll by the wheels' mean.

    Parameters
    ----------
    n_particles
        M.
    proposal
        `motion`: FastSLAM 1.0, drawn from the motion model and weighted by eq. (13). `optimal`:
        FastSLAM 2.0, drawn from the motion given the image too, with the weight that this
        proposal is owed, p(z | x) p(x) / q(x): how it is linearised costs particles, not truth.
    resampling
        `systematic`, `stratified`, `residual` or `multinomial`.
    ess_share
        Resample when the effective sample size is below this share of M; 1: at every image, as
        the paper does.
    association
        `known`: by the ids that the sensor gives. `mahalanobis`: least distance below `d0`, per
        particle, eq. (15). `descriptor`: of those below `d0`, the one that distance and
        descriptor together favour.
    d0
        Threshold of the squared Mahalanobis distance (99.9 % of three degrees of freedom).
    p0
        Weight of an observation that starts a landmark, eq. (19), as a density, 1/m^3. It cancels
        when all particles start the same ones, as under known association.
    noise_model, noise_at
        As in `estimators.stereo.StereoModel.of`.
    sigma_column_px, sigma_row_px, sigma_disparity_px, sigma_descriptor
        Believed noise; None for that of the prior's camera.
    maps
        `shared` or `contiguous`, see `estimators.landmarks.LandmarkMaps`: the same bits, at
        different speeds.
    kr, kl
        Believed slip variance per metre of the wheels, m.
    window_s
        |ds| is netted over at least this time.
    keep_map
        Put the best particle's map into every Belief.

    Notes
    -----
    Belief mean and covariance are those of the weighted particles. Extras: `particles` (M, 3) and
    `log_weights` (M,) as of the last image; `ess`; `resampled`, after these were taken; `best`
    (3,), the pose of the particle of greatest accumulated log weight, carried along the ancestry,
    eq. (20); at an image `associations` (K,) of that particle: for each observation, counted from
    0 over the whole run, the one that started its landmark, itself if it is the first, -1 if it
    was refused; with `keep_map` also `landmarks` (N, 3) and `landmark_covariances` (N, 3, 3);
    `status` when an image was of no use.

    `finish` gives the path of the best particle's lineage; `map` is its map.
    """

    needs = frozenset({"landmarks"})

    def __init__(
        self,
        n_particles: int = 200,
        proposal: Proposal = "optimal",
        resampling: Scheme = "systematic",
        ess_share: float = 0.5,
        association: Association = "known",
        d0: float = 16.27,
        p0: float = 1e-3,
        noise_model: NoiseModel = "camera",
        noise_at: NoiseAt = "predicted",
        sigma_column_px: float | None = None,
        sigma_row_px: float | None = None,
        sigma_disparity_px: float | None = None,
        sigma_descriptor: float | None = None,
        maps: Maps = "shared",
        kr: float = 5e-5,
        kl: float = 5e-5,
        window_s: float = 0.05,
        keep_map: bool = False,
    ) -> None:
        if isinstance(n_particles, bool) or not isinstance(n_particles, int) or n_particles < 1:
            raise InputError(
                f"estimator.n_particles must be a whole number from 1 on, got {n_particles!r}"
            )
        choices: dict[str, tuple[str, tuple[str, ...]]] = {
            "proposal": (proposal, ("motion", "optimal")),
            "resampling": (resampling, SCHEMES),
            "association": (association, ("known", "mahalanobis", "descriptor")),
            "noise_model": (noise_model, ("camera", "diagonal", "correlated", "image")),
            "noise_at": (noise_at, ("predicted", "measured")),
            "maps": (maps, ("shared", "contiguous")),
        }
        require_choices(choices)
        believed = {
            "sigma_column_px": sigma_column_px,
            "sigma_row_px": sigma_row_px,
            "sigma_disparity_px": sigma_disparity_px,
            "sigma_descriptor": sigma_descriptor,
        }
        self._believed = {name: sigma for name, sigma in believed.items() if sigma is not None}
        require_positive(ess_share=ess_share, kr=kr, kl=kl, window_s=window_s, **self._believed)
        for name, number in {"d0": d0, "p0": p0}.items():
            if not (math.isfinite(number) and number > 0.0):
                raise InputError(f"estimator.{name} must be positive, got {number}")
        self.n_particles, self.proposal, self.resampling = n_particles, proposal, resampling
        self.ess_share, self.association, self.d0, self.p0 = ess_share, association, d0, p0
        self.noise_model, self.noise_at, self.maps = noise_model, noise_at, maps
        self.sigma_column_px, self.sigma_row_px = sigma_column_px, sigma_row_px
        self.sigma_disparity_px, self.sigma_descriptor = sigma_disparity_px, sigma_descriptor
        self.kr, self.kl, self.window_s, self.keep_map = kr, kl, window_s, keep_map

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Draw the particles from the prior, all with an empty map."""
        start, camera = slam_start(prior, "fastslam", self.association, self._believed)
        self._model = StereoModel.of(camera, self.noise_model, self.noise_at)
        self._camera = self._model.packed
        x, y, yaw = self._model.mount
        self._mount = np.array([x, y, math.cos(yaw), math.sin(yaw)])
        self._likeness = 1.0 / (1.0 + camera.sigma_descriptor**2)
        # what a landmark may be predicted beyond dmax by, and still be the one that was seen
        self._reach_m = 1.5 * camera.max_distance_m + 1.0
        self._rng, self._track_m = rng, prior.robot.track_m
        self._window = TravelWindow(self.window_s)
        n = self.n_particles
        self._maps = LandmarkMaps(n, self.maps, births=self.association != "known")
        self._state = ekf.new_state(self._maps.n_blocks)
        # lanes beyond the last particle are moved along, and never looked at
        self._n_lanes = self._maps.n_blocks * ekf.LANES
        turned = _rotated(start.covariance, -float(start.mean[2]))
        scatter = _root(turned) @ rng.standard_normal((3, self._n_lanes))
        drawn = se2.compose(start.mean, scatter.T)
        headings = drawn[:, 2]
        self._poses = np.stack([*drawn.T, np.cos(headings), np.sin(headings)])  # (5, lanes)
        self._log_weights, self._accumulated = np.zeros(n), np.zeros(n)
        self._lineages = Lineages(n)
        self._rolled = STILL  # motion not yet drawn
        self._root = np.zeros((3, 2))  # of its covariance
        self._take_stock()
        self._slot_of: dict[int, int] = {}
        # births: observations that started a landmark in some particle
        self._births = np.zeros(0, np.int64)
        self._bank = np.zeros((0, 0), np.float32)  # their descriptors
        self._n_observations, self._blind = 0, 0
        # of each Frame: its stamp, the draw it follows, and the motion since
        self._stamps: list[float] = []
        self._draws: list[int] = []
        self._since: list[Array] = []

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, draw, associate, weight, update and resample."""
        self._roll(frame)
        extras: dict[str, Any] = {"resampled": False}
        if frame.landmarks is not None:
            self._see(frame.landmarks, extras)
        elif self._rolled.covariance[2, 2] > _MOST_DRIFT_RAD**2:
            self._poses = self._move(self._normals())
            self._take_stock()
        belief = self._belief.then(self._rolled)
        best = int(np.argmax(self._accumulated))
        extras |= {
            "particles": self._drawn,
            "log_weights": self._log_weights,
            "ess": self._ess,
            "best": compose(self._drawn[best], self._rolled.mean)[0],
        }
        if self.keep_map:
            extras |= {k: v for k, v in self.map.items() if k.startswith("landmark")}
        self._stamps.append(frame.stamp)
        self._draws.append(len(self._lineages) - 1)
        self._since.append(self._rolled.mean)
        poor = self.ess_share >= 1.0 or self._ess < self.ess_share * self.n_particles
        if poor and "associations" in extras and np.any(extras["associations"] >= 0):
            self._resample()
            extras["resampled"] = True
        return Belief(belief.mean, belief.covariance, extras)

    def _see(self, seen: LandmarkSet, extras: dict[str, Any]) -> None:
        """Take in one image."""
        found, status = self._usable(seen)
        if status:
            extras["status"] = status
        points = np.ascontiguousarray(seen.points_in_camera[found])
        normals = self._normals()
        gained = np.zeros(self.n_particles)
        if self.association == "known":
            slots = self._known(seen, found)
            self._maps.touch(slots[slots >= 0])
        if self.proposal == "motion" or len(points) == 0:
            poses = self._move(normals)
            if self.association != "known":
                slots = self._associate(points, seen, found, np.zeros((3, 3)))
        else:
            self._move(np.zeros_like(normals))
            if self.association != "known":
                slots = self._associate(points, seen, found, self._seen_spread())
            gained += self._propose(normals, slots, points)
            poses = self._move(normals)
        gained += self._observe(slots, points)
        self._create(slots, points, seen, found)
        self._poses = poses
        weights = self._log_weights + gained
        if underflowed(weights):
            extras["status"] = "weights underflowed"
            weights, gained = np.zeros(self.n_particles), np.zeros(self.n_particles)
        self._log_weights = weights
        self._accumulated = self._accumulated + gained
        self._take_stock()
        best = int(np.argmax(self._accumulated))
        extras["associations"] = np.full(len(seen.points_in_camera), -1)
        extras["associations"][found] = self._origins(slots, best, found)
        self._n_observations += len(seen.points_in_camera)

    def finish(self) -> Estimate:
        """Path of the lineage of greatest accumulated weight, gil2008, eq. (20).

        The covariances are those of all weighted lineages. Where these have one ancestor in
        common they are zero, which says that the particles have died out, not that the path is
        known so well.
        """
        best = int(np.argmax(self._accumulated))
        weights = normalize(self._log_weights)
        n = len(self._lineages)
        drawn: list[Gaussian] = []
        for poses, rows in self._lineages.paths():
            by_row = np.bincount(rows, weights, minlength=len(poses)).astype(np.float64)
            drawn.append(Gaussian(poses[rows[best]], ekf.moments(poses, by_row)[1]))
        beliefs = [
            drawn[n - 1 - draw].then(Gaussian(since, np.zeros((3, 3))))
            for draw, since in zip(self._draws, self._since, strict=True)
        ]
        return Estimate(
            np.array(self._stamps),
            np.array([belief.mean for belief in beliefs]),
            np.array([belief.covariance for belief in beliefs]),
            kind="revised",
            map=self.map,
        )

    @property
    def map(self) -> dict[str, Array | Ints]:
        """The best particle's `landmarks` (N, 3) and `landmark_covariances` (N, 3, 3), in map.

        `origins` (N,) are the observations, counted over the run, that started them; `ids` (N,)
        are the sensor's, if it gives any.
        """
        best = int(np.argmax(self._accumulated))
        means, covariances, births = self._maps.of_particle(best)
        answer: dict[str, Array | Ints] = {
            "landmarks": means,
            "landmark_covariances": covariances,
            "origins": self._births[births],
        }
        if self.association == "known":
            answer["ids"] = np.array(list(self._slot_of), dtype=np.int64)
        return answer

    @property
    def bytes_per_particle(self) -> float:
        """Memory of the maps over the number of particles."""
        return self._maps.bytes_per_particle

    def _roll(self, frame: Frame) -> None:
        """Add the Frame's arc to the motion that is not yet drawn."""
        travel = frame.wheel_increments_m
        spread_m = self._window.push(frame.duration_s, travel)
        variances = wheel_variances(spread_m, self.kr, self.kl)
        motion, by_wheels = wheel_motion(travel, variances, self._track_m)
        if self._rolled is STILL:
            self._rolled, self._root = motion, by_wheels * np.sqrt(variances)
        else:
            self._rolled, self._root = self._rolled.then(motion), np.zeros((3, 0))

    def _normals(self) -> Array:
        """Standard normal draws (3, lanes); two rows for a single arc, which has two wheels."""
        root = np.zeros((3, 3))
        rank = self._root.shape[1] or 3
        root[:, :rank] = self._root if rank < 3 else _root(self._rolled.covariance)
        normals = np.zeros((3, self._n_lanes))
        self._rng.standard_normal(out=normals[:rank])
        self._root = root
        return normals

    def _move(self, normals: Array) -> Array:
        """Poses (5, lanes) after the motion, and the state that belongs to them."""
        moved = np.empty_like(self._poses)
        mean, mount = self._rolled.mean, self._mount
        ekf.move(self._poses, mean, self._root, normals, mount, moved, self._state)
        return moved

    def _take_stock(self) -> None:
        """Moments of the particles as they are drawn and weighted."""
        self._drawn = np.ascontiguousarray(self._poses[:3, : self.n_particles].T)
        self._lineages.append(self._drawn)
        self._rolled = STILL
        weights = normalize(self._log_weights)
        self._ess = 1.0 / float(weights @ weights)
        self._belief = Gaussian(*ekf.moments(self._drawn, weights))

    def _usable(self, seen: LandmarkSet) -> tuple[Ints, str]:
        """Rows of the observations that can be used, and what is wrong with the others."""
        usable = self._model.usable(seen.points_in_camera)
        status = "" if usable.all() else "observation without depth refused"
        if self.association == "known" and usable.any():
            if seen.ids is None:
                raise InputError("fastslam: observations without ids; set estimator.association")
            ids = seen.ids[usable]
            if len(set(ids.tolist())) < len(ids):
                first = np.flatnonzero(usable)[np.unique(ids, return_index=True)[1]]
                usable = np.isin(np.arange(len(usable)), first)
                status = "duplicate id refused"
        self._blind = 0 if usable.any() else self._blind + 1
        if self._blind >= _BLIND_IMAGES:
            status = f"no landmark in {self._blind} images"
        return np.flatnonzero(usable), status

    def _known(self, seen: LandmarkSet, found: Ints) -> Ints:
        """Slots (K,) by id, -1 for new ones."""
        self._ids = [] if seen.ids is None else seen.ids[found].tolist()
        return np.array([self._slot_of.get(i, -1) for i in self._ids], dtype=np.int64)

    def _associate(self, points: Array, seen: LandmarkSet, found: Ints, spread: Array) -> Ints:
        """Slots (K, M) of each particle, -1 for new ones."""
        slots = np.full((len(points), self.n_particles), -1)
        if self.association == "descriptor":
            if seen.descriptors is None:
                raise InputError(
                    "fastslam: observations without descriptors; set "
                    "estimator.association=mahalanobis"
                )
            unlikeness = self._unlikeness(seen.descriptors[found])
        else:
            unlikeness = np.zeros((len(points), 0))
        if len(points) == 0 or self._maps.n_slots == 0:
            return slots
        maps = self._maps
        candidates = maps.nearby(self._state, self._reach_m)
        maps.touch(candidates)
        ekf.associate(
            maps.data,
            candidates,
            maps.place,
            maps.counts,
            maps.births,
            points,
            unlikeness,
            spread,
            self.d0,
            self._state,
            self._camera,
            slots,
        )
        return slots

    def _unlikeness(self, descriptors: NDArray[np.float32]) -> Array:
        """-2 log of the likelihood ratio (K, births): the same landmark against another one.

        Of D independent components of unit vectors, the product of two of one landmark is
        N(rho, 1 / D), and of two of different ones N(0, 1 / D).
        """
        if len(self._bank) == 0:
            return np.zeros((len(descriptors), 0))
        products = (descriptors @ self._bank.T).astype(np.float64)
        rho = self._likeness
        scores: Array = descriptors.shape[1] * rho * (rho - 2.0 * products)
        return scores

    def _seen_spread(self) -> Array:
        """Covariance of the motion not yet drawn, in axes of the camera after it."""
        angle = -float(self._rolled.mean[2] + self._model.mount[2])
        return _rotated(self._rolled.covariance, angle)

    def _propose(self, normals: Array, slots: Ints, points: Array) -> Array:
        """Turn normals into draws given the image; log weights (M,) that these are owed.

        The first few observations place the particle, and all are linearised anew there: what
        is left to the second linearisation is a fraction of the motion's noise.
        """
        old = slots >= 0 if slots.ndim == 1 else (slots >= 0).any(axis=1)
        rows, points = self._maps.rows(slots[old]), points[old]
        inform = ekf.inform if slots.ndim == 1 else ekf.inform_each
        maps, state, camera = self._maps.data, self._state, self._camera
        start, owed = np.zeros_like(normals), np.empty((2, self._n_lanes))
        if len(rows):
            inform(maps, rows[:_PLACING], points[:_PLACING], state, camera)
            ekf.propose(self._poses, self._root, state, np.zeros_like(normals), start, owed)
            self._move(start)
        inform(maps, rows, points, state, camera)
        ekf.propose(self._poses, self._root, state, start, normals, owed)
        log_owed: Array = 0.5 * owed[0] - np.log(owed[1])
        return log_owed[: self.n_particles]

    def _observe(self, slots: Ints, points: Array) -> Array:
        """Update the landmarks seen again; log weights (M,), gil2008, eqs. (13) and (14)."""
        gained = np.zeros(self.n_particles)
        old = slots >= 0
        if slots.ndim == 1:
            gained += np.count_nonzero(~old) * math.log(self.p0)
            slots, points = slots[old], points[old]
            gained += ekf.log_scale(points, self._camera)
            update = ekf.update
        else:
            each = np.array([ekf.log_scale(point[None], self._camera) for point in points])
            gained += np.where(old, each[:, None], math.log(self.p0)).sum(axis=0)
            update = ekf.update_each
        rows = self._maps.rows(slots)
        for start in range(0, len(rows), ekf.GROUP):
            group = slice(start, start + ekf.GROUP)
            update(self._maps.data, rows[group], points[group], self._state, self._camera)
            gained += ekf.summed(self._state, self.n_particles)
        return gained

    def _create(self, slots: Ints, points: Array, seen: LandmarkSet, found: Ints) -> None:
        """Start a landmark for each observation without one, gil2008, eqs. (16)-(18)."""
        maps, each = self._maps, slots.ndim == 2
        fresh = slots < 0
        rows = np.flatnonzero(fresh.any(axis=1) if each else fresh)
        if len(rows) == 0:
            return
        missing = fresh[rows] if each else np.ones((len(rows), self.n_particles), bool)
        at = maps.counts + np.cumsum(missing, axis=0) - 1
        maps.reserve(int(at.max()) + 1)
        begun = np.where(missing, at, -1)
        maps.touch(np.arange(int(at[missing].min()), int(at.max()) + 1))
        ekf.create(maps.data, maps.rows(begun), points[rows], self._state, self._camera)
        if each:
            row, particle = np.nonzero(missing)
            maps.births[at[missing], particle] = len(self._births) + row
        born = self._n_observations + found[rows]
        self._births = np.concatenate([self._births, born])
        if self.association == "descriptor" and seen.descriptors is not None:
            fresh_ones = seen.descriptors[found[rows]]
            empty = len(self._bank) == 0
            self._bank = fresh_ones.copy() if empty else np.concatenate([self._bank, fresh_ones])
        maps.counts = maps.counts + missing.sum(axis=0)
        if not each:
            for i, number in zip(rows, begun[:, 0], strict=True):
                self._slot_of[self._ids[i]] = int(number)

    def _origins(self, slots: Ints, particle: int, found: Ints) -> Ints:
        """For each observation (K,) the one that started its landmark, in one particle."""
        chosen = slots if slots.ndim == 1 else slots[:, particle]
        own = self._n_observations + found
        if len(self._births) == 0:
            return own
        births = self._maps.birth_of(np.maximum(chosen, 0), particle)
        return np.where(chosen >= 0, self._births[births], own)

    def _resample(self) -> None:
        """Draw particles by their weights; survivors keep their place."""
        n = self.n_particles
        drawn = resample(self._log_weights, n, self._rng, self.resampling)
        ancestors = in_place(drawn, n)
        self._maps.resample(ancestors)
        self._lineages.resample(ancestors)
        self._poses[:, :n] = np.take(self._poses, ancestors, axis=1)
        self._drawn, self._accumulated = self._drawn[ancestors], self._accumulated[ancestors]
        self._log_weights = np.zeros(n)


def _root(covariance: Array) -> Array:
    """Matrix (3, 3) whose product with its transpose is the covariance, which may be singular."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _rotated(covariance: Array, angle_rad: float) -> Array:
    """Covariance (3, 3) of a pose in axes from which the old ones are turned by the angle."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    rotated: Array = turn @ covariance @ turn.T
    return rotated
