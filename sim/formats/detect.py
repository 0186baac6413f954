"""Which format a file is in, and a Recording of it, whatever it is."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sim.errors import InputError, naming, require
from sim.files import read_head
from sim.formats import carmen, khepera
from sim.formats.intel import N_THINNED_BEAMS, read_intel, read_thinned_intel
from sim.formats.lego import read_lego
from sim.formats.mrclam import read_mrclam, robots_in
from sim.formats.rawseeds import read_rawseeds
from sim.formats.rosbag_in import read_bag
from sim.formats.text import read_bytes, read_members
from sim.formats.wean import read_wean
from sim.recording import Recording
from sim.recording_check import check_recording
from sim.team import Team, load

_HEAD_BYTES = 1 << 16


@dataclass(frozen=True)
class LogFormat:
    """How a log format is recognised and read.

    Attributes
    ----------
    name
        What `kind_of` calls it.
    read
        Reads its files into a Recording.
    begins
        First bytes of its files.
    has_name
        Whether a name belongs to a file of its folders and archives.
    has_text
        Whether a text has this format, by all of it, and its first lines without comments.
    n_files
        Least and greatest number of files that a log comes in.
    """

    name: str
    read: Callable[..., Recording]
    begins: tuple[bytes, ...] = ()
    has_name: Callable[[str], bool] = lambda _: False
    has_text: Callable[[bytes, Sequence[bytes]], bool] = lambda *_: False
    n_files: tuple[int, int] = (1, 1)


def _read_khepera(path: Path) -> Recording:
    """Recording of a file of tuples, or of the first of an archive or a folder."""
    member = None
    if path.is_dir() or _is_archive(read_bytes(path)):
        tuples = [name for name in read_members(path) if name.endswith(".tuple")]
        member = min(tuples, key=lambda name: (len(name), name))
    return khepera.to_recording(khepera.read_khepera(path, member))


def _first_words(lines: Sequence[bytes]) -> set[bytes]:
    return {line.split()[0] for line in lines[:200]}


_CARMEN = re.compile(rb"^[ \t]*(FLASER|ROBOTLASER1|ODOM|VERTEX2)\s", re.MULTILINE)
# In the order in which they are tried
FORMATS = (
    LogFormat(
        "mrclam",
        read_mrclam,
        has_name=lambda name: name.endswith(("_Odometry.dat", "_Odometry.dat.gz")),
    ),
    LogFormat(
        "rosbag",
        read_bag,
        begins=(b"#ROSBAG V2.0\n", b"\x89MCAP", b"SQLite format 3"),
        has_name=lambda name: name == "metadata.yaml",
    ),
    LogFormat(
        "carmen",
        lambda path: carmen.to_recording(carmen.read_carmen(path)),
        has_text=lambda data, _: _CARMEN.search(data) is not None,
    ),
    LogFormat(
        "wean",
        read_wean,
        has_text=lambda _, lines: bool(lines) and _first_words(lines) <= {b"O", b"L"},
    ),
    LogFormat(
        "lego",
        read_lego,
        has_text=lambda _, lines: bool(lines) and _first_words(lines) <= {b"M"},
        n_files=(2, 4),
    ),
    LogFormat(
        "khepera",
        _read_khepera,
        has_name=lambda name: name.endswith(".tuple"),
        has_text=lambda data, _: b'"sm"' in data and b'"phi_l"' in data,
    ),
    LogFormat(
        "intel",
        read_intel,
        has_text=lambda data, _: data[:64].lstrip()[:1] == b"{" and b'"map"' in data,
        n_files=(1, 2),
    ),
    LogFormat(
        "intel (thinned)",
        lambda *paths: read_thinned_intel(*paths)[0],
        has_text=lambda _, lines: bool(lines) and len(lines[0].split()) == N_THINNED_BEAMS,
        n_files=(3, 3),
    ),
    LogFormat(
        "rawseeds",
        read_rawseeds,
        has_text=lambda _, lines: bool(lines) and lines[0].count(b",") == 6,
        n_files=(2, 3),
    ),
)


def kind_of(path: Path) -> str:
    """Format of a file or folder by its contents: recording, or the name of one of `FORMATS`.

    Raises
    ------
    InputError
        If it is none of them.
    """
    return "recording" if _is_recording(path) else _format_of(path).name


def _is_recording(path: Path) -> bool:
    return not path.is_dir() and read_head(path)[:4] == b"PK\x03\x04"


def _format_of(path: Path) -> LogFormat:
    if path.is_dir():
        return _format_of_names([p.name for p in path.iterdir()], path)
    head = read_head(path)
    for each in FORMATS:
        if each.begins and head.startswith(each.begins):
            return each
    data = read_bytes(path)
    if _is_archive(data):
        return _format_of_names(list(read_members(path)), path)
    first = data[:_HEAD_BYTES].split(b"\n")
    lines = [line for line in first if line.strip() and not line.startswith(b"#")]
    for each in FORMATS:
        if each.has_text(data, lines):
            return each
    known = ", ".join(each.name for each in FORMATS)
    raise InputError(
        f"{path}: not a log of a known format; known: recording, {known} "
        "(see docs/formats.md); a map's .yaml is none: it is drawn over a recording"
    )


def _format_of_names(names: Sequence[str], path: Path) -> LogFormat:
    for each in FORMATS:
        if any(map(each.has_name, names)):
            return each
    raise InputError(f"{path}: holds no log of a known format ({', '.join(sorted(names)[:5])})")


def read_all(paths: Sequence[Path], robot: int | None = None) -> Team:
    """A Team of what a log holds: of one robot, or of all those of a team's file.

    Parameters
    ----------
    paths
        The log. Some formats come in several files, in this order: Intel (raw, corrected; or
        thinned: scans, odometry, matches);
        Rawseeds (odometry, scans, ground truth); Lego (motors, scans, reference, cylinders).
    robot
        Which robot of an MRCLAM set, by default 1; or of a team's file, from 0 on.

    Raises
    ------
    InputError
        If the format is not known, a file is missing, or cannot be read.
    """
    first = paths[0]
    if _is_recording(first):  # which is checked as it is loaded
        require(len(paths) == 1, f"{first}: a recording is one file, got {len(paths)}")
        team = load(first)
        if robot is None:
            return team
        known = range(len(team))
        require(robot in known, f"{first}: its robots are 0 to {known[-1]}, got {robot}")
        return Team((team.robots[robot],))
    log = _format_of(first)
    least, most = log.n_files
    several = f"{least}" if least == most else f"{least} to {most}"
    wanted = f"{several} files" if most > 1 else "one file"
    require(least <= len(paths) <= most, f"{first}: a {log.name} log is {wanted}, got {len(paths)}")
    require(len(set(paths)) == len(paths), f"{first}: named twice; its files differ")
    require(
        robot is None or log.read is read_mrclam,
        f"{first}: {log.name} logs hold one robot; leave out --robot",
    )
    of_robot = {"robot": robot} if robot is not None else {}
    recording = log.read(*paths, **of_robot)
    with naming(first):
        check_recording(recording)
    return Team((recording,))


def read_any(paths: Sequence[Path], robot: int | None = None) -> Recording:
    """The recording of one robot, as `read_all` reads it; InputError if there are several."""
    team = read_all(paths, robot)
    with naming(paths[0]):
        return team.only


def describe_choice(path: Path, recording: Recording, *, by_flag: bool) -> str:
    """Say which robot of a set was read where nobody named one; empty if the log holds only one.

    Parameters
    ----------
    by_flag
        Whether the command has a --robot to name another; else a recording of it does.
    """
    if recording.config.get("source") != "mrclam" or _is_recording(path):
        return ""
    robots = robots_in(read_members(path))
    if len(robots) < 2:
        return ""
    remedy = "--robot N takes another"
    if not by_flag:
        remedy = f"for another, name what `estima convert {path} --robot N -o robotN.npz` writes"
    return (
        f"{path.name} holds robots {robots[0]} to {robots[-1]}; robot "
        f"{recording.config['robot']} is taken: {remedy}"
    )


def _is_archive(data: bytes) -> bool:
    """Whether a file, unpacked, is a tar archive: this is where tar puts its name."""
    return data[257:262] == b"ustar"
