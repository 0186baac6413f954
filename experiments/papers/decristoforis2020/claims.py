"""The claims DC1-DC6 of decristoforis2020."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from experiments.evaluation.registration_errors import METRICS
from experiments.evaluation.statistics import Interval, log_ratio_interval, mean_interval
from experiments.evaluation.verdict import Claim, Verdict, banded, judged, lower
from experiments.papers.decristoforis2020.settings import CONSISTENT, PLACES
from experiments.papers.results import Results
from sim.arrays import Array

_ERRORS = {"position": "ate_rmse_m", "heading": "heading_rmse_rad"}
_ORDER = (("fusion", "icp"), ("icp", "odometry"))
_OPPOSITE = {
    Verdict.REPRODUCED: Verdict.NOT_REPRODUCED,
    Verdict.NOT_REPRODUCED: Verdict.REPRODUCED,
    Verdict.UNDECIDED: Verdict.UNDECIDED,
}


def judge(made: Results) -> list[Claim]:
    """Judge DC1-DC6 by the tables."""
    runs, ellipses = made.table("runs"), made.table("ellipses")
    return [
        *dc1(runs, made.table("ordering")),
        *dc2(ellipses),
        *dc3(ellipses),
        *dc4(made.table("covariances")),
        *dc5(made.table("metrics")),
        *dc6(runs),
    ]


def dc1(runs: pd.DataFrame, ordering: pd.DataFrame) -> list[Claim]:
    """DC1: fusion beats ICP, and ICP beats odometry, in position and in heading.

    Judged for the paper's own forms and, beside them, for the key frames and the clone; then the
    region of slip and range noise in which the paper's order holds.
    """
    table = judged_runs(runs)
    claims = [
        _lower("DC1", f"{name} RMSE, {better} over {worse}", *_paired(table, column, better, worse))
        for better, worse in (*_ORDER, ("fusion_clone", "icp_keyframe"), ("fusion_clone", "fusion"))
        for name, column in _ERRORS.items()
    ]
    region, share = _region(ordering)
    what = f"share of (k, range noise) at which the order holds in both errors ({region})"
    found = Interval.exact(share)
    return [*claims, Claim("DC1", what, found, "mapped, no criterion", Verdict.SHOWN)]


def dc2(ellipses: pd.DataFrame) -> list[Claim]:
    """DC2: on a bare corridor the ellipse stretches along it, and shrinks near objects."""
    ratio = mean_interval(ellipses["axis_ratio_bare"])
    tilt = mean_interval(ellipses["tilt_bare_deg"])
    shrinks = log_ratio_interval(ellipses["long_objects_m"], ellipses["long_bare_m"])
    return [
        banded("DC2", "long over short axis on the bare stretch", ratio, at_least=3.0),
        banded("DC2", "angle of the long axis to the corridor, deg", tilt, at_most=10.0),
        banded("DC2", "long axis near objects over bare", shrinks, at_most=0.5),
    ]


def dc3(ellipses: pd.DataFrame) -> Iterator[Claim]:
    """DC3: in a curve the ellipse turns and grows, then shrinks again; the same in a sharp bend."""
    for bend in ("curve", "corner"):
        before = ellipses[f"long_before_{bend}_m"]
        grown, typical, after = (
            log_ratio_interval(ellipses[f"long_{part}_{bend}_m"], before)
            for part in ("in", "median_in", "after")
        )
        turned = mean_interval(ellipses[f"turned_in_{bend}_deg"])
        yield from (
            banded("DC3", f"largest long axis in the {bend} over before", grown, at_least=1.5),
            banded("DC3", f"median long axis in the {bend} over before", typical, at_least=1.5),
            banded("DC3", f"long axis after the {bend} over before", after, at_most=1.2),
            banded("DC3", f"turn of the long axis in the {bend}, deg", turned, at_least=10.0),
        )


def dc4(covariances: pd.DataFrame) -> Iterator[Claim]:
    """DC4: Hessian fast but wrong, sampling right but slow, Censi right and fast.

    One verdict per metric and place, and two on the times of each metric.
    """
    low, high = CONSISTENT
    nees = nees_intervals(covariances)
    for metric in METRICS:
        for place in PLACES:
            for method in ("hessian", "sampling", "censi"):
                found = nees[metric, place, method]
                verdict, side = judged(found, low, high), "within"
                if method == "hessian":
                    verdict, side = _OPPOSITE[verdict], "outside"
                what = f"NEES over dof of {method}, {metric}, {place} (geometric mean of scenes)"
                yield Claim("DC4", what, found, f"{side} {low:g} and {high:g}", verdict)
        table = covariances[covariances["metric"] == metric]
        times = table.groupby(["method", "seed"])["time_us"].median().unstack("method").dropna()
        slower = log_ratio_interval(times["sampling"], times["censi"])
        label = f"time of sampling over Censi's closed form, {metric}"
        yield banded("DC4", label, slower, at_least=10.0)
        faster = log_ratio_interval(times["hessian"], times["sampling"])
        yield banded("DC4", f"time of Hessian over sampling, {metric}", faster, at_most=0.1)


def nees_intervals(covariances: pd.DataFrame) -> dict[tuple[str, str, str], Interval]:
    """Geometric mean over scenes of the NEES over dof, by metric, place and method."""
    known = covariances.dropna(subset="nees_over_dof").groupby(["metric", "place", "method"])
    return {
        key: log_ratio_interval(nees, np.ones(len(nees))) for key, nees in known["nees_over_dof"]
    }


def dc5(metrics: pd.DataFrame) -> list[Claim]:
    """DC5: point to line has the lower error and the lower time, over the same pairs."""
    wide = metrics.pivot(index=["class", "seed"], columns="metric")
    measures = (("position error", "error_m"), ("heading error", "error_rad"), ("time", "time_us"))
    return [
        banded(
            "DC5",
            f"{what}, point to line over point to point, {kind}",
            log_ratio_interval(
                wide.loc[kind, (column, "point_to_line")],
                wide.loc[kind, (column, "point_to_point")],
            ),
            at_most=1.0,
        )
        for kind in wide.index.unique("class")
        for what, column in measures
    ]


def dc6(runs: pd.DataFrame) -> list[Claim]:
    """DC6: the map by fusion is the most accurate, the one by odometry the most distorted."""
    table = judged_runs(runs).assign(sharpness=lambda rows: np.exp(rows["map_entropy"]))
    return [
        _lower("DC6", f"{what}, {better} over {worse}", *_paired(table, column, better, worse))
        for better, worse in (*_ORDER, ("fusion_clone", "icp_keyframe"))
        for what, column in (
            ("distance of map points to walls", "map_distance_m"),
            ("exp of map entropy", "sharpness"),
        )
    ]


def judged_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Rows at 10 Hz on exact rays."""
    return runs.query("rate_hz == 10.0 and rays == 'exact'")


def _paired(table: pd.DataFrame, column: str, first: str, second: str) -> tuple[Array, Array]:
    """Values of two methods over the same recordings."""
    wide = table.pivot(index="seed", columns="method", values=column)[[first, second]].dropna()
    return wide[first].to_numpy(), wide[second].to_numpy()


def _region(ordering: pd.DataFrame) -> tuple[str, float]:
    """Cells in which the median log ratios of the order are all below 0, and their share."""
    cells = ordering.groupby(["k_m", "sigma_range_m"])
    good = [
        f"k {k:g} sigma {sigma:g}"
        for (k, sigma), table in cells
        if all(
            np.median(np.log(np.divide(*_paired(table, column, *pair)))) < 0.0
            for pair in _ORDER
            for column in _ERRORS.values()
        )
    ]
    return ", ".join(good) or "nowhere", len(good) / max(len(cells), 1)


def _lower(claim: str, statistic: str, first: Array, second: Array) -> Claim:
    """Judge that the first arm is below the second."""
    ratio, p, verdict = lower(first, second)
    return Claim(claim, statistic, ratio, f"below 1, Wilcoxon p < 0.01 (p = {p:.2g})", verdict)
