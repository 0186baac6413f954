"""The studies and claims of maximo2024: verdicts follow the tables, parameters the tuning."""

import math

import numpy as np
import pandas as pd
import pytest

from experiments.judging.claim import Role, select, select_all
from experiments.judging.free_settings import free_settings
from experiments.judging.results import FIRST_SEED, Profile, Results
from experiments.papers.maximo2024 import claims, figures, places, settings, study, worlds
from experiments.runs.paths import SOURCE
from experiments.runs.seeds import stream
from experiments.sweeps.plan import plan_experiments
from tests.fixtures.claims import concluded


@pytest.fixture(scope="module")
def case():
    return worlds.make_case("umh", 5)


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
    table = pd.DataFrame(rows, columns=["geometry", "seed", "method", "repeat", column])
    return table.assign(n_nearest=2)


def headlines(said):
    return [c.verdict for c in said if c.role is Role.HEADLINE]


def both_routes(**umh):
    """Errors on both routes, those of Oxford as printed."""
    own = {"m1": 0.8, "m2": 0.4, "m3": 0.44} | umh
    values = own["m1"], own["m2"], own["m3"]
    return pd.concat([weighting(11.54, 9.61, 205.8), weighting(*values, name="umh", seed=1)])


def test_mx1_follows_the_errors():
    said = list(claims.mx1(both_routes()))
    assert headlines(said) == ["reproduced"] * 4
    found = concluded("maximo2024", said)
    assert found.verdict == "reproduced"
    assert found.sentence.startswith("With synthetic descriptors")
    assert "reproduced (M3 over M2: 21" in found.sentence
    assert "ten runs, shows what is claimed in 24 of 24 repetitions" in found.sentence
    for umh, at in (({"m1": 0.3}, 2), ({"m3": 0.6}, 3)):
        assert headlines(claims.mx1(both_routes(**umh)))[at] == "not_reproduced"
    oxford = pd.concat([weighting(9.0, 9.61, 20.0), weighting(0.8, 0.4, 0.44, "umh")])
    assert headlines(claims.mx1(oxford))[:2] == ["not_reproduced", "not_reproduced"]
    assert concluded("maximo2024", claims.mx1(oxford)).verdict == "not_reproduced"


def test_the_papers_data_sets_are_the_headlines():
    names = ("oxford", "oxford_real", "umh", "campus", "oxford_plane", "umh_plane")
    table = pd.concat([weighting(11.5, 9.6, 205.0, name) for name in names])
    said = select_all(list(claims.mx1(table)), method="M2")
    assert [c.role for c in said] == ["beside", "headline", "headline"] + ["beside"] * 3
    assert claims.headlines(["oxford", "umh", "campus"]) == {"oxford", "umh"}


def test_all_oxford_runs_stand_beside():
    runs = pd.concat(
        weighting(11.0, 10.0 if run < 12 else 12.0, 90.0, n=3, seed=run).assign(run=f"run {run}")
        for run in range(15)
    )
    said = list(claims.oxford_runs(runs))
    assert [c.role for c in said] == ["beside", "beside"]
    assert [c.found.value for c in said] == [12 / 15, 1.0]


def test_mx9_is_judged_by_its_region_alone():
    table = both_routes().assign(nearest_node_m=10.09)
    columns = {"oxford_m2_m": [2.0, 4.0], "umh_m2_m": [1.0, 1.0], "oxford_nearest_m": 2.0}
    region, *_, anchor, _ = said = list(
        claims.mx9(table, pd.DataFrame({**columns, "umh_nearest_m": 2.0}))
    )
    assert headlines(said) == []
    assert region.found.value == pytest.approx(2.0**0.5)
    assert anchor.found.value == pytest.approx(9.61 / 10.09, rel=0.2)
    assert free_settings("maximo2024")["MX9"].anchor is None


def test_mx2_wants_equal_errors_and_rising_times():
    rows = weighting(1.0, 1.0, 1.0).replace({"method": {"M1": 2, "M2": 4, "M3": 8}})
    table = rows.rename(columns={"method": "per_node"})
    said = list(claims.mx2(table, node_times()))
    assert headlines(said) == ["reproduced"] * 7
    said = [c for c in said if c.about.quantity not in ("intermediate", "own design")]
    assert said[3].found.low == pytest.approx(2.0)  # a slower turn moves no ratio of one turn
    assert said[6].found.value == pytest.approx(2.0)
    found = concluded("maximo2024", claims.mx2(table, node_times()))
    assert "the time grows by a factor of up to 2;" in found.sentence
    assert "on Oxford is at least 2 times that on UMH" in found.sentence
    worse = table.assign(error_m=table["error_m"] * np.where(table["per_node"] == 2, 1.3, 1.0))
    assert next(iter(claims.mx2(worse, node_times()))).verdict == "not_reproduced"
    assert next(iter(claims.mx2(worse, node_times()))).reason == "2 particles a node"
    within = table.assign(error_m=table["error_m"] * np.where(table["per_node"] == 2, 1.08, 1.0))
    assert next(iter(claims.mx2(within, node_times()))).verdict == "reproduced"
    better = table.assign(error_m=table["error_m"] * np.where(table["per_node"] == 4, 0.9, 1.0))
    for rows, verdict in ((better, "reproduced"), (worse.assign(error_m=1.0), "reproduced")):
        best = select(list(claims.mx2(rows, node_times())), quantity="intermediate")
        assert (best.verdict, best.role) == (verdict, "beside")


def node_times():
    """Six timings of a node by two numbers of particles, on each route; one turn is slower."""
    slower = [1.0, 1.1, 1.0, 1.0, 1.0, 1.0]
    seconds = {"oxford": [1.0e-4, 2.0e-4], "umh": [0.5e-4, 1.0e-4]}
    counts = {"oxford": [794, 1588], "umh": [272, 544]}
    paper_s = {"oxford": [0.26, 0.36], "umh": [0.09, 0.12]}
    return pd.concat(
        pd.DataFrame(
            {
                "geometry": name,
                "particles": counts[name] * 6,
                "repeat": np.arange(12) // 2,
                "time_s": np.outer(slower, seconds[name]).ravel(),
                "paper_s": paper_s[name] * 6,
            }
        )
        for name in seconds
    )


def verdicts_of_times(times):
    equal = weighting(1.0, 1.0, 1.0).replace({"method": {"M1": 2, "M2": 4, "M3": 8}})
    table = equal.rename(columns={"method": "per_node"})
    return {
        over: [c.verdict for c in select_all(list(claims.mx2(table, times)), over=over)]
        for over in ("the paper's", "2.56 s between nodes", "the fewest", "UMH")
    }


def test_mx2_fails_by_each_of_its_times():
    times = node_times()
    good = {"the paper's": 2, "2.56 s between nodes": 1, "the fewest": 2, "UMH": 1}
    assert verdicts_of_times(times) == {k: ["reproduced"] * n for k, n in good.items()}
    slower = times.assign(time_s=10.0 * times["time_s"])  # on another machine
    assert verdicts_of_times(slower) == verdicts_of_times(times)
    slow = times.assign(time_s=1e4 * times["time_s"])
    found = verdicts_of_times(slow)
    assert set(found["the paper's"] + found["2.56 s between nodes"]) == {"not_reproduced"}
    flat = times.assign(time_s=np.where(times["particles"] % 397, 1.0, 2.0) * 1e-4)
    flat.loc[flat["particles"].isin([1588, 544]), "time_s"] *= 0.5
    assert set(verdicts_of_times(flat)["the fewest"]) == {"not_reproduced"}
    as_fast = times.assign(time_s=np.where(times["geometry"] == "umh", 3e-4, times["time_s"]))
    assert verdicts_of_times(as_fast)["UMH"] == ["not_reproduced"]


def test_mx3_judges_every_weighting():
    spread = weighting(5.0, 2.0, 1.0, column="dispersion_m").assign(step=10)
    said = list(claims.mx3(spread))
    assert headlines(said) == ["reproduced", "reproduced"]
    assert [c.about.method for c in said[:2]] == ["M2", "M3"]
    assert list(claims.mx3(spread.assign(step=9))) == []
    slow = weighting(1.0, 1.5, 2.0, column="dispersion_m").assign(step=10)
    assert headlines(claims.mx3(slow)) == ["not_reproduced", "not_reproduced"]
    assert (
        "times as far by M3 as by M1 on Oxford"
        in concluded("maximo2024", claims.mx3(spread)).sentence
    )


def test_mx4_follows_its_tables():
    starts = pd.DataFrame({"geometry": "umh", "settled_at": [3.0] * 200})
    equal = pd.DataFrame(
        {"geometry": "umh", "least_start_m": [0.40, 0.41] * 5, "most_start_m": 0.42}
    )
    assert headlines(claims.mx4(starts, equal)) == ["reproduced", "reproduced"]
    late = starts.assign(settled_at=[3.0] * 100 + [np.nan] * 60 + [41.0] * 40)
    assert headlines(claims.mx4(late, equal))[0] == "not_reproduced"
    assert "50 % (UMH's route" in concluded("maximo2024", claims.mx4(late, equal)).sentence
    unlike = equal.assign(most_start_m=0.8)
    assert headlines(claims.mx4(starts, unlike)) == ["reproduced", "not_reproduced"]


def test_mx5_is_judged_on_descriptors_of_clouds():
    shares = {"descriptor": "m2dp", "contiguous": [0.9, 0.92, 0.91]}
    clouds = pd.DataFrame({"geometry": "campus", **shares})
    made = clouds.assign(geometry="umh", descriptor="synthetic", contiguous=0.99)
    assert headlines(claims.mx5(made, clouds)) == ["reproduced"]
    worse = clouds.assign(contiguous=[0.5, 0.52, 0.51])
    assert headlines(claims.mx5(made, worse)) == ["not_reproduced"]
    said = concluded("maximo2024", claims.mx5(made, clouds)).sentence
    assert "(M2DP); more than 80 % are asked" in said
    assert "below 80 % in 0 of 3:" in said


def test_our_own_claims_follow_their_tables():
    starts = pd.DataFrame(
        {"seed": [1, 1, 2, 2] * 60, "settled_at": 2.0, "spacing_m": 5.0, "rms_m": 0.1}
    )
    starts["rms_m"] += 0.01 * (starts["seed"] == 1)
    assert claims.mx6(starts).verdict == "reproduced"
    assert claims.mx6(starts.assign(settled_at=41.0)).verdict == "not_reproduced"
    assert claims.mx7(starts).verdict == "reproduced"
    assert claims.mx7(starts.assign(rms_m=starts["rms_m"] * 20)).verdict == "not_reproduced"
    trials = pd.DataFrame(
        {
            "geometry": "umh",
            "injection": [0.0, 0.05] * 100,
            "known_before": True,
            "settled_at": [np.nan, 4.0] * 100,
        }
    )
    assert [c.verdict for c in claims.mx8(trials)] == ["reproduced", "reproduced"]
    found = concluded("maximo2024", claims.mx8(trials))
    assert "100.0 % or more of 100 simulated kidnapped robots are localized" in found.sentence
    quick = trials.assign(settled_at=4.0)  # found again even without injection
    assert [c.verdict for c in claims.mx8(quick)] == ["not_reproduced", "reproduced"]
    slow = trials.assign(settled_at=25.0)
    assert [c.verdict for c in claims.mx8(slow)] == ["reproduced", "not_reproduced"]


def test_settling_has_to_last():
    errors = np.array([9.0, 0.0, 9.0, *([1.0] * 10), 9.0])
    assert worlds.settling_step(errors, 2.0) == 3.0
    assert math.isnan(worlds.settling_step(errors[:-2], 2.0))
    assert math.isnan(worlds.settling_step(errors, 0.5))


@pytest.mark.parametrize("name", ["weighting", "particles", "dispersion", "starts"])
def test_sweeps_have_the_parameters_of_the_anchor(name):
    for run in plan_experiments([f"study=maximo2024/{name}", "seed=2000"]):
        own, route = run.config["estimator"], run.config["recording"]["geometry"]
        at = worlds.anchored(route)
        far = round(at[settings.SIGMA_L] * places.GEOMETRIES[route].spacing_m, 2)
        assert (own["sigma_l_m"], own["sigma_m"]) == (far, at[settings.SIGMA_M])
        assert own["n_nearest"] == at[settings.B]
        assert run.config["recording"]["noise_weight"] == at["recording.noise_weight"]


@pytest.mark.slow
def test_at_the_anchor_m2_has_its_printed_error():
    printed = {"umh": 0.40} | ({"oxford": 9.61} if settings.POSITIONS.is_file() else {})
    for place, error_m in printed.items():
        at = worlds.anchored(place)
        levels = [worlds.reference_run(at, seed)[f"{place}_m2_m"] for seed in range(10)]
        assert np.exp(np.mean(np.log(levels))) == pytest.approx(error_m, rel=0.06)


def test_the_weightings_differ_in_nothing_else(case, monkeypatch):
    """All methods get the same parameters, recording and stream; at B = 1 they are one filter."""
    tuned, asked = worlds.options(case, "M2"), {}
    for method in settings.METHODS:
        assert worlds.options(case, method) | {"weighting": "M2"} == tuned
    like = (1.0, 0.1)
    walks = [
        worlds.localize(
            case, worlds.options(case, m, (*like, 1)), stream(5, "x"), case.recording.cut(45)
        )
        for m in settings.METHODS
    ]
    for walk in walks[1:]:
        np.testing.assert_allclose(walk.errors_m, walks[0].errors_m)

    def repeated(_case, given, axis, n_repeats):
        asked[given["weighting"]] = axis, n_repeats, {**given, "weighting": "any"}
        return [walk]

    monkeypatch.setattr(worlds, "_repeated", repeated)
    worlds.weighting_rows(case, 3)
    assert list(asked) == list(settings.METHODS)
    first, *others = asked.values()
    assert first[:2] == ("estimator/topological_mcl", 3)
    assert all(other == first for other in others)


def test_a_walk_reports_error_and_dispersion(case):
    part = case.recording.cut(30)
    walk = worlds.localize(case, worlds.options(case), stream(5, "test"), part, keep=("particles",))
    means = walk.estimate.means
    assert len(walk.errors_m) == len(means) == 30
    truth = case.recording.truth.poses[:30, :2]
    np.testing.assert_allclose(walk.errors_m, np.hypot(*(means[:, :2] - truth).T))
    cloud = walk.estimate.extras["particles"][3]
    away = np.hypot(*(cloud[:, :2] - means[3, :2]).T)
    assert walk.dispersions_m[3] == pytest.approx(away.mean())
    np.testing.assert_allclose(cloud[:, :2].mean(axis=0), means[3, :2])  # eq. (4)
    assert walk.errors_m[10:].mean() < 1.0
    assert not any(walk.estimate.extras["refinement"])


def test_rows_of_a_world(case):
    small = worlds.weighting_rows(case, 1)
    assert len(small["weighting"]) == 3
    assert len(small["dispersion"]) == 3 * (settings.WITHIN + 1)
    assert small["weighting"][0]["nearest_node_m"] == pytest.approx(0.39, abs=0.02)
    chosen = worlds.options(case)
    runs = list(worlds.starts(case, 3, chosen, settings.TOLERANCE * case.known_map.spacing_m))
    assert [start for start, _, _ in runs] == [0, 42, 85]
    assert all(settled <= 40 for _, settled, _ in runs)
    chosen["estimate"] = "mode"
    stolen = pd.DataFrame(worlds.kidnapping_rows(case, chosen, 0.05, 2, 30))
    back = stolen.groupby("injection")["settled_at"].max()
    assert back[0.05] <= settings.RECOVERED_WITHIN
    assert math.isnan(back[0.0])


def test_labels_of_clusters_are_stretches(case):
    row = worlds.cluster_row(case.known_map, case.recording, "synthetic", 5)
    assert row["contiguous"] > 0.8
    assert row["recall_at_1"] > 0.95
    labels = worlds.cluster_labels(case.known_map, 5)
    assert 30 <= len(np.unique(labels)) <= 40


def test_the_study_adds_up_to_the_papers_tables(case):
    rows = worlds.weighting_rows(case, 2)["weighting"]
    table = study.table_1(pd.DataFrame(rows).assign(geometry="umh", seed=5)).set_index("method")
    m2 = [row["error_m"] for row in rows if row["method"] == "M2"]
    assert table.loc["M2", "error_m"] == pytest.approx(np.mean(m2))
    assert table.loc["M3", "paper_m"] == 0.44


def test_the_filter_of_the_study_is_the_one_as_printed(case):
    estimator = case.experiment.estimator()
    assert (estimator.motion, estimator.resampling, estimator.scheme) == (
        "paper",
        "always",
        "multinomial",
    )
    assert (estimator.injection, estimator.estimate, estimator.refine) == (0.0, "mean", False)
    noisy = worlds.make_case("umh", 5, "recording.noise_weight=1.6")
    np.testing.assert_array_equal(noisy.known_map.positions_m, case.known_map.positions_m)
    assert not np.array_equal(noisy.known_map.descriptors, case.known_map.descriptors)


@pytest.mark.slow
def test_the_tracked_tables_and_arrays_redraw_every_figure():
    made = Results(SOURCE / "results", "maximo2024")
    tracked = {path.stem for path in (SOURCE / "results" / "figures").glob("maximo2024_*.png")}
    assert set(figures.draw(made)) == tracked
    assert sum(path.stat().st_size for path in (made.folder / "arrays").glob("maximo2024_*")) < 5e5


def test_examples_hold_what_the_figures_draw(case):
    drawn = study.route_arrays(case, 2)
    n = len(case.recording.frame_stamps)
    assert [int(np.argmax(np.isfinite(e))) for e in drawn["start_errors_m"]] == [0, n // 4, n // 2]
    assert np.isfinite(drawn["start_errors_m"][:, n // 2 :]).all()
    assert len(drawn["clusters"]) == len(drawn["nodes_m"]) == len(case.known_map)
    particles = drawn["particles_m"]
    assert len(particles) == len(drawn["means_m"]) == len(settings.ITERATIONS)
    np.testing.assert_allclose(particles.mean(axis=1), drawn["means_m"], rtol=1e-4)  # eq. (4)
    table = study.figure_5({"umh": drawn}).set_index("start")
    assert list(table.index) == [0, n // 4, n // 2]
    assert table.loc[0, "error_m"] == pytest.approx(float(drawn["start_errors_m"][0].mean()))
    assert table["paper_m"].tolist() == [0.41, 0.42, 0.58]


def test_controls_have_the_parameters_and_the_route_of_the_headlines(case):
    control = worlds.make_case("umh_plane", 5)
    np.testing.assert_array_equal(control.known_map.positions_m, case.known_map.positions_m)
    assert worlds.options(control) == worlds.options(case)
    along, plane = (c.recording.truth.poses[:, :2] for c in (case, control))
    assert not np.allclose(along, plane)


def test_every_job_of_the_study_is_of_a_judged_world():
    jobs = [job for job, _ in study._jobs(Profile.FULL)]
    assert len(set(jobs)) == len(jobs)
    assert min(seed for _, _, seed, _ in jobs) == FIRST_SEED[Profile.FULL] == 2000
    assert max(seed for _, _, seed, _ in (job for job, _ in study._jobs(Profile.QUICK))) < 100
