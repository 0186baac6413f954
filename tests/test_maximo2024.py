"""The studies and claims of maximo2024: verdicts follow the tables, parameters the tuning."""

import math

import numpy as np
import pandas as pd
import pytest

from experiments.papers.maximo2024 import claims, study
from experiments.papers.maximo2024.places import GEOMETRIES, place_world
from experiments.runs.seeds import stream


@pytest.fixture(scope="module")
def world():
    return place_world(GEOMETRIES["umh"], 5)


def weighting(m1, m2, m3, name="oxford", n=24, seed=0, column="error_m"):
    """Errors of n worlds and two repeats, each method about its value."""
    rng = np.random.default_rng(seed)
    rows = []
    for world in range(n):
        common = math.exp(0.2 * rng.standard_normal())
        for method, value in (("M1", m1), ("M2", m2), ("M3", m3)):
            for repeat in range(2):
                error = value * common * math.exp(0.02 * rng.standard_normal())
                rows.append((name, world, method, repeat, error))
    return pd.DataFrame(rows, columns=["geometry", "seed", "method", "repeat", column])


def quality(fails_from=5, name="oxford", n=24):
    rows = []
    for n_nearest in (1, 2, 5, 10):
        bad = 20.0 if n_nearest >= fails_from else 1.0
        table = weighting(1.5 if n_nearest == 10 else 1.0, 1.0, bad, name, n, n_nearest)
        rows.append(table.assign(noise_weight=0.8, n_nearest=n_nearest, dispersion_m=1.0))
    return pd.concat(rows)


def test_mx1_follows_the_errors():
    said = claims.mx1(weighting(11.5, 9.6, 205.0), quality())
    assert said[0].verdict == "reproduced; with shared parameters M3 fails from B = 5 on"
    assert said[1].verdict == "reproduced; with shared parameters at B = 10"
    said = claims.mx1(weighting(10.0, 10.2, 11.0), quality(fails_from=99))
    assert said[0].verdict == "not reproduced; with shared parameters M3 fails at no B tried"
    assert said[0].value == 0.0
    assert said[1].verdict.startswith("not reproduced")
    said = claims.mx1(weighting(10.0, 10.0, 11.0), quality(fails_from=99))
    assert said[1].low < 1.0 < said[1].high
    assert said[1].verdict.startswith("undecided")
    said = claims.mx1(weighting(0.5, 0.4, 0.44, "umh"), quality(name="umh"))
    assert said[0].verdict.startswith("reproduced")
    said = claims.mx1(weighting(0.5, 0.4, 0.6, "umh"), quality(name="umh"))
    assert said[0].verdict.startswith("not reproduced")


def test_mx2_wants_equal_errors_and_rising_times():
    rows = weighting(1.0, 1.0, 1.0).replace({"method": {"M1": 2, "M2": 4, "M3": 8}})
    table = rows.rename(columns={"method": "per_node"})
    times = pd.DataFrame(
        {
            "geometry": "oxford",
            "particles": [794, 1588],
            "time_s": [1e-4, 2e-4],
            "paper_s": [0.26, 0.36],
        }
    )
    said = claims.mx2(table, times)
    assert [c.verdict for c in said] == ["reproduced", "reproduced"]
    worse = table.assign(error_m=table["error_m"] * np.where(table["per_node"] == 2, 1.3, 1.0))
    flat = times.assign(time_s=[2e-4, 1e-4])
    said = claims.mx2(worse, flat)
    assert [c.verdict for c in said] == ["not reproduced", "not reproduced"]
    assert "with 2 particles" in said[0].statistic


def test_mx3_to_mx5_follow_their_tables():
    spread = weighting(5.0, 2.0, 1.0, column="dispersion_m").assign(step=10)
    assert claims.mx3(spread, quality())[0].verdict.startswith("reproduced")
    assert claims.mx3(spread.assign(step=9), quality()) == []
    starts = pd.DataFrame({"geometry": "umh", "settled_at": [3.0] * 200})
    assert claims.mx4(starts)[0].verdict == "reproduced"
    late = starts.assign(settled_at=[3.0] * 100 + [np.nan] * 60 + [41.0] * 40)
    assert claims.mx4(late)[0].verdict == "not reproduced"
    assert claims.mx4(late)[0].value == 0.5
    clusters = pd.DataFrame(
        {"geometry": "umh", "descriptor": "m2dp", "contiguous": [0.9, 0.92, 0.91]}
    )
    assert claims.mx5(clusters)[0].verdict == "reproduced"
    assert claims.mx5(clusters.assign(descriptor="scan_context")) == []


def test_our_own_claims_follow_their_tables():
    starts = pd.DataFrame(
        {"seed": [1, 1, 2, 2] * 60, "settled_at": 2.0, "spacing_m": 5.0, "rms_m": 0.1}
    )
    starts["rms_m"] += 0.01 * (starts["seed"] == 1)
    assert claims.mx6(starts)[0].verdict == "reproduced"
    assert claims.mx7(starts)[0].verdict == "reproduced"
    assert claims.mx7(starts.assign(rms_m=starts["rms_m"] * 20))[0].verdict == "not reproduced"
    trials = pd.DataFrame(
        {
            "geometry": "umh",
            "injection": [0.0, 0.05] * 100,
            "known_before": True,
            "settled_at": [np.nan, 4.0] * 100,
        }
    )
    assert [c.verdict for c in claims.mx8(trials)] == ["reproduced", "reproduced"]
    slow = trials.assign(settled_at=25.0)
    assert [c.verdict for c in claims.mx8(slow)] == ["reproduced", "not reproduced"]


def test_settling_has_to_last():
    errors = np.array([9.0, 0.0, 9.0, *([1.0] * 10), 9.0])
    assert study.settled_at(errors, 2.0) == 3.0
    assert math.isnan(study.settled_at(errors[:-2], 2.0))
    assert math.isnan(study.settled_at(errors, 0.5))


def test_parameters_are_the_best_of_the_tuning():
    table = pd.read_csv(study.ROOT / "results" / "tables" / "maximo2024_tuning.csv")
    for (name, method), chosen in study.TUNED.items():
        part = table[(table["geometry"] == name) & (table["method"] == method)]
        best = part.loc[part["error_m"].idxmin()]
        assert (best["sigma_l"], best["sigma_m"], best["n_nearest"]) == chosen


def test_a_walk_reports_error_and_dispersion(world):
    settings = study.options("umh", "M2", world.known_map.spacing_m)
    walk = study.localize(
        world.known_map, world.recording, settings, stream(5, "test"), keep=(3,), n_steps=30
    )
    assert len(walk.errors_m) == len(walk.means) == 30
    truth = world.recording.truth.poses[:30, :2]
    np.testing.assert_allclose(walk.errors_m, np.hypot(*(walk.means[:, :2] - truth).T))
    cloud = walk.particles[3]
    away = np.hypot(*(cloud[:, :2] - walk.means[3, :2]).T)
    assert walk.dispersions_m[3] == pytest.approx(away.mean())
    np.testing.assert_allclose(cloud[:, :2].mean(axis=0), walk.means[3, :2])  # eq. (4)
    assert walk.errors_m[10:].mean() < 1.0
    assert not walk.refined.any()


def test_rows_of_a_world(world):
    small = study.weighting_rows(world, "umh", 5, 1)
    assert len(small["weighting"]) == 4
    assert len(small["dispersion"]) == 4 * (study.WITHIN + 1)
    nearest = small["weighting"][0]["nearest_node_m"]
    assert nearest == pytest.approx(0.39, abs=0.02)
    starts = study.start_rows(world, "umh", 5, 3)
    assert [row["start"] for row in starts] == [0, 42, 85]
    assert all(row["settled_at"] <= 40 for row in starts)
    stolen = pd.DataFrame(study.kidnapping_rows(world, "umh", 5, 2))
    back = stolen.groupby("injection")["settled_at"].max()
    assert back[0.05] <= study.RECOVERED_WITHIN
    assert math.isnan(back[0.0])


def test_labels_of_clusters_are_stretches(world):
    row = study.cluster_row(world.known_map, world.recording, "umh", "synthetic", 5)
    assert row["contiguous"] > 0.8
    assert row["recall_at_1"] > 0.95
    labels = study.cluster_labels(world.known_map, 5)
    assert 30 <= len(np.unique(labels)) <= 40


def test_the_study_adds_up_to_the_papers_tables(world):
    rows = study.weighting_rows(world, "umh", 5, 2)["weighting"]
    table = study.table_1(pd.DataFrame(rows)).set_index("method")
    m2 = [row["error_m"] for row in rows if row["method"] == "M2"]
    assert table.loc["M2", "error_m"] == pytest.approx(np.mean(m2))
    assert table.loc["M3", "paper_m"] == 0.44
