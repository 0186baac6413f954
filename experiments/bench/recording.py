"""Speed of recording with the physics engine and its rays, from the first tick to the last."""

import resource
import statistics
import time

from experiments.bench.casting import hall
from experiments.bench.measure import Measurement, median_time_s
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim.bullet import BulletBody
from sim.robot import DifferentialDrive
from sim.route import OpenLoop
from sim.sensors import Encoder, Laser, SensorSuite
from sim.simulate import BulletRays, record

_ROBOT = DifferentialDrive(0.05, 0.19, kr=1e-5, kl=1e-5)
_CIRCLE = OpenLoop(((0.1, 0.2, 59.6),))  # for a minute; a metre across, clear of walls


def run() -> list[Measurement]:
    """Real-time factor of a minute at 10 Hz and 721 beams among 52 faces; one Bullet scan."""
    world = Experiment.compose(["world=boxes", "world.n_boxes=12"]).world()
    sensors = SensorSuite(Encoder(None), Laser(rate_hz=10.0))
    factors = []
    for repeat in range(3):
        streams = {axis: stream(repeat, axis) for axis in ("slip", "sensors")}
        begun = time.perf_counter()
        recording = record(world, _ROBOT, sensors, _CIRCLE, streams)
        factors.append(recording.duration_s / (time.perf_counter() - begun))
        assert recording.status == "ok", recording.status
    memory_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    hall_30, poses = hall(30, 50)
    laser = Laser(n_beams=721)
    with BulletBody(hall_30, _ROBOT, poses[0]) as body:
        scan = BulletRays(body).scan
        scan_s = median_time_s(lambda pose: scan(laser, pose), [(pose,) for pose in poses])
    factor, note = statistics.median(factors), "Bullet rays, 721 beams, 52 faces, 60 s"
    return [
        Measurement("sim.realtime_factor_10hz", factor, "x", 12.0, "higher", note),
        Measurement("sim.scan_bullet_30_us", 1e6 * scan_s, "us", note="the same scan by Bullet"),
        Measurement("sim.peak_memory_mib", memory_mib, "MiB", note="of the process so far"),
    ]
