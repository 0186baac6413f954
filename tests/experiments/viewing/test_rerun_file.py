"""Runs as recordings for Rerun: what is in them, and what is said without its package."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest

from experiments.viewing import movie, rerun_file
from experiments.viewing.estimates import with_all_estimates
from experiments.viewing.playback import Playback
from sim.errors import InputError
from sim.team import Team
from tests.fixtures.fakes import circle


@pytest.fixture(scope="module")
def run():
    shown = Playback.of(Team((circle(n_frames=30, n_beams=61, sigma_range_m=0.0),)), 6)
    return with_all_estimates(shown, ["ekf_icp", "odometry"], [], lambda *_: None)


def test_a_recording_holds_map_estimates_and_errors(run, tmp_path):
    pytest.importorskip("rerun", reason="the extra rerun is not installed")
    shares = []
    movie.save(run, tmp_path / "run.rrd", shares.append, "two methods")
    assert shares == pytest.approx(np.arange(1, 7) / 6)
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(tmp_path / "run.rrd")]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    for name in (
        "/map/walls", "/map/laser", "/map/truth", "/map/ekf_icp/ellipse", "/map/odometry/estimate",
        "/errors/ekf_icp/error", "/errors/odometry/bound",
    ):  # fmt: skip
        assert name in said.stdout, name


def test_each_layer_has_a_place_of_its_own(run):
    parts = rerun_file.parts_of(run)
    assert parts["0 estimate"] == ["map", "ekf_icp", "estimate"]
    assert parts["0 other 0 ellipse"] == ["map", "odometry", "ellipse"]
    assert len({tuple(each) for each in parts.values()}) == len(parts)


def test_without_the_package_the_extra_is_named(run, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"\.rrd needs Rerun's package: .*EXTRAS=rerun"):
        movie.check_output(tmp_path / "run.rrd")
