"""Workers of a sweep end with their planner, whatever they are doing."""

import os
import signal
import subprocess
import sys
import time

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
