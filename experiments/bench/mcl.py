"""Speed of Monte Carlo localization: the whole update, and the look-up alone.

A robot drives round an office; every scan has 721 beams with returns, all of which are used by
each of 10,000 particles. Times are the processor's, of all threads, so that other programs on the
machine count for little. MRPT names 30 to 36 million for itself.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.base import Prior
from estimators.likelihood_field import beam_ends, likelihood_field
from estimators.mcl import Mcl
from experiments.bench.measure import Measurement
from experiments.runs.seeds import stream
from sim import se2
from sim.builders import office
from sim.casting import SegmentCaster
from sim.recording import Frame
from sim.robot import RobotGeometry, arc_increment
from sim.sensors import Laser, SensorSuite
from sim.world import World

Array = NDArray[np.float64]

_LASER = Laser(n_beams=721, max_range_m=80.0, sigma_range_m=0.01)
_N_PARTICLES = 10_000
_TRACK_M = 0.44
_STEP_M = 0.25  # a scan is used every 0.2 m
_GOAL = 400e6


def run() -> list[Measurement]:
    """Whole updates while tracking, and look-ups near the robot and over all the floor."""
    world = office(
        rng=stream(0, "world"),
        corridor_m=2.2,
        n_landmarks=0,
        look_alike_share=0.0,
        objects_per_room=5,
        rooms_visited=8,
    )
    poses, frames = _drive(world, 240)
    per_update = _N_PARTICLES * _LASER.n_beams
    seconds, drawn = _updates(world, poses, frames)
    size = f"{_LASER.n_beams} beams x {_N_PARTICLES} particles"
    whole = f"{size}; motion, weights, belief, resampling ({drawn:.0%} of updates)"
    results = [
        Measurement(
            "mcl.particle_beams_per_s", per_update / seconds, "1/s", _GOAL, "higher", whole
        ),
        Measurement("mcl.update_ms", seconds * 1e3, "ms", note=whole),
    ]
    field = likelihood_field(world, _LASER)
    rng = np.random.default_rng(0)
    near = [
        (pose + rng.standard_normal((_N_PARTICLES, 3)) * [0.1, 0.1, 0.03], _ends(frame))
        for pose, frame in zip(poses[::24], frames[::24], strict=True)
    ]
    anywhere = [(field.draw(_N_PARTICLES, rng), ends) for _, ends in near]
    for name, inputs in (("near", near), ("anywhere", anywhere)):
        times_s = [_cpu_s(field.log_likelihood, *given) for _ in range(5) for given in inputs]
        per_s = per_update / statistics.median(times_s)
        note = f"{size}; the look-up alone, particles {name}"
        results.append(Measurement(f"mcl.lookups_{name}_per_s", per_s, "1/s", None, "higher", note))
    return results


def _cpu_s(function: Callable[..., object], *given: Any) -> float:
    """Processor time of one call, s."""
    begun = time.process_time()
    function(*given)
    return time.process_time() - begun


def _ends(frame: Frame) -> NDArray[np.float32]:
    assert frame.ranges_m is not None
    return beam_ends(frame.ranges_m, _LASER, _LASER.n_beams)


def _drive(world: World, n_frames: int) -> tuple[Array, list[Frame]]:
    """Poses (N, 3) along the tour, 0.25 m apart, and frames whose beams all have returns."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(world.waypoints, axis=0).T))])
    along = _STEP_M * np.arange(n_frames + 1)
    places = np.column_stack([np.interp(along, way, world.waypoints[:, i]) for i in (0, 1)])
    steps = np.diff(places, axis=0)
    poses = np.column_stack([places[:-1], np.arctan2(steps[:, 1], steps[:, 0])])
    caster, rng = SegmentCaster(world, _LASER), np.random.default_rng(0)
    frames = []
    for i, pose in enumerate(poses):
        travel = np.zeros(2)
        if i:  # turn and go as one arc's end has it; the wheels need not have driven it
            turn = float(se2.wrap(pose[2] - poses[i - 1, 2]))
            travel = _STEP_M + np.array([0.5, -0.5]) * turn * _TRACK_M
            pose = poses[i] = se2.compose(poses[i - 1], arc_increment(travel, _TRACK_M))
        ranges = caster.cast(se2.compose(pose, _LASER.mount.pose))
        scan = _LASER.measure(ranges, rng)
        frames.append(Frame(0.5 * i, 0.5 if i else 0.0, travel, scan))
    return poses, frames


def _updates(world: World, poses: Array, frames: list[Frame]) -> tuple[float, float]:
    """Median time of a step that uses a scan, s, and the share of steps that drew anew.

    The likelihood is as sharp as a tracker's, the number of particles fixed.
    """
    estimator = Mcl(
        n_least=_N_PARTICLES,
        n_most=_N_PARTICLES,
        n_beams=_LASER.n_beams,
        beam_power=0.01,
        kr=1e-4,
        kl=1e-4,
    )
    prior = Prior(
        RobotGeometry(0.1, _TRACK_M),
        SensorSuite(laser=_LASER),
        poses[0].copy(),
        np.diag(np.square([0.1, 0.1, 0.03])),
        world,
    )
    seconds: list[float] = []
    drawn = 0
    for _ in range(2):  # the first round compiles
        estimator.reset(prior, np.random.default_rng(0))
        seconds, drawn = [], 0
        for pose, frame in zip(poses, frames, strict=True):
            begun = time.process_time()
            belief = estimator.step(frame)
            seconds.append(time.process_time() - begun)
            drawn += belief.extras["ess"] < estimator.ess_share * _N_PARTICLES
            if np.hypot(*(belief.mean - pose)[:2]) > 0.5:
                raise RuntimeError("the filter that is timed has lost the robot")
    return statistics.median(seconds), drawn / len(frames)
