"""The wheels' prediction: the exact arc, and the covariance that its docstring states."""

import numpy as np
import pytest

from estimators.wheels import (
    EncoderTickOptions,
    WheelOptions,
    WheelPrediction,
)
from sim.errors import InputError
from sim.options import described
from sim.recording import Frame
from sim.robot.arc import arc_increment, arc_increment_jacobian

TRACK_M = 0.3


def frame(right_m, left_m, duration_s=0.1):
    return Frame(0.0, duration_s, np.array([right_m, left_m]))


@pytest.mark.parametrize("travel_m", [(0.1, 0.08), (-0.02, 0.05), (0.0, 0.03)])
def test_covariance_is_slip_ticks_and_sideways_slip(travel_m):
    believed = EncoderTickOptions(kr=1e-4, kl=3e-4, lateral_slip_m=2e-5, encoder_tick_m=1e-3)
    wheels = WheelPrediction(believed, TRACK_M)
    motion, _, root = wheels.predict_in_full(frame(*travel_m))
    travel_m = np.array(travel_m)
    G = arc_increment_jacobian(travel_m, TRACK_M)
    variances = np.abs(travel_m) * [1e-4, 3e-4] + (travel_m != 0.0) * 1e-6 / 6.0
    np.testing.assert_allclose(motion.mean, arc_increment(travel_m, TRACK_M), atol=1e-15)
    np.testing.assert_allclose(root @ root.T, G @ np.diag(variances) @ G.T, atol=1e-18)
    sideways = np.diag([0.0, 2e-5 * np.abs(travel_m).mean(), 0.0])
    np.testing.assert_allclose(motion.covariance, root @ root.T + sideways, atol=1e-18)


def test_what_both_wheels_slip_together_does_not_turn():
    wheels = WheelPrediction(WheelOptions(forward_slip_m=5e-3), TRACK_M)
    motion, _, root = wheels.predict_in_full(frame(0.1, 0.1))
    alone = WheelPrediction(WheelOptions(), TRACK_M)
    more = motion.covariance - alone.predict(frame(0.1, 0.1)).covariance
    np.testing.assert_allclose(more, np.diag([5e-3 * 0.1, 0.0, 0.0]), atol=1e-18)
    np.testing.assert_allclose(root @ root.T, motion.covariance, atol=1e-18)


def test_travel_is_netted_over_the_window():
    wheels = WheelPrediction(WheelOptions(window_s=0.2), TRACK_M)
    wheels.slip(frame(0.01, 0.01))
    travel_m, variances = wheels.slip(frame(-0.01, -0.01))
    assert travel_m.tolist() == [0.0, 0.0]
    assert variances.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("made", [EncoderTickOptions, WheelOptions])
def test_wrong_options_are_named(made):
    for option in described(made):
        with pytest.raises(InputError, match=rf"^estimator\.{option.name} must be"):
            made(**{option.name: -1.0})
