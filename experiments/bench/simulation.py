"""Speed of the simulation: recording from the first tick to the last, and the exact rays."""

import math
import statistics
import time
from collections.abc import Iterator

import numpy as np

from experiments.bench.measure import Measurement, median_time_s, peak_mib
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.robot.bullet import BulletBody
from sim.robot.drive import DifferentialDrive
from sim.routes.route import OpenLoop
from sim.sensors import Laser, Lidar3D
from sim.sensors.casting import SegmentCaster, cast_lidar, visible
from sim.sensors.rays import BulletRays
from sim.simulate import Member, record
from sim.worlds.world import World

_ROBOT = DifferentialDrive(wheel_radius_m=0.05, track_m=0.19, kr=1e-5, kl=1e-5)
_CIRCLE = OpenLoop(segments=((0.1, 0.2, 59.6),))  # for a minute; a metre across, clear of walls
_FAST = ("world=rooms", "sensors=lms291", "robot=robocom", "route.distance_m=20")
_LASER = Laser(n_beams=721, fov_rad=math.pi, max_range_m=80.0)
_BATCH = 50  # small enough for its output to stay in the processor's cache


def run() -> Iterator[Measurement]:
    """Real-time factors and memory of recording, and rays among random boxes."""
    yield from _recordings()
    yield Measurement("sim.peak_memory_mib", peak_mib(), "MiB", note="of the process so far")
    world, poses = hall(30, 50)
    with BulletBody(world, _ROBOT, poses[0]) as body:
        scan, laser = BulletRays(body).scan, Laser(n_beams=721)
        scan_s = median_time_s(lambda pose: scan(laser, pose), [(pose,) for pose in poses])
    yield Measurement("sim.scan_bullet_30_us", 1e6 * scan_s, "µs", note="721 beams by Bullet")
    yield from _scans(30, 10.0)
    yield from _scans(300, 40.0)
    yield from _other_rays()


def _recordings() -> Iterator[Measurement]:
    world = Experiment.compose(["world=boxes", "world.n_boxes=12"]).world()
    factors = []
    for repeat in range(3):
        streams = {axis: stream(repeat, axis) for axis in ("slip", "sensors")}
        begun = time.perf_counter()
        recording = record(world, Member(_ROBOT, {"laser": Laser(rate_hz=10.0)}, _CIRCLE, streams))
        factors.append(recording.duration_s / (time.perf_counter() - begun))
        assert recording.status == "ok", recording.status
    note = "Bullet rays, 721 beams, 52 faces, 60 s"
    factor = statistics.median(factors)
    yield Measurement("sim.realtime_factor_10hz", factor, "x", 32.0, "higher", note)
    for name, physics, goal in (("exact", "bullet", 40.0), ("kinematic", "kinematic", 200.0)):
        settings = (f"simulation.physics={physics}", "simulation.rays=exact")
        simulate = Experiment.compose([*_FAST, *settings]).simulate
        seconds = median_time_s(simulate, at_least_s=0.0, repeats=3, clock=time.process_time)
        note = f"{physics}, exact rays, 721 beams, a tour of rooms; processor time"
        factor = simulate().duration_s / seconds
        yield Measurement(f"sim.realtime_factor_75hz_{name}", factor, "x", goal, "higher", note)


def _scans(n_boxes: int, goal_us: float) -> Iterator[Measurement]:
    world, poses = hall(n_boxes)
    caster, name = SegmentCaster(world, _LASER), f"sim.scan_exact_{n_boxes}"
    batches = [(poses[i : i + _BATCH],) for i in range(0, len(poses), _BATCH)]
    each_us = 1e6 * median_time_s(caster.cast, [(pose,) for pose in poses])
    many_us = 1e6 * median_time_s(caster.cast_many, batches) / _BATCH
    note = f"721 beams, {len(world.walls)} faces"
    yield Measurement(f"{name}_us", each_us, "µs", goal_us, note=f"{note}, one call")
    yield Measurement(f"{name}_batch_us", many_us, "µs", note=f"{note}, in batches of {_BATCH}")


def _other_rays() -> Iterator[Measurement]:
    world, poses = hall(75, 50)
    points = np.random.default_rng(3).uniform([-19.0, -19.0, 0.2], [19.0, 19.0, 1.8], (800, 3))
    lidar, faces = Lidar3D(), f"{len(world.walls)} faces"
    cloud_s = median_time_s(lambda pose: cast_lidar(world, lidar, pose), [(p,) for p in poses])
    origins = [(np.append(pose[:2], 0.5),) for pose in poses]
    sight_s = median_time_s(lambda origin: visible(world, origin, points), origins)
    yield Measurement("sim.cloud_exact_us", 1e6 * cloud_s, "µs", note=f"16 x 720 rays, {faces}")
    yield Measurement("sim.visible_exact_us", 1e6 * sight_s, "µs", note=f"800 points, {faces}")


def hall(n_boxes: int, n_poses: int = 500) -> tuple[World, Array]:
    """A square hall of 40 m with randomly turned boxes of 0.4 to 2 m, and poses between them.

    Returns
    -------
    World
        Four faces a box, which may overlap, and the four of the hall.
    Array
        (n_poses, 3) m, m, rad; at least 0.1 m from the boxes.
    """
    rng = np.random.default_rng([n_boxes, 1])
    centres = rng.uniform(-18.0, 18.0, (n_boxes, 2))
    halves = rng.uniform(0.2, 1.0, (n_boxes, 2))
    yaws = rng.uniform(-np.pi, np.pi, n_boxes)
    cos, sin = np.cos(yaws), np.sin(yaws)
    axes = np.stack([[cos, sin], [-sin, cos]]).transpose(2, 0, 1)
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    boxes = centres[:, None] + (square * halves[:, None]) @ axes
    corners = np.concatenate([20.0 * square[None], boxes])
    walls = np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 4)
    world = World("hall", walls, np.tile([0.0, 2.0], (len(walls), 1)))

    poses = rng.uniform([-19.5, -19.5, -np.pi], [19.5, 19.5, np.pi], (4 * n_poses, 3))
    offset = np.einsum("bij,nbj->nbi", axes, poses[:, None, :2] - centres)
    free = np.any(np.abs(offset) > halves + 0.1, axis=2).all(axis=1)
    return world, poses[free][:n_poses]
