"""Recording: what a run's sensors measured, and the truth beside it; Frame: one instant of it.

A recording is saved as an `.npz` without pickles, with a checksum over all it holds; what does
not match its checksum is never read back.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import InputError, required
from sim.files import write_whole
from sim.robot import RobotGeometry
from sim.sensors import SensorSuite, suite_from_config
from sim.settings import build
from sim.world import World

FORMAT_VERSION = 1


@dataclass(frozen=True)
class WheelLog:
    """Encoder readings: stamps (N,) s; position (N, 2), right and left, accumulated metres."""

    stamps: Array
    position_m: Array


@dataclass(frozen=True)
class LaserLog:
    """Scans: stamps (N,) s; ranges (N, beams) m, float32, +inf where nothing was seen."""

    stamps: Array
    ranges_m: NDArray[np.float32]


@dataclass(frozen=True)
class LandmarkLog:
    """Landmark observations of N images, K in all, image i at rows splits[i]:splits[i + 1].

    Attributes
    ----------
    stamps
        (N,) s.
    splits
        (N + 1,) row numbers.
    points_in_camera
        (K, 3) m: z forward, x right, y down.
    ids
        (K,) landmark ids if the sensor identifies landmarks, else (0,).
    descriptors
        (K, D) float32, or (0, 0).
    """

    stamps: Array
    splits: NDArray[np.int64]
    points_in_camera: Array
    ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    descriptors: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))


@dataclass(frozen=True)
class CloudLog:
    """3D lidar turns: stamps (N,) s; ranges (N, rings, azimuths) m, float32, +inf unseen."""

    stamps: Array
    ranges_m: NDArray[np.float32]


@dataclass(frozen=True)
class PlaceLog:
    """Global descriptors of places: stamps (N,) s; descriptors (N, D) float32."""

    stamps: Array
    descriptors: NDArray[np.float32]


@dataclass(frozen=True)
class CommandLog:
    """Commands as given: from each stamp (N,) s on, v (m/s) and omega (rad/s), (N, 2)."""

    stamps: Array
    velocity: Array


@dataclass(frozen=True)
class Truth:
    """What no Frame shows.

    Attributes
    ----------
    stamps, poses
        (T,) s and (T, 3) m, m, rad: base_link in map.
    wheel_travel_m
        (T, 2) accumulated rolling of the right and left wheel on the ground, or (0, 2).
    landmark_ids
        (K,) true id of each row of the landmark observations.
    world
        The map, or None.
    """

    stamps: Array
    poses: Array
    wheel_travel_m: Array = field(default_factory=lambda: np.zeros((0, 2)))
    landmark_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    world: World | None = None


@dataclass(frozen=True)
class LandmarkSet:
    """The landmark observations of one Frame, as in `LandmarkLog`; ids None if not identified."""

    points_in_camera: Array
    ids: NDArray[np.int64] | None
    descriptors: NDArray[np.float32] | None


@dataclass(frozen=True)
class Frame:
    """One instant at which a sensor fires, without the truth. Its arrays are read-only.

    Attributes
    ----------
    stamp
        Time, s.
    duration_s
        Time since the previous Frame, s; 0 at the first.
    wheel_increments_m
        (2,) encoder travel of the right and left wheel since the previous Frame, m.
    ranges_m
        (beams,) laser scan, m, or None.
    landmarks
        Landmark observations, or None.
    cloud_ranges_m
        (rings, azimuths) 3D lidar turn, m, or None.
    place_descriptor
        (D,) global descriptor, or None.
    """

    stamp: float
    duration_s: float
    wheel_increments_m: Array
    ranges_m: NDArray[np.float32] | None = None
    landmarks: LandmarkSet | None = None
    cloud_ranges_m: NDArray[np.float32] | None = None
    place_descriptor: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Recording:
    """A run: each sensor's data with its own stamps, the commands, the truth, where it came from.

    Attributes
    ----------
    frame_stamps
        (F,) s, increasing: the instants that estimators see.
    wheels, laser, landmarks, clouds, places, commands
        The sensors' logs, None where there is none.
    truth
        What Frames never show; None for a log without reference.
    robot, sensors
        Nominal wheel radius and track, and the sensors' geometry and nominal noise.
    config
        The resolved configuration (plain JSON) the recording came from.
    status
        `ok`, or what went wrong (`collision`, `tipped`, `off_route`, `incomplete`) and when.
    """

    frame_stamps: Array
    wheels: WheelLog
    robot: RobotGeometry
    sensors: SensorSuite
    truth: Truth | None = None
    laser: LaserLog | None = None
    landmarks: LandmarkLog | None = None
    clouds: CloudLog | None = None
    places: PlaceLog | None = None
    commands: CommandLog | None = None
    config: dict[str, Any] = field(default_factory=dict)
    status: str = "ok"

    def __post_init__(self) -> None:
        for array in _arrays(self).values():
            array.setflags(write=False)

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

    @property
    def known_laser(self) -> LaserLog:
        """The laser scans; InputError if there are none."""
        return required(
            self.laser, "this recording has no laser scans; choose sensors such as sensors=hokuyo"
        )

    @property
    def known_landmarks(self) -> LandmarkLog:
        """The landmark observations; InputError if there are none."""
        return required(
            self.landmarks,
            "this recording has no landmark observations; choose sensors such as "
            "sensors=stereo_pixel",
        )

    @property
    def known_clouds(self) -> CloudLog:
        """The 3D lidar turns; InputError if there are none."""
        return required(self.clouds, "this recording has no 3D lidar turns; choose sensors=lidar3d")

    @property
    def known_places(self) -> PlaceLog:
        """The place descriptors; InputError if there are none."""
        return required(self.places, "this recording has no place descriptors")

    def frames(self) -> Iterator[Frame]:
        """Walk through the Frames in order.

        Wheel positions are interpolated at the Frame stamps; in simulation the encoders are read
        at every Frame, so the interpolation is exact there.
        """
        stamps = self.frame_stamps
        position = np.stack(
            [np.interp(stamps, self.wheels.stamps, self.wheels.position_m[:, i]) for i in (0, 1)],
            axis=1,
        )
        increments = np.diff(position, axis=0, prepend=position[:1])
        durations = np.diff(stamps, prepend=stamps[:1])
        increments.setflags(write=False)
        logs = (self.laser, self.landmarks, self.clouds, self.places)
        rows_of_frames = np.stack([_rows_at(stamps, log) for log in logs], axis=1).tolist()
        for i, (scan, image, turn, place) in enumerate(rows_of_frames):
            yield Frame(
                stamp=float(stamps[i]),
                duration_s=float(durations[i]),
                wheel_increments_m=increments[i],
                ranges_m=self.known_laser.ranges_m[scan] if scan >= 0 else None,
                landmarks=self._image(image) if image >= 0 else None,
                cloud_ranges_m=self.known_clouds.ranges_m[turn] if turn >= 0 else None,
                place_descriptor=self.known_places.descriptors[place] if place >= 0 else None,
            )

    def _image(self, row: int) -> LandmarkSet:
        log = self.known_landmarks
        rows = slice(*log.splits[row : row + 2])
        return LandmarkSet(
            points_in_camera=log.points_in_camera[rows],
            ids=log.ids[rows] if len(log.ids) else None,
            descriptors=log.descriptors[rows] if len(log.descriptors) else None,
        )

    def truth_at(self, stamps: Array) -> Array:
        """True poses (N, 3) at stamps (N,), interpolated; NaN outside the truth's time span.

        Raises
        ------
        InputError
            If the recording has no truth.
        """
        poses, times = self.known_truth.poses, self.known_truth.stamps
        heading = np.unwrap(poses[:, 2])
        columns = (poses[:, 0], poses[:, 1], heading)
        x, y, angle = (np.interp(stamps, times, c, left=np.nan, right=np.nan) for c in columns)
        return np.stack([x, y, np.arctan2(np.sin(angle), np.cos(angle))], axis=1)

    @property
    def checksum(self) -> str:
        """SHA-256 over all the recording holds, as hex."""
        return _digest(_arrays(self), _meta(self))

    def cut(self, n_frames: int) -> Recording:
        """The same recording, ended after `n_frames` Frames (the logs keep their tails)."""
        return dataclasses.replace(self, frame_stamps=self.frame_stamps[:n_frames].copy())


_LOGS: dict[str, Any] = {
    "wheels": WheelLog,
    "laser": LaserLog,
    "landmarks": LandmarkLog,
    "clouds": CloudLog,
    "places": PlaceLog,
    "commands": CommandLog,
    "truth": Truth,
}


# What NumPy, zipfile and json raise for files that are not what they should be
_UNREADABLE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    EOFError,
    MemoryError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
)


def save(recording: Recording, path: Path) -> str:
    """Write a recording; return its checksum.

    The file appears whole or not at all: it is written beside its place and then moved there.

    Raises
    ------
    InputError
        If it cannot be written (full disk, no permission).
    """
    arrays, meta = _arrays(recording), _meta(recording)
    checksum = _digest(arrays, meta)
    meta_bytes = np.frombuffer(json.dumps({**meta, "checksum": checksum}).encode(), np.uint8)
    with write_whole(path) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, meta=meta_bytes, **arrays)
    return checksum


def load(path: Path) -> Recording:
    """Read a recording and check it against its checksum.

    Raises
    ------
    InputError
        If the file is missing, truncated, altered, or not a recording.
    """
    remedy = "delete it and record again"
    if not path.is_file():
        raise InputError(f"{path}: no such recording; make one with `estima record`")
    if path.suffix != ".npz" and not zipfile.is_zipfile(path):
        raise InputError(
            f"{path}: not a recording; make one of a log with `estima convert {path} -o FILE.npz`"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            stored = {name: archive[name] for name in archive.files}
        meta = json.loads(stored.pop("meta").tobytes())
        checksum = meta.pop("checksum")
    except _UNREADABLE as error:
        raise InputError(f"{path}: truncated or not a recording ({error}); {remedy}") from error
    if meta.get("format") != FORMAT_VERSION:
        raise InputError(
            f"{path}: recording format {meta.get('format')}, this version reads {FORMAT_VERSION}; "
            f"{remedy}"
        )
    if _digest(stored, meta) != checksum:
        raise InputError(f"{path}: the data do not match their checksum; {remedy}")
    return _assemble(stored, meta)


def _rows_at(
    frame_stamps: Array, log: LaserLog | LandmarkLog | CloudLog | PlaceLog | None
) -> NDArray[np.int64]:
    """Row of a sensor's log that each Frame shows, -1 for none; the last of equal stamps wins."""
    if log is None or len(log.stamps) == 0:
        return np.full(len(frame_stamps), -1)
    found = np.searchsorted(log.stamps, frame_stamps, side="right") - 1
    return np.where((found >= 0) & (log.stamps[found] == frame_stamps), found, -1)


def _arrays(recording: Recording) -> dict[str, NDArray[Any]]:
    """Every array of a recording under the name it is saved by."""
    arrays = {"frame_stamps": recording.frame_stamps}
    parts = {name: getattr(recording, name) for name in _LOGS} | {"world": recording.world}
    for name, part in parts.items():
        for field_name, value in vars(part).items() if part else ():
            if isinstance(value, np.ndarray):
                arrays[f"{name}.{field_name}"] = value
    if recording.world:
        arrays |= {f"world.places.{k}": v for k, v in recording.world.places.items()}
    return arrays


def _meta(recording: Recording) -> dict[str, Any]:
    # Rebuilt from plain values, so that 100 and 100.0 Hz are the same recording.
    sensors = suite_from_config(dataclasses.asdict(recording.sensors))
    robot = build(RobotGeometry, dataclasses.asdict(recording.robot), "robot")
    return {
        "format": FORMAT_VERSION,
        "status": recording.status,
        "robot": dataclasses.asdict(robot),
        "sensors": dataclasses.asdict(sensors),
        "config": recording.config,
        "world": recording.world.name if recording.world else None,
    }


def _digest(arrays: dict[str, NDArray[Any]], meta: dict[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(meta, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def _assemble(stored: dict[str, NDArray[Any]], meta: dict[str, Any]) -> Recording:
    def part(name: str) -> dict[str, NDArray[Any]]:
        prefix = f"{name}."
        return {k.removeprefix(prefix): v for k, v in stored.items() if k.startswith(prefix)}

    logs: dict[str, Any] = {name: cls(**part(name)) for name, cls in _LOGS.items() if part(name)}
    if meta["world"] is not None:
        fields = {k: v for k, v in part("world").items() if not k.startswith("places.")}
        world = World(name=meta["world"], places=part("world.places"), **fields)
        logs["truth"] = dataclasses.replace(logs["truth"], world=world)
    return Recording(
        frame_stamps=stored["frame_stamps"],
        robot=RobotGeometry(**meta["robot"]),
        sensors=suite_from_config(meta["sensors"]),
        config=meta["config"],
        status=meta["status"],
        **logs,
    )
