"""gtsam's iSAM2 and batch solutions beside `fixed_lag`: ten standard drives, one noise model.

`python -m experiments.bench.isam2` prints a table; it needs the extra `gtsam`. Both solve the
problem that `estimators.graph.landmark_drive` makes of a drive: the same motions between images
with their covariances, the same observations. The camera's noise is Gaussian in pixels
(`sensors.stereo.correlated=true`), the only kind for which gtsam has a compiled factor. Its poses
are held to the plane by motions that hardly let them leave it (`_LIFT`), and its motions err on a
tangent.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
import pandas as pd

from estimators.base import run as run_estimator
from estimators.graph.fixed_lag import FixedLag
from estimators.graph.least_squares import Problem, solve
from estimators.graph.smoother import Smoother
from experiments.bench.smoothing import DRIVE
from experiments.evaluation.metrics import nees
from experiments.runs.console import progress
from experiments.runs.evaluate import limited_blas
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
from sim.arrays import Array, Ints
from sim.recording import Recording

SEEDS = range(1000, 1010)
_LIFT = 1e-5  # standard deviation of roll, pitch and height of a motion, rad and m
_MOVED = 0.01  # rad and m, from which on iSAM2 linearises again
_PLANAR = np.array([3, 4, 2])  # x, y and heading in gtsam's order of a pose's tangent
_EXACT = "gtsam, batch at every image"
_LANDMARKS = 1_000_000  # the key of landmark 0


@dataclass(frozen=True)
class Tracked:
    """A method over the N images of a drive.

    Attributes
    ----------
    means, covariances
        (N, 3), (N, 3, 3) of the newest pose at each image, in map.
    seconds, with_covariances_s
        Processor time of all images without and with the covariances.
    revised
        (N, 3) the path in the end.
    """

    means: Array
    covariances: Array
    seconds: float
    with_covariances_s: float
    revised: Array


class Feed:
    """A problem as gtsam's factors, image by image."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        camera = problem.camera
        assert camera is not None
        assert camera.in_image
        position, C = camera.axes(np.zeros(3))
        self._mount = gtsam.Pose3(gtsam.Rot3(C.T), position)
        focal = camera.focal_px
        self._lens = gtsam.Cal3_S2Stereo(focal, focal, 0.0, 0.0, 0.0, camera.baseline_m)
        column, row, disparity = camera.variances_px2
        covariance = [[column, column, 0.0], [column, column + disparity, 0.0], [0.0, 0.0, row]]
        self._pixels = gtsam.noiseModel.Gaussian.Covariance(np.array(covariance))
        self._images = camera.to_image(problem.points_in_camera)
        self._known: set[int] = set()

    def image(self, pose: int, last: Any) -> tuple[Any, Any]:
        """New factors and values of an image, from gtsam's estimate of the pose before."""
        p, graph, values = self._problem, gtsam.NonlinearFactorGraph(), gtsam.Values()
        if pose == 0:
            here = _pose3(p.prior_mean)
            noise = _model(p.prior_covariance, p.prior_mean[2])
            graph.add(gtsam.PriorFactorPose3(0, here, noise))
        else:
            motion = p.motions[pose - 1]
            noise = _model(p.motion_covariances[pose - 1], motion[2])
            graph.add(gtsam.BetweenFactorPose3(pose - 1, pose, _pose3(motion), noise))
            here = last.compose(_pose3(motion))
        values.insert(pose, here)
        for k in np.flatnonzero(p.pose_rows == pose):
            landmark = int(p.landmark_rows[k])
            key, (u, v, d) = _LANDMARKS + landmark, self._images[k]
            graph.add(
                gtsam.GenericStereoFactor3D(
                    gtsam.StereoPoint2(u, u - d, v), self._pixels, pose, key, self._lens,
                    self._mount,
                )
            )  # fmt: skip
            if landmark not in self._known:
                self._known.add(landmark)
                camera = gtsam.StereoCamera(here.compose(self._mount), self._lens)
                values.insert(key, camera.backproject(gtsam.StereoPoint2(u, u - d, v)))
        return graph, values


def _n_poses(problem: Problem) -> int:
    return int(problem.second.max()) + 1


def _pose3(pose: Array) -> Any:
    return gtsam.Pose3(gtsam.Rot3.Yaw(pose[2]), np.array([pose[0], pose[1], 0.0]))


def _model(covariance: Array, heading_rad: float) -> Any:
    """Noise of a pose or motion, whose covariance (3, 3) gtsam takes in the axes of its end."""
    whole = _LIFT**2 * np.eye(6)
    whole[np.ix_(_PLANAR, _PLANAR)] = _turned(covariance, -heading_rad)
    return gtsam.noiseModel.Gaussian.Covariance(whole)


def _turned(covariance: Array, angle_rad: float) -> Array:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turn @ covariance @ turn.T)


def _in_plane(pose: Any) -> Array:
    x, y, _ = pose.translation()
    return np.array([x, y, pose.rotation().yaw()])


def _in_map(covariance: Array, heading_rad: float) -> Array:
    return _turned(covariance[np.ix_(_PLANAR, _PLANAR)], heading_rad)


def isam2(problem: Problem) -> Tracked:
    """iSAM2 that relinearises at every image what has moved by more than `_MOVED`."""
    settings = gtsam.ISAM2Params()
    settings.relinearizeSkip = 1
    settings.setRelinearizeThreshold(_MOVED)
    solver, feed, n = gtsam.ISAM2(settings), Feed(problem), _n_poses(problem)
    means, covariances, pose = np.empty((n, 3)), np.empty((n, 3, 3)), None
    seconds = of_covariances_s = 0.0
    for i in range(n):
        begun = time.process_time()
        solver.update(*feed.image(i, pose))
        pose = solver.calculateEstimatePose3(i)
        solved = time.process_time()
        covariance = solver.marginalCovariance(i)
        seconds += solved - begun
        of_covariances_s += time.process_time() - solved
        means[i] = _in_plane(pose)
        covariances[i] = _in_map(covariance, means[i, 2])
    whole = solver.calculateBestEstimate()
    revised = np.array([_in_plane(whole.atPose3(i)) for i in range(n)])
    return Tracked(means, covariances, seconds, seconds + of_covariances_s, revised)


def batch(problem: Problem) -> Tracked:
    """Levenberg-Marquardt over all images so far at every image, from the solution before."""
    feed, n = Feed(problem), _n_poses(problem)
    graph, values, pose = gtsam.NonlinearFactorGraph(), gtsam.Values(), None
    means, covariances = np.empty((n, 3)), np.empty((n, 3, 3))
    seconds = of_covariances_s = 0.0
    for i in range(n):
        begun = time.process_time()
        factors, new = feed.image(i, pose)
        graph.push_back(factors)
        values.insert(new)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        pose = values.atPose3(i)
        solved = time.process_time()
        covariance = gtsam.Marginals(graph, values).marginalCovariance(i)
        seconds += solved - begun
        of_covariances_s += time.process_time() - solved
        means[i] = _in_plane(pose)
        covariances[i] = _in_map(covariance, means[i, 2])
    revised = np.array([_in_plane(values.atPose3(i)) for i in range(n)])
    return Tracked(means, covariances, seconds, seconds + of_covariances_s, revised)


def _images(recording: Recording) -> Ints:
    """Frames that are poses of the problem: those with observations, the first and the last."""
    seen = [
        row
        for row, frame in enumerate(recording.frames())
        if len(frame.readings.get("stereo", {}).get("points_in_camera", ()))
    ]
    return np.unique([0, *seen, len(recording.frame_stamps) - 1])


def rows_of(seed: int) -> Iterator[dict[str, Any]]:
    """Rows of all methods over one drive."""
    experiment = Experiment.compose([*DRIVE, "sensors.stereo.correlated=true", f"seed={seed}"])
    recording, robot = experiment.recording(), experiment.robot()
    prior = experiment.prior(recording)
    ours, whole = FixedLag(kr=robot.kr, kl=robot.kl), Smoother(kr=robot.kr, kl=robot.kl)
    with limited_blas():
        run_estimator(whole, recording, prior, stream(seed, "bench"))
        problem, guesses = whole.problem()
        solution = solve(problem, guesses)
        begun = time.process_time()
        online = run_estimator(ours, recording, prior, stream(seed, "bench"))
        seconds = time.process_time() - begun
    images = _images(recording)
    truth = recording.truth_at(online.stamps[images])
    found = {
        "fixed_lag": Tracked(
            online.means[images], online.covariances[images], seconds, seconds, solution.poses
        ),
        "iSAM2": isam2(problem),
        _EXACT: batch(problem),
    }
    for method, tracked in found.items():
        off = tracked.means[:, :2] - truth[:, :2]
        late = tracked.revised[:, :2] - truth[:, :2]
        apart = se2.difference(tracked.revised, solution.poses)[:, :2]
        yield {
            "method": method,
            "seed": seed,
            "online_m": float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
            "revised_m": float(np.sqrt(np.mean(np.sum(late**2, axis=1)))),
            "from_solve_m": float(np.hypot(*apart.T).max()),
            "nees_3": float(np.nanmean(nees(truth, tracked.means, tracked.covariances)) / 3.0),
            "seconds": tracked.seconds,
            "with_covariances_s": tracked.with_covariances_s,
        }


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """Means over the drives; errors as root mean squares, times as medians."""
    by_method = rows.groupby("method", sort=False)
    exact = rows[rows.method == _EXACT].set_index("seed").online_m

    def ratios(drives: pd.DataFrame) -> pd.Series[float]:
        return drives.set_index("seed").online_m / exact

    return pd.DataFrame(
        {
            "online, mm": 1e3 * by_method.online_m.apply(_rms),
            "revised, mm": 1e3 * by_method.revised_m.apply(_rms),
            "least ratio": by_method.apply(lambda drives: ratios(drives).min()),
            "most ratio": by_method.apply(lambda drives: ratios(drives).max()),
            "NEES / 3": by_method.nees_3.mean(),
            "s": by_method.seconds.median(),
            "s, with covariances": by_method.with_covariances_s.median(),
            "mm from solve": 1e3 * by_method.from_solve_m.max(),
        }
    ).reset_index()


def _rms(errors: pd.Series[float]) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _main() -> None:
    rows: list[dict[str, Any]] = []
    with progress("isam2", len(SEEDS)) as on_progress:
        for done, seed in enumerate(SEEDS, start=1):
            rows += rows_of(seed)
            on_progress(done)
    print(table(pd.DataFrame(rows)).to_string(index=False, float_format="%.3f"))


if __name__ == "__main__":
    _main()
