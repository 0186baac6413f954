"""Log weights, effective sample size and resampling."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.particles import (
    SCHEMES,
    Lineages,
    effective_sample_size,
    have_underflowed,
    keep_survivors,
    normalize,
    resample,
)
from sim.errors import InputError

WEIGHTS = np.array([0.02, 0.4, 0.0, 0.13, 0.25, 0.2])


def logs(weights):
    with np.errstate(divide="ignore"):
        return np.log(weights)


def test_normalize_takes_any_offset():
    np.testing.assert_allclose(normalize(logs(WEIGHTS) - 1e5), WEIGHTS, rtol=1e-9)
    np.testing.assert_allclose(normalize(logs(WEIGHTS) + 1e5), WEIGHTS, rtol=1e-9)


@pytest.mark.parametrize("hopeless", [-np.inf, np.nan])
def test_weights_without_any_left_count_as_equal(hopeless):
    spent = np.full(4, hopeless)
    assert have_underflowed(spent)
    assert not have_underflowed(logs(WEIGHTS))
    assert normalize(spent).tolist() == [0.25] * 4
    assert effective_sample_size(spent) == pytest.approx(4.0)
    assert resample(spent, 4, np.random.default_rng(0)).tolist() == [0, 1, 2, 3]


def test_effective_sample_size_between_one_and_all():
    assert effective_sample_size(np.zeros(50)) == pytest.approx(50.0)
    assert effective_sample_size(logs(np.array([0.0, 1.0, 0.0]))) == pytest.approx(1.0)
    assert effective_sample_size(logs(WEIGHTS)) == pytest.approx(1.0 / np.sum(WEIGHTS**2))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_resampling_is_unbiased(scheme):
    rng = np.random.default_rng(1)
    n, repeats = 17, 4000
    counts = np.array(
        [
            np.bincount(resample(logs(WEIGHTS), n, rng, scheme), minlength=len(WEIGHTS))
            for _ in range(repeats)
        ]
    )
    assert np.all(counts.sum(axis=1) == n)
    sigma = np.sqrt(n * WEIGHTS * (1.0 - WEIGHTS) / repeats)  # of multinomial draws, the widest
    assert np.all(np.abs(counts.mean(axis=0) - n * WEIGHTS) <= 4.5 * sigma)


def test_schemes_differ_in_their_spread_as_theory_says():
    rng = np.random.default_rng(2)
    n = 30
    spread = {
        scheme: np.var([np.sum(resample(logs(WEIGHTS), n, rng, scheme) == 1) for _ in range(3000)])
        for scheme in SCHEMES
    }
    assert spread["multinomial"] == pytest.approx(n * 0.4 * 0.6, rel=0.12)
    assert spread["systematic"] < 0.26  # the number of copies is floor or ceil of n w
    assert spread["stratified"] < 0.6
    assert spread["residual"] < 0.2 * spread["multinomial"]


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40), st.integers(1, 60), st.data())
@settings(max_examples=60, deadline=None)
def test_systematic_copies_are_floor_or_ceil(raw: list[float], n: int, data: st.DataObject):
    weights = np.array(raw)
    if weights.sum() <= 1e-6:
        return
    weights /= weights.sum()
    rng = np.random.default_rng(data.draw(st.integers(0, 2**31)))
    copies = np.bincount(resample(logs(weights), n, rng), minlength=len(weights))
    assert np.all(np.abs(copies - n * weights) < 1.0 + 1e-9)
    assert np.all(copies[weights == 0.0] == 0)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_same_seed_same_indices_in_order(scheme):
    first = resample(logs(WEIGHTS), 9, np.random.default_rng(5), scheme)
    again = resample(logs(WEIGHTS), 9, np.random.default_rng(5), scheme)
    assert np.array_equal(first, again)
    assert np.all(np.diff(first) >= 0)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_equal_weights_and_one_particle(scheme):
    assert resample(np.array([-3.0]), 1, np.random.default_rng(0), scheme).tolist() == [0]
    if scheme != "multinomial":
        equal = resample(np.full(100, -7.0), 100, np.random.default_rng(3), scheme)
        assert np.bincount(equal, minlength=100).max() <= 2


@given(st.lists(st.integers(0, 11), min_size=12, max_size=12))
@settings(max_examples=60, deadline=None)
def test_survivors_keep_their_slot(drawn):
    indices = np.array(drawn)
    ancestors = keep_survivors(indices, 12)
    assert np.array_equal(np.sort(ancestors), np.sort(indices))
    for particle in set(drawn):
        assert ancestors[particle] == particle


def test_unknown_scheme_is_told():
    with pytest.raises(InputError, match="systematic, stratified, residual, multinomial"):
        resample(np.zeros(3), 3, np.random.default_rng(0), "bootstrap")


def test_lineages_are_the_paths_of_the_survivors():
    rng = np.random.default_rng(4)
    n, n_steps = 12, 300
    lineages, paths = Lineages(n), np.zeros((n, 0, 3))
    for _ in range(n_steps):
        poses = rng.standard_normal((n, 3))
        lineages.append(poses)
        paths = np.concatenate([paths, poses[:, None]], axis=1)
        if rng.random() < 0.6:
            ancestors = rng.integers(n, size=n)
            lineages.resample(ancestors)
            paths = paths[ancestors]
    traced = [poses[rows] for poses, rows in lineages.paths()][::-1]
    assert np.array_equal(np.stack(traced, axis=1), paths)
    assert len(lineages) == n_steps
    n_rows = sum(len(poses) for poses, _ in lineages.paths())
    assert n_rows < 0.4 * n * n_steps  # the dead are forgotten
