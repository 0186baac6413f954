"""Do methods notice that they are lost? Alarms over drives as they are, and over planted losses.

Planted are a start misread by metres and a radian, and wheels lifted on the way, whose encoders
stand while the robot goes on.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pandas as pd

from experiments.evaluation.alarm import Evidence, alarm_curve, evidence_of
from experiments.judging.jobs import Progress, Tables, group_by, tables_of
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import Profile, Results
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.sweeps.plan import plan_experiments
from sim.recording import Recording

OFF = np.array([2.0, 2.0, 1.0])  # of a misread start, m, m, rad
LIFTED = (0.4, 0.5)  # share of the drive
PLANTED = ("nothing", "start", "wheels")
_FEWER, _QUIET = "seed=range(1000,1004)", "study=self_knowledge_quiet"
_FIRST_QUIET = 10_000  # seed


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run the study and write its tables: what each method said, and its curve of alarms.

    Parameters
    ----------
    profile
        `quick`: 4 drives of each method; `full`: 250 of `mcl`, 60 of the others, and 800 longer
        ones of `mcl` in which nothing is planted.
    """
    is_full = profile is Profile.FULL
    runs = plan_experiments(["study=self_knowledge", *([] if is_full else [_FEWER])])
    jobs: list[list[object]] = [[part] for part in group_by(runs, lambda one: one.seed)]
    if is_full:
        jobs += [[[one], PLANTED[:1]] for one in plan_experiments([_QUIET])]
    made = tables_of(said, jobs, on_progress)
    out.write_tables(**made, curve=curves(made["said"]))


REMADE = {"said": 60.0}  # the curves follow from them


def remake(_table: str, row: Cells) -> Remake:
    """The call that makes a row again."""
    seed = f"seed={row['seed']:.0f}"
    study = _QUIET if row["seed"] >= _FIRST_QUIET else "study=self_knowledge"
    runs = plan_experiments([study, seed])
    own = [one for one in runs if one.estimator_name == row["method"]]
    return said, (own, [str(row["planted"])])


def lift_wheels(recording: Recording) -> Recording:
    """The recording with encoders that stand for a part of the drive."""
    wheels = recording.wheels
    ends = np.quantile(wheels.stamps, LIFTED)
    begin_m, end_m = wheels.at(ends)
    before, after = (wheels.stamps < ends[0])[:, None], (wheels.stamps > ends[1])[:, None]
    stands = np.where(after, wheels.position_m - end_m + begin_m, begin_m)
    position_m = np.where(before, wheels.position_m, stands)
    return dataclasses.replace(recording, wheels=dataclasses.replace(wheels, position_m=position_m))


def said(runs: Sequence[Experiment], planted: Sequence[str] = PLANTED) -> Tables:
    """What each run over one recording said, in losses and in quiet windows."""
    recording = runs[0].recording()
    truth, rows = recording.truth_at(recording.frame_stamps), list[Row]()
    for one in runs:
        for what in planted:
            prior = one.prior(recording)
            if what == "start" and prior.mean is not None:
                prior = dataclasses.replace(prior, mean=prior.mean + OFF)
            driven = lift_wheels(recording) if what == "wheels" else recording
            rng = stream(one.seed, f"estimator/{one.estimator_name}/{what}")
            online, _ = run_over(driven, one.estimator(), prior, rng, ("lost",))
            labels: Row = {"method": one.estimator_name, "planted": what, "seed": one.seed}
            kinds = evidence_of(truth, online)._asdict()
            rows += [
                {**labels, "kind": kind, "number": number, "signal": float(value)}
                for kind, values in kinds.items()
                for number, value in enumerate(values)
            ]
    return {"said": rows}


def curves(table: pd.DataFrame) -> pd.DataFrame:
    """Share of losses missed against false alarms an hour, by method."""
    parts = []
    for method, own in table.groupby("method"):
        both = (own.loc[own["kind"] == kind, "signal"].to_numpy(float) for kind in Evidence._fields)
        evidence = Evidence(*both)
        rows = pd.DataFrame(alarm_curve([evidence]), columns=["threshold", "missed", "false_per_h"])
        counts = {"losses": len(evidence.peaks), "quiet": len(evidence.quiet)}
        parts.append(rows.assign(method=method, **counts))
    return pd.concat(parts, ignore_index=True)
