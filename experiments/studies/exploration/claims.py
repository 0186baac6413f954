"""The claim GI10: coordination explores better.

A world is the unit of inference. Coordinated robots are judged against robots that each drive to
the nearest frontier: by the area seen after the same distance, and by the error of the map that the
paper's method makes of the drive.
"""

from collections.abc import Iterator, Sequence

import pandas as pd

from experiments.evaluation.statistics import log_ratio_interval, share_interval
from experiments.judging.by_words import (
    Claim,
    Conclusion,
    banded,
    beside,
    conclude,
    lower,
    pick,
    plain,
    shown,
)
from experiments.judging.results import Results
from experiments.studies.exploration.settings import (
    AFTER_M,
    BASE,
    GAIN,
    JUDGED,
    MARGIN,
    N_ROBOTS,
    SHARED,
    STRATEGIES,
)

NAMES = {
    "random": "random",
    "nearest_frontier": "nearest frontier",
    "shared_frontiers": "shared out by cost",
    "information_gain": "information gain",
    "coordinated": "coordinated",
}


def judge(made: Results) -> list[Claim]:
    """Judge GI10 by the tables."""
    return [*gi10(made.table("runs"))]


def conclusions(made: Results, claims: Sequence[Claim]) -> list[Conclusion]:
    """Verdict and sentence of GI10."""
    return conclude(claims, {"GI10": gi10_sentence}, "worlds")


def gi10(runs: pd.DataFrame) -> Iterator[Claim]:
    """GI10: coordinated robots see more, and their map is not worse by 10 %."""
    area, chart = (
        runs.pivot_table(index="seed", columns="strategy", values=values)
        for values in ("area_m2", "map_rmse_m")
    )
    words = f"area seen after {AFTER_M:g} m a robot"
    for other in STRATEGIES:
        if other != JUDGED:
            ratio = f"{words}, {NAMES[other]} over {NAMES[JUDGED]}"
            yield beside(lower("GI10", ratio, area[other], area[JUDGED]), other != BASE)
    for shared, own in ((SHARED, BASE), (JUDGED, GAIN)):
        ratio = f"{words}, {NAMES[shared]} over {NAMES[own]}"
        yield shown("GI10", ratio, log_ratio_interval(area[shared], area[own]))
    found = log_ratio_interval(chart[JUDGED], chart[BASE])
    words = f"error of FastSLAM's map, {NAMES[JUDGED]} over {NAMES[BASE]}"
    yield banded("GI10", words, found, at_most=MARGIN, n=len(chart))
    n_robots = N_ROBOTS * runs.groupby("strategy")["seed"].count()
    stopped = runs.groupby("strategy")["stopped"].sum()
    for strategy in (BASE, JUDGED):
        share = share_interval(int(stopped[strategy]), int(n_robots[strategy]))
        yield shown("GI10", f"share of robots that hit something, {NAMES[strategy]}", share)


def gi10_sentence(rows: Sequence[Claim]) -> str:
    """Say how much more coordinated robots see, and what it does to the map."""
    area = pick(rows, "area seen", f"{NAMES[BASE]} over {NAMES[JUDGED]}").found
    alone = pick(rows, "area seen", f"{NAMES[SHARED]} over {NAMES[BASE]}").found
    added = pick(rows, "area seen", f"{NAMES[JUDGED]} over {NAMES[GAIN]}").found
    chart = pick(rows, "error of FastSLAM's map").found
    return (
        f"After {AFTER_M:g} m a robot, coordinated robots have seen {plain(1.0 / area.value, 3)} "
        f"times the area that robots at their nearest frontiers have; the error of FastSLAM's map "
        f"is {plain(chart.value)} times theirs. Sharing frontiers out by the way alone makes the "
        f"area of the nearest frontiers {plain(alone.value, 3)} times as large; sharing them out "
        f"among robots that already weigh what frontiers show, {plain(added.value, 3)} times."
    )
