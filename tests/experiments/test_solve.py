"""`estima solve`: one command from a log to a path, a map, and a page that says how."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from experiments import solve as solving
from experiments.runs.calibration import read_calibration
from experiments.solve import as_text, solve
from sim import se2
from sim.formats.relations import Relations, write_relations
from sim.formats.tum import read_tum
from sim.recording import load, save
from sim.worlds.grid_file import read_grid
from tests.experiments.calibration.test_from_log import GAINS, log_of
from tests.experiments.cli.test_cli import called, refused
from tests.fixtures.log_samples import DATA

LASER = np.array([0.1, 0.0, 0.0])  # of `log_of`; the log has it in the robot's middle
FILES = (
    *("recording.npz", "calibration.yaml", "trajectory.tum", "map.yaml", "map.pgm"),
    *("page.html", "summary.json", "summary.csv"),
)
needs_data = pytest.mark.skipif(not (DATA / "fr079_flirt").exists(), reason="no real logs here")


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """What the command makes of a drive in a room, and what it says."""
    folder = tmp_path_factory.mktemp("solve")
    log = log_of(90.0, sensor="laser")
    save(log, folder / "log.npz")
    scans = log.log("laser").stamps
    ends = np.stack([scans[:-40:7], scans[40::7]], axis=1)
    first, second = (se2.compose(log.truth_at(side), LASER) for side in ends.T)
    motion = se2.between(first, second)
    write_relations(folder / "relations.txt", Relations(ends, motion))
    arguments = ["--relations", str(folder / "relations.txt")]
    result = called("solve", str(folder / "log.npz"), "-o", str(folder / "out"), *arguments)
    assert result.returncode == 0, result.stderr
    return log, folder / "out", result.stdout


def test_folder_holds_the_answer(solved):
    log, out, _ = solved
    assert sorted(name for name in FILES if not (out / name).is_file()) == []
    assert load(out / "recording.npz").checksum == log.checksum
    stamps, poses = read_tum(out / "trajectory.tum")
    assert np.isin(log.log("laser").stamps, stamps).all()
    np.testing.assert_allclose(poses[0], 0.0, atol=1e-12)
    rows = np.isin(stamps, log.log("laser").stamps)
    # the path is that of what the log calls base_link: where its laser truly is, as logged
    truth, poses = se2.compose(log.truth_at(stamps[rows]), LASER), poses[rows]
    off = se2.between(se2.between(truth[0], truth), se2.between(poses[0], poses))
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.15
    grid = read_grid(out / "map.yaml")
    assert 0.005 < grid.occupied.mean() < 0.2
    wheels = read_calibration(out / "calibration.yaml").wheels
    assert [wheels.gain_right, wheels.gain_left] == pytest.approx(GAINS, rel=0.01)


def test_summary_and_page_say_it(solved):
    _, out, said = solved
    row = json.loads((out / "summary.json").read_text())
    [in_csv] = csv.DictReader((out / "summary.csv").open())
    assert in_csv.keys() == row.keys()
    assert row["n_relations"] > 20
    assert row["relation_translation_m"] < 0.1
    assert row["ate_aligned_rmse_m"] < 0.1
    assert 0.0 <= row["unused_share"] < 0.1
    page = (out / "page.html").read_text()
    for words in ("wheels.gain_right", "relation_translation_m", "map without closures", "<img"):
        assert words in page
    assert "relations" in said
    assert "% used" in said


def test_truth_is_not_looked_at():
    """With another truth the same path comes out."""
    log = log_of(60.0, sensor="laser")
    moved = dataclasses.replace(log.truth, poses=log.truth.poses[::-1].copy())
    paths = [solve(one).path for one in (log, dataclasses.replace(log, truth=moved))]
    np.testing.assert_array_equal(paths[0].means, paths[1].means)


def test_a_log_without_a_truth_says_that_its_error_is_unknown(solved):
    row = json.loads((solved[1] / "summary.json").read_text())
    assert "no error" not in as_text(row, solved[1])
    unjudged = {k: v for k, v in row.items() if k not in ("n_relations", "ate_aligned_rmse_m")}
    assert "no error    the log has no true path; give relations, or" in as_text(
        unjudged, solved[1]
    )


def test_an_interrupt_says_that_nothing_is_kept(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(solving, "solve", interrupted)
    save(log_of(2.0, sensor="laser"), tmp_path / "log.npz")
    with pytest.raises(KeyboardInterrupt, match="out is not written: run it again, from the start"):
        solving.solve_log([tmp_path / "log.npz"], tmp_path / "out")


def test_bad_input_is_one_line(tmp_path):
    out = str(tmp_path / "out")
    refused(called("solve", str(tmp_path / "none.log"), "-o", out), "none.log")
    blind = log_of(20.0, sensor="laser").without("laser")
    save(blind, tmp_path / "blind.npz")
    refused(called("solve", str(tmp_path / "blind.npz"), "-o", out), "neither scans nor landmarks")
    file = tmp_path / "blind.npz"
    refused(called("solve", str(file), "-o", str(file)), "name a folder")


@needs_data
@pytest.mark.slow
def test_freiburg_by_its_edges(tmp_path):
    log = DATA / "fr079_flirt" / "fr079.flirt.log.gz"
    relations = str(log.parent / "fr079.relations.gz")
    result = called("solve", str(log), "-o", str(tmp_path), "--relations", relations)
    assert result.returncode == 0, result.stderr
    row = json.loads((tmp_path / "summary.json").read_text())
    assert row["relation_translation_m"] < 0.258  # the printed scan matching
