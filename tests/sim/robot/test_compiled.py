"""What a user reads while code is compiled, and clocks that stand still meanwhile."""

import time

import numpy as np
from numba import njit

from estimators.base import Belief
from experiments.runs.evaluate import run_over
from sim.compiled import _Announcer, _Clock
from tests.fixtures.fakes import circle, tracking_prior


def test_a_process_says_it_once(capsys):
    for _ in range(2):
        one = _Announcer()
        one.on_start()
        one.on_start()
    assert capsys.readouterr().err.count("compiling") == 2


def test_where_it_is_noted_nothing_is_said(tmp_path, capsys):
    one, note = _Announcer(), tmp_path / "compiling"
    for one.note in (note, tmp_path / "gone" / "compiling"):
        one.on_start()
        one.on_end()
    assert note.exists()
    assert not capsys.readouterr().err


def test_a_clock_stands_still_until_the_last_lock_is_given_back():
    now = [10.0]
    clock = _Clock(lambda: now[0])
    for step in (clock.on_start, clock.on_start, clock.on_end, clock.on_end):
        step()
        now[0] += 1.0
    assert clock() == 11.0


class Compiles:
    """An estimator that stays where it is, and compiles something at its first Frame."""

    def reset(self, prior, rng):
        self.prior, self.function = prior, njit(lambda a: np.sqrt(a).max() + a[::2].sum())

    def step(self, frame):
        self.function(np.ones(3))
        return Belief(self.prior.mean, self.prior.covariance)


def test_the_times_of_a_run_are_without_compiling():
    recording = circle(n_frames=3)
    begun = time.process_time()
    online, _ = run_over(recording, Compiles(), tracking_prior(recording), np.random.default_rng(0))
    spent_s = time.process_time() - begun
    assert 0.0 < online.cpu_seconds < 0.5 * spent_s
    assert 0.0 < online.step_seconds.sum() < 0.5 * spent_s
