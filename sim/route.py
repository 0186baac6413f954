"""Where the robot is told to go: open-loop commands.

A velocity command is (v, omega): m/s forward and rad/s counter-clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.errors import InputError
from sim.robot import DifferentialDrive, arc_increment

Array = NDArray[np.float64]
Segment = tuple[float, float, float]

TICK_S = 1.0 / 300.0


@dataclass(frozen=True)
class OpenLoop:
    """Commands given by the clock, blind to where the robot is (puzzlebot2024, table 1).

    A segment (v, omega, T) promises the distance v T and the angle omega T, and keeps that
    promise exactly: both velocities ramp up together from the segment's start and down
    from its end, so the path is the arc of curvature omega / v all along, and what the first
    ramp loses the second one gives back. The faster wheel ramps at the robot's acceleration. A
    segment too short to reach its velocity becomes a triangle of the same area. The robot rests
    between two segments, unless their velocities are the same.

    Attributes
    ----------
    segments
        (v m/s, omega rad/s, T s) each; both velocities zero for a pause.
    rest_s
        Rest after the last segment, s.
    """

    segments: tuple[Segment, ...]
    rest_s: float = 0.2

    def __post_init__(self) -> None:
        if not math.isfinite(self.rest_s) or self.rest_s < 0.0:
            raise InputError(f"route.rest_s must be zero or positive, got {self.rest_s}")
        object.__setattr__(self, "segments", tuple(_merged(self.segments)))
        if not self.segments:
            raise InputError("route.segments is empty; give at least one [v, omega, duration]")

    def profile(self, robot: DifferentialDrive, dt_s: float = TICK_S) -> Array:
        """Body velocities (N, 2), m/s and rad/s: means over ticks of `dt_s`, rest included.

        Being means, they add up to the promised distance and angle exactly.
        """
        starts_s, end_s = self._schedule(robot)
        n_ticks = math.ceil((end_s + self.rest_s) / dt_s - 1e-9)
        edges_s = dt_s * np.arange(n_ticks + 1, dtype=np.float64)
        velocity = np.zeros((n_ticks, 2))
        for start_s, segment in zip(starts_s, self.segments, strict=True):
            first = int(start_s / dt_s)
            held_s = _held(edges_s[first:] - start_s, segment, robot)
            velocity[first:] += np.diff(held_s)[:, None] / dt_s * np.array(segment[:2])
        return velocity

    def starts_s(self, robot: DifferentialDrive) -> Array:
        """Time (S,) at which each segment begins, s."""
        return np.array(self._schedule(robot)[0])

    def ideal_poses(
        self, robot: DifferentialDrive, dt_s: float = TICK_S, start: ArrayLike = (0.0, 0.0, 0.0)
    ) -> Array:
        """Poses (N + 1, 3) that the commands promise at the tick edges; headings unwrapped."""
        velocity = self.profile(robot, dt_s)
        # track 2: wheel travels are then v + omega and v - omega
        travel = dt_s * np.stack([velocity[:, 0] + velocity[:, 1], velocity[:, 0] - velocity[:, 1]])
        return chain(arc_increment(travel.T, 2.0), start)

    def ideal_end(self, start: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Pose (3,) that the commands promise at the end; heading unwrapped."""
        v, omega, duration_s = np.array(self.segments).T
        travel = np.stack([v + omega, v - omega], axis=1) * duration_s[:, None]
        last: Array = chain(arc_increment(travel, 2.0), start)[-1]
        return last

    def _schedule(self, robot: DifferentialDrive) -> tuple[list[float], float]:
        """Start of each segment and end of the last one, s."""
        starts_s, now_s = [], 0.0
        for segment in self.segments:
            starts_s.append(now_s)
            plateau_s, ramp_s, _ = _trapezoid(segment, robot)
            now_s += plateau_s + 2.0 * ramp_s
        return starts_s, now_s


def chain(increments: ArrayLike, start: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Poses (N + 1, 3) from relative poses (N, 3) and a start pose; headings unwrapped."""
    steps, first = np.asarray(increments, float), np.asarray(start, float)
    heading = first[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    moves = np.stack([cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1]])
    poses = np.empty((len(steps) + 1, 3))
    poses[0, :2], poses[1:, :2] = first[:2], first[:2] + np.cumsum(moves.T, axis=0)
    poses[:, 2] = heading
    return poses


def _merged(segments: Iterable[Iterable[float]]) -> list[Segment]:
    """Check the segments; join neighbours of the same velocity."""
    merged: list[Segment] = []
    for i, segment in enumerate(segments):
        where = f"route.segments[{i}]"
        try:
            v, omega, duration_s = (float(value) for value in segment)
        except (TypeError, ValueError):
            raise InputError(f"{where} must be [v, omega, duration], got {segment!r}") from None
        if not all(map(math.isfinite, (v, omega, duration_s))) or duration_s <= 0.0:
            raise InputError(f"{where} must be finite with a positive duration, got {segment!r}")
        if merged and merged[-1][:2] == (v, omega):
            duration_s += merged.pop()[2]
        merged.append((v, omega, duration_s))
    return merged


def _trapezoid(segment: Segment, robot: DifferentialDrive) -> tuple[float, float, float]:
    """Plateau and ramp times, s, and the share of the velocity that the plateau reaches."""
    v, omega, duration_s = segment
    fastest_mps = abs(v) + abs(omega) * robot.track_m / 2.0
    ramp_s = fastest_mps / robot.max_acceleration_mps2
    if ramp_s <= duration_s:
        return duration_s - ramp_s, ramp_s, 1.0
    # peak share p reached after p ramp_s: the area p^2 ramp_s must be the duration
    share = math.sqrt(duration_s / ramp_s)
    return 0.0, share * ramp_s, share


def _held(time_s: Array, segment: Segment, robot: DifferentialDrive) -> Array:
    """Integral of the velocity's share from the segment's start to `time_s`, s."""
    plateau_s, ramp_s, share = _trapezoid(segment, robot)
    if ramp_s == 0.0:
        return np.clip(time_s, 0.0, plateau_s)
    up = np.clip(time_s, 0.0, ramp_s)
    level = np.clip(time_s - ramp_s, 0.0, plateau_s)
    down = np.clip(time_s - ramp_s - plateau_s, 0.0, ramp_s)
    return share * (up**2 / (2.0 * ramp_s) + level + down - down**2 / (2.0 * ramp_s))


TABLE_1: dict[str, OpenLoop] = {
    "linear_1": OpenLoop(((0.5, 0.0, 2.0),)),
    "linear_2": OpenLoop(((0.5, 0.0, 5.0),)),
    "linear_3": OpenLoop(((0.7, 0.0, 2.0),)),
    "linear_4": OpenLoop(((0.3, 0.0, 2.0),)),
    "angular_1": OpenLoop(((0.0, 0.5, 3.0),)),
    "angular_2": OpenLoop(((0.0, 0.5, 5.0),)),
    "angular_3": OpenLoop(((0.0, 0.5, 10.0),)),
    "angular_4": OpenLoop(((0.0, 0.8, 3.0),)),
    "angular_5": OpenLoop(((0.0, 0.2, 5.0),)),
}
"""The nine manoeuvres of puzzlebot2024, table 1.

The report drops angular case 3 because its heading was wrapped; unwrapped it is as good as the
others, so it is kept.
"""
