import gzip
import tarfile

import numpy as np
import pytest

from estimators.base import Estimate
from experiments.cli.main import app
from experiments.trajectories.convert import write_estimate, write_recording
from experiments.trajectories.odometry import read_odometry_csv
from sim.errors import InputError
from sim.formats.detect import kind_of, read_any
from sim.formats.rosbag_in import read_tracks
from sim.formats.tum import read_tum
from sim.recording import load, save
from sim.worlds.grid_file import read_grid
from tests.fixtures import fakes
from tests.fixtures import log_samples as samples


def folder_of_samples(tmp_path):
    files = {
        "carmen.log": samples.flaser_log(),
        "graph.log": samples.robotlaser_log(),
        "raw.json": samples.intel_json(),
        "run.tuple": samples.KHEPERA,
        "odometry.csv": samples.rawseeds_odometry().encode(),
        "motors.txt": samples.lego_motors(),
        "wean.log": samples.wean_log(),
    }
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress(data))
    (tmp_path / "mrclam").mkdir()
    for name, data in samples.mrclam_members().items():
        (tmp_path / "mrclam" / name).write_bytes(data)
    with tarfile.open(tmp_path / "mrclam.tar.xz", "w:xz") as archive:
        archive.add(tmp_path / "mrclam", "mrclam")
    return tmp_path


def test_every_format_is_known_by_its_contents(tmp_path):
    folder = folder_of_samples(tmp_path)
    expected = {
        "carmen.log": "carmen",
        "graph.log": "carmen",
        "raw.json": "intel",
        "run.tuple": "khepera",
        "odometry.csv": "rawseeds",
        "motors.txt": "lego",
        "wean.log": "wean",
    }
    for name, kind in expected.items():
        assert kind_of(folder / name) == kind
        assert kind_of(folder / f"{name}.gz") == kind
    assert kind_of(folder / "mrclam") == kind_of(folder / "mrclam.tar.xz") == "mrclam"
    save(fakes.circle(n_frames=3), folder / "a.npz")
    assert kind_of(folder / "a.npz") == "recording"
    (folder / "prose.txt").write_text("It was a dark night\n")
    with pytest.raises(InputError, match="not a log of a known format"):
        kind_of(folder / "prose.txt")


def test_read_any(tmp_path):
    folder = folder_of_samples(tmp_path)
    for name in ("carmen.log", "graph.log", "raw.json", "run.tuple", "wean.log", "mrclam"):
        assert len(read_any([folder / name]).frame_stamps) >= 2
    (folder / "sick.csv").write_text(samples.rawseeds_sick())
    assert "laser" in read_any([folder / "odometry.csv", folder / "sick.csv"]).logs
    with pytest.raises(InputError, match="a rawseeds log is 2 to 3 files, got 1"):
        read_any([folder / "odometry.csv"])
    with pytest.raises(InputError, match="one file, got 2"):
        read_any([folder / "wean.log", folder / "wean.log"])


@pytest.mark.parametrize("ending", [".npz", ".mcap", ".bag", ".log", ""])
def test_convert_there_and_back(tmp_path, ending):
    recording = fakes.circle(n_frames=8, n_beams=21)
    write_recording(tmp_path / f"out{ending}", recording)
    back = read_any([tmp_path / f"out{ending}"])
    np.testing.assert_array_equal(back.log("laser")["ranges_m"], recording.log("laser")["ranges_m"])
    travel = recording.wheels.position_m
    np.testing.assert_allclose(
        np.ptp(back.wheels.position_m, axis=0), np.ptp(travel, axis=0), rtol=0.6
    )


@pytest.mark.parametrize("ending", [".tum", ".csv", ".mcap"])
def test_estimates_come_back(tmp_path, ending):
    recording = fakes.circle(n_frames=8)
    covariances = np.tile(np.diag([0.01, 0.02, 0.03]), (8, 1, 1))
    landmarks = {"landmarks": np.arange(6.0).reshape(2, 3)}
    estimate = Estimate(recording.frame_stamps, recording.truth.poses, covariances, map=landmarks)
    path = tmp_path / f"estimate{ending}"
    write_estimate(path, estimate, recording)
    if ending == ".tum":
        stamps, means = read_tum(path)
    elif ending == ".csv":
        found = read_odometry_csv(path)
        stamps, means = found.stamps, found.means
    else:
        track = read_tracks(path)["estimate"]
        stamps, means = track.stamps, track.means
        np.testing.assert_array_equal(track.covariances, estimate.covariances)
        np.testing.assert_array_equal(track.landmarks, landmarks["landmarks"])
    np.testing.assert_allclose(stamps, estimate.stamps, atol=1e-9)
    np.testing.assert_allclose(means, estimate.means, atol=1e-12)
    with pytest.raises(InputError, match="unknown ending"):
        write_estimate(tmp_path / "estimate.xyz", estimate)


def test_evo_reads_our_tum(tmp_path):
    interface = pytest.importorskip("evo.tools.file_interface")
    recording = fakes.circle(n_frames=30)
    write_recording(tmp_path / "truth.tum", recording)
    found = interface.read_tum_trajectory_file(tmp_path / "truth.tum")
    np.testing.assert_array_equal(found.timestamps, recording.truth.stamps)
    np.testing.assert_array_equal(found.positions_xyz[:, :2], recording.truth.poses[:, :2])
    headings = found.get_orientations_euler()[:, 2]
    np.testing.assert_allclose(np.exp(1j * headings), np.exp(1j * recording.truth.poses[:, 2]))


def test_the_commands(tmp_path, capsys):
    from typer.testing import CliRunner

    folder = folder_of_samples(tmp_path)
    runner = CliRunner()
    done = runner.invoke(
        app, ["convert", str(folder / "carmen.log.gz"), "-o", str(folder / "c.npz")]
    )
    assert done.exit_code == 0, done.output
    assert len(load(folder / "c.npz").log("laser").stamps) == 3
    shown = runner.invoke(app, ["info", str(folder / "carmen.log")])
    assert "source      carmen" in shown.output
    assert "scans longest gap s: 1.0" in shown.output
    (folder / "map.dat").write_bytes(samples.wean_map())
    done = runner.invoke(app, ["convert", str(folder / "map.dat"), "-o", str(folder / "map.yaml")])
    assert "2 x 3 cells of 0.1 m" in done.output
    assert read_grid(folder / "map.yaml").probability[0, 1] == 1.0
    wrong = runner.invoke(app, ["convert", str(folder / "carmen.log"), "-o", str(folder / "c.xyz")])
    assert isinstance(wrong.exception, InputError)
