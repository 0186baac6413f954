"""The command line as a user meets it: what it prints, what it leaves, and how it refuses."""

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
import pytest

from estimators.base import Belief
from experiments.bench import SUITES
from experiments.cli import main as cli
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.store import read_runs
from experiments.sweeps.collect import where
from sim.errors import InputError
from sim.team import Team
from tests.fixtures.fakes import circle

ROOT = Path(__file__).resolve().parents[3]
QUICK = ["simulation.physics=kinematic", "simulation.rays=exact", "picture=false"]


def estima(*arguments, cwd=ROOT, **environment):
    return subprocess.run(
        [sys.executable, "-m", "experiments.cli", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        timeout=120,
    )


def called(*arguments):
    """As `estima`, in this process: for what does not depend on having one of its own."""
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["estima", *arguments]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as ended,
    ):
        cli.main()
    return subprocess.CompletedProcess(arguments, ended.value.code, out.getvalue(), err.getvalue())


def refused(done, *words):
    """One line on standard error that says all the words, and code 2."""
    assert done.returncode == 2, done.stderr
    lines = [line for line in done.stderr.splitlines() if not line.startswith("compiling")]
    assert len(lines) == 1, done.stderr
    for word in words:
        assert word in lines[0]
    assert "Traceback" not in done.stderr


def test_an_unknown_group_says_what_lists_all():
    refused(called("options", "nosuch"), "no group or option nosuch", "`estima options` lists all")


def test_help_names_every_benchmark():
    text = estima("bench", "--help").stdout
    assert all(name in text for name in SUITES)


def test_help_names_every_command():
    done = estima("--help")
    assert done.returncode == 0
    for command in ("run", "record", "info", "view", "calibrate", "conform", "bench", "reproduce"):
        assert command in done.stdout
    assert "estimator=odometry world=office seed=3" in estima("run", "--help").stdout


def test_options_shows_the_keys_of_one_option():
    shown = called("options", "ekf_slam").stdout
    assert "estimators.landmarks.ekf_slam.EkfSlam" in shown
    assert "gate_probability: null" in shown
    assert called("options", "estimator", "ekf_slam").stdout == shown
    assert "override /estimator: ekf_slam" in called("options", "first_run").stdout
    listed = called("options", "estimator").stdout.splitlines()
    assert all(len(line.split()) > 3 for line in listed), "a name and a few words on each"
    refused(called("options", "nosuch"), "no group or option nosuch")
    refused(called("options", "estimator", "nosuch"), "no estimator named nosuch", "ekf_slam")


def test_options_describes_a_sensor_by_its_class_or_in_its_preset():
    of_class = called("options", "laser").stdout
    assert of_class == called("options", "sensors", "Laser").stdout
    assert "rate_hz: 10.0" in of_class
    of_preset = called("options", "lms291.laser").stdout
    assert "rate_hz: 75.0" in of_preset
    assert "Encoder" not in of_preset
    refused(called("options", "lms291.stereo"), "no sensor stereo in lms291", "encoder, laser")


def test_options_describes_an_option_of_ones_own_folder(tmp_path):
    for group, text in (
        ("estimator", "_target_: estimators.odometry.Odometry\nkr: 7e-5\n"),
        ("study", "seed: 7\n"),
    ):
        (tmp_path / group).mkdir()
        (tmp_path / group / f"my_{group}.yaml").write_text(text)
    place = ("--config-dir", str(tmp_path))
    assert "kr: 7e-05" in called("options", "my_estimator", *place).stdout
    assert called("options", "my_study", *place).stdout == "seed: 7\n"
    refused(called("options", "my_estimator"), "no group or option my_estimator")


def test_a_run_prints_its_errors_and_leaves_a_row(tmp_path):
    place = {"ESTIMA_RESULTS": str(tmp_path / "mine")}
    done = estima("run", *QUICK[:2], "seed=12", "name=test_cli", cwd=tmp_path, **place)
    assert done.returncode == 0, done.stderr
    assert "position RMSE" in done.stdout
    rows = tmp_path / "mine" / "runs" / "test_cli"
    frame = read_runs(rows)
    assert [path.parent.parent for path in rows.rglob("run.png")] == [rows]
    assert frame["status"].tolist() == ["ok"]
    assert frame["robot.kr"].tolist() == [1e-5]
    assert np.isfinite(frame["ate_rmse_m"]).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["robot.krr=1"], ["krr"]),
        (["robto.kr=1"], ["robto"]),
        (["estimator=odometri"], ["odometri"]),
        (["robot.kr=-1"], ["robot.kr", "zero or a positive"]),
        (["robot.kl=nan"], ["robot.kl holds NaN; give a number"]),
        (["world=campus", "world.trees_per_block=nan"], ["world.trees_per_block holds NaN"]),
        (["route=open_loop", "route.segments=[[0.5,nan,2.0]]"], ["route.segments holds NaN"]),
        (["estimator.kr=-1"], ["estimator.kr"]),
        (["sensors=lms291", "sensors.laser.n_beams=0"], ["n_beams", "from 1 to 1000000"]),
        (["sensors=lms291", "sensors.laser.rate_hz=7"], ["rate_hz", "divide"]),
        (["+estimator.gain=2"], ["estimator.gain", "known: estimator.kr, estimator.kl"]),
        (["+foo=1"], ["unknown key foo", "known: world, robot"]),
        (["++foo.bar=1"], ["unknown key foo", "known: world, robot"]),
        (["prior.track_m=wide"], ["prior.track_m", "'wide'"]),
        (["simulation.rays=psychic"], ["simulation.rays"]),
        (["simulation.rays=bullet"], ["rays=exact"]),
        (["prior.start=nowhere"], ["prior.start", "tracking"]),
        (["prior.start=global", "route=linear_1"], ["start pose"]),
        (["estimator=icp_odometry"], ["laser"]),
        (["route.waypoints=[[0.05,0.05],[2,2]]"], ["overlaps a wall"]),
        (["recording=missing.npz"], ["missing.npz"]),
        (["world=from_file", "world.path=none.yaml"], ["none.yaml"]),
        (["seed=-1"], ["seed"]),
        (["seed=one"], ["seed"]),
        (["repeats=0"], ["repeats"]),
        (["repeats=1.5"], ["repeats", "whole number"]),
        (["keep=3"], ["keep", "list"]),
        (["simulation=null"], ["simulation", "must hold keys"]),
        (["name=../../x"], ["name", "one word"]),
        (["world.n_objects=-3"], ["objects", "zero or more"]),
        (["route.speed_mps="], ["route.speed_mps must be a positive number, got ''"]),
        (["study=leaderboard"], ["add -m: estima run -m", " study=leaderboard"]),
        (["sweeps=[{seed:[1,2]}]"], ["add -m: estima run -m", "sweeps="]),
        (["-o", "/proc/none/est.tum"], ["/proc/none/est.tum: cannot write"]),
        (["robot.kq=1"], ["unknown key robot.kq", "robot.kr", "robot.track_m"]),
        (
            ["estimator=nosuch"],
            ["no estimator named nosuch", "fastslam, ", "estima options estimator lists all"],
        ),
        (["robot=null"], ["robot=null", "estima options robot"]),
        (["~world"], ["world is missing"]),
        (["~robot.kr"], ["robot.kr", "cannot be left out"]),
        (["sensors=lms291", "sensors.laser=foo"], ["sensors.laser", "mapping"]),
        (["recording={_target_:os.getcwd}"], ["os.getcwd must return a Recording", "str"]),
    ],
)
def test_bad_input_is_one_line_and_code_2(arguments, words):
    given = [a for a in QUICK if a.split("=")[0] not in {b.split("=")[0] for b in arguments}]
    refused(called("run", *given, *arguments), *words)


def test_errors_of_a_studys_file_name_it_and_not_its_copy(tmp_path):
    path = tmp_path / "twice.yaml"
    path.write_text("# @package _global_\nseed: 1\nseed: 2\n")
    refused(called("run", f"study={path}"), f"{path}:3: the key seed is there twice")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("=3", "=3: no key"),
        ("world=3", "world=3.*estima options world"),
        ("estimator=3", "estimator=3.*estima options estimator"),
        ("route=null", "route=null.*estima options route"),
        ("estimator=null", "estimator=null.*estima options estimator"),
        ("sensors=[]", "sensors must name one"),
        ("estimator=[odometry,ekf_icp]", "for one run each, -m estimator=odometry,"),
        ("seed=1,2", "seed=1,2: several values; add -m"),
        ("~seed", "world_seed.*seed"),
        ("~prior.map", "prior.map is missing"),
        ("+sensors.laser=3", "sensors.laser must be a mapping"),
        ("sensors.encoder=foo", "sensors.encoder must be a mapping"),
        ("route.waypoints=foo", "route.waypoints.*foo"),
        ("route.waypoints=[[0,0],[1]]", r"route.waypoints.*\[1\]"),
        ("route.waypoints=[[0,0],[a,b]]", "route.waypoints.*'a'"),
        ("recording=3", "recording must be a path.*3"),
        ("recording=", "recording must be a path.*got nothing"),
        ("prior.start=foo", "prior.start must be"),
        ("prior.map=nosuch", "prior.map must be"),
        ("+prior.foo=1", "unknown key prior.foo; known: prior.start, prior.sigma_position_m"),
        (
            "+simulation.foo=1",
            "unknown key simulation.foo; known: simulation.physics, sim",
        ),
        ("prior.sigma_heading_rad=-1", "prior.sigma_heading_rad"),
        ("prior.sigma_position_m=true", "prior.sigma_position_m must be .*True"),
        ("prior.track_m=wide", "prior.track_m must be a positive number, or null, got 'wide'"),
        ("prior.wheel_radius_m=0", "prior.wheel_radius_m must be a positive number"),
        ("prior.map={_target_:nosuch.x}", "prior.map._target_=nosuch.x"),
        ("prior.map={_target_:os.getcwd,x:1}", "unknown key prior.map.x"),
        ("estimator.kr=-1", "estimator.kr must be"),
        ("+world.rooms=3", "unknown key world.rooms"),
        ("world_seed=abc", "^world_seed must be"),
    ],
)
def test_a_bad_configuration_names_its_key(override, words):
    with pytest.raises(InputError, match=words):
        Experiment.compose(["simulation.physics=kinematic", override]).check()


@pytest.mark.parametrize("argument", ["robot.kq=1,2", "robot.kq=1"])
def test_an_unknown_key_of_a_sweep_names_the_known_ones(argument):
    refused(called("run", "-m", *QUICK, argument), "unknown key robot.kq", "robot.kr")


def test_a_sweep_with_a_bad_value_runs_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    refused(called("run", "-m", *QUICK, "estimator.kr=1e-5,-1"), "estimator.kr", "-1")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("belief", "words"),
    [
        (None, "got NoneType"),
        (Belief(np.zeros(2), np.eye(3)), r"got shapes \(2,\) and \(3, 3\)"),
        (Belief(np.zeros(3), 0.0), r"got shapes \(3,\) and \(\)"),
        (Belief([0.0, [1.0]], np.eye(3)), "inhomogeneous"),
    ],
)
def test_a_step_that_returns_no_belief_names_step_and_the_shapes(belief, words):
    class Mine:
        def reset(self, prior, rng):
            pass

        def step(self, frame):
            return belief

    experiment = Experiment.compose(["simulation.physics=kinematic"]).with_estimator_object(Mine())
    with pytest.raises(InputError, match=rf"Mine.step .*\(3,\).*\(3, 3\).*{words}"):
        evaluate(experiment, lambda: Team((circle(n_frames=3),)))


def test_where_lists_the_columns():
    table = pd.DataFrame({"seed": [0, 1], "robot.kr": [1e-5, 1e-4]})
    with pytest.raises(InputError, match=r"condition foo: .*columns: seed, robot\.kr"):
        where(table, ["foo"])


@pytest.mark.parametrize(
    "arguments", [["--results", "", "cache"], ["cache", "--results="], ["cache", "--results", ""]]
)
def test_results_need_a_folder(arguments):
    refused(called(*arguments), "--results must name a folder")


def test_a_malformed_option_names_its_file(tmp_path):
    (tmp_path / "estimator").mkdir()
    (tmp_path / "estimator" / "c.yaml").write_text("kr: [1\n  a: : b\n")
    refused(
        estima("run", "--config-dir", str(tmp_path), "estimator=c", *QUICK),
        "c.yaml:2",
        "not valid YAML",
    )


def test_damaged_recordings_are_refused(tmp_path):
    path = tmp_path / "r.npz"
    assert called("record", "-o", str(path), *QUICK, "route=linear_1").returncode == 0
    assert "frames" in called("info", str(path)).stdout
    believed = called("run", *QUICK, f"recording={path}", "name=test_cli")
    assert "robot.kr" not in believed.stderr
    assert f"odometry on {path}" in believed.stdout
    other = ["robot=robocom", "estimator.kr=1e-5", "name=test_cli"]
    believed = called("run", *QUICK, f"recording={path}", *other)
    assert "was made with robot.kr=1e-05" in believed.stderr
    path.write_bytes(path.read_bytes()[:-100])
    refused(called("info", str(path)), "r.npz", "record again")
    refused(called("run", f"recording={path}"), "r.npz", "record again")
    log = tmp_path / "a.log"
    log.write_text("ODOM 0 0 0 0 0 0 0 nohost 0\n")
    refused(called("run", f"recording={log}"), "a.log", "FLASER or ROBOTLASER1")
    refused(called("record", "-o", "."), ".npz")
    refused(called("convert", str(path), "-o", "."), "name the file")
    before = path.read_bytes()
    refused(called("convert", str(path), "-o", str(path)), "the log itself", "another name")
    assert path.read_bytes() == before


def test_calibration_from_recordings(tmp_path):
    paths = []
    for seed in range(3):
        path = tmp_path / f"{seed}.npz"
        overrides = ["route=linear_2", f"seed={seed}", "robot.kr=1e-4", "robot.kl=5e-5"]
        assert called("record", "-o", str(path), *QUICK, *overrides, "world=empty").returncode == 0
        paths.append(str(path))
    done = called("calibrate", *paths, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["kr"]["low"] < 1e-4 < found["kr"]["high"]
    assert found["kl"]["low"] < 5e-5 < found["kl"]["high"]
    refused(called("calibrate", *paths, "--method", "guess"), "--method")
    refused(called("calibrate", paths[0], paths[1], paths[0]), "same recording")


@pytest.mark.slow
def test_calibration_from_a_sheet():
    sheet = str(ROOT / "docs" / "examples" / "end_poses.csv")
    done = estima("calibrate", "--sheet", sheet, "robot=puzzlebot_short_turns", "--joint", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["method"] == "sampled"
    assert found["track_m"]["low"] < 0.19 < found["track_m"]["high"]
    refused(called("calibrate", "--sheet", sheet, "world=room"), "world=room", "robot")
    refused(called("calibrate", "--sheet", sheet, "--method", "wheel-truth"), "--method")


def test_view_draws_a_world(tmp_path):
    out = tmp_path / "w.png"
    done = called("view", "--world", "world=corridor", "-o", str(out))
    assert done.returncode == 0, done.stderr
    assert out.read_bytes()[:4] == b"\x89PNG"


def test_conform_runs_by_name():
    done = called("conform", "estimators.odometry:Odometry", "kr=1e-5", "kl=1e-5")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("pass") >= 8


@pytest.mark.slow
def test_a_users_own_estimator(tmp_path):
    """One Python file and one YAML, anywhere on disk: the example of the tutorial."""
    text = (ROOT / "docs" / "tutorial.md").read_text()
    code = text.split("```python\n")[1].split("```")[0]
    options = text.split("```yaml\n")[1].split("```")[0]
    (tmp_path / "mine.py").write_text(code)
    (tmp_path / "mine" / "estimator").mkdir(parents=True)
    (tmp_path / "mine" / "estimator" / "mine.yaml").write_text(options)
    arguments = ["--config-dir", "mine", "estimator=mine", *QUICK, "name=test_cli"]
    done = estima("run", *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = estima("run", "-m", *arguments, "seed=1,2", cwd=tmp_path)  # its processes find it too
    assert done.returncode == 0, done.stderr
    done = estima("conform", "mine:Mine", "variance_per_step=1e-5", cwd=tmp_path)
    assert done.returncode == 0, done.stdout


def test_a_collision_is_told_and_fails(tmp_path):
    overrides = ["route=open_loop", "route.segments=[[0.5,0,20]]", "name=test_cli"]
    done = estima("run", *QUICK, *overrides, cwd=tmp_path)
    assert done.returncode == 1
    assert "collision at" in done.stderr


def test_a_full_disk_is_one_line(tmp_path):
    out = tmp_path / "file"
    out.write_text("")
    done = estima("record", "-o", str(out / "r.npz"), *QUICK, "route=linear_1")
    refused(done, "cannot write")
