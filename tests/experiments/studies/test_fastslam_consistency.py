"""The study of FastSLAM's consistency: every arm over the same drive, each with its own name."""

import numpy as np
import pandas as pd
import pytest

from experiments import reproduce
from experiments.judging.results import Profile
from experiments.runs.experiment import Experiment
from experiments.studies.fastslam_consistency import figures, study
from tests.fixtures.fakes import circle


@pytest.fixture(scope="module")
def runs():
    return list(study.plan(Profile.QUICK))


def test_arms_differ_in_nothing_but_the_filter(runs):
    one_seed = [run for run in runs if run.seed == 1000]
    apart = {"estimator", "seed", "world_seed"}
    settings_of = [{k: v for k, v in r.config.items() if k not in apart} for r in one_seed]
    assert all(each == settings_of[0] for each in settings_of)
    labels = [tuple(study.labels_of(run).values()) for run in one_seed]
    assert len(set(labels)) == len(labels)  # each arm has a name of its own
    assert max(run.config["estimator"].get("n_particles", 0) for run in runs) <= study.MAX_QUICK


def test_rows_hold_the_nees_at_distances(runs, monkeypatch):
    driven = circle(seed=1, n_frames=240, kr=5e-5, kl=5e-5)
    monkeypatch.setattr(Experiment, "recording", lambda self: driven)
    monkeypatch.setattr(study, "DISTANCES_M", (2.0, 4.0, 1000.0))
    chosen = [r for r in runs if r.seed == 1000 and r.estimator_name in ("ekf_slam", "smoother")]
    rows = pd.DataFrame(study.rows_of(chosen)["nees"])
    assert set(rows["filter"]) == {"ekf_slam", "batch"}
    assert np.isnan(rows["nees"][rows["distance_m"] == 1000.0]).all()  # it never came so far
    near = rows["nees"][rows["distance_m"] < 10.0]
    assert ((near > 0.0) & (near < 30.0)).all()


def test_figure_shows_each_arm():
    arms = [("fastslam1", 10, "none"), ("fastslam2", 1000, "none"), ("ekf_slam", 0, "none")]
    arms += [("batch", 0, "none"), ("fastslam2", 1000, "four times the slip")]
    rows = [(*arm, seed, d, 6.0) for arm in arms for seed in (1, 2) for d in (10.0, 20.0)]
    columns = ["filter", "n_particles", "remedy", "seed", "distance_m", "nees"]
    page = figures.by_distance(pd.DataFrame(rows, columns=columns))
    lines = [line for ax in page.axes for line in ax.get_lines()]
    drawn = [line for line in lines if len(line.get_ydata()) and line.get_linewidth() < 2.0]
    assert all(line.get_ydata() == pytest.approx([2.0, 2.0]) for line in drawn)
    named = [text.get_text() for text in page.axes[2].get_legend().get_texts()]
    assert named == ["as it is", "four times the slip"]
    shared = [text.get_text() for text in page.legends[0].get_texts()]
    assert shared == ["M = 10", "EKF-SLAM", "batch least squares", "consistent: 0.79"]
    assert "fastslam_consistency" in reproduce._chosen(None)
