"""One sentence a claim: a template of the study's findings, filled from the claim's statistics.

A template selects statistics by their fields, `select(quantity="error", size=3)` for the one and
`select_all(...)` for all with them, and writes their numbers by the filters of this module;
`headlines` is the verdict of the headlines, in words.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

from jinja2 import Environment, StrictUndefined

from experiments.evaluation.statistics import Interval
from experiments.judging.claim import (
    EQUIVALENCE,
    OWN_DESIGN,
    WAITS,
    Claim,
    Role,
    Verdict,
    headline_verdict,
    select,
    select_all,
)
from experiments.judging.region import Region, rule

WAITING = (
    "Its definition has changed (see the errata), and it waits for the judged run on new worlds."
)


@dataclass(frozen=True)
class Conclusion:
    """The one verdict on a claim, and a sentence that says what came out."""

    id: str
    verdict: Verdict
    sentence: str
    region: Region | None = None
    at_anchor: Verdict = Verdict.SHOWN  # of the headlines; the claim's own without a region


def conclude(
    claims: Iterable[Claim],
    findings: Mapping[str, Any],
    regions: Mapping[str, Region] = MappingProxyType({}),
) -> list[Conclusion]:
    """Give each claim its verdict and its sentence.

    The verdict follows from the headlines alone, and from the region of free settings if the claim
    has one; the headlines are then those at its anchor, and the sentence says what decides.
    Without headlines or region a claim is shown, as is one that waits for the judged run. The
    sentence also states what the paper's own design shows and, of an undecided claim, with what
    power data of that size decide.

    Parameters
    ----------
    findings
        `sentences`, a template by the claim's id; `anchor`, the printed level, in words.
    regions
        By the claim's id.
    """
    by_id: dict[str, list[Claim]] = {}
    for claim in claims:
        by_id.setdefault(claim.id, []).append(claim)
    conclusions = []
    for key, rows in by_id.items():
        verdict = at_anchor = headline_verdict([(row.role, row.verdict) for row in rows])
        if select_all(rows, quantity=WAITS):
            conclusions.append(Conclusion(key, verdict, WAITING))
            continue
        own = [row.reason for row in select_all(rows, quantity=OWN_DESIGN)]
        said, region = sentence(findings["sentences"][key], rows), regions.get(key)
        said = " ".join([said, *own])
        if region:
            rests_on = region.words(at_anchor, findings.get("anchor", ""))
            verdict, said = rule(at_anchor, region.share), f"{said} {rests_on}"
        if verdict is Verdict.UNDECIDED:
            said += power_stated(rows)
        conclusions.append(Conclusion(key, verdict, said, region, at_anchor))
    return conclusions


def sentence(template: str, rows: Sequence[Claim]) -> str:
    """Fill a claim's template with its statistics."""
    names = {
        "select": partial(select, rows),
        "select_all": partial(select_all, rows),
        "headlines": headline_verdict([(row.role, row.verdict) for row in rows]).label,
        "rows": rows,
    }
    return " ".join(_ENVIRONMENT.from_string(template).render(names).split())


def power_stated(rows: Sequence[Claim]) -> str:
    """Say what power an undecided claim's data have; empty if that is unknown."""
    open_ones = select_all(rows, role=Role.HEADLINE, verdict=Verdict.UNDECIDED)
    known = [row for row in open_ones if math.isfinite(row.power)]
    if not known:
        return ""
    least = min(known, key=lambda row: row.power)
    often = f"{100.0 * min(least.power, 0.99):.0f} of 100"
    what = f"{least.effect}, if there is one, would be decided in {often}"
    if least.effect == EQUIVALENCE:
        what = f"two arms that are alike would be shown to be so in {often}"
    found = ", ".join(plain(each, 3) for each in (least.found.low, least.found.high))
    return (
        f" Undecided is “{least.statistic}”, {plain(least.found, 3)} [{found}], as the interval "
        f"contains the limit ({least.criterion}); more data would decide it. With data of this "
        f"size, {what} studies."
    )


def plain(number: float | Interval, digits: int = 2) -> str:
    """Write a number, or an interval's value, with so many significant digits."""
    value = number.value if isinstance(number, Interval) else number
    if not math.isfinite(value):
        return "unknown"
    short = f"{value:.{digits}g}"
    if short.lstrip("-").isdigit() and abs(value) < 10 and value != round(value):
        short += ".0"  # 0.998 is not 1
    return f"{float(short):,.0f}" if abs(value) >= 10**digits else short


def percent(share: float | Interval) -> str:
    """Write a share, or an interval's value, in percent."""
    value = share.value if isinstance(share, Interval) else share
    return f"{100.0 * value:.0f} %" if math.isfinite(value) else "an unknown share"


def bracketed(found: Interval) -> str:
    """Write a value with its interval in brackets."""
    value, low, high = (plain(each, 3) for each in (found.value, found.low, found.high))
    return f"{value} [{low}, {high}]"


def ends(found: Interval) -> str:
    """Write the ends of an interval."""
    return f"{plain(found.low)} to {plain(found.high)}"


def span(claims: Sequence[Claim]) -> str:
    """Write the lowest and the highest value of some statistics."""
    values = [claim.found.value for claim in claims]
    return f"{plain(min(values))} to {plain(max(values))}"


_ENVIRONMENT = Environment(undefined=StrictUndefined, autoescape=False)
_ENVIRONMENT.filters |= {each.__name__: each for each in (plain, percent, bracketed, ends, span)}
