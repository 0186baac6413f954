"""From what logs hold to Recordings: order, gaps, wheels without encoders, instants for Frames.

The rules for all readers:

* Readings are sorted by their stamps; of readings with the same stamp the last one counts. The
  Recording's configuration notes how many were out of order or duplicates.
* Wheel travel between two stamps is taken to be even (linear interpolation).
* A velocity holds from its stamp to the next one, but no longer than `LONGEST_HOLD_S`: what a
  robot did in a gap of the log is unknown, and the wheels are taken to stand.
* Frames are at the stamps of the sensors that see the world, within the wheels' span; where
  these are farther apart than `LONGEST_FRAME_S`, wheel stamps are put between, so that a turn is
  not drawn into one arc.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sim import se2
from sim.arrays import Array, ArrayLike, Floats, Ints
from sim.errors import InputError, require
from sim.recording import Log, Recording, Truth, WheelLog
from sim.robot.arc import arc_increment
from sim.robot.drive import RobotGeometry
from sim.sensors import Encoder, Laser, Mount

Rows = Ints
Notes = dict[str, Any]

LONGEST_HOLD_S = 1.5
LONGEST_FRAME_S = 0.2
# What stands for nothing seen: so many readings at least, this share of all, and so many times
# those of any value around it; codes lie this near one another (SICK: 81.83 to 81.91 m)
_FEWEST_SPIKED, _SHARE_SPIKED, _SPIKE = 20, 5e-4, 5.0
_CODES, _AROUND, _LEAST_SPIKE_MM = 0.0015, 0.05, 2000.0


def in_order(stamps: Array, name: str, notes: Notes) -> Rows:
    """Rows of the readings in strictly increasing order of their stamps.

    Parameters
    ----------
    stamps
        (N,) s, as logged.
    name
        What the readings are, for the notes.
    notes
        Takes `<name>_backward` and `<name>_repeated` (readings moved and dropped) and
        `<name>_longest_gap_s`.
    """
    rows: Rows = np.argsort(stamps, kind="stable").astype(np.int64)
    ordered = stamps[rows]
    last_of_equal = np.append(ordered[1:] > ordered[:-1], True)[: len(rows)]
    if backward := int(np.sum(np.diff(stamps) < 0.0)):
        notes[f"{name}_backward"] = backward
    if repeated := int(np.sum(~last_of_equal)):
        notes[f"{name}_repeated"] = repeated
    rows = rows[last_of_equal]
    if len(rows) > 1:
        notes[f"{name}_longest_gap_s"] = round(float(np.max(np.diff(stamps[rows]))), 6)
    return rows


def require_clock(stamps: Array, where: str, what: str) -> None:
    """Refuse readings (N,) most of whose stamps are those of others: they have no usable clock.

    Raises
    ------
    InputError
        If less than half of them have a stamp of their own.
    """
    different = len(np.unique(stamps))
    if 2 * different >= len(stamps):
        return
    zero = different == 1 and stamps[0] == 0.0
    how = "are missing (all 0)" if zero else "are too coarse, such as 1.13486e+09 for every one"
    raise InputError(
        f"{where}: {len(stamps)} {what} have {different} different stamps: the stamps {how}; write "
        "them in seconds with at least three decimals"
    )


def wheels_from_poses(stamps: Array, poses: Array, track_m: float, notes: Notes) -> WheelLog:
    """Wheels (right, left) that drive the robot from pose to pose, (N, 3).

    Between close poses it drives the arc; its small sideways part, which wheels
    cannot make, is dropped. Between poses farther apart in time than a Frame, a motion to the
    side of more than 2 % shows that it was no arc: the robot then turns, drives straight and turns
    again, a third of the time each, which takes it exactly there. How many such motions there
    are, and the share of sideways motion dropped, are noted.
    """
    motion = se2.between(poses[:-1], poses[1:])
    twist = se2.log(motion)
    sideways = np.abs(twist[:, 1])
    in_legs = (sideways > 0.02 * np.abs(twist[:, 0])) & (sideways > 1e-3)
    in_legs &= np.diff(stamps) > LONGEST_FRAME_S
    forward, turn = [np.zeros((len(motion), 3)) for _ in (0, 1)]  # by thirds of the time
    forward[:], turn[:] = twist[:, :1] / 3.0, twist[:, 2:] / 3.0
    x, y, heading = motion[in_legs].T
    backwards = x < 0.0
    towards = np.arctan2(np.where(backwards, -y, y), np.abs(x))
    drive = np.where(backwards, -1.0, 1.0) * np.hypot(x, y)
    forward[in_legs, :] = drive[:, None] * [0.0, 1.0, 0.0]
    turn[in_legs] = np.stack([towards, 0.0 * drive, se2.wrap(heading - towards)], axis=1)
    kept = np.ones((len(motion), 3), bool)
    kept[~in_legs, :2] = False  # an arc needs no stamps between
    thirds = np.stack([forward + turn * track_m / 2.0, forward - turn * track_m / 2.0], axis=-1)
    travel = np.cumsum(thirds.reshape(-1, 2), axis=0)[kept.ravel()]
    times = stamps[:-1, None] + np.diff(stamps)[:, None] * np.array([1.0, 2.0, 3.0]) / 3.0
    times[:, 2] = stamps[1:]
    if in_legs.any():
        notes["motions_in_legs"] = int(np.sum(in_legs))
    travelled = float(np.sum(np.abs(twist[:, 0])))
    if travelled > 0.0:
        notes["sideways_share"] = round(float(np.sum(sideways[~in_legs])) / travelled, 6)
    return WheelLog(
        np.concatenate([stamps[:1], times.ravel()[kept.ravel()]]),
        np.concatenate([np.zeros((1, 2)), travel]),
    )


def wheels_from_velocities(
    stamps: Array, velocity: Array, track_m: float, longest_hold_s: float = LONGEST_HOLD_S
) -> WheelLog:
    """Wheels from body velocities (N, 2), m/s and rad/s, each held to the next stamp."""
    gaps = np.diff(stamps)
    lasts = np.minimum(gaps, longest_hold_s)[:, None]
    turn = velocity[:-1, 1:] * track_m / 2.0
    steps = np.concatenate([velocity[:-1, :1] + turn, velocity[:-1, :1] - turn], axis=1) * lasts
    travel = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    late = np.flatnonzero(gaps > longest_hold_s)
    if not len(late):
        return WheelLog(stamps, travel)
    # a reading at the end of each hold, so that interpolation does not spread it over the gap
    ends = stamps[late] + longest_hold_s
    return WheelLog(
        np.insert(stamps, late + 1, ends), np.insert(travel, late + 1, travel[late + 1], axis=0)
    )


def chain_motions(steps: Array) -> Array:
    """Poses (N + 1, 3) from the origin on by relative motions (N, 3); headings wrapped."""
    poses = se2.chain(steps)
    poses[:, 2] = se2.wrap(poses[:, 2])
    return poses


def pose_by_wheels(wheels: WheelLog, track_m: float) -> Array:
    """Poses (N, 3) from the origin on by the wheels' travel; headings wrapped."""
    return chain_motions(arc_increment(np.diff(wheels.position_m, axis=0), track_m))


def rate_hz(stamps: Array) -> float:
    """Median rate of stamps (N,) s, strictly increasing; 1 Hz for a single one."""
    return 1.0 / max(float(np.median(np.diff(stamps))), 1e-9) if len(stamps) > 1 else 1.0


def frame_stamps(
    wheel_stamps: Array, sensors: Sequence[Array], longest_s: float = LONGEST_FRAME_S
) -> Array:
    """Instants of the Frames: the sensors' stamps, and wheel stamps where those lie far apart."""
    begin, end = wheel_stamps[0], wheel_stamps[-1]
    seen = np.unique(np.concatenate([*sensors, [begin, end]]))
    seen = seen[(seen >= begin) & (seen <= end)]
    # of the wheel stamps in a wide gap, the last one in each cell of the allowed length
    after = np.searchsorted(seen, wheel_stamps, side="right") - 1
    cells = np.floor((wheel_stamps - seen[after]) / longest_s)
    room = seen[np.minimum(after + 1, len(seen) - 1)] - seen[after]
    last_in_cell = np.append((np.diff(cells) != 0.0) | (np.diff(after) != 0), True)
    filler = wheel_stamps[last_in_cell & (room > longest_s)]
    return np.unique(np.concatenate([seen, filler]))


def scanner(
    rate_hz: float, n_beams: int, step_rad: float, max_range_m: float, mount: Mount
) -> Laser:
    """A planar laser; the yaw of its mount is that of the middle between its beams, rad."""
    return Laser(
        rate_hz=rate_hz,
        n_beams=n_beams,
        fov_rad=min(max(step_rad * (n_beams - 1), 1e-9), 2.0 * math.pi),
        max_range_m=max_range_m,
        mount=dataclasses.replace(mount, yaw_rad=math.remainder(mount.yaw_rad, 2.0 * math.pi)),
    )


def seen_ranges(raw_m: Array, max_range_m: float, notes: Notes) -> tuple[Floats, float]:
    """Ranges with +inf where nothing was seen, and the greatest range that the sensor measures.

    Nothing was seen at zero or less, at what is not a number, at the maximum or beyond, and at
    what the sensor writes instead: a value of which the log holds far more than of those around it.

    Parameters
    ----------
    raw_m
        (M, n) m, as logged.
    max_range_m
        By the format or the log's header.
    notes
        Takes `no_return`: what was written for nothing seen, and the share of the beams.
    """
    written = {"zero or less": raw_m <= 0.0, "NaN": np.isnan(raw_m), "inf": np.isposinf(raw_m)}
    raw_m = np.where(np.isfinite(raw_m) & (raw_m > 0.0), raw_m, np.inf)
    for spike_m, beyond in _spikes(raw_m):
        near = raw_m >= (1.0 - _CODES) * spike_m if beyond else _in_mm(raw_m) == _in_mm(spike_m)
        written[f"{spike_m:g} m{' and beyond' if beyond else ''}"] = near
        raw_m = np.where(near, np.inf, raw_m)
        max_range_m = min(max_range_m, spike_m) if beyond else max_range_m
    beyond_all = np.isfinite(raw_m) & (raw_m >= max_range_m)
    written.setdefault(f"{max_range_m:g} m and beyond", beyond_all)
    shares = ((name, 100.0 * float(np.mean(rows))) for name, rows in written.items() if rows.any())
    if said := ", ".join(f"{name} ({share:.2g} % of beams)" for name, share in shares):
        notes["no_return"] = said
    return np.where(raw_m < max_range_m, raw_m, np.inf).astype(np.float32), max_range_m


def _in_mm(range_m: ArrayLike) -> Array:
    return np.round(1e3 * np.asarray(range_m))


def _spikes(ranges_m: Array) -> list[tuple[float, bool]]:
    """Values, m, greatest first, that ranges (M, n) have far too often; and if all beyond count.

    A wall is spread over neighbouring values by noise, and seen by few beams for long; what
    stands for nothing seen is one value, or a few codes next to each other. If next to nothing
    lies beyond it, it is the sensor's maximum; else it must come from many beams.
    """
    in_mm, found = _in_mm(ranges_m), []
    values, counts = np.unique(in_mm[np.isfinite(in_mm)], return_counts=True)
    often = counts >= max(_FEWEST_SPIKED, _SHARE_SPIKED * counts.sum())
    for i in np.flatnonzero(often & (values >= _LEAST_SPIKE_MM))[::-1].tolist():
        off = np.abs(values / values[i] - 1.0)
        around = counts[(off > _CODES) & (off < _AROUND)].max(initial=0)
        if counts[i] < max(_SPIKE * around, 1):
            continue
        n_beams, n_spiked = in_mm.shape[1], int(np.sum((in_mm == values[i]).any(axis=0)))
        beyond = counts[values > (1.0 + _CODES) * values[i]].sum() <= 0.1 * counts[i]
        if n_spiked >= min(n_beams, 3) and (beyond or n_spiked >= n_beams / 8):
            found.append((float(values[i]) / 1e3, bool(beyond)))
            counts = np.where((off <= _CODES) | (beyond & (values > values[i])), 0, counts)
    return found


def scan_recording(
    wheels: WheelLog,
    scan_stamps: Array,
    ranges_m: Array,
    laser: Laser,
    truth: Truth | None,
    robot: RobotGeometry,
    config: Notes,
) -> Recording:
    """A Recording of wheels and one laser; of its ranges, `seen_ranges` are kept."""
    notes = config.setdefault("notes", {})
    ranges, max_range_m = seen_ranges(ranges_m, laser.max_range_m, notes)
    laser = dataclasses.replace(laser, max_range_m=max_range_m)
    return Recording(
        frame_stamps=frame_stamps(wheels.stamps, [scan_stamps]),
        wheels=wheels,
        robot=robot,
        sensors={"encoder": Encoder(rate_hz=None), "laser": laser},
        logs={"laser": Log.of(laser, scan_stamps.copy(), ranges_m=ranges)},
        truth=truth,
        config=config,
    )


def require_readings(count: int, least: int, where: str, what: str) -> None:
    """Refuse a log with too little in it."""
    require(count >= least, f"{where}: {count} {what}; at least {least} are needed for a recording")
