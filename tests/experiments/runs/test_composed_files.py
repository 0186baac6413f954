"""What is composed of the options' files is kept, and yet follows them."""

import os
import shutil

import pytest

from experiments.runs import paths, schema
from experiments.runs.compose import searched
from experiments.runs.dependencies.recorder import recorded
from experiments.runs.experiment import Experiment
from sim.errors import InputError

SHORT = ["simulation.physics=kinematic", "world=office"]


@pytest.fixture
def option(tmp_path, monkeypatch):
    """A file of a copy of conf/, which has an option `mine`."""
    conf = tmp_path / "conf"
    shutil.copytree(paths.CONF, conf)
    path = conf / "estimator" / "mine.yaml"
    path.write_text("_target_: estimators.odometry.Odometry\nkr: 1e-5\n")
    for module in (paths, schema):
        monkeypatch.setattr(module, "CONF", conf)
    return path


def test_a_changed_file_is_read_again(option):
    overrides = [*SHORT, "estimator=mine"]
    assert Experiment.compose(overrides).config["estimator"]["kr"] == 1e-5
    state = option.stat()
    option.write_text("_target_: estimators.odometry.Odometry\nkr: 2e-5\n")  # as long as before
    os.utime(option, ns=(state.st_atime_ns, state.st_mtime_ns + 1))
    assert Experiment.compose(overrides).config["estimator"]["kr"] == 2e-5


def test_options_of_ones_own_folder_are_read_each_time(tmp_path):
    (tmp_path / "estimator").mkdir()
    path = tmp_path / "estimator" / "mine.yaml"
    for kr in (1e-5, 2e-5):
        path.write_text(f"_target_: estimators.odometry.Odometry\nkr: {kr}\n")
        os.utime(path, ns=(0, 0))
        overrides = [f"hydra.searchpath=['file://{tmp_path}']", "estimator=mine", *SHORT]
        assert Experiment.compose(overrides).config["estimator"]["kr"] == kr


def test_what_is_kept_does_not_change_with_what_is_made_of_it():
    first = Experiment.compose(SHORT)
    changed = Experiment.compose([*SHORT, "world.n_landmarks=1", "robot.kr=3e-5"])
    changed.config["world"]["n_landmarks"] = -1
    again = Experiment.compose(SHORT)
    assert (again.config, again.choices, again.key) == (first.config, first.choices, first.key)


def test_dependencies_have_the_files_of_what_is_kept():
    Experiment.compose(SHORT)
    with recorded() as recorder:
        Experiment.compose(SHORT)
    assert {"conf/config.yaml", "conf/world/office.yaml"} <= recorder.digests().keys()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("simulatoin: {physics: kinematic}", "unknown key simulatoin; did you mean simulation"),
        ("sweep: {seed: 1}", "unknown key sweep; did you mean sweeps"),
        ("bogus: {sed: [1, 2]}", "unknown key bogus"),
        ("sede: 3", "unknown key sede; did you mean seed"),
    ],
)
def test_a_studys_own_keys_are_labels_alone(tmp_path, line, said):
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "mine.yaml").write_text(f"# @package _global_\nlabel: a\n{line}\n")
    words = [*searched(tmp_path), "study=mine"]
    with pytest.raises(InputError, match=f"study=mine: {said}"):
        Experiment.compose(words)
    (tmp_path / "study" / "mine.yaml").write_text("# @package _global_\nlabel: a\n")
    assert Experiment.compose(words).config["seed"] == 0
