"""Each check of an option accepts its bounds, and names the key of what it rejects."""

import math
from typing import Literal

import numpy as np
import pytest

from estimators.base import Prior
from estimators.options import (
    require_choices,
    require_counts,
    require_laser,
    require_non_negative,
    require_positive,
    require_shares,
    require_stereo,
    start_pose,
)
from sim.errors import InputError
from sim.robot import RobotGeometry
from sim.sensors import SensorSuite

NUMBERS = {
    require_non_negative: ([0, 0.0, 1e-300, 2], [-1e-300, math.nan, math.inf, None, "1"]),
    require_positive: ([1e-300, 2, np.float64(3.0)], [0, 0.0, -0.0, -1.0, math.nan, math.inf]),
    require_shares: ([0.0, 0.5, 1.0], [-1e-9, 1.0 + 1e-9, math.nan]),
    require_counts: ([1, 5], [0, -1, 2.0, True, None]),
}


@pytest.mark.parametrize("require", NUMBERS)
def test_numbers_within_bounds_pass_and_others_are_named(require):
    allowed, rejected = NUMBERS[require]
    for number in allowed:
        require(sound=1, size=number)
    for number in rejected:
        with pytest.raises(InputError, match=r"^estimator\.size must be .*, got "):
            require(sound=1, size=number)


def test_choices_are_those_of_the_literal():
    kind = Literal["tukey", "huber"]
    require_choices(kernel=("huber", kind))
    with pytest.raises(InputError, match=r"^estimator\.kernel must be one of tukey, huber, got"):
        require_choices(kernel=("flat", kind))
    with pytest.raises(InputError, match=r"^kernel must"):
        require_choices("", kernel=(None, kind))


def test_a_prior_without_what_an_estimator_needs_names_the_estimator():
    bare = Prior(RobotGeometry(0.05, 0.2), SensorSuite())
    for require, word in (
        (start_pose, "start pose"),
        (require_laser, "laser"),
        (require_stereo, "stereo camera"),
    ):
        with pytest.raises(InputError, match=f"^mcl needs a {word}; "):
            require(bare, "mcl")


def test_the_start_pose_is_a_copy():
    prior = Prior(RobotGeometry(0.05, 0.2), SensorSuite(), np.zeros(3), np.eye(3))
    start = start_pose(prior, "mcl")
    start.mean[0], start.covariance[0, 0] = 1.0, 2.0
    assert prior.mean[0] == 0.0
    assert prior.covariance[0, 0] == 1.0
