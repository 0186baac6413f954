"""Claims by their words, for studies not yet converted; deleted with the last of them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from experiments.judging import claim as kit
from experiments.judging.claim import Claim as _Claim
from experiments.judging.claim import Subject
from experiments.judging.sentences import Conclusion, more_needed, percent, plain
from experiments.judging.verdict import (
    Role,
    Verdict,
    headline_verdict,
    holds,
    judged,
    more_to_settle,
    overall,
)

__all__ = [
    "Claim", "Conclusion", "Role", "Verdict", "banded", "beside", "conclude", "equivalent", "holds",
    "judged", "lower", "more_to_settle", "overall", "percent", "pick", "plain", "remarked", "shown",
]  # fmt: skip


class Claim(_Claim):
    """As before, by its id."""

    def __init__(
        self, claim: str = "", *values: Any, about: Subject | None = None, **more: Any
    ) -> None:
        super().__init__(about or Subject(claim, ""), *values, **more)


def banded(claim: str, statistic: str, found: Any, *bounds: float, **options: Any) -> Any:
    """As before, by its id."""
    return kit.banded(Subject(claim, ""), statistic, found, *bounds, **options)


def lower(claim: str, *values: Any) -> Any:
    """As before, by its id."""
    return kit.lower(Subject(claim, ""), *values)


def equivalent(claim: str, *values: Any) -> Any:
    """As before, by its id."""
    return kit.equivalent(Subject(claim, ""), *values)


def shown(claim: str, *values: Any) -> Any:
    """As before, by its id."""
    return kit.shown(Subject(claim, ""), *values)


def remarked(claim: _Claim, *remarks: str) -> Any:
    """As before."""
    for remark in reversed(remarks):
        claim = kit.remarked(claim, remark)
    return claim


def beside(claim: Any, is_beside: bool = True) -> Any:
    """As before."""
    return kit.beside(claim, is_beside)


def pick(claims: Sequence[_Claim], *words: str) -> Any:
    """Return the first of a claim's statistics that holds all these words."""
    for claim in claims:
        if all(word in claim.statistic for word in words):
            return claim
    raise LookupError(f"no statistic with {' and '.join(words)}")


def conclude(
    claims: Sequence[Any],
    sentences: Mapping[str, Callable[[Any], str]],
    unit: str = "recordings",
) -> list[Conclusion]:
    """Give each claim its verdict and its sentence."""
    by_id: dict[str, list[_Claim]] = {}
    for claim in claims:
        by_id.setdefault(claim.id, []).append(claim)
    said = []
    for key, rows in by_id.items():
        verdict = headline_verdict([(row.role, row.verdict) for row in rows])
        more = more_needed(rows, unit) if verdict is Verdict.UNDECIDED else ""
        said.append(Conclusion(key, verdict, sentences[key](rows) + more))
    return said
