"""Claims RL1 to RL5: what the real logs must show."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import Interval
from experiments.evaluation.verdict import Claim, Verdict, holds
from experiments.papers.real_logs.settings import FUSION, INTEL
from experiments.papers.results import Results


def judge(made: Results) -> list[Claim]:
    """Judge RL1 to RL5 by the tables."""
    return [
        *rl1(made.table("ate")),
        *rl2(made.table("relations")),
        *rl3(made.table("mrclam")),
        *rl4(made.table("wheels"), made.table("lego")),
        *rl5(made.table("wean")),
    ]


def rl1(ate: pd.DataFrame) -> list[Claim]:
    """RL1: ATE of stored trajectories equals the printed values to the last digit."""
    same = ate.ate_m.map("{:.3f}".format) == ate.printed_m.astype(float).map("{:.3f}".format)
    statistic = (
        f"share of {len(same)} trajectories of Rawseeds 25a, 25b whose ATE has the printed digits"
    )
    found = Interval.exact(float(same.mean()))
    return [Claim("RL1", statistic, found, "1", holds(bool(same.all())))]


def rl2(relations: pd.DataFrame) -> Iterator[Claim]:
    """RL2: on the Intel log, fusion beats odometry and ICP in the relations metric.

    Judged after the part that the filter's noise was tuned on; the whole log is shown beside.
    """
    intel = relations[relations.log == "intel"]
    for part, where in (("judged", "after the tuned part"), ("all", "the whole log")):
        rows = intel[intel.part == part].set_index("method")
        fused = rows.loc[FUSION]
        found = Interval(*(float(fused[f"translation_{end}_m"]) for end in ("mean", "low", "high")))
        for other in (name for name in INTEL[1:] if name != FUSION):
            rival = rows.loc[other]
            statistic = (
                f"mean translational error of {FUSION}, m, beside {other} "
                f"({rival.translation_mean_m:.3f} m), Intel, {where}"
            )
            ahead = f"fusion is {'ahead' if found.value < rival.translation_mean_m else 'behind'}"
            judgement = ("intervals apart, fusion below", Verdict.UNDECIDED, ahead)
            if part == "all":
                judgement = ("shown, not judged: the tuned part is in it", Verdict.SHOWN, ahead)
            elif found.high < rival.translation_low_m or found.low > rival.translation_high_m:
                judgement = (judgement[0], holds(found.high < rival.translation_low_m), "")
            yield Claim("RL2", statistic, found, *judgement)


def rl3(mrclam: pd.DataFrame) -> Iterator[Claim]:
    """RL3: SLAM with known association beats calibrated dead reckoning on every robot."""
    plain = mrclam[mrclam.method == "dead reckoning, calibrated"].set_index("robot").ate_rmse_m
    for method, rows in mrclam[~mrclam.method.str.contains("reckoning")].groupby("method"):
        ratio = (rows.groupby("robot").ate_rmse_m.mean() / plain).dropna()
        worse = [str(robot) for robot in ratio.index[ratio >= 1.0]]
        several = "s" if len(worse) > 1 else ""
        yield Claim(
            "RL3",
            f"ATE of {method} over that of calibrated dead reckoning, MRCLAM 6: mean over the "
            "robots (in brackets the least and the greatest of a robot)",
            Interval(float(ratio.mean()), float(ratio.min()), float(ratio.max())),
            "below 1 on every robot",
            holds(not worse),
            f"not on robot{several} {', '.join(worse)}" if worse else "",
        )


def rl4(wheels: pd.DataFrame, lego: pd.DataFrame) -> list[Claim]:
    """RL4: Khepera within 1 % of the published geometry; Lego below 0.10 m after calibration."""
    geometry = wheels[wheels.published.notna()]
    off = float(np.abs(geometry.value / geometry.published - 1.0).max())
    rms = lego.set_index("case").rms_m
    after = float(rms["calibrated"])
    return [
        Claim(
            "RL4",
            "largest deviation of Khepera diameters and axles from the published, share",
            Interval.exact(off),
            "below 0.01",
            holds(off < 0.01),
        ),
        Claim(
            "RL4",
            "dead reckoning of the Lego robot after calibration, m RMS "
            f"({rms['geometric width']:.3f} before)",
            Interval.exact(after),
            "below 0.10",
            holds(after < 0.10),
        ),
    ]


def rl5(wean: pd.DataFrame) -> list[Claim]:
    """RL5: the scans settle what the Wean Hall map's numbers mean."""
    best = wean.groupby("one_means").score.max()
    gap = float(best["free"] - best["occupied"])
    statistic = "fit of the scans with 1 = free, less that with 1 = occupied, Wean Hall"
    return [Claim("RL5", statistic, Interval.exact(gap), "above 0.1: 1 is free", holds(gap > 0.1))]
