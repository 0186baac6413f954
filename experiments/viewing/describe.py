"""A recording in words."""

import numpy as np

from experiments.evaluation.metrics import travelled_m
from sim.arrays import Array
from sim.errors import printable
from sim.recording import Log, Recording


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
    if recording.commands is not None:
        lines.append(_line("commands", recording.commands.stamps))
    where = f" in world {recording.world.name}" if recording.world else ""
    driven = "none" if truth is None else f"{travelled_m(truth.poses)[-1]:.2f} m travelled{where}"
    lines.append(f"truth       {driven}")
    if "source" in config:
        notes = config.get("notes", {}).items()
        lines.append(f"source      {config['source']}")
        lines += [f"            {key.replace('_', ' ')}: {note}" for key, note in notes]
    if "seed" in config:
        lines.append(f"seed        {config['seed']}")
    lines.append(f"checksum    {recording.checksum}")
    return "\n".join(printable(" ".join(line.splitlines())) for line in lines)


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
