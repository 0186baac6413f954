"""The jobs of a study: which runs go together, and all of them on all cores."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import ArrayLike

T = TypeVar("T")


def in_parallel(
    function: Callable[..., T],
    jobs: Sequence[Sequence[Any]],
    on_progress: Callable[[float], None],
    costs: ArrayLike | None = None,
) -> Iterator[T]:
    """Give the result of `function(*job)` for every job, in their order.

    Parameters
    ----------
    on_progress
        Called with the share done, each time a result has been used.
    costs
        What each job takes, in any unit; None if they take the same.
    """
    done = np.cumsum(np.ones(len(jobs)) if costs is None else costs)
    results = Parallel(n_jobs=-1, return_as="generator")(delayed(function)(*job) for job in jobs)
    for share, result in zip(done / done[-1], results, strict=True):
        yield result
        on_progress(float(share))


def grouped(runs: Iterable[T], key: Callable[[T], Hashable]) -> list[list[T]]:
    """Runs with the same key together, in the order of their first."""
    groups: dict[Hashable, list[T]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.values())
