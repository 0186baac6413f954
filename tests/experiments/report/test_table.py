import numpy as np
import pytest
from evo.tools import file_interface

from estimators.base import Estimate
from experiments.runs.row import (
    Outcome,
    Status,
    check_row,
    concatenate,
    read_rows,
    to_tables,
    write_frame,
)
from sim.errors import InputError
from sim.formats.tum import read_tum, write_tum

ROW = {
    **Status().columns(),
    "code_version": "a",
    "recording_checksum": "b",
    "run_key": "c",
}


def write_rows(rows, path):
    write_frame(concatenate(to_tables(rows)), path)


def an_estimate(seed=0):
    rng = np.random.default_rng(seed)
    means = np.column_stack([rng.normal(size=(7, 2)), rng.uniform(-3.1, 3.1, 7)])
    roots = rng.normal(size=(7, 3, 3))
    return Estimate(np.sort(rng.random(7)) * 1e9, means, roots @ roots.transpose(0, 2, 1))


def test_what_a_killed_process_was_writing_is_not_read(tmp_path):
    write_rows([ROW], tmp_path / "a.parquet")
    (tmp_path / ".b.1.ff.part.parquet").write_bytes(b"PAR1")
    assert len(read_rows(tmp_path)) == 1


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


def test_nan_needs_a_status():
    with pytest.raises(InputError, match="ate_rmse_m is nan though the status is ok"):
        check_row({**ROW, "ate_rmse_m": float("nan")})
    failed = Status(Outcome.FAILED, "not_finite", "not finite at 1.00 s").columns()
    check_row({**ROW, "ate_rmse_m": float("nan"), **failed})
    with pytest.raises(InputError, match="64 bits"):
        check_row({**ROW, "seed": 2**70})


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_digests_stay_text_and_mixed_columns_become_text(tmp_path, suffix):
    rows = [
        {**ROW, "run_key": "0012", "code_version": "12e45678901", "a": True, "b": 1},
        {**ROW, "run_key": "0013", "code_version": "12e45678902", "a": 1.5, "b": 2.5},
    ]
    write_rows(rows, tmp_path / f"t{suffix}")
    frame = read_rows(tmp_path / f"t{suffix}")
    assert frame["run_key"].tolist() == ["0012", "0013"]
    assert frame["code_version"].tolist() == ["12e45678901", "12e45678902"]
    assert frame["a"].tolist() == ["True", "1.5"]
    assert frame["b"].tolist() == [1.0, 2.5]


def test_tables_of_a_folder_are_read_as_one(tmp_path):
    for i in range(3):
        write_rows([{**ROW, "n": i, f"only_{i}": 1}], tmp_path / f"{i}.parquet")
    frame = read_rows(tmp_path)
    assert frame["n"].tolist() == [0, 1, 2]
    assert frame["only_1"].notna().tolist() == [False, True, False]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.parquet", "1.parquet", "2.parquet"]
    with pytest.raises(InputError, match=r"\.parquet or \.csv"):
        write_rows([ROW], tmp_path / "t.xlsx")


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
