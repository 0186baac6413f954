"""Every option of the configuration composes and builds what it names."""

import dataclasses
import inspect
from pathlib import Path

import numpy as np
import pytest
import yaml

from experiments.runs.compose import find_option, searched
from experiments.runs.experiment import Experiment
from experiments.runs.paths import option_names
from experiments.runs.schema import describe_option
from experiments.runs.targets import make
from experiments.sweeps.plan import plan_experiments
from sim.errors import InputError
from sim.robot.drive import RobotGeometry
from sim.sensors import sensors_from_config
from tests.fixtures.fakes import PROGRAMS, circle, peers_may_be_missing

CONF = Path(__file__).resolve().parents[2] / "conf"


def options(group):
    return option_names(group)


@pytest.mark.parametrize("name", options("world"))
def test_worlds_build_and_depend_on_their_seed_alone(name):
    grid = [f"world.path={CONF.parent / 'docs' / 'maps' / 'lab.yaml'}"]
    given = grid if name == "from_grid" else []
    experiment = Experiment.compose([f"world={name}", "seed=3", *given])
    first, second = experiment.world(), experiment.world()
    assert np.array_equal(first.walls, second.walls)
    assert np.array_equal(first.landmarks, second.landmarks)


@pytest.mark.parametrize("name", options("robot"))
def test_robots_state_every_key(name):
    experiment = Experiment.compose([f"robot={name}"])
    stated = set(experiment.config["robot"]) - {"_target_"}
    assert stated == set(inspect.signature(type(experiment.robot())).parameters)


@pytest.mark.parametrize("name", options("sensors"))
def test_sensors_build_and_state_every_key(name):
    config = Experiment.compose([f"sensors={name}"]).config
    sensors = sensors_from_config(config["sensors"])
    assert set(sensors) == set(config["sensors"])
    for kind, settings in config["sensors"].items():
        known = inspect.signature(type(sensors[kind])).parameters
        assert set(settings) == {"_target_", *known}, kind


@pytest.mark.parametrize("name", options("route"))
def test_routes_build(name):
    config = Experiment.compose([f"route={name}"]).config
    assert callable(make(config["route"], "route").start)


@pytest.mark.parametrize("name", options("estimator"))
def test_estimators_build_and_state_every_key(name):
    experiment = Experiment.compose([f"estimator={name}", *PROGRAMS.get(name, [])])
    with peers_may_be_missing():
        estimator = experiment.estimator()
    stated = set(experiment.config["estimator"]) - {"_target_"}
    assert stated == set(inspect.signature(type(estimator)).parameters)


def test_belief_follows_truth_unless_it_is_set():
    config = Experiment.compose(["robot.kr=3e-4"]).config
    assert config["estimator"]["kr"] == config["robot"]["kr"] == 3e-4
    given = ["robot.kr=3e-4", "estimator.kr=1e-5", "prior.track_m=0.2"]
    config = Experiment.compose(given).config
    assert (config["robot"]["kr"], config["estimator"]["kr"]) == (3e-4, 1e-5)
    assert (config["robot"]["track_m"], config["prior"]["track_m"]) == (0.19, 0.2)


def test_geometry_is_believed_to_be_the_recordings_unless_it_is_set():
    there = dataclasses.replace(circle(n_frames=3), robot=RobotGeometry(0.0975, 0.33))
    assert Experiment.compose([]).prior(there).robot == there.robot
    set_apart = Experiment.compose(["prior.track_m=0.4"]).prior(there).robot
    assert set_apart == RobotGeometry(0.0975, 0.4)
    with pytest.raises(InputError, match="prior"):
        Experiment.compose(["prior.track_m=wide"]).prior(there)


def test_every_option_says_what_it_is():
    for path in CONF.rglob("*.yaml"):
        assert path.read_text().startswith("#"), f"{path.name} has no opening comment"
        yaml.safe_load(path.read_text())


@pytest.mark.parametrize(
    "override", ["route.distance_m=far", "estimator.kr=small", "world.n_objects=many"]
)
def test_a_word_for_a_number_is_named(override):
    key, _, word = override.partition("=")
    with pytest.raises(InputError, match=rf"{key} must be .*number.*, got '{word}'"):
        Experiment.compose(["world=room", override]).check()


def test_what_a_file_does_not_state_is_the_default_of_what_it_names(tmp_path):
    (tmp_path / "estimator").mkdir()
    (tmp_path / "estimator" / "bare.yaml").write_text(
        "_target_: estimators.landmarks.ekf_slam.EkfSlam\nkr: ${robot.kr}\nkl: ${estimator.d0}\n"
    )
    own = [*searched(tmp_path), "estimator=bare"]
    found = Experiment.compose([*own, "estimator.d0=3.0"]).options_of("estimator")
    whole = Experiment.compose(["estimator=ekf_slam"]).options_of("estimator")
    assert found == {**whole, "d0": 3.0, "kl": 3.0}
    swept = [
        run.options_of("estimator")["d0"]
        for run in plan_experiments([*own, "estimator.d0=1.0,2.0"])
    ]
    assert swept == [1.0, 2.0]
    with pytest.raises(InputError, match=r"unknown key estimator\.d1; known: .*estimator\.d0, "):
        Experiment.compose([*own, "estimator.d1=3.0"])
    assert "d0: 16.27" in describe_option("estimator", "ekf_slam")


def test_an_option_of_a_folder_is_called_by_its_last_part():
    experiment = Experiment.compose(["estimator=peers/kiss_icp_tuned"])
    assert experiment.estimator_name == "kiss_icp_tuned"
    assert experiment.options_of("estimator")["voxel_size_m"] == 0.1
    assert find_option("estimator", "kiss_icp") == "peers/kiss_icp"
