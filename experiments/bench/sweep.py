"""Overhead of a sweep over its runs, and the gain of two workers."""

import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence

from estimators.base import run as run_estimator
from experiments.bench.measure import Measurement, median_time_s, time_s
from experiments.runs import paths, store
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from experiments.sweeps.work import Held, run_and_record

_NAME = "bench_sweep"
_SHORT = ["simulation.physics=kinematic", "simulation.rays=exact", "route=linear_1"]
_CHEAP = ["world=empty", "route.segments=[[0.2,0.0,1.0]]", "route.rest_s=0"]
_LONG = [
    "world=room",
    "sensors=lms291",
    "sensors.laser.rate_hz=10",
    "estimator=ekf_icp",
    "route.distance_m=40",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
]
_FEW, _MANY = 10, 60


def run() -> Iterator[Measurement]:
    """Overheads per run and per job, the gain of two workers, and the time of `estima --help`."""
    try:
        yield from _overheads()
        note = "odometry, encoder, an empty hall, 1 s, kinematic; recording included"
        yield Measurement("sweep.cheapest_run_ms", _cheapest_run_ms(), "ms", 8.0, note=note)
        yield _speedup(24, None)  # too short to make up for the workers' start-up
        yield _speedup(200, 1.8)
        help_s = statistics.median(_cli_s("--help") for _ in range(7))
        yield Measurement("cli.help_s", help_s, "s", 0.4)
    finally:
        shutil.rmtree(paths.results() / "runs" / _NAME, ignore_errors=True)


def _overheads() -> Iterator[Measurement]:
    experiment = Experiment.compose([*_SHORT, f"name={_NAME}", "picture=false"])
    read = experiment.recordings()
    recording = read.only
    _packed_s([experiment], {experiment.recording_key: (read, {})})
    prior, estimator = experiment.prior(recording), experiment.estimator()
    own_s = median_time_s(
        lambda: run_estimator(estimator, recording, prior, stream(0, "bench")),
        clock=time.process_time,
    )

    def packed_s(repeats: int) -> float:
        many = experiment.with_values(repeats=repeats)
        return _packed_s([many], {many.recording_key: (read, {})})

    def swept_s(n_runs: int) -> float:
        """Wall time of a sweep over values of a belief, the recording being cached."""
        values = ",".join(f"{1e-6 * (i + 1):.7g}" for i in range(n_runs))
        return _sweep_s(*_SHORT, f"estimator.kr={values}", "hydra/launcher=basic")

    def overhead_ms(seconds: Callable[[int], float]) -> float:
        """Slope of the time over the number of runs, less the estimator's own; median of three."""
        slopes = [(seconds(_MANY) - seconds(_FEW)) / (_MANY - _FEW) - own_s for _ in range(3)]
        return 1e3 * statistics.median(slopes)

    note = "processor time of a repeat beyond the estimator's own"
    yield Measurement("sweep.overhead_packed_ms", overhead_ms(packed_s), "ms", 10.0, note=note)
    note = "wall time of a run of its own, from the command line, one after another"
    yield Measurement("sweep.overhead_job_ms", overhead_ms(swept_s), "ms", 60.0, note=note)


def _cheapest_run_ms() -> float:
    """Processor time of a run of the cheapest kind in a job, recording included."""
    short = Experiment.compose([*_SHORT, *_CHEAP, f"name={_NAME}", "picture=false"])
    first = time.time_ns() % 10**9  # seeds that the cache does not have
    runs = [short.with_values(seed=seed, world_seed=seed) for seed in range(first, first + 300)]
    _packed_s(runs[:20], {})
    return 1e3 * _packed_s(runs[20:], {}) / len(runs[20:])


def _packed_s(runs: Sequence[Experiment], held: Held) -> float:
    """Processor time of runs in one job, their rows included."""
    begun = time.process_time()
    with store.journal(runs[0].rows_folder / f"bench{store.JOURNAL}") as journal:
        for experiment in runs:
            run_and_record(experiment, held, journal)
    store.compact(journal.path)
    return time.process_time() - begun


def _speedup(n_runs: int, goal: float | None) -> Measurement:
    """Gain of two workers over one in a sweep of so many recordings."""
    seconds = {}
    for launcher in ("joblib", "joblib", "basic"):  # the first makes the recordings
        workers = ["hydra.launcher.n_jobs=2"] if launcher == "joblib" else []
        chosen = [f"seed=range(0,{n_runs})", f"hydra/launcher={launcher}", *workers]
        seconds[launcher] = _sweep_s(*_LONG, *chosen)
    return Measurement(
        f"sweep.speedup_two_workers_{n_runs}",
        seconds["basic"] / seconds["joblib"],
        "x",
        goal,
        "higher",
        f"{n_runs} runs of ekf_icp, {seconds['basic']:.0f} s on one; start-up included",
    )


def _sweep_s(*overrides: str) -> float:
    """Wall time of a sweep that finds no rows of a former one."""
    shutil.rmtree(paths.results() / "runs" / _NAME, ignore_errors=True)
    return _cli_s("run", "-m", f"name={_NAME}", *overrides)


def _cli_s(*arguments: str) -> float:
    """Wall time of a command."""
    command = [sys.executable, "-m", "experiments.cli", *arguments]
    return time_s(lambda: subprocess.run(command, check=True, capture_output=True))
