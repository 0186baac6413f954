"""Estimators that look where they should not: what they gain, and that `estima conform` says so."""

import dataclasses
import gc
import sys

import numpy as np
import pytest

import experiments.gate.conform as conform
from estimators.base import Belief, run
from estimators.odometry import Odometry
from experiments.gate.conform import check_estimator, example
from sim.recording import Recording, Truth


@pytest.fixture(scope="module")
def case():
    return example()


class Base(Odometry):
    """Dead reckoning that adds a millionth of what it finds, where it finds something."""

    def __init__(self):
        super().__init__(kr=1e-5, kl=1e-5)

    def reset(self, prior, rng):
        super().reset(prior, rng)
        self.prior, self.rng = prior, rng

    def step(self, frame):
        belief = super().step(frame)
        found = np.nan_to_num(np.sum(self.look(frame)), posinf=0.0)
        return Belief(belief.mean + 1e-6 * found, belief.covariance)


class ReadsBase(Base):
    def look(self, frame):
        arrays = [v for reading in frame.readings.values() for v in reading.values()]
        logs = [v.base for v in arrays if isinstance(getattr(v, "base", None), np.ndarray)]
        return sum(float(np.nan_to_num(log[-1], posinf=0.0).sum()) for log in logs)


class ReadsTour(Base):
    def look(self, frame):
        return self.prior.map.waypoints[:1].sum()


class ReadsStart(Base):
    def look(self, frame):
        return self.prior.map.start_pose


class ReadsSeed(Base):
    def look(self, frame):
        return self.rng.bit_generator.seed_seq.entropy % 1000


class SearchesMemory(Base):
    def look(self, frame):
        found = [one for one in gc.get_objects() if type(one) is Truth]
        return sum({float(np.sum(truth.poses[-1])) for truth in found})


class SearchesLogs(Base):
    def look(self, frame):
        found = [one for one in gc.get_objects() if type(one) is Recording]
        # whatever their order, and however often each is in memory; without return, none counts
        scans = [one.log("laser")["ranges_m"] for one in found if "laser" in one.logs]
        ahead_m = {ranges_m[-1, ranges_m.shape[1] // 2] for ranges_m in scans}
        return sum(one for one in ahead_m if np.isfinite(one))


class ClimbsTheStack(Base):
    def look(self, frame):
        above = sys._getframe()
        while above is not None:
            for value in list(above.f_locals.values()):
                if isinstance(value, Recording):
                    return value.truth.poses[-1]
            above = above.f_back
        return 0.0


class Spoils(Base):
    def look(self, frame):
        for reading in frame.readings.values():
            for values in reading.values():
                log = getattr(values, "base", None)
                if isinstance(log, np.ndarray) and log.dtype.kind == "f":
                    log.setflags(write=True)
                    log[-1] = 0.0
        return 0.0


CHEATS = {
    ReadsBase: "readings to come",
    ReadsTour: "tour of its map",
    ReadsStart: "start pose",
    ReadsSeed: "seed sequence",
    SearchesMemory: "truth in memory",
    SearchesLogs: "readings to come",
    ClimbsTheStack: "truth in memory",
    Spoils: "changes the log",
}


@pytest.mark.slow
@pytest.mark.parametrize("cheat", CHEATS)
def test_conform_names_the_way_that_a_cheat_takes(cheat, case):
    recording, prior = case
    own = dataclasses.replace(
        recording,
        logs={
            name: dataclasses.replace(log, values={k: v.copy() for k, v in log.values.items()})
            for name, log in recording.logs.items()
        },
    )
    before = recording.checksum
    results = {one.name: one for one in check_estimator(cheat, own, prior, n_frames=4)}
    assert CHEATS[cheat] in results["only its Frames"].message
    assert dataclasses.replace(recording).checksum == before


def test_an_honest_one_is_not_accused(case):
    class Honest(Base):
        def look(self, frame):
            return self.rng.spawn(1)[0].random()

    results = {one.name: one for one in check_estimator(Honest, *case, n_frames=20)}
    assert results["only its Frames"].passed


@pytest.mark.parametrize("cheat", [ReadsBase, ReadsTour, ReadsStart, Spoils])
def test_in_a_run_nothing_is_there(cheat, case):
    """Beliefs are those of dead reckoning, and the recording stays as it is."""
    recording, prior = case
    recording = recording.cut(20)
    before = dataclasses.replace(recording).checksum
    prior = dataclasses.replace(prior, mean=np.zeros(3))
    plain = run(Odometry(kr=1e-5, kl=1e-5), recording, prior, np.random.default_rng(0))
    cheated = run(cheat(), recording, prior, np.random.default_rng(0))
    assert np.array_equal(cheated.means, plain.means)
    assert dataclasses.replace(recording).checksum == before


class Walker(Base):
    """Walks from its Frame, prior and generator to every array that attributes lead to."""

    arrays, seeds = [], []

    def look(self, frame):
        stack, seen = [frame, self.prior, self.rng], set()
        while stack:
            one = stack.pop()
            if id(one) in seen or isinstance(one, type):
                continue
            seen.add(id(one))
            if isinstance(one, np.ndarray):
                self.arrays.append(one)
                stack.append(one.base)
            elif isinstance(one, int):
                self.seeds.append(one)
            elif isinstance(one, dict):
                stack += [*one.keys(), *one.values()]
            elif isinstance(one, (list, tuple, set)):
                stack += one
            elif isinstance(one, np.random.Generator):
                stack.append(one.bit_generator.seed_seq)
            elif isinstance(one, np.random.SeedSequence):
                stack += [one.entropy, one.spawn_key]
            else:
                stack += vars(one).values() if hasattr(one, "__dict__") else ()
        return 0.0


def test_no_walk_leads_to_the_recording(case):
    from experiments.runs.seeds import stream
    from sim.recording import arrays_of

    recording, prior = case
    recording = recording.cut(20)
    Walker.arrays, Walker.seeds = [], []
    run(Walker(), recording, prior, stream(123_456_789, "estimator/walker"))
    logs = arrays_of(recording)
    assert len(Walker.arrays) > 40
    for found in Walker.arrays:
        assert not any(np.shares_memory(found, array) for array in logs.values())
        assert found.shape != recording.truth.poses.shape
    assert 123_456_789 not in Walker.seeds
    planted = stream(123_456_789, "estimator/walker").bit_generator.seed_seq
    assert planted.entropy == 123_456_789  # what the walk would find without `detach`


def test_what_an_estimator_writes_to_its_prior_stays_its_own(case):
    recording, prior = case

    class Scribbles(Base):
        def look(self, frame):
            for array in (self.prior.mean, self.prior.covariance, self.prior.map.walls):
                array.setflags(write=True)
                array[:] = 9.0
            object.__setattr__(self.prior.sensors["laser"], "sigma_range_m", 9.0)
            return 0.0

    before = prior.mean.copy(), prior.map.walls.copy(), prior.sensors["laser"].sigma_range_m
    run(Scribbles(), recording.cut(20), prior, np.random.default_rng(0))
    assert np.array_equal(before[0], prior.mean)
    assert np.array_equal(before[1], prior.map.walls)
    assert before[2] == prior.sensors["laser"].sigma_range_m


def test_the_numbers_drawn_stay_and_the_seed_is_hidden(case):
    from estimators.base import detach

    recording, prior = case
    given, plain = np.random.default_rng(5), np.random.default_rng(5)
    _, own = detach(prior, given, recording)
    assert np.array_equal(own.random(9), plain.random(9))
    entropy = own.bit_generator.seed_seq.entropy
    assert entropy.bit_length() > 128
    _, other = detach(prior, given, dataclasses.replace(recording, status="other"))
    assert other.bit_generator.seed_seq.entropy != entropy  # the truth counts too


class KnowsTruth(Odometry):
    """The truth with a little noise, by the start that it is given."""

    sigma, drives = 1e-3, []

    def reset(self, prior, rng):
        super().reset(prior, rng)
        starts = [np.abs(of_drive.mean - prior.mean).max() for _, of_drive in self.drives]
        recording, _ = self.drives[int(np.argmin(starts))]
        self.truth = iter(recording.truth_at(recording.frame_stamps))
        self.rng = rng

    def step(self, frame):
        mean = next(self.truth) + self.sigma * self.rng.standard_normal(3)
        return Belief(mean, self.sigma**2 * np.eye(3))


@pytest.mark.parametrize(("sigma", "called"), [(1e-3, True), (0.1, False)])
def test_errors_below_the_bound_are_called(monkeypatch, sigma, called):
    drives = [conform._drive((), seed) for seed in range(5)]
    monkeypatch.setattr(KnowsTruth, "drives", drives)
    monkeypatch.setattr(KnowsTruth, "sigma", sigma)
    found = conform.find_below_bound(lambda: KnowsTruth(kr=1e-5, kl=1e-5), drives)
    assert ("times the least of any honest method" in found.message) is called
    assert found.passed is not called
    assert conform.find_below_bound(lambda: Odometry(kr=1e-5, kl=1e-5), drives).message == "ok"
