"""An estimator in a child process: the same bits, and nothing of the truth on the other side."""

import multiprocessing
import os
import struct
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import joblib.externals.loky.backend.context  # noqa: F401 gives multiprocessing its method
import numba
import numpy as np
import orjson
import pytest

from estimators.programs.host import Isolated
from estimators.programs.wire import HEAD_BYTES, decode, encode, measure
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from sim.errors import InputError
from tests.fixtures import fakes

DRIVE = [
    "world=room",
    "sensors=laser_stereo",
    "route.distance_m=2",
    "simulation.physics=kinematic",
    "prior.map=world",
]
TIMES = {"isolated", "run_key", "step_time_us", "cpu_time_us"}

MINE = """
import os, signal, subprocess, sys
import numpy as np
from estimators.base import Belief

class Mine:
    def __init__(self, kind="ok", answer=(), noted=""):
        self.kind, self.answer, self.noted = kind, bytes(answer), noted
    def reset(self, prior, rng):
        self.n, self.rng = 0, rng
        print("what it prints is not an answer")
        if self.kind == "refuses":
            from sim.errors import InputError
            raise InputError("it takes no such map")
    def step(self, frame):
        self.n += 1
        if self.n == 5 and self.kind == "writes":
            frame = sys._getframe()
            while "answers" not in frame.f_locals:
                frame = frame.f_back
            os.write(frame.f_locals["answers"].fileno(), self.answer)
            import time
            time.sleep(100.0)
        if self.kind == "leaves":
            assert self.n > 1 or not hasattr(np, "left")
            np.left = os.environ["LEFT"] = "here"
        if self.kind == "looks":
            told = repr([sys.argv, sys.orig_argv, dict(os.environ), sys.modules["__main__"]])
            for secret in ("4711", "ESTIMA_", "__main__.py"):
                assert secret not in told, secret
            assert "experiments" not in sys.modules
        if self.kind == "kills":
            os.kill(os.getppid(), 9)
            os._exit(0)
        if self.kind == "stays" and self.n == 1:
            sleeper = subprocess.Popen(["sleep", "100"])
            open(self.noted, "w").write(f"{os.getpid()} {sleeper.pid}")
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


def rows_apart(*overrides):
    """`rows_of` in a new process, which reads compiled code in the order of its use.

    A function that is compiled, or read after others, may round otherwise by 1e-14.
    """
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as fresh:
        return fresh.submit(rows_of, *overrides).result()


@pytest.mark.slow  # processes that load compiled code
@pytest.mark.parametrize(
    "name", ["odometry", "ekf_icp", "mcl", "ekf_slam", "fastslam", "smoother", "graph_slam"]
)
def test_results_are_those_of_this_process(name):
    given = f"estimator={name}", "keep=[particles]"
    rows_of(*given)  # so that compiled code is on disk
    here, kept = rows_apart(*given)
    there, taken = rows_apart(*given, "isolated=true")
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


@pytest.fixture
def own_method(tmp_path, monkeypatch):
    """Function that gives the row of a run of `Mine`."""
    monkeypatch.delitem(sys.modules, "my_own_method", raising=False)
    (tmp_path / "my_own_method.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    experiment = Experiment.compose([*DRIVE, "estimator=odometry", "isolated=true"])

    def run(kind, **options):
        settings = {"_target_": "my_own_method.Mine", "kind": kind, **options}
        (row,) = evaluate(experiment.with_values(estimator=settings))
        assert "my_own_method" not in sys.modules
        return row

    return run


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
def test_code_from_elsewhere_runs_in_the_child_only(kind, status, said, own_method):
    row = own_method(kind)
    assert (row["status_code"] or "ok") == status
    assert said in row["status_detail"]


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


def test_a_message_holds_what_it_was_made_of():
    given = {
        "ranges": np.array([0.1, np.inf, np.nan], np.float32),
        "ids": np.zeros((0, 3), np.int64),
        "one": np.float64(0.1),
        "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "inside": {"list": [1, "two", None]},
    }
    data = encode(given)
    back = decode(data)
    assert measure(data) == measure(data[:HEAD_BYTES]) == len(data)
    assert measure(data[: HEAD_BYTES - 1]) == 0
    assert type(back["one"]) is np.float64
    assert back["inside"] == given["inside"]
    for name in ("ranges", "ids", "columns"):
        assert np.array_equal(back[name], given[name], equal_nan=True)
        assert back[name].dtype == given[name].dtype
        assert not back[name].flags.writeable
    with pytest.raises(TypeError):
        encode({"a": object()})


def test_frames_reach_the_child_as_they_are_here():
    """Numba compiles for the layout too: other flags of an array would be other code."""
    for frame in fakes.circle(n_frames=5, n_beams=11).frames():
        there = decode(encode({"type": "frame", **vars(frame)}))
        pairs = [(frame.wheel_increments_m, there["wheel_increments_m"])]
        for name, reading in frame.readings.items():
            pairs += [(values, there["readings"][name][key]) for key, values in reading.items()]
        for here, sent in pairs:
            assert here.tobytes() == sent.tobytes()
            assert numba.typeof(here) == numba.typeof(sent)
        assert there["stamp"] == frame.stamp


def framed(text, data=b""):
    return struct.pack("<QQ", len(text), len(data)) + text + data


def array(**changed):
    return orjson.dumps({"a": {"dtype": "<f8", "shape": [2], "order": "C", "at": 0} | changed})


DAMAGED = [
    b"",
    b"short",
    framed(b"[]"),
    framed(b"nonsense"),
    framed(array()),
    framed(array(), bytes(16)) + b"more",
    framed(array(), bytes(16))[:-1],
    framed(array(shape=[-1]), bytes(16)),
    framed(array(shape=[True]), bytes(16)),
    framed(array().replace(b"[2]", b"[99999999999999999999]"), bytes(16)),
    framed(array(dtype="|O"), bytes(16)),
    framed(array(dtype=["<f8"]), bytes(16)),
    framed(array(order="K"), bytes(16)),
    framed(array(at=-8), bytes(16)),
    framed(array(at=8), bytes(16)),
    framed(array(at=4, shape=[1]), bytes(16)),
    framed(array(at="0"), bytes(16)),
]


@pytest.mark.parametrize("data", DAMAGED)
def test_messages_that_hold_something_else_are_refused(data):
    assert decode(framed(array(), bytes(16)))["a"].tolist() == [0.0, 0.0]
    with pytest.raises(ValueError):  # noqa: PT011 of several kinds
        decode(data)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (encode({"mean": 7}), "got shapes () and ()"),
        (encode({"mean": [0, 0, 0], "covariance": "none"}), "got shapes (3,) and ()"),
        (framed(b"[]"), "is not a JSON object"),
        (framed(array(dtype="|O"), bytes(16)), "is not a JSON object"),
        (b"what it prints, and more of it", "wrote more than"),
        (encode({}) + b"more", "after its answer"),
    ],
)
def test_bytes_of_a_child_that_are_no_answer_end_in_one_line(answer, said, own_method):
    row = own_method("writes", answer=list(answer))
    assert said in row["status_detail"]
    assert "\n" not in row["status_detail"]


def test_no_run_sees_what_another_left(own_method):
    first, second = own_method("leaves"), own_method("leaves")
    assert (first["status"], second["status"]) == ("ok", "ok")
    assert first["ate_rmse_m"] == second["ate_rmse_m"]


def test_the_child_is_told_neither_the_command_line_nor_the_main_module(own_method, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["estima", "run", "seed=4711"])
    monkeypatch.setenv("ESTIMA_SECRET", "1")
    assert own_method("looks")["status_detail"] == ""
    assert sys.argv[2] == "seed=4711"


def test_workers_of_joblib_isolate_too(own_method):
    multiprocessing.set_start_method("loky", force=True)
    try:
        assert own_method("ok")["status"] == "ok"
        assert multiprocessing.get_start_method() == "loky"
    finally:
        multiprocessing.set_start_method(None, force=True)


def test_a_run_follows_a_server_that_was_killed(own_method):
    assert own_method("kills")["status_code"] == "ProgramError"
    assert own_method("ok")["status"] == "ok"
    assert own_method("exits")["status_code"] == "ProgramError"
    assert own_method("ok")["status"] == "ok"


def wait_for_the_end(pids):
    for pid in pids:
        deadline = time.monotonic() + 10.0
        while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not Path(f"/proc/{pid}").exists()


def test_a_child_that_does_not_end_is_ended_with_its_group(own_method, tmp_path):
    noted = tmp_path / "noted"
    row = own_method("stays", noted=str(noted))
    assert row["status"] == "ok"
    wait_for_the_end(noted.read_text().split())


WAITS = """
import os, subprocess, sys, time
from estimators.programs.forked import Forked

def answer(questions, answers):
    sleeper = subprocess.Popen(["sleep", "100"])
    answers.write(f"{os.getpid()} {os.getppid()} {sleeper.pid}".encode())
    answers.close()
    time.sleep(100.0)

def main():
    child = Forked(answer, "sim")
    os.write(1, os.read(child.stdout.fileno(), 100))
    os.read(0, 1)
"""


@pytest.mark.parametrize("killed", [True, False])
def test_a_child_ends_with_its_group_when_its_parent_does(killed, tmp_path):
    (tmp_path / "waits.py").write_text(WAITS)
    code = f"import sys; sys.path[:] = {[str(tmp_path), *sys.path]}; import waits; waits.main()"
    parent = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    pids = os.read(parent.stdout.fileno(), 100).split()
    assert len(pids) == 3
    parent.kill() if killed else parent.communicate(b".")
    parent.wait(10.0)
    wait_for_the_end(pid.decode() for pid in pids)
