"""Speed of recording with the physics engine and its rays, from the first tick to the last."""

import statistics
import time

from experiments.bench.casting import hall
from experiments.bench.measure import Measurement, median_time_s, peak_mib, time_s
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim.robot.bullet import BulletBody
from sim.robot.drive import DifferentialDrive
from sim.routes.route import OpenLoop
from sim.sensors import Laser
from sim.sensors.rays import BulletRays
from sim.simulate import Member, record

_ROBOT = DifferentialDrive(wheel_radius_m=0.05, track_m=0.19, kr=1e-5, kl=1e-5)
_CIRCLE = OpenLoop(segments=((0.1, 0.2, 59.6),))  # for a minute; a metre across, clear of walls
_FAST = ("world=rooms", "sensors=lms291", "robot=robocom", "route.distance_m=20")


def run() -> list[Measurement]:
    """Real-time factors of recording, and one Bullet scan."""
    world = Experiment.compose(["world=boxes", "world.n_boxes=12"]).world()
    sensors = {"laser": Laser(rate_hz=10.0)}
    factors = []
    for repeat in range(3):
        streams = {axis: stream(repeat, axis) for axis in ("slip", "sensors")}
        begun = time.perf_counter()
        recording = record(world, Member(_ROBOT, sensors, _CIRCLE, streams))
        factors.append(recording.duration_s / (time.perf_counter() - begun))
        assert recording.status == "ok", recording.status
    results = [
        Measurement(
            "sim.realtime_factor_10hz",
            statistics.median(factors),
            "x",
            32.0,
            "higher",
            "Bullet rays, 721 beams, 52 faces, 60 s",
        )
    ]
    for name, physics, goal in (("exact", "bullet", 40.0), ("kinematic", "kinematic", 200.0)):
        experiment = Experiment.compose(
            [*_FAST, f"simulation.physics={physics}", "simulation.rays=exact"]
        )
        experiment.simulate()  # compiles
        times = [time_s(experiment.simulate, clock=time.process_time) for _ in range(3)]
        factor = experiment.simulate().duration_s / statistics.median(times)
        results.append(
            Measurement(
                f"sim.realtime_factor_75hz_{name}",
                factor,
                "x",
                goal,
                "higher",
                f"{physics}, exact rays, 721 beams, a tour of rooms; processor time",
            )
        )
    memory_mib = peak_mib()
    hall_30, poses = hall(30, 50)
    laser = Laser(n_beams=721)
    with BulletBody(hall_30, _ROBOT, poses[0]) as body:
        scan = BulletRays(body).scan
        scan_s = median_time_s(lambda pose: scan(laser, pose), [(pose,) for pose in poses])
    return [
        *results,
        Measurement("sim.scan_bullet_30_us", 1e6 * scan_s, "µs", note="the same scan by Bullet"),
        Measurement("sim.peak_memory_mib", memory_mib, "MiB", note="of the process so far"),
    ]
