"""The robot with ideal rolling: the same slip law as the Bullet robot, without the engine."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sim.arrays import Array, ArrayLike
from sim.compiled import njit
from sim.errors import require
from sim.robot.arc import SMALL_ANGLE_RAD
from sim.robot.base import TICK_S, Robot
from sim.robot.drive import DifferentialDrive
from sim.robot.slip import SLIP_TIME_CONSTANT_S, forward_increment, slip_increment
from sim.routes.route import OpenLoop

_slipped = njit()(slip_increment)
_slipped_together = njit()(forward_increment)
_BLOCK_NORMALS = 2_000_000  # drawn at once, 16 MB; the bits do not depend on it


class KinematicBody:
    """A robot whose wheels roll exactly as driven; the body moves along exact arcs.

    Parameters
    ----------
    robot
        Its track is all that matters here.
    pose
        (3,) m, m, rad: base_link at the start.
    dt_s
        Length of a tick, s.
    """

    def __init__(self, robot: Robot, pose: ArrayLike, dt_s: float = TICK_S) -> None:
        self._track_m, self._dt_s = robot.track_m, dt_s
        self._x, self._y, self._heading = np.array(pose, dtype=np.float64).tolist()

    def step(self, right_mps: float, left_mps: float) -> tuple[float, float]:
        """Advance one tick at ground speeds of the wheels; return their rolling, m."""
        right, left = right_mps * self._dt_s, left_mps * self._dt_s
        x, y, turn = _arc(right, left, self._track_m)
        cos, sin = math.cos(self._heading), math.sin(self._heading)
        self._x += cos * x - sin * y
        self._y += sin * x + cos * y
        self._heading += turn
        return right, left

    @property
    def pose(self) -> Array:
        """(3,) m, m, rad: base_link in map; the heading is not wrapped."""
        return np.array([self._x, self._y, self._heading])


def _arc(right_m: float, left_m: float, track_m: float) -> tuple[float, float, float]:
    """`robot.arc_increment` in floats: one robot's tick is too small for NumPy's calls."""
    turn = (right_m - left_m) / track_m
    half = turn / 2.0
    require(
        math.isfinite(half + right_m),
        "the robot's motion is not finite; check robot.kr, robot.kl, robot.track_m and its speeds",
    )
    small = abs(half) < SMALL_ANGLE_RAD
    chord = (right_m + left_m) / 2.0
    chord *= 1.0 - half**2 / 6.0 if small else math.sin(half) / half
    return chord * math.cos(half), chord * math.sin(half), turn


@dataclass(frozen=True)
class BatchRuns:
    """Many runs of one route, sampled at common stamps; row 0 is the start, the last the end.

    Attributes
    ----------
    stamps
        (T,) s.
    poses
        (n, T, 3) true poses, m, m, rad; headings unwrapped.
    encoder_m
        (n, T, 2) encoder positions, right and left, accumulated metres.
    ground_m
        (n, T, 2) rolling of the wheels on the ground, accumulated metres.
    """

    stamps: Array
    poses: Array
    encoder_m: Array
    ground_m: Array

    @property
    def end_poses(self) -> Array:
        """(n, 3) true poses at the end; headings unwrapped."""
        return self.poses[:, -1]


def run_batch(
    robot: DifferentialDrive,
    route: OpenLoop,
    n_runs: int,
    rng: np.random.Generator,
    *,
    start: ArrayLike = (0.0, 0.0, 0.0),
    sample_s: float = 0.05,
) -> BatchRuns:
    """Drive a route many times with independent slip, at 300 ticks a second.

    Parameters
    ----------
    robot
        The true robot. Slip events, which depend on when a wheel turns back, are the simulator's
        alone.
    start
        (3,) common start pose.
    sample_s
        Time between samples, a multiple of the tick; the end is sampled in any case.

    Raises
    ------
    InputError
        If the robot has slip events, or a law of slip of its own.
    """
    require(
        robot.unmodelled_slip == 0.0,
        "slip events are the simulator's alone; set robot.unmodelled_slip=0",
    )
    require(
        type(robot).start_slip is DifferentialDrive.start_slip,
        f"a batch knows DifferentialDrive's law of slip alone, and {type(robot).__name__} has its "
        "own; simulate its runs one by one",
    )
    require(n_runs >= 1, f"n_runs must be at least 1, got {n_runs}")
    commands_m = wheel_commands(robot, route)
    n_ticks = len(commands_m)
    every = max(1, round(sample_s / TICK_S))
    sampled = np.append(np.arange(0, n_ticks, every), n_ticks)
    poses = np.empty((n_runs, len(sampled), 3))
    encoder_m, ground_m = np.empty((2, n_runs, len(sampled), 2))
    law = _Law(
        (robot.kr, robot.bias_right),
        (robot.kl, robot.bias_left),
        (robot.forward_slip_m, robot.forward_slip_length_m),
        TICK_S / SLIP_TIME_CONSTANT_S,
        robot.track_m,
    )
    of_both = rng.spawn(1)[0] if robot.forward_slip_m else None
    block = max(1, _BLOCK_NORMALS // (2 * n_ticks))
    for first in range(0, n_runs, block):
        rows = slice(first, min(first + block, n_runs))
        n_rows = rows.stop - rows.start
        normals = rng.standard_normal((n_rows, n_ticks, 2))
        # the first of each run is for the share at its start
        shared = np.zeros((n_rows, 1))
        if of_both is not None:
            shared = of_both.standard_normal((n_rows, 1 + n_ticks))
        samples = poses[rows], encoder_m[rows], ground_m[rows]
        _roll(commands_m, normals, shared, law, np.array(start, dtype=np.float64), every, samples)
    return BatchRuns(sampled * TICK_S, poses, robot.encoder_reading(encoder_m), ground_m)


def wheel_commands(robot: DifferentialDrive, route: OpenLoop) -> Array:
    """Commanded ground travel (N, 2) of the wheels, right and left, tick by tick, m."""
    return robot.wheel_speeds(*route.profile(robot).T) * TICK_S


class _Law(NamedTuple):
    """Slip of the right wheel, the left one (k, bias) and of both (q, length); lag; track, m."""

    right: tuple[float, float]
    left: tuple[float, float]
    both: tuple[float, float]
    lag_share: float
    track_m: float


@njit()
def _roll(
    commands_m: Array,
    normals: Array,
    shared: Array,
    law: _Law,
    start: Array,
    every: int,
    samples: tuple[Array, Array, Array],
) -> None:
    """The loop of `WheelSlip` and `KinematicBody` over all runs, sampled into the last three."""
    n_ticks = len(commands_m)
    poses, encoder_m, ground_m = samples
    laws, (q_m, length_m) = (law.right, law.left), law.both
    for run in range(len(normals)):
        x, y, heading = start
        lag, encoder, ground = np.zeros(2), np.zeros(2), np.zeros(2)
        rolling = np.empty(2)
        both, share = 0.0, 0.0
        if length_m > 0.0:
            share = np.sqrt(q_m / (2.0 * length_m)) * shared[run, 0]
        poses[run, 0] = start
        encoder_m[run, 0] = 0.0
        ground_m[run, 0] = 0.0
        row = 1
        for tick in range(n_ticks):
            for i in range(2):
                rolling[i] = commands_m[tick, i] - lag[i]
            if q_m > 0.0:
                travel_m = (abs(rolling[0]) + abs(rolling[1])) / 2.0
                both, share = _slipped_together(
                    travel_m, share, q_m, length_m, shared[run, 1 + tick]
                )
            for i in range(2):
                read_m, lag[i] = _slipped(
                    rolling[i], lag[i], laws[i], normals[run, tick, i], both, law.lag_share
                )
                encoder[i] += read_m
                ground[i] += rolling[i]
            half = (rolling[0] - rolling[1]) / law.track_m / 2.0
            # a tick turns by milliradians, where this series is exact to the last bit
            chord = (rolling[0] + rolling[1]) / 2.0 * (1.0 - half**2 / 6.0 + half**4 / 120.0)
            x += chord * np.cos(heading + half)
            y += chord * np.sin(heading + half)
            heading += 2.0 * half
            if (tick + 1) % every == 0 or tick + 1 == n_ticks:
                poses[run, row, 0], poses[run, row, 1], poses[run, row, 2] = x, y, heading
                for i in range(2):
                    encoder_m[run, row, i] = encoder[i]
                    ground_m[run, row, i] = ground[i]
                row += 1
