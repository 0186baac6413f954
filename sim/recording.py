"""Recording: what a run's sensors measured, and the truth beside it; Frame: one instant of it.

A recording is saved as an `.npz` without pickles, with a checksum over all it holds; what does
not match its checksum is never read back.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sim.arrays import Array, Ints, Values
from sim.errors import InputError, require, required
from sim.files import write_whole
from sim.log import CommandLog, Log, WheelLog, detach, log_of_readings
from sim.npz import UNREADABLE, read_arrays
from sim.options import build
from sim.recording_check import check_recording
from sim.robot.drive import RobotGeometry
from sim.sensors.base import (
    Reading,
    Sensor,
    Sensors,
    schema_from_meta,
    sensor_of,
    sensor_settings,
    sensors_from_meta,
    split_schema,
)
from sim.worlds.world import World

__all__ = [
    "CommandLog",
    "Frame",
    "Log",
    "Recording",
    "Truth",
    "WheelLog",
    "arrays_of",
    "describe",
    "digest_of",
    "load",
    "load_robots",
    "log_of_readings",
    "naming_file",
    "recording_from_arrays",
    "save",
    "write_arrays",
]  # fmt: skip
FORMAT_VERSION = 2
REMEDY = "delete it and record again"
SEVERAL = "it holds a team; run all of its robots by study=teams, or take one of them by its number"
S = TypeVar("S")


@dataclass(frozen=True, repr=False)
class Truth:
    """What no Frame shows.

    Attributes
    ----------
    stamps, poses
        (T,) s and (T, 3) m, m, rad: base_link in map.
    wheel_travel_m
        (T, 2) accumulated rolling of the right and left wheel on the ground, or (0, 2).
    readings
        By sensor, what its schema marks as truth, row by row as in its log.
    world
        The map, or None.
    people
        (T, n, 3) m, m, rad in map: people who walk about; None without any.
    """

    stamps: Array
    poses: Array
    wheel_travel_m: Array = field(default_factory=lambda: np.zeros((0, 2)))
    readings: Mapping[str, Mapping[str, Values]] = field(default_factory=dict)
    world: World | None = None
    people: Array | None = None

    def __repr__(self) -> str:
        return f"Truth({len(self.stamps)} poses, {'a' if self.world else 'no'} map)"


@dataclass(frozen=True, repr=False)
class Frame:
    """One instant at which a sensor fires, without the truth.

    Its arrays are read-only and hold nothing else: neither readings to come nor what the next
    estimator sees.

    Attributes
    ----------
    stamp
        Time, s.
    duration_s
        Time since the previous Frame, s; 0 at the first.
    wheel_increments_m
        (2,) encoder travel of the right and left wheel since the previous Frame, m.
    readings
        By sensor, the reading that it took at this instant: arrays by field.
    robot
        Number of the robot in its team; 0 for one alone.
    """

    stamp: float
    duration_s: float
    wheel_increments_m: Array
    readings: Mapping[str, Reading] = field(default_factory=dict)
    robot: int = 0

    def __repr__(self) -> str:
        return f"Frame({self.stamp:.6g} s: {', '.join(['wheels', *self.readings])})"


@dataclass(frozen=True, repr=False)
class Recording:
    """A run: each sensor's data with its own stamps, the commands, the truth, where it came from.

    Attributes
    ----------
    frame_stamps
        (F,) s, increasing: the instants that estimators see.
    wheels, commands
        The wheels' log, and the commands' if they are known.
    robot
        Nominal wheel radius and track.
    sensors, logs
        By name, each sensor's geometry and nominal noise, and its readings.
    truth
        What Frames never show; None for a log without reference.
    config
        The resolved configuration (plain JSON) the recording came from.
    status
        `ok`, or what went wrong (`collision`, `tipped`, `off_route`, `incomplete`) and when.
    """

    frame_stamps: Array
    wheels: WheelLog
    robot: RobotGeometry
    sensors: Sensors = field(default_factory=dict)
    logs: Mapping[str, Log] = field(default_factory=dict)
    truth: Truth | None = None
    commands: CommandLog | None = None
    config: dict[str, Any] = field(default_factory=dict)
    status: str = "ok"

    def __post_init__(self) -> None:
        for array in arrays_of(self).values():
            array.setflags(write=False)

    def __repr__(self) -> str:
        seen = ", ".join(f"{name} x {len(log.stamps)}" for name, log in self.logs.items())
        return (
            f"Recording({self.duration_s:.6g} s, {len(self.frame_stamps)} Frames; "
            f"{seen or 'wheels alone'}; {self.truth or 'no truth'}; {self.status})"
        )

    @property
    def duration_s(self) -> float:
        """Time from the first Frame to the last, s."""
        return float(self.frame_stamps[-1] - self.frame_stamps[0])

    @property
    def world(self) -> World | None:
        """The map, or None; part of the truth."""
        return self.truth.world if self.truth else None

    # Never None: an InputError says what is missing and how to get it.

    @property
    def known_truth(self) -> Truth:
        """The truth; InputError if there is none."""
        return required(self.truth, "this recording has no truth to compare with")

    @property
    def known_world(self) -> World:
        """The map; InputError if there is none."""
        return required(self.world, "this recording has no map; use a simulated one")

    def log(self, name: str) -> Log:
        """Log of a sensor; InputError if there is none."""
        known = ", ".join(self.logs) or "none"
        complaint = f"this recording has no readings of a sensor {name} (there is {known})"
        return required(self.logs.get(name), complaint)

    def sensor(self, name: str, kind: type[S]) -> S:
        """Sensor of a name and class; InputError if there is none."""
        return sensor_of(self.sensors, name, kind)

    def with_log(self, name: str, log: Log, sensor: Sensor | None = None) -> Recording:
        """Return the recording with another log of a sensor, or with one more sensor."""
        sensors = self.sensors if sensor is None else {**self.sensors, name: sensor}
        return dataclasses.replace(self, sensors=sensors, logs={**self.logs, name: log})

    def without(self, name: str) -> Recording:
        """Return the recording without a sensor, its log, and the truth of its readings."""
        truth = self.truth
        if truth is not None:
            truth = dataclasses.replace(truth, readings=_others(truth.readings, name))
        return dataclasses.replace(
            self, sensors=_others(self.sensors, name), logs=_others(self.logs, name), truth=truth
        )

    def with_wheel_radius(self, believed_m: float) -> Recording:
        """Return the recording as read by wheels of this radius: travel in proportion to it."""
        nominal_m = self.robot.wheel_radius_m
        if believed_m == nominal_m:
            return self
        travel_m = self.wheels.position_m * (believed_m / nominal_m)
        robot = dataclasses.replace(self.robot, wheel_radius_m=believed_m)
        return dataclasses.replace(self, wheels=WheelLog(self.wheels.stamps, travel_m), robot=robot)

    def frames(self, robot: int = 0) -> Iterator[Frame]:
        """Walk through the Frames in order, as those of the robot of this number.

        Wheel positions are interpolated at the Frame stamps; in simulation the encoders are read
        at every Frame, so the interpolation is exact there.
        """
        stamps = self.frame_stamps
        position = self.wheels.at(stamps)
        increments = np.diff(position, axis=0, prepend=position[:1])
        durations = np.diff(stamps, prepend=stamps[:1])
        shown = {name: _rows_at(stamps, log).tolist() for name, log in self.logs.items()}
        for i, stamp in enumerate(stamps.tolist()):
            yield Frame(
                stamp=stamp,
                duration_s=float(durations[i]),
                wheel_increments_m=detach(increments[i]),
                readings={
                    name: self.logs[name].reading(rows[i])
                    for name, rows in shown.items()
                    if rows[i] >= 0
                },
                robot=robot,
            )

    def truth_at(self, stamps: Array, longest_gap_s: float = math.inf) -> Array:
        """True poses (N, 3) at stamps (N,), interpolated; NaN outside the truth's time span.

        Parameters
        ----------
        longest_gap_s
            NaN, too, between true poses that are farther apart in time than this.

        Raises
        ------
        InputError
            If the recording has no truth.
        """
        poses, times = self.known_truth.poses, self.known_truth.stamps
        columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
        x, y, angle = (np.interp(stamps, times, c, left=np.nan, right=np.nan) for c in columns)
        found = np.stack([x, y, np.arctan2(np.sin(angle), np.cos(angle))], axis=1)
        after = np.clip(np.searchsorted(times, stamps), 1, max(len(times) - 1, 1))
        if len(times) > 1:
            wide = times[after] - times[after - 1] > longest_gap_s
            exact = (times[after] == stamps) | (times[after - 1] == stamps)
            found[wide & ~exact] = np.nan
        return found

    @cached_property
    def checksum(self) -> str:
        """SHA-256 over all the recording holds, as hex."""
        return digest_of(arrays_of(self), describe(self))

    def cut(self, n_frames: int) -> Recording:
        """The same recording, ended after `n_frames` Frames (the logs keep their tails)."""
        return dataclasses.replace(self, frame_stamps=self.frame_stamps[:n_frames].copy())


def save(recording: Recording, path: Path, *, durable: bool = True) -> str:
    """Write a recording; return its checksum.

    The file appears whole or not at all: it is written beside its place and then moved there.

    Parameters
    ----------
    durable
        As for `sim.files.write_whole`.

    Raises
    ------
    InputError
        If it cannot be written (full disk, no permission).
    """
    return write_arrays(path, arrays_of(recording), describe(recording), durable=durable)


def write_arrays(
    path: Path, arrays: dict[str, Values], meta: dict[str, Any], *, durable: bool = True
) -> str:
    """Write arrays and plain values that describe them, whole; return their checksum."""
    checksum = digest_of(arrays, meta)
    meta_bytes = np.frombuffer(json.dumps({**meta, "checksum": checksum}).encode(), np.uint8)
    with write_whole(path, durable=durable) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, meta=meta_bytes, **arrays)
    return checksum


def load(path: Path) -> Recording:
    """Read a recording and check it against its checksum.

    Raises
    ------
    InputError
        If the file is missing, truncated, altered, or not a recording of one robot.
    """
    robots = load_robots(path)
    require(len(robots) == 1, f"{path}: {SEVERAL}, from 0 to {len(robots) - 1}")
    return robots[0]


def load_robots(path: Path) -> tuple[Recording, ...]:
    """Read a file of one robot or of a team, as `load`."""
    require(path.is_file(), f"{path}: no such recording; make one with `estima record`")
    require(
        path.suffix == ".npz" or zipfile.is_zipfile(path),
        f"{path}: not a recording; make one of a log with `estima convert`",
    )
    with naming_file(path):
        stored, meta = checked_arrays(path)
        if "team" not in meta:
            return (recording_from_arrays(stored, meta),)
        parts = meta["team"]
        require(isinstance(parts, list), "it does not say what its robots are")
        own = [_below(stored, str(number)) for number in range(len(parts))]
        others = len(stored) - sum(map(len, own))
        require(others == 0, f"{others} arrays belong to none of its robots")
        return tuple(map(recording_from_arrays, own, parts))


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Turn errors in a file's content into one line that names the file and the remedy."""
    try:
        yield
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]} is missing; {REMEDY}") from error
    except (InputError, *UNREADABLE) as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}; {REMEDY}") from error


def _below(stored: Mapping[str, Values], prefix: str) -> dict[str, Values]:
    """Arrays whose names begin with a prefix and a dot, without it."""
    begin = f"{prefix}."
    return {k.removeprefix(begin): v for k, v in stored.items() if k.startswith(begin)}


def checked_arrays(path: Path) -> tuple[dict[str, Values], dict[str, Any]]:
    """Arrays and plain values of a file, which match its checksum."""
    stored = read_arrays(path)
    require("meta" in stored, "not a recording")
    meta = json.loads(stored.pop("meta").tobytes())
    require(isinstance(meta, dict), "not a recording")
    checksum, version = meta.pop("checksum", None), meta.get("format")
    require(
        version == FORMAT_VERSION,
        f"recording format {version}, this version reads {FORMAT_VERSION}",
    )
    require(digest_of(stored, meta) == checksum, "the data do not match their checksum")
    return stored, meta


def _others(parts: Mapping[str, S], name: str) -> dict[str, S]:
    """All but the part of a name."""
    return {key: part for key, part in parts.items() if key != name}


def _rows_at(frame_stamps: Array, log: Log) -> Ints:
    """Row of a sensor's log that each Frame shows, -1 for none; the last of equal stamps wins."""
    rows = np.searchsorted(log.stamps, frame_stamps, side="right") - 1
    shown = np.append(log.stamps, np.nan)[rows] == frame_stamps  # row -1 is the NaN
    return np.where(shown, rows, -1)


def arrays_of(recording: Recording) -> dict[str, Values]:
    """Every array of a recording under the name it is saved by."""
    arrays = {"frame_stamps": recording.frame_stamps}
    parts = {
        "wheels": recording.wheels,
        "commands": recording.commands,
        "truth": recording.truth,
        "world": recording.world,
        **{f"logs.{name}": log for name, log in recording.logs.items()},
    }
    for name, part in parts.items():
        for field_name, value in vars(part).items() if part is not None else ():
            if isinstance(value, np.ndarray):
                arrays[f"{name}.{field_name}"] = value
    for name, log in recording.logs.items():
        arrays |= {f"logs.{name}.{key}": values for key, values in log.values.items()}
    if recording.truth is not None:
        for name, hidden in recording.truth.readings.items():
            arrays |= {f"truth.readings.{name}.{key}": values for key, values in hidden.items()}
    if recording.world is not None:
        arrays |= {f"world.places.{k}": v for k, v in recording.world.places.items()}
    return arrays


def describe(recording: Recording) -> dict[str, Any]:
    """What a recording holds besides arrays, as plain values."""
    robot = build(RobotGeometry, dataclasses.asdict(recording.robot), "robot")
    truth = recording.truth.readings if recording.truth else {}
    schemas = {
        name: {k: f for k, f in recording.sensors[name].schema.items() if k in truth.get(name, {})}
        | dict(log.schema)
        for name, log in recording.logs.items()
    }
    return {
        "format": FORMAT_VERSION,
        "status": recording.status,
        "robot": dataclasses.asdict(robot),
        "sensors": {name: sensor_settings(s) for name, s in recording.sensors.items()},
        "schemas": {
            name: {key: dataclasses.asdict(field) for key, field in schema.items()}
            for name, schema in schemas.items()
        },
        "config": recording.config,
        "world": recording.world.name if recording.world else None,
    }


def digest_of(arrays: dict[str, Values], meta: dict[str, Any]) -> str:
    """SHA-256 of arrays and plain values that describe them, as hex."""
    digest = hashlib.sha256(json.dumps(meta, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def recording_from_arrays(stored: dict[str, Values], meta: dict[str, Any]) -> Recording:
    """Recording of its arrays and plain values, checked."""

    def part(prefix: str) -> dict[str, Values]:
        """Arrays directly under a name."""
        return {name: v for name, v in _below(stored, prefix).items() if "." not in name}

    logs, hidden = {}, {}
    schemas = {name: schema_from_meta(fields) for name, fields in meta["schemas"].items()}
    unknown = sorted(set(schemas) - set(meta["sensors"]))
    require(not unknown, f"readings of sensors that it does not describe: {unknown}")
    for name, schema in schemas.items():
        seen, hidden_fields = split_schema(schema)
        where = f"logs.{name}"
        logs[name] = Log(
            seen,
            stored[f"{where}.stamps"],
            {key: stored[f"{where}.{key}"] for key in seen},
            stored.get(f"{where}.splits"),
        )
        logs[name].check(name)
        if hidden_fields:
            where = f"truth.readings.{name}"
            hidden[name] = {key: stored[f"{where}.{key}"] for key in hidden_fields}
            for key, kind in hidden_fields.items():
                n_rows = logs[name].known_splits[-1] if kind.ragged else len(logs[name].stamps)
                kind.check(hidden[name][key], int(n_rows), f"{where}.{key}")
    world = truth = None
    if meta["world"] is not None:
        world = World(name=meta["world"], places=part("world.places"), **part("world"))
    if part("truth"):
        truth = Truth(
            stored["truth.stamps"],
            stored["truth.poses"],
            stored["truth.wheel_travel_m"],
            readings=hidden,
            world=world,
            people=stored.get("truth.people"),
        )
    recording = Recording(
        frame_stamps=stored["frame_stamps"],
        wheels=WheelLog(stored["wheels.stamps"], stored["wheels.position_m"]),
        robot=build(RobotGeometry, meta["robot"], "robot"),
        sensors=sensors_from_meta(meta["sensors"], schemas),
        logs=logs,
        truth=truth,
        commands=CommandLog(stored["commands.stamps"], stored["commands.velocity"])
        if part("commands")
        else None,
        config=meta["config"],
        status=meta["status"],
    )
    unknown = sorted(set(stored) - set(arrays_of(recording)))
    require(not unknown, f"arrays that nothing describes: {', '.join(unknown)}")
    check_recording(recording)
    return recording
