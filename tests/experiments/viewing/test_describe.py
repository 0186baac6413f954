"""What `estima info` says of lasers and people."""

import dataclasses

import numpy as np
import pytest

from experiments.runs.experiment import Experiment
from experiments.viewing.describe import describe, recognize
from sim.sensors import Laser

QUICK = ["world=rooms", "robot=robocom", "simulation.physics=kinematic", "route.distance_m=1.5"]
MODELS = ["hokuyo", "lms291_quarter", "lms291_degree", "utm30lx", "urg04lx", "rplidar_a1"]


@pytest.mark.parametrize("model", MODELS)
def test_a_laser_is_recognized_by_beams_step_and_rate(model):
    recording = Experiment.compose([*QUICK, f"sensors={model}"]).simulate()
    assert recognize(recording, "laser") == model
    assert f"like sensors={model}" in describe(recording)


def test_a_real_laser_is_like_a_device_and_not_like_an_ideal_one():
    recording = Experiment.compose([*QUICK, "sensors=hokuyo"]).simulate()
    real = dataclasses.replace(recording, config={**recording.config, "source": "carmen"})
    assert recognize(real, "laser") == "urg04lx"


def test_a_laser_of_another_step_or_rate_is_not():
    recording = Experiment.compose([*QUICK, "sensors=lms291_degree"]).simulate()
    found = recording.sensor("laser", Laser)
    for changed in ({"fov_rad": 0.9 * np.pi}, {"n_beams": 175, "fov_rad": np.radians(174.0)}):
        other = dataclasses.replace(found, **changed)
        sensors = {**recording.sensors, "laser": other}
        assert recognize(dataclasses.replace(recording, sensors=sensors), "laser") is None
    slow = Experiment.compose([*QUICK, "sensors=lms291_degree", "sensors.laser.rate_hz=10"])
    assert recognize(slow.simulate(), "laser") is None


def test_people_are_counted():
    recording = Experiment.compose([*QUICK, "sensors=hokuyo", "people.n=3"]).simulate()
    assert "people      3 walk about" in describe(recording)
    assert "people" not in describe(Experiment.compose([*QUICK, "sensors=hokuyo"]).simulate())
