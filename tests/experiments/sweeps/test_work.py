"""Workers of a sweep end with their planner, whatever they are doing."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.sweeps.work import is_alive
from tests.experiments.cli.test_cli import ROOT
from tests.experiments.sweeps.conftest import SHORT, folder
from tests.experiments.sweeps.test_sweep import own_estimator


@pytest.mark.slow
def test_a_worker_in_compiled_code_ends_with_its_planner(name, tmp_path):
    """A regular expression that goes back and forth holds Python's lock for hours."""
    note = tmp_path / "worker"
    body = (
        f"import re; open({str(note)!r}, 'w').write(str(os.getpid())); "
        "re.match('(a+)+$', 'a' * 60 + 'b')"
    )
    words = own_estimator(tmp_path, body)
    planner = subprocess.Popen(
        [sys.executable, "-m", "experiments.cli", *words, "seed=0,1,2", f"name={name}", *SHORT],
        cwd=ROOT,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}"},
    )
    while not (note.exists() and note.read_text()):
        assert planner.poll() is None
        time.sleep(0.1)
    time.sleep(1.0)
    worker = int(note.read_text())
    planner.send_signal(signal.SIGKILL)
    planner.wait()
    until = time.monotonic() + 20.0
    while is_alive(worker) and time.monotonic() < until:
        time.sleep(0.1)
    gone = not is_alive(worker)
    if not gone:
        os.kill(worker, signal.SIGKILL)
    assert gone
    assert folder(name).is_dir()


_IDLE = """
import os, sys, time
from joblib import Parallel, delayed
from experiments.sweeps.launch import tie_workers
tie_workers()
with Parallel(n_jobs=2) as workers:
    workers(delayed(time.sleep)(0.1) for _ in range(4))
    print(*workers(delayed(os.getpid)() for _ in range(20)), flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
def test_an_idle_worker_ends_with_its_planner():
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([sys.executable, "-c", _IDLE], cwd=ROOT, **pipes) as planner:
        workers = {int(word) for word in planner.stdout.readline().split()}
        assert workers
        assert all(map(is_alive, workers))
        planner.kill()
    until = time.monotonic() + 20
    while any(map(runs, workers)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(runs, workers))


def runs(process):
    """Whether a process runs; one that ended, and that nobody has asked about, does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
