"""Speed of Monte Carlo localization, whole updates and the look-up alone; drives that it keeps.

A robot drives round an office; every scan has 721 beams with returns, and each of 10,000 particles
uses them all. Times are processor times of all threads, so that other programs on the machine count
for little. MRPT claims 30 to 36 million.

A drive is kept if the error stays below 0.5 m and 10 degrees: with people about the robot, and on a
map from before a fifth of the furniture moved.
"""

import math
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from estimators.base import Prior
from estimators.on_a_map.likelihood_field import FieldOptions, beam_ends, likelihood_field
from estimators.on_a_map.mcl import Mcl
from experiments.bench.measure import Measurement, median_time_s, time_steps
from experiments.evaluation.metrics import heading_errors_rad, position_errors_m
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
from sim.arrays import Array
from sim.recording import Frame
from sim.robot.arc import arc_increment
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser
from sim.sensors.casting import SegmentCaster
from sim.worlds.buildings import office
from sim.worlds.world import World

_LASER = Laser(n_beams=721, max_range_m=80.0, sigma_range_m=0.01)
_N_PARTICLES = 10_000
_TRACK_M = 0.44
_STEP_M = 0.25  # a scan is used every 0.2 m
_KEPT_M, _KEPT_RAD = 0.5, math.radians(10.0)
_DRIVES = range(1000, 1010)  # seeds, each in rooms and in an office
_KEPT = {
    "people": ("people.n=10", "people.within_m=4"),
    "changed": ("world.changed_share=0.2",),
}
_DRIVE = (
    "robot=robocom",
    "sensors=lms291",
    "sensors.laser.rate_hz=5",
    "route=tour",
    "route.distance_m=20",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
    "estimator=mcl",
    "prior.map=world",
    "prior.sigma_position_m=0.05",
    "prior.sigma_heading_rad=0.03",
)


def run() -> Iterator[Measurement]:
    """Whole updates while tracking, look-ups near the robot and over the floor, and drives kept."""
    world = office(
        rng=stream(0, "world"),
        corridor_m=2.2,
        n_landmarks=0,
        look_alike_share=0.0,
        objects_per_room=5,
        rooms_visited=8,
    )
    poses, travels, scans = _drive(world, 240)
    frames = [
        Frame(0.5 * i, 0.5 if i else 0.0, travel, {"laser": {"ranges_m": scan}})
        for i, (travel, scan) in enumerate(zip(travels, scans, strict=True))
    ]
    per_update = _N_PARTICLES * _LASER.n_beams
    update_s, resampled = _updates(world, poses, frames)
    size = f"{_LASER.n_beams} beams x {_N_PARTICLES} particles"
    note = f"{size}; motion, weights, belief, resampling ({resampled:.0%} of updates)"
    rate = per_update / update_s
    yield Measurement("mcl.particle_beams_per_s", rate, "1/s", 400e6, "higher", note)
    yield Measurement("mcl.update_ms", update_s * 1e3, "ms", note=note)
    field = likelihood_field(world, _LASER, FieldOptions())
    rng = np.random.default_rng(0)
    ends = [beam_ends(scan, _LASER, _LASER.n_beams) for scan in scans[::24]]
    spread = [0.1, 0.1, 0.03]
    near = [pose + rng.standard_normal((_N_PARTICLES, 3)) * spread for pose in poses[::24]]
    anywhere = [field.draw(_N_PARTICLES, rng) for _ in ends]
    for name, particles in (("near", near), ("anywhere", anywhere)):
        inputs = zip(particles, ends, strict=True)
        rate = per_update / median_time_s(field.log_likelihood, inputs, clock=time.process_time)
        note = f"{size}; the look-up alone, particles {name}"
        yield Measurement(f"mcl.lookups_{name}_per_s", rate, "1/s", None, "higher", note)
    for name, changes in _KEPT.items():
        drives = np.array(
            [
                _follow(Experiment.compose([f"world={place}", f"seed={seed}", *_DRIVE, *changes]))
                for place in ("rooms", "office")
                for seed in _DRIVES
            ]
        )
        kept, error_m, short = drives.mean(axis=0)
        note = (
            f"{len(drives)} drives of 20 m ({', '.join(changes)}); {short:.0%} of the beams end "
            f"short of the known map; error {1e3 * error_m:.0f} mm"
        )
        yield Measurement(f"mcl.kept_{name}_share", kept, "", 1.0, "higher", note)


def _follow(experiment: Experiment) -> tuple[bool, float, float]:
    """Whether a drive is kept, the RMS error, m, and the share of beams 0.1 m short of the map."""
    recording = experiment.recording()
    prior = experiment.prior(recording)
    rng = stream(experiment.seed, "estimator/mcl")
    estimate, _ = run_over(recording, experiment.estimator(), prior, rng)
    poses = recording.truth_at(estimate.stamps)
    off_m = position_errors_m(poses, estimate.means)
    off_rad = np.abs(heading_errors_rad(poses, estimate.means))
    laser, log = recording.sensor("laser", Laser), recording.log("laser")
    eyes = se2.compose(recording.truth_at(log.stamps), laser.mount.pose)
    expected_m = SegmentCaster(recording.known_world.known, laser).cast_many(eyes)
    short = float(np.mean(log["ranges_m"] < expected_m - 0.1))
    kept = off_m.max() < _KEPT_M and off_rad.max() < _KEPT_RAD
    return bool(kept), float(np.sqrt(np.mean(off_m**2))), short


def _drive(world: World, n_frames: int) -> tuple[Array, Array, NDArray[np.float32]]:
    """Poses (N, 3) along the tour, wheel travel (N, 2) between them, and scans (N, 721), m."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(world.waypoints, axis=0).T))])
    along = _STEP_M * np.arange(n_frames + 1)
    places = np.column_stack([np.interp(along, way, world.waypoints[:, i]) for i in (0, 1)])
    steps = np.diff(places, axis=0)
    poses = np.column_stack([places[:-1], np.arctan2(steps[:, 1], steps[:, 0])])
    travels = np.zeros((n_frames, 2))
    for i in range(1, n_frames):  # an arc that takes up the whole turn: the way need not be exact
        turn = float(se2.wrap(poses[i, 2] - poses[i - 1, 2]))
        travels[i] = _STEP_M + np.array([0.5, -0.5]) * turn * _TRACK_M
        poses[i] = se2.compose(poses[i - 1], arc_increment(travels[i], _TRACK_M))
    ranges = SegmentCaster(world, _LASER).cast_many(se2.compose(poses, _LASER.mount.pose))
    return poses, travels, _LASER.measure(ranges, np.random.default_rng(0))


def _updates(world: World, poses: Array, frames: list[Frame]) -> tuple[float, float]:
    """Median time of a step that uses a scan, s, and the share of steps that resample.

    The likelihood is as sharp as a tracker's, and the number of particles is fixed.
    """
    estimator = Mcl(
        min_particles=_N_PARTICLES,
        max_particles=_N_PARTICLES,
        n_beams=_LASER.n_beams,
        beam_power=0.01,
        kr=1e-4,
        kl=1e-4,
    )
    prior = Prior(
        RobotGeometry(0.1, _TRACK_M),
        {"laser": _LASER},
        poses[0].copy(),
        np.diag(np.square([0.1, 0.1, 0.03])),
        world,
    )
    for _ in range(2):  # the first round compiles
        estimator.reset(prior, np.random.default_rng(0))
        steps = [
            (seconds, belief.extras["ess"], *(belief.mean - pose)[:2])
            for pose, (seconds, belief) in zip(poses, time_steps(estimator, frames), strict=True)
        ]
    seconds, ess, *off_m = np.array(steps).T
    if np.hypot(*off_m).max() > 0.5:
        raise RuntimeError("the timed filter has lost the robot")
    return float(np.median(seconds)), float(np.mean(ess < estimator.ess_share * _N_PARTICLES))
