"""How often a whole check errs, over many checks resampled from the tracked baselines' rows."""

import itertools
import math
from functools import cache
from itertools import permutations

import numpy as np
import pytest
from scipy import special, stats

from experiments.evaluation.statistics import share_interval
from experiments.gate.baseline import baseline_paths, read_baseline
from experiments.gate.compare import ALPHA, Change, Finding, exchange_p, judge
from experiments.gate.power import arrays
from experiments.gate.suite import ERRORS

N_CHECKS = 2000
GOAL = 0.02
_CANNOT = 1.0  # p of what no test could reject


@cache
def material():
    """Scatter of neutral changes, and runs of methods that draw at random: (errors, n[, runs]).

    A change of a deterministic method that is neutral is as one method put in another's place on
    the same recordings, its mean taken away. It is correlated over errors, skewed, heavy-tailed.
    """
    logs = {
        key: np.log(runs)
        for key, runs in arrays(read_baseline(baseline_paths("check")["accepted"]).rows).items()
    }
    names = list(dict.fromkeys(name for name, _ in logs))
    whole = {name: np.array([logs[name, error] for error in ERRORS]) for name in names}
    fixed = {name: runs[:, :, 0] for name, runs in whole.items() if runs.shape[2] == 1}
    changes = [
        d - d.mean(axis=1, keepdims=True)
        for a, b in permutations(fixed, 2)
        if fixed[a].shape == fixed[b].shape
        and np.isfinite(d := fixed[a] - fixed[b]).all()
        and np.ptp(d, axis=1).min() > 0.0
    ]
    drawn = {
        name: (runs - runs.mean(axis=2, keepdims=True))
        * math.sqrt(runs.shape[2] / (runs.shape[2] - 1))
        for name, runs in whole.items()
        if runs.shape[2] > 1 and np.isfinite(runs).all()
    }
    return changes, drawn


def t_p(d):
    """P of the one-sided t tests of (errors, n) differences."""
    n, mean = d.shape[1], d.mean(axis=1)
    away = d - mean[:, None]
    spread = np.sqrt(np.einsum("en,en->e", away, away) / (n * (n - 1)))
    return special.stdtr(n - 1, -mean / spread)


def findings_of(name, baseline, logs_then, logs_now, rng):
    """Findings as `examine` makes them; the costly p only where the other leaves a verdict open."""
    d = logs_now.mean(axis=2) - logs_then.mean(axis=2)
    fixed = logs_then.shape[2] == 1
    for e, (error, p) in enumerate(zip(ERRORS, t_p(d), strict=True)):
        real = 0.0 if fixed else _CANNOT
        if not fixed and p <= ALPHA / 2.0:
            real = exchange_p(logs_then[e], logs_now[e], rng)[0]
        yield Finding(
            name, error, baseline, d.shape[1], d.shape[1], math.exp(d[e].mean()), 0.0, 0.0,
            (real, _CANNOT), (float(p), _CANNOT), Change.CHANGED if fixed else Change.EQUAL,
        )  # fmt: skip


def drawn_check(n_estimators, rng, *, neutral, rise=0.0, of=None):
    """A whole check of equivalent random methods and changed deterministic ones.

    Parameters
    ----------
    neutral
        Share of the deterministic methods that were changed, neutrally.
    rise, of
        Added to the logs of the new errors of one random method.
    """
    changes, drawn = material()
    n_random = round(n_estimators * 4 / 14)
    found = []
    for i in range(n_random):
        kind = of if i == 0 and of else list(drawn)[i % len(drawn)]
        runs = drawn[kind]
        n, n_runs = runs.shape[1:]
        n_now = 2 if n_runs == 4 else max(n_runs // 2, 1)
        rows = rng.integers(n, size=(n, 1))
        picks = [rng.integers(n_runs, size=(n, k)) for k in (n_now, n_runs, n_runs)]
        now, *thens = (runs[:, rows, pick] for pick in picks)
        now = now + (rise if i == 0 else 0.0)
        for baseline, then in zip(("accepted", "release"), thens, strict=True):
            found += findings_of(f"r{i}", baseline, then, now, rng)
    for i in range(round(neutral * (n_estimators - n_random))):
        d = changes[rng.integers(len(changes))]
        d = d[:, rng.integers(d.shape[1], size=d.shape[1]), None]
        found += findings_of(f"d{i}", "accepted", np.zeros_like(d), d, rng)
    return judge(found)


def alarms(n_checks, *check, **options):
    """Share of checks in which anything is called worse, with its interval."""
    hits = sum(
        any(f.alarms for f in drawn_check(*check, np.random.default_rng([1000, i]), **options))
        for i in range(n_checks)
    )
    return share_interval(hits, n_checks)


def test_the_fast_t_test_is_that_of_scipy():
    d = np.random.default_rng(0).standard_normal((3, 40)) + 0.2
    expected = stats.ttest_1samp(d, 0.0, axis=1, alternative="greater").pvalue
    np.testing.assert_allclose(t_p(d), expected, rtol=1e-9)


@pytest.mark.parametrize("neutral", [0.0, 0.1, 1.0])
def test_a_drawn_check_is_one_of_all_methods(neutral):
    found = drawn_check(14, np.random.default_rng(0), neutral=neutral)
    assert len({f.estimator for f in found}) == 4 + round(10 * neutral)
    assert not any(f.alarms for f in found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_estimators", "neutral"),
    [
        *itertools.product((14, 100), (0.1, 1.0)),
        (500, 0.1),
        pytest.param(500, 1.0, marks=pytest.mark.xfail(run=False, reason="2.3 % [1.7, 3.1]")),
    ],
)
def test_false_alarms_of_a_whole_check(n_estimators, neutral):
    share = alarms(N_CHECKS, n_estimators, neutral=neutral)
    print(f"{n_estimators} estimators, {neutral:.0%} changed neutrally: {share}")
    assert share.value <= GOAL


@pytest.mark.slow
@pytest.mark.parametrize("n_estimators", [14, 100, 500])
def test_power_of_a_whole_check(n_estimators):
    for kind in material()[1]:
        for worse in (1.05, 1.10):
            options = {"neutral": 0.0, "rise": math.log(worse), "of": kind}
            share = alarms(100, n_estimators, **options)
            print(f"{n_estimators} estimators, {kind} {worse - 1.0:.0%} worse: {share}")
            assert share.high >= (0.9 if kind == "mcl" else 0.0)
