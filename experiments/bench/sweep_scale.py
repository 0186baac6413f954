"""A sweep of a million runs: its plan, its files, its resumption and its table.

Planner, writer and reader are the real ones. The rows hold random metrics in place of a run's own,
so the simulation is left out.
"""

import json
import math
import multiprocessing
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from experiments.bench.measure import Measurement, alone, time_s
from experiments.runs import paths, store
from experiments.runs.columns import COLUMNS
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row, Status
from experiments.sweeps import launch, work
from experiments.sweeps.collect import collect
from experiments.sweeps.plan import Family, make_plan
from experiments.sweeps.summary import ERROR, summary

_NAME = "bench_sweep_scale"
_N_SEEDS, _N_VALUES = 2000, 500
_N_RUNS = _N_SEEDS * _N_VALUES
_N_JOBS = 8
_SWEEP = (
    "simulation.physics=kinematic",
    f"seed=range(0,{_N_SEEDS})",
    f"robot.kr=range(1,{_N_VALUES + 1},1)",
    "robot.kl=${robot.kr}",
    f"name={_NAME}",
)


def run() -> list[Measurement]:
    """Times a run or row, bytes on disk, and the planner's memory, with 1,000,000 runs."""
    folder = paths.results() / "runs" / _NAME
    shutil.rmtree(folder, ignore_errors=True)
    try:
        (plan_s, shares), plan_mib = alone(_planned)
        with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
            list(pool.map(_written, shares))
        for share in {share.parent for share in shares}:
            shutil.rmtree(share)
        sizes = [path.stat().st_size for path in folder.iterdir()]
        resume_s, resume_mib = alone(_resumed)
        table_s, table_mib = alone(_tabulated)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    averaged, us = f"read and averaged; {table_mib:.0f} MiB of memory", 1e6 / _N_RUNS
    return [
        Measurement(f"sweep.{name}", value, unit, goal, note=note)
        for name, value, unit, goal, note in (
            ("plan_us_per_run", us * plan_s, "µs", 200.0, "with the jobs' files"),
            ("resume_us_per_run", us * resume_s, "µs", 60.0, ""),
            ("table_us_per_row", us * table_s, "µs", 25.0, averaged),
            ("bytes_per_row", sum(sizes) / _N_RUNS, "B", 1500.0, f"{len(sizes)} files"),
            ("planner_memory_mib", max(plan_mib, resume_mib), "MiB", 1024.0, ""),
        )
    ]


def _planned() -> tuple[float, list[Path]]:
    """Seconds from the arguments to the jobs' shares, and these."""
    begun = time.perf_counter()
    plan = make_plan(_SWEEP)
    runs = np.arange(len(plan.keys))
    launch.check(plan, runs)
    jobs = launch.Jobs(plan.experiment(0).rows_folder, _N_JOBS)
    for share in plan.split(runs, jobs.count):
        jobs.add(*share)
    seconds = time.perf_counter() - begun
    return seconds, [work.share_path(jobs.plan, number) for number in range(len(jobs.sizes))]


def _written(share: Path) -> None:
    """Rows of a job, as its journal and then as Parquet."""
    stored = json.loads(share.read_text())
    rng = np.random.default_rng(len(share.name))
    with store.journal(Path(stored["journal"])) as journal:
        for family in stored["families"]:
            labels = next(Family.experiments(family)).labels("")
            for experiment in Family.experiments(family):
                journal.begin(str(labels["run_key"]))
                journal.append([_row(labels, experiment, rng)])
    store.compact(journal.path)


def _row(labels: Row, experiment: Experiment, rng: np.random.Generator) -> Row:
    robot = experiment.robot()
    row: Row = {**labels, "seed": experiment.seed, "world_seed": experiment.seed}
    for name in ("kr", "kl"):
        row |= {f"{group}.{name}": getattr(robot, name) for group in ("robot", "estimator")}
    row |= {"run_key": experiment.key, "recording_checksum": rng.bytes(32).hex()}
    metrics = dict(zip(COLUMNS, rng.random(len(COLUMNS)).tolist(), strict=True))
    return {**row, **Status().columns(), **metrics}


def _resumed() -> float:
    """Seconds of the sweep, all of whose runs are done."""
    return time_s(launch.sweep, _SWEEP)


def _tabulated() -> float:
    def table() -> None:
        shown = summary(collect(_NAME, times=True))
        assert shown["runs"].sum() == _N_RUNS
        assert math.isclose(
            shown[ERROR].mean(), 1.0 / math.e, abs_tol=0.01
        )  # geometric, of U(0, 1)

    return time_s(table)
