"""The claim GI9: sightings of one another make a team's localization better.

A world is the unit of inference. The paper's own method, FastSLAM, decides; EKF-SLAM and the batch
bound stand beside it, and what communication costs.
"""

from collections.abc import Iterator, Sequence

import pandas as pd

from experiments.evaluation.statistics import log_ratio_interval
from experiments.judging.results import Results
from experiments.judging.verdict import (
    Claim,
    Conclusion,
    beside,
    conclude,
    lower,
    pick,
    plain,
    shown,
)
from experiments.studies.teams.settings import ALWAYS, MRCLAM_ARMS

NAMES = {"fastslam": "FastSLAM 2.0", "ekf_slam": "EKF-SLAM", "smoother": "batch"}
_ERROR = "ate_rmse_m"


def judge(made: Results) -> list[Claim]:
    """Judge GI9 by the tables; the log's is there only where the log is."""
    log = made.table("mrclam") if made.has_table("mrclam") else None
    return [*gi9(made.table("errors")), *on_the_log(log)]


def conclusions(made: Results, claims: Sequence[Claim]) -> list[Conclusion]:
    """Verdict and sentence of GI9."""
    return conclude(claims, {"GI9": gi9_sentence}, "worlds")


def gi9(errors: pd.DataFrame) -> Iterator[Claim]:
    """GI9: the error with sightings is below that without, for each size of the team."""
    linked = errors[errors["link"] == ALWAYS]
    for (name, size), part in linked.groupby(["filter", "size"], sort=False):
        wide = part.pivot_table(index="seed", columns="sightings", values=_ERROR).dropna()
        words = f"error with sightings over without, {size} robots: {NAMES[name]}"
        yield beside(lower("GI9", words, wide[True], wide[False]), name != "fastslam")
    own = errors[(errors["filter"] == "ekf_slam") & errors["sightings"]]
    for (link, size), part in own[own["link"] != ALWAYS].groupby(["link", "size"], sort=False):
        both = pd.concat([part, linked[(linked["size"] == size) & linked["sightings"]]])
        both = both[both["filter"] == "ekf_slam"]
        wide = both.pivot_table(index="seed", columns="link", values=_ERROR).dropna()
        words = f"error of {size} robots, communication {link}, over always: {NAMES['ekf_slam']}"
        yield shown("GI9", words, log_ratio_interval(wide[link], wide[ALWAYS]))


def on_the_log(mrclam: pd.DataFrame | None) -> Iterator[Claim]:
    """MRCLAM 6 as a team of five, over its robots alone."""
    if mrclam is None:
        return
    wide = mrclam.pivot_table(index="robot", columns="arm", values=_ERROR).dropna()
    for arm in MRCLAM_ARMS[1:]:
        words = f"error on MRCLAM 6 as a {arm}, over each robot alone: {NAMES['ekf_slam']}"
        yield shown("GI9", words, log_ratio_interval(wide[arm], wide[MRCLAM_ARMS[0]]))


def gi9_sentence(rows: Sequence[Claim]) -> str:
    """Say by how much sightings change the error, by the size of the team."""
    words = "error with sightings over without"
    sizes = [row for row in rows if words in row.statistic and NAMES["fastslam"] in row.statistic]
    said = ", ".join(
        f"{plain(row.found.value)} times with {row.statistic.split(', ')[1].split(':')[0]}"
        for row in sizes
    )
    ekf = [row for row in rows if words in row.statistic and NAMES["ekf_slam"] in row.statistic]
    beside_ = ", ".join(plain(row.found.value) for row in ekf)
    sentence = f"Sightings of one another change the error of FastSLAM to {said}"
    sentence += f"; of EKF-SLAM, to {beside_} times." if ekf else "."
    try:
        log = pick(rows, "MRCLAM 6 as a team with sightings").found
    except LookupError:
        return sentence
    return f"{sentence} On MRCLAM 6 a team of five errs {plain(log.value)} times a robot alone."
