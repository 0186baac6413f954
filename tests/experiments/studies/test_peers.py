"""The study of peers: its table, its figure, and what it does without a peer."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from experiments import reproduce
from experiments.judging.results import Profile, Results
from experiments.runs.experiment import Experiment
from experiments.studies.peers import figures, study

ERRORS_M = {"odometry": 1.0, "ekf_icp": 0.02, "ekf_icp_tuned": 0.01, "small_gicp": 0.005}
ERRORS_M |= {"smoother": 0.03, "gtsam_batch": 0.04, "mcl": 0.02, "mrpt_mcl": 0.01}
REVISED = ("smoother", "gtsam_batch")


def runs(seed=0):
    rng = np.random.default_rng(seed)
    return pd.DataFrame(
        [
            {
                "world": world,
                "seed": 1000 + i,
                "estimator": name,
                "status": "ok",
                "answer": "revised" if name in REVISED else "online",
                "answer_ate_rmse_m": error_m * math.exp(0.1 * rng.standard_normal()),
                "answer_heading_rmse_rad": 0.01,
                "cpu_time_us": 100.0 + i,
            }
            for world in ("room", "rooms", "office")
            for i in range(5)
            for name, error_m in ERRORS_M.items()
        ]
    )


@pytest.fixture(autouse=True)
def versions(monkeypatch):
    found = study.version_of
    named = {"small_gicp": "small_gicp 1.0", "gtsam_batch": "gtsam 4.3", "mrpt_mcl": "MRPT"}
    monkeypatch.setattr(study, "version_of", lambda name: named.get(name) or found(name))


def test_the_better_stands_first_whosever_it_is():
    table = runs()
    methods = study.methods(table).set_index("estimator")
    laser = methods[methods["sensor"] == "laser"]
    assert list(laser.index) == ["small_gicp", "ekf_icp_tuned", "ekf_icp"]
    assert list(laser["project"]) == ["small_gicp 1.0", "Estima", "Estima"]
    assert list(laser["tuned"]) == [False, True, False]
    peer = laser.loc["small_gicp"]
    logs = np.log(
        table.pivot(index=["world", "seed"], columns="estimator", values="answer_ate_rmse_m")
    )
    off = logs["small_gicp"] - logs["ekf_icp_tuned"]
    low, high = stats.t.interval(0.95, 14, off.mean(), stats.sem(off))
    assert peer["over_best_ours"] == pytest.approx(math.exp(off.mean()))
    assert (peer["low"], peer["high"]) == pytest.approx((math.exp(low), math.exp(high)))
    assert peer["cpu_time_us"] == 102.0
    assert (peer["runs"], peer["failed"]) == (15, 0)
    assert peer["ate_rmse_m"] == pytest.approx(math.exp(logs["small_gicp"].mean()))


def test_a_failed_run_counts_as_a_large_error():
    table = runs()
    row = table.index[table["estimator"] == "small_gicp"][0]
    table.loc[row, ["status", "answer_ate_rmse_m"]] = ["failed", None]
    methods = study.methods(table).set_index("estimator")
    assert methods.loc["small_gicp", "failed"] == 1
    logs = np.log(
        np.append(runs().query("estimator == 'small_gicp'")["answer_ate_rmse_m"][1:], 100)
    )
    assert methods.loc["small_gicp", "ate_rmse_m"] == pytest.approx(math.exp(logs.mean()))


def test_its_figure(tmp_path):
    made = Results(tmp_path, "peers")
    made.write_tables(methods=study.methods(runs()))
    page = figures.draw(made)["peers_errors"]
    labels = [[t.get_text() for t in axes.get_yticklabels()] for axes in page.axes[::2]]
    assert labels == [
        ["small_gicp", "ekf_icp (tuned)", "ekf_icp"],
        ["mrpt_mcl", "mcl"],
        ["smoother (revised)", "gtsam_batch (revised)"],
    ]


def test_what_is_missing_is_told(tmp_path, monkeypatch):
    absent = Experiment.compose(["estimator=peers/mrpt_icp", "sensors=hokuyo"])
    monkeypatch.chdir(tmp_path)
    assert "make peers" in study.missing(absent)
    assert study.missing(Experiment.compose(["estimator=odometry"])) == ""


def test_it_runs_when_named_and_leaves_the_tuning_alone(tmp_path, monkeypatch):
    assert "peers" in reproduce._chosen(None)
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    kept = tmp_path / "tables" / "peers_trials_tuning.csv"
    kept.parent.mkdir(parents=True)
    kept.write_text("estimator\nekf_icp\n")

    def run(profile, out, on_progress):
        out.write_tables(runs=runs(), methods=study.methods(runs()))
        on_progress(1.0)

    monkeypatch.setattr("experiments.studies.peers.study.run", run)
    assert reproduce.reproduce_paper("peers", Profile.QUICK) == []
    assert (tmp_path / "figures" / "peers_errors.png").exists()
    assert kept.exists()
