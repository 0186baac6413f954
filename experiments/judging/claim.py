"""A statistic of a claim: its subject, its value with an interval, and the verdict on it.

A study's `judge` makes claims; they are found again by their fields, never by their words.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from experiments.evaluation.statistics import (
    Interval,
    log_ratio_interval,
    share_interval,
    wilcoxon_p,
)

EQUIVALENCE = "equivalence"  # as an effect in words
SMALLEST_EFFECT = 0.1  # of interest, where nothing speaks for another: a ratio of 1.1
WAITS = "waits"  # quantity of a claim whose tables are older than its definition
OWN_DESIGN = "own design"  # quantity of what the paper's own design shows


class Verdict(StrEnum):
    """Whether an interval meets a criterion."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not_reproduced"
    DEPENDS = "depends"  # holds in a part of the region of the free settings; see `region.rule`
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
    effect, power
        Smallest effect of interest, in words, and the power with which data of this size decide it;
        NaN: unknown.
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
    effect: str = ""
    power: float = math.nan
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


def judge_one_side(
    found: Interval, at_least: float, at_most: float, near: tuple[float, float]
) -> tuple[Verdict, bool]:
    """Judge an interval against one limit, and say whether it is shown to be near it.

    What spans the limit but lies within the smallest effect of interest of it, `near`, is
    decided: there is no effect to speak of, so the claim does not hold.
    """
    verdict = judge_interval(found, at_least, at_most)
    if verdict is Verdict.UNDECIDED and judge_interval(found, *near) is Verdict.REPRODUCED:
        return Verdict.NOT_REPRODUCED, True
    return verdict, False


def power_of(
    found: Interval,
    effect: float = SMALLEST_EFFECT,
    band: tuple[float, float] = (-math.inf, math.inf),
    *,
    level: float = 0.95,
    error: float | None = None,
) -> float:
    """Power that data of this size have, by the width of the interval that they gave; NaN: unknown.

    A positive interval is measured in logs.

    Parameters
    ----------
    effect
        Smallest effect of interest: a ratio to the criterion's limit less one, in percent of the
        limit where the interval is not positive, or in its unit where the limit is 0.
    band
        Criterion. With two finite ends, the power is that of showing that a value in its middle
        lies within; else that of deciding an effect on one side of the limit.
    level
        Of the interval.
    error
        One-sided error of the test; by default the interval's.
    """
    is_log = found.low > 0.0 and all(end > 0.0 for end in band if math.isfinite(end))
    scale = math.log if is_log else float
    half = (scale(found.high) - scale(found.low)) / 2.0 if math.isfinite(found.low) else math.nan
    if not half > 0.0 or not math.isfinite(half):
        return math.nan
    z = float(scipy.stats.norm.ppf(0.5 + level / 2.0))
    limit = float(scipy.stats.norm.isf(error)) if error else z
    if all(map(math.isfinite, band)):
        reach = (scale(band[1]) - scale(band[0])) / 2.0
        return float(max(2.0 * scipy.stats.norm.cdf(reach * z / half - limit) - 1.0, 0.0))
    ends = [abs(end) for end in band if math.isfinite(end)]
    size = math.log1p(effect) if is_log else effect * (ends[0] if ends and ends[0] > 1e-6 else 1.0)
    return float(scipy.stats.norm.cdf(size * z / half - limit))


def effect_in_words(effect: float) -> str:
    """An effect that is a share of a limit, in words."""
    return f"an effect of {100.0 * effect:.3g} %"


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


def waiting(claim: str) -> Claim:
    """State that a claim waits for the judged run, since its tables are older than its definition.

    Its verdict is `shown`, as it has no headline.
    """
    said = "not judged yet by its present definition"
    return shown(Subject(claim, WAITS), said, Interval(math.nan, math.nan, math.nan))


def own_design(
    claim: str, design: str, hits: ArrayLike, *, whose: str = "The paper's own design"
) -> Claim:
    """State how often the paper's own design shows what the paper says.

    Parameters
    ----------
    design
        In words, such as "one drive".
    hits
        Whether each recording alone shows it (N,).
    whose
        In words, where the paper has no such study.
    """
    shows = np.asarray(hits, bool)
    share = share_interval(int(shows.sum()), len(shows))
    said = (
        f"{whose}, {design}, shows what is claimed in {int(shows.sum())} of {len(shows)} "
        "repetitions."
    )
    about = Subject(claim, OWN_DESIGN, arm=design)
    return shown(about, f"share of cases in which {design} shows it", share, said)


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
    effect: float = SMALLEST_EFFECT,
    level: float = 0.95,
) -> Claim:
    """Judge an interval against [at_least, at_most]; the criterion is these bounds in words.

    Parameters
    ----------
    criterion
        Other words for the bounds.
    effect, level
        As for `power_of`.
    """
    words = f"at least {at_least:g}" if at_least > -math.inf else f"at most {at_most:g}"
    if -math.inf < at_least and at_most < math.inf:
        words = f"within {at_least:.3g} and {at_most:g}"
    verdict = judge_interval(found, at_least, at_most)
    band = at_least, at_most
    power = power_of(found, effect, band, level=level)
    is_share = max(abs(end) for end in band if math.isfinite(end)) > 1e-6
    seen = effect_in_words(effect) if is_share else f"an effect of {effect:.2g}"
    if all(map(math.isfinite, band)):
        seen = EQUIVALENCE
    return Claim(about, statistic, found, criterion or words, verdict, effect=seen, power=power)


def judge_lower(about: Subject, statistic: str, first: ArrayLike, second: ArrayLike) -> Claim:
    """Judge that paired values are lower in the first arm, by their ratio and Wilcoxon's p.

    Reproduced if the median ratio is below one and p < 0.01; not reproduced if the ratio's interval
    has nothing below one; undecided if it spans one, or there are fewer than two pairs. The fact is
    `p`.
    """
    above, below = np.asarray(first, float), np.asarray(second, float)
    n, ratio = len(above), log_ratio_interval(above, below)
    effect, power = effect_in_words(SMALLEST_EFFECT), power_of(ratio, error=0.01)
    p = 1.0 if np.array_equal(above, below) else wilcoxon_p(above, below)
    verdict = Verdict.UNDECIDED
    if n >= 2 and p < 0.01 and float(np.median(np.log(above) - np.log(below))) < 0.0:
        verdict = Verdict.REPRODUCED
    elif n >= 2 and ratio.low >= 1.0:
        verdict = Verdict.NOT_REPRODUCED
    criterion, reason = "median below 1, Wilcoxon p < 0.01", f"p = {p:.2g}"
    return Claim(
        about, statistic, ratio, criterion, verdict, reason,
        effect=effect, power=power, facts={"p": p},
    )  # fmt: skip


def judge_equivalent(
    about: Subject, statistic: str, first: ArrayLike, second: ArrayLike, margin: float
) -> Claim:
    """Judge that a paired ratio lies within 1 / (1 + m) and 1 + m, by two one-sided t tests.

    They are made in logs, at 0.05. The ratio's 90 % interval, which is stated, corresponds to them.
    """
    ratio = log_ratio_interval(first, second, level=0.90)
    low, high = 1.0 / (1.0 + margin), 1.0 + margin
    return judge_bounds(about, f"{statistic} (90 % interval)", ratio, low, high, level=0.90)
