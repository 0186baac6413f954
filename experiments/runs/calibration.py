"""A real robot's calibration: the YAML file of `estima calibrate LOG`, and its use."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

from sim.errors import InputError, describe_unknown, require
from sim.files import write_text
from sim.formats.assemble import frame_stamps
from sim.options import NonNegative, Positive, build, options
from sim.recording import Log, Recording, WheelLog
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser, Mount, RobotCamera, StereoCamera
from sim.sensors.base import Sensor
from sim.yaml_file import read_yaml

Delay = Annotated[float, Field(gt=-60.0, lt=60.0), "a number of seconds below a minute"]


BELIEVED = ("kr", "kl", "forward_slip_m")  # options of estimators


@options("wheels")
class Wheels:
    """How the wheels' log becomes travel on the ground."""

    gain_right: Positive
    """Ground travel over logged travel."""
    gain_left: Positive
    track_m: Positive
    """Effective distance of the wheels."""
    delay_s: Delay
    """Added to the stamps of the wheels: positive if they are ahead of what they drive."""


@options("slip")
class Slip:
    """Slip of the wheels."""

    kr: NonNegative
    """Variance per metre of the right wheel, m."""
    kl: NonNegative
    """Of the left one."""
    forward_slip_m: NonNegative
    """Variance per metre of what both slip together, m."""
    forward_slip_length_m: NonNegative = 0.0
    """How far that lasts, m."""


@options("sensors")
class SensorBelief:
    """What is believed of a laser or a camera of landmarks; None: as the log has it."""

    x_m: float | None = None
    """Of its mount on the robot."""
    y_m: float | None = None
    yaw_rad: float | None = None
    mirrored: bool | None = None
    """Whether a laser is mounted upside down, so that its beams run the other way."""
    scale: Positive = 1.0
    """Logged range over true range."""
    delay_s: Delay = 0.0
    """Added to its stamps."""
    sigma_range_m: float | None = None
    """Of a laser."""
    sigma_column_px: float | None = None
    """Of a camera."""
    sigma_disparity_px: float | None = None
    """Of a camera."""


@dataclass(frozen=True)
class Calibration:
    """What is believed of a robot and its sensors.

    Attributes
    ----------
    wheels, slip
        As above.
    sensors
        By name.
    """

    wheels: Wheels
    slip: Slip
    sensors: Mapping[str, SensorBelief] = field(default_factory=dict)

    def apply_to(self, recording: Recording) -> Recording:
        """Return the recording with the log's values replaced by the calibrated ones.

        Raises
        ------
        InputError
            If it has no such sensor.
        """
        wheels = WheelLog(
            recording.wheels.stamps + self.wheels.delay_s,
            recording.wheels.position_m * [self.wheels.gain_right, self.wheels.gain_left],
        )
        sensors, logs = dict(recording.sensors), dict(recording.logs)
        for name, belief in self.sensors.items():
            logs[name] = _corrected(recording.log(name), belief)
            sensors[name] = _believed(name, recording.sensors[name], belief)
        return dataclasses.replace(
            recording,
            frame_stamps=frame_stamps(wheels.stamps, [log.stamps for log in logs.values()]),
            wheels=wheels,
            robot=RobotGeometry(recording.robot.wheel_radius_m, self.wheels.track_m),
            sensors=sensors,
            logs=logs,
        )


def _believed(name: str, sensor: Sensor, belief: SensorBelief) -> Sensor:
    """Return the sensor with another mount and noise."""
    require(
        isinstance(sensor, (Laser, StereoCamera, RobotCamera)),
        f"calibration: {name} is a {type(sensor).__name__}; only a Laser or a StereoCamera has one",
    )
    stated = _stated(belief)
    mount = {key: stated[key] for key in ("x_m", "y_m", "yaw_rad") if key in stated}
    sigmas = {key: value for key, value in stated.items() if key.startswith("sigma")}
    strange = ", ".join(sigmas.keys() - {f.name for f in dataclasses.fields(sensor)})  # type: ignore[arg-type]
    require(not strange, f"calibration: {name}, a {type(sensor).__name__}, has no {strange}")
    logged: Mount = sensor.mount  # type: ignore[attr-defined]
    if belief.mirrored:
        mount = {"yaw_rad": -logged.yaw_rad, **mount}
    mounted = dataclasses.replace(logged, **mount)
    changed: Sensor = dataclasses.replace(sensor, mount=mounted, **sigmas)  # type: ignore[type-var]
    return changed


def _stated(believed: Any) -> dict[str, float]:
    """The fields of an options class that are not None."""
    return {key: v for key, v in dataclasses.asdict(believed).items() if v is not None}


def _corrected(log: Log, belief: SensorBelief) -> Log:
    """Return the log with its ranges and stamps put right."""
    values = dict(log.values)
    for name in ("ranges_m", "points_in_camera"):
        if name in values:
            values[name] = (values[name] / belief.scale).astype(values[name].dtype)
    if belief.mirrored and "ranges_m" in values:
        values["ranges_m"] = values["ranges_m"][:, ::-1].copy()
    return dataclasses.replace(log, stamps=log.stamps + belief.delay_s, values=values)


def read_calibrations(given: Any) -> list[Calibration]:
    """Read what the key `calibration` names: nothing, a file, or a list of one a robot of a team.

    Raises
    ------
    InputError
        As `read_calibration`, or if it is something else.
    """
    files = given if isinstance(given, Sequence) and not isinstance(given, str) else [given]
    require(
        all(isinstance(file, str) and file for file in files) or given is None,
        f"calibration must be a path, a list of one path a robot of a team, or null, got {given!r}",
    )
    return [] if given is None else [read_calibration(Path(file)) for file in files]


def mean_slip(calibrations: Sequence[Calibration]) -> dict[str, float]:
    """What an estimator can believe of the slip: one law for all robots, the mean of theirs."""
    return {
        key: sum(getattr(each.slip, key) for each in calibrations) / len(calibrations)
        for key in BELIEVED
    }


def read_calibration(path: Path) -> Calibration:
    """Read a file of `estima calibrate LOG`.

    Raises
    ------
    InputError
        Naming the file, and the key that is missing, unknown or out of range.
    """
    document: Any = read_yaml(path)
    require(
        isinstance(document, dict) and {"wheels", "slip"} <= document.keys(),
        f"{path}: a calibration holds wheels, slip and sensors; make one with `estima calibrate`",
    )
    known = ("wheels", "slip", "sensors", "intervals")
    for key in document:
        require(key in known, f"{path}: {describe_unknown(str(key), known)}")
    sensors = document.get("sensors") or {}
    require(isinstance(sensors, dict), f"{path}: sensors must hold the sensors' names")
    try:
        return Calibration(
            build(Wheels, document["wheels"], "wheels"),
            build(Slip, document["slip"], "slip"),
            {name: build(SensorBelief, s, f"sensors.{name}") for name, s in sensors.items()},
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def write_calibration(path: Path, found: Calibration, intervals: Mapping[str, list[float]]) -> None:
    """Write a calibration, and the 95 % intervals of what was estimated, which nothing reads."""
    document = {
        "wheels": _stated(found.wheels),
        "slip": _stated(found.slip),
        "sensors": {name: _stated(belief) for name, belief in found.sensors.items()},
        "intervals": intervals,
    }
    rounded = yaml.safe_dump(_rounded(document), sort_keys=False, default_flow_style=None)
    write_text(path, "# Made by `estima calibrate`; read by `estima run calibration=`\n" + rounded)


def _rounded(value: Any) -> Any:
    """Plain values with six significant digits."""
    if isinstance(value, Mapping):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
