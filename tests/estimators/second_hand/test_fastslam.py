"""FastSLAM of gil2008, sec. IV, written out in plain NumPy from the paper, step by step.

The product's draws are recorded and given to the written-out filter too; nothing else is shared.
Two misprints are read as in docs/papers.md: eq. (8) is (I - K G) Sigma, eq. (18) the information.
"""

import math

import numpy as np
import pytest

from estimators.landmarks.fastslam import FastSLAM
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

M = 12
PRINTED = {
    "proposal": "motion",
    "resampling": "multinomial",
    "ess_share": 1.0,
    "noise_model": "diagonal",
    "noise_at": "measured",
    "keep_map": True,
}


class Tape:
    """A generator that keeps what it gives."""

    def __init__(self, seed):
        self._rng, self.normals, self.uniforms = np.random.default_rng(seed), [], []

    def standard_normal(self, size=None, out=None):
        drawn = self._rng.standard_normal(size, out=out)
        self.normals.append(drawn.copy())
        return drawn

    def random(self, n):
        self.uniforms.append(self._rng.random(n))
        return self.uniforms[-1].copy()


class Particle:
    """A pose, the means and covariances of its landmarks, and the sum of its log weights."""

    def __init__(self, pose, means=None, covariances=None, total=0.0):
        self.pose, self.total = np.array(pose), total
        self.means, self.covariances = dict(means or {}), dict(covariances or {})

    def copy(self):
        return Particle(self.pose, self.means, self.covariances, self.total)

    def move(self, ds, z):
        """Sec. IV-A: the wheels' motion, with noise of variance k |ds|, to first order."""
        step = arc(ds) + slope(arc, ds) @ (np.sqrt([KR * abs(ds[0]), KL * abs(ds[1])]) * z)
        c, n = math.cos(self.pose[2]), math.sin(self.pose[2])
        turned = np.array([c * step[0] - n * step[1], n * step[0] + c * step[1], step[2]])
        self.pose = self.pose + turned

    def see(self, number, z):
        """Eqs. (3)-(8) and the log of (13) of a landmark; eqs. (16)-(18) of a new one."""
        R = noise(z)
        if number not in self.means:
            G = slope(lambda x: predicted(self.pose, x), placed(self.pose, z))
            self.means[number] = placed(self.pose, z)
            self.covariances[number] = np.linalg.inv(G.T @ np.linalg.inv(R) @ G)
            return 0.0  # p0 of eq. (19) is the same for all: ids are known
        mean, Sigma = self.means[number], self.covariances[number]
        z_hat = predicted(self.pose, mean)
        G = slope(lambda x: predicted(self.pose, x), mean)
        Z = G @ Sigma @ G.T + R
        K = Sigma @ G.T @ np.linalg.inv(Z)
        v = z - z_hat
        self.means[number] = mean + K @ v
        self.covariances[number] = (np.eye(3) - K @ G) @ Sigma
        return float(-0.5 * math.log(np.linalg.det(2 * np.pi * Z)) - 0.5 * v @ np.linalg.inv(Z) @ v)


def resampled(particles, weights, uniforms):
    """Sec. IV-D: with replacement, by the weights; survivors stay where they are."""
    ends = np.cumsum(weights)
    copies = [0] * M
    for u in uniforms:
        copies[min(int(np.sum(ends / ends[-1] <= u)), M - 1)] += 1
    spare = [m for m in range(M) for _ in range(copies[m] - 1)]
    return [particles[m] if copies[m] else particles[spare.pop(0)].copy() for m in range(M)]


def started(tape, **options):
    filtered = FastSLAM(
        **{**PRINTED, "n_particles": M, "kr": KR, "kl": KL, "window_s": 0.0, **options}
    )
    filtered.reset(prior(np.zeros((3, 3))), tape)
    return filtered


def compare(filtered, tape, frames):
    """Walk both filters; the largest differences of poses, weights and maps."""
    particles, off = [Particle(START) for _ in range(M)], np.zeros(4)
    for frame in frames:
        n_drawn, n_uniform = len(tape.normals), len(tape.uniforms)
        belief = filtered.step(frame)
        z = tape.normals[n_drawn]
        image, gained = frame.readings["stereo"], np.zeros(M)
        for m, particle in enumerate(particles):
            particle.move(frame.wheel_increments_m, z[:2, m])
            for number, point in zip(image["ids"], image["points_in_camera"], strict=True):
                gained[m] += particle.see(number, point)  # the log of eq. (14)
            particle.total += gained[m]
        weights = np.exp(gained - gained.max())
        weights /= weights.sum()
        extras = belief.extras
        theirs = np.exp(extras["log_weights"] - extras["log_weights"].max())
        best = max(particles, key=lambda p: p.total)  # eq. (20)
        numbers = filtered.map["ids"] if len(best.means) else []
        poses = np.array([p.pose for p in particles])
        now = [
            np.abs(extras["particles"] - poses).max(),
            np.abs(theirs / theirs.sum() - weights).max(),
        ]
        now += [np.abs(extras["landmarks"] - [best.means[k] for k in numbers]).max()]
        relative = [best.covariances[k] for k in numbers]
        now += [np.abs(extras["landmark_covariances"] - relative).max() / np.abs(relative).max()]
        off = np.maximum(off, now)
        if len(tape.uniforms) > n_uniform:
            particles = resampled(particles, weights, tape.uniforms[-1])
    return off


@pytest.mark.parametrize("seed", range(3))
def test_each_step_is_the_printed_one(seed):
    tape = Tape(seed)
    filtered, frames = started(tape), drive(seed)
    assert np.all(compare(filtered, tape, frames) < [1e-7, 1e-5, 1e-6, 1e-5])
    assert len(tape.uniforms) > 10


@pytest.mark.parametrize(
    "other", [{"noise_at": "predicted"}, {"noise_model": "correlated"}, {"kr": 2 * KR}]
)
def test_a_filter_that_differs_is_seen(other):
    tape = Tape(0)
    assert not np.all(
        compare(started(tape, **other), tape, drive(0)[:6]) < [1e-7, 1e-5, 1e-6, 1e-5]
    )
