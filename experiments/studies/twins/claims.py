"""Claims TW1 and TW2: what twins of real logs must predict."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
import scipy

from experiments.evaluation.statistics import (
    Interval,
    log_ratio_interval,
    mean_interval,
    share_interval,
)
from experiments.judging.claim import (
    Claim,
    Subject,
    beside,
    holds,
    judge_bounds,
    shown,
    with_remark,
)
from experiments.judging.region_runs import judge_tables
from experiments.judging.results import Results
from experiments.studies.twins.settings import COVERED, LEAST_SHARE, SHOWN, TAU


def judge(results: Results) -> list[Claim]:
    """Judge TW1 and TW2 by the tables."""
    return judge_tables(results, {
        "TW1": (tw1, {"pairs": (), "others": (), "minutes": ("crps_own",)}),
        "TW2": (tw2, {"pairs": ()}),
    })  # fmt: skip


def tw1(pairs: pd.DataFrame, others: pd.DataFrame, minutes: pd.DataFrame) -> Iterator[Claim]:
    """TW1: a twin predicts the errors over a minute: it covers them, and better than others do.

    The log is the unit of inference; logs on which the twin was built do not judge. Beside stands
    the old form: whole errors, in intervals that are too wide for a perfect twin to pass it.
    """
    kept = minutes[~minutes.log.isin(SHOWN)]
    covered = mean_interval(kept.groupby("log").inside.mean())
    about, label = Subject("TW1", "covered"), "share of errors over a minute in intervals of 95 %"
    claim = judge_bounds(about, label, covered, at_least=COVERED)
    names = list(kept["log"].unique())
    yield with_remark(claim, f"{len(kept)} minutes and methods of {len(names)} logs", logs=names)
    logs = np.log(kept.groupby("log")[[c for c in kept if c.startswith("crps_")]].mean())
    for over, words, is_judged in (
        ("climatology", "the errors on other logs", True),
        ("others", "other logs' twins", True),
        ("right", "the twin itself, if it were right", False),
    ):
        found = log_ratio_interval(np.exp(logs["crps_own"]), np.exp(logs[f"crps_{over}"]))
        label = f"CRPS of a log's own twin over that of {words}"
        about = Subject("TW1", "CRPS", over=over)
        claim = judge_bounds(about, label, found, at_most=1.0)
        yield claim if is_judged else shown(about, label, found)
    yield from _as_wholes(pairs, others)


def _as_wholes(pairs: pd.DataFrame, others: pd.DataFrame) -> Iterator[Claim]:
    """Judge whole errors: 17 of 20 pairs held in narrow intervals, and not by another's twin."""
    kept = pairs[~pairs.log.isin(SHOWN)]
    inside, narrow = kept.inside.astype(bool), kept.narrow.astype(bool)
    good, n = int((inside & narrow).sum()), len(kept)
    outside, wide = int((~inside).sum()), int((inside & ~narrow).sum())
    held = Claim(
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
    yield beside(held)
    strange = others[(others.log != others.twin) & ~others.log.isin(SHOWN)]
    held_by, n = int(strange.held.sum()), int(strange.pairs.sum())
    if n:
        yield beside(
            Claim(
                Subject("TW1", "held", method="other twins"),
                "share of errors held by a twin of another log",
                share_interval(held_by, n),
                f"below {LEAST_SHARE:g}",
                holds(held_by / n < LEAST_SHARE),
                f"{held_by} of {n}",
            )
        )


def tw2(pairs: pd.DataFrame) -> Iterator[Claim]:
    """TW2: the order of the estimators by the twin's medians is that of the log's errors."""
    taus = {
        log: float(scipy.stats.kendalltau(rows.median_m, rows.error_m).statistic)
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
