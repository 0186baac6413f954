"""Twins of real logs: the errors that they predict next to those on the logs' second halves."""

import functools
import math

import numpy as np
import pandas as pd

from estimators.base import Estimate
from experiments.evaluation.metrics import score
from experiments.judging.jobs import Progress, Tables, tables_of
from experiments.judging.logs import known_start, why_missing
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import FIRST_SEED, Profile, Results
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.studies.twins.segments import score_segments, segment_errors_m
from experiments.studies.twins.settings import (
    LANDMARKS,
    LOGS,
    METHODS,
    RUNS,
    SCANS,
    WIDEST,
    WIDEST_OTHERS,
)
from experiments.sweeps.plan import plan_experiments
from experiments.twin.make import Twin, make_twin
from sim.formats.detect import read_any
from sim.recording import Recording

_SCORES = ("ate_rmse_m", "heading_rmse_rad", "nees_mean")


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Make a twin of each log, run all estimators over both, and write the tables.

    Parameters
    ----------
    profile
        `quick`: 4 simulations of each log in place of 50.
    """
    runs = _planned()
    seeds = range(FIRST_SEED[profile], FIRST_SEED[profile] + RUNS[profile])
    jobs = [(log, seed, runs) for log in LOGS for seed in (None, *seeds)]
    made = tables_of(errors, jobs, on_progress)
    pairs = predict_pairs(made["runs"])
    minutes = score_segments(made["segments"])
    out.write_tables(**made, pairs=pairs, others=held_by_others(pairs), minutes=minutes)


def _planned() -> dict[str, dict[str, Experiment]]:
    """Experiments by the kind of log and the method."""
    return {
        kind: dict(zip(names, plan_experiments([f"study=twins/{kind}"]), strict=True))
        for kind, names in METHODS.items()
    }


REMADE = {"runs": 60.0, "segments": 60.0}  # the others are made of it


def remake(_table: str, row: Cells) -> Remake | None:
    """The call that makes a row again; None without the logs."""
    if why_missing():
        return None
    one = {row["kind"]: {row["method"]: _planned()[row["kind"]][row["method"]]}}
    seed = None if row["seed"] < 0 else int(row["seed"])
    return errors, (row["log"], seed, one)


@functools.lru_cache(maxsize=1)
def twin_of(log: str) -> Twin:
    """The twin of a log of the study."""
    paths, robot = LOGS[log]
    return make_twin(read_any(paths, robot))


def errors(log: str, seed: int | None, runs: dict[str, dict[str, Experiment]]) -> Tables:
    """Error of each estimator on a simulation of a log's second half; seed None: on the log."""
    twin = twin_of(log)
    kind = SCANS if twin.grid is not None else LANDMARKS
    recording = twin.rest if seed is None else twin.simulate(seed)
    about: Row = {"log": log, "kind": kind, "seed": -1 if seed is None else seed}
    rows, segments = [], []
    for name, run in runs[kind].items():
        online = _estimate(twin, run, recording, seed)
        scores, label = score(recording, online), {**about, "method": name}
        found = {key: scores.get(key, math.nan) for key in _SCORES}
        rows.append({**label, "status": recording.status, **found})
        for i, error_m in enumerate(segment_errors_m(recording, online)):
            segments.append({**label, "segment": i, "error_m": float(error_m)})
    return {"runs": rows, "segments": segments}


def _estimate(twin: Twin, run: Experiment, recording: Recording, seed: int | None) -> Estimate:
    """Run an estimator from the true start; it believes the calibration's slip."""
    slip = vars(twin.found.calibration.slip)
    believed = {key: value for key, value in slip.items() if run.option(key) is not None}
    estimator = run.with_estimator(**believed).estimator()
    rng = stream(seed or 0, f"estimator/{run.estimator_name}")
    return run_over(recording, estimator, known_start(recording), rng)[0]


def predict_pairs(runs: pd.DataFrame) -> pd.DataFrame:
    """A row a pair of log and estimator: its real error, and what the twin predicts."""
    rows: list[Row] = []
    for (log, method), group in runs.groupby(["log", "method"], sort=False):
        real = group[group.seed < 0].iloc[0]
        simulated = group[group.seed >= 0].ate_rmse_m.to_numpy(float)
        low, median, high = np.quantile(simulated, [0.025, 0.5, 0.975])
        rows.append(
            {
                "log": log,
                "kind": real.kind,
                "method": method,
                "error_m": real.ate_rmse_m,
                "median_m": median,
                "low_m": low,
                "high_m": high,
                "inside": bool(low <= real.ate_rmse_m <= high),
                "narrow": bool(high <= WIDEST.get(str(method), WIDEST_OTHERS) * low),
                "nees": real.nees_mean,
                "nees_median": float(np.median(group[group.seed >= 0].nees_mean)),
                "n": len(simulated),
            }
        )
    return pd.DataFrame(rows)


def held_by_others(pairs: pd.DataFrame) -> pd.DataFrame:
    """A row a log and the twin of another log of its kind: the share of errors that it holds."""
    both = pairs.merge(pairs, on=["kind", "method"], suffixes=("", "_twin"))
    both["held"] = (both.low_m_twin <= both.error_m) & (both.error_m <= both.high_m_twin)
    by_logs = both.groupby(["log", "log_twin"], sort=False).held.agg(held="sum", pairs="size")
    return by_logs.reset_index(names=["log", "twin"])
