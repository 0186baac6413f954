"""Sensors at work in the simulator: when each fires, and the noise that is its own."""

from __future__ import annotations

import math
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sim.arrays import Array
from sim.errors import InputError, blaming, require
from sim.robot.base import TICKS_PER_S
from sim.sensors.base import Reading, Sensor, Sensors, View

# These draw their noise from one generator, in this order; every other sensor has its own
_SHARE_NOISE = ("laser", "stereo", "lidar3d")


def in_noise_order(sensors: Sensors) -> dict[str, Sensor]:
    """The sensors that share their noise, in its order, and then the others."""
    names = [name for name in _SHARE_NOISE if name in sensors]
    return {name: sensors[name] for name in dict.fromkeys([*names, *sensors])}


def periods(sensors: Sensors) -> dict[str, int]:
    """Ticks between firings of each sensor.

    Raises
    ------
    InputError
        If a rate does not divide the simulation's, or no sensor fires.
    """
    found = {}
    for name, sensor in in_noise_order(sensors).items():
        rate = sensor.rate_hz
        if rate is None:
            continue
        number = isinstance(rate, (int, float)) and 0.0 < rate < math.inf
        require(number, f"sensors.{name}.rate_hz must be a positive number or null, got {rate!r}")
        ticks = TICKS_PER_S / rate
        require(
            abs(ticks - round(ticks)) <= 1e-6 and round(ticks) >= 1,
            f"sensors.{name}.rate_hz={rate:g} does not divide the simulation's "
            f"{TICKS_PER_S} Hz; choose one that does, such as 10, 20, 50, 75 or 100",
        )
        found[name] = round(ticks)
    require(found, "no sensor fires; set sensors.encoder.rate_hz or add a sensor")
    return found


def probes(
    sensors: Sensors,
    rng: np.random.Generator,
    first: View,
    others: Callable[[], Mapping[int, Array]],
) -> dict[str, Firing]:
    """Every sensor at work, from its first view on; `others` gives the poses of other robots.

    A sensor whose beams are measured one after another keeps the poses since the first of them.
    """
    found = {}
    for name, sensor in in_noise_order(sensors).items():
        own = rng if name in _SHARE_NOISE else _stream_of(rng, name)
        found[name] = Firing(name, sensor, own, first, others)
    return found


def _stream_of(rng: np.random.Generator, name: str) -> np.random.Generator:
    """Generator of a sensor's own: what other sensors there are does not change its noise."""
    seed: Any = rng.bit_generator.seed_seq
    key = (*seed.spawn_key, zlib.crc32(name.encode()))
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=key))


class Firing:
    """A sensor at work, and what it saw last."""

    def __init__(
        self,
        name: str,
        sensor: Sensor,
        rng: np.random.Generator,
        first: View,
        others: Callable[[], Mapping[int, Array]],
    ) -> None:
        self._where, self._schema, self._last = f"sensors.{name}", sensor.schema, first
        self._others = others
        self._past = deque([(first.stamp, first.pose)], maxlen=2 + math.ceil(
            TICKS_PER_S * -float(np.min(getattr(sensor, "beam_offsets_s", 0.0)))
        ))  # fmt: skip
        with blaming(self._where):
            self._probe = sensor.start(rng)
            if hasattr(self._probe, "begin"):
                self._probe.begin(first)
        require(callable(self._probe), f"{self._where}: start must return a function of the view")

    @property
    def sweeps(self) -> bool:
        """Whether its readings take time."""
        return self._past.maxlen != 2

    def follow(self, stamp: float, pose: Array) -> None:
        """Remember the robot's pose (3,) at a tick, s."""
        self._past.append((stamp, pose))

    def __call__(self, stamp: float, pose: Array) -> Reading | None:
        """Reading at a time, s, and the robot's pose (3,); None if it gives none."""
        last, others = self._last, self._others()
        past = None
        if self.sweeps:
            past = np.array([time for time, _ in self._past]), np.array([p for _, p in self._past])
        self._last = View(stamp, pose, last.world, last.rays, last.stamp, last.pose, others, past)
        with blaming(self._where):
            reading = self._probe(self._last)
        if reading is None:
            return None
        if not (isinstance(reading, Mapping) and set(reading) == set(self._schema)):
            raise InputError(  # the text of an array takes longer than the reading
                f"{self._where}: a reading must have the fields {[*self._schema]}, "
                f"got {reading!r:.60}"
            )
        return {
            key: field.converted_copy(reading[key], f"{self._where}.{key}")
            for key, field in self._schema.items()
        }
