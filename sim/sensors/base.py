"""What a sensor is, what it sees of the simulation, and how its readings are described.

A sensor is a frozen dataclass of its geometry and noise: `rate_hz`, `schema`, and `start`, which
gives a probe. A probe is called at each firing and returns a reading, or None. It may keep a
state, such as a bias that walks. These are optional:

* a probe's `begin(view)` is called once before the drive;
* `mount` places the sensor on the robot (else it is at base_link);
* `points_in_base(reading)` gives points (N, 2) or (N, 3) m to draw;
* `ros_message`, `ros_topic`, `ros_frame`, `to_ros(reading)` and `from_ros(message)` map readings
  to a standard ROS message. A sensor without them gets a message of its own from its schema.
"""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from keyword import iskeyword
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np

from sim import se2
from sim.arrays import Array, Bools, Ints, Values
from sim.errors import InputError, blaming, require
from sim.options import Offset, Turn, build, find, options
from sim.worlds.world import World

S = TypeVar("S")
Reading = Mapping[str, Values]
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_DTYPES = ("f8", "f4", "i8", "i4", "u1")
_TAKEN = ("wheels", "commands", "truth")  # what else a recording holds
_OWN = "sim.sensors."
# What a class may offer beyond its settings; a file's settings cannot stand for it
_OFFERS = ("points_in_base", "ros_message", "ros_topic", "ros_optical", "to_ros", "from_ros")


@dataclass(frozen=True)
class Field:
    """One array of a sensor's readings.

    Attributes
    ----------
    unit
        Such as `m` or `rad/s`; empty for a plain number.
    dtype
        `f8`, `f4`, `i8`, `i4` or `u1`.
    shape
        Of one reading. None for a size that is the same in a whole recording, but not known
        beforehand.
    ragged
        Whether a reading has any number of rows of this shape.
    truth
        Whether it is kept with the truth, out of every Frame.
    in_map
        Whether it holds points of the frame map, (..., 2) or (..., 3).
    """

    unit: str = ""
    dtype: str = "f8"
    shape: tuple[int | None, ...] = ()
    ragged: bool = False
    truth: bool = False
    in_map: bool = False

    def __post_init__(self) -> None:
        require(
            self.dtype in _DTYPES, f"a field's dtype must be one of {_DTYPES}, got {self.dtype!r}"
        )
        sizes = isinstance(self.shape, tuple) and all(
            size is None or (isinstance(size, int) and size >= 0) for size in self.shape
        )
        require(sizes, f"a field's shape must be a tuple of sizes and None, got {self.shape!r}")
        require(isinstance(self.unit, str), f"a field's unit must be a text, got {self.unit!r}")

    def converted_copy(self, value: Any, where: str) -> Values:
        """Read-only copy of a reading's value, of the field's type.

        Raises
        ------
        InputError
            If it does not hold numbers, or numbers that the type cannot hold.
        """
        raw, whole = np.asarray(value), self.dtype[0] in "iu"
        require(
            raw.dtype.kind in ("biu" if whole else "biuf"),
            f"{where} must hold {'whole ' if whole else ''}numbers, got {raw.dtype}",
        )
        if whole and raw.size:
            least, most = np.iinfo(self.dtype).min, np.iinfo(self.dtype).max
            fits = least <= raw.min() and raw.max() <= most
            require(fits, f"{where} must lie in [{least}, {most}], as {self.dtype} does")
        copy = np.array(raw, self.dtype)
        copy.setflags(write=False)
        return copy

    def check(self, values: Values, n: int, where: str) -> None:
        """Check the values of `n` readings, or rows.

        Raises
        ------
        InputError
            If type or shape are wrong.
        """
        wanted = (n, *self.shape)
        fits = len(wanted) == values.ndim and all(
            want in (None, size) for want, size in zip(wanted, values.shape, strict=True)
        )
        if not fits:
            shape = ", ".join("any" if size is None else str(size) for size in wanted)
            raise InputError(f"{where} must have shape ({shape}), got {values.shape}")
        require(
            values.dtype == np.dtype(self.dtype),
            f"{where} must be {self.dtype}, got {values.dtype}",
        )

    def stack(self, values: Sequence[Any], where: str) -> Values:
        """Array of many readings: (N, *shape), or all rows of a ragged field, (K, *shape).

        Raises
        ------
        InputError
            If they do not fit the field.
        """
        if not values:
            return np.zeros((0, *(size or 0 for size in self.shape)), self.dtype)
        try:
            parts = [np.asarray(value, self.dtype) for value in values]
            whole = np.concatenate(parts) if self.ragged else np.stack(parts)
        except (ValueError, TypeError) as error:
            raise InputError(f"{where}: readings that do not go together ({error})") from error
        self.check(whole, len(whole), where)
        return whole


Schema = Mapping[str, Field]


def split_schema(schema: Schema) -> tuple[Schema, Schema]:
    """Fields that Frames show, and those that are truth."""
    seen = {name: field for name, field in schema.items() if not field.truth}
    return seen, {name: field for name, field in schema.items() if field.truth}


class Hits(NamedTuple):
    """What the beams of a scan hit.

    Attributes
    ----------
    ranges_m
        (B,); inf without a return.
    cos_incidence
        (B,) cosine of the angle between beam and the face's normal.
    materials
        (B,) `sim.worlds.world.Material`.
    """

    ranges_m: Array
    cos_incidence: Array
    materials: Ints

    def nearer(self, other: "Hits") -> "Hits":
        """Of two scans, what each beam hits first."""
        first = self.ranges_m <= other.ranges_m
        return Hits(*(np.where(first, a, b) for a, b in zip(self, other, strict=True)))


class Rays(Protocol):
    """What casts rays in the world; scanners are on the robot at a pose (3,) in map."""

    def scan(self, scanner: Any, pose: Array) -> Array:
        """Ranges (beams,) m of a planar scanner; inf without a return."""

    def cloud(self, lidar: Any, pose: Array) -> Array:
        """Ranges (rings, azimuths) m of a 3D lidar."""

    def sees(self, origin: Array, points: Array) -> Bools:
        """Whether nothing stands between a point (3,) and each of others (K, 3)."""

    def hits(self, scanner: Any, eyes: Array, bearings_rad: Array, stamps: Array) -> Hits:
        """What beams (B,) hit, each with its own pose of the scanner (B, 3), bearing and time."""


@dataclass(frozen=True)
class View:
    """The simulation as one sensor sees it when it fires.

    Attributes
    ----------
    stamp
        Time, s.
    pose
        (3,) m, m, rad: base_link in map.
    world, rays
        What stands there, and what casts rays in it.
    last_stamp, last_pose
        The same sensor's firing before; the present one at the first.
    others
        Of a team: the pose (3,) of each other robot, by its number.
    past
        Stamps (T,) s and poses (T, 3) of base_link over the last moments, up to now.
    """

    stamp: float
    pose: Array
    world: World
    rays: Rays
    last_stamp: float
    last_pose: Array
    others: Mapping[int, Array] = field(default_factory=dict)
    past: tuple[Array, Array] | None = None

    @property
    def duration_s(self) -> float:
        """Time since the last firing, s; 0 at the first."""
        return self.stamp - self.last_stamp

    @property
    def motion(self) -> Array:
        """T_last_now (3,): motion of base_link since the last firing, m, m, rad."""
        return se2.between(self.last_pose, self.pose)

    def scan(self, scanner: Any) -> Array:
        """True ranges (beams,) m of a planar scanner; +inf without a return.

        It has `mount`, evenly spaced `bearings_rad` (beams,), and `max_range_m`; `sweep_s` if its
        beams are measured one after another.
        """
        if getattr(scanner, "sweep_s", 0.0) > 0.0:
            return self.hits(scanner).ranges_m
        return self.rays.scan(scanner, self.pose)

    def hits(self, scanner: Any, turned_rad: float = 0.0) -> Hits:
        """What the beams of a `Laser` hit, each at its own instant, all turned by an angle."""
        stamps = self.stamp + scanner.beam_offsets_s
        poses = np.tile(self.pose, (len(stamps), 1))
        if scanner.sweep_s > 0.0 and self.past is not None:
            times, past = self.past
            columns = (past[:, 0], past[:, 1], np.unwrap(past[:, 2]))
            poses = np.stack([np.interp(stamps, times, column) for column in columns], axis=1)
        mount = scanner.mount
        eyes = np.column_stack(
            [se2.transform(poses, np.tile([mount.x_m, mount.y_m], (len(poses), 1, 1)))[:, 0],
             poses[:, 2] + mount.yaw_rad]
        )  # fmt: skip
        return self.rays.hits(scanner, eyes, scanner.bearings_rad + turned_rad, stamps)

    def cloud(self, lidar: Any) -> Array:
        """True ranges (rings, azimuths) m of a lidar like `Lidar3D`; +inf without a return."""
        return self.rays.cloud(lidar, self.pose)

    def sees(self, origin: Array, points: Array) -> Bools:
        """Whether nothing stands between a point (3,) of map and each of others (K, 3)."""
        return self.rays.sees(origin, points)


class Probe(Protocol):
    """A sensor at work."""

    def __call__(self, view: View) -> Reading | None:
        """Measure: arrays by the names of the schema, or None for no reading."""


class Sensor(Protocol):
    """What a sensor is: a frozen dataclass."""

    @property
    def rate_hz(self) -> float | None:
        """Firings per second; None: only read when another sensor fires."""

    @property
    def schema(self) -> Schema:
        """Fields of a reading by name."""

    def start(self, rng: np.random.Generator) -> Probe:
        """Begin a drive."""


Sensors = Mapping[str, Sensor]


@options("sensors.mount")
class Mount:
    """Pose of a sensor in base_link: x forward, y left, z up (m), yaw (rad)."""

    x_m: Offset = 0.0
    y_m: Offset = 0.0
    z_m: Offset = 0.2
    yaw_rad: Turn = 0.0

    @property
    def pose(self) -> Array:
        """T_base_sensor in the plane, (3,) m, m, rad."""
        return np.array([self.x_m, self.y_m, self.yaw_rad])

    def in_map(self, pose: Array) -> Array:
        """Pose (3,) of the sensor in map for the robot's pose (3,)."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        return np.array(
            [
                pose[0] + cos * self.x_m - sin * self.y_m,
                pose[1] + sin * self.x_m + cos * self.y_m,
                pose[2] + self.yaw_rad,
            ]
        )

    def points_in_base(self, points_in_sensor: Array) -> Array:
        """Points (N, 2) or (N, 3) of the sensor's frame (x forward, z up) in base_link, m."""
        points = np.array(points_in_sensor, float)
        points[:, :2] = se2.transform(self.pose, points[:, :2])
        points[:, 2:] += self.z_m
        return points


@dataclass(frozen=True)
class RecordedSensor:
    """A sensor read from a file, whose class is not imported: no file chooses what code runs.

    Its settings are attributes: `sensor.sigma_m`.
    """

    target: str
    settings: Mapping[str, Any]
    schema: Schema
    rate_hz: ClassVar[float | None] = None

    def __getattr__(self, name: str) -> Any:
        settings = vars(self).get("settings", {})
        if name not in settings or name in _OFFERS:
            raise AttributeError(
                f"a recorded {vars(self).get('target')} has its settings, and no {name}; name its "
                "class again: sensors=PRESET with its _target_"
            )
        return settings[name]

    def start(self, rng: np.random.Generator) -> Probe:
        """Refuse to simulate."""
        raise InputError(f"a recorded {self.target} cannot be simulated; name its class in sensors")


def sensor_of(sensors: Sensors, name: str, kind: type[S] = object) -> S:  # type: ignore[assignment]
    """Return the sensor of a name.

    Raises
    ------
    InputError
        If there is none, or one of another class.
    """
    if name not in sensors:
        known = ", ".join(sensors) or "none"
        raise InputError(f"no sensor named {name} (there is {known}); choose sensors that have one")
    found = sensors[name]
    if isinstance(found, RecordedSensor) and not isinstance(found, kind):
        raise InputError(
            f"sensor {name} was recorded as {found.target}, whose code a file does not choose; "
            "name its class again: sensors=PRESET with its _target_"
        )
    if not isinstance(found, kind):
        raise InputError(f"sensor {name} is a {type(found).__name__}, not a {kind.__name__}")
    return found


def sensors_from_config(config: Mapping[str, Any]) -> dict[str, Sensor]:
    """Sensors from mappings with `_target_`, by name; None leaves one out.

    Raises
    ------
    InputError
        For a name that is not a word, a class that cannot be found, an unknown key, or a value that
        makes no sense.
    """
    sensors = {}
    for name, settings in config.items():
        where = _place_of(name)
        if settings is None:
            continue
        require(
            isinstance(settings, Mapping) and "_target_" in settings,
            f"{where} must be a mapping with _target_, such as sim.sensors.laser.Laser",
        )
        sensors[name] = _made(find(settings["_target_"], where), settings, where)
    return sensors


def is_ours(sensor: Sensor) -> bool:
    """Whether the sensor's class is this package's, so that a file may name it."""
    return type(sensor).__module__.startswith(_OWN)


def sensor_settings(sensor: Sensor) -> dict[str, Any]:
    """Plain settings of a sensor, with `_target_`; `sensors_from_config` makes it again."""
    if isinstance(sensor, RecordedSensor):
        settings = {
            k: dataclasses.asdict(v) if isinstance(v, Mount) else v
            for k, v in sensor.settings.items()
        }
        return {"_target_": sensor.target, **settings}
    kind: Any = type(sensor)
    # Built again from plain values, so that 100 and 100.0 Hz are the same sensor.
    plain = build(kind, vars(sensor), "sensors")
    return {"_target_": f"{kind.__module__}.{kind.__qualname__}", **dataclasses.asdict(plain)}


def schema_from_meta(fields: Mapping[str, Any]) -> Schema:
    """Schema of a file's description."""
    schema = {name: Field(**{**f, "shape": tuple(f["shape"])}) for name, f in fields.items()}
    _check_fields(schema, "schemas")
    return schema


def sensors_from_meta(
    settings: Mapping[str, Mapping[str, Any]], schemas: Mapping[str, Schema]
) -> dict[str, Sensor]:
    """Sensors of a file's description: this package's, or `RecordedSensor`s."""
    sensors: dict[str, Sensor] = {}
    for name, values in settings.items():
        target, where = str(values["_target_"]), _place_of(name)
        if target.startswith(_OWN):
            sensors[name] = _made(find(target, where), values, where)
        else:
            own = {key: value for key, value in values.items() if key != "_target_"}
            if "mount" in own:
                own["mount"] = build(Mount, own["mount"], f"{where}.mount")
            sensors[name] = RecordedSensor(target, own, schemas.get(name, {}))
    return sensors


def _made(kind: Any, settings: Mapping[str, Any], where: str) -> Sensor:
    require(
        isinstance(kind, type) and dataclasses.is_dataclass(kind),
        f"{where}._target_={settings['_target_']} must be a dataclass",
    )
    made: Any = build(kind, {k: v for k, v in settings.items() if k != "_target_"}, where)
    with blaming(where):
        for name in ("rate_hz", "schema", "start"):
            known = hasattr(made, name)
            require(known, f"{where}: {settings['_target_']} has no {name}; see sim.sensors.base")
        schema = made.schema
    fields = isinstance(schema, Mapping) and all(isinstance(f, Field) for f in schema.values())
    require(fields, f"{where}: the schema must be a mapping of names to Field, got {schema!r:.60}")
    _check_fields(schema, where)
    sensor: Sensor = made
    return sensor


def _place_of(name: Any) -> str:
    """Place of a sensor in the configuration; its name must be a word."""
    require(
        isinstance(name, str) and _NAME.fullmatch(name) and name not in _TAKEN,
        f"sensors: a sensor's name must be one word of letters and digits, and none of "
        f"{', '.join(_TAKEN)}; got {name!r}",
    )
    return f"sensors.{name}"


def _check_fields(schema: Schema, where: str) -> None:
    for name in schema:
        require(
            _NAME.fullmatch(name)
            and not iskeyword(name)
            and name not in ("stamps", "splits", "header"),
            f"{where}: {name!r} cannot be the name of a field",
        )
    seen, hidden = split_schema(schema)
    ragged = [any(field.ragged for field in part.values()) for part in (seen, hidden)]
    require(
        ragged != [False, True],
        f"{where}: a ragged truth field needs a measured ragged field too",
    )
