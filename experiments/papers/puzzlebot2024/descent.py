"""The report's own calibration, kept to show what it returns; not an estimator of kr or kl."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from experiments.papers.puzzlebot2024.settings import DESCENTS


def report_gradient_descent(
    final_ideal: float,
    final_real: ArrayLike,
    time_s: float,
    *,
    rate: float = 0.01,
    n_iterations: int = 100,
) -> NDArray[np.float64]:
    """Fit k so that (k + k) v comes near v by gradient descent from k = 1.

    v is the deviation of the end over the time. The data cancel: the minimum is 1/2 whatever they
    are, and they only set how fast the descent gets there, (1 - 8 rate mean(v^2)) a step.

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
    """Run the report's own procedure on its example data and on others: it goes to 1/2."""
    rows = []
    for name, (ideal, real, time_s) in DESCENTS.items():
        steps = math.ceil(30.0 / (0.08 * (ideal - real) ** 2 / time_s**2))
        after_100, in_the_end = (
            report_gradient_descent(ideal, real, time_s, n_iterations=n)[-1]
            for n in (100, min(steps, 10**6))
        )
        rows.append({"data": name, "k_after_100": after_100, "k_in_the_end": in_the_end})
    return pd.DataFrame(rows)
