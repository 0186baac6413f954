"""Claims TW1 and TW2: tables that pass, and tables that fail."""

import numpy as np
import pandas as pd
import pytest

from experiments.judging.claim import Role, Verdict
from experiments.judging.folders import findings
from experiments.judging.sentences import conclude
from experiments.studies.twins import claims, figures, study
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


def verdicts(table):
    pairs = study.predict_pairs(table)
    made = [*claims.tw1(pairs, study.held_by_others(pairs)), *claims.tw2(pairs)]
    said = conclude(made, findings("twins"))
    assert [s.id for s in said] == ["TW1", "TW2"]
    assert all(s.sentence.endswith(".") for s in said)
    return made, {s.id: s.verdict for s in said}


def test_a_twin_that_predicts_is_reproduced():
    made, said = verdicts(runs())
    assert set(said.values()) == {Verdict.REPRODUCED}
    own, every, other = made[:3]
    assert own.found.value == every.found.value == 1.0
    assert own.reason.startswith(f"{5 * len(JUDGED)} of {5 * len(JUDGED)} pairs")
    assert every.reason == "50 simulations a log"
    assert other.found.value < 0.5
    assert made[3].found.value == pytest.approx(1.0)
    assert all(claim.role is Role.BESIDE for claim in made[4:])


def test_errors_outside_and_intervals_too_wide_fail():
    made, said = verdicts(runs(errors=3.0 * ERRORS_M))
    assert said["TW1"] is Verdict.NOT_REPRODUCED
    assert said["TW2"] is Verdict.REPRODUCED  # the order is right all the same
    assert made[0].found.value == 0.0
    wide, said = verdicts(runs(spread=0.6))  # a factor of 10: too wide but for dead reckoning
    assert said["TW1"] is Verdict.NOT_REPRODUCED
    assert wide[0].found.value == pytest.approx(0.2)
    assert wide[1].found.value == 1.0


def test_the_interval_of_tau_stays_within_its_range():
    pairs = study.predict_pairs(runs())
    pairs.loc[pairs.log == JUDGED[0], "error_m"] = ERRORS_M[::-1]
    found = next(claims.tw2(pairs)).found
    assert -1.0 <= found.low < found.value < found.high == 1.0


def test_another_order_fails():
    _, said = verdicts(runs(errors=ERRORS_M[::-1]))
    assert said["TW2"] is Verdict.NOT_REPRODUCED


def test_a_twin_that_holds_every_logs_errors_fails():
    table = runs()
    table["ate_rmse_m"] = table.groupby(["method", "seed"]).ate_rmse_m.transform("first")
    assert verdicts(table)[1]["TW1"] is Verdict.NOT_REPRODUCED


def test_the_figure_has_a_panel_a_log():
    page = figures.errors(study.predict_pairs(runs(n=5)))
    assert [ax.get_title() for ax in page.axes][: len(LOGS)] == list(LOGS)
