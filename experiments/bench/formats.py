"""How fast logs are read."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.bench.measure import Measurement
from sim.formats.carmen import read_carmen, to_recording

_MEGABYTES = 100


def carmen_log(path: Path, megabytes: float) -> None:
    """Write a made-up CARMEN log of about this size: three ODOM lines to a FLASER line."""
    rng = np.random.default_rng(0)
    blocks, length = [], 0
    stamp, x, heading = 976052857.0, 0.0, 0.0
    while length < megabytes * 1e6:
        lines = []
        for _ in range(3):
            stamp, x, heading = stamp + 0.05, x + 0.02, heading + 0.001
            pose = f"{x:.6f} {0.1 * x:.6f} {heading % 3.0:.6f}"
            lines.append(f"ODOM {pose} 0.4 0.02 0 {stamp:.6f} robot {stamp - 976052857.0:.6f}")
        ranges = " ".join(f"{r:.2f}" for r in rng.uniform(0.5, 30.0, 180))
        lines.append(
            f"FLASER 180 {ranges} {pose} {pose} {stamp:.6f} robot {stamp - 976052857.0:.6f}"
        )
        blocks.append("\n".join(lines) + "\n")
        length += len(blocks[-1])
    path.write_text("".join(blocks))


def run() -> list[Measurement]:
    """Read 100 MB of CARMEN log into a recording.

    Processor time of the one thread that reads, so that a busy machine does not count.
    """
    with tempfile.TemporaryDirectory() as folder:
        large = Path(folder) / "large.log"
        carmen_log(large, _MEGABYTES)
        parse_s, whole_s = [], []
        for _ in range(3):
            begun = time.process_time()
            log = read_carmen(large)
            parse_s.append(time.process_time() - begun)
            to_recording(log)
            whole_s.append(time.process_time() - begun)
        size = large.stat().st_size / 1e6
    return [
        Measurement(
            "formats.carmen_mb_per_s",
            size / float(np.median(parse_s)),
            "MB/s",
            15.0,
            "higher",
            f"{size:.0f} MB of ODOM and FLASER lines, one core",
        ),
        Measurement(
            "formats.carmen_recording_mb_per_s",
            size / float(np.median(whole_s)),
            "MB/s",
            15.0,
            "higher",
            "the same, into a recording",
        ),
    ]
