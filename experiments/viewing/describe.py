"""A recording in words."""

import numpy as np

from experiments.evaluation.metrics import travelled_m
from experiments.runs import paths
from sim.arrays import Array
from sim.errors import printable
from sim.recording import Log, Recording
from sim.sensors import Laser, RealLaser, sensors_from_config
from sim.yaml_file import read_yaml


def describe(recording: Recording) -> str:
    """Describe what a recording holds, in lines of text."""
    truth, config = recording.truth, recording.config
    lines = [
        f"status      {recording.status}",
        f"frames      {len(recording.frame_stamps)} over {recording.duration_s:.2f} s",
        f"robot       wheel radius {recording.robot.wheel_radius_m} m, "
        f"track {recording.robot.track_m} m",
        _line("wheels", recording.wheels.stamps),
    ]
    for name, log in recording.logs.items():
        fields = (f"            {_field(log, field)}" for field in log.values)
        lines += [_line(name, log.stamps), *fields]
        if (known := recognize(recording, name)) is not None:
            lines.append(f"            like sensors={known}, by its beams, their step and its rate")
    if recording.commands is not None:
        lines.append(_line("commands", recording.commands.stamps))
    where = f" in world {recording.world.name}" if recording.world else ""
    driven = "none" if truth is None else f"{travelled_m(truth.poses)[-1]:.2f} m travelled{where}"
    lines.append(f"truth       {driven}")
    if truth is not None and truth.people is not None:
        lines.append(f"people      {truth.people.shape[1]} walk about")
    if "source" in config:
        notes = config.get("notes", {}).items()
        lines.append(f"source      {config['source']}")
        lines += [f"            {key.replace('_', ' ')}: {note}" for key, note in notes]
    if "seed" in config:
        lines.append(f"seed        {config['seed']}")
    lines.append(f"checksum    {recording.checksum}")
    return "\n".join(printable(" ".join(line.splitlines())) for line in lines)


def recognize(recording: Recording, name: str) -> str | None:
    """The preset of `conf/sensors` that a recorded laser is like.

    It has as many beams, to one, at the same step to 1 percent and at the same rate to 15. A
    simulated laser is like a preset of its own class; a real one like one that models a device.
    """
    sensor, stamps = recording.sensors[name], recording.log(name).stamps
    if not isinstance(sensor, Laser) or sensor.n_beams < 2 or len(stamps) < 2:
        return None
    rate_hz = 1.0 / float(np.median(np.diff(stamps)))
    kind = RealLaser if "source" in recording.config else type(sensor)
    for option in paths.option_names("sensors"):
        settings = read_yaml(paths.CONF / "sensors" / f"{option}.yaml").get("laser")
        if settings is None:
            continue
        model = sensors_from_config({"laser": settings})["laser"]
        if isinstance(model, Laser) and type(model) is kind:
            steps = [np.diff(laser.bearings_rad[:2])[0] for laser in (sensor, model)]
            alike = (
                abs(steps[0] / steps[1] - 1.0) < 0.01 and abs(rate_hz / model.rate_hz - 1) < 0.15
            )
            if alike and abs(sensor.n_beams - model.n_beams) <= 1:
                return option
    return None


def _line(name: str, stamps: Array) -> str:
    gaps_s = np.diff(stamps)
    rate = f", every {1000 * float(np.median(gaps_s)):.1f} ms" if len(gaps_s) else ""
    return f"{name:<11} {len(stamps)} readings{rate}"


def _field(log: Log, name: str) -> str:
    """What a field holds, in words."""
    kind, values = log.schema[name], log[name]
    shape = " x ".join(map(str, values.shape[1:]))
    words = ", ".join(filter(None, (name, shape, kind.unit)))
    if kind.ragged:
        words += f", {len(values) / max(len(log.stamps), 1):.1f} rows a reading"
    elif kind.dtype in ("f4", "f8") and values.size:
        words += f", {100 * np.isfinite(values).mean():.1f} % finite"
    return words
