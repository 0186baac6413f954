"""The study of global localization in offices: what counts as localised, and a start or two."""

import math

import numpy as np
import pandas as pd
import pytest

from experiments import reproduce
from experiments.judging.results import Profile, Results
from experiments.runs.experiment import Experiment
from experiments.studies.mcl_office.figures import draw, found_by
from experiments.studies.mcl_office.study import found_after_m, localised_share, starts

TRAVEL_M = np.arange(0.0, 40.6, 0.5)


def near_in(*spans):
    near = np.zeros(len(TRAVEL_M), bool)
    for low, high in spans:
        near |= (low <= TRAVEL_M) & (high >= TRAVEL_M)
    return near


@pytest.mark.parametrize(
    ("spans", "found_m"),
    [
        ([(0, 50)], 0.0),
        ([(5, 14)], math.inf),  # near for 9 m only
        ([(5, 15)], 5.0),
        ([(3, 8), (20, 31)], 20.0),  # lost again: only the second time counts
        ([(30, 50)], 30.0),
        ([(30.5, 50)], math.inf),  # too late
        ([], math.inf),
    ],
)
def test_found_and_stays_found(spans, found_m):
    assert found_after_m(TRAVEL_M, near_in(*spans)) == found_m


def test_a_drive_that_ends_early_does_not_count():
    cut = TRAVEL_M <= 9.0
    assert found_after_m(TRAVEL_M[cut], near_in((0, 50))[cut]) == math.inf


def table():
    rng = np.random.default_rng(0)
    found = np.where(np.arange(60) % 20 == 7, np.inf, rng.exponential(3.0, 60))
    seeds, starts = np.divmod(np.arange(60), 20)
    return pd.DataFrame(
        {"seed": 1000 + seeds, "start": starts, "found_m": found, "localised": np.isfinite(found)}
    )


def test_share_with_its_intervals():
    shares = localised_share(table()).set_index("independent")
    exact, by_office = shares.loc["starts"], shares.loc["offices"]
    assert exact.value == by_office.value == pytest.approx(0.95)
    assert exact.low == pytest.approx(0.861, abs=2e-3)  # Clopper and Pearson, 57 of 60
    assert by_office.low == pytest.approx(0.95)  # every office has 19 of 20


def test_figure_ends_at_the_share():
    left = found_by(table()).axes[0]
    steps = left.get_lines()[0].get_ydata()
    assert steps[0] == 0.0
    assert steps[-1] == pytest.approx(0.95)


def test_it_is_run_alone_when_named():
    assert "mcl_office" in reproduce._chosen(None)
    assert reproduce._chosen("mcl_office") == ("mcl_office",)


def test_the_figure_comes_from_disk(tmp_path):
    made = Results(tmp_path, "mcl_office")
    made.write_tables(starts=table())
    assert list(draw(made)) == ["mcl_office_found"]


def test_nothing_is_judged(tmp_path, monkeypatch):
    def run(_profile, out, _on_progress):
        out.write_tables(starts=table())

    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    monkeypatch.setattr("experiments.studies.mcl_office.study.run", run)
    assert reproduce.reproduce_paper("mcl_office", Profile.QUICK) == []
    assert (tmp_path / "figures" / "mcl_office_found.png").exists()


@pytest.mark.slow
def test_starts_in_a_short_drive(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    office = Experiment.compose(["study=mcl_office", "seed=7", "route.distance_m=45"])
    rows, again = (starts(office, 2)["starts"] for _ in range(2))
    assert [row["start"] for row in rows] == [0, 1]
    for row, same in zip(rows, again, strict=True):
        assert row["found_m"] == same["found_m"]
        assert row["localised"] == np.isfinite(row["found_m"])
        if row["localised"]:
            assert row["near_share"] > 0.9
