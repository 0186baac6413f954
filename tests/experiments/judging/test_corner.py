"""The corner of a region in which a claim holds most."""

import numpy as np
import pytest

from experiments.judging.claim import Verdict
from experiments.judging.corner import corner
from experiments.judging.free_settings import Scale, Setting, middle, sample, units_of
from experiments.judging.region import NONE_ALONE, Side, describe, fit

SLIP = Setting("robot.kr", Scale.LOG, 1e-6, 1e-2, "s", words="wheel slip, m")
NEAREST = Setting("estimator.n_nearest", Scale.INTEGER, 2, 20, "s", words="B")
AT = Setting("noise_at", Scale.CHOICE, 0, 1, "s", ("measured", "predicted"))
SETTINGS = (SLIP, NEAREST, AT)


def found(holds, settings=SETTINGS):
    units = units_of(settings, sample(settings, 1024, rng=None))
    return corner(settings, units, np.tile(holds(units), (3, 1)))


def test_one_setting_is_named_where_it_tells_all():
    for holds, words in (
        (lambda u: u[:, 0] < 0.5, "wheel slip, m is below 0.0001"),
        (lambda u: u[:, 0] >= 0.25, "wheel slip, m is above 1e-5"),
        (lambda u: u[:, 1] >= NEAREST.units([5])[0], "B is above 4"),
        (lambda u: u[:, 2] == AT.units(["predicted"])[0], "noise_at is predicted"),
    ):
        best = found(holds)
        assert [half.words for half in best.halves] == [words]
        assert (
            best.words == f"holds in 100 % [100, 100] where {words}, and in 0 % [0, 0] of the rest"
        )


def test_two_settings_are_named_where_both_are_needed():
    best = found(lambda u: (u[:, 0] < 0.5) & (u[:, 1] < NEAREST.units([8])[0]))
    assert [half.words for half in best.halves] == ["wheel slip, m is below 0.0001", "B is below 8"]
    assert (best.inside.value, best.outside.value) == (1.0, 0.0)


@pytest.mark.parametrize("everywhere", [True, False])
def test_a_claim_that_holds_everywhere_or_nowhere_has_no_corner(everywhere):
    assert found(lambda u: np.full(len(u), everywhere)) is None


def test_the_shares_have_intervals_by_the_resampled_regions():
    units = units_of(SETTINGS, sample(SETTINGS, 1024, rng=None))
    holds = np.stack([units[:, 0] < at for at in (0.5, 0.4, 0.45, 0.55, 0.6)])
    best = corner(SETTINGS, units, holds)
    assert best.inside.low == pytest.approx(0.81, abs=0.01)
    assert best.inside.high == 1.0
    assert best.outside.value == 0.0
    assert best.outside.high == pytest.approx(0.19, abs=0.01)


def test_a_region_that_two_settings_decide_alike_has_a_boundary_in_both():
    rng = np.random.default_rng(11)
    points = sample(SETTINGS, 64, rng=rng)
    u = units_of(SETTINGS, points)
    logs = np.where((u[:, 0] < 0.5) & (u[:, 1] < 0.5), -1.0, 1.0)[:, None]
    noisy = logs + rng.normal(0.0, 0.05, (64, 4))
    region = describe(fit(SETTINGS, points, [(noisy, Side(high=0.0))], rng), middle(SETTINGS))
    assert region.decided_by == NONE_ALONE
    assert "wheel slip, m is below" in region.boundary
    assert "B is below" in region.boundary
    assert f"division of the region: it {region.boundary}." in region.words(Verdict.REPRODUCED)
