"""FastSLAM: a particle filter over the robot's path, with an EKF for each landmark (gil2008)."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimators import landmarks as ekf
from estimators.base import Belief, Estimate, Prior
from estimators.landmarks import LandmarkMaps, Maps
from estimators.particles import (
    SCHEMES,
    Lineages,
    Scheme,
    effective_sample_size,
    in_place,
    normalize,
    resample,
    underflowed,
)
from estimators.stereo import NoiseAt, NoiseModel, StereoModel
from sim import se2
from sim.errors import InputError
from sim.recording import Frame, LandmarkSet
from sim.robot import TravelWindow, arc_increment, arc_increment_jacobian, wheel_variances

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Proposal = Literal["motion", "optimal"]
Association = Literal["known", "mahalanobis", "descriptor"]

_BLIND_IMAGES = 100  # images without a landmark after which the status says so
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
        FastSLAM 2.0, drawn from the motion given the image too, linearised in the noise of the
        motion, with the weight that this proposal is owed, p(z | x) p(x) / q(x).
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
    Belief mean and covariance are those of the weighted particles. Extras: `particles` (M, 3),
    `log_weights` (M,), before resampling; `ess`, of the last image; `resampled`; `best` (3,), the
    pose of the particle of greatest accumulated log weight, carried along the ancestry, eq. (20);
    `associations` (K,) of that particle: for each observation, counted from 0 over the whole run,
    the one that started its landmark, itself if it is the first, -1 if it was refused; with
    `keep_map` also `landmarks` (N, 3) and `landmark_covariances` (N, 3, 3); `status` when an
    image was of no use.

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
        p0: float = 1e-2,
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
        for name, (value, allowed) in choices.items():
            if value not in allowed:
                raise InputError(f"estimator.{name} must be {' or '.join(allowed)}, got {value!r}")
        believed = {
            "sigma_column_px": sigma_column_px,
            "sigma_row_px": sigma_row_px,
            "sigma_disparity_px": sigma_disparity_px,
            "sigma_descriptor": sigma_descriptor,
        }
        self._believed = {name: sigma for name, sigma in believed.items() if sigma is not None}
        numbers = {"ess_share": ess_share, "kr": kr, "kl": kl, "window_s": window_s}
        for name, number in {**numbers, **self._believed}.items():
            if not (math.isfinite(number) and number >= 0.0):
                raise InputError(f"estimator.{name} must be zero or positive, got {number}")
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
        camera = prior.sensors.stereo
        if camera is None:
            raise InputError("fastslam needs a stereo camera; choose sensors that have one")
        if prior.mean is None or prior.covariance is None:
            raise InputError("fastslam needs a start pose; set prior.start=tracking")
        if self.association == "known" and not camera.identifies:
            raise InputError(
                "the camera does not identify landmarks; set estimator.association=mahalanobis "
                "or descriptor"
            )
        believed: dict[str, Any] = self._believed
        camera = dataclasses.replace(camera, **believed)
        self._model = StereoModel.of(camera, self.noise_model, self.noise_at)
        self._camera = self._model.packed
        self._likeness = 1.0 / (1.0 + camera.sigma_descriptor**2)
        # what a landmark may be predicted beyond dmax by, and still be the one that was seen
        self._reach_m = 1.5 * camera.max_distance_m + 1.0
        self._rng, self._track_m = rng, prior.robot.track_m
        self._window = TravelWindow(self.window_s)
        n = self.n_particles
        body = np.array([0.0, 0.0, prior.mean[2]])
        turned = _rotated(prior.covariance, -float(prior.mean[2]))
        scatter = rng.standard_normal((n, 3)) @ _root(turned).T
        self._poses = se2.compose(prior.mean, np.zeros((n, 3)))
        self._poses[:, :2] += se2.transform(body, scatter[:, :2])
        self._poses[:, 2] = se2.wrap(self._poses[:, 2] + scatter[:, 2])
        self._log_weights, self._accumulated = np.zeros(n), np.zeros(n)
        self._maps = LandmarkMaps(n, self.maps)
        self._state = ekf.new_state(self._maps.n_blocks)
        self._lineages = Lineages(n)
        self._rolled, self._spread = np.zeros(3), np.zeros((3, 3))  # motion not yet drawn
        self._slot_of: dict[int, int] = {}
        # births: observations that started a landmark in some particle
        self._births = np.zeros(0, np.int64)
        self._bank = np.zeros((0, 0), np.float32)  # their descriptors
        self._n_observations, self._blind, self._ess = 0, 0, float(n)
        self._stamps: list[float] = []

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, draw, associate, weight, update and resample."""
        self._roll(frame)
        if frame.landmarks is None:
            if math.sqrt(self._spread[2, 2]) > _MOST_DRIFT_RAD:
                self._draw_motion()
            return self._answer(frame, {})
        found, status = self._usable(frame.landmarks)
        extras: dict[str, Any] = {"status": status} if status else {}
        points = np.ascontiguousarray(frame.landmarks.points_in_camera[found])
        normals = self._rng.standard_normal((self.n_particles, 3))
        root = _root(self._spread)
        if self.association == "known":
            slots = self._known(frame.landmarks, found)
            self._maps.touch(slots[slots >= 0])
        if self.proposal == "motion" or len(points) == 0:
            poses = self._move(root, normals)
            if self.association != "known":
                slots = self._associate(points, frame.landmarks, found, np.zeros((3, 3)))
            gained = np.zeros(self.n_particles)
        else:
            poses = self._move(root, np.zeros_like(normals))
            if self.association != "known":
                slots = self._associate(points, frame.landmarks, found, self._seen_spread())
            gained = self._propose(root, normals, slots, points)
            poses = self._move(root, normals)
        gained += self._observe(slots, points)
        associations = np.full(len(frame.landmarks.points_in_camera), -1)
        self._create(slots, points, frame.landmarks, found)
        self._poses = poses
        self._rolled, self._spread = np.zeros(3), np.zeros((3, 3))
        weights = self._log_weights + gained
        if underflowed(weights):
            extras["status"] = "weights underflowed"
            weights, gained = np.zeros(self.n_particles), np.zeros(self.n_particles)
        self._log_weights = weights
        self._accumulated += gained
        best = int(np.argmax(self._accumulated))
        associations[found] = self._origins(slots, best, found)
        self._n_observations += len(associations)
        extras["associations"] = associations
        self._ess = effective_sample_size(weights)
        belief = self._answer(frame, extras)
        poor = self.ess_share >= 1.0 or self._ess < self.ess_share * self.n_particles
        if poor and len(points) > 0:
            self._resample()
            belief.extras["resampled"] = True
        return belief

    def finish(self) -> Estimate:
        """Path of the lineage of greatest accumulated weight, gil2008, eq. (20).

        The covariances are those of all weighted lineages. Where these have one ancestor in
        common they are zero, which says that the particles have died out, not that the path is
        known so well.
        """
        best = int(np.argmax(self._accumulated))
        weights = normalize(self._log_weights)
        n = len(self._lineages)
        means, covariances = np.empty((n, 3)), np.empty((n, 3, 3))
        for i, (poses, rows) in zip(range(n - 1, -1, -1), self._lineages.paths(), strict=True):
            means[i] = poses[rows[best]]
            by_row = np.bincount(rows, weights, minlength=len(poses)).astype(np.float64)
            covariances[i] = _moments(poses, by_row)[1]
        return Estimate(np.array(self._stamps), means, covariances, kind="revised", map=self.map)

    @property
    def map(self) -> dict[str, Array | Ints]:
        """The best particle's `landmarks` (N, 3) and `landmark_covariances` (N, 3, 3), in map.

        `origins` (N,) are the observations, counted over the run, that started them; `ids` (N,)
        are the sensor's, if it gives any.
        """
        best = int(np.argmax(self._accumulated))
        means, covariances, origins = self._maps.of_particle(best)
        answer: dict[str, Array | Ints] = {
            "landmarks": means,
            "landmark_covariances": covariances,
            "origins": self._births[origins],
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
        step = arc_increment(travel, self._track_m)
        by_wheels = arc_increment_jacobian(travel, self._track_m)
        Q = by_wheels @ np.diag(wheel_variances(spread_m, self.kr, self.kl)) @ by_wheels.T
        by_pose, by_step = se2.compose_jacobians(self._rolled, step)
        self._spread = by_pose @ self._spread @ by_pose.T + by_step @ Q @ by_step.T
        self._rolled = se2.compose(self._rolled, step)

    def _draw_motion(self) -> None:
        """Draw the motion since the last image, without an image."""
        normals = self._rng.standard_normal((self.n_particles, 3))
        self._poses = self._move(_root(self._spread), normals)
        self._rolled, self._spread = np.zeros(3), np.zeros((3, 3))

    def _move(self, root: Array, normals: Array) -> Array:
        """Poses (M, 3) after the motion, and the state that belongs to them."""
        moved, mount = np.empty_like(self._poses), self._model.mount
        ekf.move(self._poses, self._rolled, root, normals, mount, moved, self._state)
        return moved

    def _usable(self, seen: LandmarkSet) -> tuple[Ints, str]:
        """Rows of the observations that can be used, and what is wrong with the others."""
        usable = self._model.usable(seen.points_in_camera)
        status = "" if usable.all() else "observation without depth refused"
        if self.association == "known":
            if seen.ids is None:
                raise InputError("fastslam: observations without ids; set estimator.association")
            first = np.zeros(len(usable), bool)
            rows = np.flatnonzero(usable)
            first[rows[np.unique(seen.ids[rows], return_index=True)[1]]] = True
            if np.any(usable & ~first):
                status = "duplicate id refused"
            usable &= first
        self._blind = 0 if usable.any() else self._blind + 1
        if self._blind >= _BLIND_IMAGES:
            status = f"no landmark in {self._blind} images"
        return np.flatnonzero(usable), status

    def _known(self, seen: LandmarkSet, found: Ints) -> Ints:
        """Slots (K,) by id, -1 for new ones."""
        assert seen.ids is not None
        self._new_ids = [int(i) for i in seen.ids[found] if int(i) not in self._slot_of]
        return np.array([self._slot_of.get(int(i), -1) for i in seen.ids[found]], dtype=np.int64)

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
        candidates = maps.nearby(self._state, self._reach_m, self._camera)
        maps.touch(candidates)
        ekf.associate(
            maps.data,
            candidates,
            maps.counts,
            maps.origin,
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
        products = (descriptors @ self._bank.T).astype(np.float64)
        rho = self._likeness
        scores: Array = descriptors.shape[1] * rho * (rho - 2.0 * products)
        return scores

    def _seen_spread(self) -> Array:
        """Covariance of the motion not yet drawn, in axes of the camera after it."""
        return _rotated(self._spread, -float(self._rolled[2] + self._model.mount[2]))

    def _propose(self, root: Array, normals: Array, slots: Ints, points: Array) -> Array:
        """Turn normals into draws given the image; log weights (M,) that these are owed."""
        if slots.ndim == 1:
            old = slots >= 0
            ekf.inform(self._maps.data, slots[old], points[old], self._state, self._camera)
        else:
            ekf.inform_each(self._maps.data, slots, points, self._state, self._camera)
        owed = np.empty(self.n_particles)
        ekf.propose(self._poses, root, self._state, normals, owed)
        return owed

    def _observe(self, slots: Ints, points: Array) -> Array:
        """Update the landmarks seen again; log weights (M,), gil2008, eqs. (13) and (14)."""
        gained = np.zeros(self.n_particles)
        old = slots >= 0
        if slots.ndim == 1:
            gained += np.count_nonzero(~old) * math.log(self.p0)
            slots, points = slots[old], points[old]
            gained -= len(slots) * ekf.LOG_2PI_1_5
            update = ekf.update
        else:
            again = np.count_nonzero(old, axis=0)
            gained += (len(slots) - again) * math.log(self.p0) - again * ekf.LOG_2PI_1_5
            update = ekf.update_each
        for start in range(0, len(slots), ekf.GROUP):
            group = slice(start, start + ekf.GROUP)
            update(self._maps.data, slots[group], points[group], self._state, self._camera)
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
        maps.touch(np.arange(int(at[missing].min()), min(int(at.max()) + 1, maps.n_slots)))
        ekf.create(maps.data, begun, points[rows], self._state, self._camera)
        births = len(self._births) + np.arange(len(rows))
        maps.origin[at[missing], np.nonzero(missing)[1]] = births[np.nonzero(missing)[0]]
        born = self._n_observations + found[rows]
        self._births = np.concatenate([self._births, born])
        if self.association == "descriptor" and seen.descriptors is not None:
            fresh_ones = seen.descriptors[found[rows]]
            empty = len(self._bank) == 0
            self._bank = fresh_ones.copy() if empty else np.concatenate([self._bank, fresh_ones])
        maps.counts = maps.counts + missing.sum(axis=0)
        if not each:
            for offset, landmark_id in enumerate(self._new_ids):
                self._slot_of[landmark_id] = int(begun[offset, 0])

    def _origins(self, slots: Ints, particle: int, found: Ints) -> Ints:
        """For each observation (K,) the one that started its landmark, in one particle."""
        chosen = slots if slots.ndim == 1 else slots[:, particle]
        own = self._n_observations + found
        if len(self._maps.origin) == 0:
            return own
        births = self._maps.origin[np.maximum(chosen, 0), particle]
        return np.where(chosen >= 0, self._births[births], own)

    def _resample(self) -> None:
        """Draw particles by their weights; survivors keep their place."""
        n = self.n_particles
        drawn = resample(self._log_weights, n, self._rng, self.resampling)
        ancestors = in_place(drawn, n)
        self._maps.resample(ancestors)
        self._lineages.resample(ancestors)
        self._poses = self._poses[ancestors]
        self._accumulated = self._accumulated[ancestors]
        self._log_weights = np.zeros(n)

    def _answer(self, frame: Frame, extras: dict[str, Any]) -> Belief:
        """Moments of the particles, composed with the motion that is not yet drawn."""
        poses = self._poses
        if np.any(self._rolled) or np.any(self._spread):
            poses = se2.compose(poses, self._rolled)
        self._lineages.append(poses)
        self._stamps.append(frame.stamp)
        mean, covariance = _moments(poses, normalize(self._log_weights))
        if np.any(self._spread):
            before = float(se2.wrap(mean[2] - self._rolled[2]))
            covariance = covariance + _rotated(self._spread, before)
        best = int(np.argmax(self._accumulated))
        extras |= {
            "particles": poses.copy(),
            "log_weights": self._log_weights.copy(),
            "ess": self._ess,
            "resampled": False,
            "best": poses[best].copy(),
        }
        if self.keep_map:
            extras |= {k: v for k, v in self.map.items() if k.startswith("landmark")}
        return Belief(mean, covariance, extras)


def _moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of weighted poses (M, 3); the mean heading is circular."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    mean = np.array([*(weights @ poses[:, :2]), math.atan2(weights @ sin, weights @ cos)])
    off = poses - mean
    off[:, 2] = se2.wrap(off[:, 2])
    covariance: Array = (off * weights[:, None]).T @ off
    return mean, (covariance + covariance.T) / 2.0


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
