"""A run whose picture is hard to draw, or cannot be drawn, keeps its results."""

import dataclasses

import numpy as np
import pytest

from experiments.runs.evaluate import run_robots
from experiments.runs.experiment import Experiment
from experiments.runs.run import run_once
from experiments.runs.store import read_runs
from experiments.viewing.run_figure import draw_run, run_figure
from experiments.viewing.style import save_figure
from sim.recording import save
from sim.team import Team
from tests.fixtures import fakes


def partly_true():
    """A drive whose truth ends before its Frames do, as in many logs."""
    recording = fakes.circle(n_frames=40)
    truth = recording.known_truth
    names = ("stamps", "poses", "wheel_travel_m")
    cut = {name: getattr(truth, name)[:30] for name in names}
    return dataclasses.replace(recording, truth=dataclasses.replace(truth, **cut))


@pytest.fixture(scope="module")
def estimate():
    experiment = Experiment.compose(["estimator=odometry"]).with_recording(partly_true())
    ((online, _),) = run_robots(experiment, Team((partly_true(),)))
    return online


@pytest.mark.slow
@pytest.mark.parametrize("number", [np.nan, np.inf, -1e308, 1e200])
@pytest.mark.parametrize("first", [0, 20])
def test_any_estimate_is_drawn(tmp_path, estimate, number, first):
    means, covariances = estimate.means.copy(), estimate.covariances.copy()
    means[first:], covariances[first + 5 :] = number, number
    diverged = dataclasses.replace(estimate, means=means, covariances=covariances)
    recording = partly_true()
    for robots in (
        [(recording, diverged)],
        [(dataclasses.replace(recording, truth=None), diverged)],
        [(recording, diverged)] * 2,
    ):
        save_figure(run_figure(robots, "mine"), tmp_path / "run.png")


def test_a_picture_that_fails_is_a_warning_after_the_results(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    save(partly_true(), tmp_path / "robot3.npz")
    experiment = Experiment.compose(
        [f"recording={tmp_path / 'robot3.npz'}", "estimator=odometry", "name=real"]
    )
    out = tmp_path / "estimate.tum"
    (row,) = run_once(experiment, draw_run, out)
    picture = experiment.rows_folder / experiment.key / "run.png"
    assert picture.stat().st_size > 10_000  # its truth is NaN in the last second
    out.unlink()

    def draw(*_):
        assert len(read_runs(experiment.rows_folder)) == 1
        assert out.exists()
        raise ValueError("Axis limits cannot be\nNaN or Inf")

    capsys.readouterr()
    assert run_once(experiment, draw, out)[0]["ate_rmse_m"] == row["ate_rmse_m"]
    said = capsys.readouterr()
    assert said.err.splitlines() == [
        "estima: the picture is not drawn (ValueError: Axis limits cannot be NaN or Inf); "
        "the results are kept"
    ]
    assert not picture.exists()  # that of a run before would be taken for it
    assert "position RMSE" in said.out


def test_a_sensor_that_never_fired_is_drawn(tmp_path, estimate):
    recording = partly_true()
    name, log = "laser", recording.logs["laser"]
    none = dataclasses.replace(
        log, stamps=log.stamps[:0], values={k: v[:0] for k, v in log.values.items()}
    )
    save_figure(
        run_figure([(recording.with_log(name, none), estimate)], "mine"), tmp_path / "run.png"
    )
