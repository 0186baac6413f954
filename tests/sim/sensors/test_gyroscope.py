"""The gyroscope: its noise against its formula, its mean rate against geometry."""

import math

import numpy as np
import pytest

from sim import se2
from sim.errors import InputError
from sim.robot.drive import DifferentialDrive
from sim.routes.route import OpenLoop
from sim.sensors import Encoder, Gyroscope, View
from sim.simulate import Member, record
from sim.worlds.world import World

EMPTY = World("open", np.zeros((0, 4)), np.zeros((0, 2)))


def views(poses, interval_s):
    """What a sensor sees that fires along some poses (N, 3)."""
    last = View(0.0, poses[0], EMPTY, None, 0.0, poses[0])
    for i, pose in enumerate(poses):
        last = View(i * interval_s, pose, EMPTY, None, last.stamp, last.pose)
        yield last


def readings(gyroscope, poses, seed=0):
    probe = gyroscope.start(np.random.default_rng(seed))
    made = [probe(view) for view in views(poses, 1.0 / gyroscope.rate_hz)]
    assert made[0] is None  # nothing to take the mean over
    fields = gyroscope.schema
    assert all(reading.keys() == fields.keys() for reading in made[1:])
    return {k: np.array([reading[k] for reading in made[1:]]) for k in fields}


def test_white_noise_has_its_variance():
    gyroscope = Gyroscope(sigma_rate_radps=0.02, bias_walk_radps_per_sqrt_s=0.0)
    read = readings(gyroscope, np.zeros((40_001, 3)))
    white = read["yaw_rate_radps"] - read["bias_radps"]
    assert np.ptp(read["bias_radps"]) == 0.0
    assert np.var(white) == pytest.approx(0.02**2, rel=0.03)  # 4 sigma of its estimate
    assert abs(np.mean(white)) < 4 * 0.02 / 200
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.02


def test_biases_at_the_start_have_their_variance():
    gyroscope = Gyroscope(
        sigma_rate_radps=0.0, sigma_bias_radps=0.03, bias_walk_radps_per_sqrt_s=0.0
    )
    first = [readings(gyroscope, np.zeros((2, 3)), seed)["bias_radps"][0] for seed in range(3000)]
    assert np.var(first) == pytest.approx(0.03**2, rel=0.1)


@pytest.mark.parametrize(
    ("rate_hz", "seconds"), [(10.0, 4), pytest.param(100.0, 1, marks=pytest.mark.slow)]
)
def test_the_bias_walks_with_a_variance_that_grows_with_time(rate_hz, seconds):
    """At any rate: the walk is a law of time, not of readings."""
    walk = 0.01
    gyroscope = Gyroscope(
        rate_hz=rate_hz, sigma_rate_radps=0.0, sigma_bias_radps=0.0, bias_walk_radps_per_sqrt_s=walk
    )
    poses = np.zeros((int(seconds * rate_hz) + 1, 3))
    biases = np.array([readings(gyroscope, poses, seed)["bias_radps"] for seed in range(1500)])
    at_s = np.arange(1, 5) / 4 * seconds
    spread = np.var(biases[:, (at_s * rate_hz).astype(int) - 1], axis=0)
    np.testing.assert_allclose(spread, walk**2 * at_s, rtol=0.15)
    steps = np.diff(biases, axis=1)
    assert np.var(steps) == pytest.approx(walk**2 / rate_hz, rel=0.03)


def test_without_noise_it_is_the_mean_rate_of_an_arc():
    rate = 0.7
    heading = rate * np.arange(200) / 50.0  # through the seam at pi
    poses = np.column_stack([np.sin(heading), 1.0 - np.cos(heading), se2.wrap(heading)])
    read = readings(
        Gyroscope(
            rate_hz=50.0, sigma_rate_radps=0.0, sigma_bias_radps=0.0, bias_walk_radps_per_sqrt_s=0.0
        ),
        poses,
    )
    np.testing.assert_allclose(read["yaw_rate_radps"], rate, atol=1e-12)
    uneven = np.zeros((3, 3))
    uneven[:, 2] = [0.0, 0.01, 0.05]
    read = readings(
        Gyroscope(
            rate_hz=10.0, sigma_rate_radps=0.0, sigma_bias_radps=0.0, bias_walk_radps_per_sqrt_s=0.0
        ),
        uneven,
    )
    np.testing.assert_allclose(read["yaw_rate_radps"], [0.1, 0.4])


def test_in_a_recording():
    """Frames show the rate and not the bias; the first firing is a Frame without a reading."""
    robot = DifferentialDrive(wheel_radius_m=0.05, track_m=0.19)
    exact = Gyroscope(
        rate_hz=100.0, sigma_rate_radps=0.0, sigma_bias_radps=0.01, bias_walk_radps_per_sqrt_s=0.0
    )
    streams = {axis: np.random.default_rng(i) for i, axis in enumerate(("slip", "sensors"))}
    recording = record(
        EMPTY,
        Member(
            robot,
            {"encoder": Encoder(rate_hz=20.0), "gyroscope": exact},
            OpenLoop(segments=((0.3, 0.5, 4.0),)),
            streams,
        ),
        physics="kinematic",
        rays="exact",
    )
    log = recording.log("gyroscope")
    bias = recording.truth.readings["gyroscope"]["bias_radps"]
    assert [*log.values] == ["yaw_rate_radps"]
    assert len(bias) == len(log.stamps) > 400
    assert log.stamps[0] == 0.01
    frames = list(recording.frames())
    assert frames[0].readings == {}
    assert frames[1].readings.keys() == {"gyroscope"}
    poses = recording.truth_at(np.concatenate([[0.0], log.stamps]))
    turned = np.diff(np.unwrap(poses[:, 2]))
    np.testing.assert_allclose((log["yaw_rate_radps"] - bias) / 100.0, turned, atol=1e-9)
    assert np.median(log["yaw_rate_radps"] - bias) == pytest.approx(0.5, abs=1e-6)


def test_wrong_noise_is_named():
    for name, value in (
        ("rate_hz", 0.0),
        ("sigma_rate_radps", -1.0),
        ("sigma_bias_radps", math.nan),
        ("bias_walk_radps_per_sqrt_s", math.inf),
    ):
        with pytest.raises(InputError, match=rf"sensors\.gyroscope\.{name} must be"):
            Gyroscope(**{name: value})
