"""The checks pass dead reckoning, and each fault planted below fails exactly its own check."""

import numpy as np
import pytest
from hydra.errors import MissingConfigException

from estimators.base import Belief
from estimators.laser.icp_odometry import IcpOdometry
from estimators.odometry import Odometry
from experiments.gate.conform import check_estimator, conform_target, example
from experiments.runs.paths import option_names
from sim import se2
from sim.errors import InputError
from tests.fixtures import fakes


@pytest.fixture(scope="module")
def case():
    return example()


def failed(make, case):
    return {result.name for result in check_estimator(make, *case) if not result.passed}


def test_dead_reckoning_conforms(case):
    assert failed(lambda: Odometry(kr=1e-5, kl=1e-5), case) == set()
    recording = fakes.circle()
    assert (
        failed(lambda: Odometry(kr=1e-5, kl=1e-5), (recording, fakes.tracking_prior(recording)))
        == set()
    )


class Base(Odometry):
    def __init__(self):
        super().__init__(kr=1e-5, kl=1e-5)


class NotFinite(Base):
    def step(self, frame):
        belief = super().step(frame)
        return belief if frame.stamp < 4 else Belief(belief.mean, np.full((3, 3), np.inf))


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
        scan = frame.readings.get("laser")
        if scan is not None and scan["ranges_m"].flags.writeable:
            scan["ranges_m"][0] = 0.0
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


class Unsure(Base):
    def step(self, frame):
        belief = super().step(frame)
        return Belief(belief.mean, belief.covariance, {"lost": float("nan")})


class Silent(Base):
    needs = frozenset({"laser"})


class Misspelt(Base):
    needs = frozenset({"lasers"})


@pytest.mark.parametrize(
    ("cls", "checks"),
    [
        (NotFinite, {"finite"}),
        (Lopsided, {"covariance"}),
        (Negative, {"covariance"}),
        (Unsure, {"lost"}),
        (OwnRandomness, {"same seed, same bits", "causal", "reset"}),
        (Meddler, {"frames untouched"}),
        (Forgetful, {"reset"}),
        (EastBound, {"equivariant"}),
        (Silent, {"missing sensor"}),
        (Misspelt, {"missing sensor"}),
    ],
)
def test_each_fault_fails_its_check(cls, checks, case):
    # Randomness of one's own shows in every check that compares runs; the others fail one each.
    assert failed(cls, case) - ({"equivariant"} if cls is OwnRandomness else set()) == checks


class Careful(Base):
    """Needs everything that can be taken away, and says so when it is."""

    needs = frozenset({"laser", "stereo", "map"})

    def reset(self, prior, rng):
        super().reset(prior, rng)
        for name, there in (
            ("laser", prior.sensors.get("laser")),
            ("stereo", prior.sensors.get("stereo")),
            ("map", prior.map),
        ):
            if there is None:
                raise InputError(f"this estimator needs a {name}")


class Waiting(Base):
    """Trusts the prior's word on its sensors, and complains when no scan has come."""

    needs = frozenset({"laser"})

    def reset(self, prior, rng):
        super().reset(prior, rng)
        self._scans, self._frames = 0, 0

    def step(self, frame):
        self._frames += 1
        self._scans += "laser" in frame.readings
        if self._frames > 20 and self._scans == 0:
            raise InputError("20 Frames without a scan; is the laser on?")
        return super().step(frame)


def test_a_clear_error_for_each_missing_need_passes(case):
    assert failed(Careful, case) == set()
    assert failed(Waiting, case) == set()


class Scattered(Base):
    """A global search: its end is drawn with each seed, true in distribution only."""

    global_or_grid = True
    sigma = np.array([0.2, 0.2, 0.1])
    east_m = 0.0

    def reset(self, prior, rng):
        super().reset(prior, rng)
        self._offset = self.sigma * rng.standard_normal(3)

    def step(self, frame):
        belief = super().step(frame)
        mean = se2.compose(belief.mean, self._offset) + np.array([self.east_m, 0, 0])
        return Belief(mean, belief.covariance)


class ScatteredEast(Scattered):
    east_m = 1.0


class ScatteredByPlace(Scattered):
    """Surer of itself in one half of the plane."""

    def reset(self, prior, rng):
        super().reset(prior, rng)
        self._offset *= 5.0 if prior.mean[1] < 0.0 else 1.0


def test_global_ones_are_compared_in_distribution(case):
    assert failed(Scattered, case) == set()
    assert failed(ScatteredEast, case) == {"equivariant"}
    assert failed(ScatteredByPlace, case) == {"equivariant"}


def test_headings_at_the_seam_do_not_look_scattered():
    from experiments.gate.conform import _differ

    rng = np.random.default_rng(0)
    draws = np.array([0.0, 0.0, np.pi]) + 0.05 * rng.standard_normal((60, 3))
    draws[:, 2] = se2.wrap(draws[:, 2])
    assert _differ(draws[:30], draws[30:]) == ""
    assert "heading" in _differ(draws[:30], draws[30:] + np.array([0, 0, 0.2]))


def test_a_map_that_cannot_be_moved_is_refused(case):
    import dataclasses

    recording, prior = case
    results = check_estimator(Base, recording, dataclasses.replace(prior, map=[1, 2]))
    messages = [r.message for r in results if not r.passed]
    assert len(messages) == 1
    assert "moved(T_new_old)" in messages[0]


class Peeker(Base):
    """Knows how long the recording is: it reads ahead through a handle it should not have."""

    recording = None

    def step(self, frame):
        belief = super().step(frame)
        return Belief(belief.mean, belief.covariance * len(self.recording.frame_stamps))


def test_looking_ahead_is_caught(case, monkeypatch):
    import experiments.gate.conform as conform

    plain = conform.walk

    def walk(estimator, recording, prior, seed=0):
        estimator.recording = recording
        return plain(estimator, recording, prior, seed)

    monkeypatch.setattr(conform, "walk", walk)
    assert "causal" in failed(Peeker, case)


def test_targets_by_name():
    results = conform_target("estimators.odometry.Odometry", ["kr=1e-5", "kl=1e-5"])
    assert all(result.passed for result in results)
    with pytest.raises(InputError, match="MODULE:CLASS"):
        conform_target("estimators.odometry", [])
    with pytest.raises(MissingConfigException, match="nowhere"):
        conform_target("nowhere", [])
    with pytest.raises(InputError, match="PYTHONPATH"):
        conform_target("nowhere.to:Be", [])
    with pytest.raises(InputError, match="key=value"):
        conform_target("estimators.odometry:Odometry", ["kr"])


def test_the_sensors_can_be_chosen():
    """And an estimator reads, and misses, the one that its option names."""
    rear = "{_target_: sim.sensors.laser.Laser, n_beams: 91, rate_hz: 10, mount: {yaw_rad: 3.1}}"
    given = ["sensors=hokuyo", f"+sensors.rear={rear}", "estimator.laser=rear"]
    results = conform_target("icp_odometry", given)
    assert [f"{r.name}: {r.message}" for r in results if not r.passed] == []
    recording, prior = example(given[:2])
    assert {"laser", "rear"} <= recording.logs.keys()
    assert prior.sensors == recording.sensors
    with pytest.raises(InputError, match="no sensor named side"):
        IcpOdometry(laser="side").reset(prior, np.random.default_rng(0))


OPTIONS = option_names("estimator")
OPTIONS = [name for name in OPTIONS if not name.endswith("_tuned")]  # other values only
DEAR = ("graph_slam", "mcl", "peers/", "topological_mcl")
FEWER = {
    "mcl": ["estimator.max_particles=1000", "estimator.min_particles=300"],  # particles; else 20 s
    **fakes.PROGRAMS,
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * name.startswith(DEAR)) for name in OPTIONS],
)
def test_every_option_conforms(name):
    with fakes.peers_may_be_missing():
        results = conform_target(name, FEWER.get(name, []))
    assert [f"{r.name}: {r.message}" for r in results if not r.passed] == []
