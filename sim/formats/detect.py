"""Which format a file is in, and a Recording of it, whatever it is."""

from collections.abc import Callable, Sequence
from pathlib import Path

from sim.errors import InputError, naming, require
from sim.files import read_head
from sim.formats import carmen, khepera
from sim.formats.intel import read_intel
from sim.formats.lego import read_lego
from sim.formats.mrclam import read_mrclam
from sim.formats.rawseeds import read_rawseeds
from sim.formats.rosbag_in import read_bag
from sim.formats.text import read_bytes, read_members
from sim.formats.wean import read_wean
from sim.recording import Recording
from sim.recording_check import check_recording
from sim.team import Team, load

KINDS = ("recording", "rosbag", "mrclam", "carmen", "intel", "khepera", "lego", "rawseeds", "wean")
_HEAD_BYTES = 1 << 16


def kind_of(path: Path) -> str:
    """Format of a file or folder, by its contents.

    Raises
    ------
    InputError
        If it is none of `KINDS`.
    """
    if path.is_dir():
        return _kind_of_names([p.name for p in path.iterdir()], path)
    head = read_head(path)
    if head[:4] == b"PK\x03\x04":
        return "recording"
    if head[:13] == b"#ROSBAG V2.0\n" or head[:5] == b"\x89MCAP" or head[:15] == b"SQLite format 3":
        return "rosbag"
    data = read_bytes(path)
    if _is_archive(data):
        return _kind_of_names(list(read_members(path)), path)
    return _kind_of_text(data[:_HEAD_BYTES], path)


def _kind_of_names(names: Sequence[str], path: Path) -> str:
    if any(name.endswith(("_Odometry.dat", "_Odometry.dat.gz")) for name in names):
        return "mrclam"
    if "metadata.yaml" in names:
        return "rosbag"
    if any(name.endswith(".tuple") for name in names):
        return "khepera"
    raise InputError(f"{path}: holds no log of a known format ({', '.join(sorted(names)[:5])})")


def _kind_of_text(head: bytes, path: Path) -> str:
    lines = [line for line in head.split(b"\n") if line.strip() and not line.startswith(b"#")]
    first_words = {line.split()[0] for line in lines[:200]}
    if first_words & {b"FLASER", b"ROBOTLASER1", b"ODOM", b"VERTEX2"}:
        return "carmen"
    for kind, keywords in (("wean", {b"O", b"L"}), ("lego", {b"M"})):
        if first_words and first_words <= keywords:
            return kind
    if b'"sm"' in head and b'"phi_l"' in head:
        return "khepera"
    if head.lstrip()[:1] == b"{" and b'"map"' in head:
        return "intel"
    if lines and lines[0].count(b",") == 6:
        return "rawseeds"
    raise InputError(
        f"{path}: not a log of a known format; known: {', '.join(KINDS)} "
        "(see docs/formats.md); a map's .yaml is none: it is drawn over a recording"
    )


def read_all(paths: Sequence[Path], robot: int | None = None) -> Team:
    """A Team of what a log holds: of one robot, or of all those of a team's file.

    Parameters
    ----------
    paths
        The log. Some formats come in several files, in this order: Intel (raw, corrected);
        Rawseeds (odometry, scans, ground truth); Lego (motors, scans, reference, cylinders).
    robot
        Which robot of an MRCLAM set, by default 1; or of a team's file, from 0 on.

    Raises
    ------
    InputError
        If the format is not known, a file is missing, or cannot be read.
    """
    first, kind = paths[0], kind_of(paths[0])
    _check_count(paths, kind)
    if kind == "recording":  # which is checked as it is loaded
        team = load(first)
        if robot is None or len(team) == 1:
            return team
        known = range(len(team))
        require(robot in known, f"{first}: its robots are 0 to {known[-1]}, got {robot}")
        return Team((team.robots[robot],))
    if kind == "mrclam":
        recording = read_mrclam(first, 1 if robot is None else robot)
    else:
        recording = _READERS[kind](*paths)
    with naming(first):
        check_recording(recording)
    return Team((recording,))


def read_any(paths: Sequence[Path], robot: int | None = None) -> Recording:
    """The recording of one robot, as `read_all` reads it; InputError if there are several."""
    team = read_all(paths, robot)
    with naming(paths[0]):
        return team.only


def _check_count(paths: Sequence[Path], kind: str) -> None:
    least, most = {"intel": (1, 2), "rawseeds": (2, 3), "lego": (2, 4)}.get(kind, (1, 1))
    wanted = f"{least} to {most} files" if most > 1 else "one file"
    require(least <= len(paths) <= most, f"{paths[0]}: a {kind} log is {wanted}, got {len(paths)}")


def _read_khepera(path: Path) -> Recording:
    """Recording of a file of tuples, or of the first of an archive or a folder."""
    member = None
    if path.is_dir() or _is_archive(read_bytes(path)):
        tuples = [name for name in read_members(path) if name.endswith(".tuple")]
        member = min(tuples, key=lambda name: (len(name), name))
    return khepera.to_recording(khepera.read_khepera(path, member))


_READERS: dict[str, Callable[..., Recording]] = {
    "rosbag": read_bag,
    "carmen": lambda path: carmen.to_recording(carmen.read_carmen(path)),
    "intel": read_intel,
    "khepera": _read_khepera,
    "lego": read_lego,
    "rawseeds": read_rawseeds,
    "wean": read_wean,
}


def _is_archive(data: bytes) -> bool:
    """Whether a file, unpacked, is a tar archive: this is where tar puts its name."""
    return data[257:262] == b"ustar"
