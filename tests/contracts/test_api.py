"""`import estima`: the recordings, runs and rows of the command line, and quick to import."""

import doctest
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import estima
from experiments.runs import store
from tests.experiments.cli.test_cli import QUICK as EXACT
from tests.experiments.cli.test_cli import estima as command

ROOT = Path(__file__).resolve().parents[2]
QUICK = (*EXACT, "route=linear_1")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Everything is written here."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ESTIMA_RESULTS", raising=False)
    return tmp_path


class Still:
    """Believe that the robot stays where it was."""

    def reset(self, prior, rng):
        self.prior = prior

    def step(self, frame):
        return estima.Belief(self.prior.mean, np.eye(3))


@pytest.mark.slow
def test_its_examples():
    failed, tried = doctest.testmod(estima)
    assert failed == 0
    assert tried > 12


def test_what_it_gives_prints_in_a_line():
    recording = estima.simulate(*QUICK, "seed=3")
    run = estima.run(recording, estimator="odometry")
    for thing in (recording, recording.truth, run, run.online, next(iter(recording.frames()))):
        assert len(repr(thing)) < 120
    assert re.fullmatch(
        r"Run\(odometry on a recording: position RMSE [\d.]+ mm, NEES .+ ms per step\)", repr(run)
    )
    assert "55 Frames; wheels alone; Truth(55 poses, a map); ok" in repr(recording)
    shown = run._repr_html_()
    assert "position RMSE" in shown
    assert "data:image/png;base64," in shown


@pytest.mark.slow
def test_the_five_lines_of_the_readme(folder):
    (lines,) = re.findall(r"```py\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    short = 'simulation.physics=kinematic", "route.distance_m=2'
    quick = lines.replace("simulation.rays=exact", short).replace("range(0,4)", "0,1")
    assert quick.count(short) == 2
    names = {}
    exec(compile(quick, "README.md", "exec"), names)
    assert len([line for line in lines.splitlines() if line and not line.startswith("import")]) == 5
    for name in ("simulate", "load", "run", "score", "sweep", "plot"):
        assert f"estima.{name}" in lines
    assert len(names["table"]) == 4
    assert {path.name for path in folder.iterdir()} == {"errors.png", "results"}


def test_it_imports_nothing_heavy():
    code = (
        "import sys, time; begun = time.process_time(); import estima; "
        "print(time.process_time() - begun, 'numpy' in sys.modules); "
        "estima.Recording, estima.nothing"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    seconds, numpy = done.stdout.split()
    assert float(seconds) < 0.3
    assert numpy == "False"
    assert "has no attribute 'nothing'" in done.stderr


def test_every_name_is_there_and_documented():
    for name in estima.__all__:
        assert getattr(estima, name).__doc__


def test_its_version_is_that_of_the_command_line():
    assert command("--version").stdout.startswith(f"estima {estima.__version__}, code ")


def test_what_is_no_estimate_or_no_sweep_is_said():
    with pytest.raises(estima.InputError, match=r"takes an Estimate, .*, got NoneType"):
        estima.score(estima.simulate(*QUICK), None)
    table = pd.DataFrame({"seed": [1, 2], "ate_rmse_m": [0.1, 0.2]})
    for column in ("status", "recording_checksum"):
        with pytest.raises(estima.InputError, match=f"no column {column}; .* estima.sweep"):
            estima.plot(table, x="seed")
        table[column] = "ok"


def test_a_simulated_recording_is_that_of_the_command_line(folder):
    assert command("record", "-o", "r.npz", *QUICK, "seed=4", cwd=folder).returncode == 0
    loaded, made = estima.load("r.npz"), estima.simulate(*QUICK, "seed=4")
    assert loaded.checksum == made.checksum == estima.load(Path("r.npz")).checksum


def test_a_run_has_the_numbers_of_the_command_line(folder):
    done = command("run", *QUICK, "seed=4", "name=cli", "picture=false", cwd=folder)
    assert done.returncode == 0, done.stderr
    row = store.read_runs(folder / "results" / "runs" / "cli").iloc[0]
    run = estima.run(*QUICK, "seed=4", "name=cli", "picture=false")
    again = estima.run(estima.simulate(*QUICK, "seed=4"), "seed=4")
    for found in (run, again):
        assert found.row["ate_rmse_m"] == row["ate_rmse_m"]
        assert found.row["recording_checksum"] == row["recording_checksum"]
        assert estima.score(found.recording, found.online)["ate_rmse_m"] == row["ate_rmse_m"]
    assert run.row["run_key"] == row["run_key"]
    assert again.row["run_key"] != row["run_key"], "it is known by the recording's checksum"
    made_in = {"choice.world", "world.n_objects", "world_seed", "robot.kr", "simulation.rays"}
    assert made_in <= run.row.keys()
    assert not made_in & again.row.keys(), "the recording says what it was made in"
    mapped = "prior.map={_target_:tests.contracts.test_api.no_map}"  # it may read all settings
    assert "robot.kr" in estima.run(again.recording, mapped).row


def no_map(config):
    return None


def test_a_revised_estimate_and_its_picture(folder):
    stereo = ("sensors=stereo_pixel", "world=rooms", "robot=gil2008")
    run = estima.run(*QUICK, *stereo, estimator="smoother")
    assert run.revised is not None
    assert run.revised.kind == "revised"
    assert run.row["revised_ate_rmse_m"] == estima.score(run.recording, run.revised)["ate_rmse_m"]
    run.plot(folder / "run.png")
    assert (folder / "run.png").stat().st_size > 1000
    assert estima.run(run.recording, "robot=gil2008").revised is None


def test_an_estimator_of_ones_own():
    recording = estima.simulate(*QUICK)
    run = estima.run(recording, estimator=Still())
    assert run.row["choice.estimator"] == "Still"
    assert run.row["estimator.class"] == f"{__name__}.Still"
    assert "estimator.kr" not in run.row
    np.testing.assert_array_equal(
        run.online.means, np.tile(run.online.means[0], (len(run.online.means), 1))
    )
    assert run.row["ate_rmse_m"] > estima.run(recording).row["ate_rmse_m"]
    assert run.row["run_key"] != estima.run(recording).row["run_key"]
    with pytest.raises(estima.InputError, match="int has no method reset"):
        estima.run(recording, estimator=3)


def test_what_it_needs_is_said_before_anything_is_simulated(folder):
    class Scans(Still):
        needs = ("laser",)

    for estimator in ("icp_odometry", Scans()):
        with pytest.raises(estima.InputError, match=r"needs a sensor laser.*sensors=.*lms291"):
            estima.run(*QUICK, estimator=estimator)
    assert not (folder / "results").exists()
    with pytest.raises(estima.InputError, match=r"use estima\.sweep for repeats=3"):
        estima.run(*QUICK, "repeats=3")


def test_what_an_estimator_raises_is_raised():
    class Broken(Still):
        def step(self, frame):
            raise ZeroDivisionError("by the time step")

    with pytest.raises(ZeroDivisionError, match="by the time step"):
        estima.run(estima.simulate(*QUICK), estimator=Broken())


def test_belief_and_truth_that_differ_are_said(capsys):
    recording = estima.simulate(*QUICK, "robot.kr=1e-4")
    estima.run(recording)
    assert "made with robot.kr=0.0001; 1e-05 is believed" in capsys.readouterr().err
    estima.run(recording, "robot.kr=1e-4")
    estima.run(recording, estimator=Still())
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_a_sweep_resumes_and_keeps_its_rows_apart(folder, capsys):
    swept = (*QUICK, "seed=range(0,2)", "hydra/launcher=basic")
    arguments = list(sys.argv)
    table = estima.sweep(*swept)
    assert sys.argv == arguments
    assert table["seed"].tolist() == [0, 1]
    assert "0 of them done before" in capsys.readouterr().err
    assert estima.sweep(*swept).equals(table)
    assert "2 of them done before" in capsys.readouterr().err
    assert estima.sweep(*swept, name="other")["seed"].tolist() == [0, 1]
    assert estima.sweep(*QUICK, "seed=3,4,5", "hydra/launcher=basic", "name=third").shape[0] == 3
    folders = {path.name for path in (folder / "results" / "runs").iterdir()}
    assert {"other", "third"} < folders
    assert len(folders) == 3
    page = estima.plot(table, x="seed", path="seeds.svg")
    assert "rmse" in page.axes[0].get_ylabel().lower()
    assert (folder / "seeds.svg").exists()


@pytest.mark.slow
def test_a_sweep_follows_the_current_folder(folder, monkeypatch):
    """Workers that joblib keeps from an earlier sweep do not write to its folder."""
    for name in ("a", "b"):
        (folder / name).mkdir()
        monkeypatch.chdir(folder / name)
        assert len(estima.sweep(*QUICK, "seed=0,1")) == 2
        assert len(list((folder / name / "results" / "runs").iterdir())) == 1


def test_a_failed_run_of_a_sweep_is_a_warning_and_a_row():
    wall = ("route=open_loop", "route.segments=[[0.5,0,20]]")
    with pytest.warns(UserWarning, match="1 of 1 runs"):
        table = estima.sweep(*EXACT, *wall, "hydra/launcher=basic", "seed=1")
    assert table["status"].tolist() == ["failed"]
    assert "collision" in table["status_detail"][0]
    with pytest.raises(estima.InputError):
        estima.plot(table, x="seed")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: estima.simulate("world=ofice"), "no world named ofice; did you mean office"),
        (lambda: estima.run("nope.npz"), "a file. recording=nope.npz takes it"),
        (lambda: estima.run("seed"), "seed: write KEY=VALUE"),
        (lambda: estima.run(estimator="ekf"), "no estimator named ekf; did you mean"),
        (lambda: estima.sweep("estimator=odometri"), "no estimator named odometri"),
        (lambda: estima.sweep(["seed=0,1"]), "give those of a list one by one"),
    ],
)
def test_wrong_input_is_the_documented_error(call, said):
    with pytest.raises(estima.InputError, match=said) as caught:
        call()
    assert "\n" not in str(caught.value)
