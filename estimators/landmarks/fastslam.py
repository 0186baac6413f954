"""FastSLAM: a particle filter over the robot's path, with an EKF for each landmark (gil2008)."""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from estimators.base import Belief, Estimate, Prior, TeamEstimator
from estimators.gaussian import STILL, Gaussian, compose, rotate
from estimators.landmarks import particle_kernels as ekf
from estimators.landmarks.joint import mahalanobis_squared
from estimators.landmarks.particle_maps import LandmarkMaps, Maps
from estimators.landmarks.particle_path import ParticlePath, packed_mount
from estimators.landmarks.sightings import Sightings, dead_reckoning, team_starts
from estimators.landmarks.slam_frontend import Image, LandmarkSlamOptions, SlamFrontEnd
from estimators.lost import Unexplained
from estimators.particles import Scheme, have_underflowed, keep_survivors, normalize, resample
from sim.arrays import Array, Ints
from sim.errors import required
from sim.options import NonNegative, Positive, options
from sim.recording import Frame

Proposal = Literal["motion", "optimal"]
Start = Literal["apart", "drawn"]

_MOST_PARTICLES = 100_000  # a map of 100 landmarks each is about 1 GB
_PLACING = 4  # observations after which the proposal is linearised again
_MOST_DRIFT_RAD = 0.1  # heading spread at which motion is drawn without waiting for an image


@options("estimator")
class FastSlamOptions(LandmarkSlamOptions):
    """Options of FastSLAM."""

    n_particles: Annotated[int, Field(ge=1, le=_MOST_PARTICLES)] = 200
    """M."""
    proposal: Proposal = "optimal"
    """`motion`: FastSLAM 1.0, drawn from the motion model and weighted by eq. (13). `optimal`:
    FastSLAM 2.0, drawn from the motion given the image too, with the importance weight
    p(z | x) p(x) / q(x): a poor linearisation lowers the effective sample size, without bias."""
    resampling: Scheme = "systematic"
    """Scheme of `estimators.particles.resample`."""
    ess_share: NonNegative = 0.5
    """Resample when the effective sample size is below this share of M; 1: at every image, as the
    paper does."""
    p0: Positive = 1e-3
    """Weight of an observation that starts a landmark, eq. (19), as a density, 1/m^3. It cancels
    when all particles start the same ones, as under known association."""
    maps: Maps = "shared"
    """`shared` or `contiguous`, see `estimators.landmarks.particle_maps.LandmarkMaps`: the same
    bits, at different speeds."""
    start: Start = "apart"
    """Where the particles of a lone robot begin. `apart`: at the mean of its start; its covariance
    is added to theirs, turned along the path, as nothing that the robot sees tells of an error of
    the start. `drawn`: as the start's covariance has them, and as a team's are; each resampling
    then takes a part of that spread away."""
    slip_dof: Positive | None = None
    """Degrees of freedom of the slip, which is then Student's t: wheels that slip in bursts leave a
    normal cloud behind. Each particle draws its own scale at each image. null: normal."""


class FastSLAM(FastSlamOptions, TeamEstimator):
    """Rao-Blackwellised SLAM: each particle is a path, and has a map of its own.

    At an image the motion since the last one is drawn, the landmarks seen are associated,
    weights get the product over the observations (gil2008, eq. (14)), the EKFs are updated by
    eqs. (3)-(8), and the particles are resampled. Between images they roll by the wheels' mean.

    Of a team each particle holds the paths of all robots, and one map. A sighting weighs the
    particle by the distance that it gives the two robots; it is not part of the proposal.

    Notes
    -----
    Belief mean and covariance are those of the weighted particles, and by default what the start
    adds. Extras: `particles` (M, 3) and
    `log_weights` (M,) as of the last image; `ess`; `resampled`, after these were taken; `best`
    (3,), the pose of the particle of greatest accumulated log weight, carried along the ancestry,
    eq. (20); at an image `associations` (K,) of that particle: for each observation, counted from
    0 over the whole run, the one that started its landmark, itself if it is the first, -1 if it
    was rejected; with `keep_map` also `landmarks` (N, 3) and `landmark_covariances` (N, 3, 3);
    `status` when an image was not used; with each image `lost`, from 0 to 1, by known ids.

    `finish` gives the path of the best particle's lineage; `map` is its map.
    """

    needs = frozenset({"stereo"})

    def reset_team(self, priors: Sequence[Prior], rng: np.random.Generator) -> None:
        """Draw the particles of a team from the priors of its robots, whose starts are known.

        Raises
        ------
        InputError
            If the robots do not carry the same sensors, or a start is unknown.
        """
        self.front_end = SlamFrontEnd(self, priors[0], "fastslam")
        starts = team_starts(priors, self.front_end, "fastslam")
        noise = self.noise_model, self.noise_at
        self._sightings = Sightings.of(priors, self.robots, "fastslam", *noise)
        self._camera = self.front_end.camera.packed
        self._rng = rng
        n = self.n_particles
        self._maps = LandmarkMaps(n, self.maps, births=not self.front_end.identified)
        mount, n_blocks = self.front_end.camera.mount, self._maps.n_blocks
        self._paths = []
        self._unexplained = [Unexplained() for _ in priors]
        for start, wheels in zip(starts, dead_reckoning(self, priors), strict=True):
            start = required(start, "fastslam needs the starts of all robots; ekf_slam does not")
            path = ParticlePath(wheels, self.slip_dof, mount, n, n_blocks)
            path.scatter(start, rng, draws_start=self.start == "drawn" or len(priors) > 1)
            self._paths.append(path)
        self._log_weights, self._accumulated = np.zeros((2, n))
        for path in self._paths:
            path.settle()
        self._weigh()

    def step_team(self, frames: Sequence[Frame]) -> list[Belief]:
        """Take in the Frames of one instant; the belief of each of their robots."""
        informed = False
        extras: list[dict[str, Any]] = [{"resampled": False} for _ in frames]
        for frame in frames:
            self._paths[frame.robot].roll(frame)
        for frame, own in zip(frames, extras, strict=True):
            path = self._paths[frame.robot]
            if self.stereo in frame.readings:
                self._see(path, frame, own)
                informed |= bool(np.any(own["associations"] >= 0))
            elif path.rolled.covariance[2, 2] > _MOST_DRIFT_RAD**2:
                path.draw(self._rng)
                self._weigh()
        if self._sightings is not None and len(frames) > 1:
            for frame in frames:
                informed |= self._sight(self._sightings, frame, frames)
        poor = self.ess_share >= 1.0 or self._ess < self.ess_share * self.n_particles
        beliefs = [self._belief(*each) for each in zip(frames, extras, strict=True)]
        if poor and informed:
            self._resample()
            for belief in beliefs:
                belief.extras["resampled"] = True
        return beliefs

    def _belief(self, frame: Frame, extras: dict[str, Any]) -> Belief:
        """Belief of a Frame's robot; the Frame is noted for `finish`."""
        path = self._paths[frame.robot]
        belief = path.place(path.belief.then(path.rolled))
        extras |= {
            "particles": path.drawn,
            "log_weights": self._log_weights,
            "ess": self._ess,
            "best": compose(path.drawn[self._best], path.rolled.mean)[0],
        }
        if "associations" in extras and self.front_end.identified:
            extras["lost"] = self._unexplained[frame.robot].lost(frame.stamp, belief.covariance)
        if self.keep_map:
            extras |= {k: v for k, v in self.map.items() if k.startswith("landmark")}
        path.note(frame.stamp)
        return Belief(belief.mean, belief.covariance, extras)

    def _see(self, path: ParticlePath, frame: Frame, extras: dict[str, Any]) -> None:
        """Take in one image of a robot."""
        image = self.front_end.read(frame)
        if image.status:
            extras["status"] = image.status
        points, normals = image.points, path.normals(self._rng)
        gained = np.zeros(self.n_particles)
        known = self.front_end.identified
        if known:
            slots = self.front_end.known(image)
            distances, pose = self._distances(path, image, slots)
            far = int((distances > self.d0).sum())
            self._unexplained[frame.robot].note(frame.stamp, far, len(distances))
            if self.gate_probability is not None and len(slots):
                passed = self.front_end.passed(image, slots, distances, pose)
                image, slots, points = image.select(passed), slots[passed], points[passed]
            self._maps.touch(slots[slots >= 0])
        self.front_end.note_counted(image, frame)
        by_motion = self.proposal == "motion" or len(points) == 0
        poses = path.move(normals if by_motion else np.zeros_like(normals))
        if not known:
            # of the motion not yet drawn, in axes of the camera after it
            angle = -float(path.rolled.mean[2] + self.front_end.camera.mount[2])
            spread = np.zeros((3, 3)) if by_motion else rotate(path.rolled.covariance, angle)
            slots = self._associate(path, image, spread)
        if not by_motion:
            gained += self._propose(path, normals, slots, points)
            poses = path.move(normals)
        gained += self._observe(path, slots, points)
        self._create(path, slots, image)
        path.poses = poses
        path.settle()
        if not self._gain(gained):
            extras["status"] = "weights underflowed"
        chosen = slots if slots.ndim == 1 else slots[:, self._best]
        numbers = self._maps.birth_of(np.maximum(chosen, 0), self._best)
        landmarks = np.where(chosen >= 0, numbers, -1)
        extras["associations"] = self.front_end.associations(image, landmarks)

    def _gain(self, gained: Array) -> bool:
        """Add log weights (M,); with False, and equal weights, if all have underflowed."""
        weights = self._log_weights + gained
        lost = have_underflowed(weights)
        self._log_weights = np.zeros(self.n_particles) if lost else weights
        self._accumulated = self._accumulated + (0.0 if lost else gained)
        self._weigh()
        return not lost

    def _sight(self, sightings: Sightings, frame: Frame, frames: Sequence[Frame]) -> bool:
        """Weigh by a robot's sightings of others that have a Frame at this instant too.

        A robot that is seen is, in each particle, a landmark known without error.
        """
        camera, path = sightings.camera.packed, self._paths[frame.robot]
        mount, state = packed_mount(sightings.camera.mount), ekf.new_state(self._maps.n_blocks)
        used = False
        for number, point in sightings.identified(frame, frames, "fastslam"):
            for each in (path, self._paths[number]):
                if each.rolled is not STILL:
                    each.draw(self._rng)
            path.move(np.zeros((3, path.poses.shape[1])), mount, state)
            marker = ekf.known_landmark(self._paths[number].poses, sightings.marker_z_m)
            ekf.update(marker, np.zeros(1, np.int64), point[None], state, camera)
            if ekf.distances(state, self.n_particles).min() < self.sighting_d0:
                used = True
                gained = ekf.log_weights(state, self.n_particles)
                self._gain(gained + ekf.log_scale(point[None], camera))
        return used

    def finish(self) -> Estimate:
        """Path of the lineage of greatest accumulated weight, gil2008, eq. (20).

        The covariances are twice those of all weighted lineages, as the path is a draw from them;
        where lineages share an ancestor, what the filter knew then stands for their spread.
        """
        return self.finish_team()[0]

    def finish_team(self) -> list[Estimate]:
        """Path of each robot, as `finish` has it."""
        best, weights = self._best, normalize(self._log_weights)
        return [path.revised(best, weights, self.map) for path in self._paths]

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

    def _weigh(self) -> None:
        """Moments of the particles as they are drawn and weighted."""
        weights = normalize(self._log_weights)
        self._ess = 1.0 / float(weights @ weights)
        for path in self._paths:
            path.weigh(weights)

    def _associate(self, path: ParticlePath, image: Image, spread: Array) -> Ints:
        """Slots (K, M) of each particle, -1 for new ones."""
        maps, points = self._maps, image.points
        unlikeness = self.front_end.unlikeness(image)
        if len(points) == 0 or maps.n_slots == 0:
            return np.full((len(points), self.n_particles), -1)
        near = maps.nearby(path.state, self.front_end.reach_m)
        return ekf.associate(
            maps.data,
            ekf.Candidates(near, maps.place, maps.counts, maps.births),
            points,
            unlikeness,
            spread,
            self.d0,
            path.state,
            self._camera,
        )

    def _distances(self, path: ParticlePath, image: Image, slots: Ints) -> tuple[Array, Array]:
        """Squared distances of known landmarks by the best particle, and its pose."""
        camera, old = self.front_end.camera, slots >= 0
        moved = Gaussian(path.drawn[self._best], np.zeros((3, 3))).then(path.rolled)
        means, covariances, _ = self._maps.of_particle(self._best)
        predicted, of_pose, of_landmark = camera.predict(moved.mean, means[slots[old]])
        v, R = camera.innovation(predicted, image.points[old])
        turned = of_landmark.transpose(0, 2, 1)
        S = of_pose @ moved.covariance @ of_pose.transpose(0, 2, 1) + R
        S += of_landmark @ covariances[slots[old]] @ turned
        return mahalanobis_squared(v, S), moved.mean

    def _propose(self, path: ParticlePath, normals: Array, slots: Ints, points: Array) -> Array:
        """Turn normals into draws given the image; their log importance weights (M,).

        The first few observations place the particle, and all are linearised again there: the
        second linearisation only has to hold over a fraction of the motion's noise.
        """
        old = slots >= 0 if slots.ndim == 1 else (slots >= 0).any(axis=1)
        rows, points = self._maps.rows(slots[old]), points[old]
        inform = ekf.inform if slots.ndim == 1 else ekf.inform_each
        maps, state, camera = self._maps.data, path.state, self._camera
        start, importance = np.zeros_like(normals), np.empty((2, normals.shape[1]))
        if len(rows):
            inform(maps, rows[:_PLACING], points[:_PLACING], state, camera)
            ekf.propose(
                path.poses,
                path.root,
                path.stretch,
                state,
                np.zeros_like(normals),
                start,
                importance,
            )
            path.move(start)
        inform(maps, rows, points, state, camera)
        ekf.propose(path.poses, path.root, path.stretch, state, start, normals, importance)
        log_weights: Array = 0.5 * importance[0] - np.log(importance[1])
        return log_weights[: self.n_particles]

    def _observe(self, path: ParticlePath, slots: Ints, points: Array) -> Array:
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
            update(self._maps.data, rows[group], points[group], path.state, self._camera)
            gained += ekf.log_weights(path.state, self.n_particles)
        return gained

    def _create(self, path: ParticlePath, slots: Ints, image: Image) -> None:
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
        ekf.create(maps.data, maps.rows(begun), image.points[rows], path.state, self._camera)
        if each:
            row, particle = np.nonzero(missing)
            maps.births[at[missing], particle] = len(self.front_end.origins) + row
        self.front_end.start(image, rows)
        maps.counts = maps.counts + missing.sum(axis=0)

    def _resample(self) -> None:
        """Draw particles by their weights; survivors keep their place."""
        n = self.n_particles
        ancestors = keep_survivors(resample(self._log_weights, n, self._rng, self.resampling), n)
        self._maps.resample(ancestors)
        for path in self._paths:
            path.resample(ancestors)
        self._accumulated = self._accumulated[ancestors]
        self._log_weights = np.zeros(n)
