"""The checks pass dead reckoning, and each fault planted below fails exactly its own check."""

import numpy as np
import pytest

from estimators.base import Belief
from estimators.odometry import Odometry
from experiments.conform import check_estimator, conform_target, example
from sim.errors import InputError


@pytest.fixture(scope="module")
def case():
    return example()


def failed(make, case):
    return {result.name for result in check_estimator(make, *case) if not result.passed}


def test_dead_reckoning_conforms(case):
    assert failed(lambda: Odometry(1e-5, 1e-5), case) == set()


class Base(Odometry):
    def __init__(self):
        super().__init__(1e-5, 1e-5)


class NotFinite(Base):
    def step(self, frame):
        belief = super().step(frame)
        return belief if frame.stamp < 1 else Belief(belief.mean, np.full((3, 3), np.inf))


class Lopsided(Base):
    def step(self, frame):
        belief = super().step(frame)
        skew = np.zeros((3, 3))
        skew[0, 1], skew[1, 0] = 1e-6, -1e-6  # stays skew under any turn of the map
        return Belief(belief.mean, belief.covariance + skew)


class Negative(Base):
    def step(self, frame):
        belief = super().step(frame)
        return Belief(belief.mean, belief.covariance - 1e-2 * np.eye(3))


class OwnRandomness(Base):
    source = np.random.default_rng(0)

    def step(self, frame):
        belief = super().step(frame)
        return Belief(belief.mean + 1e-7 * self.source.standard_normal(3), belief.covariance)


class Meddler(Base):
    def step(self, frame):
        belief = super().step(frame)
        if frame.ranges_m is not None and frame.ranges_m.flags.writeable:
            frame.ranges_m[0] = 0.0
        return belief


class Forgetful(Base):
    def __init__(self):
        super().__init__()
        self.runs = 0

    def reset(self, prior, rng):
        super().reset(prior, rng)
        self.runs += 1

    def step(self, frame):
        belief = super().step(frame)
        return Belief(belief.mean, belief.covariance * self.runs)


class EastBound(Base):
    def step(self, frame):
        belief = super().step(frame)
        return Belief(belief.mean + np.array([0.01, 0, 0]), belief.covariance)


class Silent(Base):
    needs = frozenset({"laser"})


@pytest.mark.parametrize(
    ("cls", "checks"),
    [
        (NotFinite, {"finite"}),
        (Lopsided, {"covariance"}),
        (Negative, {"covariance"}),
        (OwnRandomness, {"same seed, same bits", "causal", "reset"}),
        (Meddler, {"frames untouched"}),
        (Forgetful, {"reset"}),
        (EastBound, {"equivariant"}),
        (Silent, {"missing sensor"}),
    ],
)
def test_each_fault_fails_its_check(cls, checks, case):
    found = failed(cls, case)
    if cls is NotFinite:
        found -= {"covariance"}  # which cannot be judged either
    assert checks <= found
    if cls in (Lopsided, Negative, Meddler, Forgetful, EastBound, Silent):
        assert found == checks


class Peeker(Base):
    """Knows how long the recording is: it reads ahead through a handle it should not have."""

    recording = None

    def step(self, frame):
        belief = super().step(frame)
        return Belief(belief.mean, belief.covariance * len(self.recording.frame_stamps))


def test_looking_ahead_is_caught(case, monkeypatch):
    import experiments.conform as conform

    plain = conform.walk

    def walk(estimator, recording, prior, seed=0):
        estimator.recording = recording
        return plain(estimator, recording, prior, seed)

    monkeypatch.setattr(conform, "walk", walk)
    assert "causal" in failed(Peeker, case)


def test_targets_by_name():
    results = conform_target("estimators.odometry:Odometry", ["kr=1e-5", "kl=1e-5"])
    assert all(result.passed for result in results)
    with pytest.raises(InputError, match="MODULE:CLASS"):
        conform_target("estimators.odometry", [])
    with pytest.raises(InputError, match="PYTHONPATH"):
        conform_target("nowhere.to:Be", [])
    with pytest.raises(InputError, match="key=value"):
        conform_target("estimators.odometry:Odometry", [])
