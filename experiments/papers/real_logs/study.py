"""The estimators on logs that others recorded, with the references' own figures beside.

The logs are not part of the project; they are looked for in ../shared/data.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import joblib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimators.base import Estimate, Estimator, Prior
from estimators.base import run as run_estimator
from estimators.ekf_icp import EkfIcp
from estimators.ekf_slam import EkfSlam
from estimators.fastslam import FastSLAM
from estimators.icp_odometry import IcpOdometry
from estimators.odometry import Odometry
from experiments.calibration.logs import (
    calibrate_track,
    calibrate_wheels,
    dead_reckoning_rms_m,
    slip_of_turns,
)
from experiments.evaluation.metrics import score
from experiments.evaluation.relations import relation_errors
from experiments.evaluation.time_sync import aligned_ate_m
from experiments.papers.real_logs.grid_match import beam_points, best_fit
from experiments.report.claims import Claim
from experiments.runs.row import write_frame
from experiments.runs.version import ROOT
from sim import se2
from sim.formats import carmen, intel, lego, mrclam, rawseeds, wean
from sim.formats.khepera import WheelLaserLog, read_khepera
from sim.formats.relations import Relations, read_relations
from sim.formats.text import read_members, read_words, split_words
from sim.recording import Recording, WheelLog
from sim.robot import RobotGeometry
from sim.sensors import Mount

Array = NDArray[np.float64]
Tables = dict[str, pd.DataFrame]
Profile = Literal["quick", "full"]

STUDY = "real_logs"
DATA = ROOT.parent / "shared" / "data"

RAWSEEDS = {  # printed with the logs: SE(2)-aligned ATE of 25a and 25b, m
    "amcl_beam_model_default": ("0.149", "0.178"),
    "amcl_likelihood_default": ("0.227", "0.174"),
    "ndt_mcl_0.5": ("0.079", "0.077"),
    "muse_default_params": ("0.142", "0.132"),
    "GROUNDTRUTH-CARTOGRAPHER": ("0.059", "0.062"),
    "GT-extended": ("0.031", "0.042"),
    "GraphSLAM Laser": ("", "0.074"),
}
KUEMMERLE = {  # as quoted with the logs: mean and standard deviation of the translation, m
    "intel": {"scan matching": (0.220, 0.296), "RBPF": (0.070, 0.083), "graph": (0.031, 0.026)},
    "fr079": {"scan matching": (0.258, 0.427), "RBPF": (0.061, 0.044), "graph": (0.056, 0.042)},
}
KHEPERA = {  # published: right and left diameter, axle, m
    "l90": (0.0414408, 0.0411796, 0.0880134),
    "lmov": (0.0415888, 0.0414217, 0.0883953),
}
LEGO_START_RAD = math.radians(213.0)

# Chosen on the first 40 % of the Intel log; the rest judges
TUNED_SHARE = 0.4
INTEL_SIGMA_M, INTEL_K_M = 0.03, 1e-3
FUSION: dict[str, Any] = {
    "kr": 3e-3,
    "kl": 3e-3,
    "sigma_range_m": 0.1,
    "lateral_slip_m": 3e-3,
    "keyframe_distance_m": 0.0,
    "keyframe_turn_rad": 0.0,
    "gate_probability": 1e-4,
}
# Chosen on robots 1 and 2 of MRCLAM; robots 3 to 5 judge
TUNED_ROBOTS = (1, 2)
CALIBRATED_S = 300.0
MRCLAM_K_M, WIDER = 5e-4, 4.0


def missing() -> str:
    """Why the study cannot run, or nothing."""
    return "" if DATA.is_dir() else f"the real logs are not in {DATA.parent.name}/{DATA.name}"


def run(profile: Profile, out: Path, on_progress: Callable[[float], None]) -> Tables:
    """Run all studies and write their tables to `out`.

    Parameters
    ----------
    profile
        `quick`: fewer robots, seeds and hypotheses.
    out
        Folder of the tables.
    on_progress
        Called with the share done.
    """
    full = profile == "full"
    tables = {"ate": rawseeds_ate(), "wheels": wheels(), "lego": lego_errors()}
    on_progress(0.1)
    tables["relations"], tables["intel_paths"] = relations()
    on_progress(0.3)
    tables["mrclam"], tables["mrclam_paths"] = landmark_slam(
        robots=(1, 2, 3, 4, 5) if full else (1, 4),
        n_seeds=5 if full else 1,
        with_ekf=full,
        on_progress=lambda share: on_progress(0.3 + 0.5 * share),
    )
    tables["wean"], tables["wean_path"] = wean_fit(logs=(1, 2) if full else (1,))
    for name, frame in tables.items():
        if not name.endswith(("paths", "path")):
            write_frame(frame, out / f"{STUDY}_{name}.csv")
    on_progress(1.0)
    return tables


def figures(tables: Tables) -> dict[str, Figure]:
    """All figures of the study, by file name."""
    from experiments.papers.real_logs import figures as draw

    return {
        f"{STUDY}_intel": draw.intel(tables["relations"], tables["intel_paths"]),
        f"{STUDY}_mrclam": draw.mrclam(tables["mrclam"], tables["mrclam_paths"]),
        f"{STUDY}_wheels": draw.wheels(tables["wheels"]),
        f"{STUDY}_wean": draw.wean(tables["wean"], tables["wean_path"]),
    }


def claims(tables: Tables, quick: bool) -> list[Claim]:
    """The study's claims, judged."""
    from experiments.papers.real_logs import claims as judge

    found = [
        *judge.rl1(tables["ate"]),
        *judge.rl2(tables["relations"]),
        *judge.rl3(tables["mrclam"]),
        *judge.rl4(tables["wheels"], tables["lego"]),
        *judge.rl5(tables["wean"]),
    ]
    command = f"estima reproduce --paper {STUDY}" + ("" if quick else " --full")
    return [claim.completed(study=STUDY, command=command, quick=quick) for claim in found]


def tracked(
    estimator: Estimator, recording: Recording, seed: int = 0, start: Array | None = None
) -> Estimate:
    """Estimate from a known start pose (the origin where there is none)."""
    mean = np.zeros(3) if start is None else start
    prior = Prior(recording.robot, recording.sensors, mean, np.diag([1e-6, 1e-6, 1e-6]))
    keep = ("registration_status",)
    return run_estimator(estimator, recording, prior, np.random.default_rng(seed), keep=keep)


# --- Rawseeds ------------------------------------------------------------------------------------


def rawseeds_ate() -> pd.DataFrame:
    """ATE of the stored trajectories beside the printed figures."""
    members = read_members(DATA / "rawseeds_bicocca_reference/rawseeds_bicocca_25a_25b.tar.xz")
    rows = []
    for i, session in enumerate(("25a", "25b")):
        folder = f"Bicocca_2009-02-{session}"

        def trajectory(name: str, folder: str = folder) -> rawseeds.Trajectory:
            names = (f"{folder}/{name}.csv", f"{folder}/{folder}-{name}.csv")
            member = next(n for n in names if n in members)
            return rawseeds.parse_trajectory(split_words(members[member], member))

        truth = trajectory("GROUNDTRUTH")
        for name, printed in RAWSEEDS.items():
            if not printed[i]:
                continue
            found = trajectory(name)
            ate_m = aligned_ate_m(truth.stamps, truth.poses, found.stamps, found.poses)
            rows.append(
                {"session": session, "trajectory": name, "ate_m": ate_m, "printed_m": printed[i]}
            )
    return pd.DataFrame(rows)


# --- Intel and Freiburg 079 ----------------------------------------------------------------------


def calibrated_by_scans(recording: Recording, until_s: float) -> Recording:
    """The recording with wheels, track and laser as scan matching before `until_s` shows them.

    The wheels of a log of poses are rebuilt with nominal sizes: what is found are corrections.
    """
    matcher = IcpOdometry(kr=3e-3, kl=3e-3, sigma_range_m=INTEL_SIGMA_M, reference="previous")
    estimate = tracked(matcher, recording)
    assert recording.laser is not None
    assert recording.sensors.laser is not None
    stamps = recording.laser.stamps
    rows = np.searchsorted(estimate.stamps, stamps)
    poses = estimate.means[rows]
    status = np.array([str(estimate.extras["registration_status"][i]) for i in rows])
    trusted = (status[1:] == "ok") & (stamps[1:] < until_s)
    wheels = recording.wheels
    travel = np.stack(
        [np.interp(stamps, wheels.stamps, wheels.position_m[:, i]) for i in (0, 1)], axis=1
    )
    log = WheelLaserLog(
        np.diff(stamps)[trusted],
        2.0 * np.diff(travel, axis=0)[trusted],
        se2.between(poses[:-1], poses[1:])[trusted],
    )
    right, left, axle_m, x, y, yaw = calibrate_wheels(log, 1.0, recording.robot.track_m).values
    laser = recording.sensors.laser
    mount = Mount(x, y, laser.mount.z_m, laser.mount.yaw_rad + yaw)
    return dataclasses.replace(
        recording,
        wheels=WheelLog(wheels.stamps.copy(), wheels.position_m * np.array([right, left])),
        robot=RobotGeometry(recording.robot.wheel_radius_m, axle_m),
        sensors=dataclasses.replace(
            recording.sensors, laser=dataclasses.replace(laser, mount=mount)
        ),
    )


def relations() -> tuple[pd.DataFrame, pd.DataFrame]:
    """The relations metric of our estimates and of the references; and the Intel paths."""
    folder = DATA / "intel_lab"
    truth = read_relations(folder / "intel.relations.gz")
    sparse = intel.read_intel(
        folder / "intel_raw_910.json.gz", folder / "intel_gmapping_910.json.gz"
    )
    logged, _ = intel.read_thinned_intel(
        folder / "intel_mrpt_scans_converted.txt.gz",
        folder / "intel_mrpt_ODO.txt.gz",
        folder / "intel_mrpt_reference_matches.csv.gz",
    )
    assert logged.laser is not None
    until_s = float(np.quantile(logged.laser.stamps, TUNED_SHARE))
    calibrated = calibrated_by_scans(logged, until_s)
    k, sigma = INTEL_K_M, INTEL_SIGMA_M
    methods: dict[str, tuple[Estimator, Recording]] = {
        "odometry, 910 scans": (Odometry(k, k), sparse),
        "odometry, as logged": (Odometry(k, k), logged),
        "odometry, calibrated": (Odometry(k, k), calibrated),
        "ICP alone": (IcpOdometry(use_odometry_guess=False, sigma_range_m=sigma), calibrated),
        "ICP from the wheels": (
            IcpOdometry(kr=k, kl=k, sigma_range_m=sigma, reference="previous"),
            calibrated,
        ),
        "EKF of wheels and ICP": (EkfIcp(**FUSION), calibrated),
    }
    rows: list[dict[str, Any]] = []
    paths = []
    for name, (estimator, recording) in methods.items():
        estimate = tracked(estimator, recording)
        rows += _relation_rows(
            "intel", name, truth, estimate.stamps, estimate.means, until_s=until_s
        )
        paths.append(_path(name, estimate.stamps, estimate.means))
    assert sparse.truth is not None
    reference = sparse.truth
    rows += _relation_rows(
        "intel", "GMapping, 910 poses", truth, reference.stamps, reference.poses, until_s=until_s
    )
    paths.append(_path("GMapping, 910 poses", reference.stamps, reference.poses))
    graph = carmen.read_carmen(folder / "intel-lab.flirt.log.gz")
    rows += _relation_rows(
        "intel", "graph (FLIRT)", truth, graph.scan_stamps, graph.scan_poses, near=True
    )
    rows += _freiburg_rows()
    for log, printed in KUEMMERLE.items():
        for name, (mean, spread) in printed.items():
            rows.append(
                {
                    "log": log,
                    "method": f"{name} (printed)",
                    "part": "all",
                    "translation_mean_m": mean,
                    "translation_std_m": spread,
                }
            )
    return pd.DataFrame(rows), pd.concat(paths, ignore_index=True)


def _freiburg_rows() -> list[dict[str, Any]]:
    folder = DATA / "fr079_flirt"
    truth = read_relations(folder / "fr079.relations.gz")
    log = carmen.read_carmen(folder / "fr079.flirt.log.gz")
    recording = carmen.to_recording(log)
    sigma = INTEL_SIGMA_M
    methods: dict[str, Estimator] = {
        "graph's own edges": Odometry(1e-4, 1e-4),
        "ICP alone": IcpOdometry(use_odometry_guess=False, sigma_range_m=sigma),
        "ICP from the edges": IcpOdometry(
            kr=1e-3, kl=1e-3, sigma_range_m=sigma, reference="previous"
        ),
    }
    rows: list[dict[str, Any]] = []
    for name, estimator in methods.items():
        estimate = tracked(estimator, recording)
        rows += _relation_rows("fr079", name, truth, estimate.stamps, estimate.means)
    rows += _relation_rows("fr079", "graph (FLIRT)", truth, log.scan_stamps, log.scan_poses)
    rows += _relation_rows(
        "fr079", "graph (FLIRT), exact stamps", truth, log.scan_stamps, log.scan_poses, near=True
    )
    return rows


def _relation_rows(
    log: str,
    method: str,
    relations: Relations,
    stamps: Array,
    poses: Array,
    *,
    near: bool = False,
    until_s: float | None = None,
) -> list[dict[str, Any]]:
    """Rows of all relations and, for a tuned method, of those after the tuned part."""
    parts = {"all": relations}
    if until_s is not None:
        late = np.all(relations.stamps > until_s, axis=1)
        parts["judged"] = Relations(relations.stamps[late], relations.motion[late])
    rows = []
    for part, chosen in parts.items():
        found = relation_errors(chosen, stamps, poses, "near" if near else "interpolated")
        low, high = _block_interval(found.translation_m, chosen.stamps[found.rows, 0])
        rows.append(
            {"log": log, "method": method, "part": part, **found.summary()}
            | {"translation_low_m": low, "translation_high_m": high}
        )
    return rows


def _block_interval(errors: Array, stamps: Array, block_s: float = 60.0) -> tuple[float, float]:
    """95 % interval of a mean; relations that begin in the same minute are resampled together."""
    blocks = np.floor((stamps - stamps.min()) / block_s).astype(int)
    sums = np.bincount(blocks, errors)
    counts = np.bincount(blocks)
    sums, counts = sums[counts > 0], counts[counts > 0]
    picks = np.random.default_rng(0).integers(len(sums), size=(2000, len(sums)))
    means = sums[picks].sum(axis=1) / counts[picks].sum(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def _path(name: str, stamps: Array, poses: Array) -> pd.DataFrame:
    columns = {"method": name, "stamp": stamps, "x_m": poses[:, 0], "y_m": poses[:, 1]}
    return pd.DataFrame(columns)


# --- MRCLAM --------------------------------------------------------------------------------------


def calibrated_by_truth(recording: Recording, until_s: float = CALIBRATED_S) -> Recording:
    """The recording with wheel gains and track fitted to the truth of its first `until_s`."""
    truth, wheels, lag_s = recording.truth, recording.wheels, 4.0
    assert truth is not None
    begin = max(truth.stamps[0], wheels.stamps[0])
    times = np.arange(begin, min(begin + until_s, truth.stamps[-1]), 0.02)
    travel = np.stack(
        [np.interp(times, wheels.stamps, wheels.position_m[:, i]) for i in (0, 1)], axis=1
    )
    heading = np.interp(times, truth.stamps, np.unwrap(truth.poses[:, 2]))
    x, y = (np.interp(times, truth.stamps, truth.poses[:, i]) for i in (0, 1))
    along = np.cos(heading[:-1]) * np.diff(x) + np.sin(heading[:-1]) * np.diff(y)
    forward = np.concatenate([[0.0], np.cumsum(along)])
    every = round(lag_s / 0.02)
    travel_step = travel[every::every] - travel[:-every:every]
    turn = heading[every::every] - heading[:-every:every]
    advance = forward[every::every] - forward[:-every:every]
    # turn = (a_r W_r - a_l W_l) / track, advance = (a_r W_r + a_l W_l) / 2
    per_track = np.linalg.lstsq(travel_step * np.array([1.0, -1.0]), turn, rcond=None)[0]
    mean = travel_step @ per_track / 2.0
    track_m = float(mean @ advance / (mean @ mean))
    return dataclasses.replace(
        recording,
        wheels=WheelLog(wheels.stamps.copy(), wheels.position_m * (per_track * track_m)),
        robot=RobotGeometry(recording.robot.wheel_radius_m, track_m),
    )


def _slam_methods(seed_free: bool) -> dict[str, tuple[Estimator, bool]]:
    """Name to estimator and whether it is told the landmarks' identities."""
    camera, k = mrclam.CAMERA, MRCLAM_K_M
    wide: dict[str, Any] = {
        "sigma_disparity_px": WIDER * camera.sigma_disparity_px,
        "sigma_column_px": WIDER * camera.sigma_column_px,
    }
    both: dict[str, Any] = {"kr": k, "kl": k}
    unknown: dict[str, Any] = {"association": "mahalanobis"}
    if seed_free:
        return {
            "EKF-SLAM, known": (EkfSlam(**both), True),
            "EKF-SLAM, known, wider noise": (EkfSlam(**both, **wide), True),
            "EKF-SLAM, unknown, wider noise": (EkfSlam(**both, **unknown, **wide), False),
        }
    many: dict[str, Any] = {**both, "n_particles": 500}
    return {
        "FastSLAM, known": (FastSLAM(**many), True),
        "FastSLAM, known, wider noise": (FastSLAM(**many, **wide), True),
        "FastSLAM, unknown, wider noise": (FastSLAM(**many, **unknown, **wide), False),
    }


def landmark_slam(
    robots: tuple[int, ...],
    n_seeds: int,
    with_ekf: bool,
    on_progress: Callable[[float], None],
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Errors of dead reckoning, FastSLAM and EKF-SLAM against motion capture; and some paths."""
    jobs: list[tuple[int, str | None, int]] = [(robot, None, 0) for robot in robots]
    jobs += [
        (robot, name, seed)
        for robot in robots
        for name in _slam_methods(False)
        for seed in range(n_seeds)
    ]
    if with_ekf:
        jobs += [(robot, name, 0) for robot in robots for name in _slam_methods(True)]
    done = joblib.Parallel(n_jobs=-1, return_as="generator")(
        joblib.delayed(_landmark_job)(*job) for job in jobs
    )
    rows: list[dict[str, Any]] = []
    paths = []
    for i, (found, path) in enumerate(done):
        rows += found
        paths += path
        on_progress((i + 1) / len(jobs))
    return pd.DataFrame(rows), pd.concat(paths, ignore_index=True)


def _landmark_job(
    robot: int, name: str | None, seed: int
) -> tuple[list[dict[str, Any]], list[pd.DataFrame]]:
    path = DATA / "mrclam6/MRCLAM_Dataset6.tar.xz"
    logged = mrclam.read_mrclam(path, robot)
    recording = calibrated_by_truth(logged)
    runs: dict[str, tuple[Estimator, Recording]]
    if name is None:
        k = MRCLAM_K_M
        runs = {
            "dead reckoning, as logged": (Odometry(k, k), logged),
            "dead reckoning, calibrated": (Odometry(k, k), recording),
        }
    else:
        estimator, told = {**_slam_methods(False), **_slam_methods(True)}[name]
        if not told:
            recording = calibrated_by_truth(mrclam.read_mrclam(path, robot, identifies=False))
        runs = {name: (estimator, recording)}
    rows, paths = [], []
    for method, (chosen, log) in runs.items():
        start = log.truth_at(log.frame_stamps[:1])[0]
        estimate = tracked(chosen, log, seed, start)
        found = score(log, estimate)
        rows.append(
            {"robot": robot, "method": method, "seed": seed, "judged": robot not in TUNED_ROBOTS}
            | {key: found.get(key, math.nan) for key in _SCORES}
        )
        if seed == 0 and robot == 4:
            paths.append(_path(method, estimate.stamps[::5], estimate.means[::5]))
            if name is None and method.endswith("calibrated"):
                assert log.truth is not None
                paths.append(_path("motion capture", log.truth.stamps[::20], log.truth.poses[::20]))
    return rows, paths


_SCORES = ("ate_rmse_m", "ate_aligned_rmse_m", "heading_rmse_rad", "nees_mean", "step_time_us")


# --- wheels --------------------------------------------------------------------------------------


def wheels() -> pd.DataFrame:
    """Khepera: geometry beside the published one; kr and kl by the length of the blocks."""
    archive = DATA / "censi_khepera_calib/khepera_l90_lmov.tar.xz"
    rows: list[dict[str, Any]] = []
    for name, published in KHEPERA.items():
        found = calibrate_wheels(read_khepera(archive, f"{name}.tuple"))
        geometry = (found.diameter_right_m, found.diameter_left_m, found.axle_m)
        names = ("diameter_right_m", "diameter_left_m", "axle_m")
        for quantity, measured, printed in zip(names, geometry, published, strict=True):
            rows.append(
                {"log": name, "quantity": quantity, **dataclasses.asdict(measured)}
                | {"published": printed, "block": 0}
            )
        for block in (1, 2, 4, 8, 16):
            slip = slip_of_turns(found, block, np.random.default_rng(0))
            for quantity, measured in (("kr", slip.kr), ("kl", slip.kl)):
                rows.append(
                    {"log": name, "quantity": quantity, **dataclasses.asdict(measured)}
                    | {"block": block}
                )
    return pd.DataFrame(rows)


def lego_errors() -> pd.DataFrame:
    """Dead reckoning of the Lego robot with the lecture's constants and with calibrated ones."""
    folder = DATA / "lego_brenner"
    log = lego.parse_motors(read_words(folder / "robot4_motors.txt.gz"))
    stamps, positions = lego.parse_reference(read_words(folder / "robot4_reference.txt.gz"))
    ahead = lego.SCANNER_AHEAD_M * np.array([math.cos(LEGO_START_RAD), math.sin(LEGO_START_RAD)])
    start = np.array([*(positions[0] - ahead), LEGO_START_RAD])
    rows: list[dict[str, Any]] = []
    for name, track_m in (
        ("geometric width", lego.GEOMETRIC_TRACK_M),
        ("lecture's effective width", lego.EFFECTIVE_TRACK_M),
    ):
        rms_m = dead_reckoning_rms_m(log, stamps, positions, lego.TICK_M, track_m, start)
        rows.append({"case": name, "tick_m": lego.TICK_M, "track_m": track_m, "rms_m": rms_m})
    found = calibrate_track(log, stamps, positions, LEGO_START_RAD)
    rows.append(
        {
            "case": "calibrated",
            "tick_m": found.tick_m.value,
            "track_m": found.track_m.value,
            "track_low_m": found.track_m.low,
            "track_high_m": found.track_m.high,
            "rms_m": found.rms_m,
        }
    )
    half = stamps < stamps.mean()
    first = calibrate_track(log, stamps[half], positions[half], LEGO_START_RAD)
    tick_m, track_m = first.tick_m.value, first.track_m.value
    rest = dead_reckoning_rms_m(log, stamps[~half], positions[~half], tick_m, track_m, first.start)
    rows.append(
        {
            "case": "calibrated on the first half, judged on the second",
            "tick_m": tick_m,
            "track_m": track_m,
            "rms_m": rest,
        }
    )
    return pd.DataFrame(rows)


# --- Wean Hall -----------------------------------------------------------------------------------


def wean_fit(logs: tuple[int, ...]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """How well the scans fit the map under each reading of it; and the paths in the map."""
    folder = DATA / "wean_hall_mcl"
    grid = wean.read_grid(folder / "wean.dat.gz")
    rows, paths = [], []
    for number in logs:
        recording = wean.read_wean(folder / f"robotdata{number}.log.gz")
        assert recording.laser is not None
        assert recording.sensors.laser is not None
        estimate = tracked(IcpOdometry(kr=1e-4, kl=1e-4, sigma_range_m=INTEL_SIGMA_M), recording)
        poses = estimate.means[np.searchsorted(estimate.stamps, recording.laser.stamps)]
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
        chosen = np.searchsorted(travelled, np.arange(0.0, min(travelled[-1], 15.0), 0.5))
        laser = recording.sensors.laser
        ranges = recording.laser.ranges_m[chosen][:, ::3].astype(np.float64)
        points = beam_points(ranges, laser.bearings_rad[::3], laser.mount.pose, poses[chosen])
        for free_is_one in (True, False):
            read = dataclasses.replace(grid, free_is_one=free_is_one)
            for mirrored in (False, True):
                coarse = _halved(read.occupancy.T if mirrored else read.occupancy)
                fit = best_fit(coarse, 2.0 * grid.cell_m, points)
                x, y, yaw = fit.pose
                rows.append(
                    {
                        "log": number,
                        "one_means": "free" if free_is_one else "occupied",
                        "mirrored": mirrored,
                        "score": fit.score,
                        "x_m": x,
                        "y_m": y,
                        "yaw_rad": yaw,
                    }
                )
                if free_is_one and not mirrored:
                    placed = se2.compose(fit.pose, poses)
                    paths.append(_path(f"log {number}", recording.laser.stamps, placed))
                    ends = se2.transform(fit.pose, points[:, 0])
                    ends = np.column_stack([ends, np.zeros(len(ends))])
                    paths.append(_path(f"scans {number}", np.zeros(len(ends)), ends))
    return pd.DataFrame(rows), pd.concat(paths, ignore_index=True)


def _halved(values: Array) -> Array:
    """A grid of cells twice as large: means of what is known in them."""
    n_x, n_y = values.shape[0] // 2, values.shape[1] // 2
    cells = values[: 2 * n_x, : 2 * n_y].reshape(n_x, 2, n_y, 2)
    known = np.isfinite(cells).sum(axis=(1, 3))
    total = np.nansum(cells, axis=(1, 3))
    return np.where(known > 0, total / np.maximum(known, 1), np.nan)
