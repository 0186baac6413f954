"""Runs as animations: what is drawn, the files, and the window where there is a display."""

import dataclasses
import os
import shutil
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from estimators.base import Estimate
from experiments.cli.main import app
from experiments.trajectories.odometry import write_odometry_csv
from experiments.viewing import live, movie
from experiments.viewing.animation import ellipse_outlines, pictures, sensor_points
from experiments.viewing.estimates import with_all_estimates, with_estimates
from experiments.viewing.playback import Playback, RobotTrack
from sim import se2
from sim.errors import InputError
from sim.recording import save
from sim.team import Team
from tests.fixtures import browser
from tests.fixtures.fakes import HALF_ROOM_M, circle

ROOT = Path(__file__).resolve().parents[3]


def silent(_):
    pass


@pytest.fixture(scope="module")
def recording():
    return circle(n_frames=30, n_beams=61, sigma_range_m=0.0)


@pytest.fixture(scope="module")
def run(recording):
    shown = Playback.of(Team((recording,)), 6)
    return with_estimates(shown, "fastslam", ["estimator.n_particles=20"], silent)


def played(recording, rows, estimate=None):
    """A robot at rows of its Frames."""
    return Playback((RobotTrack(recording, estimate),), recording.frame_stamps[rows])


def believed(recording, poses):
    covariances = np.tile(0.01 * np.eye(3), (len(poses), 1, 1))
    return Estimate(recording.frame_stamps.copy(), poses, covariances)


def test_shown_frames_are_evenly_apart_and_hold_both_ends(recording):
    rows = Playback.of(Team((recording,)), 6).rows
    assert rows[0] == 0
    assert rows[-1] == 29
    assert set(np.diff(rows)) <= {5, 6}
    assert len(Playback.of(Team((recording,)), 1000).stamps) == 30


def test_the_scan_lies_on_the_walls_of_the_truth(recording):
    run = RobotTrack(recording)
    for stamp in recording.frame_stamps[[0, 17]]:
        points = sensor_points(run, "laser", stamp)
        assert len(points) == 61
        assert np.allclose(np.abs(points).max(axis=1), HALF_ROOM_M, atol=1e-5)


def test_with_an_estimate_the_scan_goes_where_it_is_believed_to_be(recording):
    shift = np.array([0.3, -0.2, 0.5])
    moved = se2.compose(shift, recording.truth_at(recording.frame_stamps))
    run = RobotTrack(recording, believed(recording, moved))
    plain = sensor_points(RobotTrack(recording), "laser", 1.0)
    assert np.allclose(sensor_points(run, "laser", 1.0), se2.transform(shift, plain), atol=1e-9)


def test_landmarks_seen_are_the_true_ones(recording):
    run = RobotTrack(recording)
    seen = sensor_points(run, "stereo", recording.frame_stamps[4])
    true = recording.truth.world.landmarks[:, :2]
    nearest = np.hypot(*(seen[:, None] - true).transpose(2, 0, 1)).min(axis=1)
    assert len(seen) > 3
    assert np.median(nearest) < 0.4  # a stereo camera errs by some decimetres
    assert len(sensor_points(run, "stereo", -1.0)) == 0


def test_outlines_lie_on_the_ellipse():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(3, 2, 2))
    covariances, means = roots @ roots.transpose(0, 2, 1), rng.normal(size=(3, 2))
    outlines = ellipse_outlines(means, covariances).reshape(3, -1, 2)
    assert np.isnan(outlines[:, -1]).all()  # gaps, so that one line draws them all
    for outline, mean, covariance in zip(outlines, means, covariances, strict=True):
        error = outline[:-1] - mean
        squared = np.sum(error * np.linalg.solve(covariance, error.T).T, axis=1)
        assert np.allclose(squared, 5.991, atol=1e-3)


def test_extras_are_kept_where_they_are_shown_only(run):
    for name in ("particles", "landmarks", "landmark_covariances"):
        kept = [
            i for i, value in enumerate(run.robots[0].estimate.extras[name]) if value is not None
        ]
        assert kept == run.rows.tolist()


def test_pictures_show_what_moves(run):
    images = list(pictures(run))
    assert len(images) == len(run.rows)
    assert len({image.shape for image in images}) == 1
    assert all(side % 2 == 0 for side in images[0].shape[:2])  # which video needs
    changed = [(first != second).any() for first, second in pairwise(images)]
    assert all(changed)
    bare = next(iter(pictures(played(run.robots[0].recording, run.rows[-1:]))))
    assert (bare == [0, 114, 178]).all(axis=2).sum() == 0  # no blue without an estimate
    assert (images[-1] == [0, 114, 178]).all(axis=2).sum() > 20


def test_a_log_without_truth_needs_an_estimate(recording):
    blind = dataclasses.replace(recording, truth=None)
    with pytest.raises(InputError, match="give an estimate"):
        next(pictures(played(blind, [0, 5])))
    poses = recording.truth_at(recording.frame_stamps)
    run = played(blind, [0, 5], believed(blind, poses))
    assert len(list(pictures(run))) == 2


def test_an_estimate_that_runs_away_or_is_not_finite_is_still_drawn(recording):
    poses = recording.truth_at(recording.frame_stamps)
    poses[10:, 0] = 1e6
    poses[20:] = np.nan
    run = played(recording, [0, 15, 25], believed(recording, poses))
    assert len(list(pictures(run))) == 3


def test_estimates_of_something_else_are_refused(recording, tmp_path):
    path = tmp_path / "estimate.csv"
    sound = believed(recording, recording.truth_at(recording.frame_stamps))
    write_odometry_csv(sound, path)
    head, first, *rest = path.read_text().splitlines()
    x = head.split(",").index("pose.position.x")
    wild = ",".join("inf" if i == x else cell for i, cell in enumerate(first.split(",")))
    write_odometry_csv(dataclasses.replace(sound, stamps=sound.stamps + 1e6), path)
    later = path.read_text()
    for text, words in (
        (later, "no stamp of it"),
        ("\n".join([head, first, wild, *rest]), r"csv:3: .* not finite"),
        (head, "holds no record"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            with_estimates(Playback.of(Team((recording,)), 3), str(path), [], silent)


def test_a_robot_given_by_its_number(recording):
    """As the logs of several robots do."""
    numbered = dataclasses.replace(recording, config={"robot": 3})
    assert (
        with_estimates(Playback.of(Team((numbered,)), 3), "odometry", [], silent).name == "odometry"
    )


def test_gif(run, tmp_path):
    shares = []
    movie.save(run, tmp_path / "run.gif", shares.append)
    assert shares[-1] == 1.0
    with Image.open(tmp_path / "run.gif") as image:
        assert image.n_frames == len(run.rows)
        whole_ms = image.info["duration"] * image.n_frames
        assert whole_ms == pytest.approx(1e3 * np.ptp(run.stamps), rel=0.05)  # real time
    half = dataclasses.replace(run, seconds=np.ptp(run.stamps) / 2.0)
    assert half.fps == pytest.approx(2.0 * run.fps)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="no ffmpeg on this machine")
def test_mp4(run, tmp_path):
    path = tmp_path / "run.mp4"
    movie.save(run, path, silent)
    played = subprocess.run(
        ["ffmpeg", "-i", str(path), "-f", "null", "-"], capture_output=True, text=True
    )
    assert played.returncode == 0
    assert f"frame={len(run.rows):5d}" in played.stderr


def test_without_ffmpeg_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(InputError, match=r"ffmpeg.*\.gif"):
        movie.check_output(Path("run.mp4"))


@pytest.mark.skipif(browser.find() is None, reason="no Chromium on this machine")
def test_html_plays_in_a_browser(run, tmp_path):
    movie.save(run, tmp_path / "run.html", silent, "<mcl>: run.npz")
    assert "://" not in (tmp_path / "run.html").read_text()
    with browser.page() as tab:
        tab.open((tmp_path / "run.html").as_uri())
        assert tab.js("document.querySelectorAll('#moving path').length") > 4
        assert tab.js("document.title") == "<mcl>: run.npz"
        assert tab.js("document.querySelector('h1').textContent") == "<mcl>: run.npz"
        assert "real time" in tab.js("document.querySelector('form').textContent")
        last = len(run.rows) - 1
        for _ in range(400):
            if tab.js("+document.querySelector('input').value") == last:
                break
            time.sleep(0.05)
        assert tab.js("+document.querySelector('input').value") == last  # it has played
        assert tab.js("document.querySelector('#time').textContent").startswith(
            "2.9 of 2.9 s, error"
        )
        tab.js("document.querySelector('button').focus()")
        tab.press("Enter", text="\r")  # again from the start, by keyboard
        assert tab.js("document.querySelector('button').textContent") == "Pause"
        assert tab.complaints() == []


@pytest.mark.skipif(browser.find() is None, reason="no Chromium on this machine")
def test_several_estimates_lie_over_one_another(recording, tmp_path):
    truth = recording.truth_at(recording.frame_stamps)
    off = believed(recording, truth + np.array([0.5, 0.0, 0.0]))
    write_odometry_csv(off, tmp_path / "off.csv")
    sources = [str(tmp_path / "off.csv"), "odometry"]
    steps = []
    shown = Playback.of(Team((recording,)), 4)
    shown = with_all_estimates(shown, sources, [], steps.append)
    assert steps[-1] == 2 * len(recording.frame_stamps)
    assert [name for name, _ in shown.robots[0].others] == ["odometry"]
    drawn = list(pictures(shown))
    assert (drawn[-1] != list(pictures(without_others(shown)))[-1]).any()
    movie.save(shown, tmp_path / "run.html", silent, "two")
    with browser.page() as tab:
        tab.open((tmp_path / "run.html").as_uri())
        tab.js("stop(); show(last)")
        assert "off.csv 0.500 m, odometry 0.0" in tab.js("$('time').textContent")
        n = "document.querySelectorAll('#chart path').length"
        assert tab.js(n) == 2
        label = "[...document.querySelectorAll('#legend label')]"
        tab.js(f"{label}.find((l) => l.textContent === 'off.csv').click()")
        assert tab.js(n) == 1
        assert "off.csv" not in tab.js("$('time').textContent")
        assert tab.complaints() == []


def test_estimates_of_one_name_are_all_kept(recording):
    off = believed(recording, recording.truth_at(recording.frame_stamps))
    others = (("estimate.csv", off), ("estimate.csv", off))
    assert len(RobotTrack(recording, off, others).estimates) == 3
    assert len(RobotTrack(recording, None, others).estimates) == 2


def without_others(shown):
    own = dataclasses.replace(shown.robots[0], others=())
    return dataclasses.replace(shown, robots=(own,))


@pytest.mark.parametrize(
    ("drive_s", "seconds", "words"),
    [(62.0, 62.0, "real time"), (62.0, 20.0, "3.1 times real time"), (9.0, 20.0, "0.45 times")],
)
def test_how_fast_it_plays_is_said(drive_s, seconds, words):
    run = Playback((), np.linspace(0.0, drive_s, 200), seconds=seconds)
    assert run.speed.startswith(words)


def test_from_the_command_line(recording, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    log, out = str(tmp_path / "run.npz"), str(tmp_path / "run.gif")
    save(recording, Path(log))

    def invoke(*arguments):
        return CliRunner().invoke(app, ["view", *arguments])

    write_odometry_csv(
        believed(recording, recording.truth_at(recording.frame_stamps)),
        tmp_path / "kept" / "estimate.csv",
    )
    done = invoke(log, "-e", str(tmp_path / "kept"), "-o", out, "--seconds", "0.4")
    assert done.exit_code == 0, done.exception
    assert "4 pictures" in done.stdout
    for arguments, words in (
        ([log], "no display"),
        ([log, "-o", "run.avi"], ".mp4, .gif, .html, .rrd"),
        ([log, "-e", "odometry", "-e", "icp_odometry"], "several estimates are drawn in files"),
        ([log, "estimator.kr=1", "-o", out], "--estimate"),
        ([log, "-e", str(tmp_path / "kept"), "estimator.kr=1", "-o", out], "overrides"),
        ([log, "-o", out, "--seconds", "-1"], "seconds must"),
        (["-o", out], "name a recording"),
        ([str(tmp_path / "none.npz"), "-o", out], "none.npz"),
    ):
        done = invoke(*arguments)
        assert isinstance(done.exception, InputError), arguments
        assert words in str(done.exception)


def test_a_display_that_is_not_there_ends_in_a_line(run, monkeypatch):
    if not sys.platform.startswith("linux"):
        pytest.skip("displays are named on Linux only")
    monkeypatch.setenv("DISPLAY", ":9876")
    with pytest.raises(InputError, match=r"could not be opened.*run\.html"):
        live.watch(run)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no Xvfb on this machine")
def test_the_window_shows_the_robots(tmp_path):
    """A display in memory: its picture gets the colours of the walls, the scan and the trails."""
    recording = circle(n_frames=30)
    save(recording, tmp_path / "run.npz")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24", "-fbdir", str(tmp_path)],
        pass_fds=(write,),
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        with os.fdopen(read) as numbers:
            display = f":{numbers.readline().strip()}"
        command = ["view", str(tmp_path / "run.npz"), "-e", "odometry", "--seconds", "1"]
        window = subprocess.Popen(
            [sys.executable, "-m", "experiments.cli", *command],
            cwd=ROOT,
            env={**os.environ, "DISPLAY": display},
            stderr=subprocess.PIPE,
            text=True,
        )
        until = time.monotonic() + 60
        while not orange(tmp_path / "Xvfb_screen0") and time.monotonic() < until:
            time.sleep(0.3)
        assert orange(tmp_path / "Xvfb_screen0")
    finally:
        server.terminate()
    _, message = window.communicate(timeout=30)
    assert window.returncode == 2  # the display went away
    assert "the window could not be opened or was lost" in message.splitlines()[-1]


def orange(path):
    """Whether the screen shows the scan's colour."""
    screen = np.frombuffer(path.read_bytes()[4096:], np.uint8)
    blue, green, red, _ = screen[: len(screen) // 4 * 4].reshape(-1, 4).T.astype(int)
    return bool(((red > 190) & (green > 70) & (green < 120) & (blue < 30)).sum() > 5)


def test_a_folder_without_estimates_hides_no_estimator(recording, tmp_path, monkeypatch):
    (tmp_path / "odometry").mkdir()
    monkeypatch.chdir(tmp_path)
    shown = Playback.of(Team((recording,)), 3)
    assert with_estimates(shown, "odometry", [], silent).name == "odometry"
    (tmp_path / "runs" / "1").mkdir(parents=True)
    with pytest.raises(InputError, match=r"runs/1/estimate\.csv"):
        with_estimates(shown, "runs/1", [], silent)
