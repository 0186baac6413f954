"""Claims TW1 and TW2: what twins of real logs must predict."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from scipy import stats

from experiments.evaluation.statistics import Interval, mean_interval, share_interval
from experiments.judging.claim import Claim, Subject, holds, judge_bounds, shown
from experiments.judging.results import Results
from experiments.studies.twins.settings import LEAST_SHARE, SHOWN, TAU


def judge(results: Results) -> list[Claim]:
    """Judge TW1 and TW2 by the tables."""
    pairs = results.table("pairs")
    return [*tw1(pairs, results.table("others")), *tw2(pairs)]


def tw1(pairs: pd.DataFrame, others: pd.DataFrame) -> Iterator[Claim]:
    """TW1: the log's own twin holds 17 of 20 pairs, in narrow intervals; another's does not.

    Logs on which the twin was built do not judge.
    """
    kept = pairs[~pairs.log.isin(SHOWN)]
    inside, narrow = kept.inside.astype(bool), kept.narrow.astype(bool)
    good, n = int((inside & narrow).sum()), len(kept)
    outside, wide = int((~inside).sum()), int((inside & ~narrow).sum())
    yield Claim(
        Subject("TW1", "held", method="own twin"),
        "share of pairs held by the log's own twin",
        share_interval(good, n),
        f"at least {LEAST_SHARE:g}, in intervals whose ends differ by at most a factor of 4 "
        "(dead reckoning: 12)",
        holds(good / n >= LEAST_SHARE),
        f"{good} of {n} pairs of log and estimator; "
        f"{outside} errors lie outside, and {wide} intervals that hold one are too wide",
        facts={"held": good, "pairs": n, "outside": outside, "wide": wide},
    )
    fewest, most = int(kept.n.min()), int(kept.n.max())
    yield shown(
        Subject("TW1", "inside", method="own twin"),
        "share of errors inside, however wide the interval",
        share_interval(int(inside.sum()), n),
        f"{most if fewest == most else f'{fewest} to {most}'} simulations a log",
    )
    strange = others[(others.log != others.twin) & ~others.log.isin(SHOWN)]
    held, n = int(strange.held.sum()), int(strange.pairs.sum())
    if n:
        yield Claim(
            Subject("TW1", "held", method="other twins"),
            "share of errors held by a twin of another log",
            share_interval(held, n),
            f"below {LEAST_SHARE:g}",
            holds(held / n < LEAST_SHARE),
            f"{held} of {n}",
        )


def tw2(pairs: pd.DataFrame) -> Iterator[Claim]:
    """TW2: the order of the estimators by the twin's medians is that of the log's errors."""
    taus = {
        log: float(stats.kendalltau(rows.median_m, rows.error_m).statistic)
        for log, rows in pairs.groupby("log", sort=False)
    }
    judged = [tau for log, tau in taus.items() if log not in SHOWN and np.isfinite(tau)]
    mean = mean_interval(judged)
    low, high = np.clip([mean.low, mean.high], -1.0, 1.0)  # between which every tau lies
    yield judge_bounds(
        Subject("TW2", "tau"),
        "Kendall's tau of predicted medians and real errors over estimators, mean over logs",
        Interval(mean.value, float(low), float(high)),
        at_least=1e-9,
        criterion="above 0",
        effect=TAU,
    )
    for log, tau in taus.items():
        about = Subject("TW2", "tau", place=str(log))
        yield shown(about, f"Kendall's tau, {log}", Interval.exact(tau))
