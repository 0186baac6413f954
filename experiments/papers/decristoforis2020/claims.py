"""The claims DC1-DC6 of decristoforis2020."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.evaluation.statistics import Interval, log_ratio_interval, mean_interval, verdict
from experiments.report.claims import Claim, lower

Array = NDArray[np.float64]

PAPER = "decristoforis2020"
_CONSISTENT = (0.8, 1.25)
_ERRORS = {"position": "ate_rmse_m", "heading": "heading_rmse_rad"}
_ORDER = (("fusion", "icp"), ("icp", "odometry"))


def dc1(runs: pd.DataFrame, ordering: pd.DataFrame) -> list[Claim]:
    """DC1: fusion beats ICP, and ICP beats odometry, in position and in heading.

    Judged for the paper's own forms and, beside them, for the key frames and the clone; then the
    region of slip and range noise in which the paper's order holds.
    """
    table = _judged(runs)
    claims = []
    for better, worse in (*_ORDER, ("fusion_clone", "icp_keyframe"), ("fusion_clone", "fusion")):
        for name, column in _ERRORS.items():
            first, second = _paired(table, column, better, worse)
            claims.append(_lower("DC1", f"{name} RMSE, {better} over {worse}", first, second))
    region, holds = _region(ordering)
    claims.append(
        Claim(
            "DC1",
            PAPER,
            f"share of (k, range noise) at which the order holds in both errors ({region})",
            holds,
            holds,
            holds,
            "mapped, no criterion",
            "shown",
        )
    )
    return claims


def dc2(ellipses: pd.DataFrame) -> list[Claim]:
    """DC2: on a bare corridor the ellipse stretches along it, and shrinks near objects."""
    ratio = mean_interval(ellipses["axis_ratio_bare"])
    tilt = mean_interval(ellipses["tilt_bare_deg"])
    shrinks = log_ratio_interval(ellipses["long_objects_m"], ellipses["long_bare_m"])
    return [
        _banded("DC2", "long over short axis on the bare stretch", ratio, at_least=3.0),
        _banded("DC2", "angle of the long axis to the corridor, deg", tilt, at_most=10.0),
        _banded("DC2", "long axis near objects over bare", shrinks, at_most=0.5),
    ]


def dc3(ellipses: pd.DataFrame) -> list[Claim]:
    """DC3: in a curve the ellipse turns and grows, then shrinks again; the same in a sharp bend."""
    claims = []
    for bend in ("curve", "corner"):
        before = ellipses[f"long_before_{bend}_m"]
        grown = log_ratio_interval(ellipses[f"long_in_{bend}_m"], before)
        typical = log_ratio_interval(ellipses[f"long_median_in_{bend}_m"], before)
        after = log_ratio_interval(ellipses[f"long_after_{bend}_m"], before)
        turned = mean_interval(ellipses[f"turned_in_{bend}_deg"])
        claims += [
            _banded("DC3", f"largest long axis in the {bend} over before", grown, at_least=1.5),
            _banded("DC3", f"median long axis in the {bend} over before", typical, at_least=1.5),
            _banded("DC3", f"long axis after the {bend} over before", after, at_most=1.2),
            _banded("DC3", f"turn of the long axis in the {bend}, deg", turned, at_least=10.0),
        ]
    return claims


def dc4(covariances: pd.DataFrame) -> list[Claim]:
    """DC4: Hessian fast but wrong, sampling right but slow, Censi right and fast.

    One verdict a metric and place, and one of the times.
    """
    claims = []
    for metric in ("point_to_line", "point_to_point"):
        for place in ("corridor", "corner", "curve", "room"):
            table = covariances[
                (covariances["metric"] == metric) & (covariances["place"] == place)
            ].dropna(subset="nees_over_dof")
            for method in ("hessian", "sampling", "censi"):
                nees = table.loc[table["method"] == method, "nees_over_dof"]
                found = log_ratio_interval(nees, np.ones(len(nees)))  # its geometric mean
                low, high = _CONSISTENT
                outcome = verdict(found, low, high)
                criterion = f"within {low:g} and {high:g}"
                if method == "hessian":
                    opposite = {"reproduced": "not reproduced", "not reproduced": "reproduced"}
                    outcome = opposite.get(outcome, outcome)  # type: ignore[assignment]
                    criterion = f"outside {low:g} and {high:g}"
                what = f"NEES over dof of {method}, {metric}, {place} (geometric mean of scenes)"
                claims.append(_claim("DC4", what, found, criterion, outcome))
        of = covariances[covariances["metric"] == metric].groupby(["method", "seed"])["time_us"]
        times = of.median().unstack("method").dropna()
        slower = log_ratio_interval(times["sampling"], times["censi"])
        what = f"time of sampling over Censi's closed form, {metric}"
        claims.append(_banded("DC4", what, slower, at_least=10.0))
        faster = log_ratio_interval(times["hessian"], times["sampling"])
        what = f"time of Hessian over sampling, {metric}"
        claims.append(_banded("DC4", what, faster, at_most=0.1))
    return claims


def dc5(metrics: pd.DataFrame) -> list[Claim]:
    """DC5: point to line has the lower error and the lower time, over the same pairs."""
    claims = []
    for kind, table in metrics.groupby("class"):
        for what, column in (("position error", "error_m"), ("heading error", "error_rad"),
                             ("time", "time_us")):  # fmt: skip
            wide = table.pivot(index="seed", columns="metric", values=column)
            ratio = log_ratio_interval(wide["point_to_line"], wide["point_to_point"])
            statistic = f"{what}, point to line over point to point, {kind}"
            claims.append(_banded("DC5", statistic, ratio, at_most=1.0))
    return claims


def dc6(runs: pd.DataFrame) -> list[Claim]:
    """DC6: the map by fusion is the truest, the one by odometry the most deformed."""
    table = _judged(runs)
    claims = []
    for better, worse in (*_ORDER, ("fusion_clone", "icp_keyframe")):
        first, second = _paired(table, "map_distance_m", better, worse)
        what = f"distance of map points to walls, {better} over {worse}"
        claims.append(_lower("DC6", what, first, second))
        first, second = (np.exp(part) for part in _paired(table, "map_entropy", better, worse))
        what = f"exp of map entropy, {better} over {worse}"
        claims.append(_lower("DC6", what, first, second))
    return claims


def _judged(runs: pd.DataFrame) -> pd.DataFrame:
    """Rows at 10 Hz on exact rays."""
    return runs[(runs["rate_hz"] == 10.0) & (runs["rays"] == "exact")]


def _paired(table: pd.DataFrame, column: str, first: str, second: str) -> tuple[Array, Array]:
    """Values of two methods over the same recordings."""
    wide = table.pivot(index="seed", columns="method", values=column)[[first, second]].dropna()
    return wide[first].to_numpy(), wide[second].to_numpy()


def _lower(claim: str, statistic: str, first: Array, second: Array) -> Claim:
    """Judge that the first arm is below the second."""
    ratio, p, outcome = lower(first, second)
    return _claim(claim, statistic, ratio, f"below 1, Wilcoxon p < 0.01 (p = {p:.2g})", outcome)


def _region(ordering: pd.DataFrame) -> tuple[str, float]:
    """Where the median paired log ratios of the order are all below 0; and at what share."""
    good, cells = [], 0
    for (k, sigma), table in ordering.groupby(["k_m", "sigma_range_m"]):
        cells += 1
        if all(
            np.median(np.log(np.divide(*_paired(table, column, *pair)))) < 0.0
            for pair in _ORDER
            for column in _ERRORS.values()
        ):
            good.append(f"k {k:g} sigma {sigma:g}")
    return ", ".join(good) or "nowhere", len(good) / max(cells, 1)


def _banded(
    claim: str,
    statistic: str,
    found: Interval,
    at_least: float = -math.inf,
    at_most: float = math.inf,
) -> Claim:
    bounds = [f"at least {at_least:g}"] if math.isfinite(at_least) else []
    bounds += [f"at most {at_most:g}"] if math.isfinite(at_most) else []
    outcome = verdict(found, at_least, at_most)
    return _claim(claim, statistic, found, " and ".join(bounds), outcome)


def _claim(claim: str, statistic: str, found: Interval, criterion: str, outcome: str) -> Claim:
    return Claim(claim, PAPER, statistic, found.value, found.low, found.high, criterion, outcome)
