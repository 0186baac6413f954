"""The studies of puzzlebot2024: covariance, calibration of kr and kl, coverage of the ellipse.

Thousands of runs come from the kinematic robot, which obeys the same slip law as PyBullet's; some
are driven by PyBullet too, and both are compared.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from estimators.base import Estimate, Prior
from estimators.odometry import Odometry
from experiments.calibration.calibrate import calibrate_recordings, end_pose, from_wheel_truth
from experiments.calibration.end_poses import Manoeuvre, from_end_poses
from experiments.calibration.result import CalibrationResult
from experiments.evaluation.metrics import ellipse_area_m2, travelled_m
from experiments.judging.jobs import Progress, Tables, tables_of
from experiments.judging.remake import Cells, Remake, agrees, whole
from experiments.judging.results import Profile, Results
from experiments.papers.puzzlebot2024.descent import (
    convergence,
    from_nine_runs,
    gradient_descent,
)
from experiments.papers.puzzlebot2024.ends import count_inside, ends_without_lag
from experiments.papers.puzzlebot2024.settings import (
    AREA_K_M,
    CALIBRATION_RUNS,
    CALIBRATIONS,
    CLOSE_K_M,
    COVERAGE_RUNS,
    FEW_RUNS,
    FEW_SEEDS,
    LOOPS,
    N_CASES,
    NOMINAL,
    SQUARE_RUNS,
    SQUARE_SAMPLES,
    TABLE_1_K_M,
)
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.sweeps.plan import plan_experiments
from sim.arrays import Array
from sim.recording import Recording, WheelLog
from sim.robot.drive import DifferentialDrive, RobotGeometry
from sim.robot.kinematic import BatchRuns, run_batch
from sim.routes.route import OpenLoop

Routes = Mapping[str, OpenLoop]
Driven = dict[tuple[str, str, int], Recording]  # keyed by physics, case and seed


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run all studies of the paper, and write their tables and arrays.

    Parameters
    ----------
    profile
        `quick`: few repetitions; `full`: those that the claims are judged on.
    """
    out.write_tables(areas=areas(), crossover=crossover(), gradient_descent=gradient_descent())
    out.write_tables(convergence=convergence())
    out.write_arrays("drawn", **drawn())
    calibrated = calibration(
        arms("calibration"), CALIBRATIONS[profile], lambda share: on_progress(0.05 + 0.65 * share)
    )
    covered = arms("coverage")
    once = table_1(next(arm for arm in covered if arm.k_m == TABLE_1_K_M))
    out.write_tables(calibration=calibrated, table_1=once)
    ends, found = short_turns(*arms("short_turns"))
    out.write_tables(short_turns=ends, short_turns_found=found)
    out.write_tables(coverage=coverage(covered, COVERAGE_RUNS[profile]))
    on_progress(0.8)
    ends, paths = square_feedback(*FEW_SEEDS[profile])
    out.write_tables(square_feedback=ends)
    out.write_arrays("square_feedback", **paths)
    on_progress(0.9)
    driven = engine_recordings(*FEW_SEEDS[profile])
    out.write_tables(engine=engine_ends(driven), engine_k=engine_k(driven))
    on_progress(1.0)


REMADE = {
    "areas": 0.2,
    "calibration": 0.2,
    "convergence": 0.1,
    "coverage": 2.0,
    "crossover": 0.4,
    "engine": 1.5,
    "gradient_descent": 0.5,
    "short_turns": 3.0,
    "short_turns_found": 3.0,
    "square_feedback": 3.0,
    "table_1": 0.5,
}  # not engine_k, which comes from all drives at once


def remake(table: str, row: Cells) -> Remake:
    """The call that makes a row again."""
    sets = {"areas": areas, "gradient_descent": gradient_descent, "convergence": convergence}
    if table in sets:
        return whole, (table, sets[table])
    makers = {"crossover": crossover, "engine": _engine_table, "square_feedback": _square_table}
    if table in makers:
        return whole, (table, makers[table], f"seed={row['seed']:.0f}")
    if table in ("short_turns", "short_turns_found"):
        return _short_turns_tables, ()
    found = "coverage" if table == "table_1" else table
    k_m = {"k_m": TABLE_1_K_M, **row}
    arm = next(a for a in arms(found) if agrees(k_m, {"k_m": a.k_m, "joint": a.joint}))
    if table == "table_1":
        return whole, (table, table_1, arm)
    if table == "calibration":
        return _calibration_rows, (dataclasses.replace(arm, seed=int(row["seed"])),)
    one = dataclasses.replace(arm, routes={row["case"]: arm.routes[row["case"]]})
    return whole, (table, coverage, [one], COVERAGE_RUNS[Profile.FULL])


def _engine_table(*overrides: str) -> pd.DataFrame:
    return engine_ends(engine_recordings(*overrides))


def _square_table(*overrides: str) -> pd.DataFrame:
    return square_feedback(*overrides)[0]


def _short_turns_tables() -> Tables:
    ends, found = short_turns(*arms("short_turns"))
    return {"short_turns": ends, "short_turns_found": found}


@dataclass(frozen=True)
class Arm:
    """A robot that drives several manoeuvres, all from one seed.

    Attributes
    ----------
    routes
        The manoeuvres by name.
    """

    seed: int
    robot: DifferentialDrive
    routes: Routes

    @property
    def k_m(self) -> float:
        """The k of kr = 1.5 k and kl = 0.5 k, m."""
        return 2.0 * self.robot.kl

    @property
    def joint(self) -> bool:
        """Whether the robot's gains and track are off too, and are estimated."""
        return bool(self.robot.slip_bias.any())


@functools.cache
def arms(study: str) -> list[Arm]:
    """All robots of a study, each with all manoeuvres."""
    runs = plan_experiments([f"study=puzzlebot2024/{study}"])
    return [
        Arm(seed, robot, {part.choices["route"]: part.route() for part in parts})
        for (seed, robot), parts in itertools.groupby(runs, lambda run: (run.seed, run.robot()))
    ]


def ideal(route: OpenLoop, kr: float, kl: float) -> Estimate:
    """Dead reckoning by the commands alone, of a robot that does not slip."""
    return dead_reckoning(run_batch(NOMINAL, route, 1, np.random.default_rng(0)), kr, kl)


def dead_reckoning(batch: BatchRuns, kr: float, kl: float) -> Estimate:
    """Odometry from the origin over the first run, with the nominal geometry."""
    geometry = RobotGeometry(NOMINAL.wheel_radius_m, NOMINAL.track_m)
    recording = Recording(batch.stamps, WheelLog(batch.stamps, batch.encoder_m[0]), geometry)
    prior = Prior(geometry, mean=np.zeros(3), covariance=np.zeros((3, 3)))
    return run_over(recording, Odometry(kr=kr, kl=kl), prior, np.random.default_rng(0))[0]


def areas() -> pd.DataFrame:
    """Area of the 95 % ellipse against the distance rolled, on each loop and each k."""

    def table(name: str, k: float) -> pd.DataFrame:
        promised = ideal(LOOPS[name], k, k)
        return pd.DataFrame(
            {
                "manoeuvre": name,
                "k_m": k,
                "stamp_s": promised.stamps,
                "distance_m": travelled_m(promised.means),
                "area_m2": ellipse_area_m2(promised.covariances),
            }
        )

    return pd.concat([table(name, k) for k in AREA_K_M for name in LOOPS], ignore_index=True)


def crossover(*overrides: str) -> pd.DataFrame:
    """Distance at which the heading-borne spread overtakes the translation-borne one.

    On a straight along x the variance along x comes from translation, and the one along y from
    the heading. The encoders are noisy, so each run gives its own distance.
    """
    rows = []
    for experiment in plan_experiments(["study=puzzlebot2024/crossover", *overrides]):
        robot = experiment.robot()
        batch = run_batch(robot, experiment.route(), 1, stream(experiment.seed, "slip"))
        believed = dead_reckoning(batch, robot.kr, robot.kl)
        heading = believed.means[1:, 2]
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        sigma = believed.covariances[1:, :2, :2]
        along, across = (np.einsum("ti,tij,tj->t", u, sigma, u) for u in (ahead, left))
        distance, ratio = batch.encoder_m[0, 1:].mean(axis=1), across / along
        crossed = int(np.argmax(ratio > 1.0))
        around = slice(crossed - 1, crossed + 1)  # interpolated in the ratio's logarithm
        crossover_m = float(np.interp(0.0, np.log(ratio[around]), distance[around]))
        rows.append({"seed": experiment.seed, "crossover_m": crossover_m})
    return pd.DataFrame(rows)


def drawn() -> dict[str, NDArray[np.float32]]:
    """Real robots around the square, the ideal one's ellipses; and its spread on the straight.

    Returns
    -------
    dict
        `real_m` (2, n, T, 2) and `covariances_m2` (2, T, 2, 2) for each `kr_kl_m` (2, 2), `ideal_m`
        (T, 2); `distance_m` (T,) and `sigma_m` (T, 2) along and across the way of the crossover.
    """
    robots = arms("square")
    route = robots[0].routes["open_loop"]
    real = [
        run_batch(arm.robot, route, SQUARE_RUNS, stream(arm.seed, "slip"), sample_s=0.1).poses
        for arm in robots
    ]
    ellipses = [ideal(route, arm.robot.kr, arm.robot.kl) for arm in robots]
    straight = Experiment.compose(["study=puzzlebot2024/crossover"])
    promised = ideal(straight.route(), straight.robot().kr, straight.robot().kl)
    values = {
        "kr_kl_m": [arm.robot.slip_variance_per_m for arm in robots],
        "real_m": np.array(real)[..., :2],
        "ideal_m": ellipses[0].means[:, :2],
        "covariances_m2": [each.covariances[:, :2, :2] for each in ellipses],
        "distance_m": promised.means[:, 0],
        "sigma_m": np.sqrt(np.diagonal(promised.covariances, axis1=1, axis2=2)[:, :2]),
    }
    return {name: np.asarray(value, np.float32) for name, value in values.items()}


def square_feedback(*overrides: str) -> tuple[pd.DataFrame, dict[str, NDArray[np.float32]]]:
    """Drive the square steered by the true pose and by odometry, with each robot.

    Returns
    -------
    table
        A row each run: how far the robot ends from the last corner, by its true pose and by its
        odometry, and the error of the odometry there.
    paths
        `wanted_m` (5, 2), the start and the corners; `true_m` and `believed_m` (N, T, 2), in the
        order of the rows.
    """
    rows: list[Row] = []
    paths: dict[str, list[Array]] = {"true_m": [], "believed_m": []}
    for experiment in plan_experiments(["study=puzzlebot2024/square_feedback", *overrides]):
        route, recording = experiment.route(), experiment.simulate()
        prior, rng = experiment.prior(recording), np.random.default_rng(0)
        online, _ = run_over(recording, experiment.estimator(), prior, rng)
        believed = online.means[:, :2]
        stamps = recording.frame_stamps
        true = recording.truth_at(stamps)[:, :2]
        corner = np.array(route.points[-1])
        row = {
            "robot": experiment.choices["robot"],
            "feedback": route.feedback,
            "seed": experiment.seed,
            "status": recording.status,
            "true_end_m": np.hypot(*(true[-1] - corner)),
            "believed_end_m": np.hypot(*(believed[-1] - corner)),
            "odometry_error_m": np.hypot(*(believed[-1] - true[-1])),
        }
        rows.append(row)
        sampled_s = np.linspace(stamps[0], stamps[-1], SQUARE_SAMPLES)
        for name, path in (("true_m", true), ("believed_m", believed)):
            paths[name].append(np.stack([np.interp(sampled_s, stamps, c) for c in path.T], axis=1))
    arrays = {"wanted_m": [(0.0, 0.0), *route.points], **paths}
    return pd.DataFrame(rows), {k: np.asarray(v, np.float32) for k, v in arrays.items()}


def calibrate_once(arm: Arm, n_runs: int = CALIBRATION_RUNS) -> list[CalibrationResult]:
    """Calibrate by all methods on the same runs: each manoeuvre so many times."""
    rng, draws = stream(arm.seed, "slip"), stream(arm.seed, "samples")
    batches = [run_batch(arm.robot, route, n_runs, rng) for route in arm.routes.values()]
    manoeuvres = [
        Manoeuvre(route.profile(NOMINAL), batch.end_poses)
        for route, batch in zip(arm.routes.values(), batches, strict=True)
    ]
    return [
        from_batches(batches, geometry=arm.joint),
        from_end_poses(manoeuvres, NOMINAL, draws, method="sampled", geometry=arm.joint),
        from_end_poses(manoeuvres, NOMINAL, draws, method="linearised", geometry=arm.joint),
    ]


def from_batches(batches: list[BatchRuns], *, geometry: bool) -> CalibrationResult:
    """Calibrate by the wheel truth of many runs."""
    encoder = np.concatenate([np.diff(b.encoder_m, axis=1).reshape(-1, 2) for b in batches])
    ground = np.concatenate([np.diff(b.ground_m, axis=1).reshape(-1, 2) for b in batches])
    turns = np.concatenate([np.diff(b.poses[..., 2], axis=1).ravel() for b in batches])
    return from_wheel_truth(encoder, ground, turns, interval_s=0.05, geometry=geometry)


def calibration(robots: list[Arm], n_repetitions: int, on_progress: Progress) -> pd.DataFrame:
    """Repeat the calibration of each robot, on all cores."""
    repeated = [
        [dataclasses.replace(arm, seed=arm.seed + repetition)]
        for repetition in range(n_repetitions)
        for arm in robots
    ]
    return tables_of(_calibration_rows, repeated, on_progress)["calibration"]


def _calibration_rows(arm: Arm) -> Tables:
    run: Row = {"k_m": arm.k_m, "joint": arm.joint, "seed": arm.seed}
    results = [(CALIBRATION_RUNS, one) for one in calibrate_once(arm)]
    if not arm.joint:
        results += [(FEW_RUNS, one) for one in calibrate_once(arm, FEW_RUNS)]
    parts = [
        {**run, "runs": N_CASES * n, "method": one.method, **row}
        for n, one in results
        for row in _found(one, arm.robot)
    ]
    own = [] if arm.joint else [*from_nine_runs(arm.robot, arm.routes, arm.seed)]
    return {"calibration": parts + [{**run, **row} for row in own]}


def _found(result: CalibrationResult, robot: DifferentialDrive) -> list[Row]:
    """A row for each parameter that was found: its truth, value and interval."""
    return [
        {"parameter": name, "truth": getattr(robot, name), **dataclasses.asdict(interval)}
        for name, interval in result.found.items()
    ]


def table_1(arm: Arm) -> pd.DataFrame:
    """Table 1: each case's ideal and real ends, and kr and kl from that case alone."""
    rng = stream(arm.seed, "slip")
    rows = []
    for name, route in arm.routes.items():
        batch = run_batch(arm.robot, route, CALIBRATION_RUNS, rng)
        found = from_batches([batch], geometry=False).found
        gains = {
            f"{wheel}{end and '_' + end}_m": getattr(found[wheel], end or "value")
            for wheel in ("kr", "kl")
            for end in ("", "low", "high")
        }
        rows.append(_case(name, route) | _spread("real", batch.end_poses) | gains)
    return pd.DataFrame(rows)


def short_turns(arm: Arm) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Table 1 by a robot whose controller has a wrong track; calibrated, and driven again.

    Returns
    -------
    ends
        A row each case: ideal and real ends, and the ends when the controller takes the track that
        was found (`calibrated`).
    found
        Wheel gains, track, kr and kl by the sampled likelihood of the first ends alone, with the
        truth and with what the controller took.
    """
    rng, robot = stream(arm.seed, "slip"), arm.robot
    nominal = DifferentialDrive(
        wheel_radius_m=robot.nominal.wheel_radius_m, track_m=robot.nominal.track_m
    )
    before = {
        name: run_batch(robot, route, CALIBRATION_RUNS, rng).end_poses
        for name, route in arm.routes.items()
    }
    manoeuvres = [Manoeuvre(arm.routes[name].profile(robot), ends) for name, ends in before.items()]
    result = from_end_poses(manoeuvres, nominal, stream(arm.seed, "samples"), geometry=True)
    mended = dataclasses.replace(robot, nominal_track_m=result.found["track_m"].value)
    ends = [
        {
            **_case(name, route),
            **_spread("real", before[name]),
            **_spread("calibrated", run_batch(mended, route, CALIBRATION_RUNS, rng).end_poses),
        }
        for name, route in arm.routes.items()
    ]
    found = pd.DataFrame(_found(result, robot))
    found.insert(2, "nominal", [getattr(nominal, name) for name in result.found])
    return pd.DataFrame(ends), found


def _case(name: str, route: OpenLoop) -> Row:
    """Command of a case of table 1, and the end that it promises."""
    v, omega, duration_s = route.segments[0]
    x_m, _, heading_rad = route.ideal_end()
    return {
        "case": name,
        "v_mps": v,
        "omega_radps": omega,
        "duration_s": duration_s,
        "ideal_x_m": x_m,
        "ideal_heading_rad": heading_rad,
    }


def _spread(who: str, ends: Array) -> Row:
    """Mean and standard deviation of end poses (n, 3)."""
    mean, spread = ends.mean(axis=0), ends.std(axis=0, ddof=1)
    return {
        f"{who}_x_mean_m": mean[0],
        f"{who}_x_sd_m": spread[0],
        f"{who}_y_sd_m": spread[1],
        f"{who}_heading_mean_rad": mean[2],
        f"{who}_heading_sd_rad": spread[2],
    }


def coverage(robots: list[Arm], n_runs: int) -> pd.DataFrame:
    """Count true end positions in the ideal robot's 95 % ellipse, and poses in its ellipsoid.

    At `CLOSE_K_M` there are ten times as many runs, in batches of `n_runs`. The slip acts with the
    lag of its wheel's loop, and, beside it, at once, as the report's model has it.
    """
    rows: list[Row] = []
    for arm in robots:
        n_batches = 10 if math.isclose(arm.k_m, CLOSE_K_M) else 1
        for name, route in arm.routes.items():
            rng = stream(arm.seed, f"slip/{name}/{arm.k_m:g}")
            batches = (
                run_batch(arm.robot, route, n_runs, rng, sample_s=1.0) for _ in range(n_batches)
            )
            ends = np.concatenate([batch.end_poses for batch in batches])
            covariance = ideal(route, arm.robot.kr, arm.robot.kl).covariances[-1]
            at_once = ends_without_lag(arm.robot, route, n_runs, rng)[:, :2]
            error, direct = ends - route.ideal_end(), at_once - route.ideal_end()[:2]
            rows.append(
                {
                    "case": name,
                    "k_m": arm.k_m,
                    "runs": len(ends),
                    "in_ellipse": count_inside(error[:, :2], covariance[:2, :2]),
                    "in_ellipsoid": count_inside(error, covariance),
                    "runs_without_lag": n_runs,
                    "in_ellipse_without_lag": count_inside(direct, covariance[:2, :2]),
                }
            )
    return pd.DataFrame(rows)


def engine_recordings(*overrides: str) -> Driven:
    """Drive some manoeuvres by PyBullet's robot and by the kinematic one, with the same noise."""
    driven: Driven = {}
    for physics in ("bullet", "kinematic"):
        study = ["study=puzzlebot2024/engine", f"simulation.physics={physics}", *overrides]
        cases: dict[str, int] = {}
        for run in plan_experiments(study):
            case = run.choices["route"]
            i = cases.setdefault(case, len(cases))
            streams = {axis: stream(run.seed, axis, i) for axis in ("slip", "sensors")}
            driven[physics, case, run.seed] = run.simulate(streams=streams)
    return driven


def engine_ends(driven: Driven) -> pd.DataFrame:
    """End poses of PyBullet's robot beside the kinematic one's, per case and seed."""
    names = ["x_m", "y_m", "heading_rad"]
    cases = pd.MultiIndex.from_tuples(driven)
    ends = pd.DataFrame([end_pose(run) for run in driven.values()], cases, names)
    sides = [ends.loc[physics].add_prefix(f"{physics}_") for physics in ("bullet", "kinematic")]
    return pd.concat(sides, axis=1).rename_axis(["case", "seed"]).reset_index()


def engine_k(driven: Driven) -> pd.DataFrame:
    """Recover kr and kl from the wheels of PyBullet's robot."""
    runs = [recording for (physics, *_), recording in driven.items() if physics == "bullet"]
    found = calibrate_recordings(runs, geometry=False, interval_s=0.02)
    robot = Experiment.compose(["study=puzzlebot2024/engine"]).robot()
    return pd.DataFrame([{"k_m": 2.0 * robot.kl, **row} for row in _found(found, robot)])
