"""A part of a log, and a truth that came in a file of its own."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.trajectories.read import read_trajectory
from sim.arrays import Values
from sim.errors import require
from sim.recording import Recording, Truth, WheelLog


@dataclass(frozen=True)
class Part:
    """What of a log is kept.

    Attributes
    ----------
    truth
        Trajectory to take for the truth; None: the log's own.
    from_s, until_s
        Seconds from the first Frame; None: from it on, and to the last.
    """

    truth: Path | None = None
    from_s: float | None = None
    until_s: float | None = None

    def of(self, recording: Recording) -> Recording:
        """Return the part of a recording, with the truth.

        Raises
        ------
        InputError
            If the trajectory cannot be read or lies at another time, or too little is left.
        """
        if self.truth is not None:
            given, frames = read_trajectory(self.truth), recording.frame_stamps
            first, last = given.stamps[[0, -1]]
            require(
                first < frames[-1] and last > frames[0],
                f"{self.truth}: is from {first:.13g} to {last:.13g} s, the log from "
                f"{frames[0]:.13g} to {frames[-1]:.13g} s; give one with the log's clock",
            )
            truth = Truth(given.stamps, given.means, world=recording.world)
            recording = dataclasses.replace(recording, truth=truth)
        if self.from_s is None and self.until_s is None:
            return recording
        begin_s, end_s = recording.frame_stamps[[0, -1]]
        low_s = begin_s if self.from_s is None else begin_s + self.from_s
        high_s = end_s if self.until_s is None else begin_s + self.until_s
        return _between(recording, low_s, high_s)


WHOLE = Part()


def _between(recording: Recording, low_s: float, high_s: float) -> Recording:
    """Frames, readings and wheels between two stamps; the truth as it is, but for its readings."""
    begin_s, end_s = recording.frame_stamps[[0, -1]]
    stamps = recording.frame_stamps
    stamps = stamps[(stamps >= low_s - 1e-9) & (stamps <= high_s + 1e-9)]
    require(
        len(stamps) >= 2,
        f"no two Frames lie in the part from {low_s - begin_s:g} to {high_s - begin_s:g} s of the "
        f"log's {end_s - begin_s:.6g} s",
    )
    wheels = recording.wheels.stamps
    wheels = wheels[(wheels >= stamps[0]) & (wheels <= stamps[-1])]
    wheels = np.unique(np.concatenate([wheels, stamps[[0, -1]]]))
    hidden = {} if recording.truth is None else recording.truth.readings
    logs, readings, config = {}, {}, dict(recording.config)
    for name, log in recording.logs.items():
        first, last = np.searchsorted(log.stamps, [stamps[0], stamps[-1] + 1e-9]).tolist()
        rows, splits, items = slice(first, last), log.splits, slice(0, 0)
        if splits is not None:
            items = slice(int(splits[first]), int(splits[last]))
            splits = splits[first : last + 1] - splits[first]

        def cut(
            values: Mapping[str, Values], name: str = name, rows: slice = rows, items: slice = items
        ) -> dict[str, Values]:
            schema = recording.sensors[name].schema
            kept = {key: items if schema[key].ragged else rows for key in values}
            return {key: values[key][kept[key]] for key in values}

        own = cut(log.values)
        logs[name] = dataclasses.replace(log, stamps=log.stamps[rows], values=own, splits=splits)
        if name in hidden:
            readings[name] = cut(hidden[name])
        if "stamps_known" in config:
            known = np.array(config["stamps_known"])
            config["stamps_known"] = (known[(known >= first) & (known < last)] - first).tolist()
    truth = recording.truth
    if truth is not None:
        truth = dataclasses.replace(truth, readings=readings)
    return dataclasses.replace(
        recording,
        frame_stamps=stamps,
        wheels=WheelLog(wheels, recording.wheels.at(wheels)),
        logs=logs,
        truth=truth,
        config=config,
    )
