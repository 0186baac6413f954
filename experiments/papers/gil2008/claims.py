"""The claims GI1-GI8 of gil2008.

A world is the unit of inference: runs that share one are pooled (squares, then the root) before
anything is compared. Errors of position and map are those of the revised path and of the map of the
best particle, as the paper has them, raw and rigidly aligned.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from experiments.evaluation.statistics import (
    Interval,
    log_log_slope,
    log_ratio_interval,
    mean_interval,
    page_trend_p,
)
from experiments.evaluation.verdict import Claim, Verdict, banded, equivalent
from experiments.papers.gil2008.settings import P0
from experiments.papers.results import Results
from sim.arrays import Array

POSITION = "revised_ate_rmse_m"
ERRORS = {
    POSITION: "position",
    "revised_ate_aligned_rmse_m": "aligned position",
    "map_rmse_m": "map",
    "map_aligned_rmse_m": "aligned map",
}
NAMES = {
    "paper": "the filter as printed",
    "fastslam2": "FastSLAM 2.0",
    "ekf_slam": "EKF-SLAM",
}
NOISE = {"paper": "noise of 10 px", "pixel": "noise of 1 px"}
SHOWN = "shown, not judged"


def judge(made: Results) -> list[Claim]:
    """Judge GI1-GI8 by the tables."""
    particles, distance = made.table("particles"), made.table("distance")
    return [
        *gi1(particles),
        *gi2(particles, made.table("bound")),
        *gi3(particles),
        *gi4(distance),
        *gi5(distance),
        *gi6(made.table("observations")),
        *gi7(made.table("association")),
        *gi8(made.table("cost")),
    ]


def pooled(table: pd.DataFrame, column: str, by: str) -> pd.DataFrame:
    """Root mean square of a column, one row per world and one column per value of `by`."""
    squares = (table[column] ** 2).groupby([table["seed"], table[by]]).mean()
    return squares.unstack(by).dropna() ** 0.5


def gi1(particles: pd.DataFrame) -> Iterator[Claim]:
    """GI1: against odometry the error of SLAM stays bounded."""
    enough = particles[particles["n_particles"] >= 50]
    for (noise, name), table in enough.groupby(["noise", "filter"], sort=False):
        ratios = {}
        for m, part in table.groupby("n_particles"):
            ours, odometry = (pooled(part, c, "filter") for c in (POSITION, "odometry_rmse_m"))
            ratios[m] = log_ratio_interval(ours[name], odometry[name])
        m, worst = max(ratios.items(), key=lambda item: item[1].high)
        where = f"{NAMES[name]}, {NOISE[noise]}"
        label = f"error of SLAM over odometry's, the worst of M >= 50 (M = {m}): {where}"
        yield banded("GI1", label, worst, at_most=0.5, criterion="below 0.5")
        growth = mean_interval(1e3 * table.groupby("seed")["slope"].mean().dropna())
        label = f"growth of the error over revisited ground, mm per m of path: {where}"
        yield banded("GI1", label, growth, at_most=0.0, criterion="not above 0")
    own = mean_interval(particles.groupby("seed")["odometry_rmse_m"].mean())
    yield Claim(
        "GI1", "RMS position error of odometry, m (the paper: 3)", own, SHOWN, Verdict.SHOWN
    )


def gi2(particles: pd.DataFrame, bound: pd.DataFrame) -> Iterator[Claim]:
    """GI2: more particles, less error; and how far from the best possible."""
    first = particles[particles["draw"] == 0]
    for (noise, name), table in first.groupby(["noise", "filter"], sort=False):
        where = f"{NAMES[name]}, {NOISE[noise]}"
        yield from _trends("GI2", table, "n_particles", "M", 0.001, where)
        best = bound[bound["noise"] == noise].set_index("seed")
        some = table[table["n_particles"] == 500].groupby("seed").first()
        for column, what in list(ERRORS.items())[:2]:
            found = median_interval((some[column] / best[column]).dropna().to_numpy())
            label = f"{what} error at M = 500 over the batch bound, median of worlds: {where}"
            yield Claim("GI2", label, found, f"{SHOWN} (ours: 2)", Verdict.SHOWN)


def gi3(particles: pd.DataFrame) -> Iterator[Claim]:
    """GI3: nothing significant is gained past 200 particles."""
    table = particles[(particles["noise"] == "paper") & particles["n_particles"].isin([200, 1000])]
    for name, part in table.groupby("filter", sort=False):
        for column, what in ERRORS.items():
            errors = pooled(part, column, "n_particles")
            label = (
                f"{what} error, M = 200 over M = 1000, {len(part) // 2} recordings in "
                f"{len(errors)} worlds (90 % interval): {NAMES[name]}"
            )
            yield _equivalence("GI3", label, errors[200], errors[1000], 0.25)


def gi4(distance: pd.DataFrame) -> Iterator[Claim]:
    """GI4: the error falls with dmax."""
    for words, is_ours, part in _kinds(distance[distance["occluded"]]):
        errors = pooled(part, POSITION, "max_distance_m")
        found = log_ratio_interval(errors[3], errors[10])
        label = f"position error, dmax = 3 m over 10 m: {words}"
        claim = banded("GI4", label, found, at_least=1.5, criterion="above 1.5")
        yield _shown(claim) if is_ours else claim


def gi5(distance: pd.DataFrame) -> Iterator[Claim]:
    """GI5: nothing significant is gained past 10 m, because of the noise of far landmarks."""
    for words, is_ours, part in _kinds(distance):
        far = float(part[part["max_distance_m"] == 20]["share_beyond_10_m"].mean())
        errors = pooled(part, POSITION, "max_distance_m")
        label = (
            f"position error, dmax = 10 m over 20 m, {100 * far:.0f} % of observations beyond "
            f"10 m (90 % interval): {words}"
        )
        claim = _equivalence("GI5", label, errors[10], errors[20], 0.30)
        if far < 0.1:
            claim = _undecided(claim, "too few far observations")
        yield _shown(claim) if is_ours else claim


def gi6(observations: pd.DataFrame) -> Iterator[Claim]:
    """GI6: the error against the number of observations of an image."""
    for name, table in observations.groupby("filter", sort=False):
        yield from _trends("GI6", table, "n_seen", "B", 0.01, NAMES[name])


def gi7(association: pd.DataFrame) -> Iterator[Claim]:
    """GI7: each particle's own association survives errors; descriptors make it more robust."""
    for noise, table in association.groupby("noise", sort=False):
        ours = table[(table["filter"] == "fastslam2") & np.isclose(table["p0"], P0)]
        known = ours[ours["association"] == "known"].set_index("seed")[POSITION]
        for _, part in ours[ours["association"] == "descriptor"].groupby("sigma_descriptor"):
            right, alone = part["right_share"].mean(), part["matching_precision"].mean()
            label = (
                f"position error by distance and descriptor over known association (90 % "
                f"interval); descriptors alone match {100 * alone:.0f} %, together "
                f"{100 * right:.0f} % are right: {NOISE[noise]}"
            )
            both = pd.concat([part.set_index("seed")[POSITION], known], axis=1, join="inner")
            yield _equivalence("GI7", label, both.iloc[:, 0], both.iloc[:, 1], 0.25)
        guessed = ours[ours["association"] == "mahalanobis"].set_index("seed")
        single = table[table["filter"] == "ekf_slam"].set_index("seed")
        rates = [p["ate_rmse_m"] > 0.5 * p["odometry_rmse_m"] for p in (single, guessed)]
        ekf, fastslam = pd.concat(rates, axis=1, join="inner").to_numpy(float).T
        found = mean_interval(ekf - fastslam)
        label = (
            f"share of runs that diverge (half of odometry's error or more), EKF-SLAM's "
            f"{ekf.mean():.2f} less FastSLAM's {fastslam.mean():.2f}, both by Mahalanobis "
            f"distance: {NOISE[noise]}"
        )
        claim = banded("GI7", label, found, at_least=1e-9, criterion="above 0")
        if np.array_equal(ekf, fastslam):
            claim = _undecided(claim, "both diverge in the same worlds")
        yield claim


def gi8(cost: pd.DataFrame) -> Iterator[Claim]:
    """GI8: time of a step against N, with shared and with contiguous maps."""
    bands: dict[str, dict[str, Any]] = {
        "shared": {"at_most": 0.3, "criterion": "below 0.3"},
        "contiguous": {"at_least": 0.8, "at_most": 1.2},
    }
    for maps, table in cost.groupby("maps", sort=False):
        repeats = table.groupby("repeat")
        found = mean_interval([log_log_slope(p["n_landmarks"], p["step_ms"]) for _, p in repeats])
        label = f"exponent of N in the time of a step, {maps} maps, resampling at every image"
        yield banded("GI8", label, found, **bands[maps])
    wide = cost.groupby(["n_landmarks", "maps"])["step_ms"].median().unstack("maps")
    least = Interval.exact(float((wide["contiguous"] / wide["shared"]).iloc[0]))
    label = "time of a step, contiguous over shared, at the least N: shared is faster from there on"
    yield Claim("GI8", label, least, SHOWN, Verdict.SHOWN)


def median_interval(values: Array) -> Interval:
    """Median with its distribution-free interval of at least 95 %."""
    found = stats.quantile_test(values, p=0.5).confidence_interval(0.95)
    return Interval(float(np.median(values)), float(found.low), float(found.high))


def _kinds(distance: pd.DataFrame) -> Iterator[tuple[str, bool, pd.DataFrame]]:
    """Runs that differ in dmax alone: their name, whether no claim is about them, their rows.

    The nearest landmarks are our addition.
    """
    keys = ["filter", "occluded", "noise", "n_seen", "rule"]
    for (name, occluded, noise, n_seen, rule), part in distance.groupby(keys, sort=False):
        seen = f"{n_seen} {rule}" if n_seen else "all visible"
        walls = "behind walls" if occluded else "no walls"
        yield f"{NAMES[name]}, {seen}, {walls}, {NOISE[noise]}", rule == "nearest", part


def _undecided(claim: Claim, reason: str) -> Claim:
    return dataclasses.replace(claim, verdict=Verdict.UNDECIDED, reason=reason)


def _shown(claim: Claim) -> Claim:
    return dataclasses.replace(claim, criterion=SHOWN, verdict=Verdict.SHOWN, reason="")


def _trends(
    claim_id: str, table: pd.DataFrame, by: str, symbol: str, limit: float, where: str
) -> Iterator[Claim]:
    """Judge by Page's test that errors fall; few worlds or p up to 5 % are undecided."""
    for column, what in ERRORS.items():
        errors = pooled(table, column, by)
        (first, *_, last), p = errors.columns, page_trend_p(errors)
        verdict = Verdict.NOT_REPRODUCED
        if p < limit:
            verdict = Verdict.REPRODUCED
        elif p < 0.05 or len(errors) < 20:
            verdict = Verdict.UNDECIDED
        label = (
            f"{what} error, {symbol} = {last} over {symbol} = {first} (Page's p = {p:.2g}): {where}"
        )
        found = log_ratio_interval(errors[last], errors[first])
        yield Claim(claim_id, label, found, f"Page's p below {limit:g}", verdict)


def _equivalence(
    claim_id: str, label: str, first: ArrayLike, second: ArrayLike, margin: float
) -> Claim:
    """Judge two one-sided tests that the paired ratio lies within 1 / (1 + m) and 1 + m."""
    found, verdict = equivalent(first, second, margin)
    criterion = f"within {1.0 / (1.0 + margin):.2g} and {1.0 + margin:g}"
    return Claim(claim_id, label, found, criterion, verdict)
