"""Free settings: their ranges, samples of them, the surface over them, and the anchor."""

import numpy as np
import pytest

from experiments.judging import free_settings as free
from experiments.judging.free_settings import Scale, Setting, find_anchor, middle, sample, units_of
from experiments.judging.surface import fit_surface
from sim.errors import InputError

SETTINGS = (
    Setting("robot.kr", Scale.LOG, 1e-6, 1e-3, "s"),
    Setting("estimator.n_nearest", Scale.INTEGER, 2, 20, "s"),
    Setting("estimator.noise_at", Scale.CHOICE, 0, 2, "s", ("a", "b", "c")),
    Setting("laser.sigma_m", Scale.LINEAR, 0.01, 0.05, "s"),
)


def test_a_sample_fills_every_range_evenly():
    found = sample(SETTINGS, 64, rng=np.random.default_rng(0))
    assert list(found) == [s.name for s in SETTINGS]
    assert found["robot.kr"].between(1e-6, 1e-3).all()
    assert (found["robot.kr"] < 10**-4.5).sum() == 32
    assert (found["laser.sigma_m"] < 0.03).sum() == 32
    assert set(found["estimator.n_nearest"]) == set(range(2, 21))
    assert found["estimator.noise_at"].value_counts().between(20, 23).all()
    again = free.table_at(SETTINGS, units_of(SETTINGS, found))
    assert again["estimator.noise_at"].tolist() == found["estimator.noise_at"].tolist()
    assert again["robot.kr"].tolist() == pytest.approx(found["robot.kr"].tolist())
    other = sample(SETTINGS, 64, rng=np.random.default_rng(1))
    assert not other["robot.kr"].equals(found["robot.kr"])
    with pytest.raises(InputError, match="power of two points, not 60"):
        sample(SETTINGS, 60, rng=None)


def given(**changes):
    setting = {"low": 1, "high": 2, "scale": "log", "source": "a data sheet"} | changes
    return {"settings": {"k": {name: v for name, v in setting.items() if v is not None}}}


def test_free_settings_stand_in_the_design(monkeypatch):
    about = {"regions": {"X1": {**given(low="1e-3"), "effect": 0.2}}}
    monkeypatch.setattr(free, "design", lambda study: about)
    (found,) = free.free_settings("s")["X1"].settings
    assert found == Setting("k", Scale.LOG, 1e-3, 2.0, "a data sheet")
    assert free.free_settings("s")["X1"].effect == 0.2
    about["regions"]["X1"] = given(low=None, high=None, scale=None, choices=["a", "b"])
    assert free.free_settings("s")["X1"].settings[0].choices == ("a", "b")
    assert free.free_settings("s")["X1"].effect == 0.1


@pytest.mark.parametrize(
    ("claim", "of", "wrong"),
    [
        ("X1", {}, "regions.X1: needs settings"),
        ("X1", given(source=None), "settings.k: needs a source"),
        ("X1", given(low=3), "low must be below high"),
        ("X1", given(low="x"), "settings.k.low"),
        ("X1", given(low=0), "a log scale needs low > 0"),
        ("X1", given(scale="cubic"), "scale must be one of linear, log, integer"),
        ("X1", given(choices=["a"]), "choices two or more"),
        ("X1", {**given(), "effect": 0}, "effect must be > 0"),
    ],
)
def test_wrong_free_settings_are_refused(monkeypatch, claim, of, wrong):
    about = {"regions": {claim: of}}
    monkeypatch.setattr(free, "design", lambda study: about)
    with pytest.raises(InputError, match=wrong) as refused:
        free.free_settings("s")
    assert str(refused.value).startswith("s/design.yaml: ")


def test_a_surface_follows_a_step_through_noise_and_ignores_what_does_nothing():
    rng = np.random.default_rng(2)
    units, other = rng.random((64, 3)), rng.random((200, 3))

    def true(u):
        return 0.4 * np.tanh(6.0 * (u[:, 0] - 0.4))

    values = true(units) + rng.normal(0.0, 0.05, 64)
    surface = fit_surface(units, values, (False,) * 3)
    weights = surface.weights(other)
    assert weights.sum(axis=1) == pytest.approx(np.ones(200))
    assert np.sqrt(np.mean((weights @ values - true(other)) ** 2)) < 0.04
    assert surface.lengths[0] < 0.5 < 1.0 < surface.lengths[1:].min()
    flat = fit_surface(units, np.ones(64), (False,) * 3)
    assert flat.weights(other) @ np.ones(64) == pytest.approx(np.ones(200))


def test_choices_have_no_order():
    units = np.repeat([[1 / 6], [0.5], [5 / 6]], 20, axis=0)
    values = np.repeat([1.0, -1.0, 1.0], 20) + np.random.default_rng(3).normal(0.0, 0.1, 60)
    surface = fit_surface(units, values, (True,))
    assert surface.weights(units[[0, 20, 40]]) @ values == pytest.approx([1.0, -1.0, 1.0], abs=0.1)


def level_of(settings):
    kr = SETTINGS[0].units([settings["robot.kr"]])[0]
    return 9.61 * np.exp(2.0 * (kr - 0.3) + 0.02 * (settings["estimator.n_nearest"] - 11))


def test_the_anchor_has_the_printed_level_nearest_the_middle():
    points = sample(SETTINGS, 64, rng=np.random.default_rng(4))
    levels = [level_of(row) for row in points.to_dict("records")]
    found = find_anchor(SETTINGS, points, levels, 9.61, level_of)
    assert found is not None
    assert found.level == pytest.approx(9.61, rel=0.05)
    tried = sample(SETTINGS, 4096, rng=None)
    all_levels = np.array([level_of(row) for row in tried.to_dict("records")])
    good = tried[np.abs(np.log(all_levels / 9.61)) < np.log(1.01)]
    nearest = np.linalg.norm(units_of(SETTINGS, good) - 0.5, axis=1).min()
    place = units_of(SETTINGS, good.iloc[:1].assign(**found.settings))[0]
    assert np.linalg.norm(place - 0.5) < nearest + 0.05
    assert find_anchor(SETTINGS, points, levels, 9610.0, level_of) is None


def test_the_anchor_is_refined_by_what_is_measured_there():
    points = sample(SETTINGS, 64, rng=np.random.default_rng(5))
    levels = [1.2 * level_of(row) for row in points.to_dict("records")]  # the surface is off
    asked = []

    def measure(settings):
        asked.append(settings)
        return level_of(settings)

    found = find_anchor(SETTINGS, points, levels, 9.61, measure)
    assert found is not None
    assert len(asked) > 1
    assert found.level == pytest.approx(9.61, rel=0.05)


def test_without_a_printed_level_the_anchor_is_the_middle():
    assert middle(SETTINGS).words == (
        "robot.kr = 3.16e-5, estimator.n_nearest = 11, estimator.noise_at = b, laser.sigma_m = 0.03"
    )
