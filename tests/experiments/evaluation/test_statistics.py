import numpy as np
import pytest

from experiments.evaluation import statistics
from experiments.evaluation.statistics import Interval
from experiments.judging.claim import Subject, judge_equivalent, judge_interval
from sim.errors import InputError

ABOUT = Subject("X1", "a ratio")


def test_verdicts():
    assert judge_interval(Interval(1, 0.9, 1.1), 0.8, 1.25) == "reproduced"
    assert judge_interval(Interval(1, 0.7, 1.1), 0.8, 1.25) == "undecided"
    assert judge_interval(Interval(2, 1.5, 2.5), 0.8, 1.25) == "not_reproduced"
    assert judge_interval(Interval(2, np.nan, np.nan), 0.8) == "undecided"


@pytest.mark.parametrize("kind", ["mean", "bootstrap", "log_ratio"])
def test_intervals_cover_the_truth_as_often_as_they_say(kind):
    rng, hits, n = np.random.default_rng(0), 0, 400
    for _ in range(n):
        sample = rng.gamma(4.0, 0.25, 30)
        if kind == "mean":
            found, truth = statistics.mean_interval(sample), 1.0
        elif kind == "bootstrap":
            found = statistics.bootstrap_interval(sample, lambda v: float(v.mean()), rng, 300)
            truth = 1.0
        else:
            common = rng.lognormal(size=30)
            found = statistics.log_ratio_interval(
                common * 2.0 * rng.lognormal(0, 0.2, 30), common * rng.lognormal(0, 0.2, 30)
            )
            truth = 2.0
        hits += found.low <= truth <= found.high
    assert 0.90 <= hits / n <= 0.98


def test_share_interval_is_conservative():
    rng = np.random.default_rng(1)
    hits = rng.binomial(200, 0.95, 500)
    covered = [statistics.share_interval(int(h), 200) for h in hits]
    assert np.mean([c.low <= 0.95 <= c.high for c in covered]) >= 0.945


def test_equivalence_and_trend():
    rng = np.random.default_rng(2)
    a = rng.lognormal(0, 0.1, 100)
    same = judge_equivalent(ABOUT, "", a * rng.lognormal(0.0, 0.1, 100), a, 0.25)
    other = judge_equivalent(ABOUT, "", a * rng.lognormal(0.4, 0.1, 100), a, 0.25)
    assert same.verdict == "reproduced"
    assert other.verdict == "not_reproduced"
    assert other.found.value == pytest.approx(np.exp(0.4), rel=0.05)
    falling = np.arange(5)[::-1] + 0.8 * rng.standard_normal((20, 5))
    assert statistics.page_trend_p(falling) < 1e-4
    assert statistics.page_trend_p(-falling) > 0.5
    assert statistics.wilcoxon_p(a, 1.2 * a * rng.lognormal(0, 0.1, 100)) < 1e-6


def test_too_few_data_decide_nothing():
    rng = np.random.default_rng(4)
    for found in (
        statistics.mean_interval([]),
        statistics.mean_interval([1.0]),
        statistics.bootstrap_interval([1.0], lambda v: float(v.mean()), rng),
        statistics.bootstrap_interval([], lambda v: float(v.mean()), rng),
        statistics.share_interval(0, 0),
        statistics.log_ratio_interval([1.0], [1.0]),
        judge_equivalent(ABOUT, "", [1.0], [1.0], 0.25).found,
    ):
        assert judge_interval(found, 0.5, 2.0) == "undecided"


def test_the_bootstrap_draws_whole_recordings():
    """Repeats of one recording agree, so their number must not narrow the interval."""
    rng = np.random.default_rng(5)
    one_each = rng.normal(size=(25, 1))
    nested = np.repeat(one_each, 50, axis=1)
    widths = []
    for data in (one_each, nested):
        found = statistics.bootstrap_interval(
            data, lambda v: float(v.mean()), np.random.default_rng(6)
        )
        widths.append(found.high - found.low)
    assert widths[0] == pytest.approx(widths[1])


def test_the_bootstrap_of_few_recordings_is_wide_enough():
    rng, n, hits = np.random.default_rng(8), 500, 0
    for _ in range(n):
        found = statistics.bootstrap_interval(
            rng.normal(size=8), lambda v: float(v.mean()), rng, 200
        )
        hits += found.low <= 0.0 <= found.high
    assert 0.925 <= hits / n <= 0.975  # plain percentiles: 0.88


def test_equivalence_without_spread():
    same = judge_equivalent(ABOUT, "", [1.1, 2.2, 3.3], [1.0, 2.0, 3.0], 0.25)
    assert same.found.value == pytest.approx(1.1)
    assert same.verdict == "reproduced"
    assert judge_equivalent(ABOUT, "", [2.0, 4.0], [1.0, 2.0], 0.25).verdict == "not_reproduced"


def test_equivalence_errs_as_often_as_it_says():
    """At the margin itself, the test wrongly finds equivalence in about 5 % of samples."""
    rng, n = np.random.default_rng(7), 600
    found = [
        judge_equivalent(
            Subject("X1", ""), "", rng.lognormal(np.log(1.25), 0.1, 30), np.ones(30), 0.25
        ).verdict
        for _ in range(n)
    ]
    assert 0.025 < found.count("reproduced") / n < 0.08


@pytest.mark.parametrize("first", [[0.0, 1.0], [np.nan, 1.0], [1.0], [-1.0, 1.0]])
def test_ratios_without_a_logarithm_are_refused(first):
    for function in (statistics.log_ratio_interval, statistics.wilcoxon_p):
        with pytest.raises(InputError, match=r"logarithm|lengths"):
            function(first, [1.0, 1.0])


def test_interval_of_a_median():
    found = statistics.median_interval(values := np.arange(1.0, 21.0))
    assert (found.value, found.low, found.high) == (10.5, 6.0, 15.0)
    assert np.isnan(statistics.median_interval(values[:4]).low)
