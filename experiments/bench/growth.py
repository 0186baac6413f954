"""How memory and the time of a step grow over a drive of half an hour, through every estimator.

One drive is indoors, with a laser and a stereo camera, through sixteen rooms that are all seen
after five minutes; the other is through a campus with a lidar. Each estimator has a process of its
own.
"""

import collections
import ctypes
import gc
import itertools
import os
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from estimators.base import Belief
from experiments.bench.measure import Measurement, alone, peak_mib, time_s, time_steps
from experiments.runs.evaluate import limit_blas
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
    "study=maximo2024/campus",
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
_WITH_FINISH = ("fastslam", "fixed_lag", "smoother")
_SETTLED = 6  # minutes until all rooms have been seen
_FINISHED = (5, 10, 20, 30)  # minutes after which the whole path is solved for


def run() -> Iterator[Measurement]:
    """Step and memory at the end of the drive beside those at its beginning; times of `finish`."""
    for name in (*_IN_ROOMS, *_ON_CAMPUS):
        step_us, memory_mib = alone(measure_drive, name)[0]
        parts = step_us[1:4], step_us[_SETTLED : _SETTLED + 3], step_us[-3:]
        early, middle, late = map(statistics.median, parts)
        note = f"at the end; {early:.0f} in minutes 2-4, {middle:.0f} in 7-9"
        yield Measurement(f"growth.{name}.step_us", late, "µs", note=note)
        grown_mib, note = memory_mib[-1] - memory_mib[_SETTLED], "since the end of minute 7"
        yield Measurement(f"growth.{name}.memory_mib", grown_mib, "MiB", note=note)
    for name in _WITH_FINISH:
        for minutes, (seconds, peak) in alone(measure_finish, name)[0].items():
            note = f"peak {peak:.0f} MiB"
            yield Measurement(f"growth.{name}.finish_{minutes}min_s", seconds, "s", note=note)


def measure_drive(name: str) -> tuple[list[float], list[float]]:
    """Mean processor time of a step in each minute, µs, and memory after it, MiB."""
    minutes = [
        (1e6 * statistics.fmean(seconds for seconds, _ in steps), resident_mib())
        for _, steps in _minutes(name)
    ]
    step_us, memory_mib = map(list, zip(*minutes, strict=True))
    return step_us, memory_mib


def measure_finish(name: str) -> dict[int, tuple[float, float]]:
    """Processor time of `finish`, s, and the most memory so far, MiB, by the minutes driven."""
    costs = {}
    for minute, (estimator, steps) in enumerate(_minutes(name), start=1):
        collections.deque(steps, maxlen=0)
        if minute in _FINISHED:
            costs[minute] = time_s(estimator.finish, clock=time.process_time), peak_mib()
    return costs


def _minutes(name: str) -> Iterator[tuple[Any, Iterator[tuple[float, Belief]]]]:
    """An estimator, and what `timed_steps` gives of each minute of the drive of its kind."""
    drive, speed_mps = (_CAMPUS, 1.5) if name in _ON_CAMPUS else (_ROOMS, 0.5)
    length = f"route.distance_m={60 * _MINUTES * speed_mps:g}"
    prior_map = ["prior.map=world"] if name == "mcl" else []
    experiment = Experiment.compose([*drive, length, f"estimator={name}", *prior_map])
    recording = experiment.recording()
    prior, estimator = experiment.prior(recording), experiment.estimator()
    estimator.reset(prior, stream(0, "bench"))
    by_minute = itertools.groupby(recording.frames(), lambda frame: int(frame.stamp // 60.0))
    with limit_blas():
        for _, frames in itertools.islice(by_minute, _MINUTES):
            yield estimator, time_steps(estimator, frames)


def resident_mib() -> float:
    """Memory that the process needs now, without what it has freed."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
