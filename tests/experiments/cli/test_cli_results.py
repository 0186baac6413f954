"""Where the command puts its results: `--results`, the cache, an empty folder; and `--version`."""

import pytest

from experiments.runs import cache
from experiments.runs.version import code_version
from sim.errors import InputError
from tests.experiments.cli.test_cli import QUICK, called, estima, refused


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
    refused(called("cache", "--results"), "--results must name a folder")
    refused(estima("cache", ESTIMA_CACHE_GIB="much"), "ESTIMA_CACHE_GIB", "'much'")


@pytest.mark.slow
@pytest.mark.parametrize("after", [False, True])
def test_results_go_to_the_folder_of_the_option(tmp_path, after):
    run = ["run", *QUICK, "route=linear_1", "name=moved"]
    option = ["--results", "there"]
    arguments = [*run, *option] if after else [*option, *run]
    done = estima(*arguments, cwd=tmp_path, ESTIMA_RESULTS="elsewhere")
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "there" / "runs" / "moved").glob("*.journal"))) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_a_report_of_nothing_is_one_line(tmp_path):
    refused(estima("report", cwd=tmp_path, ESTIMA_RESULTS=""), "results", "estima reproduce")


def test_the_version_names_the_code():
    said = estima("--version").stdout.split()
    assert said[0] == "estima"
    assert said[2:] == ["code", code_version()]
