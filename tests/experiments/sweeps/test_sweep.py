"""Sweeps as they run, and what is left after failures and kills."""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
import pytest

from experiments.runs import cache, store
from experiments.runs.experiment import Experiment
from experiments.runs.paths import results
from experiments.runs.processes import hold_interrupts
from experiments.runs.row import Status, read_rows
from experiments.runs.store import read_runs
from experiments.sweeps import launch, plan, work
from experiments.sweeps.collect import collect
from tests.experiments.cli.test_cli import QUICK, ROOT, called, estima, refused
from tests.experiments.sweeps.conftest import ALONE, SHORT, clear, folder, table_of
from tests.fixtures import kill_sweeps


@pytest.mark.slow
def test_failed_runs_leave_rows_and_the_rest_goes_on(name, tmp_path):
    broken = tmp_path / "broken.py"
    broken.write_text(
        "from estimators.odometry import Odometry\n"
        "class Broken(Odometry):\n"
        "    def step(self, frame):\n"
        "        if frame.stamp > 1.0 and self.kr > 1e-4:\n"
        "            raise ValueError('a planted fault')\n"
        "        return super().step(frame)\n"
    )
    (tmp_path / "conf" / "estimator").mkdir(parents=True)
    option = tmp_path / "conf" / "estimator" / "broken.yaml"
    option.write_text("_target_: broken.Broken\nkr: ${robot.kr}\nkl: ${robot.kl}\n")
    sweep_ = ["run", "-m", "--config-dir", str(tmp_path / "conf"), *ALONE, "estimator=broken",
              "robot.kr=1e-5,1e-3", "seed=0,1", f"name={name}"]  # fmt: skip
    done = estima(*sweep_, PYTHONPATH=f"{ROOT}:{tmp_path}")
    assert done.returncode == 1, done.stderr
    assert "2 of 4 runs" in done.stderr
    assert "a planted fault" in done.stderr
    _, *table = done.stdout.split("\n\n")[1].splitlines()
    assert [line.split()[:3] for line in table] == [["1e-5", "2", "0"], ["1e-3", "2", "2"]]
    assert "Next: estima table" in done.stdout
    rows = table_of(name)
    assert len(rows) == 4
    assert sorted(rows["status"] == "ok") == [False, False, True, True]
    before = set(folder(name).glob("*.parquet"))
    again = estima(*sweep_, PYTHONPATH=f"{ROOT}:{tmp_path}")
    assert "2 of them done before" in again.stderr
    later = set(folder(name).glob("*.parquet")) - before
    assert sum(len(read_rows(path)) for path in later) == 2  # only what had failed
    assert len(table_of(name)) == 4


def own_estimator(folder, body):
    """Files of an estimator of one's own, `how` being its option; the words to sweep it by."""
    (folder / "estuary.py").write_text(
        "import os, sys\n"
        "from estimators.odometry import Odometry\n"
        "class Own(Odometry):\n"
        "    def __init__(self, how, **rest):\n"
        "        super().__init__(**rest)\n"
        "        self.how = how\n"
        "    def step(self, frame):\n"
        f"        {body}\n"
        "        return super().step(frame)\n"
    )
    (folder / "conf" / "estimator").mkdir(parents=True, exist_ok=True)
    (folder / "conf" / "estimator" / "estuary.yaml").write_text(
        "_target_: estuary.Own\nhow: sound\nkr: ${robot.kr}\nkl: ${robot.kl}\n"
        "window_s: 0.1\nintegration: arc\n"
    )
    return ["run", "-m", "--config-dir", str(folder / "conf"), *SHORT, "estimator=estuary"]


@pytest.mark.skipif(joblib.cpu_count() < 2, reason="on one core joblib has no workers")
@pytest.mark.parametrize(
    ("body", "words"),
    [pytest.param("self.how == 'bad' and sys.exit(0)", "SystemExit", marks=pytest.mark.slow),
     ("self.how == 'bad' and os._exit(3)", "process died")],
    ids=["exits", "dies"],
)  # fmt: skip
def test_an_estimator_that_ends_its_process_costs_its_own_runs(name, tmp_path, body, words):
    arguments = own_estimator(tmp_path, body)
    done = estima(*arguments, "estimator.how=sound,bad", "seed=0,1", f"name={name}",
                  PYTHONPATH=f"{ROOT}:{tmp_path}")  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert "2 of 4 runs" in done.stderr
    rows = table_of(name)
    assert (rows.loc[rows["estimator.how"] == "sound", "status"] == "ok").all()
    bad = rows[rows["estimator.how"] == "bad"]
    assert (bad["status"] == "failed").all()
    assert (bad["status_code"] + ": " + bad["status_detail"]).str.contains(words).all()
    assert len(rows) == 4
    assert {path.suffix for path in folder(name).iterdir()} == {"", ".parquet", ".txt"}


@pytest.mark.slow
def test_rows_of_an_edited_estimator_do_not_mix(name, tmp_path, capsys):
    for body in ("pass", "frame.wheel_increments_m"):
        words = own_estimator(tmp_path, body)
        done = estima(
            *words,
            "hydra/launcher=basic",
            "seed=0,1",
            f"name={name}",
            PYTHONPATH=f"{ROOT}:{tmp_path}",
        )
        assert done.returncode == 0, done.stderr
        assert "0 of them done before" in done.stderr
    assert len(table_of(name)) == 2
    assert "left out 2 rows" in capsys.readouterr().err
    assert len(collect(name, all_versions=True)) == 4


@pytest.mark.slow
def test_two_sweeps_of_one_name_at_once(name):
    command = [sys.executable, "-m", "experiments.cli", "run", "-m", *SHORT, f"name={name}",
               "hydra/launcher=basic"]  # fmt: skip
    both = [
        subprocess.Popen(
            [*command, f"seed=range({low},{low + 15})"], cwd=ROOT, stderr=subprocess.PIPE,
            text=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        for low in (0, 100)
    ]  # fmt: skip
    for process in both:
        _, errors = process.communicate(timeout=120)
        assert process.returncode == 0, errors
    assert sorted(table_of(name)["seed"]) == [*range(15), *range(100, 115)]
    assert {path.suffix for path in folder(name).iterdir()} == {"", ".parquet", ".txt"}


@pytest.mark.slow
def test_workers_end_with_a_killed_sweep(name):
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.cli", "run", "-m", *SHORT, f"name={name}",
         "seed=range(0,400)"],
        cwd=ROOT, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    while len(list(folder(name).glob("rows-*"))) < 2:  # both workers are at work
        assert process.poll() is None
        time.sleep(0.1)
    process.kill()
    # the pipe ends once nobody holds it any more
    process.communicate(timeout=30)
    assert list(folder(name).glob("plan-*"))
    assert estima("run", "-m", *SHORT, f"name={name}", "seed=range(400,402)").returncode == 0
    assert not list(folder(name).glob("plan-*"))


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_sweep_says_so_and_leaves_no_plan(name, sent):
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.cli", "run", "-m", *SHORT, f"name={name}",
         "seed=range(0,400)"],
        cwd=ROOT, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
        start_new_session=True,
    )  # fmt: skip
    while not list(folder(name).glob("rows-*")):
        assert process.poll() is None
        time.sleep(0.1)
    if sent == signal.SIGINT:  # a terminal sends it to the workers too
        os.killpg(process.pid, sent)
    else:
        process.send_signal(sent)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors.count("interrupted") == errors.count("kept") == 1
    last = errors.splitlines()[-1]
    assert re.fullmatch(
        r"estima: interrupted; \d+ of 400 runs are kept: run it again to go on", last
    )
    assert not list(folder(name).glob("plan-*"))
    assert not store.ended(folder(name)).failed


@pytest.fixture
def usual_interrupt():
    """An interrupt does what it does in a process of its own."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("usual_interrupt")
def test_an_interrupt_is_no_result_of_a_run(tmp_path, monkeypatch):
    """Compiled code makes an error of it, as an estimator's own `except` may."""

    def evaluated(*_, **__):
        signal.raise_signal(signal.SIGINT)
        raise SystemError("returned a result with an exception set")

    monkeypatch.setattr(work, "evaluate", evaluated)
    experiment = Experiment.compose(SHORT)
    with store.journal(tmp_path / "rows.journal") as journal, pytest.raises(KeyboardInterrupt):
        work.run_and_record(experiment, {}, journal)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    ended = store.ended(tmp_path)
    assert not len(ended.done)
    assert not ended.failed


@pytest.mark.usefixtures("usual_interrupt")
def test_an_interrupt_waits_for_the_next_step_and_a_second_one_does_not():
    reached = []

    def work():
        with hold_interrupts() as on_step:
            on_step(1)
            signal.raise_signal(signal.SIGINT)
            for stop in (on_step, lambda: signal.raise_signal(signal.SIGINT)):
                with pytest.raises(KeyboardInterrupt):
                    stop()
                reached.append(stop)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert len(reached) == 2
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in a worker
    with hold_interrupts():
        signal.raise_signal(signal.SIGINT)


def test_a_sweep_that_has_not_ended_says_so(name, monkeypatch, capsys):
    words = [*ALONE, f"name={name}", "seed=0,1,2"]

    def interrupted(experiment, *_):
        if experiment.seed == 2:
            raise KeyboardInterrupt
        return original(experiment, *_)

    original = work.run_and_record
    monkeypatch.setattr(work, "run_and_record", interrupted)
    with pytest.raises(KeyboardInterrupt, match="2 of 3 runs are kept"):
        launch.sweep(words)
    capsys.readouterr()
    assert len(table_of(name)) == 2
    said = capsys.readouterr().err
    assert "2 runs so far: the sweep of 3 is unfinished; to go on: estima run -m" in said
    monkeypatch.undo()
    launch.sweep(words)
    capsys.readouterr()
    assert len(table_of(name)) == 3
    assert not capsys.readouterr().err


@pytest.mark.slow
def test_values_that_no_column_holds_fail_alone(name):
    done = called("run", "-m", *ALONE, "seed=1,2,99999999999999999999999", f"name={name}",
                  "world.n_objects=6,6.5")  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert "3 of 6 runs" in done.stderr
    rows = table_of(name)
    assert len(rows) == 6
    assert (rows["status"] == "ok").sum() == 3
    out = folder(name).parent / f"{name}.csv"
    try:
        assert called("table", name, "--rows", "-o", str(out)).returncode == 0
        assert len(read_rows(out)) == 6
        plotted = called("plot", name, "--x", "seed", "-o", str(out.with_suffix(".xyz")))
        assert plotted.returncode == 2
        assert "3 of 6 runs failed" in plotted.stderr
        assert "a picture is .png" in plotted.stderr
    finally:
        out.unlink(missing_ok=True)


@pytest.mark.slow
def test_a_sweep_without_a_name_has_one_of_its_own(tmp_path):
    place = {"ESTIMA_RESULTS": str(tmp_path)}
    first = estima("run", "-m", *ALONE, "seed=0,1", **place)
    again = estima("run", "-m", "seed=0,1", *SHORT, "hydra/launcher=joblib", **place)
    other = estima("run", "-m", *ALONE, "seed=0,1,2", **place)
    assert "2 runs, 0 of them done before" in first.stderr
    assert "2 runs, 2 of them done before" in again.stderr
    assert "3 runs, 0 of them done before" in other.stderr
    folders = {path.name for path in (tmp_path / "runs").iterdir()}
    assert len(folders) == 2
    for own in folders:
        assert re.fullmatch("sweep_[0-9a-f]{8}", own)
        assert own in first.stderr + other.stderr


@pytest.mark.slow
def test_files_that_are_not_the_runs_rows(name):
    swept_ = ["run", "-m", *ALONE, "seed=0,1,2", f"name={name}"]
    assert called(*swept_).returncode == 0
    expected = table_of(name)
    first, second, *_ = sorted(folder(name).glob("*.parquet"))
    first.write_bytes(second.read_bytes())
    again = called(*swept_)
    assert f"{first} does not match its checksum; its runs are done again" in again.stderr
    assert again.returncode == 0, again.stderr
    pd.testing.assert_frame_equal(table_of(name), expected, check_exact=True)
    expected.to_parquet(folder(name) / "all.parquet")
    assert len(table_of(name)) == 3  # each row once
    (folder(name) / "all.parquet").unlink()
    os.mkfifo(folder(name) / "rows-fifo.parquet")
    refused(called(*swept_), "not a file of rows; remove it")
    (folder(name) / "rows-fifo.parquet").unlink()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["basic", "submitit_local", "ray"])
def test_launchers_give_the_same_table(name, launcher):
    plugin = {"submitit_local": "hydra_submitit_launcher", "ray": "hydra_ray_launcher"}
    if launcher in plugin:
        pytest.importorskip(f"hydra_plugins.{plugin[launcher]}", reason="an extra, not installed")
    swept_ = [*SHORT, "seed=0,1", "robot.kr=1e-5,1e-4"]
    first, second = f"{name}_a", f"{name}_b"
    try:
        for own, choice in ((first, "joblib"), (second, launcher)):
            clear(own)
            done = estima("run", "-m", *swept_, f"name={own}", f"hydra/launcher={choice}")
            assert done.returncode == 0, done.stderr
        left, right = (table_of(own).drop(columns="name") for own in (first, second))
        pd.testing.assert_frame_equal(left, right, check_exact=True)
    finally:
        clear(first)
        clear(second)


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "ray"])
def test_a_killed_sweep_comes_to_the_same_table(launcher, tmp_path):
    if launcher == "ray":
        pytest.importorskip("hydra_plugins.hydra_ray_launcher", reason="an extra, not installed")
    # 20 kills, as docs/clusters.md has them, take ten minutes: python -m tests.fixtures.kill_sweeps
    (killed, undisturbed), counts, _ = kill_sweeps.run(tmp_path, launcher, n_kills=6, seed=0)
    assert killed == undisturbed
    assert sum(counts.values()) == 6
    assert min(counts.values()) > 0


def test_a_job_tried_again_goes_on(tmp_path, monkeypatch):
    """As Ray and SLURM do it, in the midst of a line."""
    every = plan.make_plan([*QUICK, "seed=range(0,4)"])
    jobs = launch.Jobs(tmp_path, 1)
    jobs.add(*next(every.split(np.arange(4), 1)))
    share = json.loads(work.share_path(jobs.plan, 0).read_text())
    ran = []

    def run(experiment, _, journal):
        ran.append(experiment.seed)
        journal.begin(experiment.key)
        journal.append([{**experiment.labels(""), "seed": experiment.seed, **Status().columns()}])
        if len(ran) == 2:
            with journal.path.open("a") as file:
                file.write('0123abcd b"half a li')
            raise KeyboardInterrupt

    monkeypatch.setattr(work, "run_and_record", run)
    with pytest.raises(KeyboardInterrupt):
        work.run_share(share)
    for _ in range(2):
        work.run_share(share)
        assert ran == [0, 1, 2, 3]
    assert sorted(read_runs(tmp_path)["seed"]) == [0, 1, 2, 3]


def test_a_bad_combination_in_a_large_family_fails_alone(tmp_path):
    """Each of its values is sound with the others' first, so no check finds it before."""
    every = plan.make_plan(
        [*SHORT, "sensors=hokuyo", "estimator=mcl", "prior.map=world", "seed=range(0,600)",
         "estimator.min_particles=100,5000", "estimator.max_particles=20000,2000"]
    )  # fmt: skip
    assert len(every.families) == 1
    launch.check(every, np.arange(2400))
    with store.journal(tmp_path / "rows-0.journal") as journal:
        for i in (1, 3):
            work.run_and_record(every.experiment(i), {}, journal)
    rows = read_runs(tmp_path).set_index("estimator.min_particles")
    assert rows.loc[100, "status"] != "failed"
    assert rows.loc[5000, "status"] == "failed"
    assert "min_particles" in rows.loc[5000, "status_detail"]


@pytest.mark.slow
@pytest.mark.parametrize("full", ["cache", "runs/{name}"], ids=["recordings", "rows"])
def test_a_full_disk_ends_in_a_line_and_a_correct_re_run(name, full, tmp_path):
    place = results() / full.format(name=name)
    command = shlex.join(
        [sys.executable, "-m", "experiments.cli", "run", "-m", *SHORT, "seed=range(0,12)",
         f"name={name}"]
    )  # fmt: skip
    mount = f"mkdir -p {place} && mount -t tmpfs -o size=150k estima {place}"
    if subprocess.run(["unshare", "-rm", "sh", "-c", mount], cwd=ROOT, check=False).returncode:
        pytest.skip("a small disk cannot be mounted here")
    script = (
        f"{mount}\n{command}\necho code $?\nmount -o remount,size=100m {place}\n"
        f"{command}\necho code $?\ncp {folder(name)}/*.parquet {tmp_path}"
    )
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script], cwd=ROOT, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=120, check=False,
    )  # fmt: skip
    said = [line for line in done.stdout.splitlines() if line.startswith("code ")]
    first, second = (int(line.split()[1]) for line in said)
    assert first in (1, 2), done.stderr
    assert second == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("estima: ")]
    assert len(lines) == 1
    assert "No space left on device" in lines[0]
    assert "free some space" in lines[0]
    assert "Traceback" not in done.stderr
    clear(name)
    assert estima("run", "-m", *SHORT, "seed=range(0,12)", f"name={name}").returncode == 0
    pd.testing.assert_frame_equal(collect(str(tmp_path)), table_of(name), check_exact=True)


@pytest.mark.slow
def test_damaged_files_are_made_again(name):
    swept_ = ["run", "-m", *ALONE, "seed=range(90001,90005)", f"name={name}"]
    assert estima(*swept_).returncode == 0
    expected = table_of(name)
    recordings = [
        cache.folder() / f"{Experiment.compose([*SHORT, f'seed={seed}']).recording_key}-0.npz"
        for seed in range(90001, 90005)
    ]
    half = recordings[0].read_bytes()[:5000]
    other = bytearray(recordings[1].read_bytes())
    other[len(other) // 2] ^= 0x10
    recordings[0].write_bytes(half)
    recordings[1].write_bytes(other)
    recordings[2].write_bytes(b"")
    for row in folder(name).glob("*.parquet"):
        row.write_bytes(row.read_bytes()[:-100])
    again = estima(*swept_)
    assert again.returncode == 0, again.stderr
    assert "0 of them done before" in again.stderr
    for recording in recordings[:3]:
        assert any(
            str(recording) in line and "making it again" in line
            for line in again.stderr.splitlines()
        )
    pd.testing.assert_frame_equal(table_of(name), expected, check_exact=True)


def test_compiling_is_said_once_and_restarts_the_rate(tmp_path, monkeypatch, capsys):
    jobs, restarts = launch.Jobs(tmp_path, 1), []
    note = work.compiling_file(jobs.plan)
    note.parent.mkdir()
    ended = iter([1, 2, 3, 4, 5])  # runs at each look; code is compiled before the second

    def counted(*_):
        done = next(ended, 5)
        if done == 1:
            note.touch()
        return 0, done, 0

    @contextlib.contextmanager
    def shown(*_, **__):
        yield lambda done, failed, *, restart: restarts.append((done, restart))

    monkeypatch.setattr(launch, "progress", shown)
    monkeypatch.setattr(launch, "_counted", counted)
    jobs.sizes[tmp_path / "rows-0.jsonl"] = 5
    with launch._watched(jobs, 5):
        deadline = time.monotonic() + 20.0
        while len(restarts) < 5 and time.monotonic() < deadline:
            time.sleep(0.05)
    assert restarts[:5] == [*((n, True) for n in (1, 2, 3, 4)), (5, False)]
    assert capsys.readouterr().err.count("compiling numerical code") == 1


@pytest.mark.slow
def test_nothing_is_left_of_the_plan(name):
    done = estima("run", "-m", *SHORT, "seed=0,1", f"name={name}")
    assert done.returncode == 0, done.stderr
    assert {path.suffix for path in folder(name).iterdir()} == {"", ".parquet", ".txt"}
    assert not list(Path.cwd().glob("multirun*"))
