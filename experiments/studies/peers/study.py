"""Methods of other projects beside ours: errors and processor times on the same recordings."""

import importlib.metadata
import subprocess

import numpy as np
import pandas as pd

from estimators.peers import MissingPackageError
from experiments.evaluation.statistics import log_ratio_interval
from experiments.judging.jobs import Progress, Tables, answer_of, group_by, tables_of
from experiments.judging.remake import Cells, Remake, agrees
from experiments.judging.results import Profile, Results
from experiments.runs.compose import find_option
from experiments.runs.console import warn
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Row
from experiments.studies.peers.settings import LASER, PACKAGES, READS, TUNED
from experiments.sweeps.plan import plan_experiments
from experiments.sweeps.tune import FAILED_M

_ERROR = "answer_ate_rmse_m"
_KEPT = ("status", "answer", _ERROR, "answer_heading_rmse_rad", "cpu_time_us")


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run the study and write its tables: the runs, the methods, and those that are missing.

    Parameters
    ----------
    profile
        `quick`: one recording of each world; `full`: five.
    """
    fewer = [] if profile is Profile.FULL else ["seed=1000"]
    experiments = list(plan_experiments(["study=peers", *fewer]))
    one_each = {experiment.estimator_name: experiment for experiment in experiments}
    absent = {name: why for name, experiment in one_each.items() if (why := missing(experiment))}
    for name, reason in absent.items():
        warn(f"{name}: left out, {reason}")
    present = [e for e in experiments if e.estimator_name not in absent]
    drives = group_by(present, lambda e: (e.choices["world"], e.seed))
    made = tables_of(runs, [(drive,) for drive in drives], on_progress)
    out.write_tables(**made, methods=methods(made["runs"]))
    if absent:
        named = pd.DataFrame({"estimator": list(absent), "reason": list(absent.values())})
        out.write_tables(missing=named)


REMADE = {"runs": 8.0}  # methods are means of them


def remake(_table: str, row: Cells) -> Remake | None:
    """The call that makes a row again; None if its method is not here."""
    option = find_option("estimator", row["estimator"])
    given = ["study=peers", f"seed={row['seed']:.0f}", f"estimator={option}"]
    for one in plan_experiments(given):
        if agrees(row, {name: one.choices[name] for name in ("world", "estimator")}):
            return None if missing(one) else (runs, ([one],))
    return None


def missing(experiment: Experiment) -> str:
    """Why a peer cannot run here; empty if it can.

    Raises
    ------
    InputError
        If the configuration is wrong.
    """
    try:
        experiment.check()
    except MissingPackageError as error:
        return str(error)
    return ""


def runs(drive: list[Experiment]) -> Tables:
    """Rows of all methods on one recording."""
    rows: list[Row] = [
        {
            "world": one.choices["world"],
            "seed": one.seed,
            "estimator": one.estimator_name,
            **answer_of(one, _KEPT),
        }
        for one in drive
    ]
    return {"runs": rows}


def methods(table: pd.DataFrame) -> pd.DataFrame:
    """A row a method, the best first among those of its sensor.

    Errors are geometric means over the recordings, a failed run counting as 100 m; `over_best_ours`
    is the paired ratio to the best of ours for that sensor with its 95 % interval.
    """
    errors_m = table[_ERROR].astype(float)
    failed = (table["status"] == Outcome.FAILED) | ~np.isfinite(errors_m)
    kept = table.assign(e=errors_m.where(~failed, FAILED_M))
    wide = kept.pivot(index=["world", "seed"], columns="estimator", values="e")
    means_m = np.exp(np.log(wide).mean())
    by_world = np.exp(np.log(wide).groupby("world").mean())
    times = table.groupby("estimator")["cpu_time_us"].median()
    rows = []
    for name in wide:
        sensor = sensor_of(name)
        ours = [other for other in wide if is_ours(other) and sensor_of(other) == sensor]
        ratio = log_ratio_interval(wide[name], wide[min(ours, key=lambda o: means_m[o])])
        mine = table["estimator"] == name
        rows.append(
            {
                "sensor": sensor,
                "estimator": name,
                "tuned": name.endswith(TUNED),
                "project": version_of(name),
                "answer": "/".join(sorted(set(table.loc[mine, "answer"].dropna()))),
                "runs": int(mine.sum()),
                "failed": int((mine & failed).sum()),
                "ate_rmse_m": means_m[name],
                **{f"ate_rmse_m_{world}": row[name] for world, row in by_world.iterrows()},
                "over_best_ours": ratio.value,
                "low": ratio.low,
                "high": ratio.high,
                "cpu_time_us": times[name],
            }
        )
    return pd.DataFrame(rows).sort_values(["sensor", "ate_rmse_m"], ignore_index=True)


def sensor_of(name: str) -> str:
    """What a method reads beside the wheels."""
    return READS.get(name.removesuffix(TUNED), LASER)


def is_ours(name: str) -> bool:
    """Whether a method belongs to this project."""
    return name.removesuffix(TUNED) not in PACKAGES


def version_of(name: str) -> str:
    """A peer's package and version; `Estima` for ours."""
    if is_ours(name):
        return "Estima"
    package = PACKAGES[name.removesuffix(TUNED)]
    if package == "mrpt":
        said = subprocess.run(
            ["build/peers/mrpt", "version"], capture_output=True, text=True, check=False, timeout=10
        )
        return said.stdout.strip() or package
    return f"{package} {importlib.metadata.version(package)}"
