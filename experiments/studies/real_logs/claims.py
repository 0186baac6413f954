"""Claims RL1 to RL5: what the real logs must show."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import Interval
from experiments.judging.by_words import (
    Claim,
    Conclusion,
    Role,
    Verdict,
    banded,
    beside,
    conclude,
    holds,
    percent,
    pick,
    plain,
    remarked,
    shown,
)
from experiments.judging.results import Results
from experiments.studies.real_logs.settings import FUSION, INTEL, LOGGED, MRCLAM_CHOSEN


def judge(made: Results) -> list[Claim]:
    """Judge RL1 to RL5 by the tables."""
    return [
        *rl1(made.table("ate")),
        *rl2(made.table("relations")),
        *rl3(made.table("mrclam")),
        *rl4(made.table("wheels"), made.table("lego")),
        *rl5(made.table("wean")),
    ]


def conclusions(_made: Results, claims: Sequence[Claim]) -> list[Conclusion]:
    """Verdict and sentence of RL1-RL5."""
    sentences: dict[str, Callable[[Sequence[Claim]], str]] = {
        "RL1": rl1_sentence,
        "RL2": rl2_sentence,
        "RL3": rl3_sentence,
        "RL4": rl4_sentence,
        "RL5": rl5_sentence,
    }
    return conclude(claims, sentences, "minutes of log")


def rl1(ate: pd.DataFrame) -> list[Claim]:
    """RL1: ATE of stored trajectories equals the printed values to the last digit."""
    same = ate.ate_m.map("{:.3f}".format) == ate.printed_m.astype(float).map("{:.3f}".format)
    statistic = "share of trajectories of Rawseeds 25a, 25b whose ATE has the printed digits"
    found = Interval.exact(float(same.mean()))
    return [Claim("RL1", statistic, found, "1", holds(bool(same.all())), f"of {len(same)}")]


def rl1_sentence(rows: Sequence[Claim]) -> str:
    """Say how many errors come out to the printed digit."""
    (row,) = rows
    return f"{percent(row.found.value)} {row.reason} errors have every printed digit."


def rl2(relations: pd.DataFrame) -> Iterator[Claim]:
    """RL2: on the Intel log, fusion beats odometry and ICP in the relations metric.

    Judged after the part that the filter's noise was tuned on, over the same relations. Odometry as
    logged and the whole log stand beside.
    """
    intel = relations[relations.log == "intel"]
    for part, where in (("judged", "after the tuned part"), ("all", "the whole log")):
        rows = intel[intel.part == part].set_index("method")
        for other in (name for name in INTEL[1:] if name != FUSION):
            claim = _difference(rows.loc[FUSION], rows.loc[other], f"{other}, Intel, {where}")
            if part == "all":
                reason = f"the tuned part is in it; {claim.reason}"
                yield shown("RL2", claim.statistic, claim.found, reason)
            else:
                yield beside(claim, other == LOGGED)


def _difference(fused: pd.Series[float], rival: pd.Series[float], where: str) -> Claim:
    """Judge the paired difference of the errors over the same relations."""
    found = Interval(*(float(rival[f"difference_{end}_m"]) for end in ("mean", "low", "high")))
    label = f"translational error of {FUSION} less that of the other, m: {where}"
    minutes = int(rival["difference_minutes"])
    claim = banded("RL2", label, found, at_most=0.0, criterion="below 0", n=minutes)
    return remarked(claim, _means(fused, rival))


def _means(fused: pd.Series[float], rival: pd.Series[float]) -> str:
    ours, other = float(fused.translation_mean_m), float(rival.translation_mean_m)
    return f"fusion {ours:.3f} m, the other {other:.3f} m"


def rl2_sentence(rows: Sequence[Claim]) -> str:
    """Say what fusion gains over each of the others."""
    judged_rows = [row for row in rows if row.role is Role.HEADLINE]
    parts = []
    for row in judged_rows:
        other = row.statistic.split(", Intel")[0].split("m: ")[-1].split("beside ")[-1]
        parts.append(f"{row.reason.split('the other ')[-1]} by {other}")
    fused = judged_rows[0].reason.split(",")[0].removeprefix("fusion ")
    parts = [f"{fused} by fusion", *parts]
    said = f"Mean translational error after the tuned part: {'; '.join(parts)}."
    if any(row.verdict is Verdict.UNDECIDED for row in judged_rows):
        said += " The log is too short to tell the nearest of them from fusion."
    return said


def rl3(mrclam: pd.DataFrame) -> Iterator[Claim]:
    """RL3: SLAM with landmarks beats calibrated dead reckoning on every judged robot.

    Robots on which the options were chosen are not among them. The chosen options are the headline.
    """
    kept = mrclam[mrclam.judged.astype(bool)]
    plain_m = kept[kept.method == "dead reckoning, calibrated"].set_index("robot").ate_rmse_m
    for method, rows in kept[~kept.method.str.contains("reckoning")].groupby("method"):
        ratio = (rows.groupby("robot").ate_rmse_m.mean() / plain_m).dropna()
        worse = [str(robot) for robot in ratio.index[ratio >= 1.0]]
        several = "s" if len(worse) > 1 else ""
        claim = Claim(
            "RL3",
            f"ATE of {method} over that of calibrated dead reckoning, MRCLAM 6: mean over the "
            "robots (in brackets the least and the greatest of a robot)",
            Interval(float(ratio.mean()), float(ratio.min()), float(ratio.max())),
            "below 1 on every robot",
            holds(not worse) if len(ratio) else Verdict.UNDECIDED,
            f"not on robot{several} {', '.join(worse)}" if worse else "",
        )
        claim = remarked(claim, f"robots {', '.join(map(str, ratio.index))}")
        yield beside(claim, not str(method).endswith(MRCLAM_CHOSEN))


def rl3_sentence(rows: Sequence[Claim]) -> str:
    """Say on which robots SLAM does not beat dead reckoning."""
    parts = []
    for row in (row for row in rows if row.role is Role.HEADLINE):
        method = row.statistic.removeprefix("ATE of ").split(" over that of")[0]
        name, ids, *options = method.split(", ")
        least, most = plain(row.found.low), plain(row.found.high)
        robots, *failing = row.reason.split("; ")
        but = f" (not below on {failing[0].removeprefix('not on ')})" if failing else ""
        how = "".join(f" ({option})" for option in options)
        parts.append(f"{name} with {ids} ids{how} {least} to {most}{but}")
    return (
        f"Error over that of calibrated dead reckoning, least and greatest of {robots}: "
        f"{'; '.join(parts)}."
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
            "dead reckoning of the Lego robot after calibration, m RMS",
            Interval.exact(after),
            "below 0.10",
            holds(after < 0.10),
            f"{rms['geometric width']:.3f} m before",
        ),
    ]


def rl4_sentence(rows: Sequence[Claim]) -> str:
    """Say how near the wheels are to the published ones."""
    khepera, lego = pick(rows, "Khepera"), pick(rows, "Lego")
    return (
        f"The Khepera's wheels come out within {plain(100.0 * khepera.found.value)} % of the "
        f"published ones; the Lego robot's dead reckoning has {lego.found.value:.3f} m RMS after "
        f"calibration ({lego.reason})."
    )


def rl5(wean: pd.DataFrame) -> list[Claim]:
    """RL5: the scans settle what the Wean Hall map's numbers mean."""
    best = wean.groupby("one_means").score.max()
    gap = float(best["free"] - best["occupied"])
    statistic = "fit of the scans with 1 = free, less that with 1 = occupied, Wean Hall"
    return [Claim("RL5", statistic, Interval.exact(gap), "above 0.1: 1 is free", holds(gap > 0.1))]


def rl5_sentence(rows: Sequence[Claim]) -> str:
    """Say which meaning of the map's numbers fits the scans."""
    (row,) = rows
    better = "free" if row.found.value > 0.0 else "occupied"
    return (
        f"The scans fit better with 1 = {better}: the share of beams that end in occupied cells, "
        f"less that of midpoints there, is higher by {plain(abs(row.found.value))}."
    )
