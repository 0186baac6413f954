"""Error and consistency of the fusion of wheels and laser in six classes of world, beside others.

Drives are those of `study=board/CLASS`: 60 m, 10 scans a second of 721 beams. The other methods are
those of the extra `peers` that are installed, and the paper's filter. Ratios compare geometric
means over the drives; the best other method is chosen by the same drives, which favours it.
"""

from collections.abc import Collection, Iterator
from importlib.util import find_spec

import numpy as np

from experiments.bench.measure import Measurement
from experiments.evaluation.metrics import score
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream

CLASSES = ("rooms", "office", "curved", "clutter", "people", "changed")
_OURS = "ekf_icp"
_OTHERS = {  # by the package that each needs
    "ekf_icp_paper": "numpy",
    "peers/small_gicp_keyframe_tuned": "small_gicp",
    "peers/kiss_icp_tuned": "kiss_icp",
}
_DRIVES = range(1000, 1010)  # seeds; those below 1000 were for tuning
_MOST_RATIO, _MOST_NEES, _MOST_MS = 1.0, 1.5, 1.0


def run() -> Iterator[Measurement]:
    """Three figures a class."""
    for place in CLASSES:
        yield from measure(place, _DRIVES)


def measure(place: str, seeds: Collection[int]) -> Iterator[Measurement]:
    """The figures of a class, over drives by these seeds."""
    names = [_OURS, *(name for name, package in _OTHERS.items() if find_spec(package))]
    drives = np.array([_drive(place, seed, names) for seed in seeds])
    ate_m = np.exp(np.log(drives[:, :, 0]).mean(axis=0))
    best = 1 + int(np.argmin(ate_m[1:]))
    nees, scan_ms = drives[:, 0, 1:].mean(axis=0)
    note = f"{len(drives)} drives: {1e3 * ate_m[0]:.1f} mm, {names[best]} {1e3 * ate_m[best]:.1f}"
    row = f"worlds.{place}"
    yield Measurement(f"{row}.ATE_ratio", ate_m[0] / ate_m[best], "", _MOST_RATIO, note=note)
    note = f"NEES over its expectation, 3; 0.8 to {_MOST_NEES} is consistent"
    yield Measurement(f"{row}.nees_ratio", nees, "", _MOST_NEES, note=note)
    yield Measurement(f"{row}.scan_ms", scan_ms, "ms", _MOST_MS, note="processor time, a scan")


def _drive(place: str, seed: int, names: list[str]) -> list[list[float]]:
    """ATE, m, NEES over 3 and processor time of a scan, ms, of each method on one drive."""
    chosen = (f"study=board/{place}", f"seed={seed}")
    recording = Experiment.compose([*chosen, f"estimator={_OURS}"]).recording()
    found = []
    for name in names:
        experiment = Experiment.compose([*chosen, f"estimator={name}"])
        prior = experiment.prior(recording)
        rng = stream(seed, f"estimator/{experiment.name}")
        estimate, _ = run_over(recording, experiment.estimator(), prior, rng)
        row = score(recording, estimate)
        nees = row.get("nees_mean", np.nan) / 3.0
        found.append([row["ate_rmse_m"], nees, 1e-3 * row["cpu_time_us"]])
    return found
