"""No claim of a paper's is judged by the study of localization in offices."""

from __future__ import annotations

from experiments.evaluation.verdict import Claim
from experiments.papers.results import Results


def judge(_made: Results) -> list[Claim]:
    """Judge nothing: the study is our own."""
    return []
