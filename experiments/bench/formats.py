"""Speed of reading logs."""

import functools
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.bench.measure import Measurement, median_time_s
from sim.formats.carmen import read_carmen, to_recording


def carmen_log(path: Path, megabytes: float) -> None:
    """Write a made-up CARMEN log of about this size: three ODOM lines to a FLASER line."""
    rng = np.random.default_rng(0)
    stamp, x, heading = 976052857.0, 0.0, 0.0
    with path.open("w") as log:
        while log.tell() < megabytes * 1e6:
            for _ in range(3):
                stamp, x, heading = stamp + 0.05, x + 0.02, heading + 0.001
                pose = f"{x:.6f} {0.1 * x:.6f} {heading % 3.0:.6f}"
                logged = f"{stamp:.6f} robot {stamp - 976052857.0:.6f}"
                log.write(f"ODOM {pose} 0.4 0.02 0 {logged}\n")
            ranges = " ".join(f"{r:.2f}" for r in rng.uniform(0.5, 30.0, 180))
            log.write(f"FLASER 180 {ranges} {pose} {pose} {logged}\n")


def run(megabytes: float = 100.0) -> Iterator[Measurement]:
    """Read a large CARMEN log into a recording.

    Processor time of the one thread that reads, so that other programs do not count.
    """
    median_s = functools.partial(median_time_s, at_least_s=0.0, repeats=3, clock=time.process_time)
    with tempfile.TemporaryDirectory() as folder:
        large = Path(folder) / "large.log"
        carmen_log(large, megabytes)
        size = large.stat().st_size / 1e6
        parse_s = median_s(read_carmen, [(large,)])
        whole_s = parse_s + median_s(to_recording, [(read_carmen(large),)])
    for name, seconds, note in (
        ("", parse_s, f"{size:.0f} MB of ODOM and FLASER lines, one core"),
        ("recording_", whole_s, "the same, into a recording"),
    ):
        yield Measurement(
            f"formats.carmen_{name}mb_per_s", size / seconds, "MB/s", 15.0, "higher", note
        )
