"""Programs as estimators: what they are told, what they may do wrong, and that they end."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from estimators.odometry import Odometry
from estimators.programs.external import External
from estimators.programs.offline import Offline, recording_of
from estimators.programs.program import ProgramError
from experiments.gate.conform import check_estimator
from experiments.gate.suite import read_suite, run_suite
from experiments.runs.evaluate import evaluate, run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome
from sim.errors import InputError
from sim.recording import load, save
from sim.worlds.grid import rasterize
from sim.worlds.grid_file import read_grid
from tests.fixtures import fakes

EXAMPLES = Path(__file__).resolve().parents[2] / "docs/examples"
PYTHON = [sys.executable, str(EXAMPLES / "external_odometry.py")]
_READ = "import json, sys, time\nfor line in sys.stdin:\n    m = json.loads(line)\n"
_BELIEF = '{"mean": [0, 0, 0], "covariance": null}'


@pytest.fixture(scope="module")
def recording():
    return fakes.circle(n_frames=40, n_beams=11)


def child(tmp_path, body):
    """A program of Python: what it does with each message `m`."""
    path = tmp_path / "child.py"
    path.write_text(_READ + "".join(f"    {line}\n" for line in body.splitlines()))
    return [sys.executable, str(path)]


def listening(out):
    """Body of a program that writes down what it is told."""
    return f"open({str(out)!r}, 'a').write(line)\nprint('{_BELIEF}', flush=True)"


def run(estimator, recording, prior=None, seed=0):
    prior = fakes.tracking_prior(recording) if prior is None else prior
    return run_over(recording, estimator, prior, np.random.default_rng(seed))


def midpoint(recording):
    online, _ = run(Odometry(kr=1e-5, kl=1e-5, integration="midpoint"), recording)
    return online.means


def test_the_example_in_python_is_dead_reckoning(recording):
    estimator = External(command=PYTHON)
    online, revised = run(estimator, recording)
    assert revised is None
    assert np.abs(online.means - midpoint(recording)).max() < 1e-12
    assert (np.diff(online.covariances[:, 0, 0]) > 0.0).all()
    assert 0.0 < estimator.program_seconds < 10.0
    assert online.cpu_seconds == estimator.program_seconds


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_the_example_in_cpp_is_dead_reckoning(recording, tmp_path):
    program = tmp_path / "external_odometry"
    source = EXAMPLES / "external_odometry.cpp"
    options = ["-std=c++17", "-O1", "-Wall", "-Werror"]
    subprocess.run(["g++", *options, "-o", program, source], check=True)
    online, _ = run(External(command=[str(program)]), recording)
    assert np.abs(online.means - midpoint(recording)).max() < 1e-12
    results = check_estimator(
        lambda: External(command=[str(program)]),
        recording,
        fakes.tracking_prior(recording),
        n_frames=10,
    )
    assert all(result.passed for result in results), results


@pytest.mark.skipif(shutil.which("awk") is None, reason="no awk")
def test_the_example_as_a_script_is_dead_reckoning(recording):
    command = f"sh {EXAMPLES / 'offline_odometry.sh'} {{log}} {{start}} {{out}}"
    estimator = Offline(command=command)
    online, revised = run(estimator, recording)
    assert np.abs(revised.means - online.means).max() < 1e-9  # the arc, which CARMEN logs hold
    assert revised.kind == "revised"
    assert online.cpu_seconds == estimator.program_seconds > 0.0
    online, revised = run(Offline(command=command, kind="online"), recording)
    assert revised is None
    results = check_estimator(
        lambda: Offline(command=command), recording, fakes.tracking_prior(recording), n_frames=10
    )
    assert all(result.passed for result in results), results


def test_messages_hold_the_frames_exactly(recording, tmp_path):
    out = tmp_path / "said.jsonl"
    command = child(tmp_path, listening(out))
    prior = fakes.tracking_prior(recording)
    run(External(command=command), recording, prior)
    reset, *frames, finish = map(json.loads, out.read_text().splitlines())
    assert (reset["type"], finish) == ("reset", {"type": "finish"})
    assert reset["robot"] == {
        "wheel_radius_m": recording.robot.wheel_radius_m, "track_m": recording.robot.track_m
    }  # fmt: skip
    assert reset["prior"]["mean"] == prior.mean.tolist()
    assert np.array_equal(reset["map"]["walls"], prior.map.walls)
    assert set(reset["map"]) == {"kind", "walls", "wall_z_m", "landmarks", "descriptors"}
    assert reset["sensors"]["laser"]["n_beams"] == 11
    for message, frame in zip(frames, recording.frames(), strict=True):
        assert message["stamp"] == frame.stamp
        assert message["wheel_increments_m"] == frame.wheel_increments_m.tolist()
        assert set(message["readings"]) == set(frame.readings)
        told = np.array(message["readings"]["laser"]["ranges_m"], float).astype(np.float32)
        seen = np.where(np.isinf(told) | np.isnan(told), np.inf, told)
        assert np.array_equal(seen, frame.readings["laser"]["ranges_m"])


def test_no_return_is_null_and_floats_are_short(recording, tmp_path):
    ranges_m = recording.log("laser")["ranges_m"].copy()
    ranges_m[:, 0], ranges_m[:, 1] = np.inf, np.float32(0.1)
    out = tmp_path / "said.jsonl"
    command = child(tmp_path, listening(out))
    run(External(command=command), fakes.with_field(recording, "laser", ranges_m=ranges_m))
    assert '"ranges_m":[null,0.1,' in out.read_text().splitlines()[1]


BAD = {
    "crash": ("sys.exit(3)", "ended with code 3"),
    "exception": ("raise ValueError('no laser here')", "no laser here"),
    "signal": ("import os; os.kill(os.getpid(), 9)", "ended by signal 9"),
    "silence": ("time.sleep(60)", r"no answer within 0\.3 s"),
    "closed": ("import os; os.close(1); time.sleep(60)", "closed its output"),
    "no_json": ("print('hello', flush=True)", "not a JSON object"),
    "list": ("print('[1, 2]', flush=True)", "not a JSON object"),
    "no_mean": ("print('{}', flush=True)", "must answer with mean, 3 numbers; got None"),
    "short": ("print('{\"mean\": [1, 2]}', flush=True)", "mean, 3 numbers"),
    "texts": ("print('{\"mean\": [\"1\", \"2\", \"3\"]}', flush=True)", "mean, 3 numbers"),
    "true": ("print('{\"mean\": [true, 2, 3]}', flush=True)", "mean, 3 numbers"),
    "null": ("print('{\"mean\": [1, null, 3]}', flush=True)", "mean, 3 numbers"),
    "nan": ("print('{\"mean\": [NaN, 0, 0]}', flush=True)", "not a JSON object"),
    "covariance": (
        "print('{\"mean\": [0, 0, 0], \"covariance\": [1, 2, 3]}', flush=True)",
        "covariance, 3 x 3 numbers",
    ),
    "variance": (
        "print('{\"mean\": [0, 0, 0], \"covariance\": [[1,0,0],[0,-1,0],[0,0,1]]}', flush=True)",
        r"Frame at [\d.]+ s: must answer with covariance, symmetric and without a negative",
    ),
    "misspelled": (
        "print('{\"mean\": [0, 0, 0], \"covarience\": null}', flush=True)",
        "unknown key covarience; did you mean covariance.* known: covariance,",
    ),
    "error": ("print('{\"error\": \"no scan\"}', flush=True)", "the error no scan"),
    "node": (
        "sys.stderr.write('TypeError: no x\\n    at mine.js:3\\n\\nNode.js v18\\n'); sys.exit(1)",
        "ended with code 1: TypeError: no x",
    ),
    "warned": (
        "sys.stderr.write('Error tolerance is 1e-3\\nmine: no scans in log.log\\n'); sys.exit(3)",
        "ended with code 3: mine: no scans in log.log",
    ),
    "what": (
        "sys.stderr.write('  what():  out of range\\nAborted (core dumped)\\n'); sys.exit(1)",
        r"ended with code 1: +what\(\):  out of range",
    ),
    "two_lines": (f"print('{_BELIEF}\\n{_BELIEF}', flush=True)", "after its answer|being asked"),
    "greeting": ("print('hello\\n{}', flush=True)", "after its answer 'hello'|being asked"),
    "far": ("print('{\"mean\": [1e300, 0, 0]}', flush=True)", r"mean, numbers up to 1e\+12"),
    "half_line": ("print('{\"mean\"', end='', flush=True); time.sleep(60)", "no answer within"),
    "endless_line": ("while True: sys.stdout.write('x' * 65536)", "more than 1048576 bytes"),
    "binary": ("sys.stdout.buffer.write(b'\\xff\\xfe\\n'); sys.stdout.flush()", "a JSON object"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_what_a_program_does_wrong_is_said_and_never_hangs(recording, tmp_path, fault):
    body, message = BAD[fault]
    command = child(tmp_path, f"if m['type'] == 'reset': print('{{}}', flush=True)\nelse: {body}")
    if "while" in body:
        command = child(
            tmp_path, f"if m['type'] == 'reset': print('{{}}', flush=True); continue\n{body}"
        )
    estimator = External(
        command=command, step_s=0.3 if "0.3" in message or "within" in message else 5.0
    )
    begun = time.monotonic()
    with pytest.raises(ProgramError, match=message) as caught:
        run(estimator, recording)
    assert "\n" not in str(caught.value)
    assert time.monotonic() - begun < 15.0
    assert estimator._program._process.returncode is not None  # it was ended, and reaped


def test_a_status_is_one_line(recording, tmp_path):
    answer = '{"mean": [0, 0, 0], "status": "ok\\\\nestima: all is fine"}'
    online, _ = run(External(command=child(tmp_path, f"print('{answer}', flush=True)")), recording)
    assert online.status.startswith("ok estima: all is fine at ")


def test_much_talk_on_standard_error_does_no_harm(recording, tmp_path):
    body = f"sys.stderr.write('x' * 200000 + chr(10)); print('{_BELIEF}', flush=True)"
    online, _ = run(External(command=child(tmp_path, body)), recording.cut(5))
    assert len(online.means) == 5


def test_a_program_that_reads_late_is_waited_for(recording, tmp_path):
    path = tmp_path / "late.py"
    path.write_text(
        "import sys, time\ntime.sleep(0.3)\n"
        f"for line in sys.stdin: print('{_BELIEF}', flush=True)\n"
    )
    grid = rasterize(recording.known_world, 0.01, 0.5)  # far more than a pipe holds
    prior = fakes.tracking_prior(recording)
    prior = type(prior)(**{**vars(prior), "map": grid})
    online, _ = run(External(command=[sys.executable, str(path)]), recording.cut(3), prior)
    assert len(online.means) == 3


def test_children_of_the_program_are_ended_too(recording, tmp_path):
    pid = tmp_path / "pid"
    body = (
        "import subprocess\n"
        "if m['type'] == 'reset':\n"
        f"    p = subprocess.Popen(['sleep', '600']); open({str(pid)!r}, 'w').write(str(p.pid))\n"
        f"print('{_BELIEF}', flush=True)"
    )
    run(External(command=child(tmp_path, body)), recording.cut(3))
    assert _gone(int(pid.read_text()))
    estimator = External(command=child(tmp_path, body))
    estimator.reset(fakes.tracking_prior(recording), np.random.default_rng(0))
    del estimator  # nobody asks it to finish
    assert _gone(int(pid.read_text()))


def _gone(pid):
    for _ in range(100):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":  # its parent is gone; init reaps it
            return True
        time.sleep(0.05)
    return False


def test_a_revised_trajectory_comes_at_the_end(recording, tmp_path):
    body = (
        "n = n + 1 if m['type'] == 'frame' else 0 if m['type'] == 'reset' else n\n"
        "if m['type'] == 'finish': print(json.dumps({'means': [[i, 0, 0] for i in range(n)]}))\n"
        f"else: print('{_BELIEF}')\n"
        "sys.stdout.flush()"
    )
    online, revised = run(External(command=child(tmp_path, body)), recording)
    assert np.array_equal(revised.means[:, 0], np.arange(len(recording.frame_stamps)))
    assert np.array_equal(revised.stamps, online.stamps)
    assert not revised.covariances.any()


def test_revised_stamps_of_another_time_are_refused(recording, tmp_path):
    answer = '{"stamps": [1000, 1001], "means": [[0, 0, 0], [1, 0, 0]]}'
    command = child(tmp_path, f"print('{answer}' if m['type'] == 'finish' else '{_BELIEF}')\n"
                    "sys.stdout.flush()")  # fmt: skip
    with pytest.raises(ProgramError, match="stamps of the Frames; its path is from"):
        run(External(command=command), recording)


def test_a_revised_path_of_one_pose_gets_a_remark(tmp_path):
    answer = '{"stamps": [0], "means": [[0, 0, 0]]}'
    command = child(tmp_path, f"print('{answer}' if m['type'] == 'finish' else '{_BELIEF}')\n"
                    "sys.stdout.flush()")  # fmt: skip
    settings = ["simulation.physics=kinematic", "route=linear_1", "estimator=external"]
    experiment = Experiment.compose(settings).with_estimator(command=command)
    (row,) = evaluate(experiment)
    assert (row["status"], row["status_code"]) == (Outcome.REMARK, "gap")


def test_a_failing_program_is_a_status_of_its_row(tmp_path):
    command = child(tmp_path, "if m['type'] == 'frame': sys.exit(7)\nprint('{}', flush=True)")
    settings = ["simulation.physics=kinematic", "route=linear_1", "estimator=external"]
    experiment = Experiment.compose(settings).with_estimator(command=command)
    (row,) = evaluate(experiment)
    assert (row["status"], row["status_code"]) == (Outcome.FAILED, "ProgramError")
    assert "ended with code 7" in str(row["status_detail"])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"command": None}, "must be a program"),
        ({"command": []}, "must be a program"),
        ({"command": [1, 2]}, "must be a program"),
        ({"command": "no_such_program_here --fast"}, "no program no_such_program_here"),
        ({"command": "build/peers/mrpt icp"}, "`make peers` compiles it"),
        ({"command": "python3 'open"}, "No closing quotation"),
        ({"command": PYTHON, "step_s": 0}, "step_s must be a number above 0"),
    ],
)
def test_wrong_settings_are_named(settings, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where no peer is compiled
    with pytest.raises(InputError, match=message):
        External(**settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"command": "sh {log}"}, r"must have \{out\}"),
        ({"command": "sh {truth} {out}"}, r"nothing is called \{truth\}"),
    ],
)
def test_wrong_settings_of_offline_programs_are_named(settings, message):
    with pytest.raises(InputError, match=message):
        Offline(**settings)


@pytest.mark.parametrize("known", ["world", "grid"])
def test_a_program_gets_a_grid_of_the_map(recording, tmp_path, known):
    """Of a world that at the laser's height, in the form that every map server reads."""
    prior, kept = fakes.tracking_prior(recording), tmp_path / "kept"
    expected = rasterize(prior.map, 0.05, recording.sensors["laser"].mount.z_m)
    if known == "grid":
        prior = dataclasses.replace(prior, map=expected)
    copied = f"cp -r $(dirname {{grid}}) {kept} && echo 0 0 0 0 0 0 0 1 > {{out}}"
    run(Offline(command=["sh", "-c", copied]), recording, prior)
    found = read_grid(kept / "grid.yaml")
    assert "mode: trinary" in (kept / "grid.yaml").read_text()
    np.testing.assert_array_equal(found.occupied, expected.occupied)
    np.testing.assert_array_equal(found.free, expected.free)
    assert found.origin == pytest.approx(expected.origin)


@pytest.mark.parametrize(
    ("lacking", "message"),
    [
        ("prior.map=none", "needs a map; set prior.map=world"),
        ("sensors.laser=null", "sensor laser"),
    ],
)
def test_what_an_offline_program_needs_is_told_before_anything_is_simulated(lacking, message):
    settings = ["sensors=laser_stereo", "prior.map=world", "estimator=offline"]
    settings += ["estimator.command=[sh,'{grid}','{out}']"]
    Experiment.compose(settings).check()
    with pytest.raises(InputError, match=message):
        Experiment.compose([*settings, lacking]).check()


def test_an_offline_program_without_a_map_is_told(recording):
    prior = fakes.tracking_prior(recording, with_map=False)
    with pytest.raises(InputError, match=r"set prior\.map=world"):
        run(Offline(command="sh {map} {out}"), recording, prior)


OFFLINE_BAD = {
    "crash": ("echo no scans here >&2; exit 4", "ended with code 4: no scans here"),
    "nothing": ("exit 0", r"ended without writing \{out\}"),
    "garbage": ('echo hello > "$1"', r"wrote no trajectory: \{out\}:1"),
    "empty": (': > "$1"', "holds no pose"),
    "elsewhere": ('echo 1000 1 2 0 0 0 0 1 > "$1"', "is from 1000 to 1000 s, the Frames from 0 to"),
    "slow": ("sleep 60", r"did not end within 0\.5 s"),
    "child": ("sleep 60 & wait", r"did not end within 0\.5 s"),
    "talk": ("while :; do echo much too much; done", r"did not end within 0\.5 s"),
}


@pytest.mark.parametrize("fault", OFFLINE_BAD)
def test_what_an_offline_program_does_wrong_is_said(recording, tmp_path, fault):
    body, message = OFFLINE_BAD[fault]
    script = tmp_path / "run.sh"
    script.write_text(body + "\n")
    estimator = Offline(
        command=["sh", str(script), "{out}"], limit_s=0.5 if "within" in message else 5.0
    )
    begun = time.monotonic()
    with pytest.raises(ProgramError, match=message) as caught:
        run(estimator, recording)
    assert "\n" not in str(caught.value)
    assert time.monotonic() - begun < 15.0


_SPY = """
import os, pathlib, sys
import numpy as np
out, *files = sys.argv[1:]
found = b"".join(pathlib.Path(f).read_bytes() for f in files)
for name in files:
    if name.endswith(".npz"):
        archive = np.load(name)
        found += b"".join(key.encode() + archive[key].tobytes() for key in archive)
for key, value in os.environ.items():
    found += f"{key}={value}".encode()
pathlib.Path(sys.argv[0] + ".found").write_bytes(found)
pathlib.Path(out).write_text("0 0 0 0 0 0 0 1\\n1 0 0 0 0 0 0 1\\n")
"""


def secrets_of(recording):
    """What a program must not find, as text and as it lies in memory."""
    truth = recording.known_truth
    pose = truth.poses[7]
    found = [text.encode() for text in map(repr, pose.tolist()) if len(text) > 10]
    found += [truth.poses[5:9].tobytes(), pose.tobytes()]
    found += [b"ground_truth", b"truth.", b"robot.kr", b"31415926", b"world_seed"]
    return [*found, *(ids.tobytes() for ids in truth.readings["stereo"].values())]


def test_what_a_program_is_given_holds_no_truth(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_CACHE", "31415926")
    recording = fakes.circle(n_frames=30, n_beams=5, identifies=False)
    config = {"seed": 31415926, "world_seed": 31415926, "robot": {"robot.kr": 1.0}}
    recording = type(recording)(**{**vars(recording), "config": config})
    save(recording, tmp_path / "with_truth.npz")
    told = (tmp_path / "with_truth.npz").read_bytes()
    assert sum(secret in told for secret in secrets_of(recording)) > 4  # so the search finds it
    spy = tmp_path / "spy.py"
    spy.write_text(_SPY)
    prior = fakes.tracking_prior(recording, with_map=False)
    command = [sys.executable, str(spy), "{out}", "{log}", "{npz}", "{mcap}", "{start}"]
    run(Offline(command=command), recording, prior)
    out = tmp_path / "said.jsonl"
    run(External(command=child(tmp_path, listening(out))), recording, prior)
    for given in ((tmp_path / "spy.py.found").read_bytes(), out.read_bytes()):
        assert len(given) > 1000
        for secret in secrets_of(recording):
            assert secret not in given


def test_the_copy_holds_what_frames_show(recording, tmp_path):
    prior = fakes.tracking_prior(recording)
    copy = recording_of(list(recording.frames()), prior)
    assert copy.truth is None
    assert copy.config == {}
    for mine, theirs in zip(copy.frames(), recording.frames(), strict=True):
        assert mine.stamp == theirs.stamp
        assert mine.wheel_increments_m == pytest.approx(theirs.wheel_increments_m, abs=1e-12)
        assert set(mine.readings) == set(theirs.readings)
        for name, reading in theirs.readings.items():
            for key, values in reading.items():
                assert np.array_equal(mine.readings[name][key], values)
    save(copy, tmp_path / "copy.npz")
    assert load(tmp_path / "copy.npz").truth is None


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_the_suite_of_a_cpp_program_runs(tmp_path, monkeypatch):
    suite = read_suite(EXAMPLES / "own_gate" / "suite.yaml")
    overrides = (*suite.overrides["laser"], "route.distance_m=1", "sensors.laser.n_beams=11")
    suite = dataclasses.replace(suite, counts={"laser": 1}, overrides={"laser": overrides})
    suite = suite.select(["my_odometry"])
    source = EXAMPLES / "external_odometry.cpp"
    subprocess.run(["g++", "-o", tmp_path / "external_odometry", source], check=True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="add --trust"):
        run_suite(suite, {"my_odometry": 1}, n_jobs=1)
    monkeypatch.setenv("ESTIMA_TRUST", "1")
    rows = run_suite(suite, {"my_odometry": 1}, n_jobs=1)
    assert rows["status"].tolist() == ["ok"]
    assert 0.0 < rows["ate_rmse_m"][0] < 1.0


def test_no_seed_or_cache_is_in_the_environment(recording, tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    body = f"import os\nassert 'ESTIMA_RESULTS' not in os.environ\nprint('{_BELIEF}', flush=True)"
    online, _ = run(External(command=child(tmp_path, body)), recording.cut(2))
    assert len(online.means) == 2
    assert os.environ["ESTIMA_RESULTS"]
