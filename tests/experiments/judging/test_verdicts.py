"""One verdict and one sentence a claim: they follow from its headline statistics."""

import csv
import dataclasses
import math
import re

import numpy as np
import pandas as pd
import pytest
from jinja2 import UndefinedError

from experiments.evaluation.statistics import Interval, log_ratio_interval, mean_interval
from experiments.judging.claim import (
    WAITS,
    Claim,
    Role,
    Subject,
    Verdict,
    beside,
    headline_verdict,
    judge_bounds,
    judge_interval,
    power_of,
    select,
    select_all,
    shown,
)
from experiments.judging.claims_file import (
    VERDICT_COLUMNS,
    read_claims,
    read_provenance,
    read_verdicts,
    write_claims,
    write_verdicts,
)
from experiments.judging.folders import LOGS, NAMED, PAPERS, findings
from experiments.judging.results import Profile, Results
from experiments.judging.sentences import (
    WAITING,
    Conclusion,
    conclude,
    percent,
    plain,
    sentence,
)
from experiments.reproduce import judgement
from experiments.runs.paths import SOURCE
from sim.errors import InputError

RESULTS = SOURCE / "results"
ABOUT = Subject("PB1", "ratio", method="icp", size=3)
GOOD = judge_bounds(ABOUT, "a ratio", Interval(1.0, 0.9, 1.1), 0.8, 1.25)
BAD = judge_bounds(
    dataclasses.replace(ABOUT, size=4), "another", Interval(2.0, 1.9, 2.1), 0.8, 1.25
)
FUSED = dataclasses.replace(ABOUT, method="fusion")
OPEN = judge_bounds(FUSED, "a third", Interval(1.2, 1.1, 1.3), 0.8, 1.25)


def verdict_of(*claims):
    (said,) = conclude(claims, {"sentences": {"PB1": "There are {{ rows|length }} rows."}})
    return said


def test_a_verdict_follows_from_the_headlines_alone():
    assert verdict_of(GOOD, GOOD).verdict == "reproduced"
    assert verdict_of(GOOD, OPEN).verdict == "undecided"
    assert verdict_of(GOOD, OPEN, BAD).verdict == "not_reproduced"
    assert verdict_of(GOOD, beside(OPEN), beside(BAD)).verdict == "reproduced"
    assert verdict_of(beside(GOOD), shown(ABOUT, "only shown", Interval.exact(1.0))).verdict == (
        "shown"
    )
    assert headline_verdict([]) == "shown"


def test_what_is_only_shown_stands_beside():
    claim = shown(ABOUT, "a share", Interval.exact(0.5), "why")
    assert (claim.role, claim.verdict, claim.reason) == (Role.BESIDE, Verdict.SHOWN, "why")
    assert beside(GOOD, False) is GOOD


def test_an_undecided_sentence_states_the_power_of_its_size():
    assert verdict_of(GOOD).sentence == "There are 1 rows."
    assert verdict_of(GOOD, OPEN).sentence == (
        "There are 2 rows. Undecided is “a third”, 1.2 [1.1, 1.3], as the interval contains the "
        "limit (within 0.8 and 1.25); more data would decide it. With data of this size, two arms "
        "that are alike would be shown to be so in 99 of 100 studies."
    )
    low = judge_bounds(FUSED, "a ratio", Interval(1.05, 0.95, 1.16), at_most=1.1)
    assert verdict_of(OPEN, low).sentence.endswith(
        "an effect of 10 %, if there is one, would be decided in 46 of 100 studies."
    )
    unknown = dataclasses.replace(OPEN, power=math.nan)
    assert verdict_of(unknown).sentence == "There are 1 rows."
    assert "in 99 of 100 studies" in verdict_of(OPEN, beside(low), unknown).sentence


def test_the_power_of_a_size_is_that_of_tests_of_its_size():
    """Shares of drawn samples that are decided, beside the power read from one interval."""
    rng = np.random.default_rng(0)
    for shift, band in ((math.log(1.1), (-math.inf, 1.0)), (0.0, (0.8, 1.25))):
        draws = np.exp(rng.normal(-shift, 0.3, size=(1000, 60)))
        found = [log_ratio_interval(ratios, np.ones(60)) for ratios in draws]
        decided = np.mean([judge_interval(each, *band) == "reproduced" for each in found])
        power = np.mean([power_of(each, band=band) for each in found[:50]])
        assert power == pytest.approx(decided, abs=0.05)
    assert math.isnan(power_of(mean_interval([1.0])))
    assert power_of(Interval(0.0, -0.1, 0.1), effect=0.1, band=(-math.inf, 0.0)) == (
        pytest.approx(0.5)
    )


def test_numbers_in_sentences():
    assert [plain(v) for v in (0.0123, 1.25, 190.2, 12345.0, 3e-5)] == [
        "0.012",
        "1.2",
        "190",
        "12,000",
        "3e-05",
    ]
    assert percent(0.617) == "62 %"
    assert (plain(float("nan")), percent(float("nan"))) == ("unknown", "an unknown share")


def test_statistics_are_selected_by_their_fields():
    rows = [GOOD, BAD, beside(OPEN)]
    assert select(rows, size=4) is BAD
    assert select_all(rows, method="icp", quantity="ratio") == [GOOD, BAD]
    assert select(rows, role=Role.BESIDE, verdict="undecided").about.method == "fusion"
    for wanted, found in (({"size": 5}, 0), ({"method": "icp"}, 2)):
        with pytest.raises(LookupError, match=f"{found} statistics with"):
            select(rows, **wanted)


def test_a_sentence_is_a_template_filled_from_the_statistics():
    template = """{% for row in select_all(method="icp") %}
        {{ row.found|bracketed }} with {{ row.about.size }}{{ "." if loop.last else ";" }}
    {% endfor %}
    {{ select(method="fusion").found|plain(3) }}, {{ rows|span }}."""
    assert sentence(template, [GOOD, BAD, OPEN]) == (
        "1 [0.9, 1.1] with 3; 2 [1.9, 2.1] with 4. 1.2, 1 to 2."
    )
    with pytest.raises(UndefinedError, match="no_such_field"):
        sentence("{{ rows[0].no_such_field }}", [GOOD])


def write(conclusions, path, paper="puzzlebot2024", profile=Profile.FULL):
    says = {"PB1": "What it says.", "RL1": "What it says, too."}
    write_verdicts(conclusions, path, paper=paper, says=says, profile=profile)


def test_verdicts_are_written_one_row_a_claim(tmp_path):
    path = tmp_path / "verdicts.csv"
    write([Conclusion("RL1", Verdict.SHOWN, "One.")], path, "real_logs")
    write([Conclusion("PB1", Verdict.UNDECIDED, "Two.")], path, profile=Profile.QUICK)
    write([Conclusion("PB1", Verdict.NOT_REPRODUCED, "Three, with a comma.")], path)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == VERDICT_COLUMNS
    assert [(row["id"], row["verdict"], row["sentence"]) for row in rows] == [
        ("PB1", "not_reproduced", "Three, with a comma."),
        ("RL1", "shown", "One."),
    ]


@pytest.mark.parametrize(
    ("row", "wrong"),
    [
        ("PB1,p,says,undecided,a sentence,,,,,,,", "the last row is cut off"),
        ("PB1,p,says,perhaps,a sentence,,,,,,,\n", "row 2: verdict is 'perhaps'"),
        ("PB1,p,says,undecided,,,,,,,,\n", "row 2: sentence is nan"),
        ("PB1,p,says,depends,a,k = 1,maybe,,,,,\n", "row 2: holds_at_anchor is 'maybe'"),
        ("PB1,p,says,depends,a,k = 1,yes,much,,,,\n", "row 2: region_share is 'much'"),
        ("PB1,p,s,shown,a,,,,,,,\nPB1,p,s,shown,b,,,,,,,\n", "row 3: a duplicate"),
    ],
)
def test_damaged_verdicts_are_refused_in_one_line(tmp_path, row, wrong):
    path = tmp_path / "verdicts.csv"
    path.write_text(",".join(VERDICT_COLUMNS) + "\n" + row)
    with pytest.raises(InputError, match=wrong) as refused:
        read_verdicts(path)
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module", params=[*PAPERS, *LOGS, *NAMED])
def tracked(request):
    """A paper's statistics and conclusions by the tracked tables."""
    return request.param, *judgement(Results(RESULTS, request.param))


def test_the_tracked_verdicts_are_those_of_the_tracked_tables(tracked, tmp_path):
    paper, claims, conclusions = tracked
    made = read_provenance(RESULTS)
    assert all(made[name]["profile"] == Profile.FULL for name in PAPERS)
    profile = Profile(made.get(paper, {}).get("profile", Profile.QUICK))
    origin = {"paper": paper, "profile": profile}
    write_claims(claims, tmp_path / "claims.csv", command="c", **origin)
    says = findings(paper)["claims"]
    write_verdicts(conclusions, tmp_path / "verdicts.csv", says=says, **origin)
    for name, read in (("claims.csv", read_claims), ("verdicts.csv", read_verdicts)):
        old, new = read(RESULTS / name), read(tmp_path / name)
        old = old[old["paper"] == paper].reset_index(drop=True)
        if name == "claims.csv":
            old, new = (table.drop(columns="command") for table in (old, new))
        pd.testing.assert_frame_equal(old, new, rtol=1e-6, check_dtype=False)


def test_every_claim_has_one_verdict_and_a_plain_sentence(tracked):
    paper, claims, conclusions = tracked
    assert {each.id for each in conclusions} == set(findings(paper)["claims"])
    for each in conclusions:
        own = [c for c in claims if c.id == each.id]
        waits = [c for c in own if c.about.quantity == WAITS]
        has_headline = any(c.role is Role.HEADLINE for c in own)
        assert waits or has_headline or each.region, each.id  # MX9 is judged by its region alone
        assert (each.sentence == WAITING) == bool(waits)
        assert each.sentence.endswith(".")
        assert "nan" not in each.sentence
        assert not re.search(r"unknown times|unknown share|\de\+\d", each.sentence)
        if each.verdict is Verdict.UNDECIDED:
            why = r"of 100 studies|interval of this share contains [28]0 %"
            assert re.search(why, each.sentence)


def test_criteria_hold_the_rule_and_nothing_that_came_out(tracked):
    _, claims, _ = tracked
    for claim in claims:
        assert claim.criterion
        assert "p = " not in claim.criterion
        if claim.verdict is Verdict.SHOWN:
            assert claim.role is Role.BESIDE


def test_a_claim_says_its_role():
    assert Claim(ABOUT, "s", Interval.exact(1.0), "c", Verdict.REPRODUCED).role is Role.HEADLINE


def test_a_claim_is_selected_if_it_is_the_only_match():
    claims = [shown(Subject("X1", name), "s", Interval(1.0, 0.0, 2.0)) for name in ("a", "a", "b")]
    assert select(claims, quantity="b") is claims[2]
    assert select_all(claims, claim="X1", quantity="a") == claims[:2]
    for wanted, count in (({"quantity": "a"}, 2), ({"quantity": "c"}, 0)):
        with pytest.raises(LookupError, match=f"{count} statistics with "):
            select(claims, **wanted)
