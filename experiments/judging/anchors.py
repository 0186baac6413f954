"""Find a claim's anchor: where the reference arm has its printed level, on tuning seeds.

python -m experiments.judging.anchors STUDY CLAIM [WORLDS]    # prints lines for design.yaml
"""

import sys
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np

from experiments.judging.folders import part
from experiments.judging.free_settings import find_anchor, free_settings, sample
from experiments.runs.console import show
from experiments.runs.row import Row
from experiments.runs.seeds import stream

Run = Callable[[Mapping[Any, Any], int], Row]


def find(study: str, claim: str, n_worlds: int = 2, n_points: int = 64) -> list[str]:
    """Lines for the design: the anchor at each printed level of a claim, and its level.

    The study's `reference_run` runs tuning seeds 0, 1, ...; a level is the geometric mean.
    """
    free, run = free_settings(study)[claim], part(study, "study").reference_run
    points, lines = sample(free.settings, n_points, rng=stream(0, f"anchor/{study}/{claim}")), []
    sampled = [_levels(run, at, n_worlds) for at in points.to_dict("records")]
    for place, printed in free.printed.items():

        def measure(values: Mapping[str, Any], column: str = printed.column) -> float:
            return _levels(run, values, n_worlds)[column]

        levels = [each[printed.column] for each in sampled]
        found = find_anchor(free.settings, points, levels, printed.value, measure, tries=12)
        at = (
            f"anchor: {dict(found.settings)}, level: {found.level:.4g}" if found else "anchor: null"
        )
        lines.append(f"{place}: {{column: {printed.column}, value: {printed.value:g}, {at}}}")
    return lines


def _levels(run: Run, values: Mapping[Any, Any], n_worlds: int) -> dict[str, float]:
    """Each column's geometric mean over the worlds."""
    rows = [run(values, seed) for seed in range(n_worlds)]
    return {
        name: float(np.exp(np.mean([np.log(cast(float, row[name])) for row in rows])))
        for name in rows[0]
    }


if __name__ == "__main__":
    _, asked_study, asked_claim, *asked_n = sys.argv
    show("\n".join(find(asked_study, asked_claim, *map(int, asked_n))))
