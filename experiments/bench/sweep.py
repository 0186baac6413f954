"""What a sweep costs beside its runs, and what two workers gain."""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import time

from estimators.base import run as run_estimator
from experiments.bench.measure import Measurement, median_time_s
from experiments.runs import paths
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import write_rows
from experiments.runs.seeds import stream
from experiments.sweeps.launch import run_and_record

_NAME = "bench_sweep"
_SHORT = ["simulation.physics=kinematic", "simulation.rays=exact", "route=linear_1"]
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


def run() -> list[Measurement]:
    """Overheads a run and a job, the gain of two workers, and the time of `estima --help`."""
    try:
        return [*_overheads(), *_speedup(), _help()]
    finally:
        shutil.rmtree(paths.results() / "runs" / _NAME, ignore_errors=True)


def _overheads() -> list[Measurement]:
    experiment = Experiment.compose([*_SHORT, f"name={_NAME}", "picture=false"])
    recording = experiment.recording()
    run_and_record(experiment, {experiment.recording_key: recording})
    prior, estimator = experiment.prior(recording), experiment.estimator()
    own_s = median_time_s(lambda: run_estimator(estimator, recording, prior, stream(0, "bench")))

    def packed(repeats: int) -> float:
        many = experiment.replaced(repeats=repeats)
        begun = time.process_time()
        write_rows(evaluate(many, recording), many.rows_folder / f"{many.key}.parquet")
        return time.process_time() - begun

    slopes = [(packed(_MANY) - packed(_FEW)) / (_MANY - _FEW) - own_s for _ in range(3)]
    jobs = [(_swept_s(_MANY) - _swept_s(_FEW)) / (_MANY - _FEW) - own_s for _ in range(3)]
    return [
        Measurement(
            "sweep.overhead_packed_ms",
            1e3 * statistics.median(slopes),
            "ms",
            10.0,
            note="processor time of a repeat beside the estimator's own",
        ),
        Measurement(
            "sweep.overhead_job_ms",
            1e3 * statistics.median(jobs),
            "ms",
            60.0,
            note="wall time of a run of its own, from the command line, one after another",
        ),
    ]


def _swept_s(n_runs: int) -> float:
    """Wall time of a sweep over values of a belief, recording at hand, without a cached row."""
    shutil.rmtree(paths.results() / "runs" / _NAME, ignore_errors=True)
    values = ",".join(f"{1e-6 * (i + 1):.7g}" for i in range(n_runs))
    return _timed(
        ["run", "-m", *_SHORT, f"name={_NAME}", f"estimator.kr={values}", "hydra/launcher=basic"]
    )


def _speedup() -> list[Measurement]:
    """Gain of two workers: for a short sweep their start-up weighs, for a usual one it does not."""
    found = []
    for n_runs, goal in ((24, None), (200, 1.8)):
        seconds = {}
        for launcher in ("joblib", "joblib", "basic"):  # the first makes the recordings
            shutil.rmtree(paths.results() / "runs" / _NAME, ignore_errors=True)
            chosen = [f"hydra/launcher={launcher}"]
            if launcher == "joblib":
                chosen.append("hydra.launcher.n_jobs=2")
            seeds = f"seed=range(0,{n_runs})"
            seconds[launcher] = _timed(["run", "-m", *_LONG, f"name={_NAME}", seeds, *chosen])
        found.append(
            Measurement(
                f"sweep.speedup_two_workers_{n_runs}",
                seconds["basic"] / seconds["joblib"],
                "x",
                goal,
                "higher",
                f"{n_runs} runs of ekf_icp, {seconds['basic']:.0f} s on one; start-up included",
            )
        )
    return found


def _help() -> Measurement:
    seconds = [_timed(["--help"]) for _ in range(7)]
    return Measurement("cli.help_s", statistics.median(seconds), "s", 0.4)


def _timed(arguments: list[str]) -> float:
    begun = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "experiments.cli", *arguments],
        check=True,
        capture_output=True,
    )
    return time.perf_counter() - begun
