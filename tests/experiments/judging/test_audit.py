"""The audit finds what differs, in the share of trials that theory gives, and says no more."""

import math

import numpy as np
import pandas as pd
import pytest

from estimators import odometry
from experiments import audit as module
from experiments.audit import Drawn, Finding, Place, check, draw, headline_rows, summarize
from experiments.judging import remake
from experiments.judging.folders import LOGS, STUDIES, part
from experiments.judging.logs import why_missing
from experiments.judging.remake import agrees, as_written, differing, is_time, max_share
from experiments.judging.results import Results
from experiments.runs.paths import SOURCE
from sim.errors import InputError

JUDGED = SOURCE / "results"
NEW = {
    "segments",
    "said",
    "consistency",
}  # tables that wait for the judged run, as those of regions do


@pytest.fixture(autouse=True)
def judged(monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(JUDGED))


def table_of(study, name):
    return Results(JUDGED, study).table(name)


def row_of(table, number):
    return table.iloc[number].to_dict()


# Comparing


def test_rows_compare_to_the_digit_that_is_written():
    made = pd.DataFrame(
        {"a": [1.0 / 3.0, 2.0], "step_us": [1.0, 2.0], "word": ["x", "y"], "flag": [True, False],
         "known": [np.nan, 1.0], "far": [np.inf, 1.0]}
    )  # fmt: skip
    written = as_written(made)
    row = row_of(written, 0) | {"step_us": 7.0}
    assert differing(row, written) == [], "a computing time does not count"
    assert differing(row | {"a": 0.333333333334}, written) == ["a"]
    assert differing(row | {"a": 0.333333333334}, written, 1e-9) == []
    for name, other in (("word", "z"), ("flag", False), ("known", 1.0), ("far", 1.0)):
        assert differing(row | {name: other}, written) == [name]
    assert differing(row | {"more": 1.0}, written) == ["more"]
    assert differing(row | {"more": math.nan}, written) == []
    assert len(differing(row, written[:0])) == 5


def test_columns_of_times_are_known():
    columns = {
        name for path in (JUDGED / "tables").glob("*.csv") for name in pd.read_csv(path, nrows=0)
    }
    assert {name for name in columns if is_time(name)} == {
        "censi_last_time_us", "cpu_time_us", "hessian_points_time_us", "plane_time_us",
        "point_time_us", "realtime_factor", "registration_us", "sampling_time_us", "step_mean_us",
        "step_ms", "step_time_us", "step_us", "time_s", "time_us",
    }  # fmt: skip


def test_labels_are_compared_as_a_table_holds_them():
    row = {"seed": 3.0, "kind": "a", "sigma": math.nan, "joint": np.bool_(True)}
    assert agrees(row, {"seed": 3, "kind": "a", "sigma": None, "joint": True, "other": 1})
    for other in ({"seed": 4}, {"kind": "b"}, {"sigma": 1.0}, {"joint": False}):
        assert not agrees(row, other)


# Drawing


def test_the_limit_is_exact_binomial():
    for n, k in ((10, 0), (200, 0), (200, 3), (50, 49)):
        share = max_share(n, k)
        assert math.isclose(sum(math.comb(n, i) * share**i * (1 - share) ** (n - i)
                                for i in range(k + 1)), 0.05, rel_tol=1e-6)  # fmt: skip
    assert max_share(200, 0) == pytest.approx(1.0 - 0.05 ** (1 / 200))
    assert max_share(0, 0) == max_share(3, 3) == 1.0


def tables():
    return {
        Place(study, name): table_of(study, name)
        for study, name in (("gil2008", "laps"), ("gil2008", "particles"), ("gil2008", "cost"),
                            ("decristoforis2020", "metrics"), ("decristoforis2020", "boxes"))
    }  # fmt: skip


def test_rows_are_drawn_evenly_and_behind_each_headline(monkeypatch):
    given = tables()
    strata = {"GI1": [(Place("gil2008", "laps"), np.array([5, 6]))], "none": []}
    monkeypatch.setattr(module, "headline_rows", lambda _: strata)
    drawn = draw(given, np.random.default_rng(0), math.inf, 2000)
    assert len(drawn) == 2000
    assert drawn[0].headline == "GI1"
    assert drawn[0].number in (5, 6)
    evenly = pd.Series([each.place.table for each in drawn if not each.headline])
    assert set(evenly) == {"laps", "particles", "metrics"}, "neither times nor quartiles"
    sizes = {place.table: len(table) for place, table in given.items()}
    share = sizes["particles"] / (sizes["laps"] + sizes["particles"] + sizes["metrics"])
    assert (evenly == "particles").mean() == pytest.approx(share, abs=0.02)
    again = draw(given, np.random.default_rng(0), math.inf, 2000)
    assert [each.number for each in again] == [each.number for each in drawn]
    short = draw(given, np.random.default_rng(0), 60.0)
    assert 50.0 < sum(each.cost_s for each in short) <= 60.0


def test_each_headline_knows_the_rows_behind_it():
    study = "real_logs"
    names = [path.stem.removeprefix(f"{study}_") for path in (JUDGED / "tables").glob(f"{study}_*")]
    given = {Place(study, name): table_of(study, name) for name in names}
    strata = headline_rows(given)
    assert len(strata) == 11
    assert all(strata.values())
    ((place, _),) = strata[next(n for n in strata if n.startswith("RL3 ATE of FastSLAM, known"))]
    assert place.table == "mrclam"
    read = {name.split()[0]: {place.table for place, _ in s} for name, s in strata.items()}
    assert read["RL4"] == {"wheels", "lego"}
    assert read["RL5"] == {"wean"}
    assert part(study, "claims").rl3.__name__ == "rl3", "the functions are as they were"


def test_every_table_that_can_be_made_again_is_there():
    for study in STUDIES:
        names = {p.stem.removeprefix(f"{study}_") for p in (JUDGED / "tables").glob(f"{study}_*")}
        made = {name for name in part(study, "study").REMADE if not name.startswith("region_")}
        assert made - NEW <= names


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES)
def test_rows_of_every_table_have_a_call_that_makes_them(study):
    """It is not made here; of programs and of logs that are not here there may be none."""
    rng, module = np.random.default_rng(0), part(study, "study")
    for path in sorted((JUDGED / "tables").glob(f"{study}_*.csv")):
        name = path.stem.removeprefix(f"{study}_")
        if name in module.REMADE and not (study in LOGS and why_missing()):
            table = table_of(study, name)
            for number in rng.choice(len(table), min(3, len(table)), replace=False):
                call = module.remake(name, row_of(table, int(number)))
                assert call is None or callable(call[0]), (name, number)


# Finding


@pytest.mark.slow
def test_a_digit_changed_in_one_row_of_500_is_found_as_often_as_theory_says():
    """200 audits by resampling rows that were made already: 1000 rows, 2 of them changed."""
    made = as_written(table_of("gil2008", "particles")[:1000])
    changed = {137: "ate_rmse_m", 821: "map_rmse_m"}
    rows = [row_of(made, number) for number in range(len(made))]
    for number, name in changed.items():
        rows[number][name] = float(f"{rows[number][name] * (1.0 + 1e-11):.12g}")
    differs = np.array([bool(differing(row, made[i : i + 1])) for i, row in enumerate(rows)])
    assert np.flatnonzero(differs).tolist() == sorted(changed)
    n, trials, rng = 300, 200, np.random.default_rng(0)
    found = sum(differs[rng.choice(1000, n, replace=False)].any() for _ in range(trials))
    theory = 1.0 - math.comb(998, n) / math.comb(1000, n)
    assert abs(found / trials - theory) < 3.0 * math.sqrt(theory * (1 - theory) / trials)
    share = [max_share(n, differs[rng.choice(1000, n, replace=False)].sum()) for _ in range(trials)]
    assert np.mean(np.array(share) >= 0.002) >= 0.95, "the limit holds"


CHEAP = [("puzzlebot2024", name) for name in ("crossover", "table_1", "short_turns")]


@pytest.mark.slow
@pytest.mark.parametrize(("study", "name"), CHEAP)
def test_a_judged_row_is_made_again(study, name):
    row = row_of(table_of(study, name), 3)
    made = module.make_again(study, name, row)
    assert differing(row, made, remake.ELSEWHERE) == []


@pytest.mark.slow
def test_a_changed_sign_and_an_edited_study_are_found(monkeypatch):
    row = row_of(table_of("puzzlebot2024", "crossover"), 3)
    with monkeypatch.context() as patched:
        kept = odometry.arc_increment_jacobian
        patched.setattr(odometry, "arc_increment_jacobian", lambda *given: -np.abs(kept(*given)))
        made = module.make_again("puzzlebot2024", "crossover", row)
        assert differing(row, made, remake.ELSEWHERE) == ["crossover_m"]
    with monkeypatch.context() as patched:
        study = part("puzzlebot2024", "study")
        kept_plan = study.plan_experiments
        patched.setattr(
            study, "plan_experiments", lambda words: kept_plan([*words, "robot.kr=2e-4"])
        )
        made = module.make_again("puzzlebot2024", "crossover", row)
        assert differing(row, made, remake.ELSEWHERE) == ["crossover_m"]


def test_what_fails_or_is_not_here_is_said():
    place = Place("gil2008", "laps")
    row = row_of(table_of("gil2008", "laps"), 0)
    assert "cannot be made again (KeyError" in module.make_again("gil2008", "laps", {})
    bad = check(Drawn(place, 0, row, 1.0), "cannot be made again (ValueError: no)")
    assert str(bad) == "gil2008_laps, row 2: cannot be made again (ValueError: no)"
    good = Finding(Drawn(place, 1, row, 1.0), [])
    behind = Finding(Drawn(place, 2, row, 1.0, "GI1"), ["ate_rmse_m"])
    given = {
        place: table_of("gil2008", "laps"),
        Place("gil2008", "cost"): table_of("gil2008", "cost"),
    }
    lines = summarize([good] * 98 + [behind], 4, given)
    assert lines[0] == "gil2008_laps, row 4: ate_rmse_m"
    n_laps, n_cost = (len(table) for table in given.values())
    assert lines[1].startswith(f"left out: {100.0 * n_cost / (n_laps + n_cost):.1f} % of the rows")
    assert lines[1].endswith("4 drawn rows of programs that are not here")
    assert lines[-1].startswith("98 of 99 rows equal, 1 of them behind headlines; of the 98 drawn")
    assert "at most 3 % of all rows can differ (95 %); different: ate_rmse_m (1)" in lines[-1]


def test_the_command_says_what_came_out(monkeypatch, capsys):
    row = row_of(table_of("decristoforis2020", "metrics"), 0)
    given = {
        Place("decristoforis2020", "metrics"): module.make_again(
            "decristoforis2020", "metrics", row
        )
    }
    monkeypatch.setattr(module, "_judged_tables", given.items)
    monkeypatch.setattr(module, "headline_rows", lambda _: {})
    monkeypatch.setattr(module, "in_parallel", lambda f, jobs, *_: [f(*job) for job in jobs])
    monkeypatch.setattr(module, "tolerance", lambda _: remake.ELSEWHERE)
    assert module.audit(1.0, 3, seed=1)
    assert "3 of 3 rows equal" in capsys.readouterr().out
    (table,) = given.values()
    table["error_m"] *= 1.001
    assert not module.audit(1.0, 3, seed=1)
    assert "0 of 3 rows equal" in capsys.readouterr().out
    for minutes, rows in ((0.0, None), (1.0, 0)):
        with pytest.raises(InputError, match="must be positive"):
            module.audit(minutes, rows, seed=0)
    monkeypatch.setattr(module, "_judged_tables", lambda: [])
    with pytest.raises(InputError, match="no judged tables; run it in a clone"):
        module.audit(1.0, None, seed=0)
