"""The claim GI10: coordination explores better.

A world is the unit of inference. Coordinated robots are judged against robots that each drive to
the nearest frontier: by the area seen after the same distance, and by the error of the map that the
paper's method makes of the drive.
"""

from collections.abc import Iterator

import pandas as pd

from experiments.evaluation.statistics import log_ratio_interval, share_interval
from experiments.judging.claim import Claim, Subject, beside, judge_bounds, judge_lower, shown
from experiments.judging.results import Results
from experiments.studies.exploration.settings import (
    AFTER_M,
    BASE,
    GAIN,
    JUDGED,
    MARGIN,
    N_ROBOTS,
    NAMES,
    SHARED,
)


def judge(results: Results) -> list[Claim]:
    """Judge GI10 by the tables."""
    return [*gi10(results.table("runs"))]


def gi10(runs: pd.DataFrame) -> Iterator[Claim]:
    """GI10: coordinated robots see more, and their map is not worse by 10 %."""
    area, chart = (
        runs.pivot_table(index="seed", columns="strategy", values=values)
        for values in ("area_m2", "map_rmse_m")
    )

    def subject(quantity: str, method: str, over: str) -> tuple[Subject, str]:
        about = Subject("GI10", quantity, method=method, over=over, setting=AFTER_M)
        return about, f"{quantity}, {NAMES[method]} over {NAMES[over]}"

    seen = f"area seen after {AFTER_M:g} m a robot"
    for other in NAMES:
        if other != JUDGED:
            found = judge_lower(*subject(seen, other, JUDGED), area[other], area[JUDGED])
            yield beside(found, other != BASE)
    for shared, own in ((SHARED, BASE), (JUDGED, GAIN)):
        yield shown(*subject(seen, shared, own), log_ratio_interval(area[shared], area[own]))
    ratio = log_ratio_interval(chart[JUDGED], chart[BASE])
    about = subject("error of FastSLAM's map", JUDGED, BASE)
    yield judge_bounds(*about, ratio, at_most=MARGIN)
    by_strategy = runs.groupby("strategy")
    n_robots, stopped = N_ROBOTS * by_strategy["seed"].count(), by_strategy["stopped"].sum()
    for strategy in (BASE, JUDGED):
        share = share_interval(int(stopped[strategy]), int(n_robots[strategy]))
        words = f"share of robots that hit something, {NAMES[strategy]}"
        yield shown(Subject("GI10", "hit something", method=strategy), words, share)
