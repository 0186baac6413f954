"""What a recording from a file must hold, whoever wrote it. Its logs check themselves."""

import math
from typing import Any

import numpy as np

from sim.arrays import Values
from sim.errors import InputError, require
from sim.sensors.base import RecordedSensor, split_schema

LARGEST = 1e12  # s, m: nothing that is recorded is beyond


def check_recording(recording: Any) -> None:
    """Check shape, type, order and finiteness of what a Recording's users rely on.

    Readings may hold inf and NaN, where a sensor saw nothing.

    Raises
    ------
    InputError
        Naming the array or key.
    """
    _check_stamps(recording.frame_stamps, "frame_stamps", strictly=True)
    wheels, commands, truth = recording.wheels, recording.commands, recording.truth
    _check_stamps(wheels.stamps, "wheels.stamps")
    _check_numbers(wheels.position_m, (len(wheels.stamps), 2), "wheels.position_m")
    if commands is not None:
        _check_stamps(commands.stamps, "commands.stamps", least=0)
        _check_numbers(commands.velocity, (len(commands.stamps), 2), "commands.velocity")
    if truth is not None:
        _check_stamps(truth.stamps, "truth.stamps")
        n = len(truth.stamps)
        _check_numbers(truth.poses, (n, 3), "truth.poses")
        n_travel = n if len(truth.wheel_travel_m) else 0
        _check_numbers(truth.wheel_travel_m, (n_travel, 2), "truth.wheel_travel_m")
        if truth.people is not None:
            n_people = truth.people.shape[1] if truth.people.ndim == 3 else 0
            _check_numbers(truth.people, (n, n_people, 3), "truth.people")
    first, last = recording.frame_stamps[[0, -1]]
    bare_s = max(wheels.stamps[0] - first, last - wheels.stamps[-1])
    require(
        bare_s <= np.diff(wheels.stamps).max(initial=0.0),
        f"wheels.stamps leave {bare_s:g} s of its Frames without a reading",
    )
    for name, log in recording.logs.items():
        _check_stamps(log.stamps, f"{name}.stamps", least=0)
        sensor = recording.sensors[name]
        expected, _ = split_schema(sensor.schema)
        require(
            isinstance(sensor, RecordedSensor) or dict(log.schema) == dict(expected),
            f"the readings of {name} are not those of its settings: they hold {_said(log.schema)}, "
            f"not {_said(expected)}",
        )
        unseen = np.setdiff1d(log.stamps, recording.frame_stamps)
        unseen = unseen[(unseen > first) & (unseen < last)]
        for stamp in unseen[:1]:
            raise InputError(f"{name} has a reading at {stamp} s, and no Frame is then")
    _check_texts(recording)


def _check_texts(recording: Any) -> None:
    status, config = recording.status, recording.config
    require(isinstance(status, str) and status, f"status must be a text, got {status!r}")
    require(isinstance(config, dict), f"config must hold keys, got {config!r}")
    robot = config.get("robot")
    slip = robot if isinstance(robot, dict) else {}  # of a log of many robots, the number of one
    for key in ("kr", "kl"):
        value = slip.get(key, 0.0)
        require(
            isinstance(value, (int, float))
            and not isinstance(value, bool)
            and math.isfinite(value),
            f"config.robot.{key} must be a number, got {value!r}",
        )
    notes = config.get("notes", {})
    require(isinstance(notes, dict), f"config.notes must hold keys, got {notes!r}")
    if recording.world is not None:
        name = recording.world.name
        require(isinstance(name, str), f"the world's name must be a text, got {name!r}")


def _check_stamps(stamps: Values, where: str, *, strictly: bool = False, least: int = 1) -> None:
    _check_numbers(stamps, (len(stamps),) if stamps.ndim == 1 else (0,), where)
    require(len(stamps) >= least, f"{where} is empty")
    steps = np.diff(stamps)
    wanted = "increase" if strictly else "not decrease"
    for i in np.flatnonzero(steps <= 0.0 if strictly else steps < 0.0)[:1]:
        raise InputError(f"{where} must {wanted}; {i + 1} is {stamps[i + 1]} after {stamps[i]}")


def _check_numbers(values: Values, shape: tuple[int, ...], where: str) -> None:
    require(values.shape == shape, f"{where} must have shape {shape}, got {values.shape}")
    require(values.dtype == np.float64, f"{where} must be f8, got {values.dtype}")
    for place in np.argwhere(~(np.abs(values) <= LARGEST))[:1].tolist():  # NaN is not below
        raise InputError(
            f"{where}{place} must be a number below {LARGEST:g}, got {values[tuple(place)]}"
        )


def _said(schema: Any) -> str:
    return ", ".join(f"{name} {field.dtype} {field.shape}" for name, field in schema.items())
