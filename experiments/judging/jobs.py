"""The jobs of a study: which runs go together, and how all cores share them."""

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


def grouped(runs: Iterable[T], key: Callable[[T], Hashable]) -> list[list[T]]:
    """Group runs by key, in the order in which the keys first appear."""
    groups: dict[Hashable, list[T]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.values())
