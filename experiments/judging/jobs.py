"""The jobs of a study: which runs go together, and how all cores share them."""

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from numpy.typing import ArrayLike

from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.sweeps.collect import with_answers
from sim.team import Team

T = TypeVar("T")


def in_parallel(
    function: Callable[..., T],
    jobs: Sequence[Sequence[Any]],
    on_progress: Callable[[float], None],
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
    done = np.cumsum(np.ones(len(jobs)) if costs is None else costs)
    results = Parallel(n_jobs=-1, return_as="generator")(delayed(function)(*job) for job in jobs)
    for share, result in zip(done / done[-1], results, strict=True):
        yield result
        on_progress(float(share))


def table_of(
    function: Callable[..., Iterable[Row]],
    jobs: Sequence[Sequence[Any]],
    on_progress: Callable[[float], None],
    costs: ArrayLike | None = None,
) -> pd.DataFrame:
    """Table of the rows that `function(*job)` gives for every job; see `in_parallel`."""
    parts = in_parallel(_listed, [(function, *job) for job in jobs], on_progress, costs)
    return pd.DataFrame([row for part in parts for row in part])


def _listed(function: Callable[..., Iterable[Row]], *job: Any) -> list[Row]:
    """A list, since what a worker gives back cannot be a generator."""
    return list(function(*job))


def answer_of(
    experiment: Experiment, names: Collection[str], fetch: Callable[[], Team] | None = None
) -> Row:
    """Those columns of an experiment's one row, or of its best answer, that it has.

    Parameters
    ----------
    names
        As for `experiments.sweeps.collect.with_answers`.
    fetch
        As for `experiments.runs.evaluate.evaluate`.
    """
    found = with_answers(pd.DataFrame(evaluate(experiment, fetch)), list(names)).iloc[0]
    return {name: found[name] for name in names if name in found}


def grouped(runs: Iterable[T], key: Callable[[T], Hashable]) -> list[list[T]]:
    """Group runs by key, in the order in which the keys first appear."""
    groups: dict[Hashable, list[T]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.values())
