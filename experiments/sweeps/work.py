"""One job of a sweep: its share of the plan, run by run."""

import ctypes
import json
import os
import platform
import signal
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from itertools import chain
from pathlib import Path
from typing import Any

from experiments.runs import store
from experiments.runs.columns import DEPENDENCIES
from experiments.runs.dependencies.recorder import Digests, note, recorded
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.processes import hold_interrupts, is_interrupt
from experiments.runs.row import Row, Status, check_row
from experiments.sweeps.plan import Family
from sim.team import Team

Held = dict[str, tuple[Team, Digests]]
_PR_SET_PDEATHSIG = 1  # of Linux


def share_path(plan: str | Path, job: int) -> Path:
    """File of a job's share of the plan."""
    return Path(f"{plan}.jobs") / f"share-{job}.json"


def compiling_file(plan: str | Path) -> Path:
    """File that is touched whenever a job compiles numerical code."""
    return Path(f"{plan}.jobs") / "compiling"


def run_share(share: Mapping[str, Any]) -> None:
    """Run a job's share of the plan, as `Jobs.add` wrote it, but for what its journal has.

    A run that fails leaves its row, and the next follows.
    """
    held: Held = {}
    path = Path(share["journal"])
    over = store.ended(path.parent, f"{path.stem}.")  # something if the launcher tries it again
    keys = {*over.done.tolist(), *over.failed}
    with store.journal(path) as journal:
        for experiment in chain.from_iterable(map(Family.experiments, share["families"])):
            if not keys or int(experiment.key, 16) not in keys:
                run_and_record(experiment, held, journal)
    store.compact(path)


def end_with(node: str, planner: int) -> None:
    """End this process when the planner ends, if the planner started it, and not by Ctrl-C."""
    if platform.node() != node or os.getpid() == planner:
        return
    if os.getppid() != planner:  # started by a launcher's own processes, or left behind just now
        if not is_alive(planner):
            os._exit(1)
        return

    with suppress(OSError, AttributeError):  # at once, also out of a call of compiled code
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.getppid() == planner:
            time.sleep(0.5)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends it to all; the planner acts
    if "planner" not in {thread.name for thread in threading.enumerate()}:
        threading.Thread(target=watch, name="planner", daemon=True).start()


def run_and_record(experiment: Experiment, held: Held, journal: store.Journal) -> None:
    """Run one experiment; what goes wrong becomes the status of its row.

    Parameters
    ----------
    held
        The last recording by its key, and what it depends on; most runs of a job share it.
    journal
        Takes the rows; what they depend on is kept beside it.
    """
    journal.begin(experiment.key)
    with hold_interrupts() as on_step:  # what one causes is not a result
        try:
            with recorded(evaluate.__module__) as seen:
                rows = evaluate(
                    experiment,
                    lambda: _held(experiment, held, on_step),
                    shown=lambda _: nullcontext(on_step),
                )
            for row in rows:
                check_row(row)
            kept = store.keep_dependencies(seen.digests(), journal.path.parent)
            rows = [row | {DEPENDENCIES: kept} for row in rows]
        except BaseException as error:
            if is_interrupt(error):
                raise
            rows = [failure_row(experiment, Status.of_error(error))]
    journal.append(rows)


def _held(experiment: Experiment, held: Held, on_progress: Callable[..., None]) -> Team:
    key = experiment.recording_key
    if key not in held:
        held.clear()
        with recorded() as seen:
            team = experiment.recordings(on_progress)
        held[key] = team, seen.digests()
    team, dependencies = held[key]
    note(dependencies)
    return team


def failure_row(experiment: Experiment, status: Status) -> Row:
    """Row of a run that left none itself."""
    return {**experiment.labels(""), **status.columns()}


def may_run(plan: Path) -> bool:
    """Whether the planner of a plan lives, as far as this machine can tell."""
    try:
        node, planner = json.loads(plan.read_text())["planner"]
        return node != platform.node() or is_alive(planner)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return True


def is_alive(process: int) -> bool:
    """Whether a process of this machine lives."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        pass
    return True
