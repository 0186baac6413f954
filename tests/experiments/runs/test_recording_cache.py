"""The cache of recordings: made once, mended, shared by processes, and kept small."""

import fcntl
import multiprocessing
import os
import subprocess
import sys

import pytest

from experiments.runs.cache import fetch_or_make, files, folder, limit_bytes, trim
from sim.errors import InputError
from sim.recording import load
from tests.sim.test_recording import small_recording


def small():
    """A small recording that depends on nothing."""
    return small_recording(), {}


def test_the_cache_makes_once_and_mends_damage(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    made = []

    def make():
        made.append(1)
        return small_recording(), {}

    for _ in range(3):
        recording = fetch_or_make("a", make)
        assert recording.checksum == small_recording().checksum
    assert len(made) == 1
    path = folder() / "a.npz"
    path.write_bytes(path.read_bytes()[:-20])
    fetch_or_make("a", make)
    assert len(made) == 2
    fetch_or_make("b", make)
    assert len(made) == 3
    (folder() / "b.npz").write_bytes(path.read_bytes())  # the recording of another key
    fetch_or_make("b", make)
    assert len(made) == 4
    assert fetch_or_make("b", make).config == small_recording().config
    assert {file.suffix for file in folder().iterdir()} == {".npz"}


def test_the_cache_drops_what_was_used_longest_ago_but_nothing_in_use(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    for age, key in enumerate("abcd"):
        fetch_or_make(key, small)
        os.utime(folder() / f"{key}.npz", (1000.0 + age, 1000.0 + age))
    fetch_or_make("b", small)  # used again
    size = files()[0][1]
    with (folder() / "a.lock").open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        assert trim(2 * size) == 2
    assert [path.stem for path, _ in files()] == ["a", "b"]
    monkeypatch.setenv("ESTIMA_CACHE_GIB", str(2.5 * size / 2**30))
    fetch_or_make("e", small)
    assert [path.stem for path, _ in files()] == ["b", "e"]
    monkeypatch.setenv("ESTIMA_CACHE_GIB", "much")
    with pytest.raises(InputError, match="ESTIMA_CACHE_GIB"):
        limit_bytes()


def _fetch(log):
    def make():
        with open(log, "a") as f:
            f.write("made\n")
        return small()

    fetch_or_make("a", make)


def test_processes_share_one_making(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))
    log = tmp_path / "log.txt"
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=_fetch, args=(log,)) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    assert log.read_text() == "made\n"


@pytest.mark.bullet
@pytest.mark.parametrize("rays", ["bullet", "exact"])
@pytest.mark.slow
def test_two_processes_write_the_same_recording(tmp_path, rays):
    script = f"""
import sys
from experiments.runs.experiment import Experiment
from sim.recording import save
from pathlib import Path
experiment = Experiment.compose(
    ["world=room", "sensors=lms291", "sensors.laser.rate_hz=10", "seed=4",
     "route=open_loop", "robot.kr=1e-4", "simulation.rays={rays}"])
print(save(experiment.simulate(), Path(sys.argv[1])))
"""
    runs = [
        subprocess.run(
            [sys.executable, "-c", script, str(tmp_path / f"{i}.npz")],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for i in range(2)
    ]
    assert runs[0] == runs[1]
    assert len(runs[0]) == 64
    assert load(tmp_path / "0.npz").checksum == load(tmp_path / "1.npz").checksum == runs[0]


def test_an_edited_world_file_is_another_recording(tmp_path):
    from experiments.runs.experiment import Experiment

    path = tmp_path / "w.yaml"
    overrides = [
        "world=from_file",
        f"world.path={path}",
        "route=linear_4",
        "simulation.physics=kinematic",
        "simulation.rays=exact",
    ]
    walls = []
    for x in (5, 6):
        path.write_text(f"walls: [[{x}, -1, {x}, 1]]\n")
        recording = Experiment.compose(overrides).recording()
        walls.append(recording.truth.world.walls[0, 0])
    assert walls == [5.0, 6.0]
