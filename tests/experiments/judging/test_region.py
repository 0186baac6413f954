"""Where a claim holds in the region of its free settings, and the verdict that follows."""

import dataclasses
import math

import numpy as np
import pytest

from experiments.evaluation.statistics import Interval
from experiments.judging.claim import Role, Subject, Verdict, judge_bounds
from experiments.judging.claims_file import criteria, read_verdicts, write_verdicts
from experiments.judging.free_settings import (
    Anchor,
    Scale,
    Setting,
    as_words,
    middle,
    sample,
    units_of,
)
from experiments.judging.region import (
    EVERYWHERE,
    NONE_ALONE,
    NOWHERE,
    Region,
    Side,
    boundary_in_words,
    deciding,
    describe,
    first_order,
    fit,
    holding,
    rule,
    share,
)
from experiments.judging.region_figure import draw_region
from experiments.judging.results import Profile
from experiments.judging.sentences import conclude
from experiments.judging.sequential import Design, judge_ratio
from sim.errors import InputError

CUBE = tuple(Setting(name, Scale.LINEAR, 0.0, 1.0, "made up") for name in "abc")
NEED = math.log1p(0.1)
BELOW = Side(high=0.0)


def planted(effect, seed, spread=0.3, n_worlds=6, settings=CUBE):
    """A claim whose log ratio is `effect` of the places in the region, with noise by worlds."""
    rng = np.random.default_rng(seed)
    points = sample(settings, 64, rng=rng)
    true = effect(units_of(settings, points))
    logs = true[:, None] + rng.normal(0.0, spread, (64, n_worlds))
    return fit(settings, points, [(logs, BELOW)], rng, n_resamples=200), rng


def nothing(u):
    return 0.0 * u[:, 0]


def stepped(u, at=0.5):
    """Holds by a tenth where the first setting is below `at`."""
    return 0.4 * np.tanh(5.0 * (u[:, 0] - at)) - NEED


def sloped(u, at=0.5):
    return 1.2 * (u[:, 0] - at) - NEED + 0.1 * (u[:, 1] - 0.5)


def at_anchor(mean, rng, n=40, spread=0.3):
    ratios = np.exp(rng.normal(mean, spread, n))
    design = Design(spread, (n,))
    return judge_ratio(Subject("X1", "error"), "", (ratios, np.ones(n)), design, at_most=1.0)


def false_verdicts(n_claims):
    """How many claims without effect come out as if they had one."""
    wrong = 0
    for seed in range(n_claims):
        fitted, rng = planted(nothing, seed)
        ruled = rule(at_anchor(0.0, rng).verdict, share(fitted))
        wrong += ruled in (Verdict.REPRODUCED, Verdict.DEPENDS)
    return wrong


def found_boundaries(n_claims, effect):
    """How many claims that hold below 0.5 depend, and how many say so by the true boundary."""
    depend = right = 0
    for seed in range(n_claims):
        fitted, rng = planted(lambda u: effect(u), 10_000 + seed)
        centre = np.full((1, 3), [0.2, 0.5, 0.5])
        ruled = rule(at_anchor(float(effect(centre)[0]), rng).verdict, share(fitted))
        depend += ruled is Verdict.DEPENDS
        first = deciding(first_order(fitted))
        stretch = None if first is None else holding(fitted, first)
        right += first == 0 and stretch is not None and stretch[1].low <= 0.5 <= stretch[1].high
    return depend, right


def test_planted_claims_come_out_as_planted():
    assert false_verdicts(40) <= 5  # of 40 at 5 % in fewer than one of seventy runs
    for effect in (stepped, sloped):
        depend, right = found_boundaries(12, effect)
        assert depend >= 11
        assert right >= 10


@pytest.mark.slow
def test_the_rule_errs_on_few_of_2000_claims_without_effect():
    assert false_verdicts(2000) <= 100


@pytest.mark.slow
@pytest.mark.parametrize("effect", [stepped, sloped])
def test_claims_with_a_boundary_depend_on_it(effect):
    depend, right = found_boundaries(200, effect)
    assert depend >= 190
    assert right >= 180


LOW, MIDDLE, HIGH = Interval(0.05, 0.0, 0.1), Interval(0.5, 0.4, 0.6), Interval(0.95, 0.9, 1.0)
HOLDS, FAILS, OPEN, ALONE = (
    Verdict.REPRODUCED, Verdict.NOT_REPRODUCED, Verdict.UNDECIDED, Verdict.SHOWN,
)  # fmt: skip


@pytest.mark.parametrize(
    ("anchor", "found", "verdict"),
    [
        (HOLDS, HIGH, "reproduced"),
        (HOLDS, MIDDLE, "depends"),
        (HOLDS, LOW, "depends"),
        (FAILS, HIGH, "depends"),
        (FAILS, MIDDLE, "depends"),
        (FAILS, LOW, "not_reproduced"),
        (ALONE, HIGH, "reproduced"),
        (ALONE, MIDDLE, "depends"),
        (ALONE, LOW, "not_reproduced"),
        *((OPEN, found, "undecided") for found in (LOW, MIDDLE, HIGH)),
        *((a, Interval(0.2, 0.1, 0.3), "undecided") for a in (HOLDS, FAILS, ALONE)),
        *((a, Interval(0.8, 0.7, 0.9), "undecided") for a in (HOLDS, FAILS, ALONE)),
        (HOLDS, Interval(math.nan, math.nan, math.nan), "undecided"),
    ],
)
def test_the_verdict_follows_from_anchor_and_region(anchor, found, verdict):
    assert rule(anchor, found) == verdict


def test_a_share_has_an_interval_that_narrows_with_the_worlds():
    few, many = (share(planted(sloped, 3, n_worlds=n)[0]) for n in (3, 48))
    assert many.value == pytest.approx(0.5, abs=0.02)
    assert few.high - few.low > 2.0 * (many.high - many.low)
    assert share(planted(nothing, 4)[0]).high < 0.2


def test_worlds_that_all_points_share_err_together():
    rng = np.random.default_rng(5)
    points = sample(CUBE, 64, rng=rng)
    logs = sloped(units_of(CUBE, points))[:, None] + rng.normal(0.0, 0.3, 12)  # one error a world
    widths = []
    for shared in (True, False):
        fitted = fit(CUBE, points, [(logs, BELOW)], rng, shares_worlds=shared)
        found = share(fitted)
        widths.append(found.high - found.low)
    assert widths[0] > 3.0 * widths[1]


def test_all_headlines_must_hold_and_a_band_is_its_own_margin():
    rng = np.random.default_rng(6)
    points = sample(CUBE, 64, rng=rng)
    u = units_of(CUBE, points)
    noise = rng.normal(0.0, 0.02, (64, 4))
    first, second = (stepped(u[:, [i]])[:, None] + noise for i in (0, 1))
    both = fit(CUBE, points, [(first, BELOW), (second, BELOW)], rng)
    assert share(both).value == pytest.approx(0.25, abs=0.03)
    assert deciding(first_order(both)) is None  # both decide alike
    assert describe(both, None).decided_by == NONE_ALONE
    band = Side(math.log(0.9), math.log(1.1))
    assert band.margin(np.log([0.89, 0.91, 1.09, 1.11])).tolist() == pytest.approx(
        np.log([0.89 / 0.9, 0.91 / 0.9, 1.1 / 1.09, 1.1 / 1.11]).tolist()
    )
    assert (Side(low=0.0).margin(np.log([1.09, 1.11])) > 0.0).tolist() == [False, True]


def test_the_boundary_is_said_in_the_settings_own_numbers():
    number = Setting("estimator.n_nearest", Scale.INTEGER, 2, 20, "s")
    slip = Setting("robot.kr", Scale.LOG, 1e-6, 1e-2, "s")
    where = Setting("noise_at", Scale.CHOICE, 0, 1, "s", ("measured", "predicted"))
    settings = (slip, where, number)
    region = describe(planted(stepped, 7, 0.1, settings=settings)[0], middle(settings))
    assert region.decided_by == "robot.kr"
    assert region.boundary.startswith("holds below 0.0001 [")
    said = region.words(FAILS)
    assert "Robot.kr matters most: the claim holds in" in said
    assert "With the others in the middle of their ranges, it holds below 0.0001 [" in said
    assert said.endswith("to match, with robot.kr = 0.0001, it does not hold.")
    chosen = planted(lambda u: u[:, 1] - 0.5 - NEED, 8, 0.1, settings=settings)[0]
    assert boundary_in_words(chosen, 1) == "holds where it is measured"
    assert as_words(True) == "yes"
    above = planted(lambda u: stepped(1.0 - u[:, ::-1]), 9, 0.1, settings=settings)[0]
    assert boundary_in_words(above, 2).startswith("holds above 1")
    for effect, words in ((nothing, NOWHERE), (lambda u: -0.5 + 0.0 * u[:, 0], EVERYWHERE)):
        region = describe(planted(effect, 10, 0.05)[0], None)
        assert (region.decided_by, region.boundary) == (NONE_ALONE, words)


def test_a_verdict_by_region_is_written_and_read(tmp_path):
    found = judge_bounds(Subject("X1", "ratio"), "a ratio", Interval(0.8, 0.7, 0.9), at_most=1.0)
    at, boundary = Anchor({"k": 0.5}, 9.6), "holds below 0.7 [0.6, 0.8]"
    region = Region(at, MIDDLE, "k", boundary, along="k matters most")
    said = {"sentences": {"X1": "It is {{ rows[0].found|plain }}."}, "anchor": "M2 errs 9.6 m"}
    (ruled,) = conclude([found], said, {"X1": region})
    assert (ruled.verdict, ruled.at_anchor) == (Verdict.DEPENDS, HOLDS)
    assert (
        "K matters most. With the others in the middle of their ranges, it holds below 0.7"
        in ruled.sentence
    )
    assert "At the anchor, where M2 errs 9.6 m, with k = 0.5, it holds." in ruled.sentence
    (alone,) = conclude([dataclasses.replace(found, role=Role.BESIDE)], said, {"X1": region})
    assert (alone.verdict, alone.at_anchor) == (Verdict.DEPENDS, ALONE)
    path = tmp_path / "verdicts.csv"
    write_verdicts([ruled], path, paper="p", says={"X1": "s"}, profile=Profile.FULL)
    row = read_verdicts(path).iloc[0]
    assert (row["anchor"], row["holds_at_anchor"]) == ("k = 0.5", "yes")
    assert row[["region_share", "region_low", "region_high"]].tolist() == [0.5, 0.4, 0.6]
    assert (row["decided_by"], row["boundary"]) == ("k", region.boundary)


def test_the_figure_shows_region_anchor_and_the_papers_number():
    fitted, rng = planted(sloped, 11)
    points = sample(CUBE, 64, rng=rng)
    about = {"quantities": ["a ratio"], "printed": [0.8]}
    page = draw_region(fitted, points, middle(CUBE), title="t", **about)
    first, line, what = page.axes
    assert (first.get_xlabel(), line.get_ylabel()) == ("a", "a ratio")
    assert what.get_yticklabels()[-1].get_text() == "a"  # the most deciding on top
    named = {text.get_text() for text in page.legends[0].get_texts()}
    assert named >= {"anchor", "boundary, best estimate", "ratios that pass", "the paper's ratio"}
    flat = planted(nothing, 12, settings=CUBE[:1])[0]
    draw_region(flat, points, None, title="$", quantities=["a ratio"], printed=[None])


def test_criteria_say_since_when_and_whether_after_the_data(monkeypatch):
    assert criteria("gil2008")("GI3") == {"criterion_since": "2026-11-23", "after_data": "yes"}
    assert criteria("gil2008")("GI6") == {"criterion_since": "2026-11-21", "after_data": "no"}
    wrong = {"criteria": {"X1": {"since": "today", "after_data": True}}}
    monkeypatch.setattr("experiments.judging.claims_file.findings", lambda study: wrong)
    with pytest.raises(InputError, match=r"s/findings.yaml: criteria.X1: needs since"):
        criteria("s")
