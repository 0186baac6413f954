import numpy as np
import pytest

from experiments.runs.experiment import Experiment
from sim.errors import InputError
from sim.sensors import (
    Encoder,
    Gyroscope,
    Laser,
    Lidar3D,
    PlaceDescriptor,
    RealCamera,
    RealLaser,
    RobotCamera,
    StereoCamera,
    sensor_of,
    sensors_from_config,
)
from sim.sensors.base import sensor_settings

POINTS = np.array([[0.5, -0.2, 2.0], [2.5, 0.4, 5.0], [-4.0, 1.0, 8.0]])


@pytest.mark.parametrize("correlated", [True, False])
def test_stereo_noise_has_the_covariance_of_eqs_10_to_12(correlated):
    """Sampled noise against R; far enough below the disparity for the first order to hold."""
    camera = StereoCamera(
        sigma_column_px=0.5, sigma_row_px=0.7, sigma_disparity_px=0.1, correlated=correlated
    )
    rng = np.random.default_rng(0)
    for point in POINTS:
        sample = camera.measure(np.tile(point, (40_000, 1)), rng)
        R = camera.covariance(point[None])[0]
        scale = np.sqrt(np.outer(np.diag(R), np.diag(R)))
        assert np.allclose(np.cov(sample.T) / scale, R / scale, atol=0.04)


def test_diagonal_of_r_is_the_papers():
    """gil2008, eqs. (10)-(12), written out for one point."""
    camera = StereoCamera(sigma_column_px=10, sigma_row_px=10, sigma_disparity_px=0.5)
    x, y, z = POINTS[1]
    f, B = camera.focal_px, camera.baseline_m
    d = f * B / z
    c, r = f * x / z, f * y / z
    expected = [
        B**2 * 10**2 / d**2 + B**2 * c**2 * 0.5**2 / d**4,
        B**2 * 10**2 / d**2 + B**2 * r**2 * 0.5**2 / d**4,
        f**2 * B**2 * 0.5**2 / d**4,
    ]
    assert np.diag(camera.covariance(POINTS[1:2])[0]) == pytest.approx(expected, rel=1e-12)


def test_disparity_error_correlates_x_and_z():
    """0.99 at 1 px, 5 m, 200 px off axis, which the diagonal R of the paper drops."""
    camera = StereoCamera()
    R = camera.covariance(np.array([[200 * 5.0 / camera.focal_px, 0.0, 5.0]]))[0]
    assert R[0, 2] / np.sqrt(R[0, 0] * R[2, 2]) == pytest.approx(0.99, abs=0.006)


def test_non_positive_disparities_are_refused():
    camera = StereoCamera(sigma_disparity_px=5.0)
    sample = camera.measure(np.tile([0.0, 0.0, 20.0], (5000, 1)), np.random.default_rng(0))
    bad = np.isnan(sample).all(axis=1)
    assert 0.2 < bad.mean() < 0.4  # P(N(2.29, 5) <= 0) = 0.32
    assert np.all(sample[~bad, 2] > 0)


def test_laser_noise_and_limits():
    laser = Laser(n_beams=4, sigma_range_m=0.01, max_range_m=10.0, min_range_m=0.1)
    true = np.tile([0.05, 5.0, 9.999, 11.0], (20_000, 1))
    scans = laser.measure(true, np.random.default_rng(0))
    assert scans.dtype == np.float32
    assert np.all(np.isinf(scans[:, [0, 3]]))
    assert np.std(scans[:, 1], dtype=float) == pytest.approx(0.01, rel=0.03)
    assert np.mean(scans[:, 1], dtype=float) == pytest.approx(5.0, abs=3e-4)


def test_beams_are_evenly_spread():
    assert Laser(n_beams=721).bearings_rad[[0, 360, 720]] == pytest.approx(
        [-np.pi / 2, 0, np.pi / 2]
    )
    full = Laser(n_beams=8, fov_rad=2 * np.pi).bearings_rad
    assert np.allclose(np.diff(full), np.pi / 4)
    assert Laser(n_beams=1).bearings_rad.tolist() == [0.0]


def test_lidar_points_have_their_ranges_and_elevations():
    lidar = Lidar3D(n_rings=4, n_azimuths=6)
    ranges = np.full((4, 6), 7.0)
    ranges[0, 0] = np.inf
    points = lidar.points_in_sensor(ranges)
    assert points.shape == (23, 3)
    assert np.linalg.norm(points, axis=1) == pytest.approx(np.full(23, 7.0))
    assert np.arcsin(points[-1, 2] / 7.0) == pytest.approx(lidar.elevation_max_rad)


LASER, STEREO = "sim.sensors.laser.Laser", "sim.sensors.stereo.StereoCamera"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"laser": {"_target_": LASER, "n_beams": 0}}, "n_beams must be a whole number from 1"),
        ({"front": {"_target_": LASER, "n_beans": 7}}, r"unknown key sensors\.front\.n_beans"),
        ({"laser": {"_target_": LASER, "n_beams": "many"}}, "whole number"),
        ({"laser": {"_target_": LASER, "sigma_range_m": float("nan")}}, "sigma_range_m"),
        ({"stereo": {"_target_": STEREO, "selection": "best"}}, "nearest, random, spread"),
        ({"laser": {"_target_": LASER, "mount": {"z": 1}}}, r"sensors\.laser\.mount\.z"),
        (
            {"encoder": {"_target_": "sim.sensors.encoder.Encoder", "rate_hz": -1}},
            "rate_hz",
        ),
        ({"lasr": {}}, r"sensors\.lasr must be a mapping with _target_, such as"),
        ({"laser": 3}, r"sensors\.laser must be a mapping with _target_"),
        ({"laser": {"_target_": "sim.sensors.laser.Lasr"}}, "no class Lasr; did you mean Laser?"),
        ({"laser": {"_target_": "sim.lasers.Laser"}}, r"no module sim\.lasers in the"),
        ({"laser": {"_target_": "Laser"}}, "must name a class"),
        ({"laser": {"_target_": 3}}, "must name a class"),
        ({"laser": {"_target_": "sim.options.build"}}, r"laser\._target_=.* must be a dataclass"),
        ({"laser": {"_target_": "sim.errors.InputError"}}, "must be a dataclass"),
        ({"laser": {"_target_": "sim.robot.drive.RobotGeometry", "wheel_radius_m": 1,
                    "track_m": 1}},
         r"RobotGeometry has no rate_hz; see sim\.sensors\.base"),
        *(
            ({name: {"_target_": LASER}}, "name must be one word of letters and digits")
            for name in ("front laser", "front.laser", "front/laser", "", "1st", "läser", "a\n", 7)
        ),
    ],
)  # fmt: skip
def test_wrong_settings_name_their_key(settings, message):
    with pytest.raises(InputError, match=message) as caught:
        sensors_from_config(settings)
    assert "\n" not in str(caught.value)


def test_sensors_by_any_name_and_none_leaves_one_out():
    sensors = sensors_from_config(
        {"front": {"_target_": LASER, "n_beams": 3}, "rear_2": {"_target_": LASER}, "eye": None}
    )
    assert sensors == {"front": Laser(n_beams=3), "rear_2": Laser()}


def test_a_missing_sensor_is_named():
    sensors = {"laser": Laser(), "stereo": StereoCamera(), "lidar3d": Lidar3D()}
    for name, sensor in sensors.items():
        assert sensor_of(sensors, name, type(sensor)) is sensor
        with pytest.raises(InputError, match=f"no sensor named {name} .there is none.; choose"):
            sensor_of({}, name, type(sensor))
    with pytest.raises(InputError, match="sensor laser is a Laser, not a Lidar3D"):
        sensor_of(sensors, "laser", Lidar3D)


@pytest.mark.parametrize(
    "sensor",
    [
        Encoder(rate_hz=None),
        Gyroscope(),
        Laser(rate_hz=100),
        Lidar3D(),
        PlaceDescriptor(),
        RobotCamera(),
        StereoCamera(),
    ],
    ids=lambda sensor: type(sensor).__name__,
)
def test_settings_make_the_same_sensor(sensor):
    settings = sensor_settings(sensor)
    assert sensors_from_config({"one": settings}) == {"one": sensor}
    assert sensor_settings(sensors_from_config({"one": settings})["one"]) == settings


def test_what_is_only_recorded_cannot_be_simulated():
    with pytest.raises(InputError, match="choose sensors=lidar3d"):
        PlaceDescriptor().start(np.random.default_rng(0))


@pytest.mark.parametrize("kind", [Laser, Lidar3D, RealLaser])
def test_ranges_that_end_before_they_begin_are_refused(kind):
    with pytest.raises(InputError, match=r"min_range_m must be below max_range_m.* got 5 and 5"):
        kind(min_range_m=5.0, max_range_m=5.0)
    assert kind(min_range_m=4.9, max_range_m=5.0).max_range_m == 5.0


@pytest.mark.parametrize("selection", ["nearest", "random", "spread"])
def test_a_real_camera_keeps_to_its_most_observations(selection):
    experiment = Experiment.compose(
        ["world=rooms", "sensors=real_camera", "route.distance_m=3", "simulation.physics=kinematic",
         "sensors.stereo.detection_share=1.0", f"sensors.stereo.selection={selection}"]
    )  # fmt: skip
    free = np.diff(experiment.simulate().log("stereo").known_splits)
    most = experiment.with_leaves([(("sensors", "stereo", "max_observations"), 2)])
    log = most.simulate().log("stereo")
    assert free.max() > 2
    assert np.array_equal(np.diff(log.known_splits), np.minimum(free, 2))
    if selection == "nearest":
        depths = np.linalg.norm(log["points_in_camera"], axis=1).reshape(-1)
        assert (
            depths.mean()
            < np.linalg.norm(experiment.simulate().log("stereo")["points_in_camera"], axis=1).mean()
        )
    with pytest.raises(InputError, match="no effect on a RealCamera"):
        RealCamera(sigma_view_descriptor=0.1)
