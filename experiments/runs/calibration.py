"""What is believed of a real robot: the YAML file of `estima calibrate LOG`, and its use."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from sim.errors import InputError, require
from sim.files import write_text
from sim.formats.assemble import frame_stamps
from sim.options import build
from sim.recording import Log, Recording, WheelLog
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser, RobotCamera, StereoCamera
from sim.sensors.base import Sensor
from sim.yaml_file import read_yaml

_LONGEST_DELAY_S = 60.0


def _check_numbers(
    where: str, settings: object, positive: tuple[str, ...] = (), not_negative: tuple[str, ...] = ()
) -> None:
    """Check that attributes are finite and positive, or at least not negative."""
    for name in (*positive, *not_negative):
        value = getattr(settings, name)
        wanted = "a positive number" if name in positive else "zero or a positive number"
        require(
            math.isfinite(value) and (value > 0.0 or (value == 0.0 and name in not_negative)),
            f"{where}.{name} must be {wanted}, got {value}",
        )


@dataclass(frozen=True)
class Wheels:
    """How the wheels' log becomes travel on the ground.

    Attributes
    ----------
    gain_right, gain_left
        Ground travel over logged travel.
    track_m
        Effective distance of the wheels.
    delay_s
        Added to the stamps of the wheels: positive if they are ahead of what they drive.
    """

    gain_right: float
    gain_left: float
    track_m: float
    delay_s: float

    def __post_init__(self) -> None:
        _check_numbers("wheels", self, ("gain_right", "gain_left", "track_m"))
        require(abs(self.delay_s) < _LONGEST_DELAY_S, "wheels.delay_s must be below a minute")


@dataclass(frozen=True)
class Slip:
    """Variance per metre of each wheel, m, and of what both slip together, which may last, m."""

    kr: float
    kl: float
    forward_slip_m: float
    forward_slip_length_m: float = 0.0

    def __post_init__(self) -> None:
        _check_numbers("slip", self, (), ("kr", "kl", "forward_slip_m", "forward_slip_length_m"))


@dataclass(frozen=True)
class SensorBelief:
    """What is believed of a laser or a camera of landmarks.

    Attributes
    ----------
    x_m, y_m, yaw_rad
        Its mount on the robot; None: as the log has it.
    scale
        Logged range over true range.
    delay_s
        Added to its stamps.
    sigma_range_m
        Of a laser.
    sigma_column_px, sigma_disparity_px
        Of a camera.
    """

    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None
    scale: float = 1.0
    delay_s: float = 0.0
    sigma_range_m: float | None = None
    sigma_column_px: float | None = None
    sigma_disparity_px: float | None = None

    def __post_init__(self) -> None:
        _check_numbers("sensors", self, ("scale",))
        require(abs(self.delay_s) < _LONGEST_DELAY_S, "sensors.delay_s must be below a minute")


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

    def applied(self, recording: Recording) -> Recording:
        """Return the recording with what is believed in place of what its log says.

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
    placed = {key: getattr(belief, key) for key in ("x_m", "y_m", "yaw_rad")}
    mount = {key: value for key, value in placed.items() if value is not None}
    sigmas = {
        key: value
        for key, value in vars(belief).items()
        if key.startswith("sigma") and value is not None
    }
    of_kind = {f.name for f in dataclasses.fields(sensor)}  # type: ignore[arg-type]
    strange = ", ".join(sigmas.keys() - of_kind)
    require(not strange, f"calibration: {name}, a {type(sensor).__name__}, has no {strange}")
    mounted = dataclasses.replace(sensor.mount, **mount)  # type: ignore[attr-defined]
    changed: Sensor = dataclasses.replace(sensor, mount=mounted, **sigmas)  # type: ignore[type-var]
    return changed


def _corrected(log: Log, belief: SensorBelief) -> Log:
    """Return the log with its ranges and stamps put right."""
    values = dict(log.values)
    for name in ("ranges_m", "points_in_camera"):
        if name in values:
            values[name] = (values[name] / belief.scale).astype(values[name].dtype)
    return dataclasses.replace(log, stamps=log.stamps + belief.delay_s, values=values)


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
    known = {"wheels", "slip", "sensors", "intervals"}
    unknown = ", ".join(sorted(map(str, document.keys() - known)))
    require(not unknown, f"{path}: unknown key {unknown}; known: {', '.join(sorted(known))}")
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
    sensors = {
        name: {key: value for key, value in vars(belief).items() if value is not None}
        for name, belief in found.sensors.items()
    }
    document = {
        "wheels": vars(found.wheels),
        "slip": vars(found.slip),
        "sensors": sensors,
        "intervals": dict(intervals),
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
