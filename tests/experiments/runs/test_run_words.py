"""What a run and a sweep say in plain words."""

import contextlib
import dataclasses
import io
import multiprocessing
import re
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from experiments.cli.main import app
from experiments.runs import console
from experiments.runs.experiment import Experiment
from experiments.runs.run import _print, expected_duration_s, run_once, summarize
from experiments.viewing.run_figure import run_figure
from sim import compiled
from sim.formats.tum import write_tum
from sim.recording import save
from tests.experiments.cli.test_cli import QUICK, estima


def a_row(**changed):
    return {"ate_rmse_m": 0.3, "distance_m": 38.0, "nees_mean": 3.2, **changed}


def test_errors_are_said_with_their_share_of_the_way_and_consistency():
    assert summarize([a_row()]) == (
        "position RMSE 0.3 m, 0.79 % of 38 m; consistent (NEES 3.2 of 3)"
    )
    assert summarize([a_row(), a_row(ate_rmse_m=0.4)]).startswith("position RMSE 0.354 m")
    assert "too sure of itself (NEES 9 of 3)" in summarize([a_row(nees_mean=9.0)])
    some = summarize([a_row(nees_counted_share=0.074)])
    assert some.endswith("consistent (NEES 3.2 of 3, by 7.4 % of the poses)")
    assert "poses" not in summarize([a_row(nees_counted_share=1.0)])
    assert "too cautious" in summarize([a_row(nees_mean=0.5)])
    assert summarize([a_row(revised_ate_rmse_m=0.1)]).startswith(
        "revised path: position RMSE 0.1 m"
    )
    assert summarize([{"distance_m": 3.0}]) == ""
    assert summarize([{"ate_rmse_m": 0.3, "distance_m": 0.0}]) == "position RMSE 0.3 m"


@pytest.mark.parametrize(
    ("overrides", "within_s"),
    [
        (["route=linear_1"], 0.05),
        (["study=first_run"], 1.0),
        (["route.distance_m=8", "world=corridor"], 1.0),
    ],
)
def test_progress_knows_about_how_long_a_drive_is(overrides, within_s):
    alone = ["simulation.physics=kinematic", "sensors=encoder", "estimator=odometry"]
    experiment = Experiment.compose([*overrides, *alone])
    assert expected_duration_s(experiment) == pytest.approx(
        experiment.simulate().duration_s, abs=within_s
    )


def test_progress_does_not_know_how_long_other_drives_are():
    assert expected_duration_s(Experiment.compose(["route=square"])) is None
    assert expected_duration_s(Experiment.compose(["study=teams"])) > 10.0


def test_a_timetable_takes_as_long_as_its_trajectory(tmp_path):
    write_tum(tmp_path / "way.tum", np.array([5.0, 6.0, 9.0]), np.zeros((3, 3)))
    way = ["route=timetable", f"route.path={tmp_path / 'way.tum'}"]
    assert expected_duration_s(Experiment.compose(way)) == 4.0


def test_recording_says_how_much_there_is_to_simulate(tmp_path, monkeypatch):
    monkeypatch.setattr(console, "_QUIET_S", 0.0)
    arguments = ["record", "-o", str(tmp_path / "r.npz"), "route=linear_1"]
    done = CliRunner().invoke(app, [*arguments, "simulation.physics=kinematic"])
    assert done.exit_code == 0, done.output
    assert "seconds: 0 of 2.7 after" in done.stderr


def announced(_):
    """What a process says when it compiles."""
    with contextlib.redirect_stderr(io.StringIO()) as said:
        compiled._Announcer().on_start()
    return said.getvalue()


@pytest.mark.slow
def test_only_the_process_that_began_says_that_it_compiles():
    assert "compiling numerical code" in announced(0)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        assert list(pool.map(announced, [0])) == [""]


def test_the_picture_shows_the_path_and_few_ellipses_however_large():
    experiment = Experiment.compose(
        ["study=first_run", "simulation.physics=kinematic", "route.distance_m=6"]
    )
    recording = experiment.simulate()
    from experiments.runs.evaluate import run_over

    prior = experiment.prior(recording)
    estimate, _ = run_over(recording, experiment.estimator(), prior, np.random.default_rng(0))
    page = run_figure([(recording, estimate)], "ekf_slam")
    plan = page.axes[0]
    assert len(plan.patches) <= 8
    assert {"truth", "ekf_slam", "95 % ellipse"} <= set(plan.get_legend_handles_labels()[1])
    assert np.ptp(plan.get_xlim()) < 6.0 + 2 * 3.0 + 1.0


@pytest.mark.slow
def test_a_sweep_shows_its_small_table_and_what_comes_next(tmp_path):
    overrides = ["route=linear_1", "seed=0,1", "name=small", "hydra/launcher=basic"]
    done = estima("run", "-m", *QUICK, *overrides, ESTIMA_RESULTS=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "RMSE, m" in done.stdout
    assert "estima report small" in done.stdout
    command = (tmp_path / "runs" / "small" / "command.txt").read_text()
    assert command.startswith("estima run -m ")
    assert "seed=0,1" in command


def test_a_run_that_failed_says_why_and_no_metrics(capsys):
    bad = {"status": "failed", "status_code": "not_finite", "status_detail": "not finite at 1.00 s"}
    of = {"choice.estimator": "mine", "choice.world": "rooms", "seed": 3}
    _print([{**of, **bad, **a_row(ate_rmse_m=float("nan"))}], [])
    assert capsys.readouterr().out == "mine on rooms, seed 3: failed, not finite at 1.00 s\n"
    _print([{**of, **bad, **a_row()}, {**of, "status": "ok", **a_row()}], [])
    said = capsys.readouterr().out
    assert "seed 3: 1 of 2 repeats failed, not finite at 1.00 s\n  position RMSE 0.3 m," in said


def test_a_run_without_a_truth_says_why_there_is_no_error(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    drive = Experiment.compose(["route=linear_1", *QUICK]).simulate()
    save(dataclasses.replace(drive, truth=None), tmp_path / "blind.npz")
    save(drive, tmp_path / "seen.npz")
    for name, is_said in (("blind", True), ("seen", False)):
        own = [f"recording={tmp_path / name}.npz", "estimator=odometry", "name=blind"]
        run_once(Experiment.compose([*QUICK, *own, "picture=false"]), lambda *_: None)
        said = capsys.readouterr().out
        assert (
            "no error: the recording has no true path; `estima convert` adds one" in said
        ) is is_said


def test_the_next_command_has_each_key_once(tmp_path):
    done = estima("run", *QUICK, "route=linear_1", "seed=3", ESTIMA_RESULTS=str(tmp_path))
    assert "route=linear_1 -m 'seed=range(0,10)'\n" in done.stdout
    assert "seed=3" in done.stdout  # of the drive to view


def test_no_help_is_taken_for_markup():
    """Typer's leaves out words in brackets."""
    for command in typer.main.get_command(app).commands.values():
        for option in command.params:
            assert not re.search(r"\[[a-z#/@]", getattr(option, "help", None) or ""), option.name
