"""What is composed from files of options is kept, and yet follows them."""

import os

import pytest

from experiments.runs.dependencies.recorder import recorded
from experiments.runs.experiment import Experiment
from experiments.runs.option_files import state_of_files

SHORT = ["simulation.physics=kinematic", "world=office"]


@pytest.fixture
def option(tmp_path):
    """An option of one's own, and the overrides that find it."""
    (tmp_path / "estimator").mkdir()
    path = tmp_path / "estimator" / "mine.yaml"
    path.write_text("_target_: estimators.odometry.Odometry\nkr: 1e-5\n")
    return path, [f"hydra.searchpath=['file://{tmp_path}']", "estimator=mine", *SHORT]


def test_a_changed_file_is_read_again(option):
    path, overrides = option
    assert Experiment.compose(overrides).config["estimator"]["kr"] == 1e-5
    state = path.stat()
    path.write_text("_target_: estimators.odometry.Odometry\nkr: 2e-5\n")  # as long as before
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns + 1))
    assert Experiment.compose(overrides).config["estimator"]["kr"] == 2e-5


def test_what_is_kept_is_nobodys_to_change(option):
    _, overrides = option
    first = Experiment.compose([*overrides, "estimator.kr=3e-5"])
    first.config["world"]["n_objects"] = -1
    again = Experiment.compose(overrides)
    assert again.config["estimator"]["kr"] == 1e-5
    assert again.key == Experiment.compose(overrides).key


def test_dependencies_have_the_files_of_what_is_kept():
    Experiment.compose(SHORT)
    with recorded() as recorder:
        Experiment.compose(SHORT)
    assert {"conf/config.yaml", "conf/world/office.yaml"} <= recorder.digests().keys()


def test_what_is_not_in_a_folder_is_read_each_time():
    assert state_of_files(["pkg://somewhere"]) is None
    assert state_of_files([]) == state_of_files([])
