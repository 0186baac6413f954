"""Planted faults change what they should, leave nothing behind, and are graded by what they do."""

import dataclasses
from contextlib import nullcontext
from functools import cache

import numpy as np
import pandas as pd
import pytest

from estimators.base import run
from experiments.gate import power
from experiments.gate.faults import FAULTS
from experiments.gate.power import Pool, arrays, draw_check, grade, worsening
from experiments.gate.suite import ERRORS, Entry, Suite, read_suite, suite_path
from experiments.runs.experiment import Experiment
from tests.fixtures.fakes import circle, place_route, tracking_prior

KINDS = [(name, kind) for name, kinds in FAULTS.items() for kind in kinds]


@cache
def composed(*overrides):
    return Experiment.compose(overrides)


def estimate(name, plant, seed=0):
    """Final pose of an estimator over a circle, and of the smoother's revised trajectory."""
    if name == "topological_mcl":
        recording, prior = place_route()
        recording = recording.cut(25)
    else:
        recording = circle(n_frames=30)
        prior = tracking_prior(recording, with_map=name == "mcl")
    small = {
        "mcl": ["estimator.max_particles=600", "estimator.min_particles=300"],
        "fastslam": ["estimator.n_particles=20"],
        "fastslam_paper": ["estimator.n_particles=20"],
    }
    made = composed(f"estimator={name}", *small.get(name, [])).estimator()
    rng = np.random.default_rng(1)
    with plant(made, np.random.default_rng(seed)):
        found = run(made, recording, prior, rng)
        if name == "smoother":
            found = made.finish()
    return found.means[-5:]


@pytest.mark.parametrize(("name", "kind"), KINDS)
def test_each_fault_changes_the_estimate_and_is_gone_afterwards(name, kind):
    fault, size = FAULTS[name][kind]
    sound = estimate(name, lambda *_: nullcontext())
    faulty = estimate(name, fault(4.0 * min(size, 0.2)))
    assert np.isfinite(faulty).all()
    assert np.abs(faulty - sound).max() > 1e-9
    assert np.array_equal(estimate(name, lambda *_: nullcontext()), sound)


def test_every_estimator_of_the_suite_has_three_kinds_of_faults():
    names = {entry.estimator for entry in read_suite(suite_path("check")).estimators}
    assert names == set(FAULTS)
    assert all(set(kinds) == {"derivative", "lost", "noise"} for kinds in FAULTS.values())


def test_reordered_draws_are_other_draws_of_the_same_law():
    sound = estimate("fastslam", lambda *_: nullcontext())
    assert np.abs(estimate("fastslam", power.reorder_draws) - sound).max() > 1e-9


def rows(errors):
    return pd.DataFrame(
        [
            {"estimator": "e", "recording": i, "repeat": r, **dict.fromkeys(ERRORS, error)}
            for i, row in enumerate(errors)
            for r, error in enumerate(row)
        ]
    )


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("start", [1e-3, 1.0, 50.0])
def test_grading_finds_the_size_of_a_rise(power, start):
    then = np.exp(np.random.default_rng(0).standard_normal((20, 1)))

    def measure(size):
        return rows(then * (1.0 + 0.05 * size**power))

    size, graded = grade(lambda size: size, start, measure, then, "e")
    assert worsening(then, arrays(graded)["e", ERRORS[0]]) == pytest.approx(0.10, abs=0.01)
    assert size == pytest.approx(2.0 ** (1.0 / power), rel=0.25)


def pool(rise, n=60):
    """One estimator that draws at random and one that does not, with a fault in either."""
    rng = np.random.default_rng(0)
    kinds = {"a": (4, 2), "b": (1, 1)}
    entries = tuple(Entry(name=k, recordings="g", repeats=n) for k, n in kinds.items())
    suite = Suite(0, {"g": n}, {"g": ()}, entries)
    hard = np.exp(rng.standard_normal((n, 1)))

    def runs(k, shift=0.0, spread=0.1):
        return hard * np.exp(shift + spread * rng.standard_normal((n, k)))

    sound = {("a", e): runs(16) for e in ERRORS} | {("b", e): hard for e in ERRORS}
    faulty = {
        ("a", "noise"): (1.0, {e: runs(4, rise) for e in ERRORS}),
        ("b", "lost"): (1.0, {e: runs(1, rise, 0.05) for e in ERRORS}),
    }
    return Pool(suite, sound, faulty)


def test_drawn_checks_alarm_at_faults_only():
    made = pool(0.1)
    for fault in (None, ("a", "noise"), ("b", "lost")):
        alarmed = 0
        for i in range(5):
            found = draw_check(made, np.random.default_rng(i), fault)
            assert {f.baseline for f in found} == {"accepted", "release"}
            names = {f.estimator for f in found if f.alarms}
            assert names <= ({fault[0]} if fault else set())
            alarmed += bool(names)
        assert alarmed == (5 if fault else 0)


def test_smallest_worsening_grows_with_the_spread():
    made = pool(0.1)
    fine = power.smallest_detectable(made, ("b", "lost"))
    assert 0.005 < fine < 0.05
    size, of_error = made.faulty["b", "lost"]
    rng = np.random.default_rng(5)
    rough = {e: v * np.exp(0.3 * rng.standard_normal(v.shape)) for e, v in of_error.items()}
    other = dataclasses.replace(made, faulty={("b", "lost"): (size, rough)})
    assert power.smallest_detectable(other, ("b", "lost")) > 1.5 * fine
