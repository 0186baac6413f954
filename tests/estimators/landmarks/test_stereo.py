"""The stereo camera as a filter sees it."""

import math

import numpy as np
import pytest

from estimators.landmarks.stereo import StereoModel
from sim.sensors import Mount, StereoCamera
from sim.sensors.stereo import points_in_camera

CAMERA = StereoCamera(mount=Mount(x_m=0.3, y_m=-0.1, z_m=0.6, yaw_rad=0.4))
POSE = np.array([1.0, -2.0, 0.7])
LANDMARKS = np.array([[4.0, 3.0, 1.2], [6.0, 0.5, 0.1], [2.0, 2.0, 0.6]])


def finite_difference(function, at, step=1e-6):
    columns = [(function(at + d) - function(at - d)) / (2 * step) for d in step * np.eye(len(at))]
    return np.stack(columns, axis=-1)


def test_prediction_is_the_simulators():
    model = StereoModel.of(CAMERA)
    points, _, _ = model.predict(POSE, LANDMARKS)
    assert np.allclose(points, points_in_camera(CAMERA, POSE, LANDMARKS), atol=1e-12)
    assert np.allclose(model.place(POSE, points), LANDMARKS, atol=1e-12)


def test_jacobians_match_finite_differences():
    model = StereoModel.of(CAMERA)
    for landmark in LANDMARKS:
        _, by_pose, by_landmark = model.predict(POSE, landmark)
        numeric = finite_difference(lambda s, at=landmark: model.predict(s, at)[0], POSE)
        assert np.allclose(by_pose, numeric, atol=1e-7)
        numeric = finite_difference(lambda at: model.predict(POSE, at)[0], landmark)
        assert np.allclose(by_landmark, numeric, atol=1e-7)


@pytest.mark.parametrize("correlated", [True, False])
def test_covariance_is_the_sensors(correlated):
    camera = StereoCamera(
        sigma_column_px=3.0, sigma_row_px=2.0, sigma_disparity_px=0.4, correlated=correlated
    )
    model = StereoModel.of(camera, "correlated" if correlated else "diagonal")
    points = np.array([[1.0, -0.5, 4.0], [-2.0, 0.3, 9.0]])
    assert np.allclose(model.covariance(points), camera.covariance(points), rtol=1e-12)


def test_covariance_is_what_the_noisy_image_makes():
    model = StereoModel.of(StereoCamera(sigma_disparity_px=0.02), "image")
    point = np.array([1.0, -0.5, 4.0])
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((200_000, 3)) * np.sqrt(model.variances_px2)
    column, row, disparity = (model.to_image(point) + noise).T
    rays = np.column_stack([column, row, np.full(len(row), model.focal_px)])
    seen = rays * (model.baseline_m / disparity)[:, None]
    assert np.allclose(np.cov(seen.T), model.covariance(point), rtol=0.02, atol=1e-6)


def test_one_factor_makes_the_innovation_that_of_the_image():
    model = StereoModel.of(StereoCamera(), "image")
    predicted, measured = np.array([1.0, -0.4, 5.0]), np.array([1.3, -0.5, 6.5])
    D = finite_difference(model.to_image, predicted)
    expected = np.linalg.solve(D, model.to_image(measured) - model.to_image(predicted))
    v, R = model.innovation(predicted, measured)
    assert np.allclose(v, expected, rtol=1e-7)
    assert np.allclose(D @ R @ D.T, np.diag(model.variances_px2), rtol=1e-6, atol=1e-8)
    # the densities over the image and over space differ by the derivative at the measurement
    at_measured = finite_difference(model.to_image, measured)
    factor = (measured[2] / predicted[2]) ** 8
    ratio = np.linalg.det(D) ** 2 / np.linalg.det(at_measured) ** 2
    assert factor == pytest.approx(ratio, rel=1e-6)


def test_where_the_noise_is_taken():
    predicted, measured = np.array([0.5, 0.0, 5.0]), np.array([0.6, 0.0, 6.0])
    at = {
        name: StereoModel.of(StereoCamera(), "correlated", name).innovation(predicted, measured)[1]
        for name in ("predicted", "measured")
    }
    assert at["measured"][2, 2] / at["predicted"][2, 2] == pytest.approx((6.0 / 5.0) ** 4)


def test_useless_measurements_are_refused():
    model = StereoModel.of(StereoCamera())
    points = [[0.0, 0.0, 3.0], [0, 0, 0], [1.0, 0.0, -2.0], [math.nan, 0.0, 2.0], [0, 0, 1e5]]
    assert model.usable(points).tolist() == [True, False, False, False, False]
    assert model.usable(np.zeros((0, 3))).tolist() == []


def test_camera_decides_unless_told():
    assert StereoModel.of(StereoCamera(correlated=True)).in_image
    paper = StereoModel.of(StereoCamera(correlated=False))
    assert not paper.in_image
    assert not paper.correlated
