"""FastSLAM: a particle filter over the robot's path, with an EKF for each landmark (gil2008)."""

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimators import landmarks as ekf
from estimators.base import Belief, Estimate, Prior
from estimators.gaussian import STILL, Gaussian, compose, root, rotated
from estimators.landmarks import LandmarkMaps, Maps
from estimators.options import (
    require_choices,
    require_counts,
    require_non_negative,
    require_positive,
)
from estimators.particles import (
    Lineages,
    Scheme,
    in_place,
    normalize,
    resample,
    underflowed,
)
from estimators.slam_frontend import Association, Image, SlamFrontEnd
from estimators.stereo import NoiseAt, NoiseModel
from estimators.wheels import WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.recording import Frame
from sim.sensors import Reading

Proposal = Literal["motion", "optimal"]

_MOST_PARTICLES = 100_000  # a map of 100 landmarks each is about 1 GB
_PLACING = 4  # observations after which the proposal is linearised again
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
        FastSLAM 2.0, drawn from the motion given the image too, with the importance weight
        p(z | x) p(x) / q(x): a poor linearisation lowers the effective sample size, without bias.
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
    gate_probability, repeat_s
        Of known ids, as in `estimators.slam_frontend.SlamFrontEnd`: misread ones are left out, and
        a landmark counts once in `repeat_s`.
    maps
        `shared` or `contiguous`, see `estimators.landmarks.LandmarkMaps`: the same bits, at
        different speeds.
    kr, kl
        Believed slip variance per metre of the wheels, m.
    forward_slip_m
        Believed variance per metre of what both wheels slip together, m.
    slip_dof
        Degrees of freedom of the slip, which is then Student's t: wheels that slip in bursts leave
        a normal cloud behind. Each particle draws its own scale at each image. None: normal.
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
    was rejected; with `keep_map` also `landmarks` (N, 3) and `landmark_covariances` (N, 3, 3);
    `status` when an image was not used.

    `finish` gives the path of the best particle's lineage; `map` is its map.
    """

    needs = frozenset({"stereo"})

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
        gate_probability: float | None = None,
        repeat_s: float = 0.0,
        maps: Maps = "shared",
        kr: float = 5e-5,
        kl: float = 5e-5,
        forward_slip_m: float = 0.0,
        slip_dof: float | None = None,
        window_s: float = 0.05,
        keep_map: bool = False,
        stereo: str = "stereo",
    ) -> None:
        self.stereo = stereo
        require_counts(_MOST_PARTICLES, n_particles=n_particles)
        require_choices(
            proposal=(proposal, Proposal), resampling=(resampling, Scheme), maps=(maps, Maps)
        )
        require_non_negative(ess_share=ess_share)
        require_positive(p0=p0)
        if slip_dof is not None:
            require_positive(slip_dof=slip_dof)
        self.wheels = WheelPrediction(kr, kl, window_s, forward_slip_m=forward_slip_m)
        self.front_end = SlamFrontEnd(
            "fastslam",
            stereo,
            association,
            d0,
            noise_model,
            noise_at,
            gate_probability,
            repeat_s,
            sigma_column_px=sigma_column_px,
            sigma_row_px=sigma_row_px,
            sigma_disparity_px=sigma_disparity_px,
            sigma_descriptor=sigma_descriptor,
        )
        self.n_particles, self.proposal, self.resampling = n_particles, proposal, resampling
        self.slip_dof = slip_dof
        self.ess_share, self.p0, self.maps, self.keep_map = ess_share, p0, maps, keep_map

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Draw the particles from the prior, all with an empty map."""
        start = self.front_end.reset(prior)
        self._camera = self.front_end.camera.packed
        x, y, yaw = self.front_end.camera.mount
        self._mount = np.array([x, y, math.cos(yaw), math.sin(yaw)])
        self._rng = rng
        self.wheels.reset(prior.robot.track_m)
        n = self.n_particles
        self._maps = LandmarkMaps(n, self.maps, births=self.front_end.association != "known")
        self._state = ekf.new_state(self._maps.n_blocks)
        # lanes beyond the last particle are moved along, and never looked at
        self._n_lanes = self._maps.n_blocks * ekf.LANES
        self._stretch = np.ones(self._n_lanes)
        turned = rotated(start.covariance, -float(start.mean[2]))
        scatter = root((turned + turned.T) / 2.0) @ rng.standard_normal((3, self._n_lanes))
        drawn = se2.compose(start.mean, scatter.T)
        headings = drawn[:, 2]
        self._poses = np.stack([*drawn.T, np.cos(headings), np.sin(headings)])  # (5, lanes)
        self._log_weights, self._accumulated = np.zeros(n), np.zeros(n)
        self._lineages = Lineages(n)
        self._rolled = STILL  # motion not yet drawn
        self._root = np.zeros((3, 2))  # of its covariance
        self._take_stock()
        # of each Frame: its stamp, the draw it follows, and the motion since
        self._stamps: list[float] = []
        self._draws: list[int] = []
        self._since: list[Array] = []

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, draw, associate, weight, update and resample."""
        self._roll(frame)
        extras: dict[str, Any] = {"resampled": False}
        seen = frame.readings.get(self.stereo)
        if seen is not None:
            self._see(seen, frame.stamp, extras)
        elif self._rolled.covariance[2, 2] > _MOST_DRIFT_RAD**2:
            self._poses = self._move(self._normals())
            self._take_stock()
        belief = self._belief.then(self._rolled)
        extras |= {
            "particles": self._drawn,
            "log_weights": self._log_weights,
            "ess": self._ess,
            "best": compose(self._drawn[self._best], self._rolled.mean)[0],
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

    def _see(self, seen: Reading, stamp_s: float, extras: dict[str, Any]) -> None:
        """Take in one image."""
        image = self.front_end.read(seen, stamp_s)
        if image.status:
            extras["status"] = image.status
        points, normals = image.points, self._normals()
        gained = np.zeros(self.n_particles)
        known = self.front_end.association == "known"
        if known:
            slots = self.front_end.known(image)
            if self.front_end.gated and len(slots):
                passed = self._passed(image, slots)
                image, slots, points = image.of(passed), slots[passed], points[passed]
            self._maps.touch(slots[slots >= 0])
        self.front_end.counted(image, stamp_s)
        by_motion = self.proposal == "motion" or len(points) == 0
        poses = self._move(normals if by_motion else np.zeros_like(normals))
        if not known:
            slots = self._associate(image, np.zeros((3, 3)) if by_motion else self._seen_spread())
        if not by_motion:
            gained += self._propose(normals, slots, points)
            poses = self._move(normals)
        gained += self._observe(slots, points)
        self._create(slots, image)
        self._poses = poses
        weights = self._log_weights + gained
        if underflowed(weights):
            extras["status"] = "weights underflowed"
            weights, gained = np.zeros(self.n_particles), np.zeros(self.n_particles)
        self._log_weights = weights
        self._accumulated = self._accumulated + gained
        self._take_stock()
        landmarks = self._landmarks(slots, self._best)
        extras["associations"] = self.front_end.associations(image, landmarks)

    def finish(self) -> Estimate:
        """Path of the lineage of greatest accumulated weight, gil2008, eq. (20).

        The covariances are those of all weighted lineages. They are zero where all lineages share
        one ancestor: a sign of particle depletion, not of a path known exactly.
        """
        best, weights = self._best, normalize(self._log_weights)
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
        return self.front_end.map(*self._maps.of_particle(self._best))

    @property
    def bytes_per_particle(self) -> float:
        """Memory of the maps over the number of particles."""
        return self._maps.bytes_per_particle

    @property
    def _best(self) -> int:
        """Number of the particle of greatest accumulated weight."""
        return int(np.argmax(self._accumulated))

    def _roll(self, frame: Frame) -> None:
        """Add the Frame's arc to the motion that is not yet drawn."""
        motion, root_ = self.wheels.predict_with_root(frame)
        if self._rolled is STILL:
            self._rolled, self._root = motion, root_ if root_.shape[1] < 3 else np.zeros((3, 0))
        else:
            self._rolled, self._root = self._rolled.then(motion), np.zeros((3, 0))

    def _normals(self) -> Array:
        """Standard normal draws (3, lanes); two rows for a single arc, which has two wheels."""
        rolled, rank = np.zeros((3, 3)), self._root.shape[1] or 3
        covariance = self._rolled.covariance
        rolled[:, :rank] = self._root if rank < 3 else root((covariance + covariance.T) / 2.0)
        normals = np.zeros((3, self._n_lanes))
        self._rng.standard_normal(out=normals[:rank])
        if self.slip_dof is not None:  # Student's t: a normal over the root of its own chi-square
            squares = self._rng.chisquare(self.slip_dof, self._n_lanes) / self.slip_dof
            self._stretch = 1.0 / np.sqrt(squares)
        self._root = rolled
        return normals

    def _move(self, normals: Array) -> Array:
        """Poses (5, lanes) after the motion, and the state that belongs to them."""
        mean, mount, noise = self._rolled.mean, self._mount, self._stretch * normals
        return ekf.move(self._poses, mean, self._root, noise, mount, self._state)

    def _take_stock(self) -> None:
        """Moments of the particles as they are drawn and weighted."""
        self._drawn = np.ascontiguousarray(self._poses[:3, : self.n_particles].T)
        self._drawn[:, 2] = se2.wrap(self._drawn[:, 2])
        self._lineages.append(self._drawn)
        self._rolled = STILL
        weights = normalize(self._log_weights)
        self._ess = 1.0 / float(weights @ weights)
        self._belief = Gaussian(*ekf.moments(self._drawn, weights))

    def _associate(self, image: Image, spread: Array) -> Ints:
        """Slots (K, M) of each particle, -1 for new ones."""
        maps, points = self._maps, image.points
        slots = np.full((len(points), self.n_particles), -1)
        unlikeness = self.front_end.unlikeness(image)
        if len(points) == 0 or maps.n_slots == 0:
            return slots
        near = maps.nearby(self._state, self.front_end.reach_m)
        maps.touch(near)
        ekf.associate(
            maps.data,
            ekf.Candidates(near, maps.place, maps.counts, maps.births),
            points,
            unlikeness,
            spread,
            self.front_end.d0,
            self._state,
            self._camera,
            slots,
        )
        return slots

    def _passed(self, image: Image, slots: Ints) -> NDArray[np.bool_]:
        """Which observations (K,) of landmarks in these slots pass the best particle's gate."""
        camera, old = self.front_end.camera, slots >= 0
        moved = Gaussian(self._drawn[self._best], np.zeros((3, 3))).then(self._rolled)
        means, covariances, _ = self._maps.of_particle(self._best)
        predicted, of_pose, of_landmark = camera.predict(moved.mean, means[slots[old]])
        v, R = camera.innovation(predicted, image.points[old])
        turned = of_landmark.transpose(0, 2, 1)
        S = of_pose @ moved.covariance @ of_pose.transpose(0, 2, 1) + R
        S += of_landmark @ covariances[slots[old]] @ turned
        distances = np.sum(v * np.linalg.solve(S, v[..., None])[..., 0], axis=-1)
        return self.front_end.passed(image, slots, distances, moved.mean)

    def _seen_spread(self) -> Array:
        """Covariance of the motion not yet drawn, in axes of the camera after it."""
        angle = -float(self._rolled.mean[2] + self.front_end.camera.mount[2])
        return rotated(self._rolled.covariance, angle)

    def _propose(self, normals: Array, slots: Ints, points: Array) -> Array:
        """Turn normals into draws given the image; their log importance weights (M,).

        The first few observations place the particle, and all are linearised again there: the
        second linearisation only has to hold over a fraction of the motion's noise.
        """
        old = slots >= 0 if slots.ndim == 1 else (slots >= 0).any(axis=1)
        rows, points = self._maps.rows(slots[old]), points[old]
        inform = ekf.inform if slots.ndim == 1 else ekf.inform_each
        maps, state, camera = self._maps.data, self._state, self._camera
        start, owed = np.zeros_like(normals), np.empty((2, self._n_lanes))
        if len(rows):
            inform(maps, rows[:_PLACING], points[:_PLACING], state, camera)
            ekf.propose(
                self._poses, self._root, self._stretch, state, np.zeros_like(normals), start, owed
            )
            self._move(start)
        inform(maps, rows, points, state, camera)
        ekf.propose(self._poses, self._root, self._stretch, state, start, normals, owed)
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

    def _create(self, slots: Ints, image: Image) -> None:
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
        ekf.create(maps.data, maps.rows(begun), image.points[rows], self._state, self._camera)
        if each:
            row, particle = np.nonzero(missing)
            maps.births[at[missing], particle] = len(self.front_end.origins) + row
        self.front_end.start(image, rows)
        maps.counts = maps.counts + missing.sum(axis=0)

    def _landmarks(self, slots: Ints, particle: int) -> Ints:
        """Number (K,) of each observation's landmark in one particle, -1 for new ones."""
        chosen = slots if slots.ndim == 1 else slots[:, particle]
        return np.where(chosen >= 0, self._maps.birth_of(np.maximum(chosen, 0), particle), -1)

    def _resample(self) -> None:
        """Draw particles by their weights; survivors keep their place."""
        n = self.n_particles
        ancestors = in_place(resample(self._log_weights, n, self._rng, self.resampling), n)
        self._maps.resample(ancestors)
        self._lineages.resample(ancestors)
        self._poses[:, :n] = np.take(self._poses, ancestors, axis=1)
        self._drawn, self._accumulated = self._drawn[ancestors], self._accumulated[ancestors]
        self._log_weights = np.zeros(n)
