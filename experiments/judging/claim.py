"""A statistic of a claim: its subject, its value with an interval, and the verdict on it.

A study's `judge` makes claims; they are found again by their fields, never by their words.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from experiments.evaluation.statistics import Interval, log_ratio_interval, wilcoxon_p


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


@dataclass(frozen=True)
class Subject:
    """What a statistic is about; a field that does not apply is None.

    Attributes
    ----------
    claim
        Id in the papers' list, such as PB1.
    quantity
        What is measured, in a word or two that the claim's statistics share.
    method, over
        The estimator, or whatever is tried; what it is compared with.
    noise, metric, place, arm
        The noise; the metric of a registration; the world, route, log or stretch; in what else
        runs differ, such as communication or walls.
    size, setting
        How many robots, particles or observations; the value of any other parameter.
    """

    claim: str
    quantity: str
    _: KW_ONLY
    method: str | None = None
    over: str | None = None
    noise: str | None = None
    metric: str | None = None
    place: str | None = None
    arm: str | None = None
    size: int | None = None
    setting: float | None = None


@dataclass(frozen=True)
class Claim:
    """One statistic of a paper's claim, judged.

    Attributes
    ----------
    about
        What it is about.
    statistic
        The same in words.
    found
        Its value and 95 % interval, unless the statistic names another level.
    criterion
        The rule that the interval is judged by.
    verdict, reason
        The verdict; what came out besides the interval, in words.
    role
        Whether the claim's verdict follows from it.
    more
        How many more recordings would settle it if it is undecided; 0: unknown.
    facts
        What came out besides the interval, by name, such as `p` of a test.
    """

    about: Subject
    statistic: str
    found: Interval
    criterion: str
    verdict: Verdict
    reason: str = ""
    role: Role = Role.HEADLINE
    more: int = 0
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """Id of the claim, as in the papers' list."""
        return self.about.claim


def select_all(claims: Sequence[Claim], **wanted: Any) -> list[Claim]:
    """Claims whose fields, or those of their subjects, have these values, in their order."""
    known = [(claim, {**vars(claim), **vars(claim.about)}) for claim in claims]
    return [c for c, own in known if all(own[name] == value for name, value in wanted.items())]


def select(claims: Sequence[Claim], **wanted: Any) -> Claim:
    """Return the one claim with these values.

    Raises
    ------
    LookupError
        If there is none, or there are several.
    """
    found = select_all(claims, **wanted)
    if len(found) != 1:
        raise LookupError(f"{len(found)} statistics with {wanted}")
    return found[0]


def judge_interval(
    interval: Interval, at_least: float = -math.inf, at_most: float = math.inf
) -> Verdict:
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


def shown(about: Subject, statistic: str, found: Interval, reason: str = "", **facts: Any) -> Claim:
    """State a statistic that accompanies a claim and has no criterion."""
    ruling = ("shown, not judged", Verdict.SHOWN, reason, Role.BESIDE)
    return Claim(about, statistic, found, *ruling, facts=facts)


def beside(claim: Claim, is_beside: bool = True) -> Claim:
    """Return a statistic that only accompanies its claim, if `is_beside`."""
    return replace(claim, role=Role.BESIDE) if is_beside else claim


def with_remark(claim: Claim, remark: str, **facts: Any) -> Claim:
    """Return a claim with a remark before its reason, and with facts."""
    reason = "; ".join(filter(None, [remark, claim.reason]))
    return replace(claim, reason=reason, facts={**claim.facts, **facts})


def judge_bounds(
    about: Subject,
    statistic: str,
    found: Interval,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    *,
    criterion: str = "",
    n: int = 0,
) -> Claim:
    """Judge an interval against [at_least, at_most]; the criterion is these bounds in words.

    Parameters
    ----------
    criterion
        Other words for the bounds.
    n
        Recordings that the interval comes from; 0: it does not narrow with their number.
    """
    words = f"at least {at_least:g}" if at_least > -math.inf else f"at most {at_most:g}"
    if -math.inf < at_least and at_most < math.inf:
        words = f"within {at_least:.3g} and {at_most:g}"
    verdict = judge_interval(found, at_least, at_most)
    more = more_to_settle(found, n, at_least, at_most)
    return Claim(about, statistic, found, criterion or words, verdict, more=more)


def judge_lower(about: Subject, statistic: str, first: ArrayLike, second: ArrayLike) -> Claim:
    """Judge that paired values are lower in the first arm, by their ratio and Wilcoxon's p.

    Reproduced if the median ratio is below one and p < 0.01; not reproduced if the ratio's interval
    has nothing below one; undecided if it spans one, or there are fewer than two pairs. The fact is
    `p`.
    """
    above, below = np.asarray(first, float), np.asarray(second, float)
    n, ratio = len(above), log_ratio_interval(above, below)
    p = 1.0 if np.array_equal(above, below) else wilcoxon_p(above, below)
    verdict, more = Verdict.UNDECIDED, 0
    if n >= 2 and p < 0.01 and float(np.median(np.log(above) - np.log(below))) < 0.0:
        verdict = Verdict.REPRODUCED
    elif n >= 2 and ratio.low >= 1.0:
        verdict = Verdict.NOT_REPRODUCED
    elif n >= 2 and ratio.value < 1.0:
        more = max(more_by_p(n, p, 0.01), 1)
    elif n >= 2:
        more = more_to_settle(ratio, n, at_most=1.0)
    criterion, reason = "median below 1, Wilcoxon p < 0.01", f"p = {p:.2g}"
    return Claim(about, statistic, ratio, criterion, verdict, reason, more=more, facts={"p": p})


def more_by_p(n: int, p: float, limit: float) -> int:
    """How many more than n recordings would bring a test's one-sided p down to the limit.

    P = 0.01 is 2.33 standard errors away, and p = 0.05 1.64.
    """
    return math.ceil(n * float((stats.norm.isf(limit) / max(stats.norm.isf(p), 0.1)) ** 2)) - n


def judge_equivalent(
    about: Subject, statistic: str, first: ArrayLike, second: ArrayLike, margin: float
) -> Claim:
    """Judge that a paired ratio lies within 1 / (1 + m) and 1 + m, by two one-sided t tests.

    They are made in logs, at 0.05. The ratio's 90 % interval, which is stated, corresponds to them.
    """
    ratio = log_ratio_interval(first, second, level=0.90)
    low, high = 1.0 / (1.0 + margin), 1.0 + margin
    return judge_bounds(about, f"{statistic} (90 % interval)", ratio, low, high, n=np.size(first))
