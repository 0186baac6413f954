import json

import numpy as np
import pytest

from estimators.base import Estimate
from experiments.trajectories.odometry import (
    odometry_records,
    read_odometry_csv,
    write_odometry_csv,
    write_odometry_json,
)
from sim.errors import InputError
from tests.test_table import an_estimate


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


def test_quaternions_are_unit_and_turn_about_z():
    for record, mean in zip(odometry_records(an_estimate()), an_estimate().means, strict=True):
        q = record["pose"]["orientation"]
        assert (q["x"], q["y"]) == (0.0, 0.0)
        assert q["z"] ** 2 + q["w"] ** 2 == pytest.approx(1.0)
        turned = [q["w"] ** 2 - q["z"] ** 2, 2 * q["w"] * q["z"]]  # the x axis after the rotation
        assert turned == pytest.approx([np.cos(mean[2]), np.sin(mean[2])])


def test_estimates_that_cannot_be_written_are_refused(tmp_path):
    empty = Estimate(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert odometry_records(empty) == []
    with pytest.raises(InputError, match="no belief"):
        write_odometry_csv(empty, tmp_path / "o.csv")
    lost = Estimate(np.arange(2.0), np.full((2, 3), np.nan), np.zeros((2, 3, 3)))
    with pytest.raises(InputError, match="not finite"):
        write_odometry_json(lost, tmp_path / "o.json")
    assert list(tmp_path.iterdir()) == []
    write_odometry_csv(lost, tmp_path / "o.csv")
    assert np.isnan(read_odometry_csv(tmp_path / "o.csv").means).all()


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"a,b\n1,2\n"])
def test_what_is_no_odometry_is_refused(tmp_path, content):
    path = tmp_path / "o.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"o\.csv"):
        read_odometry_csv(path)
    with pytest.raises(InputError, match=r"o\.csv\.no: cannot read"):
        read_odometry_csv(tmp_path / "o.csv.no")
