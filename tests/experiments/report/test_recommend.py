"""`estima recommend`: what fits, where it was measured, and what to run."""

import re

import pytest

from experiments.report import recommend as module
from experiments.report.recommend import recommend
from experiments.runs import paths
from sim.errors import InputError

SENSORS = {
    "laser": ["sensors=hokuyo", "robot.kr=2e-5"],
    "landmarks": ["sensors=stereo_pixel"],
    "map": ["sensors=hokuyo", "prior.map=world", "world=office"],
    "wheels": [],
}
FIT = {  # some that fit, and some that do not
    "laser": ({"odometry", "ekf_icp", "graph_slam", "mrpt_icp"}, {"mcl", "smoother", "mrpt_mcl"}),
    "landmarks": ({"odometry", "smoother", "gtsam_batch"}, {"ekf_icp", "mcl", "kiss_icp"}),
    "map": ({"mcl", "mcl_tuned", "ekf_icp", "mrpt_mcl"}, {"ekf_slam", "topological_mcl"}),
    "wheels": ({"odometry"}, {"ekf_icp", "mcl", "smoother", "kiss_icp", "topological_mcl"}),
}


@pytest.fixture(autouse=True)
def no_results_here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("which", FIT)
def test_what_fits_is_named_with_where_it_was_measured(which):
    text, sweep = recommend(SENSORS[which])
    options = set(", ".join(re.findall(r"(?:Fits|would fit): (.*)\.", text)).split(", "))
    fits = {option.rpartition("/")[2] for option in options}
    good, bad = FIT[which]
    assert good <= fits
    assert not bad & fits
    measured = re.findall(r"^  (\w+) +position RMSE ([\d.]+) mm", text, re.MULTILINE)
    assert "odometry" in dict(measured)
    assert {name for name, _ in measured} <= fits
    assert "Nearest judged setting: study=" in text
    assert sweep[: len(SENSORS[which])] == SENSORS[which]
    (tried,) = [word.partition("=")[2] for word in sweep if word.startswith("estimator=")]
    assert set(tried.split(",")) <= options


def test_a_wheel_has_no_tables_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "SOURCE", tmp_path)
    monkeypatch.setattr(paths, "option_names", lambda group: ["odometry", "mcl"])
    shares: list[float] = []
    text, sweep = recommend([], shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert "No tables of results are here" in text
    assert "Fits: odometry." in text
    assert "Needs a sensor laser and a map (prior.map=world): mcl." in text
    assert "estimator=odometry" in sweep


def test_without_a_known_start_only_what_has_a_map_fits(monkeypatch):
    monkeypatch.setattr(paths, "option_names", lambda group: ["ekf_icp", "mcl"])
    text, sweep = recommend(["sensors=hokuyo", "prior.map=world", "prior.start=global"])
    assert "Fits: mcl." in text
    assert "Needs a known start (prior.start=tracking): ekf_icp." in text
    assert "estimator=mcl" in sweep


def test_landmarks_without_ids_need_a_method_that_associates(monkeypatch):
    monkeypatch.setattr(paths, "option_names", lambda group: ["ekf_slam", "odometry", "smoother"])
    text, sweep = recommend(["sensors=stereo_pixel", "sensors.stereo.identifies=false"])
    assert "Fits: ekf_slam, odometry." in text
    assert "Needs landmarks with ids (sensors.stereo.identifies=true): smoother." in text
    assert "the errors below are with ids" in text
    assert "estimator.association=mahalanobis" in sweep
    assert "estimator=ekf_slam" in sweep
    assert "association" not in recommend(["sensors=stereo_pixel"]).text


def test_people_count_in_the_distance(monkeypatch):
    monkeypatch.setattr(paths, "option_names", lambda group: ["odometry"])
    text = recommend(["sensors=hokuyo", "people.n=6"]).text
    assert "people.n 6 (there 0" in text


def test_what_is_read_by_none_and_what_takes_no_team_is_said(monkeypatch):
    monkeypatch.setattr(paths, "option_names", lambda group: ["ekf_slam", "fixed_lag", "odometry"])
    assert "None of these reads gyroscope." in recommend(["sensors=gyroscope"]).text
    text = recommend(["study=teams", "team.size=3"]).text
    assert "Fits: ekf_slam." in text
    assert "Needs a single robot: fixed_lag, odometry." in text
    assert "None of these reads" not in text


def test_where_nothing_fits_that_is_said(monkeypatch):
    monkeypatch.setattr(paths, "option_names", lambda group: ["odometry"])
    text, sweep = recommend(["prior.start=global"])
    assert "None fits." in text
    assert "Needs a known start (prior.start=tracking): odometry." in text
    assert sweep == []


def test_an_unknown_start_counts_in_the_distance(monkeypatch):
    monkeypatch.setattr(paths, "option_names", lambda group: ["mcl"])
    text = recommend(["sensors=hokuyo", "prior.map=world", "prior.start=global"]).text
    assert "prior.start global (there tracking" in text


def test_wrong_overrides_are_refused():
    with pytest.raises(InputError, match="leave the estimator out"):
        recommend(["estimator=mcl"])
    with pytest.raises(InputError, match="leave the recording out: say what it was made with"):
        recommend(["recording=a.npz"])
    with pytest.raises(InputError, match=r"robot\.kr must be"):
        recommend(["robot.kr=-1.0"])


def test_distance_counts_decades_and_choices():
    row = module.Judged("s", "e", {"robot.kr": 1e-4, "world": "room"}, 0.1, 0.1, 0.1, 1)
    asked = {"robot.kr": 1e-6, "world": "office"}
    assert module._changes(asked, row, ["robot.kr", "world"]) == {"robot.kr": 2.0, "world": 1.0}
    assert module._changes(dict(row.setting), row, ["robot.kr", "world"]) == {}
