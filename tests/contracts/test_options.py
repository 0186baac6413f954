"""Each check of an option accepts its bounds, and names the key of what it rejects."""

import dataclasses

import numpy as np
import pytest
from omegaconf import OmegaConf

from estimators.base import Prior
from experiments.runs.paths import packaged
from sim.errors import InputError
from sim.options import described, find
from sim.robot.drive import RobotGeometry
from sim.sensors import Encoder, Laser

_FILES = packaged("conf/estimator").glob("*.yaml")
_TARGETS = {OmegaConf.load(path).get("_target_") for path in _FILES} - {None}
ESTIMATORS = list(
    filter(dataclasses.is_dataclass, (find(name, "estimator") for name in sorted(_TARGETS)))
)


@pytest.mark.parametrize("cls", ESTIMATORS)
def test_every_option_of_an_estimator_is_documented_and_rejects_what_it_does_not_accept(cls):
    for option in described(cls):
        assert option.meaning, option.name
        assert option.accepts not in ("a number", "a whole number"), f"{option.name} has no bound"
        with pytest.raises(InputError, match=rf"^estimator\.{option.name} must be .*, got "):
            cls(**{option.name: object()})


def test_a_prior_without_what_an_estimator_needs_names_the_estimator():
    bare = Prior(RobotGeometry(0.05, 0.2), {})
    with pytest.raises(InputError, match=r"^mcl needs a start pose; "):
        bare.require_start("mcl")
    for require in (bare.require_laser, bare.require_stereo):
        with pytest.raises(
            InputError, match=r"^mcl: no sensor named front .there is none.; choose"
        ):
            require("front", "mcl")


def test_a_sensor_is_found_by_its_name_and_must_be_of_its_kind():
    sensors = {"encoder": Encoder(), "front": Laser(n_beams=3), "rear": Laser(n_beams=5)}
    prior = Prior(RobotGeometry(0.05, 0.2), sensors)
    assert prior.require_laser("rear", "mcl") is sensors["rear"]
    with pytest.raises(InputError, match=r"laser \(there is encoder, front, rear\); choose"):
        prior.require_laser("laser", "mcl")
    with pytest.raises(InputError, match=r"^fastslam: sensor front is a Laser, not a StereoCamera"):
        prior.require_stereo("front", "fastslam")


def test_the_start_pose_is_a_copy():
    prior = Prior(RobotGeometry(0.05, 0.2), {}, np.zeros(3), np.eye(3))
    start = prior.require_start("mcl")
    start.mean[0], start.covariance[0, 0] = 1.0, 2.0
    assert prior.mean[0] == 0.0
    assert prior.covariance[0, 0] == 1.0
