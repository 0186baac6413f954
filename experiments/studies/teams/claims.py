"""The claim GI9: sightings of one another make a team's localization better.

<<<<<<< HEAD
A world is the unit of inference. The paper's own method, FastSLAM, decides; EKF-SLAM and the batch
baseline stand beside it, and what communication costs.
=======
A world is the unit of inference. The paper's own method, the printed filter with 200 particles,
decides; FastSLAM 2.0, EKF-SLAM and the batch bound stand beside it, and what communication costs.
>>>>>>> w_VERDICTS
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import pandas as pd

from experiments.evaluation.statistics import log_ratio_interval
from experiments.judging.claim import Claim, Subject, beside, judge_bounds, shown, with_remark
from experiments.judging.region import Region
from experiments.judging.region_runs import Compared, Headlines, judge_tables, judged_regions
from experiments.judging.results import Results
from experiments.judging.sentences import percent
from experiments.judging.sequential import Design, designs, judge_ratio
from experiments.studies.teams.settings import ALWAYS, CALIBRATED, MRCLAM_ARMS, PRINTED

NAMES = {
    PRINTED: "the printed filter, 200 particles",
    "fastslam": "FastSLAM 2.0, 1000 particles",
    "ekf_slam": "EKF-SLAM",
    "smoother": "batch",
}
_ERROR = "ate_rmse_m"
HEADLINES: Headlines = {
    "GI9": [Compared("with_m", "without_m", "error with sightings / without", at_most=1.0)]
}


def judge(results: Results) -> list[Claim]:
    """Judge GI9 by the tables; the log's is there only where the log is."""
    claims = judge_tables(results, {"GI9": (gi9, {"errors": ("inside_share",)})})
    return [*claims, *on_the_log(results.optional_table("mrclam"))]


def regions(results: Results) -> Mapping[str, Region]:
    """Where GI9 holds over the settings that the paper leaves open."""
    return judged_regions(results, HEADLINES)


def gi9(errors: pd.DataFrame, design: Design | None = None) -> Iterator[Claim]:
    """GI9: the error with sightings is below that without, for each size of the team.

    The printed filter decides. Beside stand other methods, whether beliefs become less uncertain,
    and what communication costs.
    """
    linked, design = errors[errors["link"] == ALWAYS], design or designs("teams")["GI9"]
    for (name, size), part in linked.groupby(["filter", "size"], sort=False):
        wide = part.pivot_table(index="seed", columns="sightings", values=_ERROR).dropna()
        words = f"error with sightings over without, {size} robots: {NAMES[name]}"
        about = Subject("GI9", "sightings", method=str(name), size=int(size))
        claim = judge_ratio(about, words, (wide[True], wide[False]), design, at_most=1.0)
        yield beside(claim, name != PRINTED)
        if "inside_share" in part:
            yield _less_uncertain(part, replace(about, quantity="uncertainty"))
    own = errors[(errors["filter"] == "ekf_slam") & errors["sightings"]]
    for (link, size), part in own[own["link"] != ALWAYS].groupby(["link", "size"], sort=False):
        both = pd.concat([part, linked[(linked["size"] == size) & linked["sightings"]]])
        both = both[both["filter"] == "ekf_slam"]
        wide = both.pivot_table(index="seed", columns="link", values=_ERROR).dropna()
        words = f"error of {size} robots, communication {link}, over always: {NAMES['ekf_slam']}"
        about = Subject("GI9", "communication", method="ekf_slam", arm=str(link), size=int(size))
        yield shown(about, words, log_ratio_interval(wide[link], wide[ALWAYS]))


def _less_uncertain(part: pd.DataFrame, about: Subject) -> Claim:
    """Judge the size of beliefs with sightings over without, if both are calibrated."""
    wide = part.pivot_table(index="seed", columns="sightings", values=["sigma_m", "inside_share"])
    found = log_ratio_interval(wide["sigma_m", True], wide["sigma_m", False])
    shares = [float(wide["inside_share", used].mean()) for used in (False, True)]
    is_calibrated = all(CALIBRATED[0] <= share <= CALIBRATED[1] for share in shares)
    words = f"deviation of beliefs with sightings over without, {about.size} robots: "
    label, inside = words + NAMES[str(about.method)], " and ".join(map(percent, shares))
    facts = {"inside": inside, "is_calibrated": is_calibrated}
    if not is_calibrated:
        why = f"not answerable: {inside} of true positions lie in the 95 % ellipses"
        return shown(about, label, found, why, **facts)
    return with_remark(beside(judge_bounds(about, label, found, at_most=1.0)), inside, **facts)


def on_the_log(mrclam: pd.DataFrame | None) -> Iterator[Claim]:
    """MRCLAM 6 as a team of five, over its robots alone."""
    if mrclam is None:
        return
    wide = mrclam.pivot_table(index="robot", columns="arm", values=_ERROR).dropna()
    for arm in MRCLAM_ARMS[1:]:
        words = f"error on MRCLAM 6 as a {arm}, over each robot alone: {NAMES['ekf_slam']}"
        about = Subject("GI9", "MRCLAM 6", method="ekf_slam", arm=arm)
        yield shown(about, words, log_ratio_interval(wide[arm], wide[MRCLAM_ARMS[0]]))
