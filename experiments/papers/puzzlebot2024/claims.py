"""The claims PB1-PB4 of puzzlebot2024."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import Interval, mean_interval, share_interval
from experiments.evaluation.verdict import Claim, Verdict, banded, holds, judged, overall
from experiments.papers.puzzlebot2024.settings import NOMINAL
from experiments.papers.results import Results
from sim.arrays import Array

# Sigma_1 and Sigma_2 as printed, each with half a unit of its last digit
PRINTED = (
    (((0.5, 0.01, 0.01), (0.01, 0.5, 0.01), (0.01, 0.01, 0.2)), 0.005),
    (((0.9998, 0.0207, 0.0180), (0.0207, 1.0040, 0.0399), (0.0180, 0.0399, 0.4000)), 0.00005),
)


def judge(made: Results) -> list[Claim]:
    """Judge PB1-PB4 by the tables."""
    return [
        *pb1(),
        *pb2(made.table("areas"), made.table("crossover"), NOMINAL.track_m),
        *pb3(made.table("calibration"), made.table("gradient_descent"), made.table("engine_k")),
        *pb4(made.table("coverage"), made.table("engine")),
    ]


def worked_matrices() -> tuple[Array, Array]:
    """Sigma_1 and Sigma_2 of puzzlebot2024, eqs. (7)-(9).

    The recursion is eq. (1) with Q as given in eq. (7) and H of eq. (4) for v = 1 m/s and
    dt = 0.1 s. The heading that enters H is 0 at the first step and, with w = 1 rad/s, 0.1 rad
    at the second.
    """
    Q = np.array([[0.5, 0.01, 0.01], [0.01, 0.5, 0.01], [0.01, 0.01, 0.2]])
    v, w, dt = 1.0, 1.0, 0.1
    H = np.eye(3)
    H[:2, 2] = -dt * v * math.sin(w * dt), dt * v * math.cos(w * dt)
    return Q, H @ Q @ H.T + Q


def pb1() -> list[Claim]:
    """PB1: the worked matrices come out to the printed digit (0.998 read as 0.9998)."""
    worst = max(
        float(np.abs(worked - printed).max()) / half_unit
        for worked, (printed, half_unit) in zip(worked_matrices(), PRINTED, strict=True)
    )
    statistic = "largest deviation of Sigma_1 and Sigma_2, in half units of the last printed digit"
    return [Claim("PB1", statistic, Interval.exact(worst), "at most 1", holds(worst <= 1.0))]


def pb2(areas: pd.DataFrame, crossover: pd.DataFrame, track_m: float) -> Iterator[Claim]:
    """PB2: the ellipse grows on straights and arcs; heading takes over at track sqrt(3) / 2."""
    for name, table in areas.groupby("manoeuvre", sort=False):
        steps = np.concatenate([np.diff(part["area_m2"]) for _, part in table.groupby("k_m")])
        shrinking = float(np.mean(steps < -1e-9 * table["area_m2"].max()))
        statistic = f"share of steps in which the 95 % ellipse shrinks, {name}"
        judgement = ("0", holds(shrinking <= 0.0), "")
        if name == "out and back":
            judgement = ("shown, not judged", Verdict.SHOWN, "it shrinks on the way back")
        yield Claim("PB2", statistic, Interval.exact(shrinking), *judgement)
    ratio = mean_interval(crossover["crossover_m"] / (track_m * math.sqrt(3.0) / 2.0))
    statistic = "distance at which heading-borne spread overtakes, over track sqrt(3) / 2"
    yield banded("PB2", statistic, ratio, 0.98, 1.02)


def pb3(
    calibration: pd.DataFrame, descent: pd.DataFrame, engine_k: pd.DataFrame
) -> Iterator[Claim]:
    """PB3: kr, kl from open-loop runs, per method, k and arm: coverage and relative bias.

    The biases of kr and kl are judged apart, since opposite ones would cancel; the worse is shown.
    """
    for (method, joint, k), table in calibration.groupby(["method", "joint", "k_m"], sort=False):
        where = f"{method}, k = {k:g} m, {'gain and track joint' if joint else 'nominal geometry'}"
        is_slip = table["parameter"].isin(["kr", "kl"])
        slips, parts = table[is_slip], {"kr and kl": table[is_slip]}
        if joint:
            parts["gains and track"] = table[~is_slip]
        for names, part in parts.items():
            share = _clustered_share(part["truth"].between(part["low"], part["high"]), part["seed"])
            label = f"coverage of the 95 % intervals of {names}: {where}"
            yield banded("PB3", label, share, 0.90, 0.99)
        relative = slips["value"] / slips["truth"] - 1.0
        biases = [mean_interval(part) for _, part in relative.groupby(slips["parameter"])]
        worse = max(biases, key=lambda bias: abs(bias.value))
        label = f"relative bias, the worse of kr and kl: {where}"
        verdict = overall([judged(bias, -0.05, 0.05) for bias in biases])
        yield dataclasses.replace(banded("PB3", label, worse, -0.05, 0.05), verdict=verdict)
    for row in engine_k.itertuples():
        label = (
            f"{row.parameter} of PyBullet's robot by wheel truth, over the truth, k = {row.k_m:g} m"
        )
        ratio = Interval(row.value / row.truth, row.low / row.truth, row.high / row.truth)
        yield banded("PB3", label, ratio, 0.95, 1.05)
    yield Claim(
        "PB3",
        "the report's gradient descent: largest distance of its limit from 1/2, any data",
        Interval.exact(float(np.abs(descent["k_in_the_end"] - 0.5).max())),
        "an estimator of kr, kl would depend on the data",
        Verdict.NOT_REPRODUCED,
        "it returns 1/2 whatever the data",
    )


def pb4(coverage: pd.DataFrame, engine: pd.DataFrame) -> Iterator[Claim]:
    """PB4: the true end lies in the ideal robot's 95 % ellipse, per k; and where that ends."""
    verdicts = {}
    for k, table in coverage.groupby("k_m"):
        shares = [share_interval(int(row.in_ellipse), int(row.runs)) for row in table.itertuples()]
        worst = int(np.argmin([share.value for share in shares]))
        parts = [judged(share, 0.93, 0.97) for share in shares]
        verdicts[k] = overall(parts)
        yield Claim(
            "PB4",
            "least share of ends in the 95 % ellipse over nine manoeuvres "
            f"({table.iloc[worst]['case']}), k = {k:g}",
            shares[worst],
            "every manoeuvre's interval within 0.93 and 0.97",
            verdicts[k],
            f"{parts.count(Verdict.REPRODUCED)} of {len(parts)} manoeuvres within",
        )
    yield banded(
        "PB4",
        "distance of PyBullet's end from the kinematic robot's, same noise, over the spread",
        mean_interval(_engine_gap(engine)),
        at_most=0.05,
        criterion="below 0.05: the kinematic robot stands for PyBullet's",
    )
    left = [k for k, verdict in verdicts.items() if verdict is Verdict.NOT_REPRODUCED]
    if left:
        within = [k for k, v in verdicts.items() if v is Verdict.REPRODUCED and k < left[0]]
        yield Claim(
            "PB4",
            "least k at which a manoeuvre leaves the band, m (low: the last with all in it)",
            Interval(left[0], max(within, default=0.0), left[0]),
            "above 1e-4",
            holds(left[0] > 1e-4 * (1 + 1e-9)),
        )


def _engine_gap(engine: pd.DataFrame) -> pd.Series[float]:
    """RMS, per seed, of the end's gap in x, y and heading over that case's own spread."""
    kinematic = engine.filter(like="kinematic_")
    spread = kinematic.groupby(engine["case"]).transform("std")
    gap = (engine.filter(like="bullet_").to_numpy() - kinematic) / spread
    return (gap**2).mean(axis=1).groupby(engine["seed"]).mean() ** 0.5


def _clustered_share(hits: pd.Series[bool], seeds: pd.Series[int]) -> Interval:
    """Share of hits with its Clopper-Pearson interval.

    One repetition gives several hits or misses. As far as these are correlated, they count as fewer
    trials, by the ratio of the repetitions' variance to that of independent trials.
    """
    share, by_seed = float(hits.mean()), hits.groupby(seeds).mean()
    alone = share * (1.0 - share) * len(by_seed) / len(hits)
    together = max(1.0, float(by_seed.var()) / alone) if alone > 0.0 else 1.0
    trials = round(len(hits) / together)
    return dataclasses.replace(share_interval(round(share * trials), trials), value=share)
