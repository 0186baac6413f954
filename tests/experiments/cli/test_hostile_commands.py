"""Commands over files, folders and streams that are not what they should be: one line each."""

import dataclasses
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from experiments.cli.main import main
from experiments.runs.store import write_run
from sim.formats.carmen import write_carmen
from sim.recording import save
from tests.experiments.cli.test_cli import QUICK, ROOT, called, refused
from tests.experiments.runs.test_store import row
from tests.fixtures import fakes

DRIVE = [*QUICK, "route=linear_1"]
BASIC = ["name=hostile", "hydra/launcher=basic"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a recording, a log of it, and rows of a sweep."""
    folder = tmp_path_factory.mktemp("made")
    recording = fakes.circle(n_frames=30, n_beams=61).without("stereo")
    save(recording, folder / "r.npz")
    write_carmen(folder / "r.log", recording)
    write_run([row(1, ate_rmse_m=0.1, **{"choice.estimator": "a"})], folder / "results/runs/s")
    return folder


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    """The current folder, with a copy of what was made."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))
    return tmp_path


def ended_well(done):
    """Whether a command ended with its result, or with one line."""
    assert done.returncode in (0, 1, 2), done.stderr
    assert "Traceback" not in done.stderr, done.stderr


READERS = {
    "recording": ["run", "recording=X", "estimator=odometry"],
    "calibration": ["run", "recording=r.npz", "calibration=X"],
    "study": ["run", "study=X.yaml"],
    "grid": ["run", *DRIVE, "prior.map=X.yaml"],
    "world": ["run", *DRIVE, "world=from_file", "world.path=X"],
    "way": ["run", *DRIVE, "route=timetable", "route.path=X.tum"],
    "sheet": ["calibrate", "--sheet", "X"],
    "suite": ["check", "--suite", "X.yaml"],
    "trajectory": ["score", "r.npz", "X.csv"],
    "estimate": ["view", "r.npz", "-e", "X.csv", "-o", "a.html"],
    "picture": ["view", "--map", "X.yaml", "-o", "m.png"],
    "rows": ["table", "X.csv"],
    "table": ["export-table", "X.csv"],
    "log": ["info", "X"],
}


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "not utf-8", "no rights", "loop"])
@pytest.mark.parametrize("reader", READERS)
def test_any_reader_refuses_what_is_no_text_of_its_kind(here, reader, kind):
    words = READERS[reader]
    suffix = next(word for word in words if "X" in word).partition("X")[2]
    folder = here / "closed"
    folder.mkdir()
    path = folder / f"x{suffix}"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path)
    else:
        path.write_bytes(b"\xff\xfe\x00 a\n")
    folder.chmod(0 if kind == "no rights" else 0o755)
    here.chmod(0o777)
    named = [word.replace(f"X{suffix}", str(path)) if "X" in word else word for word in words]
    rooted = os.geteuid() == 0 and kind == "no rights"
    os.seteuid(65534) if rooted else None
    try:
        done = called(*named)
    finally:
        os.seteuid(0) if rooted else None
        folder.chmod(0o755)
    refused(done)


@pytest.mark.parametrize("name", ["unfinished-x.txt", "command.txt"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "long", "not utf-8"])
def test_what_lies_among_the_rows_is_read_within_bounds(here, name, kind):
    path = here / "results" / "runs" / "s" / name
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        path.write_bytes(b"\xff" if kind == "not utf-8" else b"estima run -m x\n" * 100_000)
    refused(called("report", "s", "--all-versions"), name)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "-m", *DRIVE, "name=[a]"], "name must be one word"),
        (["run", "-m", *DRIVE[:2], *BASIC, "picture=true,false"], "picture decides no result"),
        (["run", "-m", *DRIVE, *BASIC, "keep=[],[particles]"], "keep decides no result"),
        (["run", *DRIVE, "robot.kr=1e300"], "the robot's motion is not finite; check robot.kr"),
        (["run", *DRIVE, "route.rest_s=1e308"], "route.rest_s last 1e+308 s"),
        (["run", *QUICK, "route.distance_m=1e15"], "at most 100000"),
        (["run", *DRIVE, "repeats=999999999"], "from 1 to 100000"),
        (["run", *DRIVE, "world=rooms", "world.n_x=1000000"], "2500 are the most"),
        (["run", *DRIVE, "world=streets", "world.n_x=1000000"], "2500 are the most"),
        (["run", *DRIVE, "world=rooms", "world.n_landmarks=10000000000"], "world.n_landmarks"),
        (["options", "study", "q", "--config-dir", "own"], "not UTF-8 text"),
        (["report", "s", "--config-dir", "nope"], "--config-dir must name a folder"),
        (["view", "--map", "own/grid.yaml", "-o", "a.png"], "not a file"),
    ],
    ids=lambda words: words[-1] if isinstance(words, list) else "",
)
def test_values_beyond_all_bounds_are_named(here, words, said):
    (here / "own" / "study").mkdir(parents=True)
    (here / "own" / "study" / "q.yaml").write_bytes(b"\xff\n")
    os.mkfifo(here / "own" / "p.pgm")
    (here / "own" / "grid.yaml").write_text(
        "image: p.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.2\n"
    )
    refused(called(*words), said)


@pytest.mark.parametrize("words", [["run"], ["run", "-m", "hydra/launcher=basic"]])
def test_a_study_whose_keys_would_be_ignored_is_refused(here, words):
    (here / "q.yaml").write_text("seed: 7\n")
    refused(called(*words, "study=q.yaml"), "first line `# @package _global_`")


MODULES = {
    "a constructor that raises": "class Own:\n    def __init__(self, kr=0.0, kl=0.0, window_s=0.0, "
    "integration=''):\n        raise KeyError('x')\n",
    "one that exits": "class Own:\n    def __init__(self, **_):\n        raise SystemExit(0)\n",
    "no syntax": "def (\n",
    "an import that raises": "1 / 0\n",
    "an import that exits": "raise SystemExit(0)\n",
    "no text": "\x00",
}


@pytest.mark.parametrize("name", MODULES)
def test_code_of_ones_own_that_fails_is_named(here, monkeypatch, name):
    (here / "own_module.py").write_text(MODULES[name])
    monkeypatch.syspath_prepend(str(here))
    monkeypatch.delitem(sys.modules, "own_module", raising=False)
    refused(called("run", *DRIVE, "estimator._target_=own_module.Own"), "own_module.Own")


@pytest.mark.parametrize("target", ["..x", ".x", "x.", "os.path", "a b.c", "é.x", "builtins.dict"])
def test_a_target_that_names_nothing_is_refused(here, target):
    refused(called("run", *DRIVE, f"estimator._target_='{target}'"), target)


@pytest.mark.parametrize(
    "words",
    [["view", "r.npz", "-o", "a.html"], ["map", "r.npz", "-o", "m.yaml"]],
    ids=["view", "map"],
)
def test_a_program_that_fails_is_one_line(here, words):
    done = called(*words, "-e", "external", 'estimator.command=["false"]')
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("estima: ")]
    assert "the run failed: false ended with code 1" in line
    assert "Traceback" not in done.stderr


def short_logs():
    recording = fakes.circle(n_frames=30, n_beams=61).without("stereo")
    far = 1e12

    def late(log):
        return dataclasses.replace(log, stamps=log.stamps + far)

    return {
        "one": recording.cut(1),
        "two": recording.cut(2),
        "late": dataclasses.replace(
            recording,
            frame_stamps=recording.frame_stamps + far,
            wheels=late(recording.wheels),
            logs={name: late(log) for name, log in recording.logs.items()},
            truth=late(recording.truth),
        ),
    }


USES = {
    "info": ["info", "X"],
    "check": ["info", "--check", "X"],
    "run": ["run", "recording=X", "estimator=odometry"],
    "icp": ["run", "recording=X", "estimator=ekf_icp"],
    "view": ["view", "X", "-o", "a.html"],
    "calibrate": ["calibrate", "X", "-o", "c.yaml"],
    "twin": ["twin", "X", "-o", "t.yaml"],
    "convert": ["convert", "X", "-o", "x.log"],
    "map": ["map", "X", "-o", "m.yaml"],
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("log", ["one", "two", "late"])
def test_logs_of_no_length_and_stamps_without_end(here, log, use):
    save(short_logs()[log], here / "x.npz")
    ended_well(called(*[word.replace("X", "x.npz") for word in USES[use]]))


def test_a_scan_without_a_drive(here):
    lines = (here / "r.log").read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if "LASER" in line)
    (here / "one.log").write_text("\n".join(lines[: first + 1]) + "\n")
    for words in (["info", "--check"], ["calibrate", "-o", "c.yaml"], ["twin", "-o", "t.yaml"]):
        ended_well(called(words[0], "one.log", *words[1:]))


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("kind", ["closed", "full", "broken"])
def test_streams_that_cannot_be_written(here, kind, number):
    """As a shell leaves them: `>&-`, a full disk, `| head`."""
    into = {"closed": f"{number}>&-", "full": f"{number}>/dev/full", "broken": ""}[kind]
    line = f"{sys.executable} -m experiments.cli info r.npz {into}"
    if kind == "broken":
        line = f"({line} {'2>&1 >/dev/null' if number == 2 else ''}; echo $? > code) | true"
    else:
        line += "; echo $? > code"
    said = subprocess.run(
        ["sh", "-c", line], capture_output=True, text=True, cwd=here, timeout=100,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert int((here / "code").read_text()) in (0, 1), said.stderr
    assert "Traceback" not in said.stderr
    assert "Exception ignored" not in said.stderr


def run_cli(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["estima", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("OMP_NUM_THREADS", "abc"),
        ("OMP_NUM_THREADS", "0"),
        ("OMP_NUM_THREADS", "4,2"),
        ("SOURCE_DATE_EPOCH", "x"),
        ("MPLBACKEND", "nonsense"),
    ],
)
def test_an_environment_that_libraries_fail_at_is_named(name, value):
    done = subprocess.run(
        [sys.executable, "-m", "experiments.cli", "--version"],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT), name: value},
    )  # fmt: skip
    refused(done, name)


def test_a_terminal_without_end_is_bounded(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "99999999")
    assert run_cli(monkeypatch, "--help") == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 1000


def test_a_folder_that_is_gone_is_named(here, monkeypatch):
    gone = here / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    for words in (["table", "s"], ["run", *DRIVE]):
        refused(called(*words), "the current folder is gone")
    os.chdir(here)


def test_a_sparse_path_is_remarked():
    from experiments.evaluation.metrics import describe_pause

    recording = fakes.circle(n_frames=100)
    stamps = recording.frame_stamps
    assert describe_pause(recording, stamps) == ""
    assert describe_pause(recording, stamps[::4]) == ""
    sparse = describe_pause(recording, stamps[::9])
    assert sparse.startswith("a pose every 0.9 s, where the recording allows")
    assert np.isfinite(stamps).all()
