"""Claims RL1 to RL5: what the real logs must show."""

from __future__ import annotations

import numpy as np
import pandas as pd

from experiments.report.claims import Claim

PAPER = "real_logs"


def _claim(number: int, statistic: str, value: float, criterion: str, verdict: str) -> Claim:
    return Claim(f"RL{number}", PAPER, statistic, value, value, value, criterion, verdict)


def _said(holds: bool) -> str:
    return "reproduced" if holds else "not reproduced"


def rl1(ate: pd.DataFrame) -> list[Claim]:
    """RL1: ATE of stored trajectories equals the printed figures to the last digit."""
    same = np.array([f"{a:.3f}" == str(p) for a, p in zip(ate.ate_m, ate.printed_m, strict=True)])
    return [
        _claim(
            1,
            f"share of {len(same)} trajectories of Rawseeds 25a, 25b whose ATE has the "
            "printed digits",
            float(same.mean()),
            "1",
            _said(bool(same.all())),
        )
    ]


def rl2(relations: pd.DataFrame) -> list[Claim]:
    """RL2: on the Intel log, fusion beats odometry and ICP in the relations metric.

    Judged after the part that the filter's noise was tuned on; the whole log is shown beside.
    """
    intel = relations[relations.log == "intel"]
    found = []
    rivals = ("odometry, as logged", "odometry, calibrated", "ICP alone", "ICP from the wheels")
    name = "EKF of wheels and ICP"
    for part, where in (("judged", "after the tuned part"), ("all", "the whole log")):
        rows = intel[intel.part == part].set_index("method")
        for other in rivals:
            fused, rival = rows.loc[name], rows.loc[other]
            ahead = fused.translation_mean_m < rival.translation_mean_m
            place = f"fusion is {'ahead' if ahead else 'behind'}"
            if part == "all":
                criterion, verdict = "shown, not judged: the tuned part is in it", f"shown; {place}"
            else:
                criterion, verdict = "intervals apart, fusion below", f"undecided; {place}"
                if fused.translation_high_m < rival.translation_low_m:
                    verdict = "reproduced"
                elif fused.translation_low_m > rival.translation_high_m:
                    verdict = "not reproduced"
            found.append(
                Claim(
                    "RL2",
                    PAPER,
                    f"mean translational error of {name}, m, beside {other} "
                    f"({rival.translation_mean_m:.3f} m), Intel, {where}",
                    float(fused.translation_mean_m),
                    float(fused.translation_low_m),
                    float(fused.translation_high_m),
                    criterion,
                    verdict,
                )
            )
    return found


def rl3(mrclam: pd.DataFrame) -> list[Claim]:
    """RL3: SLAM with known association beats calibrated dead reckoning on every robot."""
    found = []
    plain = mrclam[mrclam.method == "dead reckoning, calibrated"].set_index("robot").ate_rmse_m
    for method, rows in mrclam.groupby("method"):
        if "reckoning" in str(method):
            continue
        ratio = (rows.groupby("robot").ate_rmse_m.mean() / plain).dropna()
        worse = [str(robot) for robot in ratio.index[ratio >= 1.0]]
        several = "s" if len(worse) > 1 else ""
        verdict = f"not reproduced; not on robot{several} {', '.join(worse)}"
        found.append(
            Claim(
                "RL3",
                PAPER,
                f"ATE of {method} over that of calibrated dead reckoning, MRCLAM 6: mean over the "
                "robots (in brackets the least and the greatest of a robot)",
                float(ratio.mean()),
                float(ratio.min()),
                float(ratio.max()),
                "below 1 on every robot",
                verdict if worse else "reproduced",
            )
        )
    return found


def rl4(wheels: pd.DataFrame, lego: pd.DataFrame) -> list[Claim]:
    """RL4: Khepera within 1 % of the published geometry; Lego below 0.10 m after calibration."""
    geometry = wheels[wheels.published.notna()]
    off = float(np.abs(geometry.value / geometry.published - 1.0).max())
    rms = lego.set_index("case").rms_m
    return [
        _claim(
            4,
            "largest deviation of Khepera diameters and axles from the published, share",
            off,
            "below 0.01",
            _said(off < 0.01),
        ),
        _claim(
            4,
            "dead reckoning of the Lego robot after calibration, m RMS "
            f"({rms['geometric width']:.3f} before)",
            float(rms["calibrated"]),
            "below 0.10",
            _said(float(rms["calibrated"]) < 0.10),
        ),
    ]


def rl5(wean: pd.DataFrame) -> list[Claim]:
    """RL5: the scans settle what the Wean Hall map's numbers mean."""
    best = wean.groupby("one_means").score.max()
    gap = float(best["free"] - best["occupied"])
    return [
        _claim(
            5,
            "fit of the scans with 1 = free, less that with 1 = occupied, Wean Hall",
            gap,
            "above 0.1: 1 is free",
            _said(gap > 0.1),
        )
    ]
