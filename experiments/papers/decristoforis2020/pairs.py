"""Pairs of scans: errors of many registrations against their covariances, and metrics compared."""

import math
import timeit
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from estimators.laser.icp import Rules, prepare, register
from estimators.laser.scan_matching import FAILED
from experiments.bench.icp import BEARINGS_RAD, pair
from experiments.evaluation.registration_errors import METRICS, measure, sample_scenes
from experiments.judging.jobs import Tables
from experiments.papers.decristoforis2020.settings import N_TIMED, PLACES, PRINTED, WRONG_M
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from sim.sensors import Laser, sensor_of


def covariances_of(
    seed: int,
    place: str,
    n_repeats: int,
    *overrides: str,
    n_sampled: int | None = None,
    **how: Any,
) -> Tables:
    """Many registrations of one pair of poses in a place, and all covariances of them.

    Parameters
    ----------
    n_sampled
        As for `measure`; None for a quarter of the repeats.
    how
        Metrics, rules and methods, as for `measure`.
    """
    study, part = PLACES[place]
    given = [f"study=decristoforis2020/{study}", f"seed={seed}", *overrides]
    experiment = Experiment.compose(given)
    laser = sensor_of(experiment.sensors(), "laser", Laser)
    rng = stream(seed, f"scenes/{place}")
    (scene,) = sample_scenes(experiment.world(), part, laser.mount.pose, rng, 1)
    n_sampled = n_sampled or max(2, n_repeats // 4)
    found = measure(scene, laser, rng, n_repeats, n_sampled, **how)
    return {"covariances": found.assign(seed=seed, place=place)}


def closed_form_of(seed: int, n_repeats: int) -> Tables:
    """What DC4 compares, in all places of a world."""
    parts = [
        covariances_of(seed, place, n_repeats, n_sampled=N_TIMED, **_COMPARED)["covariances"]
        for place in PLACES
    ]
    return {"closed_form": pd.concat(map(pd.DataFrame, parts), ignore_index=True)}


_COMPARED: dict[str, Any] = {"metrics": ["point_to_plane"], "methods": PRINTED}


def metrics_of(seed: int, kind: str, rules: Rules) -> Tables:
    """All metrics on one of the benchmark's pairs: error and time, without an initial guess."""
    place, size = kind.split("_")
    p = pair(place, size, seed)
    target, source = (prepare(r, BEARINGS_RAD) for r in (p.target_m, p.source_m))
    rows = []
    for metric in METRICS:
        match = partial(register, source, target, metric=metric, rules=rules)
        found = match()
        off = found.T_target_source - p.T_target_source
        rows.append(
            {
                "seed": seed,
                "class": kind,
                "metric": metric,
                "error_m": float(np.hypot(off[0], off[1])),
                "error_rad": abs(math.remainder(off[2], 2.0 * math.pi)),
                "time_us": 1e6 * min(timeit.repeat(match, number=1, repeat=3)),
                "bound_m": math.sqrt(p.bound[0, 0] + p.bound[1, 1]),
                "failed": found.status in FAILED or math.hypot(off[0], off[1]) > WRONG_M,
            }
        )
    return {"metrics": rows}


def covariance_levels(values: Mapping[str, Any], seed: int, n_repeats: int) -> Row:
    """How far off each covariance is, as a factor over all places of a world, and its time."""
    how = _COMPARED | {"metrics": [values["estimator.metric"]]}
    how["rules"] = Rules(neighbours=int(values["estimator.neighbours"]))
    sigma = f"sensors.laser.sigma_range_m={values['sensors.laser.sigma_range_m']}"
    parts = [
        covariances_of(seed, place, n_repeats, sigma, n_sampled=N_TIMED, **how)["covariances"]
        for place in PLACES
    ]
    # a place in which no pair registers has no row
    columns = ["method", "nees_over_dof", "time_us"]
    rows = pd.concat(pd.DataFrame(part, columns=columns) for part in parts).groupby("method")
    off = rows["nees_over_dof"].agg(lambda nees: np.exp(np.log(nees).abs().mean()))
    times = rows["time_us"].median()
    return {
        f"{method}_{key}": float(found.get(method, math.nan))
        for method in PRINTED
        for key, found in (("off", off), ("time_us", times))
    }
