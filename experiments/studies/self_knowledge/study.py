"""Do methods know their error, and notice that they are lost? Over drives as they are, and planted.

Planted are a start misread by metres and a radian, and wheels lifted on the way, whose encoders
stand while the robot goes on.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from estimators.base import Estimate
from experiments.evaluation.alarm import evidence_of
from experiments.evaluation.metrics import score
from experiments.evaluation.statistics import bootstrap_interval
from experiments.judging.jobs import Progress, Tables, group_by, tables_of
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import Profile, Results
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.studies.installed import installed, why_absent
from experiments.studies.self_knowledge.planted import lift_wheels
from experiments.studies.self_knowledge.wean import over_wean
from experiments.sweeps.plan import plan_experiments
from sim.recording import Recording

OFF = np.array([2.0, 2.0, 1.0])  # of a misread start, m, m, rad
PLANTED = ("nothing", "start", "wheels")
_FEWER, _QUIET = "seed=range(1000,1004)", "study=self_knowledge_quiet"
_SCORES = (
    "ate_rmse_m",
    "heading_rmse_rad",
    "nees_mean",
    "inside_50_share",
    "inside_90_share",
    "inside_95_share",
    "nees_counted_share",
    "sharpness_m",
)


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run the study and write its tables.

    They are: what each method said in losses and without one; of each drive in which nothing is
    planted how it knew its error, and the means of that.

    Parameters
    ----------
    profile
        `quick`: 4 drives of each method; `full`: 250 of `mcl`, 60 of the others.
    """
    is_full = profile is Profile.FULL
    runs = installed(plan_experiments(["study=self_knowledge", *([] if is_full else [_FEWER])]))
    drives = group_by(runs, lambda one: one.seed)
    made = tables_of(said, [(drive,) for drive in drives], on_progress)
    out.write_tables(**made, coverage=covered(made["consistency"]))


def over_quiet(_profile: Profile, on_progress: Progress) -> dict[str, pd.DataFrame]:
    """The table of what `mcl` said over hours in which nothing is planted."""
    return tables_of(quiet, [(one,) for one in plan_experiments([_QUIET])], on_progress)


PARTS = {"quiet": over_quiet, "wean": over_wean}
REMADE = {"said": 60.0, "consistency": 60.0, "quiet": 15.0}  # the others follow from them


def remake(table: str, row: Cells) -> Remake | None:
    """The call that makes a row again; None if its method is not here."""
    seed = f"seed={row['seed']:.0f}"
    if table == "quiet":
        return quiet, tuple(plan_experiments([_QUIET, seed]))
    runs = plan_experiments(["study=self_knowledge", seed])
    own = [one for one in runs if one.estimator_name == row["method"]]
    planted = [str(row.get("planted", PLANTED[0]))]
    return None if any(map(why_absent, own)) else (said, (own, planted))


def said(runs: Sequence[Experiment], planted: Sequence[str] = PLANTED) -> Tables:
    """What each run over one recording said, in losses and in quiet windows; how it knew its error.

    Returns
    -------
    Tables
        `said`, a row a loss, a window or a run that failed, and `consistency`, a row an answer in
        a drive as it is.
    """
    recording = runs[0].recording()
    rows, known = list[Row](), list[Row]()
    for one in runs:
        for what in planted:
            prior = one.prior(recording)
            if what == "start" and prior.mean is not None:
                prior = dataclasses.replace(prior, mean=prior.mean + OFF)
            driven = lift_wheels(recording) if what == "wheels" else recording
            rng = stream(one.seed, f"estimator/{one.estimator_name}/{what}")
            labels: Row = {"method": one.estimator_name, "planted": what, "seed": one.seed}
            try:
                online, revised = run_over(driven, one.estimator(), prior, rng, ("lost",))
            except RuntimeError:  # how GTSAM ends where it has no solution
                rows.append({**labels, "kind": "failed", "number": 0})
                continue
            kinds = evidence_of(recording.truth_at(online.stamps), online)._asdict()
            rows += [
                {**labels, "kind": kind, "number": number, "signal": float(value)}
                for kind, values in kinds.items()
                for number, value in enumerate(values)
            ]
            if what == PLANTED[0]:
                known += [
                    consistency(recording, answer, labels) for answer in (online, revised) if answer
                ]
    return {"said": rows, "consistency": known}


def quiet(one: Experiment) -> Tables:
    """What a run said in a drive in which nothing is planted."""
    return {"quiet": said([one], PLANTED[:1])["said"]}


def consistency(recording: Recording, answer: Estimate, labels: Row) -> Row:
    """How an answer knew its error over a drive."""
    scores = score(recording, answer)
    return {**labels, "answer": answer.kind, **{key: scores.get(key, math.nan) for key in _SCORES}}


def covered(table: pd.DataFrame) -> pd.DataFrame:
    """Means of the scores of `consistency` by method and answer.

    The interval of the share inside 95 % is the bootstrap over drives.
    """
    rows = list[Row]()
    for (method, answer), own in table.dropna().groupby(["method", "answer"]):
        inside = own["inside_95_share"].to_numpy(float)
        of = bootstrap_interval(inside, lambda a: float(a.mean()), np.random.default_rng(0))
        labels: Row = {"method": method, "answer": answer, "drives": len(own)}
        means = {key: float(own[key].mean()) for key in _SCORES}
        rows.append({**labels, **means, "low": of.low, "high": of.high})
    return pd.DataFrame(rows)
