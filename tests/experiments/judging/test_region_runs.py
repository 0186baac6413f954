"""Regions from the runs of a study to the verdict: tables, waiting claims, figures."""

import math

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.statistics import Interval
from experiments.judging import anchors
from experiments.judging.claim import Subject, judge_bounds, own_design, waiting
from experiments.judging.folders import NAMED, PAPERS, findings, part
from experiments.judging.free_settings import (
    Anchor,
    FreeSettings,
    Printed,
    Scale,
    Setting,
    free_settings,
    sample,
)
from experiments.judging.region import Side, fit, share
from experiments.judging.region_runs import (
    Compared,
    judge_tables,
    judged_regions,
    region_jobs,
    region_pages,
    remake_region,
    set_apart,
)
from experiments.judging.results import FIRST_SEED, Profile, Results, first_seed
from experiments.judging.sentences import WAITING, conclude
from experiments.judging.sequential import run_worlds

BELOW = Side(high=0.0)
STUDY, CLAIM = "decristoforis2020", "DC2"
KEY = "estimator.neighbours"
HEADLINES = {
    claim: [Compared("a", "b", "a over b", at_most=1.0)]
    for claim, free in free_settings(STUDY).items()
    if free.runs == CLAIM
}


def planted(_name, values, seed, _profile):
    """Holds below 13 neighbours, by a factor of e at the most."""
    noise = 0.1 * np.random.default_rng(seed).standard_normal()
    return {"a": float(np.exp((values[KEY] - 13) / 7 + noise)), "b": 1.0}


@pytest.fixture
def made(tmp_path):
    """The runs over one region, in the quick profile's size."""
    out = Results(tmp_path, STUDY)
    rows = [
        row
        for function, *given in region_jobs(STUDY, planted, Profile.QUICK)
        if given[1] == CLAIM
        for row in function(*given)[f"region_{CLAIM}"]
    ]
    out.write_tables(**{f"region_{CLAIM}": pd.DataFrame(rows)})
    return out


def test_a_region_goes_from_its_runs_to_a_boundary(made):
    found = judged_regions(made, HEADLINES)
    assert set(found) == {CLAIM}
    assert 0.2 < found[CLAIM].share.value < 0.8
    assert found[CLAIM].decided_by == KEY
    assert found[CLAIM].boundary.startswith("holds below 1")
    assert found[CLAIM].anchor.settings[KEY] == 13
    pages = region_pages(made, HEADLINES)
    assert set(pages) == {f"{STUDY}_region_{CLAIM}"}
    assert set(pages) <= set(findings(STUDY)["figures"])


def test_points_with_failed_runs_are_left_out(made):
    table = made.table(f"region_{CLAIM}")
    before = judged_regions(made, HEADLINES)[CLAIM].share.value
    table.loc[table["point"] == 3, "a"] = math.nan
    made.write_tables(**{f"region_{CLAIM}": table})
    assert judged_regions(made, HEADLINES)[CLAIM].share.value == pytest.approx(before, abs=0.25)


def test_rows_of_a_region_are_made_again(made):
    row = made.table(f"region_{CLAIM}").iloc[5].to_dict()
    function, arguments = remake_region(STUDY, planted, f"region_{CLAIM}", row)
    (again,) = function(*arguments)[f"region_{CLAIM}"]
    assert again["a"] == pytest.approx(row["a"], rel=1e-9)


def test_a_region_has_the_points_worlds_and_fresh_seeds_of_its_design():
    jobs = region_jobs(STUDY, planted, Profile.FULL, CLAIM)
    free = free_settings(STUDY)[CLAIM]
    assert (free.n_points, free.n_worlds) == (256, 2)
    assert [job[5] for job in jobs] == [5000 + i for i in range(512)]  # 1000 after the anchor's
    assert first_seed(STUDY, CLAIM, Profile.FULL) == 4000
    assert first_seed(STUDY, "DC1", Profile.FULL) == 2000  # the design names none for it
    assert first_seed(STUDY, CLAIM, Profile.QUICK) == 0
    assert {job[2] for job in jobs} == {CLAIM}


def test_tuning_and_judged_seeds_do_not_meet():
    for profile, low, high in ((Profile.QUICK, 0, 99), (Profile.FULL, 2000, 9999)):
        seeds = [job[5] for job in region_jobs(STUDY, planted, profile)]
        assert low <= min(seeds)
        assert max(seeds) <= high
    assert FIRST_SEED[Profile.FULL] == 2000


@pytest.mark.parametrize("study", [*PAPERS, *NAMED])
def test_every_region_has_headlines_sources_and_an_anchor(study):
    module = part(study, "claims")
    for claim, free in free_settings(study).items():
        assert module.HEADLINES[claim]
        assert all(len(setting.source) > 5 for setting in free.settings)
        assert (free.anchor is None) == free.is_alone, claim
        assert claim in findings(study)["criteria"]


def test_a_claim_waits_for_tables_that_its_definition_needs(tmp_path, made):
    def judge(table):
        found = Interval(0.5, 0.4, 0.6)
        return judge_bounds(Subject(CLAIM, "share"), f"{len(table)} rows", found, at_most=1.0)

    def verdicts(results, columns=()):
        return [c.about.quantity for c in judge_tables(results, {CLAIM: (judge, {"t": columns})})]

    made.write_tables(t=pd.DataFrame({"old": [1.0]}))
    assert verdicts(made) == ["share"]
    assert verdicts(made, ("new",)) == ["waits"]
    bare = Results(tmp_path / "bare", STUDY)
    bare.write_tables(t=pd.DataFrame({"old": [1.0]}))
    assert verdicts(bare) == ["waits"], "the runs over its region are not there"
    assert verdicts(Results(tmp_path / "none", STUDY), ("new",)) == ["waits"]
    (said,) = conclude([waiting(CLAIM)], findings(STUDY))
    assert (said.verdict, said.sentence) == ("shown", WAITING)


def test_the_papers_own_design_is_stated_with_the_claim():
    claim = judge_bounds(Subject("PB1", "x"), "x", Interval(0.5, 0.4, 0.6), at_most=1.0)
    own = own_design("PB1", "one drive", [True, True, False])
    (said,) = conclude([claim, own], {"sentences": {"PB1": "It is so."}})
    assert said.sentence == (
        "It is so. The paper's own design, one drive, shows what is claimed in 2 of 3 repetitions."
    )
    assert said.verdict == "reproduced"


def test_an_anchor_is_where_the_printed_level_comes_out(monkeypatch):
    def level(values, seed):
        return {"odometry_m": 3.0 * math.sqrt(values["robot.kr"] / 5e-5) * (1.0 + 0.01 * seed)}

    monkeypatch.setattr(part("gil2008", "study"), "reference_run", level)
    (line,) = anchors.find("gil2008", "GI1", n_points=16)
    assert "value: 3, anchor: {'robot.kr':" in line
    found = float(line.partition("'robot.kr': ")[2].partition(",")[0])
    assert found == pytest.approx(5e-5, rel=0.15)


def test_worlds_are_added_until_all_claims_are_decided():
    asked = []

    def rows_of(seeds):
        asked.append(list(seeds))
        return {"runs": pd.DataFrame({"seed": seeds})}

    def judge(made):
        is_open = len(made["runs"]) < 45
        claim = judge_bounds(Subject("MX1", "x"), "x", Interval(0.5, 0.4, 0.6), at_most=1.0)
        claim.facts["is_open"] = is_open
        return [claim]

    made = run_worlds("maximo2024", ["MX1"], Profile.FULL, rows_of, judge)
    assert [len(each) for each in asked] == [20, 10, 15]
    assert made["runs"]["seed"].tolist() == list(range(2000, 2045))
    made = run_worlds("maximo2024", ["MX1", "MX3"], Profile.QUICK, rows_of, judge)
    assert made["runs"]["seed"].max() < 100


def test_the_sample_is_the_same_each_time():
    settings = free_settings(STUDY)[CLAIM].settings
    first, second = (sample(settings, 8, rng=np.random.default_rng(1)) for _ in range(2))
    pd.testing.assert_frame_equal(first, second)


def test_data_sets_have_settings_of_their_own():
    """Two claims' sides that no one setting meets, but one for each data set does."""
    setting = Setting("B", Scale.LINEAR, 0.0, 1.0, "")
    at = Anchor({"B": 0.5})
    printed = {place: Printed("x", 1.0, at) for place in ("A", "B")}
    free = FreeSettings((setting,), "X", printed=printed)
    points = sample((setting,), 16, rng=np.random.default_rng(0))
    rng, here = np.random.default_rng(1), points["B"].to_numpy()[:, None]
    noise = rng.normal(0.0, 0.01, (16, 3))
    arms = [(here - 0.6 + noise, BELOW), (0.4 - here + noise, BELOW)]
    together = fit((setting,), points, arms, rng)
    drawn, apart = set_apart(free, points, together, ["A", "B"])
    assert [each.name for each in apart.settings] == list(drawn) == ["B (A)", "B (B)"]
    assert share(together).value < 0.2
    assert share(apart).value == pytest.approx(0.25, abs=0.1)  # half of each
    assert free.drawn_anchor.settings == {"B (A)": 0.5, "B (B)": 0.5}
