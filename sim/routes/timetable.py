"""A route by the clock and the map: where to be when, as a trajectory of a log says."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sim import se2
from sim.arrays import Array
from sim.errors import require
from sim.formats.rosbag import Track
from sim.formats.trajectory import check_track
from sim.formats.tum import read_tum
from sim.options import Positive, options
from sim.robot.base import TICK_S, Robot
from sim.routes.feedback import CONTROL_TICKS
from sim.worlds.world import World

_GAIN_PER_S = 2.0  # an error of place or heading falls by a factor of e in half a second
_AHEAD_M = 0.3  # where the robot heads back to its way


@options("route")
class Timetable:
    """Be at each pose of a trajectory at its time, led by the true pose.

    Between two poses the robot drives an arc. Slip moves it off its way, and it comes back as if
    someone drove it, so that only its odometry errs, as on a `Tour`.

    """

    path: str | None
    """A TUM file: stamps, s, of which the first is the start, and poses of base_link in map."""
    tolerance_m: Positive = 1.0
    """Distance from the place of the moment at which the robot counts as off its route."""

    @cached_property
    def way(self) -> tuple[Array, Array]:
        """Stamps (T,) s, and poses (T, 3).

        Raises
        ------
        InputError
            If the file cannot be read, or holds fewer than two poses.
        """
        require(
            isinstance(self.path, str) and self.path,
            "route.path must name a .tum file, such as one of `estima twin`",
        )
        path = Path(str(self.path))
        stamps, poses = read_tum(path)
        check_track(Track(stamps, poses, np.zeros((len(poses), 3, 3))), path)
        require(len(stamps) >= 2, f"{path}: a route needs two poses or more")
        return stamps, poses

    def start(self, world: World, robot: Robot) -> tuple[Array, "Follower"]:
        """First pose (3,), and the driver."""
        return Drive(*self.way, self.tolerance_m).start(world, robot)

    def about_s(self, world: World, robot: Robot) -> float:
        """How long the drive takes, s."""
        stamps, _ = self.way
        return float(stamps[-1] - stamps[0])


@dataclass(frozen=True)
class Drive:
    """A Timetable at hand: stamps (T,) s and poses (T, 3)."""

    stamps: Array
    poses: Array
    tolerance_m: float = 1.0

    def start(self, world: World, robot: Robot) -> tuple[Array, "Follower"]:
        """First pose (3,), and the driver."""
        stamps = self.stamps - self.stamps[0]
        return self.poses[0].copy(), Follower(stamps, self.poses, self.tolerance_m)


class Follower:
    """Driver of a Timetable, 50 times a second.

    The velocities are those of the trajectory, and what brings the robot back to it: a share of
    what it lags behind, and a turn towards a point ahead on the tangent.
    """

    def __init__(self, stamps: Array, poses: Array, tolerance_m: float) -> None:
        times = np.arange(0.0, stamps[-1], CONTROL_TICKS * TICK_S)
        after = np.clip(np.searchsorted(stamps, times, side="right"), 1, len(stamps) - 1)
        twists = se2.log(se2.between(poses[after - 1], poses[after]))
        lasts_s = (stamps[after] - stamps[after - 1])[:, None]
        share = (times - stamps[after - 1])[:, None] / lasts_s
        self._poses = se2.compose(poses[after - 1], se2.exp(share * twists))
        self._velocity = twists[:, [0, 2]] / lasts_s
        self._tolerance_m = tolerance_m
        self._command, self._off_m = np.zeros(2), 0.0

    def command(self, tick: int, pose: Array) -> Array | None:
        """Velocity (2,) of the tick; None at the end."""
        row, between = divmod(tick, CONTROL_TICKS)
        if row >= len(self._poses):
            return None
        if between == 0:
            ahead, left, turn = se2.between(pose, self._poses[row])
            self._off_m = math.hypot(ahead, left)
            v, omega = self._velocity[row]
            back = math.copysign(math.atan(left / _AHEAD_M), v * left) if v else 0.0
            self._command = np.array(
                [v * math.cos(turn) + _GAIN_PER_S * ahead, omega + _GAIN_PER_S * (turn + back)]
            )
        return self._command

    @property
    def trouble(self) -> str | None:
        """`off_route` if the robot is not where it should be, else None."""
        return "off_route" if self._off_m > self._tolerance_m else None
