"""Where a claim holds, in words: the part of a region, bounded in one or two of its settings."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.evaluation.statistics import Interval
from experiments.judging.free_settings import Scale, Setting, as_words
from experiments.runs.console import enumerate_words
from sim.arrays import Array, Bools

_LEVELS = np.arange(1, 20) / 20.0  # at which a range is cut
_GAIN = 0.1  # by which a second setting must tell better than one


@dataclass(frozen=True)
class Half:
    """The part of a region on one side of a setting's value, or with one of its choices."""

    setting: int
    members: Bools  # (N,) of the places
    words: str


@dataclass(frozen=True)
class Corner:
    """Where a claim holds most: within one or two halves of the region.

    Attributes
    ----------
    inside, outside
        Share of the corner, and of the rest, in which the claim holds.
    """

    halves: tuple[Half, ...]
    inside: Interval
    outside: Interval

    @property
    def words(self) -> str:
        """Name the corner and both shares."""
        where = enumerate_words([half.words for half in self.halves])
        inside, outside = map(_bracketed, (self.inside, self.outside))
        return f"holds in {inside} where {where}, and in {outside} of the rest"


def corner(settings: Sequence[Setting], units: Array, holds: Bools) -> Corner | None:
    """The corner that best tells where a claim holds.

    That is by Youden's index, sensitivity plus specificity less one. A second setting is named only
    if it adds a tenth to the index. None: the claim holds everywhere or nowhere.

    Parameters
    ----------
    units
        Places (N, D) spread evenly over the region.
    holds
        Whether the claim holds there (1 + B, N): first as found, then resampled.
    """
    good = holds[0]
    if good.all() or not good.any():
        return None
    halves = list(_halves(settings, units))
    members = np.array([half.members for half in halves], float)
    true, false = ((members * part) @ members.T / part.sum() for part in (good, ~good))
    pairs, of = true - false, [half.setting for half in halves]
    same = np.equal.outer(of, of)
    single = int(pairs.diagonal().argmax())
    first, second = np.unravel_index(np.where(same, -np.inf, pairs).argmax(), pairs.shape)
    chosen = [single]
    if len(settings) > 1 and pairs[first, second] >= pairs[single, single] + _GAIN:
        chosen = sorted((int(first), int(second)))
    within = np.logical_and.reduce([halves[i].members for i in chosen])
    inside, outside = (_spread(holds[:, part].mean(axis=1)) for part in (within, ~within))
    return Corner(tuple(halves[i] for i in chosen), inside, outside)


def _halves(settings: Sequence[Setting], units: Array) -> Iterator[Half]:
    for i, setting in enumerate(settings):
        u = units[:, i]
        if setting.choices:
            for choice, at in zip(setting.choices, setting.units(setting.choices), strict=True):
                yield Half(i, u == at, f"{setting.called} is {as_words(choice)}")
            continue
        for cut, below, above in _cuts(setting):
            if (u < cut).any() and (u >= cut).any():
                yield Half(i, u < cut, f"{setting.called} is below {as_words(below)}")
                yield Half(i, u >= cut, f"{setting.called} is above {as_words(above)}")


def _cuts(setting: Setting) -> Iterator[tuple[float, float, float]]:
    """Shares of a setting's range, the value that all below are below, and the same above."""
    if setting.scale is Scale.INTEGER:
        whole = list(range(int(setting.low) + 1, int(setting.high) + 1))
        half = 0.5 / (setting.high - setting.low + 1.0)
        for value, at in zip(whole, setting.units(whole), strict=True):
            yield float(at) - half, value, value - 1
        return
    for level, value in zip(_LEVELS.tolist(), setting.at(_LEVELS), strict=True):
        yield level, value, value


def _spread(shares: Array) -> Interval:
    low, high = np.quantile(shares[1:], [0.025, 0.975])
    return Interval(float(shares[0]), float(min(low, shares[0])), float(max(high, shares[0])))


def _bracketed(share: Interval) -> str:
    value, low, high = (f"{100.0 * each:.0f}" for each in (share.value, share.low, share.high))
    return f"{value} % [{low}, {high}]"
