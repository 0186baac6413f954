"""Weighted particles: log weights, effective sample size, resampling schemes.

Weights are kept as logs and need no normalisation by the caller; a weight of -inf is a particle
that the observations rule out. Weights that have all underflowed count as equal.
"""

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from sim.arrays import Array, Ints
from sim.compiled import njit
from sim.errors import InputError

Scheme = Literal["systematic", "stratified", "residual", "multinomial"]
SCHEMES: tuple[Scheme, ...] = ("systematic", "stratified", "residual", "multinomial")


def have_underflowed(log_weights: ArrayLike) -> bool:
    """Whether no particle has any weight left: all are -inf, or some are NaN or +inf."""
    return not bool(np.isfinite(np.max(np.asarray(log_weights, dtype=np.float64))))


def normalize(log_weights: ArrayLike) -> Array:
    """Weights (M,) that sum to 1, of log weights (M,); equal ones if all have underflowed.

    >>> normalize([-1000.0, -1000.0]).tolist()
    [0.5, 0.5]
    """
    logs = np.asarray(log_weights, dtype=np.float64)
    if have_underflowed(logs):
        return np.full(len(logs), 1.0 / len(logs))
    weights: Array = np.exp(logs - np.max(logs))
    weights /= weights.sum()
    return weights


def effective_sample_size(log_weights: ArrayLike) -> float:
    """1 / sum w^2 of the normalised weights: M when they are equal, 1 when one has them all."""
    weights = normalize(log_weights)
    return 1.0 / float(weights @ weights)


def resample(
    log_weights: ArrayLike, n: int, rng: np.random.Generator, scheme: Scheme = "systematic"
) -> Ints:
    """Indices (n,), ascending, of particles drawn with replacement by their weights.

    Every scheme is unbiased: particle i appears n w_i times in the mean.

    Parameters
    ----------
    log_weights
        (M,) log weights, not necessarily normalised.
    n
        Number of particles to draw.
    scheme
        `multinomial`: n independent draws (gil2008, sec. IV-D). `stratified`: one draw in each
        of n equal strata. `systematic`: the same draw in every stratum. `residual`: floor(n w)
        copies of each, the rest multinomial.
    """
    weights = normalize(log_weights)
    if scheme == "systematic":
        return _one_in_each_stratum(weights, n, rng.random())
    if scheme == "stratified":
        return _at(weights, (np.arange(n) + rng.random(n)) / n)
    if scheme == "multinomial":
        return _at(weights, np.sort(rng.random(n)))
    if scheme == "residual":
        copies = np.floor(n * weights).astype(np.int64)
        n_left = n - int(copies.sum())
        if n_left > 0:
            rest = n * weights - copies
            drawn = _at(rest / rest.sum(), rng.random(n_left))
            copies += np.bincount(drawn, minlength=len(weights))
        return np.repeat(np.arange(len(weights)), copies)
    raise InputError(f"resampling scheme must be one of {', '.join(SCHEMES)}, got {scheme!r}")


def keep_survivors(indices: Ints, n_particles: int) -> Ints:
    """The same particles in an order that moves few of them: survivors keep their own slot.

    Parameters
    ----------
    indices
        (M,) ancestors, as `resample` draws them, one for each of M slots.
    n_particles
        M.

    Returns
    -------
    Ancestors (M,): `result[i] == i` wherever particle i survives, so that a map has to be copied
    only where `result[i] != i`, and never onto a particle that is still to be copied from.
    """
    copies = np.bincount(indices, minlength=n_particles)
    ancestors = np.arange(n_particles)
    ancestors[copies == 0] = np.repeat(ancestors, np.maximum(copies - 1, 0))
    return ancestors


class Lineages:
    """The paths of all particles, shared where they have ancestors in common.

    Ancestors without living descendants are forgotten now and then, so that memory grows with the
    number of distinct ancestors and not with the number of particles.

    Parameters
    ----------
    n_particles
        M.
    """

    _PRUNE_EVERY = 32

    def __init__(self, n_particles: int) -> None:
        self._poses: list[Array] = []
        self._parents: list[Ints] = []  # row of the step before, of each row
        self._rows = np.arange(n_particles)  # each particle's row of the last step
        self._n_pruned = 0

    def __len__(self) -> int:
        return len(self._poses)

    def append(self, poses: Array) -> None:
        """Add the poses (M, 3) of a step, which the caller leaves as they are."""
        self._parents.append(self._rows)
        self._poses.append(poses)
        self._rows = np.arange(len(poses))
        if len(self._poses) % self._PRUNE_EVERY == 0:
            self._prune()

    def resample(self, ancestors: Ints) -> None:
        """Let particle m descend from particle `ancestors[m]` of the last step, (M,)."""
        self._rows = self._rows[ancestors]

    def paths(self) -> Iterator[tuple[Array, Ints]]:
        """Step by step, backward: poses (R, 3) of the distinct ancestors, and rows (M,)."""
        rows = self._rows
        for poses, parents in zip(reversed(self._poses), reversed(self._parents), strict=True):
            yield poses, rows
            rows = parents[rows]

    def _prune(self) -> None:
        alive, self._rows = _distinct(self._rows, len(self._poses[-1]))
        for step in range(len(self._poses) - 1, -1, -1):
            if step < self._n_pruned and len(alive) == len(self._poses[step]):
                break
            self._poses[step] = self._poses[step][alive]
            parents = self._parents[step][alive]
            n_before = len(self._poses[step - 1]) if step else len(self._rows)
            alive, self._parents[step] = _distinct(parents, n_before)
        self._n_pruned = len(self._poses)


@njit()
def _distinct(rows: Ints, n_rows: int) -> tuple[Ints, Ints]:
    """Distinct ones of rows (M,) below `n_rows`, sorted, and the place of each row among them."""
    place = np.zeros(n_rows, np.int64)
    for row in rows:
        place[row] = 1
    distinct, found = np.empty(n_rows, np.int64), 0
    for row in range(n_rows):
        if place[row]:
            distinct[found], place[row] = row, found
            found += 1
    return distinct[:found].copy(), place[rows]


@njit()
def _one_in_each_stratum(weights: Array, n: int, offset: float) -> Ints:
    """Particles (n,) at the quantiles (k + offset) / n of normalised weights."""
    drawn, last = np.empty(n, np.int64), len(weights) - 1
    while weights[last] == 0.0:
        last -= 1
    cumulated, at = 0.0, 0
    for particle in range(last):
        cumulated += weights[particle]
        while at < n and at < cumulated * n - offset:
            drawn[at] = particle
            at += 1
    drawn[at:] = last
    return drawn


def _at(weights: Array, quantiles: Array) -> Ints:
    """Particles at quantiles in [0, 1) of the cumulated weights; never one of zero weight."""
    cumulated = np.cumsum(weights)
    drawn = np.searchsorted(cumulated, quantiles * cumulated[-1], side="right")
    return np.asarray(np.minimum(drawn, np.flatnonzero(weights)[-1]))
