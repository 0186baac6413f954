"""Claims RL1 to RL5: tables that pass and fail them, and their sentences."""

import numpy as np
import pandas as pd
import pytest

from experiments.judging.folders import findings
from experiments.judging.sentences import conclude
from experiments.studies.real_logs.claims import rl1, rl2, rl3, rl4, rl5
from experiments.studies.real_logs.settings import FUSION, HELD_OUT, INTEL, MRCLAM, MRCLAM_BASE


def said(found):
    """The sentence on claims."""
    [conclusion] = conclude(found, findings("real_logs"))
    return conclusion.sentence


def relations(low, high, fused_m=1.0, all_fused_m=1.0):
    """Errors of fusion and its rivals, whose paired difference has this interval."""
    rows = [
        ("intel", name, part, ours_m if name == FUSION else 1.0, (low + high) / 2.0, low, high, 10)
        for part, ours_m in (("judged", fused_m), ("all", all_fused_m))
        for name in (FUSION, *INTEL[1:5])
    ]
    differences = [f"difference_{name}_m" for name in ("mean", "low", "high")]
    columns = ["log", "method", "part", "translation_mean_m", *differences, "difference_minutes"]
    return pd.DataFrame(rows, columns=columns)


def test_rl2_judges_after_the_tuned_part_and_shows_the_whole():
    found = list(rl2(relations(-1.0, -0.8, fused_m=0.1, all_fused_m=9.0)))
    assert [c.verdict for c in found] == ["reproduced"] * 4 + ["shown"] * 4
    assert found[0].reason == "fusion 0.100 m, the other 1.000 m"
    assert [c.role for c in found[:4]] == ["beside", "headline", "headline", "headline"]
    assert {c.about.place for c in found[4:]} == {"the whole log"}
    assert (
        "0.100 m by fusion; 1.000 m by odometry, calibrated (difference -0.9 [-1, -0.8] m);"
        in said(found)
    )


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(-0.2, -0.1, "reproduced"), (0.1, 0.2, "not_reproduced"), (-0.2, 0.1, "undecided")],
)
def test_rl2_judges_the_paired_difference(low, high, verdict):
    found = list(rl2(relations(low, high)))
    assert {c.verdict for c in found[:4]} == {verdict}
    assert found[0].statistic.startswith("translational error of EKF of wheels and ICP less")
    assert ("The log is too short" in said(found)) == (verdict == "undecided")
    assert ("an effect of 0.1, if there is one, would be decided" in said(found)) == (
        verdict == "undecided"
    )


def test_rl2_counts_arms_within_a_tenth_as_alike():
    found = list(rl2(relations(-0.05, 0.04)))
    assert {c.verdict for c in found[:4]} == {"not_reproduced"}
    assert found[1].reason.endswith("alike within 10 %")
    assert "Fusion and ICP alone are alike" in said(found)
    assert {c.verdict for c in list(rl2(relations(-0.11, 0.04)))[:4]} == {"undecided"}


def test_rl1_rl4_and_rl5_can_fail():
    ate = pd.DataFrame({"ate_m": [0.1491, 0.2272], "printed_m": ["0.149", "0.227"]})
    assert rl1(ate).verdict == "reproduced"
    assert said([rl1(ate)]).startswith("All digits agree in 100 % of 2 printed errors.")
    assert rl1(ate.assign(ate_m=[0.1496, 0.2272])).verdict == "not_reproduced"
    wheels = pd.DataFrame({"value": [0.0415, 0.0880], "published": [0.0414, 0.0880]})
    cases = ["geometric width", "calibrated", HELD_OUT]
    lego = pd.DataFrame({"case": cases, "rms_m": [0.6, 0.04, 0.05]})
    assert {c.verdict for c in rl4(wheels, lego)} == {"reproduced"}
    assert "has 0.050 m RMS on the second; calibrated and scored on the whole it has 0.040 m" in (
        said(rl4(wheels, lego))
    )
    far, late = wheels.assign(value=[0.0420, 0.0880]), lego.assign(rms_m=[0.6, 0.04, 0.17])
    assert [c.verdict for c in rl4(far, late)] == ["not_reproduced", "not_reproduced", "reproduced"]
    assert [c.role for c in rl4(far, late)] == ["headline", "headline", "beside"]
    wean = pd.DataFrame({"one_means": ["free", "occupied"], "score": [0.5, 0.2]})
    assert rl5(wean).verdict == "reproduced"
    assert "with 1 = free: " in said([rl5(wean)])
    assert rl5(wean.assign(score=[0.5, 0.45])).verdict == "not_reproduced"


def test_rl3_wants_every_robot():
    good, bad, last = MRCLAM[4], MRCLAM[5], MRCLAM[8]
    rows = [(r, MRCLAM_BASE, 1.0) for r in (1, 2, 3)]
    rows += [(r, good, 0.5) for r in (1, 2, 3)]
    rows += [(1, bad, 1.5), (2, bad, 0.1), (3, bad, 1.1), (3, last, 1.1), (2, last, 0.1)]
    table = pd.DataFrame(rows, columns=["robot", "method", "ate_rmse_m"]).assign(judged=True)
    found = list(rl3(table))
    assert {(c.about.method, c.about.arm): (c.verdict, c.reason) for c in found} == {
        ("FastSLAM", "unknown"): ("reproduced", "robots 1, 2, 3"),
        ("FastSLAM", "known"): ("not_reproduced", "robots 1, 2, 3; not on robots 1, 3"),
        ("EKF-SLAM", "unknown"): ("not_reproduced", "robots 2, 3; not on robot 3"),
    }
    assert "landmarks: FastSLAM (slip in bursts) 0.1 to 1.5 (not below 1 on robots 1, 3). " in (
        said(found)
    )
    table["judged"] = table["robot"] < 3  # robots on which the noise was chosen stand beside
    found = [c for c in rl3(table) if c.role == "headline"]
    verdicts = {(c.about.method, c.about.arm): c.verdict for c in found}
    assert set(np.array(list(verdicts.values()))[:2]) == {"reproduced", "not_reproduced"}
    assert verdicts["EKF-SLAM", "unknown"] == "reproduced"
    tuned = "On robots 3, on which the options were chosen, with unknown ids:"
    assert tuned in said(list(rl3(table)))
