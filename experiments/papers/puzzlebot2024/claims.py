"""The claims PB1-PB4 of puzzlebot2024."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.evaluation.statistics import (
    Interval,
    mean_interval,
    share_interval,
    verdict,
)
from experiments.report.claims import Claim, overall

Array = NDArray[np.float64]


def worked_matrices() -> tuple[Array, Array]:
    """Sigma_1 and Sigma_2 of puzzlebot2024, eqs. (7)-(9).

    The recursion is eq. (1) with Q as given in eq. (7) and H of eq. (4) for v = 1 m/s and
    dt = 0.1 s. The heading that enters H is 0 at the first step and, with w = 1 rad/s, 0.1 rad
    at the second.
    """
    Q = np.array([[0.5, 0.01, 0.01], [0.01, 0.5, 0.01], [0.01, 0.01, 0.2]])
    v, w, dt = 1.0, 1.0, 0.1
    sigma, steps = np.zeros((3, 3)), []
    for step in range(2):
        theta = step * w * dt
        H = np.eye(3)
        H[0, 2], H[1, 2] = -dt * v * math.sin(theta), dt * v * math.cos(theta)
        sigma = H @ sigma @ H.T + Q
        steps.append(sigma)
    return steps[0], steps[1]


PRINTED_1 = ((0.5, 0.01, 0.01), (0.01, 0.5, 0.01), (0.01, 0.01, 0.2))
PRINTED_2 = ((0.9998, 0.0207, 0.0180), (0.0207, 1.0040, 0.0399), (0.0180, 0.0399, 0.4000))


def pb1() -> list[Claim]:
    """PB1: the worked matrices come out to the printed digit (0.998 read as 0.9998)."""
    first, second = worked_matrices()
    worst = max(
        float(np.abs(first - PRINTED_1).max()) / 0.005,
        float(np.abs(second - PRINTED_2).max()) / 0.00005,
    )
    found = Interval(worst, worst, worst)
    return [
        Claim(
            "PB1",
            "puzzlebot2024",
            "largest deviation of Sigma_1 and Sigma_2, in half units of the last printed digit",
            found.value,
            found.low,
            found.high,
            "at most 1",
            verdict(found, at_most=1.0),
        )
    ]


def pb2(areas: pd.DataFrame, crossover: pd.DataFrame, track_m: float) -> list[Claim]:
    """PB2: the ellipse grows on straights and arcs; heading takes over at track sqrt(3) / 2."""
    claims = []
    for name, table in areas.groupby("manoeuvre", sort=False):
        steps = np.concatenate([np.diff(part["area_m2"]) for _, part in table.groupby("k_m")])
        size = float(table["area_m2"].max())
        shrinking = float(np.mean(steps < -1e-9 * size))
        found = Interval(shrinking, shrinking, shrinking)
        once = name != "out and back"
        claims.append(
            Claim(
                "PB2",
                "puzzlebot2024",
                f"share of steps in which the 95 % ellipse shrinks, {name}",
                found.value,
                found.low,
                found.high,
                "0" if once else "shown, not judged",
                verdict(found, at_most=0.0) if once else "shown: it shrinks on the way back",
            )
        )
    theory = track_m * math.sqrt(3.0) / 2.0
    ratio = mean_interval(crossover["crossover_m"] / theory)
    claims.append(
        Claim(
            "PB2",
            "puzzlebot2024",
            "distance at which heading-borne spread overtakes, over track sqrt(3) / 2",
            ratio.value,
            ratio.low,
            ratio.high,
            "within 0.98 and 1.02",
            verdict(ratio, 0.98, 1.02),
        )
    )
    return claims


def pb3(calibration: pd.DataFrame, descent: pd.DataFrame, engine_k: pd.DataFrame) -> list[Claim]:
    """PB3: kr, kl from open-loop runs, per method, k and arm: coverage and relative bias.

    The biases of kr and kl are judged apart, since opposite ones would cancel; the worse is told.
    """
    claims = []
    for (method, joint, k), table in calibration.groupby(["method", "joint", "k_m"], sort=False):
        where = f"{method}, k = {k:g} m, {'gain and track joint' if joint else 'nominal geometry'}"
        slips = table[table["parameter"].isin(["kr", "kl"])]
        judged = [("coverage of the 95 % intervals of kr and kl", slips)]
        if joint:
            judged.append(
                ("coverage of the 95 % intervals of gains and track", table.drop(slips.index))
            )
        for label, part in judged:
            covered = (part["low"] <= part["truth"]) & (part["truth"] <= part["high"])
            share = _clustered_share(covered, part["seed"])
            claims.append(_within(f"{label}: {where}", share, 0.90, 0.99))
        relative = slips["value"] / slips["truth"] - 1.0
        biases = [mean_interval(part) for _, part in relative.groupby(slips["parameter"])]
        worse = max(biases, key=lambda bias: abs(bias.value))
        claim = _within(f"relative bias, the worse of kr and kl: {where}", worse, -0.05, 0.05)
        outcome = overall([verdict(bias, -0.05, 0.05) for bias in biases])
        claims.append(dataclasses.replace(claim, verdict=outcome))
    for row in engine_k.itertuples():
        ratio = Interval(*(value / row.truth for value in (row.value, row.low, row.high)))
        label = (
            f"{row.parameter} of PyBullet's robot by wheel truth, over the truth, k = {row.k_m:g} m"
        )
        claims.append(_within(label, ratio, 0.95, 1.05))
    worst = float(np.abs(descent["k_in_the_end"] - 0.5).max())
    claims.append(
        Claim(
            "PB3",
            "puzzlebot2024",
            "the report's gradient descent: largest distance of its limit from 1/2, any data",
            worst,
            worst,
            worst,
            "an estimator of kr, kl would depend on the data",
            "not reproduced: it returns 1/2 whatever the data",
        )
    )
    return claims


def pb4(coverage: pd.DataFrame, engine: pd.DataFrame) -> list[Claim]:
    """PB4: the true end lies in the ideal robot's 95 % ellipse, per k; and where that ends."""
    claims, leaves, held = [], None, 0.0
    for k, table in coverage.groupby("k_m"):
        shares = [share_interval(int(row.in_ellipse), int(row.runs)) for row in table.itertuples()]
        worst = min(shares, key=lambda s: s.value)
        case = table.iloc[shares.index(worst)]["case"]
        outcomes = [verdict(share, 0.93, 0.97) for share in shares]
        outcome = overall(outcomes)
        if outcome == "not reproduced" and leaves is None:
            leaves = k
        if outcome == "reproduced" and leaves is None:
            held = k
        within = sum(outcome == "reproduced" for outcome in outcomes)
        claims.append(
            Claim(
                "PB4",
                "puzzlebot2024",
                f"least share of ends in the 95 % ellipse over nine manoeuvres ({case}), k = {k:g}",
                worst.value,
                worst.low,
                worst.high,
                "every manoeuvre's interval within 0.93 and 0.97",
                f"{outcome} ({within} of {len(shares)} manoeuvres within)",
            )
        )
    share = mean_interval(_engine_gap(engine))
    claims.append(
        Claim(
            "PB4",
            "puzzlebot2024",
            "distance of PyBullet's end from the kinematic robot's, same noise, over the spread",
            share.value,
            share.low,
            share.high,
            "below 0.05: the kinematic robot stands for PyBullet's",
            verdict(share, at_most=0.05),
        )
    )
    if leaves is not None:
        claims.append(
            Claim(
                "PB4",
                "puzzlebot2024",
                "least k at which a manoeuvre leaves the band, m (low: the last with all in it)",
                leaves,
                held,
                leaves,
                "above 1e-4",
                "reproduced" if leaves > 1e-4 * (1 + 1e-9) else "not reproduced",
            )
        )
    return claims


def _engine_gap(engine: pd.DataFrame) -> pd.Series[float]:
    """RMS, per seed, of the end's gap in x, y and heading over that case's own spread."""
    squares = pd.Series(0.0, index=engine.index)
    for name in ("x_m", "y_m", "heading_rad"):
        gap = engine[f"bullet_{name}"] - engine[f"kinematic_{name}"]
        spread = engine.groupby("case")[f"kinematic_{name}"].transform("std")
        squares += (gap / spread) ** 2 / 3.0
    per_seed: pd.Series[float] = squares.groupby(engine["seed"]).mean() ** 0.5
    return per_seed


def _clustered_share(hits: pd.Series[bool], seeds: pd.Series[int]) -> Interval:
    """Share of hits with its Clopper-Pearson interval.

    One repetition gives several hits or misses; where they go together, they count for fewer
    trials, by the ratio of the repetitions' scatter to that of independent trials.
    """
    share, by_seed = float(hits.mean()), hits.groupby(seeds).mean()
    alone = share * (1.0 - share) * len(by_seed) / len(hits)
    together = max(1.0, float(by_seed.var()) / alone) if alone > 0.0 else 1.0
    trials = round(len(hits) / together)
    return dataclasses.replace(share_interval(round(share * trials), trials), value=share)


def _within(statistic: str, found: Interval, low: float, high: float) -> Claim:
    """Judge a statistic of PB3 by a band."""
    criterion = f"within {low:g} and {high:g}"
    paper, outcome = "puzzlebot2024", verdict(found, low, high)
    return Claim("PB3", paper, statistic, found.value, found.low, found.high, criterion, outcome)
