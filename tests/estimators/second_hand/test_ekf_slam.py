"""EKF-SLAM, the classical filter that gil2008 compares with, written out in plain NumPy.

One Gaussian over the pose and all landmarks: predicted by the wheels, corrected by one landmark
after another's stacked rows, augmented by eq. (17). FilterPy's update stands beside, if installed.
"""

import numpy as np
import pytest

from estimators.landmarks.ekf_slam import EkfSlam
from tests.estimators.second_hand.landmark_drive import (
    KL,
    KR,
    START,
    arc,
    drive,
    noise,
    placed,
    predicted,
    prior,
)
from tests.fixtures.derivatives import slope

P0 = np.diag([0.02, 0.02, 0.01]) ** 2
OPTIONS = {
    "kr": KR,
    "kl": KL,
    "window_s": 0.0,
    "noise_model": "diagonal",
    "errors": "coordinates",
}


class Written:
    """The filter; `update` gives mean and covariance after H, v and R."""

    def __init__(self, update):
        self.mean, self.P, self.row_of, self._update = START.copy(), P0.copy(), {}, update

    def step(self, frame):
        """Predict by the wheels, correct by the landmarks in the map, take in the others."""
        ds = frame.wheel_increments_m
        F = slope(lambda x: rolled(x, ds), self.mean)
        W = slope(lambda u: rolled(self.mean, u), ds)
        self.mean = rolled(self.mean, ds)
        self.P = F @ self.P @ F.T + W @ np.diag([KR * abs(ds[0]), KL * abs(ds[1])]) @ W.T
        image = frame.readings["stereo"]
        seen = dict(zip(image["ids"], image["points_in_camera"], strict=True))
        known = {k: z for k, z in seen.items() if k in self.row_of}
        if known:
            rows = [self.row_of[k] for k in known]
            h = lambda x: np.concatenate([predicted(x[:3], x[r : r + 3]) for r in rows])  # noqa: E731
            R = np.zeros((3 * len(known), 3 * len(known)))
            for i, at in enumerate(h(self.mean).reshape(-1, 3)):
                R[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = noise(at)
            v = np.concatenate(list(known.values())) - h(self.mean)
            self.mean, self.P = self._update(self.mean, self.P, slope(h, self.mean), v, R)
        for k in seen.keys() - known.keys():
            self.take_in(k, seen[k])

    def take_in(self, number, z):
        """Add a landmark with its correlations."""
        J = slope(lambda x: placed(x, z), self.mean)
        C = slope(lambda u: placed(self.mean, u), z)
        own = J @ self.P @ J.T + C @ noise(z) @ C.T
        self.P = np.block([[self.P, self.P @ J.T], [J @ self.P, own]])
        self.row_of[number] = len(self.mean)
        self.mean = np.append(self.mean, placed(self.mean, z))


def rolled(x, ds):
    step, c, s = arc(ds), np.cos(x[2]), np.sin(x[2])
    moved = [c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]]
    return np.concatenate([x[:3] + moved, x[3:]])


def textbook(mean, P, H, v, R):
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return mean + K @ v, (np.eye(len(P)) - K @ H) @ P


def by_filterpy(mean, P, H, v, R):
    kalman = pytest.importorskip("filterpy.kalman", reason="FilterPy is not installed")
    found = kalman.ExtendedKalmanFilter(len(mean), len(v))
    found.x, found.P, found.R = mean[:, None].copy(), P.copy(), R
    found.update(v[:, None], lambda x: H, lambda x: np.zeros((len(v), 1)))
    return found.x[:, 0], found.P


@pytest.mark.parametrize("update", [textbook, by_filterpy])
@pytest.mark.parametrize("seed", range(2))
def test_each_step_is_the_written_one(update, seed):
    written = Written(update)
    filtered = EkfSlam(**OPTIONS, keep_map=True)
    filtered.reset(prior(P0), np.random.default_rng(0))
    for frame in drive(seed):
        belief = filtered.step(frame)
        written.step(frame)
        np.testing.assert_allclose(belief.mean, written.mean[:3], atol=1e-7)
        np.testing.assert_allclose(belief.covariance, written.P[:3, :3], rtol=1e-5, atol=1e-9)
        for number, at, spread in zip(
            filtered.map["ids"],
            belief.extras["landmarks"],
            belief.extras["landmark_covariances"],
            strict=True,
        ):
            rows = slice(written.row_of[number], written.row_of[number] + 3)
            np.testing.assert_allclose(at, written.mean[rows], atol=1e-6)
            np.testing.assert_allclose(spread, written.P[rows, rows], rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize(
    "other", [{"noise_at": "measured"}, {"kr": 2 * KR}, {"errors": "invariant"}]
)
def test_a_filter_that_differs_is_seen(other):
    written = Written(textbook)
    options = OPTIONS | other
    filtered = EkfSlam(**options)
    filtered.reset(prior(P0), np.random.default_rng(0))
    for frame in drive(0, 6):
        belief = filtered.step(frame)
        written.step(frame)
    assert np.abs(belief.mean - written.mean[:3]).max() > 1e-6
