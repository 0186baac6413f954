"""How memory and the time of a step grow over a drive of half an hour, through every estimator.

One drive is indoors, with a laser and a stereo camera, through sixteen rooms that are all seen
after five minutes; the other is through a campus with a lidar. Each estimator has a process of its
own.
"""

import itertools
import os
import statistics
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from experiments.bench.measure import Measurement, time_s, timed_steps
from experiments.runs.evaluate import limited_blas
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream

_MINUTES = 30
_ROOMS = (
    "world=gil2008",
    "robot=robocom",
    "sensors=laser_stereo",
    "simulation.physics=kinematic",
    "prior.sigma_position_m=1e-3",
    "prior.sigma_heading_rad=1e-4",
)
_CAMPUS = (
    "study=maximo2024_campus",
    "world.n_x=3",
    "world.n_y=2",
    "simulation.physics=kinematic",
)
_ON_CAMPUS = ("topological_mcl", "topological_mcl_paper")
_IN_ROOMS = (
    "odometry",
    "icp_odometry",
    "ekf_icp",
    "ekf_icp_paper",
    "mcl",
    "ekf_slam",
    "fastslam",
    "fastslam_paper",
    "fixed_lag",
    "smoother",
)
_SETTLED = 6  # minutes until all rooms have been seen
_FINISHED = (5, 10, 20, 30)  # minutes after which the whole path is solved for


@dataclass(frozen=True)
class Drive:
    """What an estimator took.

    Attributes
    ----------
    step_us, memory_mib
        Mean processor time of a step in each minute, and memory of the process after it.
    finish_s
        Processor time of `finish` by the minutes driven, if there is one.
    """

    step_us: list[float]
    memory_mib: list[float]
    finish_s: dict[int, float]


def run() -> Iterator[Measurement]:
    """Step and memory at the end of the drive beside those at its beginning; times of `finish`."""
    for name in (*_IN_ROOMS, *_ON_CAMPUS):
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:  # memory of this one alone
            drive = pool.submit(_driven, name).result()
        first, last = drive.step_us[_SETTLED : _SETTLED + 3], drive.step_us[-3:]
        early, middle, late = (statistics.median(t) for t in (drive.step_us[1:4], first, last))
        yield Measurement(
            f"growth.{name}.step_us",
            late,
            "us",
            note=f"at the end; {early:.0f} in minutes 2-4, {middle:.0f} in 7-9",
        )
        yield Measurement(
            f"growth.{name}.memory_mib",
            drive.memory_mib[-1] - drive.memory_mib[_SETTLED],
            "MiB",
            note="at the end, beyond that after minute 7",
        )
        for minutes, seconds in drive.finish_s.items():
            memory = drive.memory_mib[minutes - 1]
            yield Measurement(
                f"growth.{name}.finish_{minutes}min_s", seconds, "s", note=f"{memory:.0f} MiB"
            )


def _driven(name: str) -> Drive:
    experiment = _experiment(name)
    recording = experiment.recording()
    prior, estimator = experiment.prior(recording), experiment.estimator()
    estimator.reset(prior, stream(0, "bench"))
    drive = Drive([], [], {})
    by_minute = itertools.groupby(recording.frames(), lambda frame: int(frame.stamp // 60.0))
    with limited_blas():
        for minute, frames in itertools.islice(by_minute, _MINUTES):
            times_s = [seconds for seconds, _ in timed_steps(estimator, frames)]
            drive.step_us.append(1e6 * statistics.fmean(times_s))
            drive.memory_mib.append(_memory_mib())
            if minute + 1 in _FINISHED and hasattr(estimator, "finish"):
                drive.finish_s[minute + 1] = time_s(estimator.finish, clock=time.process_time)
    return drive


def _experiment(name: str) -> Experiment:
    """An estimator over the drive of its kind, of half an hour."""
    drive, speed_mps = (_CAMPUS, 1.5) if name in _ON_CAMPUS else (_ROOMS, 0.5)
    length = f"route.distance_m={60 * _MINUTES * speed_mps:g}"
    known = ["prior.map=world"] if name == "mcl" else []
    return Experiment.compose([*drive, length, f"estimator={name}", *known])


def _memory_mib() -> float:
    """Memory that the process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
