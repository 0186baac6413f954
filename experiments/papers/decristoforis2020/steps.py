"""Registration from scan to scan: the errors of its steps, and the shape of its ellipses."""

import functools
import itertools
import math

import numpy as np
import pandas as pd

from estimators.base import Estimate
from estimators.gaussian import STILL, Gaussian
from estimators.laser import icp_covariance
from estimators.laser.icp import DEFAULT_RULES, Metric, Rules, prepare, register
from estimators.laser.scan_matching import FAILED
from experiments.evaluation.metrics import travelled_m
from experiments.evaluation.registration_errors import resample
from experiments.evaluation.scan_bound import cast, fisher_bound
from experiments.papers.decristoforis2020.settings import APART_M, HELD_M, N_STRETCH, WINDOWS_S
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from sim import se2
from sim.arrays import Array
from sim.recording import Recording
from sim.sensors import Laser, sensor_of
from sim.worlds.world import World


def step_errors(recording: Recording, world: World, estimate: Estimate) -> Row:
    """Correlation of successive errors, their accumulation, and their size beside its bound.

    Errors are in the axes of the reference, and whitened by the registration's own covariance.
    Steps whose match is wrong, or that the walls do not constrain in some direction, are left out.

    Returns
    -------
    Row
        `correlation_lag_1` to `_5`; `nees_over_3` of one step, and of all in 1 s and 10 s as
        `accumulated_over_predicted_`; RMS `step_error_` and `step_bound_`, m and rad.
    """
    truth, laser = recording.truth_at(recording.frame_stamps), recording.sensor("laser", Laser)
    motions, true_motions = (se2.between(p[:-1], p[1:]) for p in (estimate.means, truth))
    off = motions - true_motions
    off[:, 2] = se2.wrap(off[:, 2])
    found = estimate.extras["registration_covariance"][1:]
    use = np.array([i for i, C in enumerate(found) if C is not None])
    R = np.array([found[i] for i in use])
    white = np.linalg.solve(np.linalg.cholesky(R), off[use][:, :, None])[:, :, 0]
    sound = np.sum(white**2, axis=1) < 30.0  # a wrong match would dominate the correlations
    sound &= R[:, 0, 0] + R[:, 1, 1] < HELD_M**2  # and so would a guess in a free direction
    row: Row = {}
    for lag in range(1, 6):
        both = sound[lag:] & sound[:-lag] & (use[lag:] - use[:-lag] == lag)
        product = np.sum(white[lag:][both] * white[:-lag][both])
        row[f"correlation_lag_{lag}"] = float(product / np.sum(white[:-lag][both] ** 2))
    row["nees_over_3"] = float(np.mean(np.sum(white[sound] ** 2, axis=1)) / 3.0)
    steps = {int(i): Gaussian(motions[i], C) for i, C in zip(use[sound], R[sound], strict=True)}
    for window_s in WINDOWS_S:
        n = round(window_s * laser.rate_hz)
        row[f"accumulated_over_predicted_{window_s:g}s"] = _accumulated(steps, truth, n)
    chosen = use[sound][:: max(1, int(sound.sum()) // 40)]
    scanned = se2.compose(truth, laser.mount.pose)
    noise = laser.bearings_rad, laser.sigma_range_m, laser.max_range_m
    bounds = np.array(
        [fisher_bound(world.walls, scanned[i], scanned[i + 1], *noise) for i in chosen]
    )
    return row | {
        "step_error_m": float(np.sqrt(np.mean(np.sum(off[chosen, :2] ** 2, axis=1)))),
        "step_bound_m": float(np.sqrt(np.mean(bounds[:, 0, 0] + bounds[:, 1, 1]))),
        "step_error_rad": float(np.sqrt(np.mean(off[chosen, 2] ** 2))),
        "step_bound_rad": float(np.sqrt(np.mean(bounds[:, 2, 2]))),
    }


def _accumulated(steps: dict[int, Gaussian], truth: Array, n: int) -> float:
    """NEES over 3 of n successive steps composed, each taken as independent of the others."""
    values = []
    for first in range(0, len(truth) - n, n):
        window = range(first, first + n)
        if not all(i in steps for i in window):
            continue
        total = functools.reduce(Gaussian.then, (steps[i] for i in window), STILL)
        off = total.mean - se2.between(truth[first], truth[first + n])
        off[2] = se2.wrap(off[2])
        values.append(float(off @ np.linalg.solve(total.covariance, off)) / 3.0)
    return float(np.mean(values)) if values else math.nan


def ellipse_path(
    recording: Recording,
    world: World,
    metric: Metric,
    scans: icp_covariance.Scans,
    neighbours: int = DEFAULT_RULES.neighbours,
) -> pd.DataFrame:
    """Ellipse of each registration of successive scans, in the axes of the map, along the path.

    Covariances are those of eqs. (6)-(8) as they stand: also along a direction that the scans hold
    badly or not at all, where an estimator would take the wheels' instead. Registrations start
    from the true motion, so that they differ in nothing but the scans.

    Returns
    -------
    DataFrame
        One row per registration: `distance_m` driven, `place`, true pose; covariance `xx_m2`,
        `xy_m2`, `yy_m2`; standard deviations along the axes `long_m`, `short_m`, and the
        `direction_rad` of the long one; `degenerate`: whether the scans hold too little.
    """
    laser, log = recording.sensor("laser", Laser), recording.logs["laser"]
    truth = recording.truth_at(log.stamps)
    mount, sigma_m = laser.mount.pose, laser.sigma_range_m
    motions = se2.between(*(se2.compose(poses, mount) for poses in (truth[:-1], truth[1:])))
    prepared = [prepare(r, laser.bearings_rad, laser.max_range_m) for r in log["ranges_m"]]
    rules, rows = Rules(neighbours=neighbours), []
    for i, (target, source) in enumerate(itertools.pairwise(prepared), 1):
        found = register(source, target, motions[i - 1], metric=metric, rules=rules)
        if found.status in FAILED:
            continue
        R = icp_covariance.censi(found, source, target, sigma_m, scans=scans, everywhere=True)
        step, _ = Gaussian(found.T_target_source, R).in_sensor(se2.inverse(mount))
        rows.append((i, found.status == "degenerate", step.covariance[:2, :2]))
    use, degenerate, in_base = (np.array(column) for column in zip(*rows, strict=True))
    cos, sin = np.cos(truth[use - 1, 2]), np.sin(truth[use - 1, 2])
    R = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    in_map = R @ in_base @ R.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(in_map)
    return pd.DataFrame(
        {
            "distance_m": travelled_m(truth)[use],
            "place": world.place_of(truth[use, :2]),
            "x_m": truth[use, 0],
            "y_m": truth[use, 1],
            "heading_rad": truth[use, 2],
            "xx_m2": in_map[:, 0, 0],
            "xy_m2": in_map[:, 0, 1],
            "yy_m2": in_map[:, 1, 1],
            "long_m": np.sqrt(values[:, 1]),
            "short_m": np.sqrt(values[:, 0]),
            "direction_rad": np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]),
            "degenerate": degenerate,
        }
    )


def stretch_axes(experiment: Experiment, rng: np.random.Generator) -> Row:
    """Median long axis of the ellipses on the bare stretch and near the objects of a corridor, m.

    Pairs of scans are taken along the middle of the way, without a drive.
    """
    laser, world = sensor_of(experiment.sensors(), "laser", Laser), experiment.world()
    believed, row = experiment.options_of("estimator"), Row()
    path = resample(world.waypoints, APART_M)
    places = world.place_of(path[:, :2])
    for name in ("bare", "objects"):
        inside = np.flatnonzero(places == f"corridor_{name}")[:-1]
        use = inside[np.linspace(0, len(inside) - 1, N_STRETCH).astype(int)]
        axes = []
        for k in use:
            poses = se2.compose(path[[k, k + 1]], laser.mount.pose)
            ranges = [cast(world.walls, pose, laser.bearings_rad)[0] for pose in poses]
            target, source = (
                prepare(laser.measure(r, rng), laser.bearings_rad, laser.max_range_m)
                for r in ranges
            )
            rules = Rules(neighbours=believed["neighbours"])
            motion = se2.between(*poses)
            found = register(source, target, motion, metric=believed["metric"], rules=rules)
            if found.status not in FAILED:
                sigma_m = laser.sigma_range_m
                R = icp_covariance.censi(
                    found, source, target, sigma_m, scans="last", everywhere=True
                )
                step, _ = Gaussian(found.T_target_source, R).in_sensor(
                    se2.inverse(laser.mount.pose)
                )
                axes.append(math.sqrt(np.linalg.eigvalsh(step.covariance[:2, :2])[1]))
        row[f"long_{name}_m"] = float(np.median(axes)) if axes else math.nan
    return row


def ellipse_summary(path: pd.DataFrame) -> Row:
    """What DC2 and DC3 ask of the ellipses along one path.

    A bend is compared with the bare legs before and after it, without their last 3 m.
    """
    bare, objects = (path[path["place"] == f"corridor_{name}"] for name in ("bare", "objects"))
    tilt = np.abs(np.remainder(bare["direction_rad"] + math.pi / 2.0, math.pi) - math.pi / 2.0)
    row: Row = {
        "axis_ratio_bare": float((bare["long_m"] / bare["short_m"]).median()),
        "tilt_bare_deg": float(np.degrees(tilt.median())),
        "long_bare_m": float(bare["long_m"].median()),
        "long_objects_m": float(objects["long_m"].median()),
        "degenerate_bare": float(bare["degenerate"].mean()),
    }
    for bend, legs in (("curve", ("leg_2", "leg_3")), ("corner", ("leg_1", "leg_2"))):
        inside, before, after = (path[path["place"] == place] for place in (bend, *legs))
        smooth = inside["long_m"].rolling(5, center=True, min_periods=1).median()
        # the mean direction of axes, which are the same when they are turned by pi
        straight = 0.5 * np.angle(np.mean(np.exp(2j * before["direction_rad"])))
        turned = inside["direction_rad"][smooth.idxmax()] - straight if len(inside) else math.nan
        row |= {
            f"long_before_{bend}_m": float(before["long_m"].median()),
            f"long_in_{bend}_m": float(smooth.max()),
            f"long_median_in_{bend}_m": float(inside["long_m"].median()),
            f"long_after_{bend}_m": float(after["long_m"].median()),
            f"turned_in_{bend}_deg": math.degrees(abs(math.remainder(turned, math.pi))),
        }
    return row
