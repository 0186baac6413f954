"""Claims that stop when they are decided: designs, verdicts at looks, studies in blocks."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest

from experiments.judging import sequential
from experiments.judging.claim import Subject, select
from experiments.judging.folders import ROOMS
from experiments.judging.sequential import Design, designs, judge_ratio, run_until_decided
from experiments.papers.gil2008 import claims as gil2008
from sim.errors import InputError

ABOUT = Subject("X1", "a ratio")
DESIGN = Design(spread=0.3, looks=(20, 40, 80, 160))


def judged(effect, n, design=DESIGN, spread=0.3, **limits):
    noise = np.random.default_rng(0).normal(0.0, spread, n)
    return judge_ratio(
        ABOUT, "a ratio", (np.exp(effect + noise - noise.mean()), np.ones(n)), design,
        **(limits or {"at_most": 1.0}),
    )  # fmt: skip


def test_a_claim_is_decided_goes_on_or_is_capped():
    clear, against = judged(-0.5, 20), judged(0.5, 20)
    assert (clear.verdict, against.verdict) == ("reproduced", "not_reproduced")
    early = judged(-0.1, 20)
    assert (early.verdict, early.facts["is_open"], early.facts["look"]) == ("undecided", True, 1)
    capped = judged(-0.05, 160, spread=0.6)
    assert (capped.verdict, capped.facts["is_open"]) == ("undecided", False)
    assert 0.2 < capped.power < 0.6
    assert capped.effect == "an effect of 10 %"
    none = judged(-0.5, 10)  # before the first look
    assert (none.verdict, none.facts["look"], none.facts["is_open"]) == ("undecided", 0, True)
    assert math.isnan(none.power)


def test_as_good_as_at_the_limit_decides_against_the_claim():
    same = judged(0.0, 160, spread=0.1)
    assert (same.verdict, same.reason) == (
        "not_reproduced",
        "within 10 %, its smallest effect of interest",
    )
    assert judged(0.0, 160, spread=0.1, at_least=0.8, at_most=1.25).verdict == "reproduced"


def test_designs_of_all_studies_are_sound():
    studies = [folder.name for room in ROOMS for folder in room.iterdir() if folder.is_dir()]
    found = {(study, name): each for study in studies for name, each in designs(study).items()}
    assert ("gil2008", "GI3") in found
    for design in found.values():
        assert design.looks[0] >= 20
        assert design.power > 0.88
    wasted = dataclasses.replace(DESIGN, spread=3.0)
    assert wasted.power < 0.2


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"X1": {"spread": 0.1, "effect": 0.1}}, "designs.X1: needs spread, looks and effect"),
        ({"X1": {"spread": 0.1, "effect": 0.1, "looks": [40, 20]}}, "must increase"),
        ({"X1": {"spread": 0.0, "effect": 0.1, "looks": [40]}}, "must be > 0"),
    ],
)
def test_a_wrong_design_is_named(monkeypatch, given, complaint):
    monkeypatch.setattr(sequential.folders, "design", lambda _: {"designs": given})
    with pytest.raises(InputError, match=complaint):
        designs("paper")


def particles(n_worlds, gain):
    """Rows of gil2008's study of particles, the worlds one by one."""
    rows = []
    for seed in range(2000, 2000 + n_worlds):
        rng = np.random.default_rng(seed)
        for m in (200, 1000):
            error = (gain if m == 200 else 1.0) * math.exp(rng.normal(0.0, 0.2))
            rows.append((seed, 0, m, *[error] * len(gil2008.ERRORS)))
    table = pd.DataFrame(rows, columns=["seed", "draw", "n_particles", *gil2008.ERRORS])
    return table.assign(filter="paper", noise="paper")


@pytest.mark.parametrize(
    ("gain", "verdict", "most"), [(1.0, "reproduced", 50), (2.0, "not_reproduced", 20)]
)
def test_a_study_runs_in_blocks_until_its_headline_is_decided(gain, verdict, most):
    design, sizes = designs("gil2008")["GI3"], []

    def run_to(n):
        sizes.append(n)
        return particles(n, gain)

    table, found = run_until_decided(
        design.looks, run_to, lambda t: [*gil2008.gi3(t, None, design)]
    )
    assert select(found, quantity="position", arm=None).verdict == verdict
    assert sizes == list(design.looks[: len(sizes)])
    assert sizes[-1] <= most
    assert table["seed"].nunique() == sizes[-1]


def test_a_study_ends_at_its_cap():
    design, sizes = Design(0.3, (20, 30), 0.25), []
    table, found = run_until_decided(
        design.looks,
        lambda n: sizes.append(n) or particles(n, 1.25),
        lambda t: [*gil2008.gi3(t, None, design)],
    )
    claim = select(found, quantity="position", arm=None)
    assert (claim.verdict, sizes, len(table)) == ("undecided", [20, 30], 60)
    assert 0.0 <= claim.power < 1.0
