"""The boards of the report's first screen."""

import pandas as pd

from experiments.report import leaderboard
from experiments.runs.row import write_frame


def test_the_first_screen_has_the_leaderboard_on_lasers(tmp_path):
    path = tmp_path / "peers_methods.csv"
    assert leaderboard.on_lasers(path) == {}
    rows = {"sensor": ["wheels", "laser", "laser"], "estimator": ["w", "theirs", "ours"]}
    rows |= {"project": ["Estima", "other 1.0", "Estima"], "runs": 15}
    rows |= {"ate_rmse_m": [0.001, 0.0321, 0.0123]}
    write_frame(pd.DataFrame(rows), path)
    assert (found := leaderboard.on_lasers(path))["rows"][0] == {
        "method": "ours",
        "project": "Estima",
        "ours": True,
        "error": "0.012",
        "level": False,
        "ratio": "",
    }
    assert (found["n_methods"], found["runs"], found["others"]["method"]) == (2, 15, "theirs")
    write_frame(pd.DataFrame({**rows, "answer": "revised"}), path)
    assert leaderboard.on_lasers(path)["rows"][0]["method"] == "ours (revised)"
    write_frame(pd.DataFrame({**rows, "sensor": "wheels"}), path)
    assert leaderboard.on_lasers(path) == {}


def test_a_tuned_method_is_no_second_one_and_ties_are_said(tmp_path):
    path = tmp_path / "peers_methods.csv"
    rows = {"sensor": "laser", "estimator": ["a", "a_tuned", "b_tuned", "b", "c"], "runs": 15}
    rows |= {"project": "Estima", "ate_rmse_m": [0.01, 0.01, 0.011, 0.011, 0.02]}
    rows |= {"over_best": [1, 1, 1.1, 1.1, 2.0], "answer": "online"}
    rows |= {"low": [1, 1, 0.9, 0.9, 1.5], "high": [1, 1, 1.3, 1.3, 3.0]}
    write_frame(pd.DataFrame(rows), path)
    shown = leaderboard.on_lasers(path)["rows"]
    assert [row["method"] for row in shown] == ["a", "b (tuned)", "c"]
    assert [row["ratio"] for row in shown] == ["", "1.1 [0.90, 1.3]", "2.0 [1.5, 3.0]"]
    assert [row["level"] for row in shown] == [False, True, False]
    write_frame(pd.DataFrame(rows | {"low": [1, 1, 1.05, 1.05, 1.5]}), path)
    assert not any(row["level"] for row in leaderboard.on_lasers(path)["rows"])


def test_a_method_is_compared_with_the_best_that_answers_alike(tmp_path):
    path = tmp_path / "peers_methods.csv"
    rows = {"sensor": "laser", "estimator": ["a", "b", "c"], "runs": 15, "project": "Estima"}
    rows |= {"ate_rmse_m": [0.003, 0.004, 0.005], "answer": ["revised", "online", "online"]}
    rows |= {"over_best": [1, 1, 1.2], "low": [1, 1, 0.9], "high": [1, 1, 1.6]}
    write_frame(pd.DataFrame(rows), path)
    shown = leaderboard.on_lasers(path)["rows"]
    assert [row["ratio"] for row in shown] == ["", "", "1.2 [0.90, 1.6]"]
    assert not any(row["level"] for row in shown)
