"""The claims GI1-GI8 of gil2008.

A world is the unit of inference: runs that share one are pooled (squares, then the root) before
anything is compared. Errors of position and map are those of the revised path and of the map of the
best particle, as the paper has them, raw and rigidly aligned.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from experiments.bench.fastslam import slope
from experiments.evaluation.statistics import (
    Interval,
    equivalent,
    log_ratio_interval,
    mean_interval,
    page_trend_p,
    verdict,
)
from experiments.report.claims import Claim

Array = NDArray[np.float64]

PAPER = "gil2008"
ERRORS = {
    "revised_rmse_m": "position",
    "revised_aligned_rmse_m": "aligned position",
    "map_rmse_m": "map",
    "map_aligned_rmse_m": "aligned map",
}
NAMES = {
    "paper": "the filter as printed",
    "fastslam2": "FastSLAM 2.0",
    "ekf_slam": "EKF-SLAM",
}
NOISE = {"paper": "noise of 10 px", "pixel": "noise of 1 px"}


def pooled(table: pd.DataFrame, column: str, by: Sequence[str]) -> pd.DataFrame:
    """Root of the mean square of a column, one row a world and one column a value of `by`."""
    squares = table[column] ** 2
    wide = squares.groupby([table["seed"], *(table[name] for name in by)]).mean().unstack(by)
    return wide.dropna() ** 0.5


def gi1(particles: pd.DataFrame) -> list[Claim]:
    """GI1: against odometry the error of SLAM stays bounded."""
    claims = []
    judged = particles[particles["n_particles"] >= 50]
    for (noise, name), table in judged.groupby(["noise", "filter"], sort=False):
        ratios = {}
        for m, part in table.groupby("n_particles"):
            ours = pooled(part, "revised_rmse_m", ["filter"])[name]
            ratios[m] = log_ratio_interval(ours, pooled(part, "odometry_rmse_m", ["filter"])[name])
        m, worst = max(ratios.items(), key=lambda item: item[1].high)
        where = f"{NAMES[name]}, {NOISE[noise]}"
        label = f"error of SLAM over odometry's, the worst of M >= 50 (M = {m}): {where}"
        claims.append(_claim("GI1", label, worst, "below 0.5", verdict(worst, at_most=0.5)))
        slopes = table.groupby("seed")["slope"].mean().dropna()
        found = mean_interval(1e3 * slopes)
        label = f"growth of the error over revisited ground, mm per m of path: {where}"
        claims.append(_claim("GI1", label, found, "not above 0", verdict(found, at_most=0.0)))
    own = particles.groupby("seed")["odometry_rmse_m"].mean()
    label = "RMS position error of odometry, m (the paper: 3)"
    claims.append(_claim("GI1", label, mean_interval(own), "shown, not judged", "shown"))
    return claims


def gi2(particles: pd.DataFrame, bound: pd.DataFrame) -> list[Claim]:
    """GI2: more particles, less error; and how far from the best possible."""
    claims = []
    first = particles[particles["draw"] == 0]
    for (noise, name), table in first.groupby(["noise", "filter"], sort=False):
        for column, what in ERRORS.items():
            errors = pooled(table, column, ["n_particles"])
            found = log_ratio_interval(errors[1000], errors[10])
            p = page_trend_p(errors.to_numpy())
            label = (
                f"{what} error, M = 1000 over M = 10 (Page's p = {p:.2g}): "
                f"{NAMES[name]}, {NOISE[noise]}"
            )
            outcome = _trend(p, 0.001, len(errors))
            claims.append(_claim("GI2", label, found, "Page's p below 0.001", outcome))
        best = bound[bound["noise"] == noise].set_index("seed")
        some = table[table["n_particles"] == 500].groupby("seed").first()
        for column in list(ERRORS)[:2]:
            ratios = (some[column] / best[column]).dropna()
            label = (
                f"{ERRORS[column]} error at M = 500 over the batch bound, median of worlds: "
                f"{NAMES[name]}, {NOISE[noise]}"
            )
            found = median_interval(ratios.to_numpy())
            claims.append(_claim("GI2", label, found, "shown, not judged (ours: 2)", "shown"))
    return claims


def gi3(particles: pd.DataFrame) -> list[Claim]:
    """GI3: nothing significant is gained past 200 particles."""
    claims = []
    table = particles[(particles["noise"] == "paper") & particles["n_particles"].isin([200, 1000])]
    for name, part in table.groupby("filter", sort=False):
        for column, what in ERRORS.items():
            errors = pooled(part, column, ["n_particles"])
            n = len(part) // 2
            label = (
                f"{what} error, M = 200 over M = 1000, {n} recordings in {len(errors)} worlds "
                f"(90 % interval): {NAMES[name]}"
            )
            claims.append(_equivalence("GI3", label, errors[200], errors[1000], 0.25))
    return claims


def gi4(distance: pd.DataFrame) -> list[Claim]:
    """GI4: the error falls with dmax."""
    return [
        _claim("GI4", *_distances(part, key, 3.0, 10.0, at_least=1.5))
        for key, part in _kinds(distance)
        if key[1]
    ]


def gi5(distance: pd.DataFrame) -> list[Claim]:
    """GI5: nothing significant is gained past 10 m, because of the noise of far landmarks."""
    claims = []
    for key, part in _kinds(distance):
        far = float(part[part["max_distance_m"] == 20.0]["share_beyond_10_m"].mean())
        errors = pooled(part, "revised_rmse_m", ["max_distance_m"])
        label = (
            f"position error, dmax = 10 m over 20 m, {100 * far:.0f} % of observations beyond "
            f"10 m (90 % interval): {_kind(key)}"
        )
        claim = _equivalence("GI5", label, errors[10.0], errors[20.0], 0.30)
        if key[4] == "nearest":
            claim = dataclasses.replace(claim, criterion="shown, not judged", verdict="shown")
        elif far < 0.1:
            claim = dataclasses.replace(claim, verdict="undecided: too few far observations")
        claims.append(claim)
    return claims


def gi6(observations: pd.DataFrame) -> list[Claim]:
    """GI6: the error against the number of observations of an image."""
    claims = []
    for name, table in observations.groupby("filter", sort=False):
        for column, what in ERRORS.items():
            errors = pooled(table, column, ["n_seen"])
            found = log_ratio_interval(errors[20], errors[1])
            p = page_trend_p(errors.to_numpy())
            label = f"{what} error, B = 20 over B = 1 (Page's p = {p:.2g}): {NAMES[name]}"
            outcome = _trend(p, 0.01, len(errors))
            claims.append(_claim("GI6", label, found, "Page's p below 0.01", outcome))
    return claims


def gi7(association: pd.DataFrame) -> list[Claim]:
    """GI7: an association of each particle's own outlives errors; descriptors make it sturdier."""
    claims = []
    for noise, table in association.groupby("noise", sort=False):
        ours = table[(table["filter"] == "fastslam2") & np.isclose(table["p0"], 1e-3)]
        known = ours[ours["association"] == "known"].set_index("seed")["revised_rmse_m"]
        described = ours[ours["association"] == "descriptor"]
        for _, part in described.groupby("sigma_descriptor"):
            errors = part.set_index("seed")["revised_rmse_m"]
            right, alone = part["right_share"].mean(), part["matching_precision"].mean()
            label = (
                f"position error by distance and descriptor over known association (90 % "
                f"interval); descriptors alone match {100 * alone:.0f} %, together "
                f"{100 * right:.0f} % are right: {NOISE[str(noise)]}"
            )
            both = pd.concat([errors, known], axis=1, join="inner").to_numpy()
            claims.append(_equivalence("GI7", label, both[:, 0], both[:, 1], 0.25))
        guessed = ours[ours["association"] == "mahalanobis"].set_index("seed")
        single = table[table["filter"] == "ekf_slam"].set_index("seed")
        rates = [_diverged(part) for part in (single, guessed)]
        both_rates = pd.concat(rates, axis=1, join="inner").to_numpy(float)
        found = mean_interval(both_rates[:, 0] - both_rates[:, 1])
        label = (
            "share of runs that diverge (half of odometry's error or more), EKF-SLAM's "
            f"{both_rates[:, 0].mean():.2f} less FastSLAM's {both_rates[:, 1].mean():.2f}, both by "
            f"Mahalanobis distance: {NOISE[str(noise)]}"
        )
        outcome: str = verdict(found, at_least=1e-9)
        if np.array_equal(both_rates[:, 0], both_rates[:, 1]):
            outcome = "undecided: both diverge in the same worlds"
        claims.append(_claim("GI7", label, found, "above 0", outcome))
    return claims


def gi8(cost: pd.DataFrame) -> list[Claim]:
    """GI8: time of a step against N, with shared and with contiguous maps."""
    claims = []
    bands = {"shared": (-np.inf, 0.3), "contiguous": (0.8, 1.2)}
    for maps, table in cost.groupby("maps", sort=False):
        slopes = [
            slope(part["n_landmarks"], part["step_ms"]) for _, part in table.groupby("repeat")
        ]
        low, high = bands[str(maps)]
        found = mean_interval(slopes)
        label = f"exponent of N in the time of a step, {maps} maps, resampling at every image"
        criterion = f"below {high:g}" if low < 0 else f"within {low:g} and {high:g}"
        claims.append(_claim("GI8", label, found, criterion, verdict(found, low, high)))
    wide = cost.groupby(["n_landmarks", "maps"])["step_ms"].median().unstack("maps")
    ratio = wide["contiguous"] / wide["shared"]
    label = "time of a step, contiguous over shared, at the least N: shared is faster from there on"
    least = Interval(*[float(ratio.iloc[0])] * 3)
    claims.append(_claim("GI8", label, least, "shown, not judged", "shown"))
    return claims


def median_interval(values: Array) -> Interval:
    """Median with its distribution-free interval of at least 95 %."""
    ordered = np.sort(values)
    k = int(stats.binom.ppf(0.025, len(ordered), 0.5))
    if len(ordered) < 6:
        return Interval(float(np.median(ordered)), np.nan, np.nan)
    low, high = ordered[max(k - 1, 0)], ordered[len(ordered) - max(k, 1)]
    return Interval(float(np.median(ordered)), float(low), float(high))


def _trend(p: float, limit: float, n_worlds: int) -> str:
    """Judge Page's test; few worlds, or a p between the limit and 5 %, decide nothing."""
    if p < limit:
        return "reproduced"
    return "undecided" if p < 0.05 or n_worlds < 20 else "not reproduced"


def _diverged(table: pd.DataFrame) -> pd.Series[bool]:
    return table["online_rmse_m"] > 0.5 * table["odometry_rmse_m"]


Kind = tuple[str, bool, str, int, str]


def _kinds(distance: pd.DataFrame) -> list[tuple[Kind, pd.DataFrame]]:
    """Parts of the table that differ in dmax alone."""
    by = ["filter", "occluded", "noise", "n_seen", "rule"]
    return [
        ((str(f), bool(o), str(n), int(b), str(r)), part)
        for (f, o, n, b, r), part in distance.groupby(by, sort=False)
    ]


def _kind(key: Kind) -> str:
    name, occluded, noise, n_seen, rule = key
    seen = f"{n_seen} {rule}" if n_seen else "all visible"
    walls = "behind walls" if occluded else "no walls"
    return f"{NAMES[name]}, {seen}, {walls}, {NOISE[noise]}"


def _distances(
    part: pd.DataFrame, key: Kind, near: float, far: float, at_least: float
) -> tuple[str, Interval, str, str]:
    errors = pooled(part, "revised_rmse_m", ["max_distance_m"])
    found = log_ratio_interval(errors[near], errors[far])
    label = f"position error, dmax = {near:g} m over {far:g} m: {_kind(key)}"
    if key[4] == "nearest":
        return label, found, "shown, not judged", "shown"
    return label, found, f"above {at_least:g}", verdict(found, at_least=at_least)


def _equivalence(
    claim_id: str, label: str, first: Array | pd.Series[float], second: object, margin: float
) -> Claim:
    """Judge two one-sided tests that the paired ratio lies within 1 / (1 + m) and 1 + m."""
    found, _ = equivalent(np.asarray(first, float), np.asarray(second, float), margin)
    outcome = verdict(found, 1.0 / (1.0 + margin), 1.0 + margin)
    return _claim(
        claim_id, label, found, f"within {1 / (1 + margin):.2g} and {1 + margin:g}", outcome
    )


def _claim(claim_id: str, label: str, found: Interval, criterion: str, outcome: str) -> Claim:
    return Claim(claim_id, PAPER, label, found.value, found.low, found.high, criterion, outcome)
