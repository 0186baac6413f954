"""FastSLAM: a particle filter over the robot's path, with an EKF for each landmark (gil2008)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimators.base import Belief, Estimate, Prior
from estimators.gaussian import STILL, Gaussian, compose, root, rotated
from estimators.landmarks import particle_kernels as ekf
from estimators.landmarks.particle_maps import LandmarkMaps, Maps
from estimators.landmarks.sightings import Sightings, dead_reckoning, team_starts
from estimators.landmarks.slam_frontend import Association, Image, SlamFrontEnd
from estimators.landmarks.stereo import NoiseAt, NoiseModel
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
from estimators.wheels import ForwardSlipOptions, WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import InputError, require
from sim.recording import Frame

Proposal = Literal["motion", "optimal"]

_MOST_PARTICLES = 100_000  # a map of 100 landmarks each is about 1 GB
_PLACING = 4  # observations after which the proposal is linearised again
_MOST_DRIFT_RAD = 0.1  # heading spread at which motion is drawn without waiting for an image


class FastSLAM:
    """Rao-Blackwellised SLAM: each particle is a path, and has a map of its own.

    At an image the motion since the last one is drawn, the landmarks seen are associated,
    weights get the product over the observations (gil2008, eq. (14)), the EKFs are updated by
    eqs. (3)-(8), and the particles are resampled. Between images they roll by the wheels' mean.

    Of a team each particle holds the paths of all robots, and one map. A sighting weighs the
    particle by the distance that it gives the two robots; it is not part of the proposal.

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
        As in `estimators.landmarks.stereo.StereoModel.of`.
    sigma_column_px, sigma_row_px, sigma_disparity_px, sigma_descriptor
        Believed noise; None for that of the prior's camera.
    gate_probability, repeat_s
        Of known ids, as in `estimators.landmarks.slam_frontend.SlamFrontEnd`: misread ones are
        left out, and a landmark counts once in `repeat_s`.
    maps
        `shared` or `contiguous`, see `estimators.landmarks.particle_maps.LandmarkMaps`: the same
        bits, at different speeds.
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
    robots
        Name of the sensor that sees the other robots of a team, with ids; None: sightings are not
        used.
    sighting_d0
        Squared Mahalanobis distance from which on, in every particle, a sighting is a misread
        robot, and rejected.

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
        robots: str | None = None,
        sighting_d0: float = 16.27,
    ) -> None:
        self.stereo, self.robots, self.sighting_d0 = stereo, robots, sighting_d0
        require_counts(_MOST_PARTICLES, n_particles=n_particles)
        require_choices(
            proposal=(proposal, Proposal), resampling=(resampling, Scheme), maps=(maps, Maps)
        )
        require_non_negative(ess_share=ess_share)
        require_positive(p0=p0, sighting_d0=sighting_d0)
        if slip_dof is not None:
            require_positive(slip_dof=slip_dof)
        self._noise = noise_model, noise_at
        self.wheels = ForwardSlipOptions(
            kr=kr, kl=kl, window_s=window_s, forward_slip_m=forward_slip_m
        )
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
        self.reset_team((prior,), rng)

    def reset_team(self, priors: Sequence[Prior], rng: np.random.Generator) -> None:
        """Draw the particles of a team from the priors of its robots, whose starts are known.

        Raises
        ------
        InputError
            If the robots do not carry the same sensors, or a start is unknown.
        """
        starts = team_starts(priors, self.front_end, "fastslam")
        self._sightings = Sightings.of(priors, self.robots, *self._noise, "fastslam")
        self._camera = self.front_end.camera.packed
        self._rng = rng
        n = self.n_particles
        self._maps = LandmarkMaps(n, self.maps, births=self.front_end.association != "known")
        mount, n_blocks = self.front_end.camera.mount, self._maps.n_blocks
        self._paths = []
        for start, wheels in zip(starts, dead_reckoning(self.wheels, priors), strict=True):
            if start is None:
                raise InputError("fastslam needs the starts of all robots; ekf_slam does not")
            self._paths.append(_Path(wheels, self.slip_dof, start, mount, n, n_blocks, rng))
        self._log_weights, self._accumulated = np.zeros(n), np.zeros(n)
        for path in self._paths:
            path.settle()
        self._weigh()

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, draw, associate, weight, update and resample."""
        return self.step_team((frame,))[0]

    def step_team(self, frames: Sequence[Frame]) -> list[Belief]:
        """Take in the Frames of one instant; the belief of each of their robots."""
        informed = False
        extras: list[dict[str, Any]] = [{"resampled": False} for _ in frames]
        for frame in frames:
            self._paths[frame.robot].roll(frame)
        for frame, found in zip(frames, extras, strict=True):
            path = self._paths[frame.robot]
            if self.stereo in frame.readings:
                self._see(path, frame, found)
                informed |= bool(np.any(found["associations"] >= 0))
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
        belief = path.belief.then(path.rolled)
        extras |= {
            "particles": path.drawn,
            "log_weights": self._log_weights,
            "ess": self._ess,
            "best": compose(path.drawn[self._best], path.rolled.mean)[0],
        }
        if self.keep_map:
            extras |= {k: v for k, v in self.map.items() if k.startswith("landmark")}
        path.note(frame.stamp)
        return Belief(belief.mean, belief.covariance, extras)

    def _see(self, path: _Path, frame: Frame, extras: dict[str, Any]) -> None:
        """Take in one image of a robot."""
        image = self.front_end.read(frame)
        if image.status:
            extras["status"] = image.status
        points, normals = image.points, path.normals(self._rng)
        gained = np.zeros(self.n_particles)
        known = self.front_end.association == "known"
        if known:
            slots = self.front_end.known(image)
            if self.front_end.gated and len(slots):
                passed = self._passed(path, image, slots)
                image, slots, points = image.of(passed), slots[passed], points[passed]
            self._maps.touch(slots[slots >= 0])
        self.front_end.counted(image, frame)
        by_motion = self.proposal == "motion" or len(points) == 0
        poses = path.moved(normals if by_motion else np.zeros_like(normals))
        if not known:
            spread = np.zeros((3, 3)) if by_motion else self._seen_spread(path)
            slots = self._associate(path, image, spread)
        if not by_motion:
            gained += self._propose(path, normals, slots, points)
            poses = path.moved(normals)
        gained += self._observe(path, slots, points)
        self._create(path, slots, image)
        path.poses = poses
        path.settle()
        if not self._gain(gained):
            extras["status"] = "weights underflowed"
        landmarks = self._landmarks(slots, self._best)
        extras["associations"] = self.front_end.associations(image, landmarks)

    def _gain(self, gained: Array) -> bool:
        """Add log weights (M,); with False, and equal weights, if all have underflowed."""
        weights = self._log_weights + gained
        lost = underflowed(weights)
        if lost:
            weights, gained = np.zeros(self.n_particles), np.zeros(self.n_particles)
        self._log_weights = weights
        self._accumulated = self._accumulated + gained
        self._weigh()
        return not lost

    def _sight(self, sightings: Sightings, frame: Frame, frames: Sequence[Frame]) -> bool:
        """Weigh by a robot's sightings of others that have a Frame at this instant too.

        A robot that is seen is, in each particle, a landmark known without error.
        """
        points, numbers = sightings.read(frame)
        if numbers is None:
            require(
                len(points) == 0, "fastslam: sightings without ids; set sensors.robots.identifies"
            )
            return False
        others = {f.robot for f in frames} - {frame.robot}
        camera, path = sightings.camera.packed, self._paths[frame.robot]
        mount, state = _packed(sightings.camera.mount), ekf.new_state(self._maps.n_blocks)
        used = False
        for point, number in zip(points, numbers.tolist(), strict=True):
            if number not in others:
                continue
            for each in (path, self._paths[number]):
                if each.rolled is not STILL:
                    each.draw(self._rng)
            path.moved(np.zeros((3, path.poses.shape[1])), mount, state)
            marker = ekf.known_landmark(self._paths[number].poses, sightings.marker_z_m)
            ekf.update(marker, np.zeros(1, np.int64), point[None], state, camera)
            if ekf.distances(state, self.n_particles).min() < self.sighting_d0:
                used = True
                gained = ekf.summed(state, self.n_particles)
                self._gain(gained + ekf.log_scale(point[None], camera))
        return used

    def finish(self) -> Estimate:
        """Path of the lineage of greatest accumulated weight, gil2008, eq. (20).

        The covariances are those of all weighted lineages. They are zero where all lineages share
        one ancestor: a sign of particle depletion, not of a path known exactly.
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
            path.belief = Gaussian(*ekf.moments(path.drawn, weights))

    def _associate(self, path: _Path, image: Image, spread: Array) -> Ints:
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
            self.front_end.d0,
            path.state,
            self._camera,
        )

    def _passed(self, path: _Path, image: Image, slots: Ints) -> NDArray[np.bool_]:
        """Which observations (K,) of landmarks in these slots pass the best particle's gate."""
        camera, old = self.front_end.camera, slots >= 0
        moved = Gaussian(path.drawn[self._best], np.zeros((3, 3))).then(path.rolled)
        means, covariances, _ = self._maps.of_particle(self._best)
        predicted, of_pose, of_landmark = camera.predict(moved.mean, means[slots[old]])
        v, R = camera.innovation(predicted, image.points[old])
        turned = of_landmark.transpose(0, 2, 1)
        S = of_pose @ moved.covariance @ of_pose.transpose(0, 2, 1) + R
        S += of_landmark @ covariances[slots[old]] @ turned
        distances = np.sum(v * np.linalg.solve(S, v[..., None])[..., 0], axis=-1)
        return self.front_end.passed(image, slots, distances, moved.mean)

    def _seen_spread(self, path: _Path) -> Array:
        """Covariance of the motion not yet drawn, in axes of the camera after it."""
        angle = -float(path.rolled.mean[2] + self.front_end.camera.mount[2])
        return rotated(path.rolled.covariance, angle)

    def _propose(self, path: _Path, normals: Array, slots: Ints, points: Array) -> Array:
        """Turn normals into draws given the image; their log importance weights (M,).

        The first few observations place the particle, and all are linearised again there: the
        second linearisation only has to hold over a fraction of the motion's noise.
        """
        old = slots >= 0 if slots.ndim == 1 else (slots >= 0).any(axis=1)
        rows, points = self._maps.rows(slots[old]), points[old]
        inform = ekf.inform if slots.ndim == 1 else ekf.inform_each
        maps, state, camera = self._maps.data, path.state, self._camera
        start, owed = np.zeros_like(normals), np.empty((2, normals.shape[1]))
        if len(rows):
            inform(maps, rows[:_PLACING], points[:_PLACING], state, camera)
            ekf.propose(
                path.poses, path.root, path.stretch, state, np.zeros_like(normals), start, owed
            )
            path.moved(start)
        inform(maps, rows, points, state, camera)
        ekf.propose(path.poses, path.root, path.stretch, state, start, normals, owed)
        log_owed: Array = 0.5 * owed[0] - np.log(owed[1])
        return log_owed[: self.n_particles]

    def _observe(self, path: _Path, slots: Ints, points: Array) -> Array:
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
            gained += ekf.summed(path.state, self.n_particles)
        return gained

    def _create(self, path: _Path, slots: Ints, image: Image) -> None:
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

    def _landmarks(self, slots: Ints, particle: int) -> Ints:
        """Number (K,) of each observation's landmark in one particle, -1 for new ones."""
        chosen = slots if slots.ndim == 1 else slots[:, particle]
        return np.where(chosen >= 0, self._maps.birth_of(np.maximum(chosen, 0), particle), -1)

    def _resample(self) -> None:
        """Draw particles by their weights; survivors keep their place."""
        n = self.n_particles
        ancestors = in_place(resample(self._log_weights, n, self._rng, self.resampling), n)
        self._maps.resample(ancestors)
        for path in self._paths:
            path.resample(ancestors)
        self._accumulated = self._accumulated[ancestors]
        self._log_weights = np.zeros(n)


class _Path:
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
        start: Gaussian,
        mount: Array,
        n_particles: int,
        n_blocks: int,
        rng: np.random.Generator,
    ) -> None:
        self._wheels, self._slip_dof, self._n = wheels, slip_dof, n_particles
        self._mount = _packed(mount)
        self.state = ekf.new_state(n_blocks)
        turned = rotated(start.covariance, -float(start.mean[2]))
        normals = rng.standard_normal((3, n_blocks * ekf.LANES))
        scatter = root((turned + turned.T) / 2.0) @ normals
        drawn = se2.compose(start.mean, scatter.T)
        headings = drawn[:, 2]
        self.poses = np.stack([*drawn.T, np.cos(headings), np.sin(headings)])
        self._lineages = Lineages(n_particles)
        self.rolled, self.root, self.belief = STILL, np.zeros((3, 2)), start
        self.stretch = np.ones(self.poses.shape[1])
        # of each Frame: its stamp, the draw it follows, and the motion since
        self._frames: list[tuple[float, int, Array]] = []

    def roll(self, frame: Frame) -> None:
        """Add the Frame's arc to the motion that is not yet drawn."""
        motion, root_ = self._wheels.predict_with_root(frame)
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

    def moved(
        self, normals: Array, mount: Array | None = None, state: Array | None = None
    ) -> Array:
        """Poses (5, lanes) after the motion; writes the state of a camera, by default the own."""
        mount = self._mount if mount is None else mount
        state = self.state if state is None else state
        noise = self.stretch * normals
        return ekf.move(self.poses, self.rolled.mean, self.root, noise, mount, state)

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the motion by the wheels alone."""
        self.poses = self.moved(self.normals(rng))
        self.settle()

    def settle(self) -> None:
        """Take the poses as drawn."""
        self.drawn = np.ascontiguousarray(self.poses[:3, : self._n].T)
        self.drawn[:, 2] = se2.wrap(self.drawn[:, 2])
        self._lineages.append(self.drawn)
        self.rolled = STILL

    def note(self, stamp: float) -> None:
        """Note a Frame."""
        self._frames.append((stamp, len(self._lineages) - 1, self.rolled.mean))

    def resample(self, ancestors: Ints) -> None:
        """Give particle m the path of `ancestors[m]`, (M,)."""
        self._lineages.resample(ancestors)
        self.poses[:, : self._n] = np.take(self.poses, ancestors, axis=1)
        self.drawn = self.drawn[ancestors]

    def revised(self, best: int, weights: Array, made: dict[str, Array | Ints]) -> Estimate:
        """Path of one particle, with the covariances of all weighted ones."""
        n = len(self._lineages)
        drawn: list[Gaussian] = []
        for poses, rows in self._lineages.paths():
            by_row = np.bincount(rows, weights, minlength=len(poses)).astype(np.float64)
            drawn.append(Gaussian(poses[rows[best]], ekf.moments(poses, by_row)[1]))
        beliefs = [
            drawn[n - 1 - draw].then(Gaussian(since, np.zeros((3, 3))))
            for _, draw, since in self._frames
        ]
        return Estimate(
            np.array([stamp for stamp, _, _ in self._frames]),
            np.array([belief.mean for belief in beliefs]),
            np.array([belief.covariance for belief in beliefs]),
            kind="revised",
            map=made,
        )


def _packed(mount: Array) -> Array:
    """(4,) x, y, and cosine and sine of the yaw of a mount (3,)."""
    x, y, yaw = mount
    return np.array([x, y, math.cos(yaw), math.sin(yaw)])
