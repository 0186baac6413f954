"""Each check of an option accepts its bounds, and names the key of what it rejects."""

import dataclasses
import hashlib
from dataclasses import MISSING

import numpy as np
import pytest
from omegaconf import OmegaConf

from estimators.base import Prior
from experiments.runs.paths import packaged
from sim import sensors
from sim.errors import InputError
from sim.options import described, find
from sim.robot.drive import DifferentialDrive, RobotGeometry
from sim.sensors import Encoder, Laser

_FILES = packaged("conf/estimator").rglob("*.yaml")
_TARGETS = {OmegaConf.load(path).get("_target_") for path in _FILES} - {None}
ESTIMATORS = list(
    filter(dataclasses.is_dataclass, (find(name, "estimator") for name in sorted(_TARGETS)))
)
SENSORS = [getattr(sensors, name) for name in sensors.__all__]
SENSORS = [cls for cls in SENSORS if hasattr(cls, "schema") and dataclasses.is_dataclass(cls)]


@pytest.mark.parametrize("cls", ESTIMATORS)
def test_every_option_of_an_estimator_is_documented_and_rejects_what_it_does_not_accept(cls):
    for option in described(cls):
        assert option.meaning, option.name
        assert option.accepts not in ("a number", "a whole number"), f"{option.name} has no bound"
        with pytest.raises(InputError, match=rf"^estimator\.{option.name} must be .*, got "):
            cls(**{option.name: object()})


@pytest.mark.parametrize("cls", ESTIMATORS + SENSORS)
def test_no_check_of_several_options_hides_another(cls):
    """`__post_init__` of a class calls that of the next one, which Python does not do by itself."""
    checks = [vars(base)["__post_init__"] for base in cls.__mro__ if "__post_init__" in vars(base)]
    for check in checks[:-1]:
        assert "__post_init__" in check.__code__.co_names, check.__qualname__


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


def digest_of_defaults(options):
    defaults = sorted((o.name, repr(o.default)) for o in options if o.default is not MISSING)
    return hashlib.sha256(repr(defaults).encode()).hexdigest()[:8]


# A default decides results: who changes one says so in CHANGELOG.md, and here.
DEFAULTS = {
    "DifferentialDrive": "4c424886",
    "EkfIcp": "0a9f9bed",
    "EkfIcpPaper": "ef960ab5",
    "EkfSlam": "8f62fa03",
    "Encoder": "9c7c1c0b",
    "External": "a594d99f",
    "FastSLAM": "02dccffb",
    "FilterpyEkf": "0b6fa43b",
    "FixedLag": "13e55cd8",
    "GraphSlam": "f4b95616",
    "GtsamBatch": "644cfc1c",
    "GtsamIsam2": "2f7bff1f",
    "Gyroscope": "819bc6ea",
    "IcpOdometry": "3cc15ca0",
    "Karto": "e91bdba0",
    "KissIcp": "71303030",
    "Laser": "e752606f",
    "Lidar3D": "29cea5d0",
    "Mcl": "a1971896",
    "Odometry": "3fb34598",
    "Offline": "d6b7b12c",
    "PlaceDescriptor": "af6aa1df",
    "RealCamera": "8d155e5d",
    "RealLaser": "efcccb79",
    "RobotCamera": "d05fb434",
    "SmallGicp": "7b59f3f4",
    "Smoother": "298dcf86",
    "StereoCamera": "312bf8bc",
    "TopologicalMcl": "9f9972d0",
}


def test_no_default_changes_unseen():
    configured = (*ESTIMATORS, *SENSORS, DifferentialDrive)
    assert {cls.__name__: digest_of_defaults(described(cls)) for cls in configured} == DEFAULTS


def test_a_changed_default_is_seen():
    first, *others = described(Laser)
    changed = [dataclasses.replace(first, default=first.default + 1), *others]
    assert digest_of_defaults(changed) != digest_of_defaults(described(Laser))
