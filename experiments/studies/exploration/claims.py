"""The claim GI10: coordination explores better.

A world is the unit of inference. Robots that share the frontiers out are judged against robots that
each drive to the nearest one: by the area seen after the same distance, and by the error of the map
that the paper's method makes of the drive.
"""

from collections.abc import Iterator

import pandas as pd

from experiments.evaluation.statistics import log_ratio_interval, share_interval
from experiments.judging.claim import Claim, Subject, own_design, shown
from experiments.judging.results import Results
from experiments.judging.sequential import Design, designs, judge_ratio
from experiments.studies.exploration.settings import (
    AFTER_M,
    BASE,
    BOTH,
    GAIN,
    JUDGED,
    MARGIN,
    N_ROBOTS,
    NAMES,
)


def judge(results: Results) -> list[Claim]:
    """Judge GI10 by the tables."""
    return [*gi10(results.table("runs"))]


def gi10(runs: pd.DataFrame, design: Design | None = None) -> Iterator[Claim]:
    """GI10: robots that share the frontiers out see more, and their map is not worse by 10 %."""
    design = design or designs("exploration")["GI10"]
    area, chart = (
        runs.pivot_table(index="seed", columns="strategy", values=values)
        for values in ("area_m2", "map_rmse_m")
    )

    def subject(quantity: str, method: str, over: str) -> tuple[Subject, str]:
        about = Subject("GI10", quantity, method=method, over=over, setting=AFTER_M)
        return about, f"{quantity}, {NAMES[method]} over {NAMES[over]}"

    seen = f"area seen after {AFTER_M:g} m a robot"
    arms = area[JUDGED], area[BASE]
    yield judge_ratio(*subject(seen, JUDGED, BASE), arms, design, at_least=1.0)
    for method, over in ((JUDGED, "random"), (BOTH, BASE), (BOTH, GAIN), (GAIN, BASE)):
        yield shown(*subject(seen, method, over), log_ratio_interval(area[method], area[over]))
    arms = chart[JUDGED], chart[BASE]
    map_error = "error of FastSLAM's map"
    yield judge_ratio(*subject(map_error, JUDGED, BASE), arms, design, at_most=MARGIN)
    yield own_design(
        "GI10",
        "one building",
        area[JUDGED] > area[BASE],
        whose="The design of the paper's other experiments",
    )
    by_strategy = runs.groupby("strategy")
    n_robots, stopped = N_ROBOTS * by_strategy["seed"].count(), by_strategy["stopped"].sum()
    for strategy in (BASE, JUDGED):
        share = share_interval(int(stopped[strategy]), int(n_robots[strategy]))
        words = f"share of robots that hit something, {NAMES[strategy]}"
        yield shown(Subject("GI10", "hit something", method=strategy), words, share)
