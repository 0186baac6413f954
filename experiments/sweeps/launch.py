"""Many runs: skip what is done, and start the rest with Hydra's launcher.

The runs are planned once, here, and packed into jobs; each job reads its own share of the plan. So
workers compose nothing, and any of Hydra's launchers will do.
"""

import hashlib
import importlib.util
import itertools
import json
import os
import platform
import re
import secrets
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from omegaconf import DictConfig

from experiments.runs import paths, store
from experiments.runs.console import RunFailedError, pluralize, progress, warn
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Status
from experiments.sweeps.collect import UNFINISHED
from experiments.sweeps.commands import note_command
from experiments.sweeps.plan import Numbers, Plan, make_plan
from experiments.sweeps.until import Until
from experiments.sweeps.work import (
    compiling_file,
    end_with,
    failure_row,
    may_run,
    run_share,
    share_path,
)
from sim.compiled import ANNOUNCED, note_compiling
from sim.errors import InputError, how_to_install, nearest, require
from sim.files import require_file, write_text

_JOBS_PER_CORE = 4  # enough to keep all busy to the end, few enough to cost little
# What launchers raise when a process of theirs has died; Ray and submitit are extras
_DIED = {"UncompletedJobError", "WorkerCrashedError", "NodeDiedError", "OutOfMemoryError"}
OnDone = Callable[[Path, int], None]


def sweep(
    arguments: Sequence[str], config_dir: str | None = None, on_done: OnDone = lambda *_: None
) -> None:
    """Run all combinations of the swept values, except those already done.

    Parameters
    ----------
    arguments
        Hydra's overrides. A study's `sweeps` are a list of further ones, each with its values;
        its `hydra.sweeper.params` are swept where the arguments do not say otherwise. Those of
        `hydra/launcher` and `hydra.launcher` go to the launcher; `jobs` is the number of jobs
        that the runs are packed into. `until` and what goes with it are for `Until.of`.
    config_dir
        A further folder of options.
    on_done
        Called when all runs have ended, also if some failed, with the folder of the rows and the
        number of runs.

    Raises
    ------
    InputError
        If a configuration does not fit together; then nothing is run.
    RunFailedError
        If a run failed; all others are done, and the rows of the failed ones say how.
    """
    launching = [a for a in arguments if a.lstrip("+~").startswith(_LAUNCHING)]
    _check_launcher(launching)
    n_jobs = _n_jobs(launching)
    until, own = Until.of([a for a in arguments if a not in launching])
    plan = make_plan(own, config_dir)
    plan = plan.name_by(own, config_dir)
    folder = plan.experiment(0).rows_folder
    require(
        folder.is_dir() or not folder.exists(),
        f"{folder}: not a folder; remove it, or choose another name",
    )
    prepare(folder)
    keys, first = np.unique(plan.keys, return_index=True)
    done = np.isin(keys, store.ended(folder, damaged=_drop).done)
    check(plan, np.sort(first[~done]))
    blocks = until.blocks(plan, folder) if until else iter([np.sort(first)])
    block = next(blocks)  # what is wrong with the sweep is said before its command is noted
    command = note_command(folder, arguments, config_dir)
    unfinished = folder / UNFINISHED.format(hashlib.sha256(command.encode()).hexdigest()[:8])
    n_runs = f"{'at most ' * bool(until)}{pluralize(len(keys), 'run')}"
    warn(f"{n_runs}, {done.sum()} of them done before: {paths.short(folder)}")
    wanted = []
    for some in itertools.chain([block], blocks):
        wanted.append(some)
        runs = some[~np.isin(plan.keys[some], store.ended(folder).done)]
        if not len(runs):
            continue
        write_text(unfinished, f"{len(keys)} {command}\n")
        try:
            _launch_all(plan, runs, Jobs(folder, n_jobs), launching)
        except KeyboardInterrupt:
            n_kept = np.isin(keys, store.ended(folder).done).sum()
            raise KeyboardInterrupt(
                f"interrupted; {n_kept} of {len(keys)} runs are kept: run it again to go on"
            ) from None
        except Exception:
            if not np.isin(keys, store.ended(folder).done).any():
                unfinished.unlink(missing_ok=True)  # the command itself is wrong
            raise
        _tidy(folder)
    unfinished.unlink(missing_ok=True)
    every, found = np.concatenate(wanted), store.ended(folder)
    on_done(folder, len(every))
    bad = every[~np.isin(plan.keys[every], found.done)]
    if len(bad):
        why = found.failed.get(int(plan.keys[bad[0]]), "no row was written")
        raise RunFailedError(f"{len(bad)} of {len(every)} runs; first: {why}")


def check(plan: Plan, runs: Numbers) -> None:
    """Check runs before the first begins: all of a small family, and those along each axis."""
    wanted = {(f, n) for f in np.unique(plan.family[runs]) for n in plan.families[f].spread()}
    for i in runs if len(runs) <= len(wanted) else ():
        plan.experiment(i).check()
    for f, n in sorted(wanted) if len(runs) > len(wanted) else ():
        plan.families[f].experiment(n).check()


def _drop(path: Path, error: InputError) -> None:
    """Remove a damaged file of rows, so that its runs are done again; not one of other names.

    Nor one that cannot be read now: its rows may be sound.
    """
    if not store.has_checksum(path) or isinstance(error.__cause__, OSError):
        raise error
    warn(f"estima: {path} does not match its checksum; its runs are done again")
    path.unlink(missing_ok=True)


@dataclass
class Jobs:
    """The jobs of a sweep, and their files.

    Attributes
    ----------
    folder
        Folder of the rows.
    count
        How many there should be.
    name
        What the plan and the journals of this sweep are called; sorted as they begin.
    sizes
        Number of runs of each job, by its journal.
    """

    folder: Path
    count: int
    name: str = field(
        default_factory=lambda: f"{time.time_ns():016x}-{os.getpid()}-{secrets.token_hex(3)}"
    )
    sizes: dict[Path, int] = field(default_factory=dict)

    @property
    def plan(self) -> Path:
        """File that is there while the sweep runs."""
        return self.folder / f"plan-{self.name}.json"

    def add(self, n_runs: int, families: Sequence[Any]) -> str:
        """Write a job's share of the plan, as `Plan.split` gives it; return its number."""
        number = len(self.sizes)
        journal = self.folder / f"rows-{self.name}-{number}{store.JOURNAL}"
        self.sizes[journal] = n_runs
        share = {
            "planner": [platform.node(), os.getpid()],
            "places": [os.getcwd(), str(paths.results())],
            "journal": str(journal),
            "families": families,
        }
        write_text(share_path(self.plan, number), json.dumps(share))
        return str(number)


def _launch_all(plan: Plan, runs: Numbers, jobs: Jobs, launching: Sequence[str]) -> None:
    """Start the runs; find those at which a worker of joblib's died, and go on with the rest."""
    write_text(jobs.plan, json.dumps({"planner": [platform.node(), os.getpid()]}))
    try:
        with _watched(jobs, len(runs)):
            left, again = runs, False
            while len(left):
                died = _launch(plan, left, jobs, launching)
                if died is None:
                    return
                begun = store.find_begun_runs(jobs.folder, f"rows-{jobs.name}")
                if not begun and again:
                    raise RunFailedError(
                        "a process died twice before its first run, perhaps for want of memory; "
                        "try hydra.launcher.n_jobs=1"
                    ) from died
                again = True
                for i in left[np.isin(plan.keys[left], np.array(list(begun), np.uint64))]:
                    one = np.array([i])  # which of them was it?
                    if _launch(plan, one, jobs, [*launching, "hydra.launcher.n_jobs=2"]):
                        _record_death(plan.experiment(i), jobs)
                over = store.ended(jobs.folder, f"rows-{jobs.name}")
                keys = np.array([*over.done, *over.failed], np.uint64)
                left = left[~np.isin(plan.keys[left], keys)]
    finally:
        note_compiling(None)
        _remove(jobs.plan)


def _launch(plan: Plan, runs: Numbers, jobs: Jobs, launching: Sequence[str]) -> Exception | None:
    """Write the shares and start their jobs; return the error if a process of joblib's has died.

    Raises
    ------
    RunFailedError
        If a process of another launcher's has died.
    """
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    tie_workers()
    numbers = [jobs.add(*share) for share in plan.split(runs, jobs.count)]
    arguments, os.environ["HYDRA_FULL_ERROR"] = sys.argv, "1"  # its errors come to the caller
    sys.argv = [
        "estima run",
        "-m",
        *launching,
        *_for_cluster(launching),
        f"plan={paths.quoted(jobs.plan)}",
        f"job={','.join(numbers)}",
    ]
    try:
        job_application()
    except TerminatedWorkerError as error:
        died: Exception = error
        return died
    except ConnectionError as error:  # Ray's
        raise InputError(f"{error}; see hydra.launcher.ray.init.address") from error
    except Exception as error:
        if type(error).__name__ not in _DIED:
            raise
        raise RunFailedError(
            f"a job's process died ({type(error).__name__}); what was finished is kept: start the "
            "sweep again, with hydra/launcher=joblib to find a run that always kills its process"
        ) from error
    finally:
        sys.argv = arguments
    return None


def tie_workers() -> None:
    """Let joblib's workers end with this process, also those that never get a job."""
    from joblib._parallel_backends import LokyBackend
    from joblib.parallel import BACKENDS

    me = platform.node(), os.getpid()
    BACKENDS["loky"] = partial(LokyBackend, initializer=end_with, initargs=me)


def _for_cluster(launching: Sequence[str]) -> list[str]:
    """Overrides that make Ray's launcher omit a setting that a running cluster rejects."""
    memory = "hydra.launcher.ray.init.object_store_memory"
    given = {argument.lstrip("+").partition("=")[0] for argument in launching}
    if "hydra.launcher.ray.init.address" in given and memory not in given:
        return [f"+{memory}=null"]
    return []


def _remove(plan: Path) -> None:
    plan.unlink(missing_ok=True)
    shutil.rmtree(f"{plan}.jobs", ignore_errors=True)


def prepare(folder: Path) -> None:
    """Tidy a folder of rows after sweeps that were killed.

    Raises
    ------
    InputError
        If a plan or a journal is not a file, or cannot be read.
    """
    for plan in folder.glob("plan-*.json"):  # of this machine, with what they were writing
        require_file(plan)
        if may_run(plan):
            continue
        _remove(plan)
        for part in folder.glob(f".rows-{plan.stem.removeprefix('plan-')}*.part*"):
            part.unlink(missing_ok=True)
    _tidy(folder)


def _tidy(folder: Path) -> None:
    def is_running(journal: str) -> bool:
        name = journal.removeprefix("rows-").rpartition("-")[0]
        return (folder / f"plan-{name}.json").exists()

    store.tidy(folder, is_running)


_LAUNCHING = ("hydra/launcher", "hydra.launcher", "jobs=")
_LAUNCHERS = ("basic", "joblib", "submitit_local", "submitit_slurm", "ray", "ray_aws")
_EXTRAS = {"submitit": "slurm", "ray": "ray"}


def _check_launcher(launching: Sequence[str]) -> None:
    """Check that the launcher is installed, where Hydra would only say that it knows none."""
    for argument in launching:
        wrong = re.fullmatch(r"\+*hydra\.launcher\.n_jobs=[+-]?(0+|\d{5,})", argument)
        require(not wrong, f"{argument}: give the number of processes, or -1 for all cores")
        name = argument.partition("=")[2]
        plugin = name.partition("_")[0]
        if not argument.lstrip("+").startswith("hydra/launcher="):
            continue
        require(
            name in _LAUNCHERS or importlib.util.find_spec(f"hydra_plugins.{plugin}"),
            f"no hydra/launcher named {name}; {nearest(name, _LAUNCHERS)} (docs/clusters.md)",
        )
        if (
            plugin in _EXTRAS
            and importlib.util.find_spec(f"hydra_plugins.hydra_{plugin}_launcher") is None
        ):
            raise InputError(
                f"hydra/launcher={name} is an extra that is not installed: "
                f"{how_to_install(_EXTRAS[plugin])}"
            )


def _n_jobs(launching: Sequence[str]) -> int:
    """Into how many jobs the runs are packed; see conf/job.yaml."""
    given = [a.partition("=")[2] for a in launching if a.lstrip("+~").startswith("jobs=")]
    if given in ([], ["null"]):
        return _JOBS_PER_CORE * (os.cpu_count() or 1)
    require(
        len(given) == 1 and given[0].isdecimal() and int(given[0]),
        f"jobs={','.join(given)}: give one whole number, 1 or more",
    )
    return int(given[0])


@hydra.main(version_base="1.3", config_path=str(paths.CONF), config_name="job")
def job_application(cfg: DictConfig) -> None:
    """Read one job's share of the plan, and run it."""
    try:
        share = json.loads(share_path(cfg.plan, cfg.job).read_text())
    except OSError as error:
        raise InputError(f"{cfg.plan}: the plan is gone; start the sweep again") from error
    end_with(*share["planner"])
    if os.getpid() != share["planner"][1]:  # joblib's workers stay, as they were, for later sweeps
        folder, os.environ["ESTIMA_RESULTS"] = share["places"]
        os.chdir(folder)
    note_compiling(compiling_file(cfg.plan))
    run_share(share)


def _record_death(experiment: Experiment, jobs: Jobs) -> None:
    """Leave the row of a run whose process died."""
    status = Status(Outcome.FAILED, "died", "its process died (out of memory?)")
    path = jobs.folder / f"rows-{jobs.name}-{experiment.key}{store.JOURNAL}"
    with store.journal(path) as journal:
        journal.append([failure_row(experiment, status)])


@contextmanager
def _watched(jobs: Jobs, n_runs: int) -> Iterator[None]:
    """Show how many runs are done and failed, at what rate, and the time that remains.

    The rate counts from the second run on, and again from the second that ended after code was
    compiled: imports and compiling say nothing of the rest.
    """
    ended = threading.Event()

    def watch() -> None:
        counts: dict[Path, tuple[int, int, int]] = {}
        compiled_ns, done_then, shown, over = 0, 0, 0, False
        note = compiling_file(jobs.plan)
        with progress("", n_runs, "runs", summary=True) as on_progress:
            while not over:
                over = ended.wait(0.5)
                noted_ns = note.stat().st_mtime_ns if note.exists() else 0
                if noted_ns and not compiled_ns:
                    warn(ANNOUNCED)
                for journal in list(jobs.sizes):
                    counts[journal] = _counted(journal, jobs.sizes[journal], counts.get(journal))
                done, failed = (sum(count[i] for count in counts.values()) for i in (1, 2))
                if over:
                    found = store.ended(jobs.folder, f"rows-{jobs.name}", lambda *_: None)
                    done, failed = len(found.done) + len(found.failed), len(found.failed)
                if noted_ns != compiled_ns:
                    compiled_ns, done_then = noted_ns, done
                if done:
                    restart = shown <= done_then + 1
                    on_progress(min(done, n_runs), failed, restart=restart)
                    shown = done

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _counted(
    journal: Path, n_runs: int, before: tuple[int, int, int] | None
) -> tuple[int, int, int]:
    """Bytes read of a journal, and the runs that ended and failed in them.

    A journal that was there and is gone is that of a job that has ended.
    """
    place, done, failed = before or (0, 0, 0)
    try:
        with journal.open("rb") as file:
            file.seek(place)
            read = file.read()
    except FileNotFoundError:
        return (place, n_runs, failed) if before and place else (0, done, failed)
    whole = read[: read.rfind(b"\n") + 1]
    kinds = [line[store.KIND_AT] for line in whole.splitlines() if len(line) > store.KIND_AT]
    return (
        place + len(whole),
        done + sum(kind in store.ENDED for kind in kinds),
        failed + kinds.count(store.ENDED[-1]),
    )
