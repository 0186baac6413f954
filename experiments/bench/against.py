"""Old and new code in alternation, in the same minutes on one core: ratios, with intervals.

Times of different days differ by more than most changes do. So a second checkout of the code, at
an earlier revision, runs in turn with the code as it is, and each pair of runs gives a ratio.
"""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.bench.measure import Measurement
from experiments.evaluation.statistics import Interval, log_ratio_interval
from experiments.runs import paths
from experiments.runs.console import warn
from sim.errors import InputError, require

PAIRS = 5
_LOCK = "requirements.lock"  # of the environment
_WALL = ("compile", "external", "sweep", "sweep_scale")  # their children do the work
_BENCH = """
import sys, time
if sys.argv[2] == "processor":
    time.perf_counter = time.process_time
from experiments.bench import run_bench
print(run_bench(sys.argv[1], as_json=True))
"""


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
    require(not revision.startswith("-"), f"{revision} is not a revision")
    commit = git("rev-parse", f"{revision}^{{commit}}", folder=folder)
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


def run_in(folder: Path, script: str, *arguments: str) -> Any:
    """What a script prints, as JSON, that imports the code of a folder before that of now.

    Raises
    ------
    InputError
        If it fails.
    """
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    found = os.pathsep.join(map(str, (folder, paths.SOURCE)))
    places = {"PYTHONPATH": found, "ESTIMA_RESULTS": str(paths.results())}
    ran = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        cwd=folder,
        env={**os.environ, **threads, **places},
        capture_output=True,
        text=True,
    )
    why = (ran.stderr.strip().splitlines() or [f"code {ran.returncode}"])[-1]
    require(ran.returncode == 0, f"{folder}: {why}")
    return json.loads(ran.stdout)


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
    measure: Callable[[Path], Mapping[str, float]],
    new: Path,
    old: Path,
    pairs: int = PAIRS,
    on_progress: Callable[[float], None] = lambda _: None,
) -> dict[str, Interval]:
    """Ratio new / old of each figure that both give, with its 95 % interval over the pairs.

    The order turns with each pair, so that a machine that slows down favours neither.
    """
    times: dict[Path, list[Mapping[str, float]]] = {new: [], old: []}
    with on_one_core():
        for pair in range(pairs):
            for folder in (new, old) if pair % 2 else (old, new):
                times[folder].append(measure(folder))
            on_progress((pair + 1) / pairs)
    runs = [*times[new], *times[old]]
    names = [name for name in runs[0] if all(run.get(name, 0.0) > 0.0 for run in runs)]
    return {
        name: log_ratio_interval(
            [run[name] for run in times[new]], [run[name] for run in times[old]]
        )
        for name in names
    }


def run_against(
    name: str, revision: str, on_progress: Callable[[float], None] = lambda _: None
) -> list[Measurement]:
    """A suite's last measurements of the code as it is, with their ratios to a revision's."""
    old, clock = checkout(revision), "wall" if name in _WALL else "processor"
    last: Sequence[Mapping[str, Any]] = ()

    def measure(folder: Path) -> dict[str, float]:
        nonlocal last
        results = run_in(folder, _BENCH, name, clock)["results"]
        if folder == paths.SOURCE:
            last = results
        return {result["name"]: result["value"] for result in results}

    ratios = alternate(measure, paths.SOURCE, old.folder, on_progress=on_progress)
    found = [Measurement(**result) for result in last]
    return [
        dataclasses.replace(m, ratio=r.value, ratio_low=r.low, ratio_high=r.high)
        if (r := ratios.get(m.name))
        else m
        for m in found
    ]
