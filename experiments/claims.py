"""One function a claim: it reads a finished study's tables and judges by interval and criterion."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.statistics import (
    Interval,
    bootstrap_interval,
    mean_interval,
    share_interval,
    verdict,
)
from experiments.table import read_rows, write_frame

Array = NDArray[np.float64]
COLUMNS = (
    "id",
    "paper",
    "statistic",
    "value",
    "low",
    "high",
    "criterion",
    "verdict",
    "study",
    "command",
)


@dataclass(frozen=True)
class Claim:
    """A paper's claim, judged.

    Attributes
    ----------
    id, paper
        As in the papers' list, such as PB1 and puzzlebot2024.
    statistic
        What was measured.
    value, low, high
        Its value and 95 % interval; equal where nothing is random.
    criterion
        What the interval is held against.
    verdict
        `reproduced`, `not reproduced` or `undecided`, marked `(quick)` after few repeats, and
        followed by the reason or region where there is one to name.
    study, command
        Where the tables came from, and how to make them again.
    """

    id: str
    paper: str
    statistic: str
    value: float
    low: float
    high: float
    criterion: str
    verdict: str
    study: str = ""
    command: str = ""

    def completed(self, *, study: str, command: str, quick: bool) -> Claim:
        """Add the origin, and the mark of a quick run."""
        mark = f"{self.verdict} (quick)" if quick else self.verdict
        return dataclasses.replace(self, study=study, command=command, verdict=mark)


def write(claims: Sequence[Claim], path: Path) -> None:
    """Write claims to a table; those of papers not among them keep their rows."""
    new = pd.DataFrame([dataclasses.asdict(claim) for claim in claims], columns=list(COLUMNS))
    if path.exists():
        old = read_rows(path)
        new = pd.concat([old[~old["paper"].isin(set(new["paper"]))], new], ignore_index=True)
    write_frame(new.sort_values(["id", "statistic"], kind="stable"), path)


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


def pb3(calibration: pd.DataFrame, descent: pd.DataFrame) -> list[Claim]:
    """PB3: kr, kl from open-loop runs, per method, k and arm: coverage and relative bias."""
    claims = []
    slips = calibration[calibration["parameter"].isin(["kr", "kl"])]
    for (method, joint, k), table in slips.groupby(["method", "joint", "k_m"], sort=False):
        where = f"{method}, k = {k:g} m, {'gain and track joint' if joint else 'nominal geometry'}"
        covered = (table["low"] <= table["truth"]) & (table["truth"] <= table["high"])
        # One repetition gives both kr and kl, so the repetition is what is independent.
        by_seed = covered.groupby(table["seed"]).mean().to_numpy()
        share = bootstrap_interval(by_seed, lambda v: float(v.mean()), np.random.default_rng(0))
        relative = (table["value"] / table["truth"] - 1.0).groupby(table["seed"]).mean()
        bias = mean_interval(relative)
        judged = (
            ("coverage of the 95 % intervals of kr and kl", share, (0.90, 0.99)),
            ("relative bias of kr and kl", bias, (-0.05, 0.05)),
        )
        for label, found, (low, high) in judged:
            claims.append(
                Claim(
                    "PB3",
                    "puzzlebot2024",
                    f"{label}: {where}",
                    found.value,
                    found.low,
                    found.high,
                    f"within {low:g} and {high:g}",
                    verdict(found, low, high),
                )
            )
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
    claims, leaves = [], None
    for k, table in coverage.groupby("k_m"):
        shares = [share_interval(int(row.in_ellipse), int(row.runs)) for row in table.itertuples()]
        worst = min(shares, key=lambda s: s.value)
        case = table.iloc[shares.index(worst)]["case"]
        outcomes = [verdict(share, 0.93, 0.97) for share in shares]
        overall = (
            "reproduced"
            if set(outcomes) == {"reproduced"}
            else "not reproduced"
            if "not reproduced" in outcomes
            else "undecided"
        )
        if overall == "not reproduced" and leaves is None:
            leaves = k
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
                f"{overall} ({within} of {len(shares)} manoeuvres within)",
            )
        )
    gap = np.hypot(
        engine["bullet_x_m"] - engine["kinematic_x_m"],
        engine["bullet_y_m"] - engine["kinematic_y_m"],
    )
    spread = np.hypot(engine["kinematic_y_m"].std(), engine["kinematic_x_m"].std())
    share = mean_interval(gap / spread)
    claims.append(
        Claim(
            "PB4",
            "puzzlebot2024",
            "distance of PyBullet's end from the kinematic robot's, same noise, over their spread",
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
                "least k at which a manoeuvre leaves the band, m",
                leaves,
                leaves,
                leaves,
                "above 1e-4",
                "reproduced" if leaves > 1e-4 * (1 + 1e-9) else "not reproduced",
            )
        )
    return claims
