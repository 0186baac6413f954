"""Many runs: leave out what is done, start the rest by Hydra's launcher.

The runs are composed once, here, and packed into jobs; each job reads its share of the plan. So a
run costs no composition of its own in the workers, and any of Hydra's launchers will do.
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import secrets
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import hydra
from omegaconf import DictConfig

from experiments.runs import paths
from experiments.runs.console import RunFailedError, progress
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Status, read_rows, write_rows
from experiments.sweeps.plan import packed, planned
from sim.errors import InputError
from sim.files import write_whole
from sim.recording import Recording

_JOBS_PER_WORKER = 4  # enough to keep all busy to the end, few enough to cost little


def sweep_arguments(arguments: Sequence[str]) -> None:
    """Sweep by a command line's arguments: overrides, and `--config-dir` with its folder."""
    overrides, config_dir = [], None
    rest = iter(arguments)
    for argument in rest:
        name, equals, value = argument.partition("=")
        if name in ("--config-dir", "-cd"):
            config_dir = value if equals else next(rest, None)
            if config_dir is None or not Path(config_dir).is_dir():
                raise InputError(f"--config-dir must name a folder, got {config_dir}")
        elif argument.startswith("-"):
            raise InputError(f"a sweep takes overrides and --config-dir, not {argument}")
        else:
            overrides.append(argument)
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))  # end as by Ctrl-C
    sweep(overrides, config_dir)


def sweep(arguments: Sequence[str], config_dir: str | None = None) -> None:
    """Run all combinations of the swept values; those that are done already are left out.

    Parameters
    ----------
    arguments
        Hydra's overrides. A study's `sweeps` are a list of further ones, each with its values;
        `hydra.sweeper.params` are swept where the arguments do not say otherwise. Those of
        `hydra/launcher` and `hydra.launcher` go to the launcher.
    config_dir
        A further folder of options.

    Raises
    ------
    RunFailedError
        If a run failed; all others are done, and the rows of the failed ones say how.
    """
    launching = [a for a in arguments if a.lstrip("+~").startswith(_LAUNCHING)]
    _require_launcher(launching)
    own = [a for a in arguments if a not in launching]
    every = list(planned(own, config_dir))
    if not every:
        raise InputError(f"no runs: a value of {' '.join(own)} is an empty range or list")
    folders = {run.rows_folder for run in every}
    if len(folders) > 1:
        raise InputError("name is the folder of all the rows; a sweep has one, not several")
    folder = folders.pop()
    runs = list({run.key: run for run in every}.values())
    missing = [run for run in runs if not is_done(folder, run.key)]
    print(
        f"{len(runs)} runs, {len(runs) - len(missing)} of them done before: {paths.short(folder)}",
        file=sys.stderr,
    )
    if missing:
        _launch_all(missing, folder, launching)
    bad = [status for run in runs if (status := _status(folder, run.key)) is not None]
    if bad:
        raise RunFailedError(f"{len(bad)} of {len(runs)} runs; first: {bad[0]}")


def is_done(folder: Path, key: str) -> bool:
    """Whether the run has rows, and none of them tells of a failure."""
    return (folder / f"{key}.parquet").exists() and _status(folder, key) is None


def _status(folder: Path, key: str) -> str | None:
    """Return how a run failed; None if it did not."""
    path = folder / f"{key}.parquet"
    if not path.exists():
        return "no row was written"
    try:
        rows = read_rows(path)
    except InputError as error:
        return str(error)
    if not {"status", "run_key"} <= set(rows) or (rows["run_key"] != key).any():
        return f"{path} holds other rows; delete it and run again"
    failures = rows[rows["status"] == Outcome.FAILED]
    for _, row in failures.iterrows():
        return f"{row['status_code']}: {row['status_detail']}"
    return None


def _launch_all(runs: Sequence[Experiment], folder: Path, launching: Sequence[str]) -> None:
    """Start the runs; those at which a worker died are told apart, and the rest goes on."""
    for run in runs:  # rows of an earlier failure, and files that are no rows
        path = folder / f"{run.key}.parquet"
        if path.is_dir():
            raise InputError(f"{path}: a folder in place of a table; remove it")
        if path.exists() and not is_done(folder, run.key):
            path.unlink(missing_ok=True)
        path.with_suffix(".failed").unlink(missing_ok=True)
        _begun(folder, run.key).unlink(missing_ok=True)
    _clear_plans(folder)
    with _Watch(folder, [run.key for run in runs]):
        left = list(runs)
        while left:
            died = _launch(left, folder, launching)
            if died is None:
                return
            begun = [run for run in left if _begun(folder, run.key).exists()]
            if not begun:
                raise died
            for run in begun:  # which of them was it?
                if _launch([run], folder, [*launching, "hydra.launcher.n_jobs=2"]) is not None:
                    _record_failure(run, _DIED)
                _begun(folder, run.key).unlink(missing_ok=True)
            left = [run for run in left if not (folder / f"{run.key}.parquet").exists()]


def _launch(runs: Sequence[Experiment], folder: Path, launching: Sequence[str]) -> Exception | None:
    """Write the plan and start its jobs; return the error if a process of joblib's has died."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    jobs = packed(runs, _JOBS_PER_WORKER * (os.cpu_count() or 1))
    plan = folder / f"plan-{os.getpid()}-{secrets.token_hex(3)}.json"
    text = json.dumps(
        {
            "planner": [platform.node(), os.getpid()],
            "places": [os.getcwd(), str(paths.results())],
            "jobs": [[[r.config, r.choices] for r in job] for job in jobs],
        }
    )
    with write_whole(plan) as part:
        part.write_text(text)
    arguments = sys.argv
    sys.argv = [
        "estima run",
        "-m",
        *launching,
        f"plan={paths.quoted(plan)}",
        f"job={','.join(str(number) for number in range(len(jobs)))}",
    ]
    try:
        job_application()
    except TerminatedWorkerError as error:
        died: Exception = error
        return died
    finally:
        sys.argv = arguments
        plan.unlink(missing_ok=True)
        shutil.rmtree(f"{plan}.jobs", ignore_errors=True)
    return None


def _clear_plans(folder: Path) -> None:
    """Remove what sweeps of this machine left that were killed."""
    for plan in folder.glob("plan-*.json"):
        try:
            node, planner = json.loads(plan.read_text())["planner"]
            if node == platform.node():
                os.kill(planner, 0)  # is it there?
        except ProcessLookupError:
            plan.unlink(missing_ok=True)
            shutil.rmtree(f"{plan}.jobs", ignore_errors=True)
        except (OSError, ValueError, KeyError, TypeError):
            continue


def _begun(folder: Path, key: str) -> Path:
    """Mark of a run that is being computed."""
    return folder / f"{key}.begun"


_LAUNCHING = ("hydra/launcher", "hydra.launcher")
_EXTRAS = {"submitit": "slurm", "ray": "ray"}


def _require_launcher(launching: Sequence[str]) -> None:
    """Check that the launcher is installed; Hydra would only say that it knows none."""
    for argument in launching:
        name = argument.partition("=")[2]
        plugin = name.partition("_")[0]
        chosen = argument.lstrip("+").startswith("hydra/launcher=") and plugin in _EXTRAS
        if chosen and importlib.util.find_spec(f"hydra_plugins.hydra_{plugin}_launcher") is None:
            raise InputError(
                f"hydra/launcher={name} is an extra that is not installed: "
                f"pip install -e .[{_EXTRAS[plugin]}]"
            )


@hydra.main(version_base="1.3", config_path=str(paths.CONF), config_name="job")
def job_application(cfg: DictConfig) -> None:
    """Run one job's share of the plan; a run that fails leaves its row, and the next follows."""
    plan = json.loads(Path(cfg.plan).read_text())
    _end_with(*plan["planner"])
    if os.getpid() != plan["planner"][1]:  # joblib's workers stay, as they were, for later sweeps
        folder, os.environ["ESTIMA_RESULTS"] = plan["places"]
        os.chdir(folder)
    fetch = _LastRecording()
    for config, choices in plan["jobs"][cfg.job]:
        run_and_record(Experiment(config, choices), fetch)


def _end_with(node: str, planner: int) -> None:
    """End this process when the planner is killed, if it is the planner that started it."""
    if platform.node() != node or os.getppid() != planner or os.getpid() == planner:
        return

    def watch() -> None:
        while os.getppid() == planner:
            time.sleep(0.5)
        os._exit(1)

    if "planner" not in {thread.name for thread in threading.enumerate()}:
        threading.Thread(target=watch, name="planner", daemon=True).start()


def run_and_record(experiment: Experiment, fetch: Callable[[Experiment], Recording]) -> None:
    """Run one experiment; what goes wrong becomes the status of its row."""
    key = experiment.key
    path = experiment.rows_folder / f"{key}.parquet"
    mark = _begun(path.parent, key)
    with write_whole(mark) as part:
        part.touch()
    try:
        experiment.check()
        rows = evaluate(experiment, fetch(experiment))
        write_rows(rows, path)
        if any(row["status"] == Outcome.FAILED for row in rows):  # for those who watch
            path.with_suffix(".failed").touch()
    except (Exception, SystemExit) as error:
        _record_failure(experiment, Status.of_error(error))
    finally:
        mark.unlink(missing_ok=True)


_DIED = Status(Outcome.FAILED, "died", "its process died (out of memory?)")


def _record_failure(experiment: Experiment, status: Status) -> None:
    """Leave a row that says how the run failed, unless it has left one itself."""
    path = experiment.rows_folder / f"{experiment.key}.parquet"
    if not path.exists():
        write_rows([{**experiment.labels(""), **status.columns()}], path)
    path.with_suffix(".failed").touch()


class _LastRecording:
    """Keeps the last recording: the runs of a job mostly share it."""

    def __init__(self) -> None:
        self._key = ""
        self._recording: Recording | None = None

    def __call__(self, experiment: Experiment) -> Recording:
        key = experiment.recording_key
        if self._recording is None or key != self._key:
            self._recording, self._key = experiment.recording(), key
        return self._recording


class _Watch:
    """Show how many runs are done and failed, at what rate, and the time that remains."""

    def __init__(self, folder: Path, keys: Sequence[str]) -> None:
        self._folder, self._keys, self._over = folder, set(keys), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        with progress("", len(self._keys), "runs", summary=True) as on_progress:
            over = False
            while not over:
                over = self._over.wait(0.5)
                if done := self._count("parquet"):
                    on_progress(done, self._count("failed"))

    def _count(self, suffix: str) -> int:
        return len({path.stem for path in self._folder.glob(f"*.{suffix}")} & self._keys)
