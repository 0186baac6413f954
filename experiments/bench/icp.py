"""Registration of pairs of scans without an initial guess, its covariances, and its peers.

Scans have 721 beams over 180 degrees and range noise of 1 cm. They are taken in furnished rooms of
5 to 10 m and in corridors of 30 to 50 m, where only niches of 8 to 20 cm and the end wall fix the
position along the corridor. `small` is a motion of 5 cm and 2 degrees, `large` of 20 cm and 8.

`fisher_ratio` is sqrt(median(e' F^-1 e) / 2.366) of the errors e in (x, y, heading). F is the least
covariance that the true pair allows (`evaluation.scan_bound`), 2.366 the median of chi-squared with
3 degrees of freedom: an efficient estimator has 1. The bound noted beside `error_mm` is the root of
the trace of F's position block. A failure is an error of more than 5 cm or 1 degree; failures count
in all medians. The fusion of wheels and laser is timed at the laser's full rate.

Scans of one pose that differ in their noise alone should register as the identity on average; what
they are off by is the bias of the metric.
"""

import importlib.util
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from statistics import geometric_mean
from typing import get_args

import numpy as np

from estimators.base import Estimate
from estimators.laser import icp_covariance
from estimators.laser.icp import Metric, PreparedScan, Registration, prepare, register
from estimators.peers import pose_of
from experiments.bench.measure import Measurement, median_time_s
from experiments.evaluation.metrics import score
from experiments.evaluation.registration_errors import same_pose_errors
from experiments.evaluation.scan_bound import cast, fisher_bound
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
from sim.arrays import Array
from sim.recording import Recording
from sim.sensors import Laser
from sim.sensors.casting import SegmentCaster
from sim.worlds.world import World

Matcher = Callable[[Array, Array], Array]  # ranges of the target and of the source -> pose

SIGMA_RANGE_M = 0.01
BEARINGS_RAD = np.linspace(-math.pi / 2.0, math.pi / 2.0, 721)
MOTIONS = {"small": (0.05, math.radians(2.0)), "large": (0.20, math.radians(8.0))}
FAILED_M, FAILED_RAD = 0.05, math.radians(1.0)

_SEEDS = range(1000, 1300)  # those below 1000 were for tuning
_MEDIAN_CHI2_3 = 2.366
_GOAL_MS, _GOAL_RATIO = 0.25, 1.2  # of point to line in rooms
_OFFICE = (
    "study=decristoforis2020/office",
    "sensors.laser.rate_hz=75",
    "simulation.physics=kinematic",
    "route.distance_m=20",
)
_GOALS = {"ekf_icp": 20.0, "ekf_icp_paper": None, "icp_odometry": None}
_SPARING = ("estimator.register_distance_m=0.05", "estimator.register_turn_rad=0.05")
_OFFICES = range(1000, 1004)  # seeds
_N_SAME_POSE = 1000  # noisy pairs a place


@dataclass(frozen=True)
class Pair:
    """Two scans (721,) m, the true T_target_source (3,), and the least covariance (3, 3) of it."""

    target_m: Array
    source_m: Array
    T_target_source: Array
    bound: Array


def run() -> Iterator[Measurement]:
    """All metrics over all classes, covariances, peers, bias at one pose, and the fusion."""
    classes = {
        f"{place}_{size}": [pair(place, size, seed) for seed in _SEEDS]
        for place in ("room", "corridor")
        for size in MOTIONS
    }
    peers = {"scipy": _match_by_scipy, "small_gicp": _match_by_gicp, "open3d": _match_by_open3d}
    matchers: dict[str, Matcher] = {
        **{metric: partial(_match, metric) for metric in get_args(Metric)},
        **{f"peer_{n}": match for n, match in peers.items() if importlib.util.find_spec(n)},
    }
    yield from _covariances(classes["room_small"])
    for name, match in matchers.items():
        for kind, pairs in classes.items():
            chosen = pairs[:60] if name.startswith("peer") else pairs
            yield from _measure(f"icp.{name}.{kind}", match, chosen)
    yield from _same_pose()
    yield from _fusion()


def pair(place: str, size: str, seed: int) -> Pair:
    """One pair of scans; the seed fixes the world, the poses and the noise."""
    rng = np.random.default_rng([seed, place == "room"])
    walls, (x_min, x_max, y_min, y_max) = _room(rng) if place == "room" else _corridor(rng)
    world = World(place, walls, np.tile([0.0, 2.0], (len(walls), 1)))
    distance_m, turn_rad = MOTIONS[size]
    clearance_m = 0.0
    while clearance_m <= 0.3:
        heading = rng.uniform(-np.pi, np.pi)
        if place == "corridor":
            heading = rng.choice([0.0, np.pi]) + rng.normal(0.0, 0.1)
        T_w_target = np.array([rng.uniform(x_min, x_max), rng.uniform(y_min, y_max), heading])
        way = rng.uniform(-np.pi, np.pi)
        motion = np.array(
            [distance_m * np.cos(way), distance_m * np.sin(way), turn_rad * rng.choice([-1, 1])]
        )
        T_w_source = se2.compose(T_w_target, motion)
        clearance_m = min(map(world.clearance_m, (T_w_target, T_w_source)))
    target_m, source_m = (
        cast(walls, pose, BEARINGS_RAD)[0] + SIGMA_RANGE_M * rng.standard_normal(len(BEARINGS_RAD))
        for pose in (T_w_target, T_w_source)
    )
    bound = fisher_bound(walls, T_w_target, T_w_source, BEARINGS_RAD, SIGMA_RANGE_M)
    return Pair(target_m, source_m, motion, bound)


def places(n: int = 10) -> Iterator[tuple[Laser, Array]]:
    """Laser and its scan (n_beams,) m without noise: a small one in rooms, an LMS291 in offices.

    Places are on the worlds' tours, with any heading; the seeds are for tuning.
    """
    for seed in range(n):
        world, sensors = ("office", "lms291") if seed % 2 else ("rooms", "hokuyo")
        experiment = Experiment.compose([f"world={world}", f"sensors={sensors}", f"seed={seed}"])
        laser, rng = experiment.sensors()["laser"], stream(seed, "bench")
        assert isinstance(laser, Laser)
        tour = experiment.world().waypoints
        k = rng.integers(len(tour) - 1)
        at = np.append(tour[k] + rng.random() * (tour[k + 1] - tour[k]), rng.uniform(-np.pi, np.pi))
        yield laser, SegmentCaster(experiment.world(), laser).cast(at)


def _same_pose() -> Iterator[Measurement]:
    """Largest mean error of point to plane between noisy scans of one pose, over ten places."""
    means = [
        same_pose_errors(scan_m, laser, stream(k, "sensors"), _N_SAME_POSE).mean(axis=(0, 1))
        for k, (laser, scan_m) in enumerate(places())
    ]
    off = np.max(np.abs(means), axis=0)
    note = f"largest mean over {len(means)} places, {_N_SAME_POSE} noisy pairs each, both ways"
    row = "icp.point_to_plane.same_pose_bias"
    yield Measurement(f"{row}_urad", 1e6 * float(off[2]), "µrad", 15.0, note=note)
    yield Measurement(f"{row}_mm", 1e3 * float(off[:2].max()), "mm", 0.05, note=note)


def _match(metric: Metric, target_m: Array, source_m: Array) -> Array:
    target, source = prepare(target_m, BEARINGS_RAD), prepare(source_m, BEARINGS_RAD)
    return register(source, target, metric=metric).T_target_source


def _measure(row: str, match: Matcher, pairs: list[Pair]) -> list[Measurement]:
    """Time from ranges to pose, and the errors, of one way to register over one class."""
    mine, in_room = "point_to_line" in row, "room" in row
    errors = np.array([match(p.target_m, p.source_m) - p.T_target_source for p in pairs])
    errors[:, 2] = se2.wrap(errors[:, 2])
    off_m, off_rad = np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])
    failed = (off_m > FAILED_M) | (off_rad > FAILED_RAD)
    bound_m = np.median([math.sqrt(p.bound[0, 0] + p.bound[1, 1]) for p in pairs])
    squares = [e @ np.linalg.solve(p.bound, e) for e, p in zip(errors, pairs, strict=True)]
    ratio = math.sqrt(np.median(squares) / _MEDIAN_CHI2_3)
    ms = 1e3 * median_time_s(match, [(p.target_m, p.source_m) for p in pairs], repeats=1)
    goal_ms, goal_ratio = (_GOAL_MS, _GOAL_RATIO) if mine and in_room else (None, None)
    error_mm, error_deg = 1e3 * float(np.median(off_m)), math.degrees(np.median(off_rad))
    share, goal_share = float(np.mean(failed)), 0.0 if mine else None
    return [
        Measurement(f"{row}.{name}", value, unit, goal, note=note)
        for name, value, unit, goal, note in (
            ("ms", ms, "ms", goal_ms, "two raw scans to pose"),
            ("error_mm", error_mm, "mm", None, f"median; bound {1e3 * bound_m:.2f}"),
            ("error_deg", error_deg, "deg", None, "median"),
            ("fisher_ratio", ratio, "1", goal_ratio, ""),
            ("fail_share", share, "1", goal_share, f"of {len(pairs)} pairs"),
        )
    ]


def _covariances(pairs: list[Pair]) -> list[Measurement]:
    """Time of each method for a point-to-line registration."""
    scans = [
        (prepare(p.source_m, BEARINGS_RAD), prepare(p.target_m, BEARINGS_RAD)) for p in pairs[:20]
    ]
    inputs = [(register(source, target), source, target) for source, target in scans]
    of_guess = np.diag([0.05**2, 0.05**2, 0.03**2])
    methods: dict[str, Callable[[Registration, PreparedScan, PreparedScan], object]] = {
        "censi": icp_covariance.censi,
        "hessian": lambda found, source, target: icp_covariance.hessian(found),
        "unscented": partial(icp_covariance.unscented, initial_covariance=of_guess),
        "unscented_censi": partial(icp_covariance.unscented_censi, initial_covariance=of_guess),
        "sampling": partial(icp_covariance.sampling, rng=np.random.default_rng(0)),
    }
    goals, notes = {"censi": 60.0}, {"sampling": "100 samples"}
    return [
        Measurement(
            f"icp.covariance.{name}_us",
            1e6 * median_time_s(method, inputs),
            "µs",
            goals.get(name),
            note=notes.get(name, ""),
        )
        for name, method in methods.items()
    ]


def _match_by_scipy(target_m: Array, source_m: Array) -> Array:
    """Point to line with SciPy's k-d tree: normals of 10 neighbours, Huber weights, no trimming."""
    from scipy.spatial import cKDTree

    target, source = _points(target_m), _points(source_m)
    tree = cKDTree(target)
    near = target[tree.query(target, k=10)[1]]
    off = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))[1][:, :, 0]
    pose = np.zeros(3)
    for _ in range(50):
        moved = se2.transform(pose, source)
        match = tree.query(moved)[1]
        normal = normals[match]
        miss = np.sum(normal * (moved - target[match]), axis=1)
        weight = 1.0 / np.maximum(1.0, np.abs(miss) / (2.0 * SIGMA_RANGE_M))
        arm = moved - pose[:2]
        lever = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        J = np.column_stack([normal, lever])
        step = np.linalg.solve(J.T @ (weight[:, None] * J), -J.T @ (weight * miss))
        pose = pose + step
        if np.abs(step).max() < 1e-5:
            break
    return pose


def _match_by_gicp(target_m: Array, source_m: Array) -> Array:
    """small_gicp's plane-to-plane ICP, the best of its methods here.

    A second layer of points turns the walls into planes; 2 cm between the layers suits it best.
    """
    import small_gicp  # type: ignore[import-not-found]

    found = small_gicp.align(
        _two_layers(target_m),
        _two_layers(source_m),
        registration_type="GICP",
        downsampling_resolution=1e-3,
        max_correspondence_distance=1.0,
        max_iterations=50,
        rotation_epsilon=1e-5,
        translation_epsilon=1e-5,
    )
    return pose_of(np.asarray(found.T_target_source))


def _match_by_open3d(target_m: Array, source_m: Array) -> Array:
    """Open3D's point-to-plane ICP, with the same two layers."""
    import open3d  # type: ignore[import-not-found]

    target, source = (
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(_two_layers(ranges)))
        for ranges in (target_m, source_m)
    )
    for cloud in (target, source):
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(20))
    ways = open3d.pipelines.registration
    found = ways.registration_icp(
        source,
        target,
        1.0,
        np.eye(4),
        ways.TransformationEstimationPointToPlane(),
        ways.ICPConvergenceCriteria(1e-8, 1e-8, 50),
    )
    return pose_of(np.asarray(found.transformation))


def _points(ranges_m: Array) -> Array:
    seen = np.isfinite(ranges_m)
    rays = np.stack([np.cos(BEARINGS_RAD[seen]), np.sin(BEARINGS_RAD[seen])], axis=1)
    return np.asarray(ranges_m[seen, None] * rays)


def _two_layers(ranges_m: Array) -> Array:
    points = np.pad(_points(ranges_m), ((0, 0), (0, 1)))
    return np.concatenate([points, points + np.array([0.0, 0.0, 0.02])])


def _room(rng: np.random.Generator) -> tuple[Array, tuple[float, float, float, float]]:
    """Walls of a room with three to six boxes, and where a robot may stand."""
    width, depth = rng.uniform(5.0, 10.0), rng.uniform(4.0, 8.0)
    walls = [_box(width / 2.0, depth / 2.0, width, depth, 0.0)]
    for _ in range(rng.integers(3, 7)):
        x, y = rng.uniform(0.5, width - 0.5), rng.uniform(0.5, depth - 0.5)
        box_width, box_depth = rng.uniform(0.3, 1.2, 2)
        walls.append(_box(x, y, box_width, box_depth, rng.uniform(0.0, np.pi)))
    return np.concatenate(walls), (0.6, width - 0.6, 0.6, depth - 0.6)


def _corridor(rng: np.random.Generator) -> tuple[Array, tuple[float, float, float, float]]:
    """Walls of a closed corridor with a niche of 0.9 m every few metres on either side."""
    width, length = rng.uniform(1.8, 2.6), rng.uniform(30.0, 50.0)
    sides = []
    for side in (-1.0, 1.0):
        y, x = side * width / 2.0, rng.uniform(1.0, 4.0)
        corners = [(0.0, y)]
        while x < length - 1.5:
            back = y + side * rng.uniform(0.08, 0.2)
            corners += [(x, y), (x, back), (x + 0.9, back), (x + 0.9, y)]
            x += rng.uniform(3.0, 7.0)
        sides.append([*corners, (length, y)])
    walls = _closed(np.array(sides[0] + sides[1][::-1]))
    return walls, (2.0, length - 2.0, -width / 2.0 + 0.4, width / 2.0 - 0.4)


def _box(x: float, y: float, width: float, depth: float, turn_rad: float) -> Array:
    corners = np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]]) / 2.0
    return _closed(se2.transform(np.array([x, y, turn_rad]), corners))


def _closed(corners: Array) -> Array:
    """Walls (N, 4) along a closed line through corners (N, 2)."""
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def _fusion() -> Iterator[Measurement]:
    """Real-time factors of the filters at 75 Hz and 721 beams, and a scan that may wait."""
    recordings = [Experiment.compose([*_OFFICE, f"seed={s}"]).simulate() for s in _OFFICES]
    recording = recordings[0]
    note = f"721 beams, {len(recording.frame_stamps)} steps"
    for name, goal in _GOALS.items():
        times = [_run(name, recording, repeat).step_seconds.sum() for repeat in range(3)]
        factor = recording.duration_s / statistics.median(times)
        yield Measurement(f"{name}.realtime_factor_75hz", factor, "x", goal, "higher", note)
    every, sparing = (
        [_run("ekf_icp", recording, 0, *options) for recording in recordings]
        for options in ((), _SPARING)
    )
    ratio = geometric_mean(
        score(recording, b)["ate_rmse_m"] / score(recording, a)["ate_rmse_m"]
        for recording, a, b in zip(recordings, every, sparing, strict=True)
    )
    mean_ms = statistics.median(1e3 * float(e.step_seconds.mean()) for e in sparing)
    note = (
        f"registered every 5 cm or 0.05 rad: {ratio:.2f} times the error of every scan, "
        f"{len(recordings)} offices at 75 Hz"
    )
    yield Measurement("ekf_icp.scan_ms_75hz", mean_ms, "ms", 0.12, note=note)


def _run(name: str, recording: Recording, repeat: int, *options: str) -> Estimate:
    experiment = Experiment.compose([*_OFFICE, f"estimator={name}", *options])
    prior = experiment.prior(recording)
    return run_over(recording, experiment.estimator(), prior, stream(repeat, "bench"))[0]
