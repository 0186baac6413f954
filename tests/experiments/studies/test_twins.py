"""Claims TW1 and TW2: tables that pass, and tables that fail."""

import functools
import itertools

import numpy as np
import pandas as pd
import pytest

from experiments.judging.claim import Role, Verdict
from experiments.judging.folders import findings
from experiments.judging.sentences import conclude
from experiments.studies.twins import claims, figures, study
from experiments.studies.twins.segments import crps
from experiments.studies.twins.settings import LOGS, METHODS, SHOWN

JUDGED = [log for log in LOGS if log not in SHOWN]
ERRORS_M = np.array([2.0, 0.4, 0.3, 0.2, 0.1])


def runs(errors=None, spread=0.25, n=50):
    """Runs of five methods on each log, whose simulated errors scatter about the ordinary ones."""
    rng = np.random.default_rng(0)
    rows = []
    for number, log in enumerate(LOGS):
        kind = "scans" if number > 4 else "landmarks"
        real = ERRORS_M if errors is None else errors
        scale = 3.0**number
        for method, usual, error in zip(METHODS[kind], ERRORS_M, real, strict=True):
            about = {"log": log, "kind": kind, "method": method, "nees_mean": 3.0}
            rows.append({**about, "seed": -1, "ate_rmse_m": scale * error})
            drawn = scale * usual * np.exp(spread * rng.standard_normal(n))
            rows += [{**about, "seed": 1000 + i, "ate_rmse_m": v} for i, v in enumerate(drawn)]
    return pd.DataFrame(rows)


@functools.cache
def minutes(spread=0.3, shift=1.0, own_scale=3.0, n=60, n_minutes=60):
    """Errors over minutes: the log's own scale, and what its twin draws of them."""
    rng = np.random.default_rng(0)
    rows = []
    for number, log in enumerate(LOGS):
        kind, scale = "scans" if number > 4 else "landmarks", own_scale**number
        for method, segment in itertools.product(METHODS[kind][:2], range(n_minutes)):
            about = {"log": log, "kind": kind, "method": method, "segment": segment}
            drawn = np.exp(0.5 * rng.standard_normal(n + 1))
            rows.append({**about, "seed": -1, "error_m": scale * shift * drawn[0]})
            wide = drawn[1:] ** (spread / 0.3)
            rows += [{**about, "seed": i, "error_m": scale * v} for i, v in enumerate(wide)]
    return study.score_segments(pd.DataFrame(rows))


def verdicts(table, scored=None):
    pairs = study.predict_pairs(table)
    others = study.held_by_others(pairs)
    scored = minutes() if scored is None else scored
    made = [*claims.tw1(pairs, others, scored), *claims.tw2(pairs)]
    said = conclude(made, findings("twins"))
    assert [s.id for s in said] == ["TW1", "TW2"]
    assert all(s.sentence.endswith(".") for s in said)
    return made, {s.id: s.verdict for s in said}


def test_a_twin_that_predicts_is_reproduced():
    made, said = verdicts(runs())
    assert set(said.values()) == {Verdict.REPRODUCED}
    covered, climatology, strange, right, own, other = made[:6]
    assert [c.role for c in (covered, climatology, strange)] == [Role.HEADLINE] * 3
    assert covered.found.value > 0.85
    assert right.found.value == pytest.approx(1.0, abs=0.2)
    assert max(climatology.found.value, strange.found.value) < 0.8
    assert own.found.value == 1.0
    assert own.reason.startswith(f"{5 * len(JUDGED)} of {5 * len(JUDGED)} pairs")
    assert other.found.value < 0.5
    assert {c.role for c in (right, own, other)} == {Role.BESIDE}


@pytest.mark.slow
def test_twins_that_cover_too_little_or_predict_no_better_fail():
    off, said = verdicts(runs(), minutes(shift=4.0))
    assert said["TW1"] is Verdict.NOT_REPRODUCED
    assert off[0].verdict is Verdict.NOT_REPRODUCED
    sure, said = verdicts(runs(), minutes(spread=0.05))
    assert (sure[0].verdict, said["TW1"]) == (Verdict.NOT_REPRODUCED,) * 2
    alike, said = verdicts(runs(), minutes(own_scale=1.0))  # all logs err alike
    assert said["TW1"] is not Verdict.REPRODUCED
    assert alike[1].found.value == pytest.approx(1.0, abs=0.2)


def test_the_crps_is_lowest_for_the_true_distribution():
    rng = np.random.default_rng(0)
    values = rng.normal(size=400)
    scores = {
        (shift, width): np.mean([crps(shift + width * rng.normal(size=50), v) for v in values])
        for shift in (0.0, 1.0)
        for width in (0.3, 1.0, 3.0)
    }
    assert min(scores, key=scores.get) == (0.0, 1.0)
    # of a standard normal: (sqrt(2) - 1) / sqrt(pi) at 0, plus the finite draws' own
    assert np.mean([crps(rng.normal(size=500), 0.0) for _ in range(50)]) == pytest.approx(
        (np.sqrt(2.0) - 1.0) / np.sqrt(np.pi), abs=0.02
    )


def test_whole_errors_stand_beside():
    made, said = verdicts(runs(errors=3.0 * ERRORS_M))
    assert said["TW1"] is Verdict.REPRODUCED
    assert said["TW2"] is Verdict.REPRODUCED  # the order is right all the same
    assert made[4].verdict is Verdict.NOT_REPRODUCED
    wide, _ = verdicts(runs(spread=0.6))  # a factor of 10: too wide but for dead reckoning
    assert wide[4].found.value == pytest.approx(0.2)
    table = runs()
    table["ate_rmse_m"] = table.groupby(["method", "seed"]).ate_rmse_m.transform("first")
    assert verdicts(table)[0][5].verdict is Verdict.NOT_REPRODUCED


def test_the_interval_of_tau_stays_within_its_range():
    pairs = study.predict_pairs(runs())
    pairs.loc[pairs.log == JUDGED[0], "error_m"] = ERRORS_M[::-1]
    found = next(claims.tw2(pairs)).found
    assert -1.0 <= found.low < found.value < found.high == 1.0


def test_another_order_fails():
    _, said = verdicts(runs(errors=ERRORS_M[::-1]))
    assert said["TW2"] is Verdict.NOT_REPRODUCED


def test_the_figure_has_a_panel_a_log():
    page = figures.errors(study.predict_pairs(runs(n=5)))
    assert [ax.get_title() for ax in page.axes][: len(LOGS)] == list(LOGS)
