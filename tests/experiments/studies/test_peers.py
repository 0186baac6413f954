"""The study of peers: its table, its figure, and what it does without a peer."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from experiments import reproduce
from experiments.judging.results import Profile, Results
from experiments.runs.experiment import Experiment
from experiments.studies.installed import why_absent
from experiments.studies.peers import figures, study
from experiments.studies.peers.settings import CLASSES
from experiments.studies.peers.version import is_ours

ROOT = Path(__file__).resolve().parents[3]
ARMS = {  # error by estimator and arm, m
    ("odometry", "informed"): 1.0,
    ("ekf_icp", "informed"): 0.02,
    ("ekf_icp", "slip a tenth"): 0.001,
    ("small_gicp", "shipped"): 0.2,
    ("small_gicp_tuned", "tuned"): 0.0205,
    ("mcl", "informed"): 0.02,
    ("mrpt_mcl", "shipped"): 0.01,
    ("smoother", "informed"): 0.03,
    ("gtsam_batch", "informed"): 0.04,
}
REVISED = ("smoother", "gtsam_batch")


def runs(seed=0):
    rng = np.random.default_rng(seed)
    return pd.DataFrame(
        [
            {
                "board": board,
                "seed": 1000 + i,
                "estimator": name,
                "arm": arm,
                "answer": "revised" if name in REVISED else "online",
                "status": "ok",
                "ate_rmse_m": error_m * math.exp(0.1 * rng.standard_normal()),
                "heading_rmse_rad": 0.01,
                "nees_mean": 6.0,
                "unused_share": 0.25,
                "cpu_time_us": 100.0 + i,
            }
            for board in CLASSES
            for i in range(4)
            for (name, arm), error_m in ARMS.items()
        ]
    )


@pytest.fixture(autouse=True)
def versions(monkeypatch):
    """Versions of peers that need not be installed."""
    found = study.version_of
    monkeypatch.setattr(
        study, "version_of", lambda name: found(name) if is_ours(name) else "peer 1"
    )


def test_the_better_stands_first_and_ties_are_ties():
    table = runs()
    found = study.methods(table)
    laser = found[found["sensor"] == "laser"].set_index(["estimator", "arm"])
    assert [name for name, _ in laser.index[:2]] == ["ekf_icp", "ekf_icp"]
    assert not laser.loc[("ekf_icp", "slip a tenth"), ["competes", "level"]].any()
    assert laser.loc[("small_gicp", "shipped"), "project"] == "peer 1"
    # a percent of difference is a tie, tenfold is not
    assert list(laser["level"]) == [False, True, True, False]
    peer = laser.loc[("small_gicp", "shipped")]
    wide = table.pivot(index=["board", "seed"], columns=["estimator", "arm"], values="ate_rmse_m")
    off = np.log(wide["small_gicp"]["shipped"] / wide["ekf_icp"]["informed"])
    low, high = stats.t.interval(0.95, 23, off.mean(), stats.sem(off))
    assert peer["over_best"] == pytest.approx(math.exp(off.mean()))
    assert (peer["low"], peer["high"]) == pytest.approx((math.exp(low), math.exp(high)))
    assert (peer["runs"], peer["failed"], peer["cpu_time_us"]) == (24, 0, 101.5)
    assert (peer["nees_over_3"], peer["used_share"]) == (2.0, 0.75)


def test_a_class_of_one_drive_tests_nothing():
    found = study.methods(runs().query("seed == 1000"))
    assert found.loc[found["competes"], "level_rooms"].all()


def test_a_failed_run_counts_as_a_large_error():
    table = runs()
    mine = table["estimator"] == "small_gicp"
    table.loc[table.index[mine][0], ["status", "ate_rmse_m"]] = ["failed", None]
    found = study.methods(table).set_index("estimator").loc["small_gicp"]
    assert found["failed"] == 1
    logs = np.log(np.append(runs().loc[mine, "ate_rmse_m"][1:], 100))
    assert found["ate_rmse_m"] == pytest.approx(math.exp(logs.mean()))


def test_a_failed_run_has_no_revised_row_and_counts_all_the_same():
    table = runs()
    revised = table.index[table["estimator"] == "gtsam_batch"]
    found = study.methods(table.drop(revised[0])).set_index("estimator").loc["gtsam_batch"]
    assert (found["runs"], found["failed"]) == (24, 1)
    logs = np.log(np.append(table.loc[revised[1:], "ate_rmse_m"], 100))
    assert found["ate_rmse_m"] == pytest.approx(math.exp(logs.mean()))


def test_its_figure(tmp_path):
    made = Results(tmp_path, "peers")
    made.write_tables(methods=study.methods(runs()))
    page = figures.draw(made)["peers_errors"]
    labels = [[t.get_text() for t in axes.get_yticklabels()] for axes in page.axes[::7]]
    assert labels == [
        ["ekf_icp", "small_gicp, tuned", "small_gicp, shipped"],
        ["mrpt_mcl, shipped (map)", "mcl (map)"],
        ["smoother", "gtsam_batch, informed"],
    ]


def test_what_is_missing_is_told(tmp_path, monkeypatch):
    absent = Experiment.compose(["estimator=peers/mrpt_icp", "sensors=hokuyo"])
    monkeypatch.chdir(tmp_path)
    assert "make peers" in why_absent(absent)
    assert why_absent(Experiment.compose(["estimator=odometry"])) == ""


@pytest.mark.slow
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


def test_the_comparison_says_what_the_table_has():
    table = pd.read_csv(ROOT / "results" / "tables" / "peers_methods.csv")
    text = " ".join((ROOT / "docs" / "programs.md").read_text(encoding="utf-8").split())
    of = table[table["answer"] == "online"].set_index(["sensor", "estimator", "arm"])
    for key in (
        ("laser", "small_gicp_keyframe_tuned", "tuned"),
        ("laser", "kiss_icp_tuned", "tuned"),
        ("laser", "ekf_icp", "slip a tenth"),
        ("laser", "ekf_icp", "slip tenfold"),
        ("laser", "ekf_icp", "sensor noise threefold"),
        ("laser, known map", "mrpt_mcl_tuned", "tuned"),
    ):
        value, low, high = (f"{of.loc[key, name]:.1f}" for name in ("over_best", "low", "high"))
        assert f"{value} [{low}, {high}] times" in text or f"{value} [{low}, {high}]." in text, key
    lasers = of.loc["laser"]
    assert list(lasers.index[lasers["level"]]) == [
        (n, "informed") for n in ("ekf_icp", "graph_slam")
    ]
    arms = "slip a tenth", "slip tenfold", "sensor noise threefold"
    errors_m = lasers["ate_rmse_m"]
    misled = [errors_m["graph_slam", arm] / errors_m["graph_slam", "informed"] for arm in arms]
    assert "`graph_slam` then has {:.1f}, {:.1f} and {:.1f} times its own".format(*misled) in text
    ours, theirs = (of.loc[("laser, known map", *key)] for key in
                    (("mcl", "informed"), ("mrpt_mcl_tuned", "tuned")))  # fmt: skip
    assert of.loc[("laser, known map", "mcl", "informed"), "level"]
    heading = theirs["heading_rmse_rad"] / ours["heading_rmse_rad"]
    time = theirs["cpu_time_us"] / ours["cpu_time_us"]
    assert f"{heading:.1f} times its heading error, at {time:.1f} times its processor" in text
    level = {name for name in CLASSES if theirs[f"level_{name}"]}
    assert level == {"curved", "clutter"}
    misled = of.loc[("laser, known map", "mcl", "slip a tenth"), "heading_rmse_rad"]
    assert f"has {misled / ours['heading_rmse_rad']:.1f} times its heading error" in text
    assert ours["ate_rmse_m_changed"] < theirs["ate_rmse_m_changed"]
    known = table[table["sensor"] == "landmarks"].set_index(["answer", "estimator", "arm"])
    assert known.loc[("revised", "gtsam_batch", "informed"), "failed"] == 1
