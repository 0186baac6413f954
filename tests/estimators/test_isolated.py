"""An estimator in a child process: the same bits, and nothing of the truth on the other side."""

import sys

import numpy as np
import pytest

from estimators.programs.host import Isolated, decode, encode
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from sim.errors import InputError

DRIVE = [
    "world=room",
    "sensors=laser_stereo",
    "route.distance_m=2",
    "simulation.physics=kinematic",
    "prior.map=world",
]
TIMES = {"isolated", "run_key", "step_time_us", "cpu_time_us"}

MINE = """
import os, sys
import numpy as np
from estimators.base import Belief

class Mine:
    def __init__(self, kind="ok"):
        self.kind = kind
    def reset(self, prior, rng):
        self.n, self.rng = 0, rng
        print("what it prints is not an answer")
        if self.kind == "refuses":
            from sim.errors import InputError
            raise InputError("it takes no such map")
    def step(self, frame):
        self.n += 1
        if self.n == 5 and self.kind == "exits":
            os._exit(3)
        if self.n == 5 and self.kind == "raises":
            raise KeyError("lost")
        if self.n == 5 and self.kind == "scalar":
            return Belief(1.0, 1.0)
        if self.n == 5 and self.kind == "negative":
            return Belief(np.zeros(3), -np.eye(3))
        import gc
        names = {type(one).__name__ for one in gc.get_objects()}
        assert not names & {"Recording", "Truth"}
        return Belief(self.rng.spawn(1)[0].random(3), np.eye(3))
"""


def rows_of(*overrides):
    kept = []
    experiment = Experiment.compose([*DRIVE, *overrides])
    rows = evaluate(experiment, on_estimate=lambda *answer: kept.append(answer[2:]))
    return rows, kept


@pytest.mark.slow  # two processes that load compiled code
@pytest.mark.parametrize("name", ["odometry", "ekf_icp", "mcl", "ekf_slam", "fastslam", "smoother"])
def test_results_are_those_of_this_process(name):
    here, kept = rows_of(f"estimator={name}", "keep=[particles]")
    there, taken = rows_of(f"estimator={name}", "keep=[particles]", "isolated=true")
    assert here[0].keys() == there[0].keys()
    assert {key for key in here[0] if here[0][key] != there[0][key]} <= TIMES
    for ours, theirs in zip(kept[0], taken[0], strict=True):
        assert (ours is None) == (theirs is None)
        if ours is not None:
            assert np.array_equal(ours.means, theirs.means)
            assert np.array_equal(ours.covariances, theirs.covariances)
            for key, values in ours.extras.items():
                for one, other in zip(values, theirs.extras[key], strict=True):
                    assert np.array_equal(one, other)


@pytest.mark.parametrize(
    ("kind", "status", "said"),
    [
        ("ok", "ok", ""),
        ("exits", "ProgramError", "ended with code 3"),
        ("raises", "ProgramError", "KeyError: 'lost'"),
        ("scalar", "ProgramError", "BeliefError: Mine.step must return a Belief"),
        ("negative", "unsound", "positive semidefinite at"),
    ],
)
def test_code_from_elsewhere_runs_in_the_child_only(kind, status, said, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "my_own_method", raising=False)
    experiment = Experiment.compose([*DRIVE, "estimator=odometry", "isolated=true"]).with_values(
        estimator={"_target_": "my_own_method.Mine", "kind": kind}
    )
    (tmp_path / "my_own_method.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    (row,) = evaluate(experiment)
    assert (row["status_code"] or "ok") == status
    assert said in row["status_detail"]
    assert "my_own_method" not in sys.modules


def test_what_it_refuses_is_refused(tmp_path, monkeypatch):
    (tmp_path / "my_own_method.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    experiment = Experiment.compose([*DRIVE, "isolated=true"])
    for settings, said in (
        ({"kind": "refuses"}, "it takes no such map"),
        ({"kinds": 1}, "does not accept its values"),
    ):
        one = experiment.with_values(estimator={"_target_": "my_own_method.Mine", **settings})
        with pytest.raises(InputError, match=said):
            evaluate(one)
    with pytest.raises(InputError, match="object in memory"):
        experiment.with_estimator_object(Isolated({})).check()
    with pytest.raises(InputError, match="those of a team"):
        Experiment.compose(["study=teams", "sweeps=[]", "isolated=true"]).check()


def test_a_line_holds_what_it_was_made_of():
    given = {
        "ranges": np.array([0.1, np.inf, np.nan], np.float32),
        "ids": np.zeros((0, 3), np.int64),
        "one": np.float64(0.1),
        "inside": {"list": [1, "two", None]},
    }
    back = decode(encode(given))
    assert np.array_equal(back["ranges"], given["ranges"], equal_nan=True)
    assert back["ranges"].dtype == np.float32
    assert back["ids"].shape == (0, 3)
    assert type(back["one"]) is np.float64
    assert back["inside"] == given["inside"]
    with pytest.raises(TypeError):
        encode({"a": object()})


@pytest.mark.parametrize(
    "line",
    [
        b"[]",
        b"nonsense",
        b'{"a":{"dtype":"<f8","shape":[2],"data":""}}',
        b'{"a":{"dtype":"<f8","shape":[-1],"data":""}}',
        b'{"a":{"dtype":"|O","shape":[1],"data":"AAAAAAAAAAA="}}',
        b'{"a":{"dtype":"<f8","shape":[true],"data":"AAAAAAAAAAA="}}',
        b'{"a":{"dtype":"<f8","shape":[1],"data":"%%"}}',
        b'{"a":{"dtype":["<f8"],"shape":[1],"data":"AAAAAAAAAAA="}}',
        b'{"a":{"dtype":"<f8","shape":[99999999999999999999],"data":"AAAAAAAAAAA="}}',
    ],
)
def test_lines_that_hold_something_else_are_refused(line):
    with pytest.raises(ValueError):  # noqa: PT011 of several kinds
        decode(line)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ('{"mean": 7}', "got shapes () and ()"),
        ('{"mean": [0, 0, 0], "covariance": "none"}', "got shapes (3,) and ()"),
        ("[]", "is not a JSON object"),
        ('{"mean": {"dtype": "|O", "shape": [3], "data": ""}}', "is not a JSON object"),
    ],
)
def test_a_child_that_says_nonsense_fails(answer, said, tmp_path, monkeypatch):
    child = tmp_path / "child"
    child.write_text(
        "#!/bin/sh\nwhile read -r line; do\n"
        f"case $line in *frame*) echo '{answer}';; *) echo '{{}}';; esac\ndone\n"
    )
    child.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(child))
    experiment = Experiment.compose([*DRIVE, "isolated=true"])
    try:
        (row,) = evaluate(experiment)
        complaint = row["status_detail"]
    except InputError as error:  # of the first belief
        complaint = str(error)
    assert said in complaint
