"""The studies of puzzlebot2024: covariance, calibration of kr and kl, coverage of the ellipse.

Thousands of runs come from the kinematic robot, which obeys the same slip law as PyBullet's; a
subset is driven by PyBullet too, and both are compared.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimators.base import Prior
from estimators.odometry import Odometry
from experiments.calibration.calibrate import (
    CalibrationResult,
    Manoeuvre,
    calibrate_recordings,
    end_pose,
    from_end_poses,
    from_wheel_truth,
    report_gradient_descent,
)
from experiments.evaluation.metrics import CHI2_95_2DOF, ellipse_area_m2
from experiments.report.claims import Claim
from experiments.runs.row import write_frame
from experiments.runs.seeds import stream
from sim.kinematic import run_batch, wheel_commands
from sim.recording import Frame, Recording
from sim.robot import DifferentialDrive, RobotGeometry
from sim.route import TABLE_1, TICK_S, OpenLoop
from sim.sensors import Encoder, SensorSuite
from sim.simulate import Physics

Array = NDArray[np.float64]
Tables = dict[str, pd.DataFrame]
Profile = Literal["quick", "full"]

PAPER = "puzzlebot2024"
NOMINAL = DifferentialDrive(wheel_radius_m=0.05, track_m=0.19)
JUDGED_SEED = 1000  # seeds 0-99 are for tuning
RATIOS = (1.5, 0.5)  # kr and kl over k: they differ, so that one cannot pass for the other
CALIBRATION_KS = (1e-5, 1e-4, 1e-3)
COVERAGE_KS = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)
RUNS_PER_CASE = 20  # repetitions of each of the nine cases in one calibration
GEOMETRY_ERROR = 0.05  # gain and track error of the joint arm
_PHYSICS: tuple[Physics, ...] = ("bullet", "kinematic")
CHI2_95_3DOF = 7.814727903251179
FRAME_S = 0.05
LOOPS: dict[str, OpenLoop] = {
    "straight": OpenLoop(((0.5, 0.0, 6.0),)),
    "arc": OpenLoop(((0.5, 0.4, 6.0),)),
    "arc of one turn and a half": OpenLoop(((0.5, 1.5 * np.pi / 3.0, 6.0),)),
    "out and back": OpenLoop(((0.5, 0.0, 3.0), (-0.5, 0.0, 3.0))),
}


def run(profile: Profile, out: Path, on_progress: Callable[[float], None]) -> Tables:
    """Run all studies of the paper and write their tables to `out`.

    Parameters
    ----------
    profile
        `quick`: few repetitions; `full`: what the claims are judged by.
    out
        Folder of the tables.
    on_progress
        Called with the share done.
    """
    full = profile == "full"
    tables = {"areas": areas(), "crossover": crossover(20)}
    on_progress(0.05)
    tables["calibration"] = calibration(
        200 if full else 5, lambda share: on_progress(0.05 + 0.65 * share)
    )
    tables["table_1"] = table_1()
    on_progress(0.75)
    tables["coverage"] = coverage(10_000 if full else 400)
    on_progress(0.85)
    driven = engine_recordings(40 if full else 4)
    tables["engine"] = engine_ends(driven)
    tables["engine_k"] = engine_k(driven)
    tables["gradient_descent"] = gradient_descent()
    for name, frame in tables.items():
        write_frame(frame, out / f"{PAPER}_{name}.csv")
    on_progress(1.0)
    return tables


def slipping(k: float, *, geometry: bool = False) -> DifferentialDrive:
    """Return the robot with kr = 1.5 k, kl = 0.5 k, and on request 5 % gain and track errors."""
    robot = dataclasses.replace(NOMINAL, kr=RATIOS[0] * k, kl=RATIOS[1] * k)
    if geometry:
        robot = dataclasses.replace(
            robot,
            bias_right=GEOMETRY_ERROR,
            bias_left=-GEOMETRY_ERROR,
            track_m=(1.0 + GEOMETRY_ERROR) * NOMINAL.track_m,
        )
    return robot


def ideal_beliefs(
    route: OpenLoop, kr: float, kl: float, frame_s: float = FRAME_S
) -> tuple[Array, Array, Array]:
    """Stamps (T,), poses (T, 3) and covariances (T, 3, 3) that the commands alone promise."""
    commands = np.concatenate([np.zeros((1, 2)), np.cumsum(wheel_commands(NOMINAL, route), 0)])
    every = round(frame_s / TICK_S)
    rows = np.unique(np.append(np.arange(0, len(commands), every), len(commands) - 1))
    estimator = Odometry(kr, kl)
    geometry = RobotGeometry(NOMINAL.wheel_radius_m, NOMINAL.track_m)
    prior = Prior(geometry, SensorSuite(), np.zeros(3), np.zeros((3, 3)))
    estimator.reset(prior, np.random.default_rng(0))
    stamps = rows * TICK_S
    increments = np.diff(commands[rows], axis=0, prepend=commands[:1])
    lapses = np.diff(stamps, prepend=stamps[:1])
    beliefs = [
        estimator.step(Frame(float(t), float(dt), step))
        for t, dt, step in zip(stamps, lapses, increments, strict=True)
    ]
    means = np.array([belief.mean for belief in beliefs])
    return stamps, means, np.array([belief.covariance for belief in beliefs])


def areas() -> pd.DataFrame:
    """Area of the 95 % ellipse against the distance rolled, on each loop and each k."""
    parts = []
    for k in (1e-5, 1e-4):
        for name, route in LOOPS.items():
            stamps, means, covariances = ideal_beliefs(route, k, k)
            rolled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(means[:, :2], axis=0).T))])
            columns = {"distance_m": rolled, "area_m2": ellipse_area_m2(covariances)}
            parts.append(pd.DataFrame({"manoeuvre": name, "k_m": k, "stamp_s": stamps, **columns}))
    return pd.concat(parts, ignore_index=True)


def crossover(n_runs: int) -> pd.DataFrame:
    """Distance at which the heading-borne spread overtakes the translation-borne one.

    On a straight along x the filter's variance along x is borne by translation and the one along
    y by heading. The wheels' readings are noisy, so each run gives its own distance.
    """
    k = 1e-5
    route, robot = OpenLoop(((0.25, 0.0, 2.0),)), dataclasses.replace(NOMINAL, kr=k, kl=k)
    rows = []
    for run_number in range(n_runs):
        rng = stream(JUDGED_SEED + run_number, "slip")
        batch = run_batch(robot, route, 1, rng, sample_s=FRAME_S)
        estimator = Odometry(k, k)
        geometry = RobotGeometry(NOMINAL.wheel_radius_m, NOMINAL.track_m)
        prior = Prior(geometry, SensorSuite(), np.zeros(3), np.zeros((3, 3)))
        estimator.reset(prior, rng)
        increments = np.diff(batch.encoder_m[0], axis=0)
        beliefs = [
            estimator.step(Frame(float(t), float(dt), step))
            for t, dt, step in zip(batch.stamps[1:], np.diff(batch.stamps), increments, strict=True)
        ]
        sigma = np.array([belief.covariance for belief in beliefs])
        heading = np.array([belief.mean[2] for belief in beliefs])
        distance = batch.encoder_m[0, 1:].mean(axis=1)
        along, across = _along_and_across(sigma, heading)
        crossed = int(np.argmax(across > along))
        ratio = np.log(across[crossed - 1 : crossed + 1] / along[crossed - 1 : crossed + 1])
        share = -ratio[0] / (ratio[1] - ratio[0])
        at = distance[crossed - 1] + share * (distance[crossed] - distance[crossed - 1])
        rows.append({"seed": JUDGED_SEED + run_number, "crossover_m": float(at)})
    return pd.DataFrame(rows)


def _along_and_across(covariances: Array, heading: Array) -> tuple[Array, Array]:
    """Variances along and across the heading, m^2."""
    cos, sin = np.cos(heading), np.sin(heading)
    xx, yy, xy = covariances[:, 0, 0], covariances[:, 1, 1], covariances[:, 0, 1]
    along = cos**2 * xx + sin**2 * yy + 2 * cos * sin * xy
    across = sin**2 * xx + cos**2 * yy - 2 * cos * sin * xy
    return along, across


def calibrate_once(k: float, seed: int, *, geometry: bool) -> list[CalibrationResult]:
    """Calibrate by all methods on one set of runs: the nine cases, 20 times each."""
    rng = stream(seed, "slip")
    robot = slipping(k, geometry=geometry)
    batches = {
        name: run_batch(robot, route, RUNS_PER_CASE, rng, nominal_track_m=NOMINAL.track_m)
        for name, route in TABLE_1.items()
    }
    encoder, ground, turns = (
        np.concatenate([np.diff(getattr(b, n), axis=1).reshape(-1, 2) for b in batches.values()])
        if n != "poses"
        else np.concatenate([np.diff(b.poses[..., 2], axis=1).ravel() for b in batches.values()])
        for n in ("encoder_m", "ground_m", "poses")
    )
    manoeuvres = [
        Manoeuvre.of_route(TABLE_1[name], NOMINAL, batch.end_poses)
        for name, batch in batches.items()
    ]
    results = [from_wheel_truth(encoder, ground, turns, interval_s=0.05, geometry=geometry)]
    draws = stream(seed, "samples")
    for method in ("sampled", "linearised"):
        results.append(from_end_poses(manoeuvres, NOMINAL, draws, method=method, geometry=geometry))
    return results


def calibration(n_repetitions: int, on_progress: Callable[[float], None]) -> pd.DataFrame:
    """Repeat the calibration at each k, without and with gain and track errors, on both cores."""
    from joblib import Parallel, delayed

    jobs = [
        (k, geometry, JUDGED_SEED + repetition)
        for repetition in range(n_repetitions)
        for geometry in (False, True)
        for k in CALIBRATION_KS
    ]
    calls = (delayed(_calibration_rows)(*job) for job in jobs)
    rows: list[dict[str, object]] = []
    for done, part in enumerate(Parallel(n_jobs=-1, return_as="generator")(calls), start=1):
        rows += part
        on_progress(done / len(jobs))
    return pd.DataFrame(rows)


def _calibration_rows(k: float, geometry: bool, seed: int) -> list[dict[str, object]]:
    robot = slipping(k, geometry=geometry)
    rows: list[dict[str, object]] = []
    for result in calibrate_once(k, seed, geometry=geometry):
        for name in ("kr", "kl", "bias_right", "bias_left", "track_m"):
            measured = getattr(result, name)
            if measured is None:
                continue
            rows.append(
                {
                    "k_m": k,
                    "joint": geometry,
                    "seed": seed,
                    "method": result.method,
                    "parameter": name,
                    "truth": getattr(robot, name),
                    "value": measured.value,
                    "low": measured.low,
                    "high": measured.high,
                }
            )
    return rows


def table_1(k: float = 1e-4, seed: int = JUDGED_SEED) -> pd.DataFrame:
    """Table 1: what each case promises, where the robot ends, and kr, kl from that case alone."""
    rng, robot = stream(seed, "slip"), slipping(k)
    rows = []
    for name, route in TABLE_1.items():
        batch = run_batch(robot, route, RUNS_PER_CASE, rng)
        v, omega, duration = route.segments[0]
        encoder = np.diff(batch.encoder_m, axis=1).reshape(-1, 2)
        ground = np.diff(batch.ground_m, axis=1).reshape(-1, 2)
        found = from_wheel_truth(encoder, ground, interval_s=0.05, geometry=False)
        ideal, real = route.ideal_end(), batch.end_poses
        rows.append(
            {
                "case": name,
                "v_mps": v,
                "omega_radps": omega,
                "duration_s": duration,
                "ideal_x_m": ideal[0],
                "ideal_heading_rad": ideal[2],
                "real_x_mean_m": real[:, 0].mean(),
                "real_x_sd_m": real[:, 0].std(ddof=1),
                "real_y_sd_m": real[:, 1].std(ddof=1),
                "real_heading_mean_rad": real[:, 2].mean(),
                "real_heading_sd_rad": real[:, 2].std(ddof=1),
                "kr_m": found.kr.value,
                "kr_low_m": found.kr.low,
                "kr_high_m": found.kr.high,
                "kl_m": found.kl.value,
                "kl_low_m": found.kl.low,
                "kl_high_m": found.kl.high,
            }
        )
    return pd.DataFrame(rows)


def coverage(n_runs: int) -> pd.DataFrame:
    """Count true end positions in the ideal robot's 95 % ellipse, and poses in its ellipsoid."""
    rows = []
    for k in COVERAGE_KS:
        robot = slipping(k)
        for name, route in TABLE_1.items():
            rng = stream(JUDGED_SEED, f"slip/{name}/{k:g}")
            ends = run_batch(robot, route, n_runs, rng, sample_s=1.0).end_poses
            rows.append({"case": name, "k_m": k, **_inside(ends, route, robot)})
    return pd.DataFrame(rows)


def _inside(ends: Array, route: OpenLoop, robot: DifferentialDrive) -> dict[str, int]:
    """Number of runs, and of those within the ellipse and the ellipsoid."""
    _, _, covariances = ideal_beliefs(route, robot.kr, robot.kl)
    error, covariance = ends - route.ideal_end(), covariances[-1]
    flat = np.linalg.solve(covariance[:2, :2], error[:, :2].T).T
    ellipse = np.sum(error[:, :2] * flat, axis=1) <= CHI2_95_2DOF
    pose = np.linalg.solve(covariance, error.T).T
    ellipsoid = np.sum(error * pose, axis=1) <= CHI2_95_3DOF
    return {
        "runs": len(ends),
        "in_ellipse": int(ellipse.sum()),
        "in_ellipsoid": int(ellipsoid.sum()),
    }


ENGINE_K = 1e-4
Driven = dict[tuple[str, str], list[Recording]]


def engine_recordings(n_runs: int) -> Driven:
    """Recordings of some cases by (case, physics), with the same noise in either physics."""
    from sim.simulate import record
    from sim.world import World

    floor = World("open floor", np.zeros((0, 4)), np.zeros((0, 2)))
    robot = slipping(ENGINE_K)
    return {
        (case, physics): [
            record(
                floor,
                robot,
                SensorSuite(Encoder(50.0)),
                TABLE_1[case],
                {axis: stream(JUDGED_SEED + number, axis, i) for axis in ("slip", "sensors")},
                physics=physics,
                rays="exact",
            )
            for number in range(n_runs)
        ]
        for i, case in enumerate(("linear_1", "linear_3", "angular_1", "angular_5"))
        for physics in _PHYSICS
    }


def engine_ends(driven: Driven) -> pd.DataFrame:
    """End poses of PyBullet's robot beside the kinematic one's, per case and seed."""
    rows = []
    for case in dict.fromkeys(case for case, _ in driven):
        for number in range(len(driven[case, "bullet"])):
            row: dict[str, object] = {"case": case, "seed": JUDGED_SEED + number}
            for physics in _PHYSICS:
                x, y, heading = end_pose(driven[case, physics][number])
                row |= {
                    f"{physics}_x_m": x,
                    f"{physics}_y_m": y,
                    f"{physics}_heading_rad": heading,
                }
            rows.append(row)
    return pd.DataFrame(rows)


def engine_k(driven: Driven) -> pd.DataFrame:
    """Recover kr and kl from the wheels of PyBullet's robot."""
    runs = [run for (_, physics), part in driven.items() if physics == "bullet" for run in part]
    found, robot = calibrate_recordings(runs, geometry=False, interval_s=0.02), slipping(ENGINE_K)
    rows = [
        {
            "k_m": ENGINE_K,
            "parameter": name,
            "truth": getattr(robot, name),
            **dataclasses.asdict(getattr(found, name)),
        }
        for name in ("kr", "kl")
    ]
    return pd.DataFrame(rows)


def gradient_descent() -> pd.DataFrame:
    """Run the report's own procedure on its example data and on others: it goes to 1/2."""
    cases = {
        "report, kl: 2.445 to 2.347 m in 5 s": (2.445330811, 2.34674, 5.0),
        "report, kr: 2.312 to 1.064 rad in 3 s": (2.312493295, 1.06419, 3.0),
        "1 to 2 m in 2 s": (1.0, 2.0, 2.0),
        "1 to 6 m in 2 s": (1.0, 6.0, 2.0),
    }
    rows = []
    for name, (ideal, real, time_s) in cases.items():
        after_100 = report_gradient_descent(ideal, real, time_s)
        rate = (ideal - real) ** 2 / time_s**2
        steps = math.ceil(30.0 / (0.08 * rate))
        limit = report_gradient_descent(ideal, real, time_s, n_iterations=min(steps, 10**6))[-1]
        rows.append({"data": name, "k_after_100": after_100[-1], "k_in_the_end": limit})
    return pd.DataFrame(rows)


def claims(tables: Tables, *, quick: bool) -> list[Claim]:
    """Judge PB1-PB4 by the tables."""
    from experiments.papers.puzzlebot2024.claims import pb1, pb2, pb3, pb4

    judged = [
        *pb1(),
        *pb2(tables["areas"], tables["crossover"], NOMINAL.track_m),
        *pb3(tables["calibration"], tables["gradient_descent"], tables["engine_k"]),
        *pb4(tables["coverage"], tables["engine"]),
    ]
    command = "estima reproduce --paper puzzlebot2024" + ("" if quick else " --full")
    return [claim.completed(study=PAPER, command=command, quick=quick) for claim in judged]


def figures(tables: Tables) -> dict[str, Figure]:
    """Draw all figures of the paper, by file name."""
    from experiments.papers.puzzlebot2024 import figures as draw

    return {
        "puzzlebot2024_ideal_and_real": draw.ideal_and_real(),
        "puzzlebot2024_ellipse_area": draw.ellipse_area(tables["areas"], tables["crossover"]),
        "puzzlebot2024_calibration": draw.calibration(tables["calibration"]),
        "puzzlebot2024_table_1": draw.table_1(tables["table_1"]),
        "puzzlebot2024_coverage": draw.coverage(tables["coverage"]),
    }
