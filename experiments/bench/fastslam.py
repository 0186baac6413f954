"""Speed of FastSLAM: a whole step, the landmark update alone, and how both grow with size."""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from estimators.base import Prior
from estimators.landmarks import particle_kernels as ekf
from estimators.landmarks.fastslam import FastSLAM
from estimators.landmarks.particle_maps import LandmarkMaps
from estimators.landmarks.stereo import StereoModel
from experiments.bench.measure import Measurement, median_time_s, time_steps
from experiments.evaluation.statistics import log_log_slope
from experiments.runs.evaluate import run_over
from sim.arrays import Array
from sim.recording import Log, Recording, WheelLog
from sim.robot.drive import RobotGeometry
from sim.robot.slip import wheel_errors
from sim.sensors import StereoCamera

PAPER = StereoCamera(sigma_column_px=10.0, sigma_row_px=10.0, correlated=False)
_TRACK_M, _STEP_M, _RADIUS_M, _K_M = 0.4, 0.4, 5.0, 5e-5
_PAPER: dict[str, Any] = {"proposal": "motion", "resampling": "multinomial", "ess_share": 1.0}
_SIZE: dict[str, Any] = {"n_landmarks": 200, "n_seen": 20}
_NS = (100, 200, 400, 800)


def run_steps(
    n_particles: int,
    *,
    n_landmarks: int,
    n_seen: int,
    n_steps: int = 400,
    camera: StereoCamera = PAPER,
    **options: Any,
) -> tuple[Array, float, float]:
    """Processor time (T,) of each step, s; share of steps that resample; bytes per particle."""
    recording = circling(n_landmarks, n_seen, n_steps, camera)
    prior = Prior(recording.robot, recording.sensors, np.zeros(3), np.zeros((3, 3)))
    estimator = FastSLAM(n_particles=n_particles, kr=_K_M, kl=_K_M, **options)
    run_over(recording.cut(40), estimator, prior, np.random.default_rng(0))
    estimator.reset(prior, np.random.default_rng(0))
    steps = time_steps(estimator, recording.frames())
    seconds, resampled = np.array([(s, belief.extras["resampled"]) for s, belief in steps]).T
    return seconds, float(resampled.mean()), estimator.bytes_per_particle


def circling(n_landmarks: int, n_seen: int, n_steps: int, camera: StereoCamera) -> Recording:
    """Laps inside a ring of N landmarks; every image shows B of those ahead.

    The ring grows with N, so that as many landmarks are in view whatever their number.
    """
    rng = np.random.default_rng([n_landmarks, n_seen])
    radius_m = _RADIUS_M * n_landmarks / _SIZE["n_landmarks"]
    turn = _STEP_M / radius_m * np.arange(n_steps)
    poses = np.stack([radius_m * np.sin(turn), radius_m * (1 - np.cos(turn)), turn], axis=1)
    angle = rng.uniform(-np.pi, np.pi, n_landmarks)
    radius = radius_m + rng.uniform(1.0, 4.0, n_landmarks)
    x, y = radius * np.cos(angle), radius_m + radius * np.sin(angle)
    landmarks = np.column_stack([x, y, rng.uniform(0, 2, n_landmarks)])
    model = StereoModel.of(camera)
    points, ids = np.empty((n_steps, n_seen, 3)), np.empty((n_steps, n_seen), np.int64)
    for i, pose in enumerate(poses):
        seen = model.predict(pose, landmarks)[0]
        near = np.argsort(np.where(seen[:, 2] > 1.0, seen[:, 2], np.inf))[: 3 * n_seen]
        ids[i] = rng.choice(near, n_seen, replace=False)
        points[i] = camera.measure(seen[ids[i]], rng)
    wheels = np.full((n_steps, 2), _STEP_M) * (1.0 + np.array([0.5, -0.5]) * _TRACK_M / radius_m)
    wheels += wheel_errors(np.full(wheels.shape, _STEP_M), _K_M, rng)
    wheels[0] = 0.0
    stamps = 0.8 * np.arange(n_steps, dtype=np.float64)
    return Recording(
        frame_stamps=stamps,
        wheels=WheelLog(stamps, np.cumsum(wheels, axis=0)),
        robot=RobotGeometry(0.1, _TRACK_M),
        sensors={"stereo": camera},
        logs={
            "stereo": Log.of(
                camera,
                stamps,
                n_seen * np.arange(n_steps + 1),
                points_in_camera=points.reshape(-1, 3),
                ids=ids.ravel(),
                descriptors=np.zeros((ids.size, 0)),
            )
        },
        config={"bench": "circling"},
    )


def update_ns(n_particles: int, n_landmarks: int, n_seen: int = 20) -> float:
    """Time of one landmark update, ns per particle and observation."""
    rng = np.random.default_rng(0)
    maps = LandmarkMaps(n_particles, "contiguous", births=False)
    points = rng.uniform([-3.0, -1.0, 2.0], [3.0, 1.0, 8.0], (n_landmarks, 3))
    maps.reserve(n_landmarks)
    state, packed = ekf.new_state(maps.n_blocks), StereoModel.of(StereoCamera()).packed
    poses = np.tile([[0.0], [0.0], [0.0], [1.0], [0.0]], (1, maps.n_blocks * ekf.LANES))
    ahead = np.array([0.0, 0.0, 1.0, 0.0])
    ekf.move(poses, np.zeros(3), np.zeros((3, 3)), poses[:3], ahead, state)
    slots = np.tile(np.arange(n_landmarks)[:, None], (1, n_particles))
    ekf.create(maps.data, maps.rows(slots), points, state, packed)

    def one_image(chosen: NDArray[np.int64]) -> None:
        for start in range(0, n_seen, ekf.GROUP):
            part = chosen[start : start + ekf.GROUP]
            ekf.update(maps.data, maps.place[part], points[part], state, packed)

    images = [(rng.choice(n_landmarks, n_seen, replace=False),) for _ in range(50)]
    return 1e9 * median_time_s(one_image, images) / (n_particles * n_seen)


def _steps() -> Iterator[Measurement]:
    pixel: dict[str, Any] = {"camera": StereoCamera()}
    arms: tuple[tuple[str, dict[str, Any], float | None, str], ...] = (
        ("", {}, 0.6, "FastSLAM 2.0, ESS < M/2"),
        ("motion_", {"proposal": "motion"}, 0.5, "FastSLAM 1.0, ESS < M/2"),
        ("paper_", _PAPER, None, "FastSLAM 1.0, multinomial at every image"),
        ("pixel_", pixel, None, "FastSLAM 2.0, ESS < M/2, noise of 1 px"),
    )
    for arm, options, goal, note in arms:
        seconds, share, _ = run_steps(1000, **_SIZE, **options)
        mean, last = 1e3 * float(seconds.mean()), 1e3 * float(np.quantile(seconds, 0.99))
        name = f"fastslam.{arm}step_m1000_n200_b20"
        yield from (
            Measurement(f"{name}_ms", mean, "ms", goal, note=f"{note}; mean over all steps"),
            Measurement(f"{name}_p99_ms", last, "ms", goal and 1.2),
            Measurement(f"{name}_resampled", share, "", note="share of steps that resample"),
        )


def cost_by_landmarks(n_repeats: int, n_unknown: int = 0) -> pd.DataFrame:
    """Time of a step against N, with either kind of map, resampling at every image.

    With known association, and in the first `n_unknown` repeats also by the Mahalanobis distance,
    for which every landmark near is asked, in some ten times the time.
    """
    rows = []
    arms = itertools.product(range(n_repeats), _NS, ("shared", "contiguous"), ("known", "unknown"))
    for repeat, n, maps, ids in arms:
        if ids == "unknown" and repeat >= n_unknown:
            continue
        size: dict[str, Any] = {"n_landmarks": n, "n_seen": 20, "n_steps": n // 2 + 60}
        how: dict[str, Any] = {}
        if ids == "unknown":
            how = {"association": "mahalanobis", "d0": 7.81}
        seconds, _, _ = run_steps(1000, **size, maps=maps, **_PAPER, **how)
        ms = 1e3 * float(np.median(seconds[-50:]))  # in the second lap
        row = {"repeat": repeat, "maps": maps, "association": ids, "n_landmarks": n}
        rows.append({**row, "step_ms": ms})
    return pd.DataFrame(rows)


def _by_size() -> Iterator[Measurement]:
    ms, bs = (250, 500, 1000, 2000, 4000), (5, 10, 20, 40)
    by_m = [float(run_steps(m, **_SIZE, n_steps=150)[0].mean()) for m in ms]
    by_b = [float(run_steps(1000, n_landmarks=200, n_seen=b, n_steps=150)[0].mean()) for b in bs]
    yield from (
        Measurement("fastslam.slope_m", log_log_slope(ms, by_m), "", note=f"M in {ms}"),
        Measurement("fastslam.slope_b", log_log_slope(bs, by_b), "", note=f"B in {bs}"),
    )
    known = cost_by_landmarks(1)
    for maps, part in known.groupby("maps"):
        exponent = log_log_slope(part["n_landmarks"], part["step_ms"])
        kib = run_steps(1000, **_SIZE, n_steps=100, maps=maps)[2] / 1024
        note = f"N in {_NS}, resampling at every image"
        yield from (
            Measurement(f"fastslam.slope_n_{maps}", exponent, "", note=note),
            Measurement(
                f"fastslam.memory_{maps}_n200_kib", kib, "KiB", note="maps of one particle"
            ),
        )


def run() -> list[Measurement]:
    """Steps, updates, slopes and memory."""
    small, large = update_ns(1000, 200), update_ns(1000, 2000)
    note = "per particle and observation, M = 1000"
    return [
        *_steps(),
        Measurement("fastslam.update_ns", small, "ns", 10.0, note=f"{note}, N = 200"),
        Measurement("fastslam.update_streamed_ns", large, "ns", note=f"{note}, N = 2000"),
        *_by_size(),
    ]
