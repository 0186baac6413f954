"""A program that reads a whole log as a file, as an estimator; its trajectory is read back.

The log is made of the Frames and the Prior, so it holds neither the truth nor where it came from.
"""

import tempfile
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, cast

import numpy as np
import orjson

from estimators.base import Belief, Estimate, Prior
from estimators.programs.places import NAMES, fill, needs_of, places_in
from estimators.programs.program import (
    ProgramError,
    ProgramOptions,
    Seconds,
    draw_seed,
    explain_mismatch,
    map_message,
    start,
)
from sim import se2
from sim.errors import InputError, require
from sim.files import write_text
from sim.formats.carmen import write_carmen
from sim.formats.rosbag_out import write_bag
from sim.formats.trajectory import read_track
from sim.options import options
from sim.recording import Frame, Recording, WheelLog, log_of_readings, save
from sim.robot.arc import arc_increment
from sim.worlds.grid import OccupancyGrid, rasterize
from sim.worlds.grid_file import write_grid
from sim.worlds.world import World

Output = Literal["tum", "mcap", "bag"]
Kind = Literal["revised", "online"]
_CELL_M = 0.05  # of a world's {grid}


@options("estimator")
class OfflineOptions(ProgramOptions):
    """Options of a program that reads a whole log.

    In the command {log} (CARMEN), {mcap}, {npz}, {map}, {grid}, {start}, {seed} and {out} stand for
    the files' names.
    """

    settings: Annotated[
        dict[str, int | float | str | bool] | None,
        "a mapping of names to numbers, words or truth values",
    ] = None
    """Further words KEY=VALUE of the command; null: none."""
    limit_s: Seconds = 600.0
    """Longest time that it may take, s."""
    output: Output = "tum"
    """Format of {out}: `tum`, or `mcap` or `bag` (nav_msgs/Odometry)."""
    kind: Kind = "revised"
    """`revised`, or `online` where each pose of its trajectory saw only its past."""

    def __post_init__(self) -> None:
        super().__post_init__()
        known = ", ".join(f"{{{place}}}" for place in NAMES)
        for name in self.places:
            require(
                name in NAMES,
                f"estimator.command: nothing is called {{{name}}}; known: {known}",
            )
        require("out" in self.places, "estimator.command must have {out}, the file it writes")

    @cached_property
    def places(self) -> set[str]:
        """Names of files in the command."""
        return places_in(" ".join(self.words))

    @property
    def chosen(self) -> list[str]:
        """The settings as words."""
        return [
            f"{key}={str(value).lower() if isinstance(value, bool) else value}"
            for key, value in (self.settings or {}).items()
        ]

    @property
    def needs(self) -> frozenset[str]:
        """The sensors, and the map, from which the named files are made."""
        return needs_of(" ".join(self.words))


class Offline(OfflineOptions):
    """Run a command over the whole log when the last Frame is there.

    Until then its beliefs are dead reckoning without a covariance.
    """

    answers_at_finish = True
    program_seconds = 0.0

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Keep what is known at the start."""
        if "laser" in self.needs:
            self._laser = prior.require_laser("laser", "estimator.command")
        require(
            "map" not in self.needs or isinstance(prior.map, (World, OccupancyGrid)),
            "estimator.command names {map} or {grid}; set prior.map=world or GRID.yaml",
        )
        self._prior, self._seed = prior, draw_seed(rng)
        self._frames = list[Frame]()
        self._pose = np.zeros(3) if prior.mean is None else prior.mean.copy()

    def step(self, frame: Frame) -> Belief:
        """Keep the Frame, and follow the wheels."""
        self._frames.append(frame)
        increment = arc_increment(frame.wheel_increments_m, self._prior.robot.track_m)
        self._pose = se2.compose(self._pose, increment)
        return Belief(self._pose.copy(), np.zeros((3, 3)))

    def finish(self) -> Estimate:
        """Write the log, run the command, and read its trajectory."""
        with tempfile.TemporaryDirectory(prefix="estima-") as name:
            places = self._written(Path(name))
            program = start([*(fill(word, places) for word in self.words), *self.chosen])
            try:
                program.wait(self.limit_s)
            finally:
                self.program_seconds = program.close()
            out = Path(places["out"])
            if not out.exists():
                raise ProgramError(f"{program.name} ended without writing {{out}}")
            try:
                track = read_track(out)
            except InputError as error:
                text = str(error).replace(str(out), "{out}")
                raise ProgramError(f"{program.name} wrote no trajectory: {text}") from error
        if why := explain_mismatch(track.stamps, [frame.stamp for frame in self._frames]):
            raise ProgramError(f"{program.name} wrote no trajectory of this log: {{out}} {why}")
        return Estimate(track.stamps, track.means, track.covariances, self.kind)

    def _written(self, folder: Path) -> dict[str, str]:
        """Write the files that the command names; return all names."""
        recording = recording_of(self._frames, self._prior)
        files: dict[str, tuple[str, Callable[[Path], object]]] = {
            "log": ("log.log", lambda path: write_carmen(path, recording)),
            "mcap": ("log.mcap", lambda path: write_bag(path, recording)),
            "npz": ("log.npz", lambda path: save(recording, path)),
            "map": self._map_file(),
            "grid": ("grid.yaml", lambda path: write_grid(self._grid(), path)),
            "start": ("start.txt", lambda path: write_text(path, start_text(self._prior))),
        }
        places = {"seed": str(self._seed), "out": str(folder / f"out.{self.output}")}
        for key in self.places & set(files):
            name, write = files[key]
            write(folder / name)
            places[key] = str(folder / name)
        return places

    def _grid(self) -> OccupancyGrid:
        """The known map as free, occupied and unknown cells, which every map server reads."""
        known_map = self._prior.map
        if isinstance(known_map, World):
            return rasterize(known_map, _CELL_M, self._laser.mount.z_m)
        return cast(OccupancyGrid, known_map)

    def _map_file(self) -> tuple[str, Callable[[Path], object]]:
        known_map = self._prior.map
        if isinstance(known_map, OccupancyGrid):
            return "map.yaml", lambda path: write_grid(known_map, path, "raw")

        def write(path: Path) -> None:
            message = map_message(known_map)
            text = orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_INDENT_2)
            write_text(path, text.decode())

        return "map.json", write


def start_text(prior: Prior) -> str:
    """A line `x y heading` and the three rows of its covariance; empty if it is not known."""
    rows = [] if prior.start is None else [prior.start.mean, *prior.start.covariance]
    return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in rows)


def recording_of(frames: Sequence[Frame], prior: Prior) -> Recording:
    """Recording of what Frames show, with the geometry and the sensors that are believed."""
    stamps = np.array([frame.stamp for frame in frames])
    travel_m = np.cumsum([frame.wheel_increments_m for frame in frames], axis=0)
    logs = {}
    for name, sensor in prior.sensors.items():
        seen = [frame for frame in frames if name in frame.readings]
        if seen:
            readings = [frame.readings[name] for frame in seen]
            schema = {key: field for key, field in sensor.schema.items() if key in readings[0]}
            logs[name] = log_of_readings(schema, np.array([f.stamp for f in seen]), readings, name)
    wheels = WheelLog(stamps, travel_m)
    return Recording(stamps.copy(), wheels, prior.robot, prior.sensors, logs)
