"""Figures show what they say: equal samples, every curve named, rows at one height."""

import itertools

import numpy as np
import pandas as pd
import pytest

from experiments.papers.decristoforis2020 import figures as decristoforis2020
from experiments.papers.gil2008 import figures as gil2008
from experiments.papers.maximo2024 import figures as maximo2024
from experiments.papers.puzzlebot2024 import figures as puzzlebot2024
from experiments.studies.all_estimators import figures as all_estimators
from experiments.studies.leaderboard import figures as leaderboard
from experiments.studies.teams import figures as teams

ERRORS = (
    "revised_ate_rmse_m",
    "revised_ate_aligned_rmse_m",
    "map_rmse_m",
    "map_aligned_rmse_m",
)


def test_figure_8_over_worlds_has_equal_samples_and_names_every_filter():
    rows = [
        (seed, m, noise, name, draw, 1.0 if draw == 0 else 50.0)
        for seed, m, (noise, name) in itertools.product(
            range(3),
            (10, 200),
            [("paper", "paper"), ("paper", "fastslam2"), ("pixel", "fastslam2")],
        )
        for draw in range(3 if m == 200 else 1)
    ]
    columns = ["seed", "n_particles", "noise", "filter", "draw", "error"]
    table = pd.DataFrame(rows, columns=columns)
    table = table.assign(**dict.fromkeys(ERRORS, table["error"]))
    bound = table[table["draw"] == 0]
    page = gil2008.by_particles_over_worlds(table, bound)
    for ax in page.axes:
        for drawn in ax.containers:
            assert drawn.lines[0].get_ydata() == pytest.approx([1.0, 1.0])
    named = {text.get_text() for text in page.legends[0].get_texts()}
    assert named == {"as printed", "FastSLAM 2.0", "batch baseline"}


def test_ways_to_associate_stand_at_one_height_left_and_right():
    ways = [
        ("fastslam2", "mahalanobis", 1e-3, 0.9),
        ("fastslam2", "descriptor", 1e-3, 0.9),
        ("ekf_slam", "mahalanobis", 1e-3, 0.9),
        ("fastslam2", "known", 1e-3, 0.9),
    ]
    columns = ["filter", "association", "p0", "sigma_descriptor"]
    table = pd.concat(
        pd.DataFrame(part, columns=columns).assign(noise=noise, seed=seed, noise_at="predicted")
        for noise, part in (("paper", ways), ("pixel", ways[:2]))
        for seed in range(2)
    ).assign(revised_ate_rmse_m=1.0, odometry_rmse_m=2.0, right_share=0.5, matching_precision=0.9)
    axes = gil2008.by_association(table).axes
    for left, right, count in ((axes[0], axes[1], 4), (axes[2], axes[3], 2)):
        assert left.get_ylim() == right.get_ylim()
        heights = [bar.get_y() + bar.get_height() / 2 for bar in right.patches]
        assert heights == pytest.approx(range(count))
    names = [label.get_text() for label in axes[0].get_yticklabels()]
    assert names[0] == "known"
    assert names[-1] == "EKF-SLAM, Mahalanobis"


def runs(errors):
    rows = [
        (seed, method, (seed + 1) * value) for seed in range(3) for method, value in errors.items()
    ]
    return pd.DataFrame(rows, columns=["seed", "method", "ate_rmse_m"])


def test_the_drive_drawn_tells_its_errors():
    drawn = runs({"odometry": 1.0, "icp": 0.5, "fusion": 0.1}).query("seed == 0")
    told = decristoforis2020._of_drawn(drawn.assign(distance_m=300.2), "ate_rmse_m", "RMSE")
    assert told == "300 m, seed 0; RMSE: odometry 1.00 m, ICP 0.50 m, fusion 0.10 m"


def test_shares_end_at_one():
    starts = pd.DataFrame({"median_m": [0.1, 0.2], "rms_m": [0.2, 0.3], "spacing_m": 6.0})
    kinds = list(maximo2024.describers.KINDS)
    clusters = pd.DataFrame(
        {
            "geometry": "campus",
            "descriptor": list(kinds),
            "recall_at_1": 1.0,
            "recall_at_1_percent": 1.0,
        }
    )
    right = maximo2024.campus_errors(starts, clusters).axes[1]
    assert np.array_equal(right.get_ylim(), (0.0, 1.0))


def test_figures_1_and_2_of_gil2008_name_both_filters_and_fit_their_grids():
    run = {}
    for name in ("truth", "odometry", "paper", "fastslam2"):
        grid = np.full((300, 300), np.nan, np.float32)
        grid[100, :] = 0.9
        run |= {f"{name}_grid": grid, f"{name}_origin": np.zeros(3)}
    for name in ("paper", "fastslam2"):
        run |= {
            f"{name}_landmarks": np.ones((2, 3)),
            f"{name}_covariances": np.tile(np.eye(3), (2, 1, 1)),
        }
    for page in (gil2008.maps(run), gil2008.corrected(run)):
        titles = [ax.get_title(loc="left") for ax in page.axes]
        assert "as printed" in titles[1]
        assert "FastSLAM 2.0" in titles[2]
        for ax in page.axes:
            assert ax.get_xlabel() == "x, m"
            assert np.ptp(ax.get_xlim()) < 40.0
            assert np.ptp(ax.get_ylim()) < 40.0


def test_figure_8_shows_both_designs():
    rows = [
        (m, name, draw, 2.0 if draw else 1.0)
        for m, name in itertools.product((10, 200), ("paper", "fastslam2"))
        for draw in (0, 0, 1, 2)
    ]
    table = pd.DataFrame(rows, columns=["n_particles", "filter", "image_draw", "error"])
    table = table.assign(**dict.fromkeys(ERRORS, table["error"]))
    table = table.assign(seed=1000, noise="paper", odometry_rmse_m=3.0)
    page = gil2008.by_particles(table, table[:1])
    for ax, mean in zip(page.axes, (2.0, 2.0, 1.0, 1.0), strict=True):
        for drawn in ax.containers:
            assert drawn.lines[0].get_ydata() == pytest.approx([mean, mean])
    assert "2 runs each" in page.get_suptitle()


def test_robots_that_drive_the_same_way_all_show():
    way = np.array([[0.0, 0.0], [4.0, 0.0]])
    run = {"walls": np.array([[0.0, -1.0, 4.0, -1.0]]), "wall_z_m": np.array([[0.0, 2.0]])}
    run |= {f"truth_{number}": way for number in range(3)}
    run |= {f"sightings_{number}": np.zeros((0, 4)) for number in range(3)}
    page = teams.drive(run)
    paths = [line for line in page.axes[0].lines if line.get_label().startswith("robot")]
    assert len(paths) == 3
    assert all(a.get_linewidth() >= b.get_linewidth() + 1.0 for a, b in itertools.pairwise(paths))
    named = [text.get_text() for text in page.legends[0].get_texts()]
    assert "start" in named
    assert any("sighting" in name for name in named)


def test_sweeps_are_drawn_from_their_means_with_the_best_on_top():
    slips = [1e-6, 1e-5, 1e-4]
    rows = [
        (
            name,
            "revised" if name == "b" else "online",
            kr,
            error * (1 + kr),
            error,
            2 * error,
            world,
        )
        for name, error in (("a", 0.1), ("b", 0.01), ("c", 1.0))
        for kr, world in zip(slips, ("office", "room", "rooms"), strict=True)
    ]
    error = "answer_ate_rmse_m"
    means = pd.DataFrame(
        rows,
        columns=[
            *("choice.estimator", "answer", "robot.kr", error, f"{error}_low", f"{error}_high"),
            "choice.world",
        ],
    ).assign(**{"sensors.stereo.max_distance_m": np.nan})
    for page in (all_estimators.slip(means), leaderboard.errors(means)):
        names = [tick.get_text() for tick in page.axes[0].get_yticklabels()]
        assert names == ["c", "a", "b (revised)"]
        assert len(page.legends[0].get_texts()) == 3


def test_whiskers_stay_inside_their_axes():
    ends = {"whislo": 1e-5, "q1": 0.1, "med": 0.2, "q3": 0.4, "whishi": 0.9}
    kinds = itertools.product(("odometry", "icp", "fusion"), ("position_m", "heading_rad"))
    table = pd.DataFrame([{"method": m, "error": e, **ends} for m, e in kinds])
    for ax, unit in zip(decristoforis2020.boxes(table).axes, (1.0, np.degrees(1.0)), strict=True):
        low, high = ax.get_ylim()
        assert low <= ends["whislo"]
        assert high >= unit * ends["whishi"]


def test_manoeuvres_that_stay_covered_are_one_grey_family():
    rows = [
        (case, k, 1000, share, share)
        for case, end in (("linear_2", 600), ("linear_3", 950), ("angular_1", 945))
        for k, share in ((1e-6, 950), (1e-3, end))
    ]
    table = pd.DataFrame(rows, columns=["case", "k_m", "runs", "in_ellipse", "in_ellipsoid"])
    for ax in puzzlebot2024.coverage(table).axes:
        assert {text.get_text() for text in ax.texts} == {"linear 2", "all others"}
