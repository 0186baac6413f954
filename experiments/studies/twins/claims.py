"""Claims TW1 and TW2: what twins of real logs must predict."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from scipy import stats

from experiments.evaluation.statistics import Interval, mean_interval, share_interval
from experiments.judging.by_words import (
    Claim,
    Conclusion,
    banded,
    beside,
    conclude,
    holds,
    percent,
    pick,
    plain,
    shown,
)
from experiments.judging.results import Results
from experiments.studies.twins.settings import LEAST_SHARE, SHOWN

_HELD, _OTHERS = "pairs held by the log's own twin", "by a twin of another log"


def judge(made: Results) -> list[Claim]:
    """Judge TW1 and TW2 by the tables."""
    pairs = made.table("pairs")
    return [*tw1(pairs, made.table("others")), *tw2(pairs)]


def conclusions(_made: Results, claims: Sequence[Claim]) -> list[Conclusion]:
    """Verdict and sentence of TW1 and TW2."""
    sentences: dict[str, Callable[[Sequence[Claim]], str]] = {
        "TW1": tw1_sentence,
        "TW2": tw2_sentence,
    }
    return conclude(claims, sentences, "logs")


def tw1(pairs: pd.DataFrame, others: pd.DataFrame) -> list[Claim]:
    """TW1: the log's own twin holds 17 of 20 pairs, in narrow intervals; another's does not.

    Logs on which the twin was built do not judge.
    """
    kept = pairs[~pairs.log.isin(SHOWN)]
    good = kept.inside.astype(bool) & kept.narrow.astype(bool)
    outside = int((~kept.inside.astype(bool)).sum())
    wide = int((~kept.narrow.astype(bool) & kept.inside.astype(bool)).sum())
    own = Claim(
        "TW1",
        f"share of {_HELD}",
        share_interval(int(good.sum()), len(good)),
        f"at least {LEAST_SHARE:g}, in intervals whose ends differ by at most a factor of 4 "
        "(dead reckoning: 12)",
        holds(bool(good.mean() >= LEAST_SHARE)),
        f"{int(good.sum())} of {len(good)} pairs of log and estimator; "
        f"{outside} errors lie outside, and {wide} intervals that hold one are too wide",
    )
    inside = share_interval(int(kept.inside.sum()), len(kept))
    fewest, most = int(kept.n.min()), int(kept.n.max())
    runs = f"{most}" if fewest == most else f"{fewest} to {most}"
    every = shown(
        "TW1",
        "share of errors inside, however wide the interval",
        inside,
        f"{runs} simulations a log",
    )
    strange = others[(others.log != others.twin) & ~others.log.isin(SHOWN)]
    held, n = int(strange.held.sum()), int(strange.pairs.sum())
    if not n:
        return [own, every]
    other = Claim(
        "TW1",
        f"share of errors held {_OTHERS}",
        share_interval(held, n),
        f"below {LEAST_SHARE:g}",
        holds(held / n < LEAST_SHARE),
        f"{held} of {n}",
    )
    return [own, every, other]


def tw1_sentence(rows: Sequence[Claim]) -> str:
    """Say how many errors the twins hold, and how many those of other logs."""
    held, missed = pick(rows, _HELD).reason.split("; ")
    said = f"A log's own twin holds {held}: {missed}."
    for row in rows:
        if _OTHERS in row.statistic:
            said += f" A twin of another log holds {percent(row.found.value)} of the errors."
    return said


def tw2(pairs: pd.DataFrame) -> list[Claim]:
    """TW2: the order of the estimators by the twin's medians is that of the log's errors."""
    taus = {
        log: float(stats.kendalltau(rows.median_m, rows.error_m).statistic)
        for log, rows in pairs.groupby("log", sort=False)
    }
    judged = [tau for log, tau in taus.items() if log not in SHOWN and np.isfinite(tau)]
    label = "Kendall's tau of predicted medians and real errors over estimators, mean over logs"
    mean = mean_interval(judged)
    low, high = np.clip([mean.low, mean.high], -1.0, 1.0)  # between which every tau lies
    found = Interval(mean.value, float(low), float(high))
    claim = banded("TW2", label, found, at_least=1e-9, criterion="above 0", n=len(judged))
    each = [
        beside(shown("TW2", f"Kendall's tau, {log}", Interval.exact(tau)))
        for log, tau in taus.items()
    ]
    return [claim, *each]


def tw2_sentence(rows: Sequence[Claim]) -> str:
    """Say how alike the orders are."""
    found = pick(rows, "mean over logs").found
    return (
        f"The order of the estimators that the twins predict has a Kendall's tau of "
        f"{plain(found.value)} ({plain(found.low)} to {plain(found.high)} over logs) with that on "
        "the logs."
    )
