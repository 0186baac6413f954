"""Methods of other projects beside ours, on the same drives through six classes of world."""

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import log_ratio_interval
from experiments.judging.jobs import Progress, Tables, group_by, tables_of
from experiments.judging.logs import why_missing
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import Profile, Results
from experiments.runs.columns import REVISED
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Row
from experiments.studies.installed import find_absent, why_absent
from experiments.studies.peers import edges
from experiments.studies.peers.logs import LOGS, ordered, over_log
from experiments.studies.peers.own_logs import over_folder as over_folder
from experiments.studies.peers.settings import CLASSES, COMPETING
from experiments.studies.peers.version import sensor_of, version_of
from experiments.sweeps.averages import MIN_UNITS, averages
from experiments.sweeps.plan import plan_experiments
from experiments.sweeps.tune import FAILED_M
from experiments.sweeps.winner import differing_pairs
from sim.errors import InputError

_ERROR = "ate_rmse_m"
_SCORES = (_ERROR, "heading_rmse_rad", "nees_mean", "unused_share")
_METHOD = ["sensor", "answer", "estimator", "arm"]
_DRIVE = ["board", "seed"]
_EXPECTED_NEES = 3.0  # of a planar pose


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run the study and write its tables: the runs, the methods, and those that are missing.

    Parameters
    ----------
    profile
        `quick`: one drive of each class; `full`: all of the study's YAML.
    """
    fewer = [] if profile is Profile.FULL else ["seed=1000"]
    experiments = list(plan_experiments(["study=peers", *fewer]))
    absent = find_absent(experiments)
    present = [e for e in experiments if e.estimator_name not in absent]
    drives = group_by(present, lambda e: (e.label("board"), e.seed))
    made = tables_of(runs, [(drive,) for drive in drives], on_progress)
    out.write_tables(**made, methods=methods(made["runs"]))
    if absent:
        named = pd.DataFrame({"estimator": list(absent), "reason": list(absent.values())})
        out.write_tables(missing=named)


def over_logs(_profile: Profile, on_progress: Progress) -> dict[str, pd.DataFrame]:
    """The table of all methods over the logs of others."""
    if why := why_missing():
        raise InputError(f"{why}; put them there, or name another folder of logs")
    by_edges = [(name,) for name in edges.LOGS]
    by_wheels = [(name,) for name in LOGS]
    share = len(by_edges) / len(by_edges + by_wheels)
    parts = [
        tables_of(edges.over_edges, by_edges, lambda done: on_progress(share * done)),
        tables_of(over_log, by_wheels, lambda done: on_progress(share + (1.0 - share) * done)),
    ]
    return ordered({"logs": pd.concat([part["logs"] for part in parts])})


PARTS = {"logs": over_logs}
REMADE = {"runs": 8.0}  # methods are means of them


def remake(_table: str, row: Cells) -> Remake | None:
    """The call that makes a row again; None if its method is not here."""
    given = [f"study/board={row['board']}", f"seed={row['seed']:.0f}"]
    for one in plan_experiments(["study=peers", *given]):
        if (one.label("arm"), one.estimator_name) == (row["arm"], row["estimator"]):
            return None if why_absent(one) else (runs, ([one],))
    return None


def runs(drive: list[Experiment]) -> Tables:
    """Rows of all methods on one drive; of a method that revises its path, one an answer."""
    rows = [row for one in drive for row in _answers(one)]
    return {"runs": rows}


def _answers(one: Experiment) -> list[Row]:
    found = evaluate(one)[0]
    revised = REVISED + _ERROR in found
    return [
        {
            "board": one.label("board"),
            "seed": one.seed,
            "estimator": one.estimator_name,
            "arm": one.label("arm"),
            "answer": "revised" if prefix else "online",
            "status": found["status"],
            **{name: found.get(prefix + name, np.nan) for name in _SCORES},
            "cpu_time_us": found.get("cpu_time_us", np.nan),
        }
        for prefix in ("", *[REVISED] * revised)
    ]


def methods(table: pd.DataFrame) -> pd.DataFrame:
    """A row a method, arm and answer, the best first among those of its sensor and answer.

    Errors are geometric means over the drives, a failed run counting as 100 m. `level` says
    whether it is the best of its board or does not differ from that by paired t tests of the logs,
    with Holm's method over all pairs of the arms that compete; `level_CLASS` the same on the drives
    of a class. `over_best` is the paired ratio to the best, with its 95 % interval.
    """
    table = _complete(table)
    failed = (table["status"] == Outcome.FAILED) | ~np.isfinite(table[_ERROR].astype(float))
    kept = table.assign(
        sensor=[sensor_of(name) for name in table["estimator"]],
        failed=failed,
        **{_ERROR: table[_ERROR].astype(float).where(~failed, FAILED_M)},
        drive=table["board"] + "/" + table["seed"].astype(str),
    )
    found = kept.groupby(_METHOD).agg(
        runs=("status", "size"),
        failed=("failed", "sum"),
        heading_rmse_rad=("heading_rmse_rad", _geometric),
        nees_over_3=("nees_mean", lambda v: v.mean() / _EXPECTED_NEES),
        used_share=("unused_share", lambda v: 1.0 - v.mean()),
        cpu_time_us=("cpu_time_us", "median"),
    )
    for place, rows in {"": kept, **{f"_{c}": kept[kept["board"] == c] for c in CLASSES}}.items():
        means = averages(rows, _METHOD, "drive", _ERROR)
        names = {"value": _ERROR, "low": "ate_low_m", "high": "ate_high_m"}
        found = found.join(means.rename(columns={k: v + place for k, v in names.items()}))
        found = found.join(_compared(rows, place))
    found = found.reset_index().sort_values(["sensor", "answer", _ERROR], ignore_index=True)
    found.insert(4, "project", [version_of(name) for name in found["estimator"]])
    return found.assign(competes=found["arm"].isin(COMPETING))


def _complete(table: pd.DataFrame) -> pd.DataFrame:
    """The rows, with a failed one where a run that failed has no revised answer."""
    given, drives = (table[c].drop_duplicates() for c in (["estimator", "arm", "answer"], _DRIVE))
    return (
        given.merge(drives, how="cross").merge(table, how="left").fillna({"status": Outcome.FAILED})
    )


def _geometric(values: "pd.Series[float]") -> float:
    known = values.dropna()
    return float(np.exp(np.log(known).mean())) if len(known) else np.nan


def _compared(rows: pd.DataFrame, place: str) -> pd.DataFrame:
    """Each method beside the best of its board: whether it is level, and over all the ratio."""
    parts = []
    for board, part in rows.groupby(["sensor", "answer"]):
        wide = part.pivot(index="drive", columns=["estimator", "arm"], values=_ERROR)
        able = wide[[name for name in wide if name[1] in COMPETING]]
        best = np.log(able).mean().idxmin()
        enough = len(able) >= MIN_UNITS
        differ = differing_pairs(able) if enough else set()
        for name in wide:
            found: Row = {"level" + place: name in able and {best, name} not in differ}
            if not place:
                ratio = log_ratio_interval(wide[name], wide[best])
                found |= {"over_best": ratio.value, "low": ratio.low, "high": ratio.high}
            parts.append({**dict(zip(_METHOD, (*board, *name), strict=True)), **found})
    return pd.DataFrame(parts).set_index(_METHOD)
