import dataclasses
import json

import numpy as np
import pytest

from estimators.base import Estimate
from experiments.trajectories.convert import write_estimate, write_recording
from experiments.trajectories.odometry import (
    PLANAR,
    odometry_records,
    read_odometry_csv,
    wheel_twist_covariances,
    write_odometry_csv,
    write_odometry_json,
)
from sim.errors import InputError
from sim.robot.drive import DifferentialDrive
from sim.robot.kinematic import run_batch
from sim.robot.slip import twist_covariances
from sim.routes.route import OpenLoop
from tests.experiments.report.test_table import an_estimate
from tests.fixtures import fakes


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


def test_twist_covariance_is_that_of_the_wheels_error():
    """Sampled: velocity by the encoders less that of the wheels on the ground."""
    robot = DifferentialDrive(wheel_radius_m=0.05, track_m=0.19, kr=1.5e-4, kl=5e-5)
    runs = run_batch(robot, OpenLoop(segments=((0.4, 0.8, 2.0),)), 4000, np.random.default_rng(2))
    lapse = np.diff(runs.stamps)
    J = np.array([[0.5, 0.5], [0.0, 0.0], [1.0 / 0.19, -1.0 / 0.19]])
    travel = np.diff(runs.encoder_m, axis=1)
    error = (travel - np.diff(runs.ground_m, axis=1)) @ J.T / lapse[:, None]  # (n, T, 3)
    of_runs = [twist_covariances(lapse, ds, 0.19, 1.5e-4, 5e-5) for ds in travel[:200]]
    for i in (8, 20, 35):
        covariance = np.mean(of_runs, axis=0)[i]  # |ds| is read from noisy encoders
        sampled = np.cov(error[:, i].T)
        scale = np.sqrt(np.diag(covariance))[[0, 2]]
        off = (sampled - covariance)[np.ix_([0, 2], [0, 2])] / np.outer(scale, scale)
        np.testing.assert_allclose(off, 0.0, atol=0.08)
        assert covariance[0, 2] > 0.3 * scale.prod()  # the right wheel errs more
        assert sampled[1, 1] == covariance[1, 1] == 0.0
    at_rest = twist_covariances([0.0, 0.1], np.zeros((2, 2)), 0.19, 1e-4, 1e-4)
    np.testing.assert_array_equal(at_rest, np.zeros((2, 3, 3)))


def test_what_is_exported_has_the_twist_covariance(tmp_path):
    """Records, and topics of a bag: from the wheels if kr and kl are known, else zeros."""
    recording = fakes.circle(n_frames=8)
    estimate = Estimate(recording.frame_stamps, recording.truth.poses, np.zeros((8, 3, 3)))
    wanted = wheel_twist_covariances(recording, estimate.stamps, (1e-4, 2e-4))
    assert np.all(wanted[0] == 0.0)
    assert np.all(wanted[1:, [0, 2], [0, 2]] > 0.0)
    planar = [0, 1, 5, 6, 7, 11, 30, 31, 35]
    write_estimate(tmp_path / "o.json", estimate, recording, slip=(1e-4, 2e-4))
    for record, covariance in zip(
        json.loads((tmp_path / "o.json").read_text()), wanted, strict=True
    ):
        flat = np.array(record["twist"]["covariance"])
        np.testing.assert_allclose(flat[planar], covariance.ravel())
        assert np.count_nonzero(flat) <= 4
    with pytest.raises(InputError, match="without the recording"):
        write_estimate(tmp_path / "o.json", estimate, slip=(1e-4, 2e-4))
    write_estimate(tmp_path / "o.mcap", estimate, recording, slip=(1e-4, 2e-4))
    of_topics = bag_twists(tmp_path / "o.mcap")
    np.testing.assert_allclose(of_topics["/estimate"], wanted, rtol=1e-9)
    assert of_topics["/odom"][1:, 0, 0].min() > 0.0
    made_with = dataclasses.replace(recording, config={"robot": {"kr": 1e-4, "kl": 2e-4}})
    write_recording(tmp_path / "made.mcap", made_with)
    np.testing.assert_allclose(bag_twists(tmp_path / "made.mcap")["/odom"], of_topics["/odom"])
    evil = dataclasses.replace(recording, config={"robot": {"kr": "many", "kl": 2e-4}})
    write_recording(tmp_path / "evil.mcap", evil)
    assert not bag_twists(tmp_path / "evil.mcap")["/odom"].any()


def bag_twists(path):
    """Planar covariances (T, 3, 3) of the twists of each odometry topic."""
    from rosbags.highlevel import AnyReader

    found = {}
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            if connection.msgtype == "nav_msgs/msg/Odometry":
                message = reader.deserialize(data, connection.msgtype)
                full = message.twist.covariance.reshape(6, 6)
                found.setdefault(connection.topic, []).append(full[PLANAR[1:]])
    return {topic: np.array(parts) for topic, parts in found.items()}


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
