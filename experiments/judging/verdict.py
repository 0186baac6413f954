"""A paper's claim and the verdict on it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from experiments.evaluation.statistics import Interval, log_ratio_interval, wilcoxon_p

_Z_01 = float(stats.norm.isf(0.01))


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
    """Whether a statistic decides its claim's verdict, or only accompanies it.

    Headlines say what the paper says, with the paper's own method.
    """

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
        The rule that the interval is judged by.
    verdict, reason
        The verdict; what came out besides the interval, such as a test's p.
    role
        Whether the claim's verdict follows from it.
    more
        How many more recordings would settle it if it is undecided; 0: unknown.
    """

    id: str
    statistic: str
    found: Interval
    criterion: str
    verdict: Verdict
    reason: str = ""
    role: Role = Role.HEADLINE
    more: int = 0


@dataclass(frozen=True)
class Conclusion:
    """The one verdict on a claim, and a sentence that says what came out."""

    id: str
    verdict: Verdict
    sentence: str


def shown(claim: str, statistic: str, found: Interval, reason: str = "") -> Claim:
    """State a statistic that accompanies a claim and has no criterion."""
    return Claim(claim, statistic, found, "shown, not judged", Verdict.SHOWN, reason, Role.BESIDE)


def beside(claim: Claim, is_beside: bool = True) -> Claim:
    """Return a statistic that only accompanies its claim, if `is_beside`."""
    return replace(claim, role=Role.BESIDE) if is_beside else claim


def remarked(claim: Claim, *remarks: str) -> Claim:
    """Return a claim with remarks before its reason."""
    return replace(claim, reason="; ".join(filter(None, [*remarks, claim.reason])))


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


def banded(
    claim: str,
    statistic: str,
    found: Interval,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    criterion: str = "",
    n: int = 0,
) -> Claim:
    """Judge that an interval lies in [at_least, at_most]; the criterion is these bounds in words.

    Parameters
    ----------
    claim
        Its id.
    criterion
        Other words for the bounds.
    n
        Recordings that the interval comes from; 0: it does not narrow with their number.
    """
    words = f"at least {at_least:g}" if at_least > -math.inf else f"at most {at_most:g}"
    if -math.inf < at_least and at_most < math.inf:
        words = f"within {at_least:.3g} and {at_most:g}"
    verdict = judged(found, at_least, at_most)
    more = more_to_settle(found, n, at_least, at_most)
    return Claim(claim, statistic, found, criterion or words, verdict, more=more)


def holds(condition: bool) -> Verdict:
    """Judge a statistic without an interval."""
    return Verdict.REPRODUCED if condition else Verdict.NOT_REPRODUCED


def lower(claim: str, statistic: str, first: ArrayLike, second: ArrayLike) -> Claim:
    """Judge that paired values are lower in the first arm, by their ratio and Wilcoxon's p.

    Reproduced if the median ratio is below one and p < 0.01; not reproduced if the ratio's interval
    has nothing below one; undecided if it spans one, or there are fewer than two pairs.
    """
    above, below = np.asarray(first, float), np.asarray(second, float)
    n, ratio = len(above), log_ratio_interval(above, below)
    p = 1.0 if np.array_equal(above, below) else wilcoxon_p(above, below)
    verdict, more = Verdict.UNDECIDED, 0
    if n >= 2 and p < 0.01 and float(np.median(np.log(above) - np.log(below))) < 0.0:
        verdict = Verdict.REPRODUCED
    elif n >= 2 and ratio.low >= 1.0:
        verdict = Verdict.NOT_REPRODUCED
    elif n >= 2 and ratio.value < 1.0:  # p = 0.01 is 2.33 standard errors away, and 0.05 1.64
        more = max(math.ceil(n * (_Z_01 / max(stats.norm.isf(p), 0.1)) ** 2) - n, 1)
    elif n >= 2:
        more = more_to_settle(ratio, n, at_most=1.0)
    criterion = "median below 1, Wilcoxon p < 0.01"
    return Claim(claim, statistic, ratio, criterion, verdict, f"p = {p:.2g}", more=more)


def equivalent(
    claim: str, statistic: str, first: ArrayLike, second: ArrayLike, margin: float
) -> Claim:
    """Judge that a paired ratio lies within 1 / (1 + m) and 1 + m, by two one-sided t tests.

    They are made in logs, at 0.05. The ratio's 90 % interval, which is stated, corresponds to them.
    """
    ratio, limits = (
        log_ratio_interval(first, second, level=0.90),
        (1.0 / (1.0 + margin), 1.0 + margin),
    )
    return banded(claim, f"{statistic} (90 % interval)", ratio, *limits, n=np.size(first))


def overall(parts: Sequence[Verdict]) -> Verdict:
    """Return the verdict on a claim whose parts must all hold."""
    if set(parts) == {Verdict.REPRODUCED}:
        return Verdict.REPRODUCED
    return Verdict.NOT_REPRODUCED if Verdict.NOT_REPRODUCED in parts else Verdict.UNDECIDED


def conclude(
    claims: Sequence[Claim],
    sentences: Mapping[str, Callable[[Sequence[Claim]], str]],
    unit: str = "recordings",
) -> list[Conclusion]:
    """Give each claim its verdict, which follows from its headlines alone, and its sentence.

    Without headlines a claim is shown. If it is undecided, the sentence also says how many more
    recordings would settle it.

    Parameters
    ----------
    sentences
        For each claim's id, a function that says in plain words what its statistics came to.
    unit
        What intervals narrow with.
    """
    by_id: dict[str, list[Claim]] = {}
    for claim in claims:
        by_id.setdefault(claim.id, []).append(claim)
    return [
        Conclusion(key, verdict, _with_debt(sentences[key](rows), verdict, rows, unit))
        for key, rows in by_id.items()
        for verdict in [headline_verdict([(row.role, row.verdict) for row in rows])]
    ]


def headline_verdict(statistics: Sequence[tuple[Role, Verdict]]) -> Verdict:
    """Verdict on a claim by the roles and verdicts of its statistics."""
    parts = [verdict for role, verdict in statistics if role is Role.HEADLINE]
    return overall(parts) if parts else Verdict.SHOWN


def pick(claims: Sequence[Claim], *words: str) -> Claim:
    """Return the first of a claim's statistics that holds all these words.

    Raises
    ------
    LookupError
        If there is none.
    """
    for claim in claims:
        if all(word in claim.statistic for word in words):
            return claim
    raise LookupError(f"no statistic with {' and '.join(words)}")


def plain(value: float, digits: int = 2) -> str:
    """Write a number with so many digits that count, for a sentence."""
    if not math.isfinite(value):
        return "unknown"
    short = f"{value:.{digits}g}"
    if short.lstrip("-").isdigit() and abs(value) < 10 and value != round(value):
        short += ".0"  # 0.998 is no 1
    return f"{float(short):,.0f}" if abs(value) >= 10**digits else short


def percent(share: float) -> str:
    """Write a share for a sentence."""
    return f"{100.0 * share:.0f} %" if math.isfinite(share) else "an unknown share"


def _with_debt(sentence: str, verdict: Verdict, rows: Sequence[Claim], unit: str) -> str:
    if verdict is not Verdict.UNDECIDED:
        return sentence
    open_ones = [row for row in rows if (row.role, row.verdict) == (Role.HEADLINE, verdict)]
    more = max(row.more for row in open_ones)
    if not more:
        return sentence
    what = "it" if all(row.more for row in open_ones) else "what is open"
    units = unit.removesuffix("s") if more == 1 else unit
    return f"{sentence} About {_rounded(more)} more {units} would settle {what}."


def _rounded(number: int) -> int:
    """Two leading digits of a positive number, rounded up."""
    unit: int = 10 ** max(len(str(number)) - 2, 0)
    return -(-number // unit) * unit
