"""The answer of a sweep: who won, by how much, what is level, by which test."""

import numpy as np
import pandas as pd
import pytest

from experiments.evaluation.statistics import paired_p
from experiments.sweeps.winner import differing_pairs, find_winner


def rows(errors, worlds=("office",), **columns):
    """A row a method, world and recording, of errors {method: one a recording}."""
    found = [
        {
            "choice.estimator": name,
            "world": world,
            "seed": i,
            "recording_checksum": f"{world}{i}",
            "repeat": 0,
            "ate_rmse_m": error,
            "status": "ok",
            "status_code": "",
        }
        for world in worlds
        for name, each in errors.items()
        for i, error in enumerate(each)
    ]
    return pd.DataFrame(found).assign(**columns)


DRIVES = np.array([0.8, 1.3, 1.0, 0.7, 1.5, 1.1, 0.9, 1.2])
NOISE = np.exp(0.05 * np.array([1.0, -0.5, 0.3, -1.2, 0.9, -0.2, 0.4, -0.7]))


def test_methods_with_the_same_errors_are_equal():
    same = {"one": 0.01 * DRIVES, "other": 0.01 * DRIVES}
    said = find_winner(rows(same)).sentences()
    assert said == ["one, other: the same error, 0.0103 m.", "Over 8 recordings."]
    said = find_winner(rows({**same, "bad": 0.03 * DRIVES * NOISE})).sentences()
    assert said[0] == "one has the smallest error (as other): 0.0103 m."
    assert said[1].startswith("Significantly worse: bad (")


def test_the_winner_its_margin_and_what_is_level():
    errors = {"good": 0.01 * DRIVES, "level": 0.0101 * DRIVES * NOISE, "bad": 0.03 * DRIVES * NOISE}
    won = find_winner(rows(errors))
    assert won.name == "good"
    assert won.error_m == pytest.approx(0.01 * np.exp(np.log(DRIVES).mean()))
    level, bad = won.rivals
    assert (level.name, level.differs, bad.name, bad.differs) == ("level", False, "bad", True)
    logs = np.log(errors["bad"] / errors["good"])
    assert bad.ratio == pytest.approx(np.exp(logs.mean()))
    assert bad.low < 3.0 < bad.high
    assert paired_p(logs) < 0.025
    words = " ".join(won.sentences())
    assert "No single winner: good has the smallest error, 0.0103 m" in words
    assert "not significantly smaller than that of level (1.01 [" in words
    assert "Significantly worse: bad (3 [2.9, 3.1] times as large)." in words
    assert (
        "Paired t tests of the logs of all pairs over 8 recordings, at 5 % in all (Holm)." in words
    )


def test_only_common_recordings_count_and_other_settings_are_averaged():
    table = rows({"a": DRIVES, "b": 2.0 * DRIVES * NOISE}, worlds=("office", "rooms"))
    table = table[~((table["choice.estimator"] == "a") & (table["seed"] > 5))]
    won = find_winner(table)
    assert (won.name, won.n_recordings) == ("a", 12)


def test_who_failed_somewhere_cannot_win():
    table = rows({"a": 0.1 * DRIVES, "b": DRIVES, "c": 2.0 * DRIVES * NOISE})
    table.loc[(table["choice.estimator"] == "a") & (table["seed"] == 2), "status"] = "failed"
    won = find_winner(table)
    assert (won.name, won.out) == ("b", ("a",))
    assert "Left out, since runs failed or have gaps: a." in won.sentences()


def test_of_one_estimator_its_settings_are_compared():
    table = pd.concat(
        rows({"mcl": each * DRIVES * NOISE}).assign(**{"estimator.n": n})
        for n, each in ((100, 2.0), (500, 1.0))
    )
    won = find_winner(table)
    assert won.name.endswith("500")
    assert won.rivals[0].ratio == pytest.approx(2.0)


def test_two_recordings_are_too_few_and_one_arm_is_no_contest():
    won = find_winner(rows({"a": DRIVES[:2], "b": 3.0 * DRIVES[:2]}))
    assert won.name == "a"
    assert not won.rivals[0].differs
    assert "too few for a test" in won.sentences()[-1]
    assert find_winner(rows({"a": DRIVES})) is None


@pytest.mark.slow
def test_false_alarms_among_equals_are_held():
    rng = np.random.default_rng(5)
    n, wrong = 400, 0
    for _ in range(n):
        drives = rng.lognormal(0.0, 0.5, 8)
        errors = pd.DataFrame({name: drives * rng.lognormal(0.0, 0.1, 8) for name in "abcd"})
        best = np.log(errors).mean().idxmin()
        wrong += any(best in pair for pair in differing_pairs(errors))
    assert wrong / n < 0.05 + 2.0 * (0.05 * 0.95 / n) ** 0.5  # though the data choose the best
