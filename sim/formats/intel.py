"""The Intel Research Lab log as JSON: one scan and one pose a stamp, raw or corrected.

`{"map": {"<unix time>": {"range": [180 m], "x": m, "y": m, "theta": rad}}}`; the raw file's poses
are wheel odometry, the corrected one's, at the same stamps, are those of a mapper.
"""

import json
import math
from pathlib import Path

import numpy as np

from sim.arrays import Array
from sim.errors import InputError, require
from sim.formats import assemble
from sim.formats.carmen import NOMINAL_RADIUS_M, NOMINAL_TRACK_M, half_turn_step_rad
from sim.formats.text import json_number, read_bytes, read_words, reason_of
from sim.recording import Recording, Truth
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser, Mount

_NO_RETURN_M = 81.83  # what the log writes where nothing was seen
N_THINNED_BEAMS, _THINNED_MAX_RANGE_M = 180, 50.0


def parse_intel(data: bytes, where: str) -> tuple[Array, Array, Array]:
    """Stamps (N,) s, poses (N, 3) and ranges (N, n) m, as they stand in the file.

    Raises
    ------
    InputError
        Naming the file and the line (of the syntax) or the stamp that is wrong.
    """
    try:
        entries = json.loads(data)["map"].items()
    except json.JSONDecodeError as error:
        raise InputError(f"{where}:{error.lineno}: not JSON ({error.msg})") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f'{where}:1: no {{"map": {{stamp: scan}}}} in it ({reason_of(error)})'
        ) from None
    stamps, poses, ranges = [], [], []
    for stamp, entry in entries:
        try:
            stamps.append(json_number(float(stamp)))
            poses.append([json_number(entry[key]) for key in ("x", "y", "theta")])
            ranges.append([json_number(r) for r in entry["range"]])
            if len(ranges[-1]) != len(ranges[0]):
                raise ValueError(f"{len(ranges[-1])} beams, the first scan has {len(ranges[0])}")
        except (ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
            line = data[: max(data.find(json.dumps(stamp).encode()), 0)].count(b"\n") + 1
            raise InputError(
                f"{where}:{line}: the scan at {stamp[:40]} is wrong ({reason_of(error)})"
            ) from None
    shape = len(stamps), len(ranges[0]) if ranges else 0
    return (
        np.array(stamps, float),
        np.array(poses, float).reshape(-1, 3),
        np.array(ranges, float).reshape(shape),
    )


def read_intel(
    raw: Path,
    reference: Path | None = None,
    *,
    track_m: float = NOMINAL_TRACK_M,
    wheel_radius_m: float = NOMINAL_RADIUS_M,
) -> Recording:
    """A Recording of the raw file; the corrected file's poses, if given, are its truth.

    Beams start at -90 degrees and are `half_turn_step_rad` apart: a degree for 180 or 181 of them.
    """
    where = str(raw)
    stamps, poses, ranges = parse_intel(read_bytes(raw), where)
    notes: assemble.Notes = {}
    rows = assemble.in_order(stamps, "scans", notes)
    assemble.require_readings(len(rows), 2, where, "scans")
    n_beams = ranges.shape[1]
    require(n_beams >= 2, f"{where}:1: scans of {n_beams} beams; at least 2 are needed")
    stamps, poses, ranges = stamps[rows], poses[rows], ranges[rows]
    truth = None
    if reference is not None:
        times, corrected, _ = parse_intel(read_bytes(reference), str(reference))
        order = assemble.in_order(times, "reference", {})
        truth = Truth(times[order], corrected[order])
    wheels = assemble.wheels_from_poses(stamps, poses, track_m, notes)
    return assemble.scan_recording(
        wheels,
        stamps,
        ranges,
        _scanner(assemble.rate_hz(stamps), n_beams, _NO_RETURN_M),
        truth,
        RobotGeometry(wheel_radius_m, track_m),
        {"source": "intel", "notes": notes},
    )


def read_thinned_intel(
    scans: Path,
    odometry: Path,
    matches: Path,
    *,
    track_m: float = NOMINAL_TRACK_M,
    wheel_radius_m: float = NOMINAL_RADIUS_M,
) -> tuple[Recording, Array]:
    """A denser thinning of the same drive: 2726 scans with odometry between, but without clock.

    Parameters
    ----------
    scans
        Ranges, one scan a line, m.
    odometry
        `dx dy dphi` from each scan to the next.
    matches
        CSV of scans that also stand in a log with a clock: scan number, source, number there,
        unix time, pose.

    Returns
    -------
    Recording
        With stamps of the matched scans; between them time is shared out by what the odometry
        says the robot did (0.5 m/s and 0.8 rad/s at full speed). Matches that would make it move
        more than three times as fast are dropped.
    Array
        (N,) numbers of the scans whose stamps are known.
    """
    where = str(scans)
    ranges = read_words(scans).table(N_THINNED_BEAMS, "scans")
    steps = read_words(odometry).table(3, "odometry")[: len(ranges) - 1]
    words = read_words(matches)
    lines = words.lines[1:]  # the first line names the columns
    numbers = words.whole(lines, 0, "the number of a scan", 0, len(ranges) - 1)
    times = words.finite(lines, 3, 1, "the time of a match")[:, 0]
    assemble.require_readings(min(len(ranges), len(steps) + 1, len(times)), 2, where, "scans")
    effort = np.hypot(steps[:, 0], steps[:, 1]) / 0.5 + np.abs(steps[:, 2]) / 0.8 + 1e-3
    busy_s = np.concatenate([[0.0], np.cumsum(effort)])
    ranges = ranges[: len(busy_s)]
    known: list[tuple[int, float]] = []
    for number, time in sorted(zip(numbers.tolist(), times.tolist(), strict=True)):
        before, then = known[-1] if known else (-1, -math.inf)
        if before < number < len(busy_s) and (
            time - then > 0.3 * (busy_s[number] - busy_s[before])
        ):
            known.append((number, time))
    rows, clock = np.array([k[0] for k in known]), np.array([k[1] for k in known])
    stamps = np.interp(busy_s, busy_s[rows], clock)
    stamps[: rows[0]] = clock[0] - (busy_s[rows[0]] - busy_s[: rows[0]])
    stamps[rows[-1] :] = clock[-1] + (busy_s[rows[-1] :] - busy_s[rows[-1]])
    notes: assemble.Notes = {"matches_left_out": len(numbers) - len(known)}
    wheels = assemble.wheels_from_poses(stamps, assemble.chain_motions(steps), track_m, notes)
    recording = assemble.scan_recording(
        wheels,
        stamps,
        ranges,
        _scanner(1.0, N_THINNED_BEAMS, _THINNED_MAX_RANGE_M),
        None,
        RobotGeometry(wheel_radius_m, track_m),
        {"source": "intel (thinned)", "notes": notes, "stamps_known": rows.tolist()},
    )
    return recording, rows.astype(np.int64)


def _scanner(rate_hz: float, n_beams: int, max_range_m: float) -> Laser:
    """A laser whose beams start at -90 degrees, `half_turn_step_rad` apart."""
    step = half_turn_step_rad(n_beams)
    mount = Mount(yaw_rad=(step * (n_beams - 1) - math.pi) / 2.0)
    return assemble.scanner(rate_hz, n_beams, step, max_range_m, mount)
