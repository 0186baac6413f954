"""Claims: what they read decides the verdict, and a fault in it changes the verdict."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from experiments import claims as common
from experiments.claims import puzzlebot2024 as claims
from experiments.studies import puzzlebot2024 as study


def test_worked_matrices_come_out_and_the_misprint_does_not():
    assert claims.pb1()[0].verdict == "reproduced"
    _, second = claims.worked_matrices()
    assert second[0, 0] == pytest.approx(0.9998, abs=5e-5)
    assert abs(second[0, 0] - 0.998) > 1e-3


def test_pb1_fails_on_a_wrong_sign(monkeypatch):
    first, second = claims.worked_matrices()
    monkeypatch.setattr(claims, "worked_matrices", lambda: (first, second * [1, -1, 1]))
    assert claims.pb1()[0].verdict == "not reproduced"


def test_areas_grow_on_straights_and_arcs_and_shrink_on_the_way_back():
    areas, crossover = study.areas(), study.crossover(3)
    judged = claims.pb2(areas, crossover, study.NOMINAL.track_m)
    by_name = {c.statistic.rsplit(", ", 1)[-1]: c for c in judged}
    assert by_name["straight"].verdict == by_name["arc"].verdict == "reproduced"
    assert by_name["out and back"].value > 0
    assert judged[-1].verdict == "reproduced"
    wrong = claims.pb2(areas, crossover, 1.1 * study.NOMINAL.track_m)
    assert wrong[-1].verdict == "not reproduced"
    shrinking = areas.assign(area_m2=areas["area_m2"].to_numpy()[::-1])
    assert claims.pb2(shrinking, crossover, 0.19)[0].verdict == "not reproduced"


def calibrated(n, offset=0.0, half=0.1):
    rng = np.random.default_rng(0)
    value = 1 + offset + 0.05 * rng.standard_normal(2 * n)
    return pd.DataFrame(
        {
            "k_m": 1e-4,
            "joint": False,
            "seed": np.repeat(np.arange(n), 2),
            "method": "sampled",
            "parameter": ["kr", "kl"] * n,
            "truth": 1.0,
            "value": value,
            "low": value - half,
            "high": value + half,
        }
    )


ENGINE_K = pd.DataFrame(
    [{"k_m": 1e-4, "parameter": "kr", "truth": 1e-4, "value": 1e-4, "low": 9.8e-5, "high": 1.02e-4}]
)


def pb3(table):
    return {c.statistic.split(":")[0]: c for c in claims.pb3(table, DESCENT, ENGINE_K)}


DESCENT = study.gradient_descent()
COVERAGE = "coverage of the 95 % intervals of kr and kl"
BIAS = "relative bias, the worse of kr and kl"


def test_pb3_judges_coverage_and_bias():
    good = pb3(calibrated(200))
    assert good[COVERAGE].verdict == good[BIAS].verdict == "reproduced"
    biased = pb3(calibrated(200, offset=0.2))
    assert biased[COVERAGE].verdict == biased[BIAS].verdict == "not reproduced"
    assert pb3(calibrated(200, half=0.02))[COVERAGE].verdict == "not reproduced"
    assert "1/2" in good["the report's gradient descent"].verdict


def test_opposite_biases_of_the_wheels_do_not_cancel():
    table = calibrated(200)
    table["value"] += np.where(table["parameter"] == "kr", 0.1, -0.1)
    judged = pb3(table)[BIAS]
    assert judged.verdict == "not reproduced"
    assert abs(judged.value) == pytest.approx(0.1, abs=0.02)


def test_pb3_judges_the_gains_and_the_track_of_the_joint_arm_apart():
    table = calibrated(200).assign(joint=True)
    geometry = table.assign(parameter="track_m", low=2.0, high=3.0)
    judged = pb3(pd.concat([table, geometry], ignore_index=True))
    assert judged[COVERAGE].verdict == "reproduced"
    assert judged["coverage of the 95 % intervals of gains and track"].verdict == "not reproduced"


def test_pb4_names_the_k_at_which_the_band_is_left():
    runs = 4000
    shares = {1e-5: 0.95, 1e-4: 0.95, 1e-3: 0.80}
    coverage = pd.DataFrame(
        [
            {"case": case, "k_m": k, "runs": runs, "in_ellipse": int(share * runs)}
            for k, share in shares.items()
            for case in ("linear_1", "angular_1")
        ]
    )
    engine = ends(0.0)
    judged = claims.pb4(coverage, engine)
    assert [c.verdict.split(" (")[0] for c in judged[:3]] == [
        "reproduced",
        "reproduced",
        "not reproduced",
    ]
    assert judged[-1].value == judged[-1].high == 1e-3
    assert judged[-1].low == 1e-4
    assert judged[-1].verdict == "reproduced"


def ends(gap_m):
    """Ends of two cases, the second a hundred times as spread out and a metre further on."""
    spread = np.tile([-1.0, 0.0, 1.0], 2) * np.repeat([1e-3, 0.1], 3)
    table = {"case": np.repeat(["angular_1", "linear_1"], 3), "seed": np.tile([1, 2, 3], 2)}
    for name in ("x_m", "y_m", "heading_rad"):
        table[f"kinematic_{name}"] = spread + np.repeat([0.0, 1.0], 3)
        table[f"bullet_{name}"] = table[f"kinematic_{name}"] + np.repeat([gap_m, 0.0], 3)
    return pd.DataFrame(table)


def test_the_engines_gap_is_held_against_the_spread_of_its_own_case():
    coverage = pd.DataFrame([{"case": "a", "k_m": 1e-4, "runs": 4000, "in_ellipse": 3800}])
    assert claims.pb4(coverage, ends(1e-6))[1].verdict == "reproduced"
    assert claims.pb4(coverage, ends(2e-4))[1].verdict == "not reproduced"


def test_coverage_is_95_percent_where_the_first_order_holds():
    table = study.coverage(300)
    small = table[table["k_m"] == 1e-6]
    assert small["in_ellipse"].sum() / small["runs"].sum() == pytest.approx(0.95, abs=0.015)
    assert small["in_ellipsoid"].sum() / small["runs"].sum() == pytest.approx(0.95, abs=0.015)


@pytest.mark.bullet
def test_the_engine_and_the_kinematic_robot_end_together():
    driven = study.engine_recordings(2)
    engine = study.engine_ends(driven)
    gap = np.hypot(*(engine[f"bullet_{c}_m"] - engine[f"kinematic_{c}_m"] for c in "xy"))
    assert gap.max() < 3e-4
    assert np.ptp(engine["kinematic_heading_rad"]) > 1.0
    k = study.engine_k(driven)
    assert (k["value"] / k["truth"]).to_numpy() == pytest.approx(1.0, abs=0.2)


def test_writing_keeps_other_papers_rows(tmp_path):
    path = tmp_path / "claims.csv"
    one = claims.pb1()[0]
    other = dataclasses.replace(one, id="XX1", paper="another")
    common.write([other], path)
    common.write([one], path)
    common.write([dataclasses.replace(one, value=0.5)], path)
    frame = pd.read_csv(path)
    assert frame["paper"].tolist() == ["puzzlebot2024", "another"]
    assert frame["value"].tolist()[0] == 0.5
    assert tuple(frame.columns) == common.COLUMNS
