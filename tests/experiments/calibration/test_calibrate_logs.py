import math

import numpy as np
import pytest

from estimators.landmarks.ekf_slam import EkfSlam
from estimators.landmarks.fastslam import FastSLAM
from estimators.laser.ekf_icp import EkfIcp
from estimators.laser.icp_odometry import IcpOdometry
from estimators.odometry import Odometry
from experiments.calibration.logs import calibrate_track, dead_reckoning_rms_m, scanner_positions
from experiments.studies.real_logs import settings
from experiments.studies.real_logs.grid_match import beam_points, best_fit
from experiments.sweeps.plan import plan_experiments
from sim import se2
from sim.formats.lego import TickLog, parse_motors, parse_reference
from sim.formats.mrclam import CAMERA
from sim.formats.text import read_words
from tests.fixtures.log_samples import DATA

needs_data = pytest.mark.skipif(not DATA.exists(), reason="no real logs here")


def ticks(rng, n=200):
    steps = rng.integers(5, 30, (n, 2)) + np.where(np.arange(n)[:, None] % 60 < 30, [8, 0], [0, 8])
    return TickLog(np.arange(n + 1) * 0.2, np.concatenate([[[0, 0]], np.cumsum(steps, axis=0)]))


def test_track_and_tick_are_found():
    log = ticks(np.random.default_rng(0))
    start = np.array([1.0, 2.0, 0.7])
    seen = scanner_positions(log, 0.00035, 0.18, start)
    seen += 0.002 * np.random.default_rng(1).standard_normal(seen.shape)
    seen[0] = scanner_positions(log, 0.00035, 0.18, start)[0]
    found = calibrate_track(log, log.stamps, seen, 0.5)
    assert found.tick_m.value == pytest.approx(0.00035, rel=0.01)
    assert abs(found.track_m.value - 0.18) < 0.002
    np.testing.assert_allclose(found.start, start, atol=0.01)
    assert found.rms_m < 0.004
    wrong = dead_reckoning_rms_m(log, log.stamps, seen, 0.00035, 0.155, start)
    assert wrong > 5.0 * found.rms_m


@needs_data
def test_lego_below_ten_centimetres():
    folder = DATA / "lego_brenner"
    log = parse_motors(read_words(folder / "robot4_motors.txt.gz"))
    stamps, positions = parse_reference(read_words(folder / "robot4_reference.txt.gz"))
    heading = math.radians(213.0)
    start = np.array([1.85 - 0.03 * math.cos(heading), 1.897 - 0.03 * math.sin(heading), heading])
    before = dead_reckoning_rms_m(log, stamps, positions, 0.000349, 0.155, start)
    assert before == pytest.approx(0.593, abs=0.01)
    effective = dead_reckoning_rms_m(log, stamps, positions, 0.000349, 0.173, start)
    assert effective == pytest.approx(0.069, abs=0.003)
    assert calibrate_track(log, stamps, positions, heading).rms_m < 0.05


def test_scans_find_their_place_and_the_maps_meaning():
    rng = np.random.default_rng(0)
    occupancy = np.full((60, 50), np.nan)
    occupancy[5:55, 5:45] = 0.0  # a free hall with walls and a few pillars
    occupancy[5:55, [5, 44]] = occupancy[[5, 54], 5:45] = 1.0
    occupancy[20:23, 30:33] = occupancy[40:44, 12:15] = 1.0
    cell_m, bearings = 0.2, np.linspace(-math.pi, math.pi, 90, endpoint=False)
    truth = np.array([4.1, 3.1, 1.2])
    steps = np.array([[0.0, 0.0, 0.0], [0.6, 0.2, 0.3]])
    poses = se2.compose(truth, steps)
    mount = np.array([0.1, 0.0, 0.0])
    ranges = np.full((2, 90), np.inf)
    for s, laser in enumerate(se2.compose(poses, np.broadcast_to(mount, poses.shape))):
        for b, bearing in enumerate(bearings):
            for r in np.arange(0.1, 11.0, 0.1):
                x, y = laser[:2] + r * np.array(
                    [math.cos(laser[2] + bearing), math.sin(laser[2] + bearing)]
                )
                if occupancy[int(x / cell_m), int(y / cell_m)] == 1.0:
                    ranges[s, b] = r
                    break
    ranges[rng.random(ranges.shape) < 0.1] = np.inf
    points = beam_points(ranges, bearings, mount, steps)
    found = best_fit(occupancy, cell_m, points, n_headings=72)
    np.testing.assert_allclose(found.pose[:2], truth[:2], atol=0.25)
    assert abs(se2.wrap(found.pose[2] - truth[2])) < 0.1
    inverted = best_fit(1.0 - occupancy, cell_m, points, n_headings=72)
    assert inverted.score < found.score - 0.2


@pytest.mark.parametrize(
    ("study", "names"),
    [
        ("intel", settings.INTEL),
        ("fr079", settings.FREIBURG),
        ("mrclam recording.robot=1", settings.MRCLAM),
    ],
)
def test_every_run_of_a_study_has_its_name(study, names):
    runs = dict(zip(names, plan_experiments(f"study=real_logs/{study}".split()), strict=True))
    methods = {
        "ICP": IcpOdometry,
        "EKF of": EkfIcp,
        "EKF-SLAM": EkfSlam,
        "FastSLAM": FastSLAM,
        "odometry": Odometry,
        "dead reckoning": Odometry,
        "graph's": Odometry,
    }
    for name, run in runs.items():
        (kind,) = [kind for start, kind in methods.items() if name.startswith(start)]
        assert type(run.estimator()) is kind
        unknown = run.config["estimator"].get("association") == "mahalanobis"
        assert unknown == ("unknown" in name)
        wider = run.config["estimator"].get("sigma_disparity_px") is not None
        assert wider == ("wider noise" in name or "bursts" in name)
    if study.startswith("mrclam"):
        noise = runs["FastSLAM, known, wider noise"].config["estimator"]
        assert noise["sigma_disparity_px"] == 4.0 * CAMERA.sigma_disparity_px
        assert noise["sigma_column_px"] == 4.0 * CAMERA.sigma_column_px
