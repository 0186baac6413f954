"""The study of localization in offices judges no claim."""

from __future__ import annotations

from experiments.evaluation.verdict import Claim
from experiments.papers.results import Results


def judge(_made: Results) -> list[Claim]:
    """Return no claims, since the study is our own."""
    return []
