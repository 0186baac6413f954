"""The jobs of a study: which runs go together, how all cores share them, and their tables."""

import time
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from numpy.typing import ArrayLike

from experiments.judging.kept_jobs import Tables as Tables
from experiments.judging.kept_jobs import file_of, keep, kept
from experiments.runs.dependencies.recorder import (
    Digests,
    is_recording,
    kept_in,
    note,
    note_part,
    recorded,
)
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.sweeps.collect import with_answers
from sim.team import Team

T = TypeVar("T")
Progress = Callable[[float], None]  # called with the share done


def in_parallel(
    function: Callable[..., T],
    jobs: Sequence[Sequence[Any]],
    on_progress: Progress = lambda _: None,
    costs: ArrayLike | None = None,
) -> Iterator[T]:
    """Yield `function(*job)` for every job, in order, computed on all cores.

    Parameters
    ----------
    on_progress
        Called with the share done after each result has been used.
    costs
        How long each job takes, in any unit; None if all take the same.
    """
    calls = [delayed(_recorded_job)(function, job, is_recording()) for job in jobs]
    for result, dependencies, _ in _in_turn(calls, on_progress, costs):
        note(dependencies)
        yield result


def _in_turn(
    calls: Sequence[Any], on_progress: Progress, costs: ArrayLike | None
) -> Iterator[tuple[Any, Digests, float]]:
    """Yield results, what each depends on and the seconds that it took."""
    done = np.cumsum(np.ones(len(calls)) if costs is None else costs)
    results = Parallel(n_jobs=-1, return_as="generator")(calls)
    for share, result in zip(done / done[-1], results, strict=True):
        yield result
        on_progress(float(share))


def _recorded_job(
    function: Callable[..., T], job: Sequence[Any], wanted: bool
) -> tuple[T, Digests, float]:
    begun = time.monotonic()
    if not wanted:
        return function(*job), {}, time.monotonic() - begun
    with recorded(function.__module__) as seen:
        result = function(*job)
    return result, seen.digests(), time.monotonic() - begun


def _kept_job(
    function: Callable[..., Tables], job: Sequence[Any], wanted: bool, file: Path | None
) -> tuple[Tables, Digests, float]:
    """As `_recorded_job`, but from the file if it has the tables; else they are kept in it."""
    found = kept(file) if file is not None else None
    if found is None:
        found = _recorded_job(function, job, wanted)
        if file is not None:
            keep(file, *found)
            found = kept(file) or found  # so that a study that goes on has the same bytes
    return found


def tables_of(
    function: Callable[..., Tables],
    jobs: Sequence[Sequence[Any]],
    on_progress: Progress = lambda _: None,
    costs: ArrayLike | None = None,
) -> dict[str, pd.DataFrame]:
    """Run jobs in parallel and join the rows that they give, by table, in their order.

    Within a recording that keeps jobs, what an interrupted run has finished is not run again.
    """
    folder, wanted = kept_in(), is_recording()
    files = [folder and file_of(folder, function, job) for job in jobs]
    calls = [
        delayed(_kept_job)(function, job, wanted, file)
        for job, file in zip(jobs, files, strict=True)
    ]
    parts: dict[str, list[Any]] = {}
    for tables, dependencies, seconds in _in_turn(calls, on_progress, costs):
        for name, rows in tables.items():
            parts.setdefault(name, []).append(rows)
            note_part(name, dependencies, seconds)
    return {name: _joined(several) for name, several in parts.items()}


def _joined(parts: list[Any]) -> pd.DataFrame:
    if isinstance(parts[0], pd.DataFrame):
        return pd.concat(parts, ignore_index=True)
    return pd.DataFrame(list(chain.from_iterable(parts)))


def answer_of(
    experiment: Experiment,
    names: Collection[str],
    fetch: Callable[[], Team] | None = None,
    **how: Any,
) -> Row:
    """Those columns of an experiment's one row, or of its best answer, that it has.

    Parameters
    ----------
    names
        As for `experiments.sweeps.collect.with_answers`.
    fetch, how
        As for `experiments.runs.evaluate.evaluate`.
    """
    found = with_answers(pd.DataFrame(evaluate(experiment, fetch, **how)), list(names)).iloc[0]
    return {name: found[name] for name in names if name in found}


def group_by(runs: Iterable[T], key: Callable[[T], Hashable]) -> list[list[T]]:
    """Group runs by key, in the order in which the keys first appear."""
    groups: dict[Hashable, list[T]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.values())
