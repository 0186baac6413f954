"""Verdicts, and how an interval comes to one."""

import math
from collections.abc import Sequence
from enum import StrEnum

from experiments.evaluation.statistics import Interval


class Verdict(StrEnum):
    """Whether an interval meets a criterion."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not_reproduced"
    UNDECIDED = "undecided"  # the interval spans the criterion, or the data are too few
    SHOWN = "shown"  # without a criterion

    @property
    def label(self) -> str:
        """The verdict in words."""
        return self.value.replace("_", " ")


class Role(StrEnum):
    """Whether a statistic decides its claim's verdict, or only accompanies it.

    Headlines say what the paper says, with the paper's own method.
    """

    HEADLINE = "headline"
    BESIDE = "beside"


class Profile(StrEnum):
    """The size of a study: `quick` makes every table and figure from few repeats."""

    FULL = "full"
    QUICK = "quick"


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


def more_to_settle(
    found: Interval, n: int, at_least: float = -math.inf, at_most: float = math.inf
) -> int:
    """How many more recordings would settle an interval from n of them; 0: none, or unknown.

    The value is taken to stay, and the interval to shrink with the square root of their number. A
    positive interval is measured in logs.
    """
    spanned = [limit for limit in (at_least, at_most) if found.low < limit < found.high]
    if n < 2 or not spanned or found.value in spanned:
        return 0
    if found.value < at_least or found.value > at_most:  # only the nearest limit has to be cleared
        spanned = [min(spanned, key=lambda limit: abs(limit - found.value))]
    scale = math.log if min(found.low, *spanned) > 0.0 else float
    factors = [
        (scale(found.high if limit > found.value else found.low) - scale(found.value))
        / (scale(limit) - scale(found.value))
        for limit in spanned
    ]
    return math.ceil(round(n * max(factors) ** 2, 6)) - n


def holds(condition: bool) -> Verdict:
    """Judge a statistic without an interval."""
    return Verdict.REPRODUCED if condition else Verdict.NOT_REPRODUCED


def overall(parts: Sequence[Verdict]) -> Verdict:
    """Return the verdict on a claim whose parts must all hold."""
    if set(parts) == {Verdict.REPRODUCED}:
        return Verdict.REPRODUCED
    return Verdict.NOT_REPRODUCED if Verdict.NOT_REPRODUCED in parts else Verdict.UNDECIDED


def headline_verdict(statistics: Sequence[tuple[Role, Verdict]]) -> Verdict:
    """Verdict on a claim by the roles and verdicts of its statistics."""
    parts = [verdict for role, verdict in statistics if role is Role.HEADLINE]
    return overall(parts) if parts else Verdict.SHOWN
