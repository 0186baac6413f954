"""DC1-DC6: what the tables hold decides the verdict."""

import numpy as np
import pandas as pd
import pytest

from experiments.papers.decristoforis2020 import claims

SEEDS = np.arange(1000, 1020)


def runs(**medians):
    """Lognormal errors of each method about its median."""
    rng = np.random.default_rng(0)
    rows = []
    for method, median in medians.items():
        for seed in SEEDS:
            value = median * np.exp(0.2 * rng.standard_normal())
            rows.append(
                {
                    "seed": seed, "rate_hz": 10.0, "rays": "exact", "method": method,
                    "ate_rmse_m": value, "heading_rmse_rad": value / 10,
                    "map_distance_m": value / 2, "map_entropy": np.log(value),
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


RIGHT = {
    "odometry": 3.0, "icp": 1.0, "fusion": 0.3, "icp_keyframe": 0.2, "fusion_clone": 0.1,
}  # fmt: skip


def ordering(good):
    rows = []
    for k in (1e-6, 1e-4):
        order = RIGHT if k in good else RIGHT | {"fusion": 2.0}
        rows.append(runs(**order).assign(k_m=k, sigma_range_m=0.01))
    return pd.concat(rows)


def verdicts(found):
    return {c.statistic: c.verdict for c in found}


def test_dc1_follows_the_order():
    found = verdicts(claims.dc1(runs(**RIGHT), ordering({1e-6, 1e-4})))
    (region,) = (s for s in found if s.startswith("share"))
    assert found.pop(region) == "shown"
    assert set(found.values()) == {"reproduced"}
    swapped = RIGHT | {"fusion": 1.0, "icp": 0.3}
    found = verdicts(claims.dc1(runs(**swapped), ordering({1e-6})))
    assert found["position RMSE, fusion over icp"] == "not_reproduced"
    assert found["heading RMSE, icp over odometry"] == "reproduced"
    (region,) = (s for s in found if s.startswith("share"))
    assert "k 1e-06" in region
    assert "k 0.0001" not in region
    equal = verdicts(claims.dc1(runs(**RIGHT | {"fusion": 1.0}), ordering(set())))
    assert equal["position RMSE, fusion over icp"] == "undecided"


def test_dc1_reads_exact_rays_at_10_hz_alone():
    wrong = runs(**RIGHT | {"fusion": 50.0}).assign(rays="bullet")
    found = verdicts(claims.dc1(pd.concat([runs(**RIGHT), wrong]), ordering({1e-6})))
    assert found["position RMSE, fusion over icp"] == "reproduced"


def ellipses(**changed):
    rng = np.random.default_rng(1)
    values = {
        "axis_ratio_bare": 8.0, "tilt_bare_deg": 1.0, "long_bare_m": 3e-3, "long_objects_m": 1e-3,
    }  # fmt: skip
    for bend in ("curve", "corner"):
        values |= {
            f"long_before_{bend}_m": 1e-3, f"long_in_{bend}_m": 2e-3,
            f"long_median_in_{bend}_m": 2e-3, f"long_after_{bend}_m": 1e-3,
            f"turned_in_{bend}_deg": 40.0,
        }  # fmt: skip
    values |= changed
    return pd.DataFrame({k: v * np.exp(0.05 * rng.standard_normal(20)) for k, v in values.items()})


def test_dc2_and_dc3_by_their_bands():
    assert set(verdicts(claims.dc2(ellipses())).values()) == {"reproduced"}
    assert set(verdicts(claims.dc3(ellipses())).values()) == {"reproduced"}
    found = verdicts(claims.dc2(ellipses(long_objects_m=2e-3, tilt_bare_deg=20.0)))
    assert found["long axis near objects over bare"] == "not_reproduced"
    assert found["angle of the long axis to the corridor, deg"] == "not_reproduced"
    found = verdicts(claims.dc3(ellipses(long_after_curve_m=1.3e-3, long_in_corner_m=1.2e-3)))
    assert found["long axis after the curve over before"] == "not_reproduced"
    assert found["largest long axis in the corner over before"] == "not_reproduced"
    assert found["largest long axis in the curve over before"] == "reproduced"


def covariances(**nees):
    rng = np.random.default_rng(2)
    times = {"censi": 40.0, "hessian": 20.0, "sampling": 2e4}
    rows = [
        {
            "metric": metric, "place": place, "method": method, "seed": seed,
            "nees_over_dof": level * np.exp(0.05 * rng.standard_normal()),
            "time_us": times[method],
        }
        for metric in ("point_to_line", "point_to_point")
        for place in ("corridor", "corner", "curve", "room")
        for method, level in nees.items()
        for seed in SEEDS
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_dc4_wants_the_hessian_outside_and_the_others_inside():
    found = verdicts(claims.dc4(covariances(hessian=2.0, sampling=1.0, censi=1.0)))
    assert set(found.values()) == {"reproduced"}
    assert len(found) == 28
    found = verdicts(claims.dc4(covariances(hessian=1.0, sampling=1.0, censi=3.0)))
    names = {s.split(",")[0]: v for s, v in found.items() if "point_to_line" in s}
    assert names["NEES over dof of hessian"] == "not_reproduced"
    assert names["NEES over dof of censi"] == "not_reproduced"
    assert names["NEES over dof of sampling"] == "reproduced"
    slow = covariances(hessian=2.0, sampling=1.0, censi=1.0)
    slow.loc[slow["method"] == "censi", "time_us"] = 1e4
    found = verdicts(claims.dc4(slow))
    assert found["time of sampling over Censi's closed form, point_to_line"] == "not_reproduced"


def test_dc5_wants_both_lower():
    rng = np.random.default_rng(3)
    rows = [
        {
            "seed": seed, "class": "room_small", "metric": metric,
            "error_m": level * np.exp(0.3 * rng.standard_normal()), "error_rad": level / 10,
            "time_us": 1.0 / level,
        }
        for seed in SEEDS
        for metric, level in (("point_to_line", 1e-3), ("point_to_point", 3e-3))
    ]  # fmt: skip
    found = verdicts(claims.dc5(pd.DataFrame(rows)))
    assert found["position error, point to line over point to point, room_small"] == "reproduced"
    assert found["time, point to line over point to point, room_small"] == "not_reproduced"


def test_dc6_follows_the_maps():
    assert set(verdicts(claims.dc6(runs(**RIGHT))).values()) == {"reproduced"}
    found = verdicts(claims.dc6(runs(**RIGHT | {"odometry": 0.5})))
    what = "distance of map points to walls, icp over odometry"
    assert found[what] == "not_reproduced"


def test_every_claim_names_its_criterion():
    for claim in claims.dc1(runs(**RIGHT), ordering({1e-6})):
        assert claim.criterion
        assert claim.found.low <= claim.found.value <= claim.found.high
    assert claims.dc2(ellipses())[0].found.value == pytest.approx(8.0, rel=0.1)
