"""Damaged and hostile inputs for all that is read: each must end right, or in one clear line.

    python -m tests.attack            (or some kinds: rows tables)

An attack ends `right` if it gives what the undamaged input gives, `read` if the input is another
valid one, and `refused` if it raises one `InputError`, which the command line prints in one line of
printable characters and ends with code 2. Anything else (another exception, a wrong result, too
much time or memory) is a failure.
"""

import contextlib
import dataclasses
import gzip
import io
import json
import os
import resource
import signal
import struct
import sys
import tarfile
import tempfile
import time
import warnings
import zipfile
import zlib
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from matplotlib.figure import Figure
from PIL import Image

from estimators.base import run
from estimators.odometry import Odometry
from estimators.topological_map import load as load_topological
from estimators.topological_map import read_array
from estimators.topological_map import save as save_topological
from experiments.gate.suite import read_suite
from experiments.report.claims import COLUMNS, VERDICT_COLUMNS
from experiments.report.export import export
from experiments.report.page import write_report
from experiments.report.plot import sweep_figure
from experiments.runs import cache, store
from experiments.runs.console import end, show
from experiments.runs.experiment import Experiment, searched
from experiments.runs.row import write_rows
from experiments.sweeps.collect import collect
from experiments.sweeps.launch import sweep
from experiments.sweeps.summary import summary
from experiments.trajectories.odometry import read_odometry_csv, write_odometry_csv
from experiments.viewing.describe import describe
from sim import recording as recordings
from sim.errors import InputError, printable
from sim.formats.detect import read_any
from sim.formats.text import read_bytes
from sim.grid import OccupancyGrid
from sim.grid_file import read_grid, write_grid
from sim.world_file import read_world
from tests import fakes, fuzz_formats
from tests.test_store import row

LONGEST_S = 20.0
MOST_MEMORY = 3 << 30  # bytes above what the process has at the start
EVIL = "\x1b[31m<meta http-equiv='refresh' content='0'>\r\n::error::<script>x</script>\u202e"
EVIL_CELLS = [
    EVIL,
    "",
    "nan",
    "1e999",
    "\x00",
    "=cmd()",
    "9" * 400,
    "[" * 400,
    "\ufeff",
    "-1",
    "NA",
]


class TooLongError(BaseException):
    """An input that a reader does not come to the end of."""


class Attack:
    """Counts how attacks end, by kind; `failures` holds what must not be."""

    def __init__(self):
        self.counts, self.failures, self.seconds = Counter(), [], {}

    def __call__(self, kind, name, call, right=None, refuse=False):
        """Attack.

        Parameters
        ----------
        right
            What an undamaged input gives; where it is given, nothing else may come out.
        refuse
            Whether the input must be refused.
        """
        out, err, begun = io.StringIO(), io.StringIO(), time.perf_counter()
        signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
        failure = None
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                found = call()
            verdict = "read" if right is None else "right"
            if refuse or (right is not None and found != right):
                failure = f"came through with {found!r:.200}"
        except (Exception, TooLongError) as error:
            verdict, failure = "refused", complaint(error)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        seconds = time.perf_counter() - begun
        shown = out.getvalue() + err.getvalue()
        if failure is None and not all(c == "\n" or printable(c) == c for c in shown):
            failure = f"printed {shown!r:.300}"
        if failure is None and "Traceback" in shown:
            failure = f"printed a traceback: {shown[-300:]!r}"
        if failure is not None:
            verdict = "FAILED"
            self.failures.append(f"{kind}, {name} ({seconds:.1f} s): {failure}")
        self.counts[kind, verdict] += 1


def complaint(error):
    """What is wrong with how the command line shows an error; None if nothing is."""
    shown = io.StringIO()
    try:
        with contextlib.redirect_stderr(shown):
            end(error)
    except SystemExit as ended:
        line = shown.getvalue()
        if ended.code == 2 and line.count("\n") == 1 and len(line) > 20 and len(line) < 2100:
            return None if printable(line[:-1]) == line[:-1] else f"unprintable: {line!r}"
        return f"code {ended.code}: {error!r:.200} {line[-300:]!r}"


def damaged(content, rng, n):
    """Bytes with some cut off, or flipped, or put in; and none at all."""
    yield b""
    for _ in range(n):
        at = int(rng.integers(len(content)))
        yield content[:at]
        yield content[:at] + bytes([content[at] ^ (1 << int(rng.integers(8)))]) + content[at + 1 :]
        yield content[:at] + rng.bytes(20) + content[at:]


def not_files(folder, suffix):
    """Paths at which no reader may wait or read for ever."""
    folder.mkdir()
    os.mkfifo(folder / f"fifo{suffix}")
    (folder / f"folder{suffix}").mkdir()
    (folder / f"device{suffix}").symlink_to("/dev/zero")
    (folder / f"loop{suffix}").symlink_to(folder / f"loop{suffix}")
    (folder / f"nothing{suffix}").symlink_to(folder / "missing")
    return sorted(folder.iterdir())


# Recordings


def sound_recording():
    recording = fakes.circle(n_frames=4, n_beams=5)
    commands = recordings.CommandLog(recording.frame_stamps, np.zeros((4, 2)))
    return dataclasses.replace(recording, commands=commands)


def forged(path, arrays, meta):
    """Write a recording with a checksum that fits, whatever it holds."""
    arrays = {name: np.asarray(values) for name, values in arrays.items()}
    try:
        meta = {**meta, "checksum": recordings.digest_of(arrays, meta)}
    except (TypeError, ValueError):
        meta = {**meta, "checksum": ""}
    packed = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    np.savez(path, meta=packed, **arrays)
    return path


def use(path):
    """Read a recording and do with it what the command line does."""
    recording = read_any([path])
    show(describe(recording))
    experiment = Experiment(_CONFIG)
    experiment._compare_slip(recording)
    estimate = run(
        Odometry(1e-5, 1e-5), recording, experiment.prior(recording), np.random.default_rng(0)
    )
    return recording.checksum, estimate.means.tolist()


def attack_recordings(attack, folder, rng):
    sound = sound_recording()
    arrays, meta = recordings.arrays_of(sound), recordings.described(sound)
    with contextlib.redirect_stdout(io.StringIO()):
        right = use(forged(folder / "sound.npz", arrays, meta))
    for name, values in arrays.items():
        whole = values.dtype.kind in "iu"
        wrong = {
            "missing": None,
            "of text": values.astype("U"),
            "of another type": values.astype(np.float16 if not whole else np.float64),
            "too short": values[:-1],
            "too deep": values[..., None],
            "a number": np.zeros((), values.dtype),
            "complex": values.astype(complex),
        }
        if name.endswith("stamps"):
            wrong["backward"] = values[::-1]
        if (
            values.size
            and not whole
            and not name.startswith(("logs", "world.descriptors", "world.look"))
        ):
            bad = values.copy()
            bad.flat[-1] = np.nan
            wrong["not finite"] = bad
        for what, changed in wrong.items():
            if np.array_equal(np.asarray(changed), values) and changed is not None:
                continue  # of an empty array
            others = {k: v for k, v in arrays.items() if k != name}
            others |= {} if changed is None else {name: changed}
            path = forged(folder / "a.npz", others, meta)
            optional = name.startswith("world.") and what in ("missing", "of another type")
            optional |= (name, what) == ("frame_stamps", "too short")
            optional |= name in ("world.waypoints", "world.landmarks") and what == "too short"
            attack("recordings", f"{name} {what}", lambda p=path: use(p), refuse=not optional)
    path = forged(folder / "a.npz", {**arrays, "logs.radar.power": np.zeros(3)}, meta)
    attack("recordings", "an array more", lambda: use(path), refuse=True)
    for key in meta:
        for value in (None, 3, EVIL, [], {}, [[]], {"a": {"b": 1}}, True, float("nan")):
            path = forged(folder / "a.npz", arrays, {**meta, key: value})
            attack("recordings", f"{key}={value!r}", lambda p=path: use(p))
    deep = json.loads("[" * 900 + "]" * 900)
    sensor = meta["sensors"]["laser"]
    for what, changes in {
        "code of its choice": {"sensors": {"laser": {"_target_": "os.system", "command": "x"}}},
        "a module of ours": {"sensors": {"laser": {"_target_": "sim.sensors.base.find"}}},
        "too many beams": {"sensors": {**meta["sensors"], "laser": {**sensor, "n_beams": 10**12}}},
        "other beams": {"sensors": {**meta["sensors"], "laser": {**sensor, "n_beams": 721}}},
        "deep settings": {"sensors": {"laser": deep}},
        "deep configuration": {"config": {"robot": deep}},
        "slip of text": {"config": {"robot": {"kr": "much", "kl": "1"}}},
        "slip of lists": {"config": {"robot": {"kr": [1], "kl": None}}},
        "notes of text": {"config": {"source": EVIL, "notes": EVIL}},
        "evil notes": {"config": {"source": EVIL, "notes": {EVIL: EVIL}, "seed": EVIL}},
        "a schema of objects": {"schemas": {"laser": {"ranges_m": {"dtype": "O", "shape": []}}}},
        "a negative shape": {"schemas": {"laser": {"ranges_m": {"dtype": "f4", "shape": [-5]}}}},
        "an evil field": {"schemas": {"laser": {EVIL: {"dtype": "f4", "shape": [5]}}}},
    }.items():
        path = forged(folder / "a.npz", arrays, {**meta, **changes})
        attack("recordings", what, lambda p=path: use(p))
    content = (folder / "sound.npz").read_bytes()
    for i, data in enumerate(damaged(content, rng, 12)):
        path = folder / "damaged.npz"
        path.write_bytes(data)
        attack("recordings", f"damage {i}", lambda p=path: use(p), right)
    for path in not_files(folder / "odd", ".npz"):
        attack("recordings", path.name, lambda p=path: use(p), refuse=True)
    for what, data in archives(folder, content):
        (folder / "zip.npz").write_bytes(data)
        attack("recordings", what, lambda: use(folder / "zip.npz"), refuse=True)


def archives(folder, content):
    """Archives that promise more than they hold, or are no archive of arrays."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**11,)}
    )
    for what, name, data in (
        ("a long array", "frame_stamps.npy", header.getvalue()),
        ("no array", "meta.npy", b"nonsense"),
        ("a member elsewhere", "../../elsewhere.npy", b"nonsense"),
    ):
        with zipfile.ZipFile(folder / "b.zip", "w") as archive:
            archive.writestr(name, data)
        yield what, (folder / "b.zip").read_bytes()
    with zipfile.ZipFile(folder / "b.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.npy", bytes(1 << 20))
    packed = (folder / "b.zip").read_bytes()
    place = packed.rindex(b"PK\x01\x02")
    for what, at, value in (
        ("a bomb", 24, struct.pack("<I", 3 << 30)),
        ("an encrypted member", 8, b"\x01\x00"),
        ("an unknown packing", 10, b"\x63\x00"),
        ("a member outside", 42, struct.pack("<I", 1 << 30)),
    ):
        yield what, packed[: place + at] + value + packed[place + at + len(value) :]
    twice = io.BytesIO(content)
    with warnings.catch_warnings(), zipfile.ZipFile(twice, "a") as archive:
        warnings.simplefilter("ignore")  # of the name that is there twice
        archive.writestr("frame_stamps.npy", b"other")
    yield "an array twice", twice.getvalue()
    np.savez(folder / "objects.npz", meta=np.array([{}], dtype=object))
    yield "pickles", (folder / "objects.npz").read_bytes()


# Logs


def attack_logs(attack, folder, rng):
    texts, files = fuzz_formats.text_targets(), fuzz_formats.file_targets(folder)
    for name, (read, wholes) in texts.items():
        for i in range(4):
            data = fuzz_formats.mutate(wholes[i % len(wholes)], rng)
            attack("logs", f"{name} {i}", lambda r=read, d=data: str(r(d)))
    for name, (read, wholes) in files.items():
        for i in range(6):
            harm = fuzz_formats.flip if i % 2 else fuzz_formats.mutate
            data = harm(wholes[i % len(wholes)], rng)
            attack("logs", f"{name} {i}", lambda r=read, d=data: str(r(d)))
    for what, text in {"intel": b'{"map": ', "khepera": b'{"sm": "phi_l", "x": '}.items():
        (folder / "deep.log").write_bytes(text + b"[" * 100_000)
        attack("logs", f"{what} deep", lambda: read_any([folder / "deep.log"]), refuse=True)
    for path in not_files(folder / "odd", ".log"):
        attack("logs", path.name, lambda p=path: read_any([p]), refuse=True)
    bomb = gzip.compress(bytes(40 << 20), 9)
    (folder / "bomb.gz").write_bytes(bomb)
    attack("logs", "gzip", lambda: read_bytes(folder / "bomb.gz", 1 << 20), refuse=True)
    for what, member in sparse_members():
        (folder / "sparse.tar").write_bytes(member)
        attack("logs", what, lambda: read_any([folder / "sparse.tar"]), refuse=True)


def sparse_members():
    """GNU and PAX archives whose member is as long as it says, 20 GB, of holes."""
    member = tarfile.TarInfo("set/Robot1_Odometry.dat")
    member.type, member.size = tarfile.GNUTYPE_SPARSE, 512
    header = bytearray(member.tobuf(tarfile.GNU_FORMAT))
    header[386 : 386 + 24] = b"%011o\x00%011o\x00" % (0, 512)
    header[483 : 483 + 12] = b"\x80" + (20 << 30).to_bytes(11, "big")
    header[148:156] = b"%06o\x00 " % (sum(header[:148]) + 256 + sum(header[156:512]))
    yield "GNU sparse", bytes(header[:512]) + bytes(512 * 3)
    member = tarfile.TarInfo("set/Robot1_Odometry.dat")
    member.size = 512
    member.pax_headers = {"GNU.sparse.size": str(20 << 30), "GNU.sparse.map": "0,512"}
    yield "PAX sparse", member.tobuf(tarfile.PAX_FORMAT) + bytes(512 * 3)
    member = tarfile.TarInfo("set/Robot1_Odometry.dat")
    member.size = 20 << 30
    yield "long member", member.tobuf(tarfile.GNU_FORMAT) + bytes(512 * 3)


# YAML: worlds, maps, suites, options

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]\n" for i in range(9)
)
YAMLS = {
    "bomb": BOMB,
    "bomb in name": BOMB + "name: *a9\n",
    "deep": "name: " + "[" * 5000 + "]" * 5000,
    "deep mapping": "name: " + "{a: " * 5000 + "}" * 5000,
    "deep block": "\n".join(" " * i + "- " for i in range(3000)),
    "endless": "name: &a [*a]\n",
    "endless key": "name: &a {? *a : 1}\n",
    "merged": "a: &a {k: 1}\n" + "".join(f"b{i}: {{<<: *a}}\n" for i in range(3)),
    "code": "name: !!python/object/apply:os.system ['true']\n",
    "bad date": "name: 2001-99-99\n",
    "long number": "name: " + "9" * 5000 + "\n",
    "bad tags": "name: !!int x\n",
    "bad truth": "name: !!bool x\n",
    "bad float": "name: !!float ''\n",
    "bad set": "name: !!set [1]\n",
    "bad order": "name: !!omap [1]\n",
    "bad binary": "name: !!binary '*'\n",
    "two documents": "a: 1\n---\nb: 2\n",
    "tabs": "\tname: 1\n",
    "nothing": "",
    "a number": "3",
    "a list": "[1]",
    "evil": f"name: {json.dumps(EVIL)}\n",
    "evil key": f"{json.dumps(EVIL)}: 1\n",
    "escape": "name: \x1b[31m\n",
    "null": "null: null\n",
    "list as key": "? [1, 2]\n: 3\n",
    "unknown anchor": "name: *a\n",
    "text": "name",
    "not utf-8": b"name: \xff\xfe\x00",
    "zero": b"\x00",
    "utf-16": "name: a\n".encode("utf-16"),
}
WORLD = (
    "name: lab\nwalls: [[0, 0, 8, 0], {from: [8, 0], to: [8, 6]}]\nboxes:\n"
    "  - {x: 2, y: 3, length: 1.0, width: 0.5}\nlandmarks: [[1, 0.01, 1.2]]\n"
    "places: {room: [[0, 0, 8, 6]]}\nwaypoints: [[1, 1], [7, 1], [7, 5]]\n"
)


def attack_yaml(attack, kind, folder, read, sound, changes=()):
    """Attack a reader of YAML by documents, by keys put twice, and by changes of a sound one."""
    folder.mkdir(exist_ok=True)
    path = folder / "x.yaml"
    texts = dict(YAMLS)
    for line in sound.splitlines():
        if line[:1].isalpha():
            key = line.partition(":")[0]
            texts[f"{key} twice"] = f"{sound}\n{key}: {{}}\n"
            for value in ("null", "[]", "{}", "nan", "1e400", "x", "[[[]]]", json.dumps(EVIL)):
                kept = [other for other in yaml.safe_load(sound).items() if other[0] != key]
                texts[f"{key}: {value}"] = yaml.safe_dump(dict(kept)) + f"{key}: {value}\n"
    for name, text in {**texts, **dict(changes)}.items():
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        refuse = name.endswith(" twice") or name.startswith(("bomb", "deep", "endless"))
        attack(kind, name, lambda: read(path) and None, refuse=refuse)
    for odd in not_files(folder / "odd", ".yaml"):
        attack(kind, odd.name, lambda p=odd: read(p) and None, refuse=True)


def attack_maps(attack, folder, rng):
    grid = OccupancyGrid(np.float32(rng.integers(0, 2, (6, 8))), 0.1)
    write_grid(grid, folder / "map.yaml")
    sound, image = (folder / "map.yaml").read_text(), (folder / "map.pgm").read_bytes()
    images = {f"image {i}": data for i, data in enumerate(damaged(image, rng, 5))}
    images |= {
        "a huge image": b"P5\n1000000 1000000\n255\n",
        "a negative image": b"P5\n-3 -3\n255\n",
        "an image of depth": b"P5\n3 3\n99999999999\n" + bytes(9),
    }
    small = io.BytesIO()
    Image.new("L", (3, 3)).save(small, "PNG")
    png = bytearray(small.getvalue())
    png[16:24] = struct.pack(">II", 60000, 60000)
    images["a huge PNG"] = bytes(png)
    for name, data in images.items():
        (folder / "map.pgm").write_bytes(data)
        attack("maps", name, lambda: read_grid(folder / "map.yaml") and None)
    (folder / "map.pgm").write_bytes(image)
    elsewhere = {
        f"image {odd.name}": sound.replace("map.pgm", str(odd))
        for odd in not_files(folder / "images", ".pgm")
    }
    (folder / "y").mkdir()
    (folder / "y" / "map.pgm").write_bytes(image)
    attack_yaml(attack, "maps", folder / "y", read_grid, sound, elsewhere)
    _, prior = fakes.place_route()
    path = folder / "places.npz"
    save_topological(prior.map, path)
    content = path.read_bytes()
    right = known(load_topological(path))
    for i, data in enumerate(damaged(content, rng, 6)):
        path.write_bytes(data)
        attack("maps", f"places {i}", lambda: load_topological(path) and None)
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    for name, values in arrays.items():
        for what, changed in {"missing": None, "of text": values.astype("U"), "0": 0}.items():
            others = {k: v for k, v in arrays.items() if k != name}
            np.savez(path, **others, **({} if changed is None else {name: changed}))
            attack("maps", f"{name} {what}", lambda: known(load_topological(path)), right)
    for odd in not_files(folder / "arrays", ".npy"):
        attack("maps", f"array {odd.name}", lambda p=odd: read_array(p), refuse=True)


def known(topological):
    return topological.positions_m.tolist(), topological.descriptor


def attack_options(attack, folder, _):
    """Options of a folder, and overrides, as the command line takes them."""
    option = folder / "estimator" / "mine.yaml"
    option.parent.mkdir()

    def compose(*overrides):
        Experiment.compose([*searched(folder), *overrides]).check()

    sound = "_target_: estimators.odometry.Odometry\nkr: 1e-5\nkl: 1e-5\nwindow_s: 0.05\n"
    texts = {k: v for k, v in YAMLS.items() if k not in ("bomb", "deep block", "bad set")}
    texts |= {
        "twice": sound + "kr: 2e-5\n",
        "evil value": sound.replace("0.05", json.dumps(EVIL)),
        "deep value": sound.replace("0.05", "[" * 5000 + "]" * 5000),
        "a missing class": "_target_: nowhere.Nothing\n",
        "no class": "_target_: os.path\n",
        "an interpolation": sound.replace("0.05", "${nowhere}"),
        "a loop": sound.replace("0.05", "${estimator.window_s}"),
    }
    for name, text in texts.items():
        option.write_bytes(text if isinstance(text, bytes) else text.encode())
        attack("options", name, lambda: compose("estimator=mine"), refuse=True)
    option.unlink()
    for override in (
        "seed=-1", "seed=nan", "seed=" + "9" * 400, "seed=[" + "[" * 300, "repeats=1e9", "keep=3",
        "robot=null", "robot.kr=1e999", "robot.kr=[1]", "robot={}", "world=null", "sensors=[]",
        "world=from_file world.path=/dev/zero", "prior.map=/dev/zero.yaml", "prior.start=3",
        "prior.map={_target_: os.getcwd}", "recording=/dev/zero", "recording=''", "name=../../x",
        "sensors.laser.n_beams=1e12", "estimator.window_s=inf", "route=nowhere", "=", "a", "+x=1",
        "recording=" + "x" * 5000, f"name='{EVIL}'", "~robot", "simulation.rays=[]",
    ):  # fmt: skip
        given = ["sensors=lms291", *override.split(" ")]

        def go(given=given):
            compose(*given)
            raise InputError("a value that some run refuses, such as a name or a path")

        attack("options", override[:40], go, refuse=True)


# Caches, rows and sweeps


def attack_cache(attack, folder, rng):
    os.environ["ESTIMA_RESULTS"] = str(folder)
    make, right = sound_recording, sound_recording().checksum

    def fetch():
        return cache.cached("a", make).checksum

    fetch()
    path = cache.folder() / "a.npz"
    content = path.read_bytes()
    cache.cached("b", lambda: fakes.circle(seed=1, n_frames=4, n_beams=5))
    other = (cache.folder() / "b.npz").read_bytes()
    for i, data in enumerate([*damaged(content, rng, 10), other, content + b"more", b"text"]):
        path.write_bytes(data)
        attack("caches", f"damage {i}", fetch, right)
        attack("caches", f"after damage {i}", fetch, right)
    path.unlink()
    for name in ("a.npz", "a.lock"):
        place = cache.folder() / name
        for odd in not_files(folder / f"odd {name}", ".x"):
            place.unlink(missing_ok=True)
            place.symlink_to(odd)
            attack("caches", f"{name} {odd.name}", fetch, right)
            place.unlink(missing_ok=True)
        os.mkfifo(place) if name == "a.npz" else None
        attack("caches", f"{name} fifo itself", fetch, right)
        place.unlink(missing_ok=True)
        place.mkdir()
        attack("caches", f"{name} folder itself", fetch, right)
        place.rmdir()
    for mode in (0o555, 0o000, 0o755):
        cache.folder().chmod(mode)
        with without_rights():
            attack("caches", f"folder of mode {mode:o}", fetch, right)
    cache.folder().chmod(0o755)
    for kept in cache.folder().iterdir():
        kept.unlink()
    cache.folder().rmdir()
    cache.folder().write_text("a file")
    attack("caches", "a file in place of the folder", fetch, refuse=True)


@contextlib.contextmanager
def without_rights():
    """As a user who may not write everywhere; an ordinary user is one already."""
    rooted = os.geteuid() == 0
    os.seteuid(65534) if rooted else None
    try:
        yield
    finally:
        os.seteuid(0) if rooted else None


def attack_rows(attack, folder, rng):
    """Row files: what is damaged is found, and no row that is read is wrong."""
    rows = {f"{n:016x}": row(n, ate_rmse_m=n / 7, **({"x": 1} if n % 5 else {})) for n in range(20)}

    def fill():
        for file in folder.iterdir():
            file.rmdir() if file.is_dir() and not file.is_symlink() else file.unlink()
        with store.journal(folder / "rows-a.journal") as journal:
            for each in list(rows.values())[:10]:
                journal.begin(each["run_key"])
                journal.append([each])
        with store.journal(folder / "rows-b.journal") as journal:
            for each in list(rows.values())[10:]:
                journal.append([each])
        store.compact(folder / "rows-b.journal")
        return sorted(folder.iterdir())

    def read():
        """Whether every row that is read is right, and every run that counts as done is there."""
        dropped = []
        done = store.ended(folder, damaged=lambda path, _: dropped.append(path)).done.tolist()
        for path in dropped:
            if store.is_own(path):
                path.unlink()
        table = store.read_runs(folder)
        for found in table.to_dict("records"):
            true = rows[found["run_key"]]
            if any(found[k] != v for k, v in true.items()):
                return f"a wrong row {found}"
        missing = set(done) - {int(key, 16) for key in table["run_key"]}
        return f"done without rows: {missing}" if missing else "right"

    for name in [path.name for path in fill()]:
        path = folder / name
        content = path.read_bytes()
        for i, data in enumerate(damaged(content, rng, 10)):
            fill()
            path.write_bytes(data)
            attack("rows", f"{name} damage {i}", read, "right")
        for odd in not_files(folder.parent / f"odd {name}", ".x"):
            fill()
            path.unlink()
            path.symlink_to(odd)
            attack("rows", f"{name} {odd.name}", read, "right")
    first = fill()[0]
    for i, text in enumerate(
        [
            b"b3",
            b"b[]",
            b"={}",
            b"=[]",
            b"=[3]",
            b'=[{"run_key": 3}]',
            b"+[{}]",
            b"!{}",
            b"x[]",
            b"=",
            b'=[{"run_key": "1", "status": {"a": [1]}}]',
            b"=" + b"[" * 5000 + b"]" * 5000,
        ]
    ):
        fill()
        first.write_bytes(b"%08x %s\n" % (zlib.crc32(text), text))
        attack("rows", f"a forged line {i}", read, "right")
    for leftover in (".rows-c.1.part.parquet", ".x.journal", "notes.txt", "table.csv"):
        fill()
        (folder / leftover).write_bytes(b"half")
        attack("rows", leftover, read, "right")
    fill()
    folder.chmod(0o555)
    with without_rights():
        attack("rows", "a folder that cannot be written",
               lambda: store.write_run([row(1)], folder), refuse=True)  # fmt: skip
        attack("rows", "a folder that cannot be tidied",
               lambda: store.tidy(folder, lambda _: False), refuse=True)  # fmt: skip
    folder.chmod(0o000)
    with without_rights():
        attack("rows", "a folder that cannot be read", read, "right")
    folder.chmod(0o755)


def attack_sweeps(attack, folder, rng):
    """A whole sweep over damage: the same table as an undisturbed one, or a refusal."""
    os.environ["ESTIMA_RESULTS"] = str(folder)
    line = ["simulation.physics=kinematic", "route=linear_1", "seed=1,2,3", "name=s"]
    line.append("hydra.launcher.n_jobs=1")

    def table():
        sweep(line)
        return collect("s").to_csv()

    right = table()
    place = folder / "runs" / "s"
    for i in range(8):
        file = sorted(place.glob("*.parquet"))[0]
        content = bytearray(file.read_bytes())
        if i == 0:
            file.write_bytes(b"")
        elif i == 1:
            file.write_bytes(content[: len(content) // 2])
        elif i == 2:
            file.rename(place / file.name.replace("rows", "other"))
        elif i == 3:
            (place / ".rows-x.1.part.parquet").write_bytes(content[:100])
        elif i == 4:
            (place / "rows-old.journal").write_bytes(b"0000000")
        elif i == 5:
            for entry in cache.folder().glob("*.npz"):
                entry.write_bytes(b"")
            file.unlink()
        else:
            content[int(rng.integers(len(content)))] ^= 4
            file.write_bytes(content)
        attack("sweeps", f"damage {i}", table, right)
    for odd in not_files(folder / "odd", ".parquet"):
        link = place / f"rows-{odd.name}"
        link.symlink_to(odd)
        attack("sweeps", odd.name, table, right)
        link.unlink()
    with without_rights():
        attack("sweeps", "a folder of another user", lambda: sweep([*line, "robot.kl=3e-6"]))


# Tables, reports, estimates


def attack_tables(attack, folder, _):
    sound = [row(n, ate_rmse_m=n / 7, **{"choice.estimator": "a"}) for n in range(3)]

    def use_table(path):
        table = collect(str(path), all_versions=True)
        show(summary(table).to_string())
        sweep_figure(table, "seed", "ate_rmse_m", pool=True)

    def print_table(path):
        export([path], "markdown", None, 4)
        export([path], "latex", None, 4)

    write_rows(sound, folder / "sound.csv")
    use_table(folder / "sound.csv")
    text = (folder / "sound.csv").read_text()
    head, first, *_ = text.splitlines()
    cells = first.split(",")
    texts = {
        f"cell {i} {cell[:9]!r}": text.replace(first, ",".join([json.dumps(cell)] * i + cells[i:]))
        for cell in EVIL_CELLS
        for i in (1, 4, 9)
    }
    texts |= {
        "nothing": "", "a heading": head + "\n", "a heading twice": f"{head},seed\n{first},1\n",
        "other columns": "a,b\n1,2\n", "too many cells": f"{head}\n{first},1,2,3\n",
        "quotes": text + '"', "evil heading": text.replace("ate_rmse_m", json.dumps(EVIL)),
        "not utf-8": b"a,b\n\xff\xfe,2\n", "zeros": bytes(100), "one line": "x" * 200_000,
    }  # fmt: skip
    path = folder / "t.csv"
    for name, content in texts.items():
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        attack("tables", name, lambda: use_table(path))
        attack("tables", f"{name} printed", lambda: print_table(path))
    plain = pd.read_csv(folder / "sound.csv").to_dict("list")
    path = folder / "t.parquet"
    for what, values in {
        "lists": [[1], [2], [3]], "mappings": [{"a": 1}] * 3, "bytes": [b"\x00\xff"] * 3,
        "times": [pd.Timestamp(0)] * 3, "nulls": [None] * 3, "truths": [True] * 3,
        "texts": [EVIL] * 3, "numbers": [1.5] * 3, "infinite": [float("inf")] * 3,
    }.items():  # fmt: skip
        for column in ("ate_rmse_m", "run_key", "seed", "status", "code_version", "repeat"):
            pq.write_table(pa.table({**plain, column: values}), path)
            attack("tables", f"{column} of {what}", lambda: use_table(path))
        attack("tables", f"{what} printed", lambda: print_table(path))
    for suffix, call in ((".csv", use_table), (".parquet", use_table), (".csv", print_table)):
        for odd in not_files(folder / f"odd {suffix} {call.__name__}", suffix):
            attack("tables", odd.name, lambda p=odd, c=call: c(p), refuse=True)


class Tags(HTMLParser):
    """The kinds of elements and attributes of a page."""

    def __init__(self, text):
        super().__init__()
        self.found = set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found |= {(tag, name) for name, _ in attributes} | {(tag, "")}
        self.found |= {("refresh", "")} & {(v, "") for k, v in attributes if k == "http-equiv"}
        for name, value in attributes:
            if name in ("href", "src") and not (value or "").startswith(("#", "tables/", "data:")):
                self.found.add((tag, value))


def attack_reports(attack, folder, _):
    def claims(**changes):
        usual = {
            "id": "PB1", "paper": "puzzlebot2024", "role": "headline", "statistic": "s",
            "value": "0.5", "low": "0.4", "high": "0.6", "criterion": "c", "verdict": "reproduced",
            "reason": "r", "profile": "full", "study": "puzzlebot2024", "command": "estima",
        }  # fmt: skip
        return pd.DataFrame([{name: {**usual, **changes}[name] for name in COLUMNS}]).to_csv(
            index=False
        )

    verdict = pd.DataFrame(
        [dict(zip(VERDICT_COLUMNS, ("PB1", "puzzlebot2024", "a", "reproduced", "b"), strict=True))]
    )
    page = Figure(figsize=(1.0, 1.0))
    picture = io.BytesIO()
    page.savefig(picture, format="png")
    made = {"profile": "full", "seconds": 3, "code_version": "v", "cpu": "c"}
    sound = {
        "claims.csv": claims(),
        "verdicts.csv": verdict.to_csv(index=False),
        "provenance.json": json.dumps({"puzzlebot2024": made}),
        "figures/puzzlebot2024_a.png": picture.getvalue(),
        "tables/puzzlebot2024_a.csv": "seed,b\n1,2\n",
    }

    def report(changes):
        place = Path(tempfile.mkdtemp(dir=folder))
        for name, content in {**sound, **changes}.items():
            path = place / name
            path.parent.mkdir(exist_ok=True)
            if callable(content):
                content(path)
            else:
                path.write_bytes(content if isinstance(content, bytes) else content.encode())
        text = write_report(place).read_text()
        assert printable(text.replace("\n", "")) == text.replace("\n", ""), "control characters"
        return Tags(text).found

    more = {"tables/puzzlebot2024_b.csv": "a,b\nx,1\n", "tables/x.csv": "a\n1\n"}
    allowed = report({**more, "figures/puzzlebot2024_b.png": picture.getvalue()})
    assert ("refresh", "") not in allowed

    def only_allowed(changes):
        more = report(changes) - allowed
        assert not more, f"the page holds {more}"

    evil_name = EVIL.replace("/", "-").replace("\x1b", "")[:60].replace("\r\n", "")
    attacks = {f"{column}={cell[:12]!r}": {"claims.csv": claims(**{column: cell})}
               for column in COLUMNS for cell in (EVIL, "", "nan", "1e999")}  # fmt: skip
    attacks |= {
        f"verdicts {name}": {"verdicts.csv": verdict.assign(**{name: EVIL}).to_csv(index=False)}
        for name in VERDICT_COLUMNS
    }
    attacks |= {
        f"table {cell[:9]!r}": {"tables/puzzlebot2024_a.csv": f"seed,b\n{q},{q}\n1,2\n"}
        for cell in EVIL_CELLS
        for q in [json.dumps(cell)]
    }
    attacks |= {
        f"{name} {what}": {name: content}
        for name in sound
        for what, content in {
            "empty": b"", "cut": sound[name][: len(sound[name]) // 2], "a folder": Path.mkdir,
            "a pipe": os.mkfifo, "zeros": bytes(300),
            "a device": lambda path: path.symlink_to("/dev/zero"),
        }.items()
    }  # fmt: skip
    attacks |= {
        f"provenance {text[:20]!r}": {"provenance.json": text}
        for text in (
            "[]", "3", "null", "{", "[" * 5000, '{"x": 1}',
            json.dumps({EVIL: {**made, EVIL: EVIL}}),
            json.dumps({"puzzlebot2024": dict.fromkeys(made, EVIL)}),
            json.dumps({"puzzlebot2024": {key: [1, {"a": 2}] for key in made}}),
        )
    }  # fmt: skip
    attacks["an evil figure"] = {f"figures/puzzlebot2024_{evil_name}.png": picture.getvalue()}
    attacks["an evil table"] = {f"tables/puzzlebot2024_{evil_name}.csv": "seed\n1\n"}
    attacks["an evil other"] = {f"figures/{evil_name}.png": picture.getvalue()}
    attacks["evil seeds"] = {"tables/puzzlebot2024_a.csv": "seed,x\n" + "<meta refresh>,1\n" * 70}
    for name, changes in attacks.items():
        attack("reports", name, lambda c=changes: only_allowed(c))


def attack_estimates(attack, folder, rng):
    path = folder / "estimate.csv"
    write_odometry_csv(fakes.estimate(fakes.circle(n_frames=5)), path)
    content = path.read_bytes()
    for i, data in enumerate([*damaged(content, rng, 5), b"\x00" * 50, b'"' * 50, b"a\n" * 9]):
        path.write_bytes(data)
        attack("estimates", f"damage {i}", lambda: read_odometry_csv(path) and None)
    for odd in not_files(folder / "odd", ".csv"):
        attack("estimates", odd.name, lambda p=odd: read_odometry_csv(p), refuse=True)


SUITE = (
    "first_seed: 1\nrecordings: {a: {count: 2, overrides: []}}\n"
    "estimators: {odometry: {recordings: a, repeats: [1, 1]}}\n"
)
_CONFIG = {
    "prior": {
        "start": "tracking", "map": "none", "sigma_position_m": 0.0, "sigma_heading_rad": 0.0,
        "wheel_radius_m": None, "track_m": None,
    },
    "robot": {"kr": 1e-5, "kl": 1e-5}, "estimator": {"kr": 1e-5, "kl": 1e-5}, "seed": 0,
}  # fmt: skip


KINDS = {
    "recordings": attack_recordings,
    "logs": attack_logs,
    "worlds": lambda attack, folder, _: attack_yaml(attack, "worlds", folder, read_world, WORLD),
    "suites": lambda attack, folder, _: attack_yaml(attack, "suites", folder, read_suite, SUITE),
    "maps": attack_maps,
    "options": attack_options,
    "caches": attack_cache,
    "rows": attack_rows,
    "sweeps": attack_sweeps,
    "tables": attack_tables,
    "reports": attack_reports,
    "estimates": attack_estimates,
}


def attack_all(seed=0, only=()):
    """All attacks, or those of some kinds; how they ended."""
    attack, rng = Attack(), np.random.default_rng(seed)
    limits, kept = resource.getrlimit(resource.RLIMIT_AS), os.environ.get("ESTIMA_RESULTS")
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MOST_MEMORY, limits[1]))

    def too_long(*_):
        raise TooLongError(f"more than {LONGEST_S} s")

    before = signal.signal(signal.SIGALRM, too_long)
    try:
        with tempfile.TemporaryDirectory() as name:
            Path(name).chmod(0o755)
            for kind, make in KINDS.items():
                if only and kind not in only:
                    continue
                folder = Path(name) / kind
                folder.mkdir()
                begun = time.perf_counter()
                make(attack, folder, rng)
                attack.seconds[kind] = time.perf_counter() - begun
    finally:
        signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, limits)
        os.environ.pop("ESTIMA_RESULTS", None)
        if kept is not None:
            os.environ["ESTIMA_RESULTS"] = kept
    return attack


def told(attack):
    """The counts by kind, as a table."""
    kinds = sorted({kind for kind, _ in attack.counts})
    ends = ("right", "read", "refused", "FAILED")
    lines = [f"{'':<12}" + "".join(f"{how:>9}" for how in ends) + f"{'seconds':>9}"]
    for kind in kinds:
        counts = "".join(f"{attack.counts[kind, how]:>9}" for how in ends)
        lines.append(f"{kind:<12}{counts}{attack.seconds[kind]:>9.1f}")
    total = [sum(attack.counts[kind, how] for kind in kinds) for how in ends]
    return "\n".join([*lines, f"{'all':<12}" + "".join(f"{n:>9}" for n in total)])


if __name__ == "__main__":
    begun = time.perf_counter()
    found = attack_all(only=sys.argv[1:])
    print("\n".join(found.failures))
    print(told(found))
    print(f"{sum(found.counts.values())} attacks in {time.perf_counter() - begun:.0f} s")
    sys.exit(1 if found.failures else 0)
