"""Old and new code in alternation, in the same minutes on one core: ratios, with intervals.

Times of different days differ by more than most changes do, and on a busy machine so do those of
one tenth of a second and the next. So a second checkout of the code, at an earlier revision, runs
in turn with the code as it is. In each of ROUNDS, a process of either is asked for the same, and
they take turns every few milliseconds, wherever the code looks at the clock.
"""

import dataclasses
import json
import math
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.bench.measure import Measurement
from experiments.evaluation.statistics import Interval, log_ratio_interval
from experiments.runs import paths
from experiments.runs.console import warn
from sim.errors import InputError, require, required

ROUNDS = 5  # of fresh processes
_SLICE_S = 0.003  # of processor time, after which a process lets the other one run
_TURNS = range(6, 41)  # of a round, as many as the noise asks for;
_SURE = 0.02  # until the medians have this standard error, as a share,
_ROUND_S = 20.0  # or this time is up
_EXCEPTION = re.compile(r"[\w.]+(Error|Exception)\b")  # begins the last line of a traceback
_LOCK = "requirements.lock"  # of the environment
_WALL = ("compile", "external", "score", "sweep", "sweep_scale")  # their children do the work
_BENCH = """
from experiments.bench import run_bench
def answer(name):
    return json.loads(run_bench(name, as_json=True))["results"]
"""
# The clocks give processor time. Where they are read, a process that has run for a while answers
# null, and waits until it is asked again; what that takes does not count. One that holds a lock
# goes on, as the other may need it. What else the code prints goes to stderr.
_SERVED = """
import fcntl, json, sys, threading, time
out, sys.stdout = sys.stdout, sys.stderr
own, lost_s, last_s, main = time.process_time, 0.0, 0.0, threading.get_ident()
lock, locked = fcntl.flock, []
def flock(file, how):
    lock(file, how)
    locked[:] = [one for one in [*locked, file] if not getattr(one, "closed", True)]
fcntl.flock = flock
def processor_s():
    global lost_s, last_s
    now_s, before_s = own(), lost_s
    goes_on = threading.get_ident() != main or not all(file.closed for file in locked)
    if now_s - last_s > {slice_s} and not goes_on:
        print("null", file=out, flush=True)
        sys.stdin.readline()
        last_s = own()
        lost_s += last_s - now_s
    return now_s - before_s
if {slice_s}:
    time.process_time = time.perf_counter = processor_s
{script}
for line in iter(sys.stdin.readline, ""):
    print(json.dumps(answer(line.strip())), file=out, flush=True)
"""
Ask = Callable[[str], Any]


@dataclass(frozen=True)
class Checkout:
    """A folder of the code, and the commit that it holds."""

    folder: Path
    commit: str


def git(*words: str, folder: Path | None = None) -> str:
    """What git prints, in the clone or in another folder.

    Raises
    ------
    InputError
        If git fails.
    """
    place = folder or paths.SOURCE
    try:
        ran = subprocess.run(["git", "-C", str(place), *words], capture_output=True, text=True)
    except OSError as error:
        raise InputError(f"git: {error.strerror}; install it") from error
    why = (ran.stderr.strip().splitlines() or [f"code {ran.returncode}"])[0]
    require(ran.returncode == 0, f"git {words[0]}: {why}")
    return ran.stdout.strip()


def commit_of(revision: str, folder: Path | None = None) -> str:
    """The whole name of a revision's commit.

    Raises
    ------
    InputError
        If there is none.
    """
    try:
        require(not revision.startswith("-"), "an option of git's")
        return git("rev-parse", f"{revision}^{{commit}}", folder=folder)
    except InputError:
        raise InputError(
            f"{revision}: no such revision; `git log` lists them, and `git fetch` gets those that "
            "this clone lacks"
        ) from None


def clone_of(file: Path) -> Path | None:
    """The clone that a file lies in; None for that of the running code."""
    if file.resolve().is_relative_to(paths.CONF.resolve()):
        return None
    for folder in file.resolve().parents:
        if (folder / ".git").exists():
            return folder
    raise InputError(f"{file}: in no git repository, so its commits cannot be run")


def checkout(revision: str, folder: Path | None = None) -> Checkout:
    """Check a revision out into the cache, as a `git worktree`; take the one that is there.

    Parameters
    ----------
    folder
        The clone; by default that of the running code.
    """
    commit = commit_of(revision, folder)
    place = paths.results() / "cache" / "checkouts" / commit[:12]
    if not (place / ".git").exists():
        place.parent.mkdir(parents=True, exist_ok=True)
        git("worktree", "add", "-d", "-f", str(place), commit, folder=folder)
        _share_compiled(folder or paths.SOURCE, place)
    here, there = ((f / _LOCK) for f in (folder or paths.SOURCE, place))
    if here.exists() and (not there.exists() or here.read_bytes() != there.read_bytes()):
        warn(f"estima: {_LOCK} differs at {revision}; both run in the environment of now")
    return Checkout(place, commit)


def _share_compiled(here: Path, there: Path) -> None:
    """Give a checkout the compiled code of here, if every file that it was compiled from is equal.

    Compiled functions hold those of other files, so one that differs is enough to compile again.
    """
    compiled = [p for room in ("sim", "estimators") for p in (here / room).rglob("*.nb[ic]")]
    sources = {p.parent.parent / f"{p.name.partition('.')[0]}.py" for p in compiled}
    pairs = [(source, there / source.relative_to(here)) for source in sources]
    if all(s.exists() and t.exists() and s.read_bytes() == t.read_bytes() for s, t in pairs):
        for source, copy in pairs:
            shutil.copystat(source, copy)  # numba compares the time of the last change
        for path in compiled:
            copy = there / path.relative_to(here)
            copy.parent.mkdir(exist_ok=True)
            shutil.copy2(path, copy)


def _command(folder: Path, script: str, *arguments: str) -> dict[str, Any]:
    """How a script starts that imports the code of a folder before that of now."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    found = os.pathsep.join(map(str, (folder, paths.SOURCE)))
    places = {"PYTHONPATH": found, "ESTIMA_RESULTS": str(paths.results())}
    command = [sys.executable, "-c", script, *arguments]
    return {"args": command, "cwd": folder, "env": {**os.environ, **threads, **places}}


def _why(stderr: str, code: int | None) -> str:
    """The last line that names an exception, whose message may go on below; else the last one."""
    lines = stderr.strip().splitlines() or [f"code {code}"]
    return ([line for line in lines if _EXCEPTION.match(line)] or lines)[-1]


def run_in(folder: Path, script: str, *arguments: str) -> Any:
    """What a script prints, as JSON, that imports the code of a folder before that of now.

    Raises
    ------
    InputError
        If it fails.
    """
    ran = subprocess.run(**_command(folder, script, *arguments), capture_output=True, text=True)
    require(ran.returncode == 0, f"{folder}: {_why(ran.stderr, ran.returncode)}")
    return json.loads(ran.stdout)


@contextmanager
def serving(
    script: str, arguments: Sequence[str], folder: Path, slice_s: float = _SLICE_S
) -> Iterator[Ask]:
    """A process with the code of a folder, which is asked for one item after the other.

    It answers None where the other process should run for a while; ask again.

    Parameters
    ----------
    script
        Defines `answer`, a function of the item that returns what JSON can hold, by the clocks
        of processor time.
    slice_s
        Processor time between such answers; 0: none, and the clocks are those of the system.

    Raises
    ------
    InputError
        When asked, if it fails.
    """
    with tempfile.TemporaryFile("w+") as errors:
        child = subprocess.Popen(
            **_command(folder, _SERVED.format(script=script, slice_s=slice_s), *arguments),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )

        asked, answered = required(child.stdin, "pipe"), required(child.stdout, "pipe")

        def ask(item: str) -> Any:
            try:
                asked.write(f"{item}\n")
                asked.flush()
                return json.loads(answered.readline())
            except (OSError, ValueError):
                child.kill()
                child.wait()
                errors.seek(0)
                why = _why(errors.read(), child.returncode)
                raise InputError(f"{folder}: {why}") from None

        with child:
            try:
                yield ask
            finally:
                child.kill()


@contextmanager
def on_one_core() -> Iterator[None]:
    """Hold this process and its children to one core, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def alternate(
    start: Callable[[Path], AbstractContextManager[Ask]],
    items: Sequence[str],
    new: Path,
    old: Path,
    on_progress: Callable[[float], None] = lambda _: None,
) -> dict[str, Interval]:
    """Ratio new / old of each figure that both give, with its 95 % interval over ROUNDS.

    Parameters
    ----------
    start
        Starts a process with the code of a folder, which answers an item with its figures, or
        with None where the other should run for a while.
    """
    rounds: dict[str, list[float]] = {}
    with on_one_core():
        for number in range(ROUNDS):
            with start(old) as before, start(new) as now:
                for done, item in enumerate(items, start=1):
                    for name, ratios in _turns(item, now, before, number).items():
                        rounds.setdefault(name, []).append(statistics.median(ratios))
                    on_progress((number + done / len(items)) / ROUNDS)
    every = {name: medians for name, medians in rounds.items() if len(medians) == ROUNDS}
    return {name: log_ratio_interval(m, np.ones(ROUNDS)) for name, m in every.items()}


def _turns(item: str, now: Ask, before: Ask, first: int) -> dict[str, list[float]]:
    """Ratios of each figure by turns: who comes first changes, so that no drift favours either."""
    ratios: dict[str, list[float]] = {}
    until = math.inf  # the first turn may have to compile
    for turn in range(first, first + _TURNS.stop - 1):
        given: dict[Ask, Mapping[str, float]] = {}
        waiting = [now, before] if turn % 2 else [before, now]
        while waiting:
            given |= {ask: found for ask in waiting if (found := ask(item)) is not None}
            waiting = [ask for ask in waiting if ask not in given]
        for name, value in given[now].items():
            if value > 0.0 and given[before].get(name, 0.0) > 0.0:
                ratios.setdefault(name, []).append(value / given[before][name])
        until = min(until, time.monotonic() + _ROUND_S)
        if time.monotonic() >= until or all(map(_is_sure, ratios.values())):
            break
    return ratios


def _is_sure(ratios: Sequence[float]) -> bool:
    """Whether their median has a small standard error, taken from the deviations' median."""
    away = float(np.median(np.abs(np.array(ratios) - np.median(ratios))))
    return len(ratios) >= _TURNS.start and 1.86 * away / math.sqrt(len(ratios)) < _SURE


def run_against(
    name: str, revision: str, on_progress: Callable[[float], None] = lambda _: None
) -> list[Measurement]:
    """A suite's last measurements of the code as it is, with their ratios to a revision's."""
    old, slice_s = checkout(revision), 0.0 if name in _WALL else _SLICE_S
    last: Sequence[Mapping[str, Any]] = ()

    @contextmanager
    def start(folder: Path) -> Iterator[Ask]:
        with serving(_BENCH, [], folder, slice_s) as ask:

            def figures(item: str) -> dict[str, float] | None:
                nonlocal last
                results = ask(item)
                if results is None:
                    return None
                if folder == paths.SOURCE:
                    last = results
                return {result["name"]: result["value"] for result in results}

            yield figures

    ratios = alternate(start, [name], paths.SOURCE, old.folder, on_progress=on_progress)
    found = [Measurement(**result) for result in last]
    return [
        dataclasses.replace(m, ratio=r.value, ratio_low=r.low, ratio_high=r.high)
        if (r := ratios.get(m.name))
        else m
        for m in found
    ]
