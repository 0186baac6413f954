import json

import numpy as np
import pytest
from evo.tools import file_interface

from estimators.base import Estimate
from experiments.export import (
    odometry_records,
    read_odometry_csv,
    write_odometry_csv,
    write_odometry_json,
)
from experiments.table import check_row, read_rows, write_rows
from sim.errors import InputError
from sim.formats.tum import read_tum, write_tum

ROW = {"status": "ok", "code_version": "a", "recording_checksum": "b", "run_key": "c"}


def an_estimate(seed=0):
    rng = np.random.default_rng(seed)
    means = np.column_stack([rng.normal(size=(7, 2)), rng.uniform(-3.1, 3.1, 7)])
    roots = rng.normal(size=(7, 3, 3))
    return Estimate(np.sort(rng.random(7)) * 1e9, means, roots @ roots.transpose(0, 2, 1))


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_rows_survive_the_round_trip(tmp_path, suffix):
    rows = [
        {**ROW, "robot.kr": 1e-5, "ate_rmse_m": 0.1, "n": 3, "route.distance_m": None},
        {**ROW, "robot.kr": 2e-5, "ate_rmse_m": 1 / 3, "n": 4, "sensors.laser": "x"},
    ]
    write_rows(rows, tmp_path / f"t{suffix}")
    frame = read_rows(tmp_path / f"t{suffix}")
    assert frame["ate_rmse_m"].tolist() == pytest.approx([0.1, 1 / 3], rel=1e-9)
    assert frame["sensors.laser"].isna().tolist() == [True, False]


def test_wrong_rows_and_files_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"robot\.kr must hold a scalar"):
        check_row({**ROW, "robot.kr": [1.0]})
    with pytest.raises(InputError, match="status"):
        check_row({"n": 1})
    (tmp_path / "x.parquet").write_bytes(b"PAR1 nonsense")
    with pytest.raises(InputError, match=r"x\.parquet: cannot read"):
        read_rows(tmp_path / "x.parquet")
    with pytest.raises(InputError, match="run the study first"):
        read_rows(tmp_path / "empty")


def test_tum_is_lossless_and_evo_reads_it(tmp_path):
    estimate, path = an_estimate(), tmp_path / "t.tum"
    write_tum(path, estimate.stamps, estimate.means)
    stamps, poses = read_tum(path)
    assert np.array_equal(stamps, estimate.stamps)
    assert np.array_equal(poses[:, :2], estimate.means[:, :2])
    assert np.allclose(poses[:, 2], estimate.means[:, 2], atol=1e-15, rtol=0)
    theirs = file_interface.read_tum_trajectory_file(path)
    assert np.array_equal(theirs.positions_xyz[:, :2], estimate.means[:, :2])
    yaw = theirs.get_orientations_euler("sxyz")[:, 2]
    assert np.allclose(yaw, estimate.means[:, 2], atol=1e-12)


@pytest.mark.parametrize(
    "line", ["1 2 3", "a b c d e f g h", "1 nan 0 0 0 0 0 1", "1 0 0 0 0 0 0 0"]
)
def test_malformed_tum_names_the_line(tmp_path, line):
    path = tmp_path / "t.tum"
    path.write_text(f"# comment\n0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=r"t\.tum:3: "):
        read_tum(path)


def test_odometry_message_places_the_planar_covariance(tmp_path):
    estimate = an_estimate()
    record = odometry_records(estimate)[3]
    flat = np.array(record["pose"]["covariance"])
    planar = [0, 1, 5, 6, 7, 11, 30, 31, 35]
    assert flat[planar].tolist() == estimate.covariances[3].ravel().tolist()
    assert np.count_nonzero(flat) == 9
    assert (record["header"]["frame_id"], record["child_frame_id"]) == ("odom", "base_link")
    write_odometry_json(estimate, tmp_path / "o.json")
    assert json.loads((tmp_path / "o.json").read_text())[3] == record
    write_odometry_csv(estimate, tmp_path / "o.csv")
    back = read_odometry_csv(tmp_path / "o.csv")
    assert np.array_equal(back.stamps, estimate.stamps)
    assert np.array_equal(back.covariances, estimate.covariances)
    assert np.allclose(back.means, estimate.means, atol=1e-12)


def test_twist_is_the_body_velocity():
    stamps = np.arange(5) * 0.5
    heading = 0.3 * stamps + 1.0
    means = np.column_stack([np.sin(heading) / 0.3, -np.cos(heading) / 0.3, heading])
    records = odometry_records(Estimate(stamps, means, np.zeros((5, 3, 3))))
    for record in records[1:]:
        assert record["twist"]["linear"]["x"] == pytest.approx(1.0)
        assert record["twist"]["linear"]["y"] == pytest.approx(0.0, abs=1e-9)
        assert record["twist"]["angular"]["z"] == pytest.approx(0.3)
