"""Claims RL1 to RL5: what the real logs must show."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import Interval
from experiments.judging.claim import (
    SMALLEST_EFFECT,
    Claim,
    Subject,
    Verdict,
    beside,
    holds,
    judge_bounds,
    judge_one_side,
    shown,
    with_remark,
)
from experiments.judging.results import Results
from experiments.studies.real_logs.settings import (
    FUSION,
    HELD_OUT,
    INTEL,
    LOGGED,
    MRCLAM_BASE,
    MRCLAM_CHOSEN,
    MRCLAM_METHODS,
)


def judge(results: Results) -> list[Claim]:
    """Judge RL1 to RL5 by the tables."""
    return [
        rl1(results.table("ate")),
        *rl2(results.table("relations")),
        *rl3(results.table("mrclam")),
        *rl4(results.table("wheels"), results.table("lego")),
        rl5(results.table("wean")),
    ]


def rl1(ate: pd.DataFrame) -> Claim:
    """RL1: ATE of stored trajectories equals the printed values to the last digit."""
    same = ate.ate_m.map("{:.3f}".format) == ate.printed_m.astype(float).map("{:.3f}".format)
    statistic = "share of trajectories of Rawseeds 25a, 25b whose ATE has the printed digits"
    found, n, verdict = Interval.exact(float(same.mean())), len(same), holds(bool(same.all()))
    return Claim(Subject("RL1", "ATE", size=n), statistic, found, "1", verdict, f"of {n}")


def rl2(relations: pd.DataFrame) -> Iterator[Claim]:
    """RL2: on the Intel log, fusion beats odometry and ICP in the relations metric.

    Judged after the part that the filter's noise was tuned on, over the same relations. Odometry as
    logged and the whole log are shown as well.
    """
    intel = relations[relations.log == "intel"]
    for part, where in (("judged", "after the tuned part"), ("all", "the whole log")):
        rows = intel[intel.part == part].set_index("method")
        for other in (name for name in INTEL[1:] if name != FUSION):
            about = Subject("RL2", "translational error", method=FUSION, over=other, place=where)
            claim = _difference(about, rows.loc[FUSION], rows.loc[other])
            if part == "all":
                reason = f"the tuned part is in it; {claim.reason}"
                yield shown(about, claim.statistic, claim.found, reason, **claim.facts)
            else:
                yield beside(claim, other == LOGGED)


def _difference(about: Subject, fused: pd.Series[float], rival: pd.Series[float]) -> Claim:
    """Judge the paired difference of the errors over the same relations."""
    found = Interval(*(float(rival[f"difference_{end}_m"]) for end in ("mean", "low", "high")))
    label = (
        f"translational error of {FUSION} less that of the other, m: {about.over}, Intel, "
        f"{about.place}"
    )
    ours_m, other_m = float(fused.translation_mean_m), float(rival.translation_mean_m)
    effect_m = SMALLEST_EFFECT * other_m
    claim = judge_bounds(about, label, found, at_most=0.0, criterion="below 0", effect=effect_m)
    verdict, is_near = judge_one_side(found, -math.inf, 0.0, (-effect_m, effect_m))
    remark = f"fusion {ours_m:.3f} m, the other {other_m:.3f} m"
    if is_near:
        remark += f", alike within {100.0 * SMALLEST_EFFECT:.0f} %"
    facts = {"fused_m": ours_m, "other_m": other_m, "is_near": is_near}
    return with_remark(replace(claim, verdict=verdict), remark, **facts)


def rl3(mrclam: pd.DataFrame) -> Iterator[Claim]:
    """RL3: SLAM with landmarks beats calibrated dead reckoning on robots 3 to 5.

    Robots 1 and 2, on which the options were chosen, stand beside. The chosen options are the
    headlines, a row each for known and for unknown ids.
    """
    for judged, rows in mrclam.groupby(mrclam.judged.astype(bool), sort=False):
        base_m = rows[rows.method == MRCLAM_BASE].set_index("robot").ate_rmse_m
        for method, own in rows.groupby("method"):
            if MRCLAM_METHODS[method][0] != "dead reckoning":
                ratio = (own.groupby("robot").ate_rmse_m.mean() / base_m).dropna()
                claim = _below_on_every_robot(str(method), ratio, is_judged=bool(judged))
                yield beside(claim, not judged or method not in MRCLAM_CHOSEN)


def _below_on_every_robot(method: str, ratio: pd.Series[float], *, is_judged: bool) -> Claim:
    kind, ids, *options = MRCLAM_METHODS[method]
    robots, worse = (list(map(str, part.index)) for part in (ratio, ratio[ratio >= 1.0]))
    failing = f"robot{'s' if len(worse) > 1 else ''} {', '.join(worse)}" if worse else ""
    remarks = [f"robots {', '.join(robots)}", failing and f"not on {failing}"]
    place = "judged robots" if is_judged else "robots tuned on"
    about = Subject("RL3", "ATE", method=kind, arm=ids, over="dead reckoning", place=place)
    return Claim(
        about,
        f"ATE of {method} over that of calibrated dead reckoning, MRCLAM 6, {place}: mean over "
        "the robots (in brackets the least and the greatest of a robot)",
        Interval(float(ratio.mean()), float(ratio.min()), float(ratio.max())),
        "below 1 on every robot",
        holds(not worse) if len(ratio) else Verdict.UNDECIDED,
        "; ".join(filter(None, remarks)),
        facts={"options": options, "robots": robots, "failing": failing},
    )


def rl4(wheels: pd.DataFrame, lego: pd.DataFrame) -> list[Claim]:
    """RL4: Khepera within 1 % of the published geometry; Lego below 0.10 m on its second half.

    The Lego robot is calibrated on the first half of its log; calibrated and scored on the whole
    stands beside.
    """
    geometry = wheels[wheels.published.notna()]
    off = float(np.abs(geometry.value / geometry.published - 1.0).max())
    rms_m = lego.set_index("case").rms_m
    before_m = float(rms_m["geometric width"])
    about = Subject("RL4", "wheels", place="Khepera")
    label = "largest deviation of Khepera diameters and axles from the published, share"
    found = [Claim(about, label, Interval.exact(off), "below 0.01", holds(off < 0.01))]
    for case, arm in ((HELD_OUT, "held out"), ("calibrated", "in sample")):
        after_m = float(rms_m[case])
        about = Subject("RL4", "dead reckoning", place="Lego", arm=arm)
        label = f"dead reckoning of the Lego robot, {case}, m RMS"
        verdict, facts = holds(after_m < 0.10), {"before_m": before_m}
        claim = Claim(about, label, Interval.exact(after_m), "below 0.10", verdict, facts=facts)
        found.append(beside(claim, arm == "in sample"))
    return found


def rl5(wean: pd.DataFrame) -> Claim:
    """RL5: the scans settle what the Wean Hall map's numbers mean."""
    best = wean.groupby("one_means").score.max()
    gap = float(best["free"] - best["occupied"])
    statistic = "fit of the scans with 1 = free, less that with 1 = occupied, Wean Hall"
    about, found = Subject("RL5", "fit"), Interval.exact(gap)
    return Claim(about, statistic, found, "above 0.1: 1 is free", holds(gap > 0.1))
