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
from experiments.papers.decristoforis2020.settings import PLACES, WRONG_M
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from sim.sensors import Laser, sensor_of


def covariances_of(seed: int, place: str, n_repeats: int, *overrides: str, **how: Any) -> Tables:
    """Many registrations of one pair of poses in a place, and all covariances of them.

    Parameters
    ----------
    how
        Metrics and rules, as for `measure`.
    """
    study, part = PLACES[place]
    given = [f"study=decristoforis2020/{study}", f"seed={seed}", *overrides]
    experiment = Experiment.compose(given)
    laser = sensor_of(experiment.sensors(), "laser", Laser)
    rng = stream(seed, f"scenes/{place}")
    (scene,) = sample_scenes(experiment.world(), part, laser.mount.pose, rng, 1)
    found = measure(scene, laser, rng, n_repeats, max(2, n_repeats // 4), **how)
    return {"covariances": found.assign(seed=seed, place=place)}


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
    """How far off each covariance is, as a factor, and its time."""
    given = {"metrics": [values["estimator.metric"]]}
    rules = Rules(neighbours=int(values["estimator.neighbours"]))
    sigma = f"sensors.laser.sigma_range_m={values['sensors.laser.sigma_range_m']}"
    made = covariances_of(seed, values["place"], n_repeats, sigma, rules=rules, **given)
    methods = ("hessian_points", "censi_last", "sampling")
    columns = ["method", "nees_over_dof", "time_us"]
    # NaN if no pair registers
    rows = pd.DataFrame(made["covariances"], columns=columns).set_index("method").reindex(methods)
    return {
        f"{method}_{key}": float(np.exp(abs(np.log(value)))) if key == "off" else float(value)
        for method in methods
        for key, value in (
            ("off", rows.loc[method, "nees_over_dof"]), ("time_us", rows.loc[method, "time_us"])
        )
    }  # fmt: skip
