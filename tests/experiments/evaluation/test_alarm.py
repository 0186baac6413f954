"""Losses, alarms, and the curve of those missed against false ones."""

import numpy as np
import pytest

from estimators.base import Estimate
from experiments.evaluation.alarm import (
    WINDOW_S,
    Evidence,
    alarm_curve,
    alarm_signal,
    evidence_of,
    find_losses,
)
from sim.errors import InputError

STAMPS = np.arange(0.0, 60.0, 0.5)


def estimate(errors_m, sigma_m, lost=None):
    means = np.column_stack([errors_m, np.zeros((len(STAMPS), 2))])
    covariances = np.asarray(sigma_m)[:, None, None] ** 2 * np.diag([0.25, 1.0, 1.0])
    return Estimate(STAMPS, means, covariances, extras={} if lost is None else {"lost": lost})


def test_losses_are_long_and_far_enough():
    errors = np.zeros(len(STAMPS))
    errors[[4, 5]] = 3.0  # too short
    errors[20:30], errors[100:], errors[40:60] = 2.0, 2.0, 0.9
    errors[70:80] = np.nan
    np.testing.assert_allclose(find_losses(STAMPS, errors), [[10.0, 14.5], [50.0, 59.5]])


def test_what_a_method_says():
    sigma = np.full(len(STAMPS), 0.3)
    sigma[3] = np.nan
    said = alarm_signal(estimate(0.0 * STAMPS, sigma))
    assert said[0] == pytest.approx(0.3)
    assert np.isinf(said[3])  # it has no pose
    own = [None, *np.linspace(0.0, 1.0, len(STAMPS) - 1)]
    assert alarm_signal(estimate(0.0 * STAMPS, sigma, own))[-1] == 1.0


def test_silence_repeats_what_was_said_last():
    sigma = np.full(len(STAMPS), 0.3)
    own = [None, 0.9, None, 0.1, *[None] * (len(STAMPS) - 4)]
    said = alarm_signal(estimate(0.0 * STAMPS, sigma, own))
    assert said[:5].tolist() == [0.0, 0.9, 0.9, 0.1, 0.1]


@pytest.mark.parametrize("wrong", [np.nan, np.inf, "yes", [0.1, 0.2]])
def test_what_is_no_number_is_refused(wrong):
    """NaN would neither miss a loss nor raise a false alarm."""
    own = [0.0] * (len(STAMPS) - 1) + [wrong]
    with pytest.raises(InputError, match=r"^extra lost at 59\.5 s must be a finite number"):
        alarm_signal(estimate(0.0 * STAMPS, np.full(len(STAMPS), 0.3), own))


def test_a_late_alarm_is_a_miss_and_what_is_near_a_loss_is_not_quiet():
    errors, sigma = np.zeros(len(STAMPS)), np.full(len(STAMPS), 0.1)
    errors[20:60] = 5.0  # 10 to 29.5 s
    sigma[50:] = 2.0  # from 25 s on
    evidence = evidence_of(np.zeros((len(STAMPS), 3)), estimate(errors, sigma))
    np.testing.assert_allclose(evidence.peaks, [0.1])
    np.testing.assert_allclose(evidence.quiet, [2.0])  # from 40 s; 0 s: a warning; 50 s: cut short


def test_curve_of_one_who_knows_and_of_one_who_does_not():
    hours = 3600.0 / WINDOW_S
    knows = Evidence(np.array([5.0, 7.0]), np.full(int(hours), 0.1))
    np.testing.assert_allclose(alarm_curve([knows]), [[5, 0, 0], [7, 0.5, 0], [np.inf, 1, 0]])
    blind = Evidence(np.array([0.1]), np.full(int(hours), 0.1))
    np.testing.assert_allclose(alarm_curve([blind]), [[0.1, 0, hours], [np.inf, 1, 0]])
    both = alarm_curve([knows, blind])
    assert both[0].tolist() == pytest.approx([0.1, 0.0, hours])
    never = Evidence(np.zeros(0), np.zeros(0))
    assert np.isnan(alarm_curve([never])[:, 1:]).all()
