"""Intervals over growing data: one error over all looks, whatever the shape of the log ratios."""

import numpy as np
import pytest
from scipy import stats

from experiments.evaluation.sequential import (
    SPENT,
    look_errors,
    plan_looks,
    power_at,
    recordings_for,
    repeated_interval,
    skewed_bounds,
)
from experiments.judging import sequential_power
from sim.errors import InputError


def test_all_looks_together_err_as_often_as_promised():
    looks = (20, 40, 60, 80, 100)
    errors = np.array(look_errors(looks))
    assert look_errors((50,)) == pytest.approx((SPENT,))
    assert np.all(np.diff(errors) > 0.0)
    score = np.cumsum(np.random.default_rng(0).standard_normal((100_000, 100)), axis=1)
    at = np.array(looks) - 1
    p = 2.0 * stats.norm.sf(np.abs(score[:, at]) / np.sqrt(looks))
    assert (p < errors).any(axis=1).mean() == pytest.approx(SPENT, abs=0.002)
    assert (p < 0.05).any(axis=1).mean() > 0.12  # what looking five times costs without it


def test_looks_must_increase():
    for looks in ((), (1, 5), (5, 5), (9, 4)):
        with pytest.raises(InputError, match="must increase"):
            look_errors(looks)


def test_an_interval_is_that_of_the_latest_look():
    values = np.random.default_rng(1).normal(1.0, 0.5, 60)
    looks = (20, 40, 80)
    first = repeated_interval(values[:20], looks)
    assert repeated_interval(values[:35], looks) == first
    second = repeated_interval(values, looks)
    assert second == repeated_interval(values[:40], looks)
    assert first.low < second.low < 1.0 < second.high < first.high
    assert np.isnan(repeated_interval(values[:19], looks).low)
    same = repeated_interval(np.full(40, 0.5), looks)
    assert (same.low, same.high) == (0.5, 0.5)


def test_bounds_are_the_t_interval_and_reach_further_on_the_side_of_the_tail():
    low, high = skewed_bounds(40, 1.0, 0.0, 0.05)
    half = stats.t.ppf(0.975, 39) / np.sqrt(40)
    assert [-low, high] == pytest.approx([half, half], abs=1e-5)
    low_skewed, high_skewed = skewed_bounds(40, 1.0, 2.0, 0.05)
    assert low_skewed == pytest.approx(low, abs=1e-5)
    assert high_skewed > 1.1 * high


def test_sizes_have_their_power():
    n = recordings_for(0.1, 0.4)
    assert power_at(n, 0.05, 0.1, 0.4) == pytest.approx(0.9, abs=0.005)
    assert plan_looks(200) == (20, 32, 50, 80, 126, 200)
    assert plan_looks(8) == (8,)


def test_the_simulated_bounds_are_those_of_the_interval():
    logs = np.random.default_rng(2).gumbel(size=(3, 60))
    looks = (20, 40, 60)
    low, high = sequential_power.bounds_at(logs, looks, np.array(look_errors(looks)))
    for i, sample in enumerate(logs):
        for j, n in enumerate(looks):
            found = repeated_interval(sample[:n], looks)
            assert (found.low, found.high) == pytest.approx((low[i, j], high[i, j]))


@pytest.mark.slow
def test_claims_without_effect_are_decided_in_five_percent_at_most():
    """A part of the simulation in docs/papers.md: any stopping, any of its shapes."""
    found = sequential_power.null_errors(2000).set_index("log ratios")
    chance = 100.0 * 3.0 * np.sqrt(0.05 * 0.95 / 2000)
    assert (found[["6 looks", "each recording"]] < 5.0 + chance).all(axis=None)
    assert (found["t test at each recording"] > 20.0).all()


@pytest.mark.slow
def test_the_rule_saves_runs_and_keeps_the_power():
    found = sequential_power.powers(2000).set_index("effect over the smallest")
    assert found.loc[1.0, "6 looks: effect, %"] > 80.0
    assert found.loc[3.0, "6 looks: runs saved, %"] > 60.0
    assert found.loc[1.0, "mixture: effect, %"] < 65.0
    assert sequential_power.of_claims(200)["saved, %"].median() > 60.0
