"""The claims MX1-MX5 of maximo2024, and three of our own on simulated clouds and kidnapping."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import (
    Interval,
    log_ratio_interval,
    mean_interval,
    share_interval,
)
from experiments.evaluation.verdict import Claim, Verdict, banded, equivalent, holds, lower, overall
from experiments.papers.maximo2024.settings import NAMES, RECOVERED_WITHIN, WITHIN
from experiments.papers.results import Results

_LEAST_M = 1e-3  # added to dispersions that may be zero, before a logarithm


def judge(made: Results) -> list[Claim]:
    """Judge MX1-MX8 by the tables."""
    quality = made.table("quality")
    return [
        *mx1(made.table("weighting"), quality),
        *mx2(made.table("particles"), made.table("times")),
        *mx3(made.table("dispersion"), quality),
        *mx4(made.table("starts")),
        *mx5(made.table("clusters")),
        mx6(made.table("campus_starts")),
        mx7(made.table("campus_starts")),
        *mx8(made.table("kidnapping")),
    ]


def geometries(table: pd.DataFrame) -> list[str]:
    """Geometries of a table, the paper's before our own."""
    return [name for name in NAMES if name in set(table["geometry"])]


def _by_world(table: pd.DataFrame, column: str, by: str = "method") -> pd.DataFrame:
    """Mean over repeats: one row per world, one column per value of `by`."""
    return table.pivot_table(index="seed", columns=by, values=column, aggfunc="mean")


def mx1(weighting: pd.DataFrame, quality: pd.DataFrame) -> Iterator[Claim]:
    """MX1: M2 is the best weighting; M3 fails on Oxford and holds on UMH.

    Each method has the parameters that suit it best. The reason says where M3 fails with
    parameters that the methods share.
    """
    for name in geometries(weighting):
        errors = _by_world(weighting[weighting["geometry"] == name], "error_m")
        if name.startswith("oxford"):
            statistic = f"share of worlds with M3 worse than 5 times M2, {NAMES[name]}"
            share = _share("MX1", statistic, errors["M3"] > 5.0 * errors["M2"], at_least=0.8)
            yield replace(share, reason=_where_m3_fails(quality, "oxford"))
        if name == "umh":
            ratio, verdict = equivalent(errors["M3"], errors["M2"], 0.25)
            yield Claim(
                "MX1",
                "error of M3 over M2, UMH (90 % interval)",
                ratio,
                "within 25 % by two one-sided tests",
                verdict,
                _where_m3_fails(quality, "umh"),
            )
    yield from _m2_below_m1("MX1", "error", weighting, quality)


def mx3(dispersion: pd.DataFrame, quality: pd.DataFrame) -> Iterator[Claim]:
    """MX3: M2 concentrates faster than M1: its dispersion at step 10."""
    at_10 = dispersion.query("step == 10").eval("dispersion_m = dispersion_m + @_LEAST_M")
    return _m2_below_m1("MX3", "dispersion", at_10, quality, " at step 10")


def _m2_below_m1(
    claim: str, what: str, table: pd.DataFrame, quality: pd.DataFrame, at: str = ""
) -> Iterator[Claim]:
    """Judge on each geometry whether M2 is below M1; the reason: where with shared parameters."""
    for name in geometries(table):
        worlds = _by_world(table[table["geometry"] == name], f"{what}_m")
        ratio, p, verdict = lower(worlds["M2"], worlds["M1"])
        statistic = f"{what} of M2 over M1{at}, {NAMES[name]}"
        criterion = f"below 1 by Wilcoxon, p < 0.01 (p = {p:.2g})"
        reason = _where_less(quality[quality["geometry"] == name], f"{what}_m")
        yield Claim(claim, statistic, ratio, criterion, verdict, reason)


def _where_less(quality: pd.DataFrame, column: str) -> str:
    """Name the B at which M2 is below M1 when both have the same parameters, at a noise of 0.8."""
    part = quality[quality["noise_weight"] == 0.8]
    by_b = {b: _by_world(rows, column) + _LEAST_M for b, rows in part.groupby("n_nearest")}
    less = [
        str(b)
        for b, worlds in by_b.items()
        if lower(worlds["M2"], worlds["M1"])[2] is Verdict.REPRODUCED
    ]
    where = f"B = {', '.join(less)}" if less else "no B tried"
    return "" if part.empty else f"with shared parameters at {where}"


def m3_failures(quality: pd.DataFrame, name: str) -> pd.DataFrame:
    """Share of worlds with M3 worse than 5 times M2, by noise weight (rows) and B (columns)."""
    part = quality[quality["geometry"] == name]
    keys = ["noise_weight", "n_nearest", "seed"]
    errors = part.pivot_table(index=keys, columns="method", values="error_m")
    return (errors["M3"] > 5.0 * errors["M2"]).groupby(keys[:2]).mean().unstack()


def _where_m3_fails(quality: pd.DataFrame, name: str) -> str:
    """Name the least B at which M3 fails in 80 % of worlds, at the paper-like noise of 0.8."""
    shares = m3_failures(quality, name).loc[0.8]
    failing = shares.index[shares >= 0.8]
    where = f"from B = {failing.min()} on" if len(failing) else "at no B tried"
    return f"with shared parameters M3 fails {where}"


def mx2(particles: pd.DataFrame, times: pd.DataFrame) -> Iterator[Claim]:
    """MX2: the error does not depend on the number of particles, the time grows with it."""
    for name, part in particles.groupby("geometry", sort=False):
        errors = _by_world(part, "error_m", "per_node")
        ratios = {n: equivalent(errors[n], errors[4], 0.05) for n in errors.columns if n != 4}
        worst = max(ratios, key=lambda n: abs(math.log(ratios[n][0].value)))
        yield Claim(
            "MX2",
            f"error with {worst} particles a node over that with 4, the worst, {NAMES[name]} "
            "(90 % interval)",
            ratios[worst][0],
            "within 5 % by two one-sided tests, for 2, 6 and 8",
            overall([verdict for _, verdict in ratios.values()]),
        )
    for name, part in times.groupby("geometry", sort=False):
        rising = bool(np.all(np.diff(part.sort_values("particles")["time_s"]) > 0.0))
        slowest = float((part["time_s"] / part["paper_s"]).max())
        yield Claim(
            "MX2",
            f"time a node over the paper's, the largest, {NAMES[name]}",
            Interval.exact(slowest),
            "below 0.1, and rising with the particles",
            holds(rising and slowest < 0.1),
        )


def _share(claim: str, statistic: str, hits: pd.Series[bool], **judging: Any) -> Claim:
    return banded(claim, statistic, share_interval(int(hits.sum()), len(hits)), **judging)


def mx4(starts: pd.DataFrame) -> list[Claim]:
    """MX4: any starting node works."""
    return [
        _share(
            "MX4",
            f"share of starts that M2 localises within {WITHIN} steps, {NAMES[name]}",
            part["settled_at"] <= WITHIN,
            at_least=0.95,
            criterion="lower bound above 0.95",
        )
        for name, part in starts.groupby("geometry", sort=False)
    ]


def mx5(clusters: pd.DataFrame) -> list[Claim]:
    """MX5: clusters of descriptors are stretches of the route.

    On the synthetic field this holds by construction. Scan Context is left out, since it turns
    with the robot, which k-means does not allow for.
    """
    asked = clusters[clusters["descriptor"] != "scan_context"]
    shares = asked.groupby(["geometry", "descriptor"], sort=False)["contiguous"]
    return [
        banded(
            "MX5",
            f"share of nodes with a route neighbour in their cluster, {NAMES[name]}"
            + (f", {descriptor}" if descriptor != "synthetic" else ""),
            mean_interval(part),
            at_least=0.8,
            criterion="above 0.8",
        )
        for (name, descriptor), part in shares
    ]


def mx6(starts: pd.DataFrame) -> Claim:
    """Our own: global localization on simulated clouds."""
    return _share(
        "MX6",
        "share of starts localised on campus clouds (our own)",
        starts["settled_at"] <= WITHIN,
        at_least=0.95,
    )


def mx7(starts: pd.DataFrame) -> Claim:
    """Our own, the paper's future work: registration brings the error below the spacing."""
    worlds = starts.dropna(subset="rms_m").groupby("seed")[["spacing_m", "rms_m"]].mean()
    ratio = log_ratio_interval(worlds["spacing_m"], worlds["rms_m"])
    statistic = "node spacing over RMS error with refinement, campus clouds (our own)"
    return banded("MX7", statistic, ratio, at_least=5.0)


def mx8(kidnapping: pd.DataFrame) -> list[Claim]:
    """Our own: a kidnapped robot is found again with injection, and not without."""
    known = kidnapping[kidnapping["known_before"]]
    back = known["settled_at"] <= RECOVERED_WITHIN
    trials = back.groupby([known["geometry"], known["injection"] > 0.0], sort=False)
    return [
        _share(
            "MX8",
            f"share recovered within {RECOVERED_WITHIN} nodes {'with' if injects else 'without'} "
            f"injection, {NAMES[name]} (our own)",
            recovered,
            **({"at_least": 0.95} if injects else {"at_most": 0.5}),
        )
        for (name, injects), recovered in trials
    ]
