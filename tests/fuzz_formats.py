"""Malformed logs for every reader: mutated samples, real and made by hand.

    python -m tests.fuzz_formats 100000

Each input must be read, or refused with an `InputError` that names the file, the line (where the
format has lines) and the reason; in bounded time and memory. Anything else ends the run.
"""

import io
import re
import resource
import sys
import tarfile
import tempfile
import time
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.formats import carmen, intel, khepera, lego, mrclam, rawseeds, relations, tum, wean
from sim.formats.rosbag_in import read_bag, read_tracks
from sim.formats.rosbag_out import write_bag
from sim.formats.text import read_bytes, read_members, split_words
from sim.recording import joined
from sim.sensors.base import parted
from tests import fakes
from tests import log_samples as samples
from tests.beacons import Beacons

LONGEST_S = 5.0
MOST_MEMORY_MIB = 600  # growth of the process over the whole run

EVIL = [
    b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e12", b"1000000000000", b"1e-320",
    b"99999999999999999999999999", b"0x10", b"1_0", b"--1", b"1e", b"", b" ", b",", b";", b"#",
    b"\x00", b"\xff\xfe", "\u0661".encode(), b"\r", b"\n", b"{", b"[", b'"', b"null", b"true",
    b"-2147483649", b"4294967296", b"18446744073709551616", b"2", b"3", b"180", b"1e308",
    b"__import__('os').system('x')", b"!!python/object/apply:os.system ['x']", b"cos\nsystem\n(",
]  # fmt: skip


def mutate(data, rng):
    """One to four small harms done to some bytes."""
    for _ in range(int(rng.integers(1, 5))):
        kind = int(rng.integers(9))
        size = len(data)
        at = int(rng.integers(size + 1))
        end = min(size, at + int(rng.integers(1, 30)))
        if kind == 0:
            data = data[:at] + bytes([int(rng.integers(256))]) + data[at + 1 :]
        elif kind == 1:
            data = data[:at] + data[end:]
        elif kind == 2:
            data = data[:at] + data[at:end] * int(rng.integers(2, 5)) + data[end:]
        elif kind == 3:
            data = data[:at]
        elif kind == 4:
            data = data[:at] + EVIL[int(rng.integers(len(EVIL)))] + data[at:]
        elif kind in (5, 6):  # a word for a word
            words = list(re.finditer(rb"[^\s,;]+", data[: 1 << 16]))
            if words:
                word = words[int(rng.integers(len(words)))]
                evil = EVIL[int(rng.integers(len(EVIL)))]
                data = data[: word.start()] + evil + data[word.end() :]
        else:  # lines dropped, repeated, exchanged
            lines = data.split(b"\n")
            i, j = (int(k) for k in rng.integers(len(lines), size=2))
            if kind == 7:
                lines[i], lines[j] = lines[j], lines[i]
            else:
                lines[i : i + 1] = lines[j : j + int(rng.integers(3))]
            data = b"\n".join(lines)
    return data


def flip(data, rng):
    """Some bytes changed, none moved: what gets past the checks of lengths and offsets."""
    harmed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        harmed[int(rng.integers(len(harmed)))] = int(
            rng.choice([0, 1, 127, 255, rng.integers(256)])
        )
    return bytes(harmed)


def of_words(parse):
    """A reader of bytes from a reader of words."""
    return lambda data: parse(split_words(data, "log"))


def recording_of(log):
    """A recording's frames, walked through."""
    for _ in log.frames():
        pass
    return log


def _mrclam(data):
    files = dict(part.split(b"\x01", 1) for part in data.split(b"\x02") if b"\x01" in part)
    members = {name.decode("latin1"): text for name, text in files.items()}
    return recording_of(mrclam.parse_mrclam(members, "log"))


def text_targets():
    """Name to reader and samples; real logs are cut to their first lines."""
    packed = b"\x02".join(n.encode() + b"\x01" + t for n, t in samples.mrclam_members().items())

    def head(name, n_bytes):
        path = samples.DATA / name
        return [read_bytes(path)[:n_bytes]] if path.exists() else []

    carmen_logs = [samples.flaser_log(), samples.robotlaser_log()]
    carmen_logs += head("intel_lab/intel.gfs.log.gz", 6000)
    carmen_logs += head("fr079_flirt/fr079.flirt.log.gz", 6000)
    wean_logs = [samples.wean_log(), *head("wean_hall_mcl/robotdata1.log.gz", 4000)]

    def read_carmen(data):
        log = carmen.parse_carmen(split_words(data, "log"))
        recording_of(carmen.to_recording(log))

    def read_khepera(data):
        khepera.to_recording(khepera.parse_khepera(data, "log"))

    return {
        "carmen": (read_carmen, carmen_logs),
        "intel": (lambda data: intel.parse_intel(data, "log"), [samples.intel_json()]),
        "khepera": (read_khepera, [samples.KHEPERA]),
        "relations": (
            of_words(relations.parse_relations),
            [samples.relations(), *head("intel_lab/intel.relations.gz", 1000)],
        ),
        "mrclam": (_mrclam, [packed]),
        "rawseeds": (of_words(rawseeds.parse_trajectory), [samples.rawseeds_truth().encode()]),
        "rawseeds odometry": (
            of_words(rawseeds.parse_odometry), [samples.rawseeds_odometry().encode()],
        ),
        "rawseeds scans": (of_words(rawseeds.parse_sick), [samples.rawseeds_sick().encode()]),
        "lego motors": (
            of_words(lego.parse_motors),
            [samples.lego_motors(), *head("lego_brenner/robot4_motors.txt.gz", 1000)],
        ),
        "lego scans": (of_words(lego.parse_scans), [samples.lego_scans()]),
        "lego reference": (of_words(lego.parse_reference), [samples.lego_reference()]),
        "lego cylinders": (of_words(lego.parse_cylinders), [b"L C 1 2 3\nL C 4 5 6\n"]),
        "wean": (lambda d: recording_of(wean.parse_wean(split_words(d, "log"))), wean_logs),
        "wean map": (lambda data: wean.parse_grid(data, "log"), [samples.wean_map()]),
        "tum": (lambda data: tum.parse_tum(data, "log"), [samples.TUM]),
    }  # fmt: skip


def own_log(sensor, stamps):
    """Readings of a sensor that the package does not know, each with two rows."""
    seen, _ = parted(sensor.schema)
    shapes = {k: (2,) * (f.ragged + f.shape.count(None)) for k, f in seen.items()}
    readings = [
        {k: np.ones((*shapes[k], *filter(None, f.shape)), f.dtype) for k, f in seen.items()}
        for _ in stamps
    ]
    return joined(seen, stamps, readings, "beacons")


def file_targets(folder):
    """Name to reader and samples of what is no text: packed files, archives, bags."""
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w:xz") as tar:
        for name, text in samples.mrclam_members().items():
            member = tarfile.TarInfo(f"set/{name}")
            member.size = len(text)
            tar.addfile(member, io.BytesIO(text))
    recording = fakes.circle(n_frames=3, n_beams=5)
    own = Beacons()  # a message by the schema that is in the file
    recording = recording.with_log("beacons", own_log(own, recording.frame_stamps), own)
    bags = {}
    for name in ("run.mcap", "run.bag", "run.db3"):
        write_bag(folder / name, recording)
        path = folder / name
        bags[name] = (path if path.is_file() else next(path.glob("*.db3"))).read_bytes()

    def on_disk(name, read):
        def from_bytes(data):
            path = folder / f"log-{name}"
            path.write_bytes(data)
            read(path)

        return from_bytes

    targets = {"archive": (on_disk("a.tar.xz", read_members), [archive.getvalue()])}
    for name, data in bags.items():
        targets[name] = (on_disk(name, read_bag), [data])
        targets[f"{name} tracks"] = (on_disk(name, read_tracks), [data])
    return targets


def attack(name, read, data, with_lines):
    """Let a reader have some bytes; say whether it read or refused them."""
    begun = time.perf_counter()
    try:
        read(data)
        verdict = "read"
    except InputError as error:
        verdict = "refused"
        message = str(error)
        named = re.match(r"log[^:]*(:\d+)?: .{5,}", message) if with_lines else len(message) > 10
        assert named, f"{name}: the message names no file and reason: {message!r}"
        assert "\n" not in message, f"{name}: more than a line: {message!r}"
    except Exception as error:
        raise AssertionError(f"{name}: {type(error).__name__} {error} for {data!r}") from error
    seconds = time.perf_counter() - begun
    assert seconds < LONGEST_S, f"{name}: {seconds:.1f} s for {data!r}"
    return verdict


def fuzz(n_inputs, seed=0, share_of_files=0.03):
    """Attack all readers in turn; counts of inputs read and refused by reader."""
    rng = np.random.default_rng(seed)
    counts = {}
    with tempfile.TemporaryDirectory() as name:
        texts, files = list(text_targets().items()), list(file_targets(Path(name)).items())
        for _, (read, wholes) in texts + files:
            for whole in wholes:
                attack("sample", read, whole, with_lines=True)  # compiles, and is the base line
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for i in range(n_inputs):
            of_file = rng.random() < share_of_files
            pool = files if of_file else texts
            target, (read, wholes) = pool[i % len(pool)]
            whole = wholes[int(rng.integers(len(wholes)))]
            harm = flip if of_file and rng.random() < 0.7 else mutate
            verdict = attack(target, read, harm(whole, rng), with_lines=not of_file)
            counts[target, verdict] = counts.get((target, verdict), 0) + 1
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
        assert grown < MOST_MEMORY_MIB, f"the memory grew by {grown:.0f} MiB"
    return counts


if __name__ == "__main__":
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    begun = time.perf_counter()
    found = fuzz(n, seed=int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    for (target, verdict), count in sorted(found.items()):
        print(f"{target:<20} {verdict:<8} {count}")
    print(f"{n} inputs in {time.perf_counter() - begun:.0f} s: none came through otherwise")
