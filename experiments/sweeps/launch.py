"""Many runs: skip what is done, and start the rest with Hydra's launcher.

The runs are composed once, here, and packed into jobs; each job reads its share of the plan. So
workers compose nothing, and any of Hydra's launchers will do.
"""

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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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
    """Run all combinations of the swept values, except those already done.

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
    InputError
        If a configuration does not fit together; then nothing is run.
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
    missing = [run for run in runs if _failure(folder, run.key) is not None]
    for run in missing:
        run.check()
    print(
        f"{len(runs)} run{'s' if len(runs) > 1 else ''}, {len(runs) - len(missing)} of them done "
        f"before: {paths.short(folder)}",
        file=sys.stderr,
    )
    if missing:
        _launch_all(missing, folder, launching)
    bad = [failure for run in runs if (failure := _failure(folder, run.key)) is not None]
    if bad:
        raise RunFailedError(f"{len(bad)} of {len(runs)} runs; first: {bad[0]}")


def _failure(folder: Path, key: str) -> str | None:
    """Return how a run failed, or that it has no rows yet; None if it is done."""
    path = folder / f"{key}.parquet"
    if not path.exists():
        return "no row was written"
    try:
        rows = read_rows(path)
    except InputError as error:
        return str(error)
    if not {"status", "run_key"} <= set(rows) or (rows["run_key"] != key).any():
        return f"{path} holds other rows; delete it and run again"
    failed = rows[rows["status"] == Outcome.FAILED]
    if failed.empty:
        return None
    return f"{failed['status_code'].iloc[0]}: {failed['status_detail'].iloc[0]}"


def _launch_all(runs: Sequence[Experiment], folder: Path, launching: Sequence[str]) -> None:
    """Start the runs; find those at which a worker died, and go on with the rest."""
    for run in runs:  # rows of an earlier failure, and files that are no rows
        path = folder / f"{run.key}.parquet"
        if path.is_dir():
            raise InputError(f"{path}: a folder in place of a table; remove it")
        if _failure(folder, run.key) is not None:
            path.unlink(missing_ok=True)
        path.with_suffix(".failed").unlink(missing_ok=True)
        _begun(folder, run.key).unlink(missing_ok=True)
    _clear_plans(folder)
    with _watched(folder, {run.key for run in runs}):
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
    content = {
        "planner": [platform.node(), os.getpid()],
        "places": [os.getcwd(), str(paths.results())],
        "jobs": [[[r.config, r.choices] for r in job] for job in jobs],
    }
    with write_whole(plan) as part:
        part.write_text(json.dumps(content))
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
        _remove(plan)
    return None


def _remove(plan: Path) -> None:
    plan.unlink(missing_ok=True)
    shutil.rmtree(f"{plan}.jobs", ignore_errors=True)


def _clear_plans(folder: Path) -> None:
    """Remove the plans of sweeps on this machine that were killed."""
    for plan in folder.glob("plan-*.json"):
        try:
            node, planner = json.loads(plan.read_text())["planner"]
            if node == platform.node():
                os.kill(planner, 0)  # is it there?
        except ProcessLookupError:
            _remove(plan)
        except (OSError, ValueError, KeyError, TypeError):
            continue


def _begun(folder: Path, key: str) -> Path:
    """File that marks a run as being computed."""
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
    held: dict[str, Recording] = {}
    for config, choices in plan["jobs"][cfg.job]:
        run_and_record(Experiment(config, choices), held)


def _end_with(node: str, planner: int) -> None:
    """End this process when the planner is killed, if the planner started it."""
    if platform.node() != node or os.getppid() != planner or os.getpid() == planner:
        return

    def watch() -> None:
        while os.getppid() == planner:
            time.sleep(0.5)
        os._exit(1)

    if "planner" not in {thread.name for thread in threading.enumerate()}:
        threading.Thread(target=watch, name="planner", daemon=True).start()


def run_and_record(experiment: Experiment, held: dict[str, Recording]) -> None:
    """Run one experiment; what goes wrong becomes the status of its row.

    Parameters
    ----------
    held
        The last recording by its key; most runs of a job share it.
    """
    key = experiment.key
    path = experiment.rows_folder / f"{key}.parquet"
    mark = _begun(path.parent, key)
    with write_whole(mark) as part:
        part.touch()
    try:
        rows = evaluate(experiment, lambda: _held(experiment, held))
        write_rows(rows, path)
        if any(row["status"] == Outcome.FAILED for row in rows):  # for those who watch
            path.with_suffix(".failed").touch()
    except (Exception, SystemExit) as error:
        _record_failure(experiment, Status.of_error(error))
    finally:
        mark.unlink(missing_ok=True)


def _held(experiment: Experiment, held: dict[str, Recording]) -> Recording:
    key = experiment.recording_key
    if key not in held:
        held.clear()
        held[key] = experiment.recording()
    return held[key]


_DIED = Status(Outcome.FAILED, "died", "its process died (out of memory?)")


def _record_failure(experiment: Experiment, status: Status) -> None:
    """Leave a row that says how the run failed, unless it has left one itself."""
    path = experiment.rows_folder / f"{experiment.key}.parquet"
    if not path.exists():
        write_rows([{**experiment.labels(""), **status.columns()}], path)
    path.with_suffix(".failed").touch()


@contextmanager
def _watched(folder: Path, keys: set[str]) -> Iterator[None]:
    """Show how many runs are done and failed, at what rate, and the time that remains."""
    ended = threading.Event()

    def count(suffix: str) -> int:
        return len({path.stem for path in folder.glob(f"*.{suffix}")} & keys)

    def watch() -> None:
        with progress("", len(keys), "runs", summary=True) as on_progress:
            over = False
            while not over:
                over = ended.wait(0.5)
                if done := count("parquet"):
                    on_progress(done, count("failed"))

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
