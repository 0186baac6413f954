"""Wean Hall's second log: what `mcl` says of itself as logged, and with wheels that are lifted."""

import numpy as np
import pandas as pd

from estimators.base import Estimate
from experiments.judging.jobs import Progress
from experiments.judging.logs import why_missing
from experiments.judging.results import Profile
from experiments.runs.evaluate import run_over
from experiments.studies.peers.logs import LOGS, methods_of
from experiments.studies.self_knowledge.planted import lift_wheels
from sim.arrays import Array
from sim.errors import InputError

_LOG, _METHOD = "wean 2", "mcl"


def over_wean(_profile: Profile, on_progress: Progress) -> dict[str, pd.DataFrame]:
    """Table of what was said over the log, and how far apart the two paths are, m."""
    if why := why_missing():
        raise InputError(f"{why}; put them there, or name another folder of logs")
    case = LOGS[_LOG]()
    one = next(one for one in methods_of(case) if one.estimator_name == _METHOD)
    paths = list[Estimate]()
    for recording in (case.recording, lift_wheels(case.recording)):
        rng = np.random.default_rng(0)
        online, _ = run_over(recording, one.estimator(), case.prior, rng, ("lost",))
        paths.append(online)
        on_progress(len(paths) / 2.0)
    logged, lifted = paths
    stamps = logged.stamps
    table = {
        "stamp_s": stamps - stamps[0],
        "lost": _lost(logged),
        "lost_lifted": _lost(lifted),
        "apart_m": np.hypot(*(lifted.means - logged.means)[:, :2].T),
    }
    return {"wean": pd.DataFrame(table)}


def _lost(path: Estimate) -> Array:
    said = path.extras["lost"]
    return np.array([np.nan if value is None else value for value in said], np.float64)
