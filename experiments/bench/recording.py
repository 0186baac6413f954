"""Making a recording with the physics engine and its rays, from first tick to last."""

from __future__ import annotations

import resource
import statistics
import time

import numpy as np

from experiments.bench.casting import hall
from experiments.bench.measure import Measurement, median_time_s
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim.bullet import BulletBody
from sim.robot import DifferentialDrive
from sim.route import OpenLoop
from sim.sensors import Encoder, Laser, SensorSuite
from sim.simulate import BulletRays, record

SIMULATED_S = 60.0
ROBOT = DifferentialDrive(0.05, 0.19, kr=1e-5, kl=1e-5)
CIRCLE = OpenLoop(((0.1, 0.2, SIMULATED_S - 0.4),))  # a metre across, clear of walls


def run() -> list[Measurement]:
    """Real-time factor of a minute at 10 Hz and 721 beams among 52 faces; one Bullet scan."""
    world = Experiment.compose(["world=boxes", "world.n_boxes=12"]).world()
    sensors = SensorSuite(Encoder(None), Laser(rate_hz=10.0))
    factors = []
    for repeat in range(3):
        streams = {axis: stream(repeat, axis) for axis in ("slip", "sensors")}
        begun = time.perf_counter()
        recording = record(world, ROBOT, sensors, CIRCLE, streams)
        factors.append(recording.duration_s / (time.perf_counter() - begun))
        assert recording.status == "ok", recording.status
    memory_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    scan_us = 1e6 * _bullet_scan_s(30)
    return [
        Measurement(
            "sim.realtime_factor_10hz",
            statistics.median(factors),
            "x",
            12.0,
            "higher",
            "Bullet rays, 721 beams, 52 faces, 60 s",
        ),
        Measurement("sim.scan_bullet_30_us", scan_us, "us", note="the same scan by Bullet"),
        Measurement("sim.peak_memory_mib", memory_mib, "MiB", note="of the process so far"),
    ]


def _bullet_scan_s(n_boxes: int) -> float:
    world, poses = hall(n_boxes)
    laser = Laser(n_beams=721)
    start = np.asarray(poses[0], float)
    with BulletBody(world, ROBOT, start) as body:
        rays = BulletRays(body)
        return median_time_s(lambda pose: rays.scan(laser, pose), [(p,) for p in poses[:50]])
