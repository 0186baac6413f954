"""A paper's claim and the verdict on it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from experiments.evaluation.statistics import Interval, log_ratio_interval, wilcoxon_p


class Verdict(StrEnum):
    """Whether an interval meets a criterion."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not_reproduced"
    UNDECIDED = "undecided"  # the interval spans the criterion, or the data are too few
    SHOWN = "shown"  # there is no criterion

    @property
    def label(self) -> str:
        """The verdict in words."""
        return self.value.replace("_", " ")


class Role(StrEnum):
    """Whether a statistic decides its claim's verdict, or only accompanies it."""

    HEADLINE = "headline"
    BESIDE = "beside"


class Profile(StrEnum):
    """The size of a study: `quick` makes every table and figure from few repeats."""

    FULL = "full"
    QUICK = "quick"


@dataclass(frozen=True)
class Claim:
    """One statistic of a paper's claim, judged.

    Attributes
    ----------
    id
        As in the papers' list, such as PB1.
    statistic
        What was measured.
    found
        Its value and 95 % interval, unless the statistic names another level.
    criterion
        What the interval is judged by.
    verdict, reason
        The verdict; why, or where it holds, if that is not obvious.
    """

    id: str
    statistic: str
    found: Interval
    criterion: str
    verdict: Verdict
    reason: str = ""

    @property
    def role(self) -> Role:
        """A statistic without a criterion only accompanies the claim."""
        return Role.BESIDE if self.verdict is Verdict.SHOWN else Role.HEADLINE


def judged(interval: Interval, at_least: float = -math.inf, at_most: float = math.inf) -> Verdict:
    """Judge an interval against [at_least, at_most]: inside, wholly outside, or spanning an end.

    An interval without bounds, for lack of data, leaves the claim undecided.
    """
    if not (math.isfinite(interval.low) and math.isfinite(interval.high)):
        return Verdict.UNDECIDED
    if interval.low >= at_least and interval.high <= at_most:
        return Verdict.REPRODUCED
    outside = interval.high < at_least or interval.low > at_most
    return Verdict.NOT_REPRODUCED if outside else Verdict.UNDECIDED


def banded(
    claim: str,
    statistic: str,
    found: Interval,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    criterion: str = "",
) -> Claim:
    """Judge that an interval lies in [at_least, at_most]; the criterion is these bounds in words.

    Parameters
    ----------
    claim
        Its id.
    criterion
        Other words for the bounds.
    """
    words = f"at least {at_least:g}" if at_least > -math.inf else f"at most {at_most:g}"
    if -math.inf < at_least and at_most < math.inf:
        words = f"within {at_least:g} and {at_most:g}"
    return Claim(claim, statistic, found, criterion or words, judged(found, at_least, at_most))


def holds(condition: bool) -> Verdict:
    """Judge a statistic without an interval."""
    return Verdict.REPRODUCED if condition else Verdict.NOT_REPRODUCED


def lower(first: ArrayLike, second: ArrayLike) -> tuple[Interval, float, Verdict]:
    """Whether paired values are lower in the first arm: their ratio, Wilcoxon's p, the verdict.

    Reproduced if the median ratio is below one and p < 0.01; not reproduced if the ratio's interval
    has nothing below one; undecided if it spans one, or there are fewer than two pairs.
    """
    above, below = np.asarray(first, float), np.asarray(second, float)
    ratio = log_ratio_interval(above, below)
    p = 1.0 if np.array_equal(above, below) else wilcoxon_p(above, below)
    if len(above) < 2:
        return ratio, p, Verdict.UNDECIDED
    if p < 0.01 and float(np.median(np.log(above) - np.log(below))) < 0.0:
        return ratio, p, Verdict.REPRODUCED
    return ratio, p, Verdict.NOT_REPRODUCED if ratio.low >= 1.0 else Verdict.UNDECIDED


def equivalent(first: ArrayLike, second: ArrayLike, margin: float) -> tuple[Interval, Verdict]:
    """Whether a paired ratio lies within 1 / (1 + m) and 1 + m, by two one-sided t tests at 0.05.

    They are made in logs. The ratio's 90 % interval, which is returned too, corresponds to them.
    """
    ratio = log_ratio_interval(first, second, level=0.90)
    return ratio, judged(ratio, 1.0 / (1.0 + margin), 1.0 + margin)


def overall(parts: Sequence[Verdict]) -> Verdict:
    """Return the verdict on a claim whose parts must all hold."""
    if set(parts) == {Verdict.REPRODUCED}:
        return Verdict.REPRODUCED
    return Verdict.NOT_REPRODUCED if Verdict.NOT_REPRODUCED in parts else Verdict.UNDECIDED
