"""Files of the tracked Lego robot: motor ticks, scans, an overhead camera, cylinders.

M stamp_ms ticks_left .. (field 2) .. ticks_right (field 6) ..     absolute counts
S stamp_ms n r1 .. rn                                              mm
P stamp_ms x y                                                     mm, of the scanner
L C x y diameter                                                   mm
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.arrays import Array
from sim.formats import assemble
from sim.formats.text import Words, read_words
from sim.recording import Recording, Truth, WheelLog
from sim.robot.drive import RobotGeometry
from sim.sensors import Mount
from sim.worlds.world import World

# The lecture's constants: geometric width of the tracks, effective one, length of a tick, the
# scanner ahead of the axle, and the angles of its beams
GEOMETRIC_TRACK_M, EFFECTIVE_TRACK_M, TICK_M = 0.155, 0.173, 0.000349
SCANNER_AHEAD_M = 0.030
_BEAM_STEP_RAD, _BEAM_OFFSET_RAD, _MIDDLE_BEAM = 0.006135923151543, -0.06981317007977318, 330
_WHEEL_RADIUS_M = 0.02
_MAX_RANGE_M = 10.0
_MOST_BEAMS = 10_000


@dataclass(frozen=True)
class TickLog:
    """Absolute ticks: stamps (N,) s, counts (N, 2) of the right and left track."""

    stamps: Array
    ticks: Array


def parse_motors(words: Words) -> TickLog:
    """Ticks of the M lines.

    Raises
    ------
    InputError
        Naming the file and the line.
    """
    lines = words.lines_of("M")
    assemble.require_readings(len(lines), 2, words.where, "M lines")
    values = words.finite(lines, 1, 6, "an M line")
    stamps = values[:, 0] / 1000.0
    assemble.require_clock(stamps, words.where, "M lines")
    rows = assemble.in_order(stamps, "motors", {})
    assemble.require_readings(len(rows), 2, words.where, "M lines with different stamps")
    return TickLog(stamps[rows], values[rows][:, [5, 1]])


def parse_scans(words: Words) -> tuple[Array, Array]:
    """Stamps (N,) s and ranges (N, n) m of the S lines."""
    lines = words.lines_of("S")
    assemble.require_readings(len(lines), 1, words.where, "S lines")
    counts = words.whole(lines, 2, "the number of beams", 1, _MOST_BEAMS)
    words.refuse(counts != counts[0], lines, "a scan of another size than the first")
    stamps = words.finite(lines, 1, 1, "an S line")[:, 0] / 1000.0
    ranges = words.numbers(lines, 3, int(counts[0]), "ranges") / 1000.0
    assemble.require_clock(stamps, words.where, "S lines")
    rows = assemble.in_order(stamps, "scans", {})
    return stamps[rows], ranges[rows]


def parse_reference(words: Words) -> tuple[Array, Array]:
    """Stamps (N,) s and positions (N, 2) m of the P lines."""
    lines = words.lines_of("P")
    assemble.require_readings(len(lines), 2, words.where, "P lines")
    values = words.finite(lines, 1, 3, "a P line")
    rows = assemble.in_order(values[:, 0] / 1000.0, "reference", {})
    return values[rows, 0] / 1000.0, values[rows, 1:] / 1000.0


def read_lego(
    motors: Path,
    scans: Path,
    reference: Path | None = None,
    cylinders: Path | None = None,
    *,
    tick_m: float = TICK_M,
    track_m: float = EFFECTIVE_TRACK_M,
) -> Recording:
    """A Recording of the robot.

    The overhead camera sees no heading. The truth gets the direction in which the scanner moves
    over half a second, held while it moves less than 2 cm: good for drawing and for errors of
    position, not for errors of heading. Its positions are moved from the scanner to the axle.
    """
    log = parse_motors(read_words(motors))
    wheels = WheelLog(log.stamps, (log.ticks - log.ticks[0]) * tick_m)
    stamps, ranges = parse_scans(read_words(scans))
    n_beams = ranges.shape[1]
    middle = (n_beams - 1) / 2.0 - _MIDDLE_BEAM
    mount = Mount(x_m=SCANNER_AHEAD_M, yaw_rad=middle * _BEAM_STEP_RAD + _BEAM_OFFSET_RAD)
    laser = assemble.scanner(5.0, n_beams, _BEAM_STEP_RAD, _MAX_RANGE_M, mount)
    truth = None
    if reference is not None:
        times, positions = parse_reference(read_words(reference))
        heading = _headings(times, positions)
        ahead = SCANNER_AHEAD_M * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        world = None
        if cylinders is not None:
            words = read_words(cylinders)
            middles = words.finite(words.lines_of("L"), 2, 3, "an L line") / 1000.0
            middles[:, 2] = 0.0  # the diameter
            world = World("arena", np.zeros((0, 4)), np.zeros((0, 2)), landmarks=middles)
        truth = Truth(times, np.column_stack([positions - ahead, heading]), world=world)
    robot = RobotGeometry(_WHEEL_RADIUS_M, track_m)
    return assemble.scan_recording(wheels, stamps, ranges, laser, truth, robot, {"source": "lego"})


def _headings(stamps: Array, positions: Array) -> Array:
    """Direction of motion (N,), rad, unwrapped; that of the reading before where it stands."""
    later = np.minimum(np.searchsorted(stamps, stamps + 0.25), len(stamps) - 1)
    before = np.maximum(np.searchsorted(stamps, stamps - 0.25) - 1, 0)
    off = positions[later] - positions[before]
    moved = np.hypot(*off.T) > 0.02
    direction = np.arctan2(off[:, 1], off[:, 0])
    if not moved.any():
        return np.zeros(len(stamps))
    last = np.maximum.accumulate(np.where(moved, np.arange(len(stamps)), -1))
    return np.unwrap(direction[np.where(last >= 0, last, np.argmax(moved))])
