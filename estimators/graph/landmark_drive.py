"""What a drive past identified landmarks has shown, and the least-squares solution over all of it.

Shared by `estimators.graph.smoother` and `estimators.graph.fixed_lag`. Only the Frames with
observations (and the first and last) are poses of the problem. Those between are filled in from
the odometry on both sides, which loses nothing.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence

import numpy as np

from estimators.base import Estimate
from estimators.gaussian import Gaussian, compose, stack, wrap
from estimators.graph.camera_residuals import PoseSightings
from estimators.graph.least_squares import (
    PLAIN_SQUARES,
    LeastSquaresOptions,
    OnStep,
    Problem,
    solve,
)
from estimators.landmarks.sightings import Sightings
from estimators.landmarks.slam_frontend import screen
from estimators.landmarks.stereo import StereoModel
from sim.arrays import Array, Ints
from sim.errors import require
from sim.recording import Frame

# What a motion and a start pose are uncertain by at least, so that both can be inverted
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 1e-5, 1e-5
# Robot and row of the Frame that sees, those that are seen, and the point (3,) in the camera
Sighted = tuple[tuple[int, int], tuple[int, int], Array]
FLOOR = np.diag(np.square([_LEAST_SIGMA_M, _LEAST_SIGMA_M, _LEAST_SIGMA_RAD]))


class LandmarkDrive:
    """Motions and images of a drive, Frame by Frame.

    Parameters
    ----------
    camera
        What is believed of it.
    start
        Pose in map before the first Frame.
    """

    def __init__(self, camera: StereoModel, start: Gaussian) -> None:
        self._camera = camera
        self._start = Gaussian(start.mean, start.covariance + FLOOR)
        self._stamps: list[float] = []
        self._guesses: list[Array] = []
        self._motions: list[Gaussian] = []  # of each Frame since the one before
        self._images: list[tuple[int, Array, Ints]] = []
        self._ties: list[tuple[int, int, Gaussian]] = []
        self._pinned: set[int] = set()

    def add(
        self, stamp: float, motion: Gaussian, guess: Array, seen: tuple[Array, Ints] | None
    ) -> None:
        """Append a Frame.

        Parameters
        ----------
        motion
            Since the Frame before, as `loosened` has it.
        guess
            (3,) of the pose in map, to start the solution from.
        seen
            Points (K, 3) m in the camera frame and ids (K,) of its observations; None without.
        """
        if seen is not None:
            self._images.append((len(self._stamps), *seen))
        self._stamps.append(stamp)
        self._guesses.append(guess)
        self._motions.append(motion)

    def pin(self) -> int:
        """Make the last Frame a pose of the problem; return its row."""
        row = len(self._stamps) - 1
        self._pinned.add(row)
        return row

    def tie(self, motion: Gaussian) -> None:
        """Add another measurement of the motion between the last two images."""
        self._ties.append((self._images[-2][0], self._images[-1][0], motion))

    def problem(self) -> tuple[Problem, Array]:
        """The least-squares problem over all Frames so far, and poses (T, 3) to start from."""
        rows = self._rows()
        return self._problem(rows)[0], np.array([self._guesses[row] for row in rows])

    def _rows(self) -> list[int]:
        """Frames that are poses of the problem."""
        seeing = (row for row, _, _ in self._images)
        return sorted({0, *seeing, *self._pinned, len(self._stamps) - 1})

    def _problem(self, rows: list[int]) -> tuple[Problem, Ints]:
        """The problem over the Frames of these rows, and the id of each of its landmarks."""
        between = (self._motions[a + 1 : b + 1] for a, b in itertools.pairwise(rows))
        merged = [functools.reduce(Gaussian.then, motions) for motions in between]
        pose_of = {row: pose for pose, row in enumerate(rows)}
        seen = [np.zeros(0, np.int64), *(seen for _, _, seen in self._images)]
        ids, landmark_rows = np.unique(np.concatenate(seen), return_inverse=True)
        tied = [(pose_of[first], pose_of[second]) for first, second, _ in self._ties]
        motions, covariances = stack([*merged, *(motion for _, _, motion in self._ties)])
        steps = [*itertools.pairwise(range(len(rows))), *tied]
        first, second = np.array(steps, np.int64).reshape(-1, 2).T
        problem = Problem(
            prior_mean=compose(self._start.mean, self._motions[0].mean)[0],
            prior_covariance=self._start.covariance,
            first=first,
            second=second,
            motions=motions,
            motion_covariances=covariances,
            camera=self._camera,
            pose_rows=np.array([pose_of[row] for row, p, _ in self._images for _ in p], np.int64),
            landmark_rows=landmark_rows.astype(np.int64),
            points_in_camera=np.concatenate([np.zeros((0, 3)), *(p for _, p, _ in self._images)]),
        )
        return problem, ids

    def fill_in(self, poses: Array, joints: Array, alone: Array) -> tuple[Array, Array]:
        """Means (T, 3) and covariances (T, 3, 3) of every Frame, between the solved ones too.

        Parameters
        ----------
        poses
            (N, 3) of the problem, solved.
        joints
            (N - 1, 6, 6) covariance of each with the next.
        alone
            (3, 3) that of the last.
        """
        rows = self._rows()
        n = len(self._stamps)
        means, covariances = np.empty((n, 3)), np.empty((n, 3, 3))
        means[rows], covariances[rows[:-1]] = poses, joints[:, :3, :3]
        covariances[rows[-1]] = alone
        for pose, (a, b) in enumerate(itertools.pairwise(rows)):
            ends = poses[pose : pose + 2]
            between = _between(self._motions[a + 1 : b + 1], ends, joints[pose])
            for row, belief in enumerate(between, start=a + 1):
                means[row], covariances[row] = belief.mean, belief.covariance
        return means, covariances

    @property
    def stamps(self) -> Array:
        """(T,) s of all Frames so far."""
        return np.array(self._stamps)


def solve_drives(
    drives: Sequence[LandmarkDrive],
    how: LeastSquaresOptions = PLAIN_SQUARES,
    camera: Sightings | None = None,
    sighted: Sequence[Sighted] = (),
    on_step: OnStep = None,
) -> list[Estimate]:
    """Least squares over all Frames so far of the drives of a team, in one map.

    Parameters
    ----------
    camera, sighted
        What sees the other robots, and what it saw; the Frames are pinned.
    on_step
        Called before each step.

    Returns
    -------
    list of Estimate
        One a drive. Its `map` is a mapping of `ids` (N,), `landmarks` (N, 3) m and
        `landmark_covariances` (N, 3, 3); its status is `no_landmarks` when it is dead reckoning
        alone, and `not_converged` when the steps did not suffice.

    Raises
    ------
    InputError
        Before the first Frame.
    """
    require(
        all(len(drive.stamps) for drive in drives),
        "the estimator has seen no Frame; step before finish",
    )
    rows = [drive._rows() for drive in drives]
    guesses = [
        np.array([drive._guesses[row] for row in own])
        for drive, own in zip(drives, rows, strict=True)
    ]
    parts, ids_of = zip(*map(LandmarkDrive._problem, drives, rows), strict=True)
    if len(drives) == 1:
        problem, ids, ends = parts[0], ids_of[0], np.array([0, len(rows[0])])
    else:
        # pose 0 is the origin of the map, to which the starts are tied
        ends = 1 + np.cumsum([0, *map(len, rows)])
        guesses = [np.zeros((1, 3)), *guesses]
        seen = [own[part.landmark_rows] for part, own in zip(parts, ids_of, strict=True)]
        ids, landmark_rows = np.unique(np.concatenate(seen), return_inverse=True)
        problem = dataclasses.replace(
            _joined(parts, ends), landmark_rows=landmark_rows.astype(np.int64)
        )
        if camera is not None and sighted:
            pose_of = {
                (robot, row): ends[robot] + pose
                for robot, own in enumerate(rows)
                for pose, row in enumerate(own)
            }
            sightings = PoseSightings(
                camera,
                np.array([pose_of[seeing] for seeing, _, _ in sighted], np.int64),
                np.array([pose_of[seen_] for _, seen_, _ in sighted], np.int64),
                np.array([point for _, _, point in sighted]),
            )
            problem = dataclasses.replace(problem, sightings=sightings)
    solution = solve(problem, np.concatenate(guesses), how, on_step=on_step)
    known_map = {
        "ids": ids,
        "landmarks": solution.landmarks,
        "landmark_covariances": solution.landmark_covariances,
    }
    status = "ok" if solution.converged else "not_converged"
    status = status if len(ids) else "no_landmarks"
    joints, estimates = solution.information.joints(), []
    for drive, (low, high) in zip(drives, itertools.pairwise(ends), strict=True):
        alone = joints[high - 2, 3:, 3:] if high > 1 else solution.covariance
        path = drive.fill_in(solution.poses[low:high], joints[low : high - 1], alone)
        estimates.append(Estimate(drive.stamps, *path, "revised", map=known_map, status=status))
    return estimates


def _joined(parts: Sequence[Problem], ends: Ints) -> Problem:
    """The problems of several drives as one, whose poses of drive k begin at `ends[k]`."""
    begins, own = ends[:-1], list(zip(parts, ends, strict=False))
    starts = np.array([part.prior_mean for part in parts])
    start_covariances = np.array([part.prior_covariance for part in parts])
    return Problem(
        prior_mean=np.zeros(3),
        prior_covariance=FLOOR,
        first=np.concatenate([0 * begins, *(part.first + at for part, at in own)]),
        second=np.concatenate([begins, *(part.second + at for part, at in own)]),
        motions=np.concatenate([starts, *(part.motions for part in parts)]),
        motion_covariances=np.concatenate(
            [start_covariances, *(part.motion_covariances for part in parts)]
        ),
        camera=parts[0].camera,
        pose_rows=np.concatenate([part.pose_rows + at for part, at in own]),
        points_in_camera=np.concatenate([part.points_in_camera for part in parts]),
    )


def read_observations(
    frame: Frame, sensor: str, camera: StereoModel, estimator: str
) -> tuple[tuple[Array, Ints] | None, str]:
    """Points (K, 3) and ids (K,) of a Frame's observations that can be used; None without any.

    And what is wrong with the others, as `screened` has it; empty if nothing is.

    Raises
    ------
    InputError
        If the camera gives no ids.
    """
    seen = frame.readings.get(sensor)
    if seen is None or not len(seen["points_in_camera"]):
        return None, ""
    require(
        "ids" in seen,
        f"{estimator} needs to know which landmark is which; set sensors.{sensor}.identifies=true",
    )
    used, status = screen(camera, seen["points_in_camera"], seen["ids"])
    return (seen["points_in_camera"][used], seen["ids"][used]) if used.any() else None, status


def loosen(motion: Gaussian) -> Gaussian:
    """Motion of a Frame with what least squares needs beside slip: sideways play, and a floor."""
    # The arc takes each wheel to turn evenly. A heading that wanders by the variance s^2 over the
    # way d also leaves it sideways, by d^2 s^2 / 12 beyond what the final heading accounts for.
    x, y, turn = motion.mean
    normal = np.array([-math.sin(turn / 2.0), math.cos(turn / 2.0), 0.0])
    sideways = np.outer(normal, normal) * ((x**2 + y**2) * motion.covariance[2, 2] / 12.0)
    return Gaussian(motion.mean, motion.covariance + sideways + FLOOR)


def _between(motions: list[Gaussian], ends: Array, joint: Array) -> list[Gaussian]:
    """Poses between two solved ones (2, 3) of this joint covariance (6, 6).

    Given both ends, a pose between is the odometry from the first, corrected by its share of
    what the odometry misses the second by.
    """
    # motions from the start to each pose between, and from there to the end
    so_fars = list(itertools.accumulate(motions[:-1], Gaussian.then))
    rests = list(itertools.accumulate(motions[:0:-1], lambda rest, motion: motion.then(rest)))
    poses = []
    for so_far, rest in zip(so_fars, reversed(rests), strict=True):
        at, F, by_motion = compose(ends[0], so_far.mean)
        reached, H, by_rest = compose(at, rest.mean)
        missed = ends[1] - reached
        missed[2] = math.remainder(missed[2], 2.0 * math.pi)
        P = by_motion @ so_far.covariance @ by_motion.T
        R = by_rest @ rest.covariance @ by_rest.T
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        keep = np.eye(3) - K @ H
        by_ends = np.hstack([keep @ F, K])
        covariance = keep @ P @ keep.T + K @ R @ K.T + by_ends @ joint @ by_ends.T
        mean = at + K @ missed
        mean[2] = wrap(mean[2])
        poses.append(Gaussian(mean, (covariance + covariance.T) / 2.0))
    return poses
