"""A robot that slows down and waits for the people in its way."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sim.arrays import Array
from sim.people.walk import Crowd
from sim.robot.base import TICK_S, Robot
from sim.robot.collisions import half_footprint_m
from sim.routes.feedback import CONTROL_TICKS
from sim.sensors.base import Reading

_KEPT_OFF_M, _BESIDE_M = 0.25, 0.03  # from people ahead, who need room to step aside; beside
_BRAKING_SHARE = 0.4  # of the wheels' acceleration
_LONGEST_WAIT_S = 120.0
_PATIENCE_S, _SQUEEZING_S = 10.0, 6.0  # of a robot that waits; how long it then squeezes past
_STRAIGHT_RADPS = 0.2  # turning slower than that, it goes straight on


class GivingWay:
    """Driver that follows another one's commands, slower where people are near.

    Its clock runs slower as the robot does, so that the way stays that of the commands.

    Parameters
    ----------
    driver
        The one to follow.
    crowd, number
        The people, and the robot's number among those that they see.
    true_pose
        Gives the robot's true pose (3,).
    """

    def __init__(
        self, driver: Any, crowd: Crowd, number: int, robot: Robot, true_pose: Callable[[], Array]
    ) -> None:
        self._driver, self._crowd, self._number, self._pose = driver, crowd, number, true_pose
        self._brake_mps2 = _BRAKING_SHARE * robot.max_acceleration_mps2
        self._clock, self._tick, self._waited_s = 0.0, -1, 0.0
        self._squeezes_s = 0.0  # for so long still
        self._half_width_m = float(half_footprint_m(robot)[1])
        self._pace, self._share = 1.0, 1.0  # of the commands' speed: now, and allowed
        self._wanted: Array | None = np.zeros(2)

    def command(self, tick: int, pose: Array) -> Array | None:
        """Velocity (2,) of the tick; None when the route is done. The pose is the believed one."""
        if math.floor(self._clock) > self._tick:
            self._tick = math.floor(self._clock)
            self._wanted = self._driver.command(self._tick, pose)
        if self._wanted is None:
            return None
        v_mps = float(self._wanted[0])
        change = self._brake_mps2 * TICK_S / max(abs(v_mps), 0.05)
        if tick % CONTROL_TICKS == 0:
            self._share = self._allowed(v_mps, float(self._wanted[1]))
        self._pace += min(max(self._share - self._pace, -change), change)
        self._clock += self._pace
        self._waited_s = 0.0 if self._pace > 0.05 else self._waited_s + TICK_S
        self._squeezes_s -= TICK_S
        if self._waited_s > _PATIENCE_S:
            self._squeezes_s = _SQUEEZING_S
        return self._pace * self._wanted

    def _allowed(self, v_mps: float, turn_radps: float) -> float:
        """Share of the speed at which the robot can still stop short of everybody ahead of it.

        A robot that has waited long leaves people ahead no room to step aside, and goes straight
        past those who stand beside its way.
        """
        pose = self._pose()
        gaps, offsets = self._crowd.gaps_m(self._number, pose)
        towards = math.copysign(1.0, v_mps) * (
            math.cos(pose[2]) * offsets[:, 0] + math.sin(pose[2]) * offsets[:, 1]
        )
        nearing = np.maximum(towards / np.hypot(*offsets.T), 0.0)  # share of the speed
        speeds = nearing * abs(v_mps)
        kept_off_m, counts = _KEPT_OFF_M, speeds > 0.0
        if self._squeezes_s > 0.0:
            kept_off_m = 0.0
            if abs(turn_radps) < _STRAIGHT_RADPS:
                off = math.cos(pose[2]) * offsets[:, 1] - math.sin(pose[2]) * offsets[:, 0]
                beside_m = np.abs(off) - self._half_width_m - self._crowd.people.radius_m
                counts &= beside_m <= _BESIDE_M
        room_m = np.maximum(gaps - (_BESIDE_M + kept_off_m) * nearing, 0.0)
        most = np.sqrt(2.0 * self._brake_mps2 * room_m)
        return float(np.min(most[counts] / speeds[counts], initial=1.0))

    @property
    def trouble(self) -> str | None:
        """What the driver says, `collision` with a person, or `incomplete` for one who stays."""
        if self._crowd.touches(self._number, self._pose()):
            return "collision"
        waits = self._waited_s > _LONGEST_WAIT_S
        trouble: str | None = self._driver.trouble or ("incomplete" if waits else None)
        return trouble

    def see(self, pose: Array, readings: Mapping[str, Reading]) -> None:
        """Let the driver see."""
        if hasattr(self._driver, "see"):
            self._driver.see(pose, readings)
