"""The claim GI10: coordination explores better.

A world is the unit of inference. Coordinated robots are judged against robots that each drive to
the nearest frontier: by the area seen after the same distance, and by the error of the map that the
paper's method makes of the drive.
"""

from collections.abc import Iterator, Sequence

import pandas as pd

from experiments.evaluation.statistics import log_ratio_interval, share_interval
from experiments.evaluation.verdict import (
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
from experiments.papers.exploration.settings import (
    AFTER_M,
    BASE,
    JUDGED,
    MARGIN,
    N_ROBOTS,
    STRATEGIES,
)
from experiments.papers.results import Results

NAMES = {
    "random": "random",
    "nearest_frontier": "nearest frontier",
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
            both = area[[other, JUDGED]].dropna()
            yield beside(lower("GI10", ratio, both[other], both[JUDGED]), other != BASE)
    both = chart[[JUDGED, BASE]].dropna()
    found = log_ratio_interval(both[JUDGED], both[BASE])
    words = f"error of FastSLAM's map, {NAMES[JUDGED]} over {NAMES[BASE]}"
    yield banded("GI10", words, found, at_most=MARGIN, n=len(both))
    n_robots = N_ROBOTS * runs.groupby("strategy")["seed"].count()
    stopped = runs.groupby("strategy")["stopped"].sum()
    for strategy in (BASE, JUDGED):
        share = share_interval(int(stopped[strategy]), int(n_robots[strategy]))
        yield shown("GI10", f"share of robots that hit something, {NAMES[strategy]}", share)


def gi10_sentence(rows: Sequence[Claim]) -> str:
    """Say how much more coordinated robots see, and what it does to the map."""
    area = pick(rows, "area seen", NAMES[BASE]).found
    gain = pick(rows, "area seen", NAMES["information_gain"]).found
    chart = pick(rows, "error of FastSLAM's map").found
    return (
        f"After {AFTER_M:g} m a robot, coordinated robots have seen {plain(1.0 / area.value, 3)} "
        f"times the area that robots at their nearest frontiers have; the error of FastSLAM's map "
        f"is {plain(chart.value)} times theirs. Robots that weigh what frontiers show, but do not "
        f"share them out, have seen {plain(gain.value, 3)} times the area of the coordinated ones."
    )
