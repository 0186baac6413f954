"""A team: one Recording a robot, on one clock and in one map."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim.arrays import Array, Values
from sim.errors import require
from sim.recording import (
    FORMAT_VERSION,
    SEVERAL,
    Frame,
    Recording,
    arrays_of,
    describe,
    digest_of,
    load_robots,
    naming_file,
    write_arrays,
)
from sim.sensors import RobotCamera

MOST_ROBOTS = 100


@dataclass(frozen=True)
class Team:
    """Recordings of robots that drive at the same time, in the order of their numbers.

    Wherever their time spans overlap their Frames have the same stamps, so that an instant has a
    Frame of each robot. `on_one_clock` makes it so.

    Raises
    ------
    InputError
        If there is none, their stamps differ, or their worlds do.
    """

    robots: tuple[Recording, ...]

    def __post_init__(self) -> None:
        n = len(self.robots)
        require(0 < n <= MOST_ROBOTS, f"a team has 1 to {MOST_ROBOTS} robots, got {n}")
        if n == 1:
            return
        for number, (recording, stamps) in enumerate(
            zip(self.robots, _on_one_clock(self.robots), strict=True)
        ):
            require(
                np.array_equal(recording.frame_stamps, stamps),
                f"the Frames of robot {number} are not at the stamps of the others'",
            )
            first, own = self.robots[0].world, recording.world
            same = (first is None) == (own is None)
            if first is not None and own is not None:
                same = np.array_equal(first.walls, own.walls)
                same &= np.array_equal(first.landmarks, own.landmarks)
            require(same, f"the world of robot {number} is not that of robot 0")

    @property
    def duration_s(self) -> float:
        """Time from the first Frame of any robot to the last, s."""
        stamps = [robot.frame_stamps for robot in self.robots]
        return float(max(own[-1] for own in stamps) - min(own[0] for own in stamps))

    @property
    def checksum(self) -> str:
        """SHA-256 over all the team holds, as hex; of one robot, that of its recording."""
        return self.robots[0].checksum if len(self) == 1 else digest_of(*_parts(self))

    @property
    def only(self) -> Recording:
        """The recording of a team of one; InputError if there are several robots."""
        require(len(self) == 1, f"{SEVERAL}, from 0 to {len(self) - 1}")
        return self.robots[0]

    def __len__(self) -> int:
        return len(self.robots)

    @classmethod
    def on_one_clock(cls, recordings: Sequence[Recording]) -> Team:
        """Team of recordings in one time base: each gets Frames at the stamps of all of them."""
        if len(recordings) == 1:
            return cls(tuple(recordings))
        clock = _on_one_clock(recordings)
        return cls(
            tuple(
                dataclasses.replace(recording, frame_stamps=stamps)
                for recording, stamps in zip(recordings, clock, strict=True)
            )
        )

    def first(self, size: int) -> Team:
        """Team of the first robots alone, without sightings of the others.

        It is what they would have recorded alone if the others' bodies hid nothing from them.
        """
        require(1 <= size <= len(self), f"a team of {len(self)} has no first {size} robots")
        return Team.on_one_clock([_among(recording, size) for recording in self.robots[:size]])

    def instants(self) -> Iterator[tuple[Frame, ...]]:
        """Walk through the instants in order: the Frames of the robots that have one then."""
        frames = [recording.frames(number) for number, recording in enumerate(self.robots)]
        waiting = [next(own, None) for own in frames]
        while any(waiting):
            now = min(frame.stamp for frame in waiting if frame)
            due = [frame if frame and frame.stamp == now else None for frame in waiting]
            yield tuple(frame for frame in due if frame)
            waiting = [
                next(own, None) if is_due else frame
                for own, is_due, frame in zip(frames, due, waiting, strict=True)
            ]


def save(team: Team, path: Path) -> str:
    """Write a team into one `.npz` file, whole; return its checksum.

    The file of one robot is that of its recording.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    return write_arrays(path, *_parts(team))


def _parts(team: Team) -> tuple[dict[str, Values], dict[str, Any]]:
    """Every array of a team under the name it is saved by, and plain values."""
    if len(team) == 1:
        return arrays_of(team.robots[0]), describe(team.robots[0])
    arrays = {
        f"{number}.{name}": values
        for number, recording in enumerate(team.robots)
        for name, values in arrays_of(recording).items()
    }
    return arrays, {"format": FORMAT_VERSION, "team": [describe(robot) for robot in team.robots]}


def load(path: Path) -> Team:
    """Read a team, or a recording as a team of one, and check it against its checksum.

    Raises
    ------
    InputError
        If the file is missing, altered, or not a recording.
    """
    robots = load_robots(path)
    with naming_file(path):
        return Team(robots)


def _among(recording: Recording, size: int) -> Recording:
    """Recording without sightings of robots from this number on."""
    for name, sensor in recording.sensors.items():
        if isinstance(sensor, RobotCamera):
            log, truth = recording.log(name), recording.known_truth
            hidden = truth.readings[name]
            kept = hidden["true_ids"] < size
            log = dataclasses.replace(
                log,
                values={key: values[kept] for key, values in log.values.items()},
                splits=np.concatenate([[0], np.cumsum(kept)])[log.known_splits],
            )
            hidden = {key: values[kept] for key, values in hidden.items()}
            truth = dataclasses.replace(truth, readings={**truth.readings, name: hidden})
            recording = dataclasses.replace(recording.with_log(name, log), truth=truth)
    return recording


def _on_one_clock(recordings: Sequence[Recording]) -> list[Array]:
    """For each recording, the stamps of all within its own span."""
    stamps = np.unique(np.concatenate([r.frame_stamps for r in recordings]))
    spans = [(r.frame_stamps[0], r.frame_stamps[-1]) for r in recordings]
    return [stamps[(stamps >= begin) & (stamps <= end)] for begin, end in spans]
