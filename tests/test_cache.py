"""The cache of recordings: its limit, what goes first, and `estima cache`."""

import fcntl
import os

import pytest

from experiments.runs import cache
from sim.errors import InputError
from tests.test_cli import estima, refused


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Three files of a cache, used in the order b, a, c."""
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    place = cache.folder()
    place.mkdir(parents=True)
    for used, name in enumerate("bac", start=1):
        path = place / f"{name}.npz"
        path.write_bytes(bytes(1000))
        os.utime(path, (used, used))
    return place


def names(folder):
    return sorted(path.stem for path in folder.glob("*.npz"))


def test_the_recordings_used_longest_ago_go_first(folder):
    assert [path.stem for path, _ in cache.files()] == ["b", "a", "c"]
    assert cache.trim(3000) == 0
    assert cache.trim(2999) == 1
    assert names(folder) == ["a", "c"]
    assert cache.trim(1000) == 1
    assert names(folder) == ["c"]
    assert cache.trim(0) == 1
    assert names(folder) == []


def test_a_recording_in_use_stays(folder):
    with (folder / "b.lock").open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        assert cache.trim(2000) == 1
        assert names(folder) == ["b", "c"]
        assert cache.trim(0) == 1
        assert names(folder) == ["b"]
    assert cache.trim(0) == 1


def test_what_is_cached_stays_within_the_limit(folder, monkeypatch):
    from experiments.runs.experiment import Experiment

    quick = ["simulation.physics=kinematic", "route=linear_1"]
    monkeypatch.setenv("ESTIMA_CACHE_GIB", "1e-9")  # a byte: room for nothing but the last one
    for seed in range(2):
        experiment = Experiment.compose([*quick, f"seed={seed}"])
        recording = experiment.recording()
        assert names(folder) == [experiment.recording_key]
    read = Experiment.compose([*quick, "seed=1"]).recording()
    assert read.checksum == recording.checksum


@pytest.mark.parametrize("value", ["-1", "much", "nan"])
def test_the_limit_is_a_number(value, monkeypatch):
    monkeypatch.setenv("ESTIMA_CACHE_GIB", value)
    with pytest.raises(InputError, match="ESTIMA_CACHE_GIB"):
        cache.limit_bytes()


def test_the_command_shows_and_clears(folder, tmp_path):
    shown = estima("cache", "--results", str(tmp_path), ESTIMA_CACHE_GIB="2")
    assert shown.returncode == 0, shown.stderr
    assert "3 recordings, 0.00 of 2 GiB" in shown.stdout
    cleared = estima("cache", "--clear", f"--results={tmp_path}")
    assert "3 recordings deleted" in cleared.stdout
    assert names(folder) == []
    refused(estima("cache", "--results"), "--results must name a folder")
    refused(estima("cache", ESTIMA_CACHE_GIB="much"), "ESTIMA_CACHE_GIB", "'much'")
