"""Fixed-lag smoothing of stereo landmarks: an online estimate close to full least squares.

The poses x_0 ... x_W of the last W images and the landmarks l seen from them minimise

    |(x_0, l) - m|^2_P + sum_i |between(x_i-1, x_i) - u_i|^2_Q + sum_ij |h(x_i, l_j) - z_ij|^2_R

by Gauss-Newton steps at every image (sibley2010, the sliding window filter). Everything in the
window is linearised again at every step, which a filter cannot do.

The prior N(m, P) covers x_0 and all landmarks seen before, with all their correlations, so that
a landmark that comes back after hundreds of images counts. The window needs the part of it on its
own landmarks, and a part of a covariance is a marginal, so a Gauss-Newton step does not grow with
the map. When x_0 leaves, the terms that tie x_0 and x_1 and the image of x_1 become part of the
prior, linearised at the window's estimates x*, l* of that moment:

    e + J_x (x_1 - x_1*) + J_l (l - l*) = noise,    x_1 = x_1* - B^-1 (r + A (x_0 - x_0*) - noise)

with residuals e, r and A, B the derivatives of `between` at x_0*, x_1*. It is an update of
EKF-SLAM, W images late, and costs as much, O(K N^2). W = 1 is an iterated EKF-SLAM; a W beyond
the run, full least squares.

Marginalised terms keep their derivatives, but for one: an error of the heading of x_0 turns all of
the map about its origin, so the prior's coordinates are taken about wherever the window's estimates
are now (`_linearise_again`). Without that, terms that were linearised at different headings
disagree on what a turn of the whole map does, its heading seems known (huang2009), and errors grow
by a sixth over drives of 40 m. A Bayes tree (kaess2012, iSAM2) linearises old poses again instead,
where they have moved.

Observations are weighted by a robust loss, since a few wrong ones would carry the window away. An
image is first weighted where the wheels have put it, with the spread of its motion allowed for;
landmarks that the window does not see otherwise count in full there, since the pose may be far off
by them. If an observation still contradicts the solution, a second step weights it down.

With a laser, the scans of consecutive images are registered, and their relative pose is one more
measurement of u_i, of the covariance that `estimators.laser.scan_matching` gives it.

Sources: Sibley, Matthies and Sukhatme, Sliding window filter with application to planetary landing,
J. Field Robotics 27, 2010; Huang, Mourikis and Roumeliotis, A first-estimates Jacobian EKF for
improving SLAM consistency, ISER 2008 (2009); Kaess et al., iSAM2: incremental smoothing and mapping
using the Bayes tree, IJRR 31, 2012.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from estimators.base import Belief, Estimate, Prior
from estimators.gaussian import STILL, Gaussian, between, wrap
from estimators.graph.camera_residuals import camera_whitening, residuals_of
from estimators.graph.landmark_drive import (
    FLOOR,
    LandmarkDrive,
    loosen,
    read_observations,
    solve_drives,
)
from estimators.graph.least_squares import MIN_INFORMATION, LeastSquaresOptions, OnStep, Robust
from estimators.graph.matrices import inverse, times, transpose, whitening_of
from estimators.landmarks.joint import JointGaussian, quarter_turned
from estimators.landmarks.stereo import StereoModel, StereoOptions
from estimators.laser.icp import PreparedScan
from estimators.laser.scan_matching import MatcherOptions, ScanMatcher
from estimators.wheels import WheelOptions, WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.compiled import njit
from sim.errors import require
from sim.options import Count, NonNegative, Positive, options
from sim.recording import Frame

_POSE = slice(0, 3)  # rows of the prior's


@dataclass(frozen=True)
class _Image:
    """Motion since the image before, and points (K, 3) in the camera frame of landmarks (K,)."""

    motion: Gaussian
    landmarks: Ints
    points: Array


@options("estimator")
class FixedLagOptions(WheelOptions, StereoOptions, LeastSquaresOptions):
    """Options of fixed-lag smoothing."""

    robust: Robust = "dcs"
    """Loss of each observation, in the window and at the end: `none` (squares); `huber`, `cauchy`
    or `dcs` from `robust_sigma` on."""
    robust_sigma: Positive = 5.5
    """Mahalanobis distance at which the loss turns."""
    lag_images: Count = 20
    """W, the images whose poses are estimated together."""
    iterations: Count = 1
    """Gauss-Newton steps at every image."""
    keep_landmarks: bool = True
    """Keep landmarks that the window sees no more, so that they count when they come back. If not,
    time and memory do not grow with the map."""
    laser: str | None = None
    """Name of a laser whose scans are registered where a Frame has a scan beside its image; null
    for none."""
    sigma_range_m: NonNegative | None = None
    """Believed range noise of that laser, m; null: its own."""

    def __post_init__(self) -> None:
        require(
            self.sigma_range_m is None or self.laser is not None,
            "estimator.sigma_range_m has no effect without a laser; set estimator.laser",
        )


class FixedLag(FixedLagOptions):
    """Least squares over the last images on a Gaussian prior of all older ones.

    Notes
    -----
    The camera and the odometry are believed as `estimators.graph.smoother` does. Landmarks are
    numbered in the order in which they are seen; those of the prior come first. An image without
    usable observations does not become a pose of the window.

    Extras: `status` when an observation could not be used, or an image not be solved for; the
    belief is then the odometry's from the last one.
    """

    needs = frozenset({"stereo"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        self._camera = StereoModel.of(prior.require_stereo(self.stereo, "fixed_lag"))
        self._belief = prior.require_start("fixed_lag")
        self._wheels = WheelPrediction(self, prior.robot.track_m)
        self._drive = LandmarkDrive(self._camera, self._belief)
        self._laser = None if self.laser is None else prior.require_laser(self.laser, "fixed_lag")
        self._scan: PreparedScan | None = None  # of the last image
        self._matcher = ScanMatcher(MatcherOptions(sigma_range_m=self.sigma_range_m))
        self._rng = rng
        self._prior = JointGaussian(self._belief.mean.copy(), self._belief.covariance + FLOOR)
        self._motion = STILL  # since the last image
        self._images: list[_Image] = []
        self._poses = self._belief.mean[None].copy()  # of the prior, then of each image
        self._landmarks = np.zeros((0, 3))
        self._landmark_of_id: dict[int, int] = {}

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, solve the window, and let its oldest pose go."""
        motion = self._wheels.predict(frame)
        loose = loosen(motion)
        self._belief, self._motion = self._belief.then(motion), self._motion.then(loose)
        seen, rejected = read_observations(frame, self.stereo, self._camera, "fixed_lag")
        registered = None if seen is None else self._registered(frame)
        if registered is not None:
            self._motion = self._motion.fuse(registered)
        status = ("" if seen is None else self._see(*seen)) or rejected
        self._drive.add(frame.stamp, loose, self._belief.mean, seen)
        if registered is not None:
            self._drive.tie(registered)
        covariance = (self._belief.covariance + self._belief.covariance.T) / 2.0
        return Belief(self._belief.mean.copy(), covariance, {"status": status} if status else {})

    def finish(self, on_step: OnStep = None) -> Estimate:
        """Least squares over all Frames so far, as `estimators.graph.smoother` solves it.

        It starts from the online estimate. `on_step` is called before each of its steps.
        """
        return solve_drives([self._drive], self, on_step=on_step)[0]

    def _registered(self, frame: Frame) -> Gaussian | None:
        """Motion since the last image by the scans; None without both, or if that fails."""
        before, self._scan = self._scan, None
        reading = None if self.laser is None else frame.readings.get(self.laser)
        if reading is None or self._laser is None:
            return None
        self._scan = self._matcher.prepare(reading["ranges_m"], self._laser)
        if before is None or self._scan is None:
            return None
        found = self._matcher.match(self._scan, before, self._motion, self._laser, self._rng)
        return None if found.failed else found.motion

    def _see(self, points: Array, ids: Ints) -> str:
        """Take in points (K, 3) and ids (K,) of an image; what went wrong, or nothing."""
        order = np.argsort(ids)
        ids, points = ids[order], points[order]
        pose = se2.compose(self._poses[-1], self._motion.mean)
        self._poses = np.vstack([self._poses, pose])
        number = self._landmark_of_id
        landmarks = np.array([number.setdefault(i, len(number)) for i in ids.tolist()])
        new = np.flatnonzero(landmarks >= len(self._landmarks))
        placed = self._camera.place(np.tile(pose, (len(new), 1)), points[new])
        self._landmarks = np.concatenate([self._landmarks, placed])
        self._images.append(_Image(self._motion, landmarks, points))
        self._motion = STILL
        sound = all(self._refine(is_new=i == 0) for i in range(self.iterations))
        if sound and self._contradicts(self._images[-1]):
            sound = self._refine(is_new=False)
        if len(self._images) >= self.lag_images:
            sound &= self._absorb(self._images.pop(0))
        return "" if sound else "image not used: broken covariance, not positive definite"

    def _refine(self, *, is_new: bool) -> bool:
        """One Gauss-Newton step of the window; not taken, with False, if it cannot be solved.

        While an image `is_new`, its pose is only where the wheels put it.
        """
        try:
            active, step, root = self._solved(is_new=is_new)
        except np.linalg.LinAlgError:
            return False
        if not np.isfinite(step).all():
            return False
        n, old = len(active), active[active < self._n_prior]
        before = np.vstack([self._poses[:1], self._landmarks[old]])
        self._landmarks[active] += step[:n]
        self._poses += step[n:]
        self._poses[:, 2] = se2.wrap(self._poses[:, 2])
        self._linearise_again(old, before, np.vstack([self._poses[:1], self._landmarks[old]]))
        self._belief = Gaussian(self._poses[-1], root.T @ root)
        return True

    def _solved(self, *, is_new: bool) -> tuple[Ints, Array, Array]:
        """Solve the window's normal equations, of its landmarks and then its poses.

        Returns
        -------
        tuple
            Landmarks (N,) that the window sees; their changes and those of the poses, (N + T, 3);
            a root (3, 3) of the newest pose's covariance.
        """
        seen = np.concatenate([image.landmarks for image in self._images])
        active, columns = np.unique(seen, return_inverse=True)
        old = active[active < self._n_prior]
        n_landmarks, n = len(active), len(active) + len(self._poses)
        H, g = np.zeros((n, 3, n, 3)), np.zeros((n, 3))
        flat, flat_g = H.reshape(3 * n, 3 * n), g.reshape(3 * n)

        of_prior = np.concatenate([(3 + 3 * old[:, None] + np.arange(3)).ravel(), [0, 1, 2]])
        rows = np.concatenate([np.arange(3 * len(old)), 3 * n_landmarks + np.arange(3)])
        root_of_prior = _root(self._prior.covariance[np.ix_(of_prior, of_prior)])
        off = (
            np.concatenate([self._landmarks[old].ravel(), self._poses[0]])
            - self._prior.mean[of_prior]
        )
        off[-1] = wrap(off[-1])
        flat[np.ix_(rows, rows)] = lapack.dpotrs(root_of_prior, np.eye(len(rows)), lower=1)[0]
        flat_g[rows] = lapack.dpotrs(root_of_prior, off, lower=1)[0]
        fresh = np.arange(3 * len(old), 3 * n_landmarks)
        flat[fresh, fresh] += MIN_INFORMATION

        ends = self._poses[:-1], self._poses[1:]
        missed = se2.between(*ends) - np.array([image.motion.mean for image in self._images])
        missed[:, 2] = se2.wrap(missed[:, 2])
        whitening = whitening_of(np.array([image.motion.covariance for image in self._images]))
        by_first, by_second = (whitening @ by for by in se2.between_jacobians(*ends))
        first = np.arange(n_landmarks, n - 1)
        _add(H, g, first, first + 1, by_first, by_second, times(whitening, missed))

        counts = [len(image.landmarks) for image in self._images]
        images = np.repeat(np.arange(1, len(counts) + 1), counts)
        points = np.concatenate([image.points for image in self._images])
        residuals = self._whitened(self._poses[images], seen, points)
        squares = np.sum(residuals[0] * residuals[0], axis=1)
        if is_new:
            k = counts[-1]
            again = np.isin(seen[-k:], seen[:-k])  # what the window has not seen may be far off
            squares[-k:] = again * self._squares_of_newest(residuals[0][-k:], residuals[1][-k:])
        e, by_pose, by_landmark = self._weighted(residuals, squares)
        _add(H, g, n_landmarks + images, columns, by_pose, by_landmark, e)

        factor = _root(flat)
        step = -lapack.dpotrs(factor, flat_g, lower=1)[0].reshape(n, 3)
        # the newest pose is eliminated last, so its corner of the factor is its information's root
        return active, step, inverse(np.tril(factor[-3:, -3:]))

    def _linearise_again(self, landmarks: Ints, before: Array, now: Array) -> None:
        """Take the prior's coordinates about what the window now estimates.

        An error of the heading turns all positions about the map's origin, however far the window
        has turned them since; if it did not, the heading of the map would seem known.

        Parameters
        ----------
        landmarks
            (K,) those of the prior that the window sees.
        before, now
            (1 + K, 3) its estimates of the prior's pose and of them.
        """
        mean, P = self._prior.mean.reshape(-1, 3), self._prior.covariance
        rows, at, to = np.append(0, 1 + landmarks), before[:, :2], now[:, :2]
        turn, off_rad = wrap(now[0, 2] - before[0, 2]), wrap(mean[0, 2] - before[0, 2])
        turned = se2.transform([0.0, 0.0, turn], at)
        moved = se2.log(np.column_stack([to - turned, np.full(len(to), turn)]))[:, :2]
        off = mean[rows, :2] - at - off_rad * quarter_turned(at) - moved
        mean[rows, :2] = to + off + (off_rad - turn) * quarter_turned(to)
        arms = quarter_turned(to - at).ravel()
        xy = (3 * rows[:, None] + np.arange(2)).ravel()
        change = np.outer(arms, P[2])
        within = change[:, xy] + 0.5 * P[2, 2] * np.outer(arms, arms)
        change[:, xy] = within + within.T
        P[xy] += change
        P[:, xy] = P[xy].T

    def _absorb(self, image: _Image) -> bool:
        """Make the oldest image of the window part of the prior, which moves on to its pose.

        With False if the prior rejects it.
        """
        moved = self._move(image.motion)
        self._poses = self._poses[1:]
        x_1 = np.tile(self._poses[0], (len(image.points), 1))
        residuals = self._whitened(x_1, image.landmarks, image.points)
        e, by_pose, by_landmark = self._weighted(residuals, np.sum(residuals[0] ** 2, axis=1))
        e += by_pose @ moved
        old = image.landmarks < self._n_prior
        taken = self._update(image.landmarks[old], e[old], by_pose[old], by_landmark[old])
        new = np.flatnonzero(~old)[np.argsort(image.landmarks[~old])]
        # until now, e was at the prior's x_1 before the update
        e[new] += by_pose[new] @ (self._prior.mean[:3] - self._poses[0] - moved)
        by_residual = -inverse(by_landmark[new])
        placed = self._landmarks[image.landmarks[new]] + times(by_residual, e[new])
        noise = by_residual @ transpose(by_residual)
        self._prior.extend(_POSE, by_residual @ by_pose[new], placed, noise)
        self._prior.mean[2] = wrap(float(self._prior.mean[2]))
        idle = np.ones(self._n_prior, dtype=bool)
        for other in self._images:
            idle[other.landmarks[other.landmarks < self._n_prior]] = False
        if self.keep_landmarks:  # out of the window they go with the prior, by their correlations
            left, means = np.flatnonzero(idle), self._prior.mean[3:].reshape(-1, 3)
            before = np.vstack([self._poses[:1], self._landmarks[left]])
            self._linearise_again(left, before, np.vstack([self._poses[:1], means[left]]))
            self._landmarks[left] = means[left]
        else:
            self._forget(idle)
        return taken

    def _move(self, motion: Gaussian) -> Array:
        """Put x_1 in place of x_0 in the prior; its mean (3,) less the window's x_1*."""
        P = self._prior.covariance
        r, A, B = between(self._poses[0], self._poses[1])
        r -= motion.mean
        off = self._prior.mean[:3] - self._poses[0]
        r[2], off[2] = wrap(r[2]), wrap(off[2])
        by_motion = inverse(B)
        by_pose = -by_motion @ A
        moved: Array = by_pose @ off - by_motion @ r
        P[:3, :3] = by_pose @ P[:3, :3] @ by_pose.T + by_motion @ motion.covariance @ by_motion.T
        P[:3, 3:] = by_pose @ P[:3, 3:]
        P[3:, :3] = P[:3, 3:].T
        self._prior.mean[:3] = self._poses[1] + moved
        return moved

    def _update(self, landmarks: Ints, e: Array, by_pose: Array, by_landmark: Array) -> bool:
        """Kalman update of the prior by whitened residuals (K, 3) at its pose and at l*.

        Rejected, with False, if rounding has left the innovation without a proper covariance.
        """
        if not len(landmarks):
            return True
        at = 3 + 3 * landmarks[:, None] + np.arange(3)
        e = e + times(by_landmark, self._prior.mean[at] - self._landmarks[landmarks])
        HP, S, by_other = self._prior.predicted(_POSE, at, by_pose, by_landmark)
        S += np.eye(len(S))
        S += by_other
        correction = self._prior.update(HP, S, e)
        if correction is not None:
            self._prior.mean -= correction
        return correction is not None

    def _forget(self, gone: NDArray[np.bool_]) -> None:
        """Drop these (N,) of the prior's landmarks, and number the others without gaps."""
        self._prior.keep(np.concatenate([np.ones(3, dtype=bool), np.repeat(~gone, 3)]))
        kept = np.ones(len(self._landmarks), dtype=bool)
        kept[: len(gone)] = ~gone
        number = np.cumsum(kept) - 1
        self._landmarks = self._landmarks[kept]
        self._images = [replace(i, landmarks=number[i.landmarks]) for i in self._images]
        old = self._landmark_of_id.items()
        self._landmark_of_id = {i: int(number[n]) for i, n in old if kept[n]}

    def _contradicts(self, image: _Image) -> bool:
        """Whether the newest image, as it is now solved, has observations that count for less."""
        if self.robust == "none":
            return False
        poses = np.tile(self._poses[-1], (len(image.points), 1))
        e = self._whitened(poses, image.landmarks, image.points)[0]
        return bool((np.sum(e * e, axis=1) > self.robust_sigma**2).any())

    def _squares_of_newest(self, e: Array, by_pose: Array) -> Array:
        """Squared residuals (K,) where the wheels have put the newest pose, over their spread.

        The landmarks are taken to be as uncertain as one observation of them.
        """
        before, motion = self._poses[-2], self._images[-1].motion.covariance
        turned = se2.between_jacobians(before[None], self._poses[-1:])[1][0]  # by the newest pose
        of_pose = inverse(turned) @ motion @ inverse(turned).T
        spread = by_pose @ of_pose @ transpose(by_pose) + 2.0 * np.eye(3)
        return np.asarray(np.einsum("ki,ki->k", e, np.linalg.solve(spread, e[..., None])[..., 0]))

    def _weighted(
        self, residuals: tuple[Array, Array, Array], squares: Array
    ) -> tuple[Array, Array, Array]:
        """Whitened residuals and derivatives (K, ...), weighted by their loss at these squares."""
        if self.robust == "none":
            return residuals
        root = np.sqrt(self.loss(squares)[1])
        e, by_pose, by_landmark = residuals
        return root[:, None] * e, root[:, None, None] * by_pose, root[:, None, None] * by_landmark

    def _whitened(self, poses: Array, landmarks: Ints, points: Array) -> tuple[Array, Array, Array]:
        """Residuals (K, 3) in standard deviations, and derivatives by the pose and landmark."""
        at = self._landmarks[landmarks]
        e, by_pose, by_landmark = residuals_of(self._camera, poses, at, points)
        if self._camera.in_image:
            whitening = camera_whitening(self._camera, poses, at)
        else:  # at the predicted points, once more
            whitening = whitening_of(self._camera.covariance(e + points))
        return times(whitening, e), whitening @ by_pose, whitening @ by_landmark

    @property
    def _n_prior(self) -> int:
        """Landmarks that the prior covers."""
        return len(self._prior.mean) // 3 - 1


def _root(matrix: Array) -> Array:
    """Lower factor of a symmetric matrix by Cholesky, which may be overwritten.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """
    factor, failed = lapack.dpotrf(matrix.T, lower=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray(factor, dtype=np.float64)


@njit()
def _add(
    H: Array, g: Array, first: Ints, second: Ints, by_first: Array, by_second: Array, e: Array
) -> None:
    """Add K squared residuals to normal equations, each of two nodes.

    Parameters
    ----------
    H, g
        (N, 3, N, 3) and (N, 3) of the nodes, changed in place.
    first, second
        (K,) nodes of each residual.
    by_first, by_second, e
        (K, 3, 3), (K, 3, 3), (K, 3): derivatives and whitened residuals.
    """
    for k in range(len(e)):
        i, j = first[k], second[k]
        for a in range(3):
            for r in range(3):
                g[i, a] += by_first[k, r, a] * e[k, r]
                g[j, a] += by_second[k, r, a] * e[k, r]
                for b in range(3):
                    cross = by_first[k, r, a] * by_second[k, r, b]
                    H[i, a, i, b] += by_first[k, r, a] * by_first[k, r, b]
                    H[j, a, j, b] += by_second[k, r, a] * by_second[k, r, b]
                    H[i, a, j, b] += cross
                    H[j, b, i, a] += cross
