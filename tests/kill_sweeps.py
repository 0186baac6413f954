"""A sweep that is killed again and again, and the table that it comes to.

    python -m tests.kill_sweeps joblib 20 0 [FOLDER]

Its launcher, the number of kills, and the seed of their moments. SIGKILL meets the planner, one
worker, or all; what had been finished must still be there, and the table in the end must be that of
an undisturbed sweep, to the byte.
"""

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from experiments.runs import store
from experiments.sweeps.collect import collect

ROOT = Path(__file__).resolve().parent.parent
CHEAP = [
    "simulation.physics=kinematic", "world=empty", "route=linear_1", "route.rest_s=0",
    "route.segments=[[0.2,0.0,1.0]]", "robot.kl=${robot.kr}",
]  # fmt: skip
LAUNCHERS = {
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    "ray": ["hydra/launcher=ray", "+hydra.launcher.ray.init.num_cpus=2"],
}
WORKERS = {"joblib": "popen_loky", "ray": "ray::_run_job"}
RUNS_PER_KILL = 20  # about so many end before the next kill


class Sweep:
    """A sweep in a process of its own, with results in a folder of its own."""

    def __init__(self, folder, launcher, n_runs):
        self.rows, self.launcher = folder / "runs" / "kills", launcher
        self.command = [
            sys.executable, "-m", "experiments.cli", "run", "-m", *CHEAP, "name=kills",
            f"seed=range(0,{n_runs // 4})", "robot.kr=1e-6,1e-5,1e-4,1e-3", *LAUNCHERS[launcher],
        ]  # fmt: skip
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), "ESTIMA_RESULTS": str(folder)}
        folder.mkdir(parents=True, exist_ok=True)
        self.said, self.process, self.n_runs = folder / "said.txt", None, n_runs

    def start(self):
        with self.said.open("w") as said:
            self.process = subprocess.Popen(
                self.command, cwd=ROOT, env=self.environment, stderr=said, start_new_session=True
            )

    def is_running(self):
        return self.process is not None and self.process.poll() is None

    def complete(self):
        """Start it until all is done."""
        for _ in range(3):
            self.start()
            if self.process.wait() == 0:
                return
        raise AssertionError(self.said.read_text())

    def done(self):
        """Keys of the runs that are done, by what is on disk."""
        return set(store.ended(self.rows).done.tolist()) if self.rows.is_dir() else set()

    def workers(self):
        """Processes below the planner that compute."""
        wanted = WORKERS[self.launcher]
        return [pid for pid in below(self.process.pid) if wanted in words_of(pid)]


def below(parent):
    """Processes that descend from one, itself left out."""
    children = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            above = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:  # it has just ended
            continue
        children.setdefault(above, []).append(int(path.parent.name))
    found, new = [], [parent]
    while new:
        new = [child for one in new for child in children.get(one, [])]
        found += new
    return found


def words_of(pid):
    """Its command line; none if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
    except OSError:
        return ""


def writes(pid):
    """Whether it has a file of rows open."""
    with contextlib.suppress(OSError):  # it has ended, or is ending
        return any("/rows-" in os.readlink(file) for file in Path(f"/proc/{pid}/fd").iterdir())
    return False


def kill(pids):
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def wait_until(is_so, seconds, what):
    until = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < until, f"not within {seconds} s: {what}"
        time.sleep(0.02)


def disturb(sweep, n_kills, rng):
    """Kill the sweep so often; how often each kind of process, and how many runs were done then."""
    counts, progress = {"planner": 0, "worker": 0, "all": 0}, []
    while sum(counts.values()) < n_kills:
        begins = not sweep.is_running()
        if begins:
            sweep.start()
        if begins and rng.random() < 0.5:  # while it plans, or a little later
            time.sleep(rng.uniform(0.0, 3.0))
        else:
            wanted = len(sweep.done()) + rng.randrange(1, RUNS_PER_KILL)
            while len(sweep.done()) < wanted and sweep.is_running():
                time.sleep(rng.uniform(0.0, 0.3))
        if not sweep.is_running():  # the death of a worker ended it
            assert len(sweep.done()) < sweep.n_runs, f"over after {counts}: plan more runs"
            continue
        kind = rng.choice(list(counts))
        workers, everyone = sweep.workers(), [sweep.process.pid, *below(sweep.process.pid)]
        if kind == "worker" and not workers:
            continue  # none of them at work yet
        before, at_work = sweep.done(), list(filter(writes, workers))
        kill({"planner": everyone[:1], "worker": workers[:1], "all": everyone}[kind])
        counts[kind] += 1
        if kind != "worker":
            sweep.process.wait()
            wait_until(lambda pids=at_work: not any(map(words_of, pids)), 60, "workers ended")
            kill(workers)  # joblib's that had no job yet would wait for one, five minutes long
        progress.append(len(sweep.done()))
        assert before <= sweep.done(), f"rows were lost when {kind} was killed"
    if sweep.is_running():
        kill([sweep.process.pid, *below(sweep.process.pid)])
        sweep.process.wait()
    return counts, progress


def table_of(sweep):
    """The exported table, as bytes."""
    return collect(str(sweep.rows)).to_csv(index=False).encode()


def run(folder, launcher, n_kills, seed):
    """Tables of a killed sweep and of an undisturbed one, and what was killed."""
    n_runs = 2 * RUNS_PER_KILL * n_kills
    killed, whole = (Sweep(folder / name, launcher, n_runs) for name in ("killed", "whole"))
    counts, progress = disturb(killed, n_kills, random.Random(seed))
    killed.complete()
    whole.complete()
    tables = [table_of(sweep) for sweep in (killed, whole)]
    assert tables[1].count(b"\n") == n_runs + 1
    return tables, counts, progress


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(sys.argv[4] if len(sys.argv) > 4 else temporary)
        (left, right), counts, progress = run(
            place, sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
        )
    print(f"{counts}; runs done after each kill: {progress}")
    assert left == right, "another table"
    print(f"the same table, {len(left)} bytes")
