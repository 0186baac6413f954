"""A drive among landmarks with a stereo camera, by gil2008, eqs. (3), (9)-(12) and (17).

Worked out here from the paper; of the product only the types that its filters read are used.
"""

import math

import numpy as np

from estimators.base import Prior
from sim.recording import Frame
from sim.robot.drive import RobotGeometry
from sim.sensors import Mount, StereoCamera

TRACK_M, KR, KL = 0.4, 4e-4, 6e-4
FOCAL_PX, BASELINE_M, HEIGHT_M = 381.0, 0.12, 0.6
SIGMA_PX = np.array([1.0, 1.5, 0.5])  # column, row, disparity
START = np.array([0.2, -0.3, 0.4])


def arc(ds):
    """Motion of base_link by wheel increments (right, left), along a circle."""
    turn, way = (ds[0] - ds[1]) / TRACK_M, (ds[0] + ds[1]) / 2.0
    if turn == 0.0:
        return np.array([way, 0.0, 0.0])
    return np.array([way / turn * math.sin(turn), way / turn * (1.0 - math.cos(turn)), turn])


def predicted(s, landmark):
    """g of eq. (3): the landmark in the camera, X right, Y down, Z ahead."""
    c, n = math.cos(s[2]), math.sin(s[2])
    dx, dy = landmark[:2] - s[:2]
    return np.array([n * dx - c * dy, HEIGHT_M - landmark[2], c * dx + n * dy])


def placed(s, z):
    """g^-1 of eq. (17)."""
    c, n = math.cos(s[2]), math.sin(s[2])
    return np.array([s[0] + c * z[2] + n * z[0], s[1] + n * z[2] - c * z[0], HEIGHT_M - z[1]])


def noise(z):
    """R of eqs. (10)-(12) at a point z = (X, Y, Z), by its pixels of eq. (9)."""
    d = FOCAL_PX * BASELINE_M / z[2]
    column, row = z[0] * d / BASELINE_M, z[1] * d / BASELINE_M  # from the principal point
    var_c, var_r, var_d = SIGMA_PX**2
    B2 = BASELINE_M**2
    return np.diag(
        [
            B2 * var_c / d**2 + B2 * column**2 * var_d / d**4,
            B2 * var_r / d**2 + B2 * row**2 * var_d / d**4,
            FOCAL_PX**2 * B2 * var_d / d**4,
        ]
    )


def drive(seed, n=25):
    """Frames of a drive among landmarks, an image each."""
    rng = np.random.default_rng([seed, 5])
    landmarks = np.column_stack([rng.uniform(-6, 6, (40, 2)), rng.uniform(0.1, 1.5, 40)])
    pose, frames = START.copy(), []
    for i in range(n):
        true_ds = rng.uniform(0.05, 0.15, 2) if i else np.zeros(2)
        step, c, s = arc(true_ds), math.cos(pose[2]), math.sin(pose[2])
        pose = pose + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])
        seen = np.array([predicted(pose, at) for at in landmarks])
        ids = np.flatnonzero((seen[:, 2] > 0.8) & (np.abs(seen[:, 0]) < seen[:, 2]))
        points = [seen[k] + np.sqrt(np.diag(noise(seen[k]))) * rng.standard_normal(3) for k in ids]
        image = {
            "points_in_camera": np.array(points).reshape(-1, 3),
            "ids": ids,
            "descriptors": np.zeros((len(ids), 0), np.float32),
        }
        logged = true_ds + np.sqrt([KR, KL] * np.abs(true_ds)) * rng.standard_normal(2)
        frames.append(Frame(float(i), 1.0 if i else 0.0, logged, {"stereo": image}))
    return frames


def prior(covariance):
    """The start, and the camera that `drive` has."""
    camera = StereoCamera(
        focal_px=FOCAL_PX,
        baseline_m=BASELINE_M,
        sigma_column_px=SIGMA_PX[0],
        sigma_row_px=SIGMA_PX[1],
        sigma_disparity_px=SIGMA_PX[2],
        mount=Mount(z_m=HEIGHT_M),
    )
    return Prior(RobotGeometry(0.1, TRACK_M), {"stereo": camera}, START, covariance)
