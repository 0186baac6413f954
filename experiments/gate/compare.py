"""The regression gate: errors of a suite against a baseline, by paired tests.

A baseline and a check run the same recordings, so d = log(error now) - log(error then), one number
per recording, is free of the recordings' difficulty and noise. An estimator that draws at random
has several runs per recording, and d is the difference of their means. Two questions follow:

1. Is the difference real? Equivalent code draws its errors from the same distributions, so runs
   of then and now can be exchanged within each recording: a permutation test. Where nothing is
   drawn at random, equivalent code gives equal errors to rounding, and any difference beyond 1e-6
   is real.
2. Is it for the worse? A change may raise errors on some recordings and lower them on others; so
   the mean of d must be above zero by a t test over the recordings.

`worse` means yes to both, at a level of 0.008 for the whole check: the larger of the two p counts,
and Holm's method covers all estimators, errors and baselines (`judge`). `better` likewise, in the
other direction.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import pandas as pd
import scipy

from experiments.evaluation.statistics import holm, mean_interval
from experiments.gate.suite import ERRORS
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.errors import require

ALPHA = 0.008  # nominal, of a whole check: 0.02 in effect, since the t test of skewed d overspends
INTERVAL = 0.90  # of one error of one estimator
ROUNDING = 1e-6  # of an error, as a share; machines differ by less than 1e-9
_MOST_WAYS = 2**15 - 1  # to exchange a recording's runs; where there are more,
_DRAWN_WAYS = 4096  # so many are drawn
_MOST_COUNTED = 2**16  # ways to exchange the runs of all recordings
_NEAR_MEAN = 1e-3  # standard deviations, where the saddle-point formula divides zero by zero
_N_WORST = 3
_LEAST_ERROR = 1e-12  # zero has no logarithm
WHICH = ("estimator", "recording", "repeat")


class Change(StrEnum):
    """How an error compares with its baseline's, the gravest first."""

    FAILED = "failed"  # runs fail that did not before
    WORSE = "worse"
    BETTER = "better"
    CHANGED = "changed"  # another result, neither worse nor better on the whole
    EQUAL = "equal"  # no difference is shown
    IDENTICAL = "identical"  # to rounding


@dataclass(frozen=True)
class Finding:
    """One error of one estimator beside one baseline.

    Attributes
    ----------
    estimator, error, baseline
        Whose, which of ERRORS, and `accepted` or `release`.
    n_recordings, n_suite
        Recordings on which both ran to the end, and all of the suite's.
    ratio, low, high
        Geometric mean of now / then over the recordings, with its 90 % t interval.
    p_real, p_general
        (worse, better) of either question.
    verdict
        How it compares.
    message
        What failed.
    worst
        Up to three recordings of the greatest ratio, by their seeds, with the error then and now;
        of a failure, the first recording that fails.
    """

    estimator: str
    error: str
    baseline: str
    n_recordings: int
    n_suite: int
    ratio: float
    low: float
    high: float
    p_real: tuple[float, float]
    p_general: tuple[float, float]
    verdict: Change
    message: str = ""
    worst: tuple[tuple[int, float, float], ...] = ()

    @property
    def alarms(self) -> bool:
        """Whether it fails the check."""
        return self.verdict in (Change.WORSE, Change.FAILED)


def exchange_p(then: Array, now: Array, rng: np.random.Generator) -> tuple[float, float]:
    """P that runs exchanged within each recording differ as far as these, up and down.

    Where the ways to exchange are few, all are counted. Otherwise p comes from the saddle-point
    formula of Lugannani and Rice (1980), whose error is relative: it holds for any small p.

    Parameters
    ----------
    then, now
        (n, B) and (n, C) logs of errors.
    """
    runs = np.concatenate([now, then], axis=1)
    sums = _exchanged_sums(runs - runs.mean(axis=1, keepdims=True), now.shape[1], rng)
    sums = sums[np.ptp(sums, axis=1) > 0.0]
    if len(sums) == 0:
        return 1.0, 1.0
    if len(sums) * math.log(sums.shape[1]) > math.log(_MOST_COUNTED):
        return _saddle_point_p(sums), _saddle_point_p(-sums)
    totals = np.zeros(1)
    for of_recording in sums:
        totals = np.add.outer(totals, of_recording).ravel()
    seen = totals[0]
    slack = 1e-9 * (1.0 + abs(seen))  # sums of the same numbers in another order
    return float(np.mean(totals >= seen - slack)), float(np.mean(totals <= seen + slack))


def _saddle_point_p(sums: Array) -> float:
    """P that a draw from each row of (n, ways), added up, reaches the sum of the first column."""
    seen = float(sums[:, 0].sum())
    centred = sums - sums.mean(axis=1, keepdims=True)
    above = seen - float(sums.mean(axis=1).sum())
    spread = math.sqrt(float(centred.var(axis=1).sum()))
    if abs(above) <= _NEAR_MEAN * spread:
        return float(scipy.stats.norm.sf(above / spread))
    if above < 0.0:
        return 1.0 - _saddle_point_p(-sums)
    least = -len(sums) * math.log(sums.shape[1])  # log p of what is seen, by itself

    def tilted(slope: float) -> tuple[float, float, float]:
        """Cumulant function and its two derivatives."""
        powers = slope * centred
        peaks = powers.max(axis=1, keepdims=True)
        weights = np.exp(powers - peaks)
        totals = weights.sum(axis=1, keepdims=True)
        weights /= totals
        means = (weights * centred).sum(axis=1)
        variance = (weights * centred**2).sum(axis=1) - means**2
        value = (peaks + np.log(totals / sums.shape[1])).sum()
        return float(value), float(means.sum()), float(variance.sum())

    low, high, slope = 0.0, math.inf, above / spread**2
    for _ in range(60):
        value, mean, variance = tilted(slope)
        if abs(mean - above) <= 1e-9 * spread or variance <= 1e-12 * spread**2:
            break
        low, high = (slope, high) if mean < above else (low, slope)
        slope += (above - mean) / variance
        if not low < slope < high:  # Newton's step leads astray
            slope = (low + high) / 2.0 if math.isfinite(high) else 2.0 * low
    bound = min(value - slope * above, 0.0)  # of log p (Chernoff); exact at the greatest sum
    root, scale = math.sqrt(-2.0 * bound), slope * math.sqrt(max(variance, 0.0))
    if root == 0.0 or scale == 0.0:
        return math.exp(bound)
    p = float(scipy.stats.norm.sf(root) + scipy.stats.norm.pdf(root) * (1.0 / scale - 1.0 / root))
    return min(max(p, math.exp(max(least, -700.0))), math.exp(bound))


def _exchanged_sums(runs: Array, n_now: int, rng: np.random.Generator) -> Array:
    """Sums of n_now of each recording's (n, B) runs, (n, ways); the first is that of those seen."""
    if math.comb(runs.shape[1], n_now) <= _MOST_WAYS:
        picks = np.array(list(itertools.combinations(range(runs.shape[1]), n_now)))
        return np.asarray(runs[:, picks].sum(axis=2))
    sums = np.empty((len(runs), _DRAWN_WAYS))
    for row, of_recording in zip(sums, runs, strict=True):
        ways = np.tile(of_recording, (_DRAWN_WAYS, 1))
        rng.permuted(ways[1:], axis=1, out=ways[1:])
        row[:] = ways[:, :n_now].sum(axis=1)
    return sums


def general_p(differences: Array) -> tuple[float, float]:
    """P of the one-sided t tests that the mean of (n,) paired differences is above, below zero."""
    n, mean = len(differences), float(differences.mean())
    spread = float(differences.std(ddof=1)) / math.sqrt(n)
    if spread == 0.0:
        return float(mean <= 0.0), float(mean >= 0.0)
    above = float(scipy.stats.t.sf(mean / spread, n - 1))
    return above, 1.0 - above


def examine(
    which: tuple[str, str, str],
    then: Array,
    now: Array,
    rng: np.random.Generator,
    failure: str = "",
    recordings: Sequence[int] | None = None,
) -> Finding:
    """Compare one error on the recordings where all runs succeed; the verdict is still open.

    It is `identical`, or else `equal` where runs differ by chance, or `changed` where they do not.

    Parameters
    ----------
    which
        Estimator, error, baseline.
    then, now
        (n, B) and (n, C) errors, not finite where a run failed.
    failure
        How runs fail now that did not then; the verdict is then `failed`.
    recordings
        Their seeds, to name the worst by; by default 0 to n - 1.
    """
    sound = np.isfinite(then).all(axis=1) & np.isfinite(now).all(axis=1)
    n, n_suite, ones = int(np.sum(sound)), len(then), (1.0, 1.0)
    if failure or n < 2:
        message, nan = failure or "no run succeeds", math.nan
        return Finding(*which, n, n_suite, nan, nan, nan, ones, ones, Change.FAILED, message)
    logs_then, logs_now = (np.log(np.maximum(runs[sound], _LEAST_ERROR)) for runs in (then, now))
    shared = min(then.shape[1], now.shape[1])
    same = np.abs(logs_now[:, :shared] - logs_then[:, :shared]).max() < ROUNDING
    if same:  # by the same draws, as far as both go
        logs_then, logs_now = logs_then[:, :shared], logs_now[:, :shared]
    differences = logs_now.mean(axis=1) - logs_then.mean(axis=1)
    mean = mean_interval(differences, INTERVAL)
    ratios = (math.exp(mean.value), math.exp(mean.low), math.exp(mean.high))
    if same:
        return Finding(*which, n, n_suite, *ratios, ones, ones, Change.IDENTICAL)
    p_general = general_p(differences)
    seeds = np.arange(n_suite) if recordings is None else np.asarray(recordings)
    most = np.argsort(-differences, kind="stable")[:_N_WORST]
    means = (np.exp(logs[most].mean(axis=1)).tolist() for logs in (logs_then, logs_now))
    worst = tuple(zip(seeds[sound][most].tolist(), *means, strict=True))
    if then.shape[1] == 1:  # nothing random in it
        p_real, verdict = (0.0, 0.0), Change.CHANGED
    else:
        p_real, verdict = exchange_p(logs_then, logs_now, rng), Change.EQUAL
    return Finding(*which, n, n_suite, *ratios, p_real, p_general, verdict, worst=worst)


def judge(findings: Sequence[Finding]) -> list[Finding]:
    """Reach the verdicts of a whole check, of which at most ALPHA raise a false alarm.

    Half of ALPHA goes to the methods that draw at random, and half to the others, of which those
    with identical errors need no test; Holm's method controls each half whatever the dependence.
    That the new errors are larger, for a method that has truly changed, is the claim of either
    test: its p is the larger of both. Beside two baselines that hold the same it is one claim.
    """
    verdicts = {Change.WORSE: 0, Change.BETTER: 1}
    judged = list(findings)
    for open_verdict in (Change.EQUAL, Change.CHANGED):
        claims: dict[Finding, list[int]] = {}
        for i, finding in enumerate(findings):
            if finding.verdict is open_verdict:
                claims.setdefault(dataclasses.replace(finding, baseline=""), []).append(i)
        for verdict, side in verdicts.items():
            ps = [max(f.p_real[side], f.p_general[side]) for f in claims]
            for places, shown in zip(claims.values(), holm(ps, ALPHA / 2.0), strict=True):
                for i in places if shown else ():
                    judged[i] = dataclasses.replace(findings[i], verdict=verdict)
    return judged


def compare(baselines: dict[str, pd.DataFrame], current: pd.DataFrame) -> list[Finding]:
    """Findings of a check against baselines, by name.

    Raises
    ------
    InputError
        If the baselines lack an estimator or a recording, or hold others of the same seed.
    """
    findings = []
    for name, baseline in baselines.items():
        for estimator, now in current.groupby("estimator", sort=False):
            then = baseline[baseline["estimator"] == estimator]
            check_recordings(str(estimator), name, then, now)
            failing = _newly_failing(then, now)
            for error in ERRORS:
                finding = examine(
                    (str(estimator), error, name),
                    by_repeat(then, error),
                    by_repeat(now, error),
                    stream(0, f"exchange/{estimator}/{error}"),
                    failing[1] if failing else "",
                    sorted(then["recording"].unique()),
                )
                if failing:
                    worst = ((failing[0], math.nan, math.nan),)
                    finding = dataclasses.replace(finding, worst=worst)
                findings.append(finding)
    return judge(findings)


def by_repeat(rows: pd.DataFrame, error: str) -> Array:
    """Errors (n, repeats) of one estimator, in the order of the recordings."""
    return np.asarray(rows.pivot(index="recording", columns="repeat", values=error), np.float64)


def how_to_renew(name: str) -> str:
    """Say how a new baseline is started."""
    also = " and pin the release with it" if name == "release" else ""
    return f"accept a check with a reason{also} to start a new baseline"


def check_recordings(estimator: str, name: str, then: pd.DataFrame, now: pd.DataFrame) -> None:
    """Refuse rows that cannot be compared with a baseline's, run by run.

    Raises
    ------
    InputError
        If the baseline has no such estimator, or it ran over other recordings.
    """
    remedy = how_to_renew(name)
    require(not then.empty, f"the {name} baseline has no {estimator}; {remedy}")
    before, after = (
        rows.drop_duplicates("recording").set_index("recording") for rows in (then, now)
    )
    require(
        set(before.index) == set(after.index),
        f"the {name} baseline of {estimator} has other recordings; {remedy}",
    )
    after = after.loc[before.index]
    away = np.abs(after["fingerprint"] - before["fingerprint"])
    near = away <= ROUNDING * np.abs(before["fingerprint"])  # false for NaN
    other = ~near & (after["checksum"] != before["checksum"])
    require(
        not other.any(),
        f"recording {other.idxmax()} of {estimator} is not that of the {name} baseline: what "
        f"simulates it has changed, and errors cannot be compared run by run; {remedy}",
    )


def failed_runs(rows: pd.DataFrame) -> pd.Series:
    """Which runs ended in an exception or in errors that are not finite."""
    finite = np.isfinite(rows[list(ERRORS)].to_numpy(np.float64)).all(axis=1)
    return (rows["status"] != "ok") | ~finite


def how(run: pd.Series) -> str:
    """Say how a run failed."""
    return str(run["status"]) if run["status"] != "ok" else "errors that are not finite"


def _newly_failing(then: pd.DataFrame, now: pd.DataFrame) -> tuple[int, str] | None:
    """First recording where runs fail and none of the baseline's did, and how; None: no such."""
    bad = now[failed_runs(now)]
    new = bad[~bad["recording"].isin(then.loc[failed_runs(then), "recording"])]
    for _, first in new.head(1).iterrows():
        line = f"{len(bad)} of {len(now)} runs fail; recording {first['recording']}: {how(first)}"
        return int(first["recording"]), line
    return None
