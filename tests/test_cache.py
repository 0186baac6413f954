"""`estima cache`, and the limit of the cache; test_recording.py has what goes first."""

import pytest

from experiments.runs import cache
from sim.errors import InputError
from tests.test_cli import estima, refused


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Three files of a cache."""
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    place = cache.folder()
    place.mkdir(parents=True)
    for name in "abc":
        (place / f"{name}.npz").write_bytes(bytes(1000))
    return place


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
    assert list(folder.glob("*.npz")) == []
    refused(estima("cache", "--results"), "--results must name a folder")
    refused(estima("cache", ESTIMA_CACHE_GIB="much"), "ESTIMA_CACHE_GIB", "'much'")
