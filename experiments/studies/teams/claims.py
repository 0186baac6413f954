"""The claim GI9: sightings of one another make a team's localization better.

A world is the unit of inference. The paper's own method, FastSLAM, decides; EKF-SLAM and the batch
baseline stand beside it, and what communication costs.
"""

from collections.abc import Iterator

import pandas as pd

from experiments.evaluation.statistics import log_ratio_interval
from experiments.judging.claim import Claim, Subject, beside, judge_lower, shown
from experiments.judging.results import Results
from experiments.studies.teams.settings import ALWAYS, MRCLAM_ARMS

NAMES = {"fastslam": "FastSLAM 2.0", "ekf_slam": "EKF-SLAM", "smoother": "batch"}
_ERROR = "ate_rmse_m"


def judge(results: Results) -> list[Claim]:
    """Judge GI9 by the tables; the log's is there only where the log is."""
    return [*gi9(results.table("errors")), *on_the_log(results.optional_table("mrclam"))]


def gi9(errors: pd.DataFrame) -> Iterator[Claim]:
    """GI9: the error with sightings is below that without, for each size of the team."""
    linked = errors[errors["link"] == ALWAYS]
    for (name, size), part in linked.groupby(["filter", "size"], sort=False):
        wide = part.pivot_table(index="seed", columns="sightings", values=_ERROR).dropna()
        words = f"error with sightings over without, {size} robots: {NAMES[name]}"
        about = Subject("GI9", "sightings", method=str(name), size=int(size))
        yield beside(judge_lower(about, words, wide[True], wide[False]), name != "fastslam")
    own = errors[(errors["filter"] == "ekf_slam") & errors["sightings"]]
    for (link, size), part in own[own["link"] != ALWAYS].groupby(["link", "size"], sort=False):
        both = pd.concat([part, linked[(linked["size"] == size) & linked["sightings"]]])
        both = both[both["filter"] == "ekf_slam"]
        wide = both.pivot_table(index="seed", columns="link", values=_ERROR).dropna()
        words = f"error of {size} robots, communication {link}, over always: {NAMES['ekf_slam']}"
        about = Subject("GI9", "communication", method="ekf_slam", arm=str(link), size=int(size))
        yield shown(about, words, log_ratio_interval(wide[link], wide[ALWAYS]))


def on_the_log(mrclam: pd.DataFrame | None) -> Iterator[Claim]:
    """MRCLAM 6 as a team of five, over its robots alone."""
    if mrclam is None:
        return
    wide = mrclam.pivot_table(index="robot", columns="arm", values=_ERROR).dropna()
    for arm in MRCLAM_ARMS[1:]:
        words = f"error on MRCLAM 6 as a {arm}, over each robot alone: {NAMES['ekf_slam']}"
        about = Subject("GI9", "MRCLAM 6", method="ekf_slam", arm=arm)
        yield shown(about, words, log_ratio_interval(wide[arm], wide[MRCLAM_ARMS[0]]))
