"""The report's own calibration by gradient descent, which returns 1/2 whatever the data."""

import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from experiments.papers.puzzlebot2024.settings import DESCENTS, N_CASES, REPORTS
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.robot.drive import DifferentialDrive
from sim.robot.kinematic import run_batch
from sim.routes.route import OpenLoop


def report_gradient_descent(
    final_ideal: float,
    final_real: ArrayLike,
    time_s: float,
    *,
    rate: float = 0.01,
    n_iterations: int = 100,
) -> Array:
    """The report's own calibration, kept to show what it returns; it does not estimate kr or kl.

    It fits k so that (k + k) v comes near v by gradient descent from k = 1; v is the deviation of
    the end over the time. The data cancel: the minimum is 1/2 whatever they are, and they only set
    how fast the descent gets there, (1 - 8 rate mean(v^2)) a step.

    Parameters
    ----------
    final_ideal, final_real
        Promised and real end positions (n,), m or rad.
    time_s
        Duration, s.

    Returns
    -------
    Array
        (n_iterations + 1,) values of k, the first one 1.
    """
    v = (np.atleast_1d(np.asarray(final_real, float)) - final_ideal) / time_s
    slope = float(np.mean(v**2))
    k = np.ones(n_iterations + 1)
    for i in range(n_iterations):
        k[i + 1] = k[i] - rate * 4.0 * (2.0 * k[i] - 1.0) * slope
    return k


def gradient_descent() -> pd.DataFrame:
    """Run the report's own procedure on its example data and on others: it converges to 1/2."""
    rows = []
    for name, (ideal, real, time_s) in DESCENTS.items():
        last = min(math.ceil(30.0 / (0.08 * (ideal - real) ** 2 / time_s**2)), 10**6)
        k = report_gradient_descent(ideal, real, time_s, n_iterations=max(100, last))
        rows.append({"data": name, "k_after_100": k[100], "k_in_the_end": k[last]})
    return pd.DataFrame(rows)


def convergence() -> pd.DataFrame:
    """The 100 iterations that the report plots, on its example data, from the start on.

    Returns
    -------
    pandas.DataFrame
        `data`, `iteration`, `k`, and the `error` that is minimised, (2 k v - v)^2 with v in m/s or
        rad/s.
    """
    parts = []
    for name in itertools.islice(DESCENTS, 2):
        ideal, real, time_s = DESCENTS[name]
        k = report_gradient_descent(ideal, real, time_s)
        error = ((2.0 * k - 1.0) * (real - ideal) / time_s) ** 2
        columns = {"data": name, "iteration": np.arange(len(k)), "k": k, "error": error}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def from_nine_runs(
    robot: DifferentialDrive, routes: Mapping[str, OpenLoop], seed: int
) -> Iterator[Row]:
    """Kl from the straights and kr from the turns of table 1, each driven once, by the report.

    Its descent is stated at its limit, which a faster rate reaches in a few steps; after the 100
    iterations of the report it is still between that and its start, 1.
    """
    rng = stream(seed, "slip")
    for parameter, axis in (("kl", 0), ("kr", 2)):
        slips = []
        for route in routes.values():
            _, omega, duration_s = route.segments[0]
            end = run_batch(robot, route, 1, rng).end_poses[0]
            if (omega != 0.0) == (parameter == "kr"):
                slips.append((end[axis] - route.ideal_end()[axis]) / duration_s)
        rate = 1.0 / (16.0 * float(np.mean(np.square(slips))))
        limit = float(report_gradient_descent(0.0, slips, 1.0, rate=rate)[-1])
        found = {"value": limit, "low": limit, "high": limit}
        truth = {"parameter": parameter, "truth": getattr(robot, parameter)}
        yield {"runs": N_CASES, "method": REPORTS, **truth, **found}
