"""Errors over stretches of a minute, and proper scores of what twins predict of them.

A log's whole error hangs on a few turns; over its minutes luck averages out. The CRPS of a
prediction is the mean distance of its draws to what comes, less half of that among the draws
(Gneiting and Raftery 2007, eq. (21)); it is lowest for the true distribution.
"""

import functools

import numpy as np
import pandas as pd

from estimators.base import Estimate
from experiments.studies.twins.settings import SEGMENT_S
from sim import se2
from sim.arrays import Array
from sim.recording import Recording

_KEYS = ["log", "kind", "method", "segment"]


def segment_errors_m(recording: Recording, estimate: Estimate) -> Array:
    """Position error (N,) of the motion over each whole minute, m; NaN where the truth is lost."""
    stamps = estimate.stamps
    edges = np.searchsorted(stamps, np.arange(stamps[0], stamps[-1], SEGMENT_S))
    truth = recording.truth_at(stamps[edges])
    moved, true = (se2.between(path[:-1], path[1:]) for path in (estimate.means[edges], truth))
    return np.asarray(np.hypot(*(moved - true)[:, :2].T))


def crps(draws: Array, value: float) -> float:
    """CRPS of draws (N,) for a value."""
    x, n = np.sort(draws), len(draws)
    among = 2.0 * float(np.sum((2.0 * np.arange(1, n + 1) - n - 1.0) * x)) / n**2
    return float(np.mean(np.abs(x - value))) - 0.5 * among


def score_segments(segments: pd.DataFrame) -> pd.DataFrame:
    """A row a log, method and minute: its real error, and how well it is predicted.

    `inside` says whether it lies in the 95 % interval of the log's own twin; `crps_` is by that
    twin (`own`), by the twins of other logs of its kind (`others`), by the real errors of the other
    logs (`climatology`), and what the own twin would have if it were right (`right`).
    """
    known = segments.dropna(subset="error_m")
    real, simulated = known[known.seed < 0], known[known.seed >= 0]
    draws = {key: part.error_m.to_numpy() for key, part in simulated.groupby(_KEYS)}

    @functools.cache
    def of_other_logs(log: str, kind: str, method: str) -> tuple[Array, Array]:
        """Errors of their twins, and their real ones."""
        alike = (known.kind == kind) & (known.method == method) & (known.log != log)
        errors, simulated = known.error_m[alike].to_numpy(), known.seed[alike].to_numpy() >= 0
        return errors[simulated], errors[~simulated]

    rows = []
    for row in real.itertuples():
        own = draws.get((row.log, row.kind, row.method, row.segment))
        others, past = of_other_logs(row.log, row.kind, row.method)
        if own is None or len(own) < 2 or not len(past):
            continue
        low, high = np.quantile(own, [0.025, 0.975])
        again = [crps(np.delete(own, i), value) for i, value in enumerate(own)]
        rows.append(
            {
                **{key: getattr(row, key) for key in _KEYS},
                "error_m": row.error_m,
                "inside": bool(low <= row.error_m <= high),
                "crps_own": crps(own, row.error_m),
                "crps_others": crps(others, row.error_m),
                "crps_climatology": crps(past, row.error_m),
                "crps_right": float(np.mean(again)),
            }
        )
    return pd.DataFrame(rows)
