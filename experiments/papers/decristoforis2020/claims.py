"""The claims DC1-DC6 of decristoforis2020."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from experiments.evaluation.registration_errors import METRICS
from experiments.evaluation.statistics import Interval, log_ratio_interval, mean_interval
from experiments.judging.by_words import (
    Claim,
    Conclusion,
    Verdict,
    banded,
    beside,
    conclude,
    lower,
    percent,
    pick,
    plain,
    shown,
)
from experiments.judging.results import Results
from experiments.papers.decristoforis2020.settings import CONSISTENT, PLACES, RATE_HZ
from sim.arrays import Array

_ERRORS = {"position": "ate_rmse_m", "heading": "heading_rmse_rad"}
_OVER_10_M = "rpe_10m_heading_rmse_rad"
_ORDER = (("fusion", "icp"), ("icp", "odometry"))
_BESIDE = (
    ("fusion", "icp_guess"), ("icp_guess", "icp"), ("fusion_clone", "icp"),
    ("fusion_clone", "fusion"),
)  # fmt: skip
_HOW = {  # of the ellipses
    "printed": "",
    "printed_12": ", planes of 12 neighbours",
    "printed_20": ", planes of 20 neighbours",
    "lines": ", lines and both scans",
}
_OPPOSITE = {
    Verdict.REPRODUCED: Verdict.NOT_REPRODUCED,
    Verdict.NOT_REPRODUCED: Verdict.REPRODUCED,
    Verdict.UNDECIDED: Verdict.UNDECIDED,
}
# As printed: the residual variance of the Hessian is taken from points, Censi's z is the last scan
_PRINTED = ("hessian_points", "sampling", "censi_last")
# Residuals from what was fitted to many points; both scans, as Censi published his form
_COVARIANCES = (*_PRINTED, "hessian", "censi", "censi_sliding")


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


def conclusions(_made: Results, claims: Sequence[Claim]) -> list[Conclusion]:
    """Verdict and sentence of DC1-DC6."""
    return conclude(
        claims,
        {
            "DC1": dc1_sentence,
            "DC2": dc2_sentence,
            "DC3": dc3_sentence,
            "DC4": dc4_sentence,
            "DC5": dc5_sentence,
            "DC6": dc6_sentence,
        },
    )


def dc1(runs: pd.DataFrame, ordering: pd.DataFrame) -> list[Claim]:
    """DC1: fusion beats ICP, and ICP beats odometry, in position and in heading.

    Headlines are the paper's own forms. Beside stand the heading error over 10 m; ICP started from
    the wheels, as the fusion is, which tells what the start adds from what fusion adds; our fusion;
    and the region of slip and range noise in which the paper's order holds.
    """
    table = judged_runs(runs)
    columns = {**_ERRORS}
    if _OVER_10_M in table:  # drives of the quick profile are shorter
        columns["heading over 10 m"] = _OVER_10_M
    claims = [
        beside(
            lower(
                "DC1", f"{name} RMSE, {better} over {worse}", *_paired(table, column, better, worse)
            ),
            (better, worse) not in _ORDER or column == _OVER_10_M,
        )
        for better, worse in (*_ORDER, *_BESIDE)
        for name, column in columns.items()
    ]
    region, share = _region(ordering)
    what = (
        "share of (k, range noise) at which the order holds in both errors, all intervals below 1"
    )
    return [*claims, shown("DC1", what, Interval.exact(share), f"where: {region}")]


def dc1_sentence(rows: Sequence[Claim]) -> str:
    """Say what fusion gains over registration, and registration over odometry."""

    def found(pair: str, error: str) -> str:
        return plain(pick(rows, f"{error} RMSE, {pair}").found.value)

    long = any("heading over 10 m" in row.statistic for row in rows)
    over_10_m = f" ({found('fusion over icp', 'heading over 10 m')} over 10 m)" if long else ""
    said = (
        f"Fusion has {found('fusion over icp', 'position')} times the position error of ICP alone "
        f"and {found('fusion over icp', 'heading')} times its heading error{over_10_m}; ICP alone "
        f"has {found('icp over odometry', 'position')} and {found('icp over odometry', 'heading')} "
        "times those of odometry. ICP started from the wheels, as the fusion is, has "
        f"{found('icp_guess over icp', 'position')} and {found('icp_guess over icp', 'heading')} "
        "times the errors of ICP alone"
    )
    cloned = [pick(rows, f"{error} RMSE, fusion_clone over fusion") for error in _ERRORS]
    if all(row.verdict is Verdict.REPRODUCED for row in cloned):
        said += (
            "; our fusion, which registers against lines and clones a reference pose, has "
            f"{plain(cloned[0].found.value)} and {plain(cloned[1].found.value)} times those of the "
            "printed one"
        )
    share = pick(rows, "share of (k, range noise)").found.value
    where = f"in {percent(share)}" if share else "in no part"
    return f"{said}. The whole order holds {where} of a map of wheel slip and range noise."


def dc2(ellipses: pd.DataFrame) -> Iterator[Claim]:
    """DC2: on a bare corridor the ellipse stretches along it, and shrinks near objects."""
    for method, where in _HOW.items():
        table = ellipses[ellipses["method"] == method]
        ratio, n = mean_interval(table["axis_ratio_bare"]), len(table)
        tilt = mean_interval(table["tilt_bare_deg"])
        shrinks = log_ratio_interval(table["long_objects_m"], table["long_bare_m"])
        for claim in (
            banded("DC2", f"long over short axis on the bare stretch{where}", ratio, 3.0, n=n),
            banded(
                "DC2", f"angle of the long axis to the corridor, deg{where}", tilt, at_most=10.0,
                n=n,
            ),
            banded("DC2", f"long axis near objects over bare{where}", shrinks, at_most=0.5, n=n),
        ):  # fmt: skip
            yield beside(claim, method != "printed")


def dc2_sentence(rows: Sequence[Claim]) -> str:
    """Say how long the ellipse is on the bare stretch and near objects."""
    ratio, tilt, shrinks = (
        pick(rows, words).found.value for words in ("long over short", "angle", "near objects")
    )
    return (
        f"On the bare corridor the long axis is {plain(ratio)} times the short one and "
        f"{plain(tilt)} deg off the corridor's direction; near objects it has {percent(shrinks)} "
        f"of that length. {_by_neighbours(rows)}"
    )


def _by_neighbours(rows: Sequence[Claim]) -> str:
    """Say what the ellipse owes to the number of neighbours, which the paper does not print."""
    of_6, *more = (
        pick(rows, "long over short", "bare stretch" + _HOW[method]).found.value
        for method in ("printed", "printed_12", "printed_20")
    )
    lines = pick(rows, "long over short", _HOW["lines"]).found.value
    shrinks = percent(pick(rows, "near objects", _HOW["lines"]).found.value)
    return (
        f"It hangs on the normals: the ratio is {plain(of_6)} with planes of 6 points, "
        f"{plain(more[0])} and {plain(more[1])} with those of 12 and 20, and {plain(lines)} with "
        "lines cut from the whole scan, as the noise of a normal passes for information along the "
        f"corridor. With those lines it shrinks to {shrinks} near objects."
    )


def dc3(ellipses: pd.DataFrame) -> Iterator[Claim]:
    """DC3: in a curve the ellipse turns and grows, then shrinks again; beside, in a sharp bend.

    Before and after are bare legs of like lengths.
    """
    for (method, where), bend in itertools.product(_HOW.items(), ("curve", "corner")):
        table = ellipses[ellipses["method"] == method]
        n, before = len(table), table[f"long_before_{bend}_m"]
        grown, typical, after = (
            log_ratio_interval(table[f"long_{part}_{bend}_m"], before)
            for part in ("in", "median_in", "after")
        )
        turned, is_beside = mean_interval(table[f"turned_in_{bend}_deg"]), bend == "corner"
        what = f"the {bend} over before{where}"
        for claim in (
            banded("DC3", f"largest long axis in {what}", grown, 1.5, n=n),
            beside(banded("DC3", f"median long axis in {what}", typical, 1.5, n=n)),
            banded("DC3", f"long axis after {what}", after, at_most=1.2, n=n),
            beside(
                banded("DC3", f"turn of the long axis in the {bend}, deg{where}", turned, 10.0, n=n)
            ),
        ):
            yield beside(claim, is_beside or method != "printed")


def dc3_sentence(rows: Sequence[Claim]) -> str:
    """Say how the ellipse turns and grows in the curve."""
    grown, typical, after, turned = (
        pick(rows, words, "curve") for words in ("largest", "median", "after", "turn of")
    )
    said = (
        f"In the curve the long axis turns by {plain(turned.found.value)} deg and grows to at most "
        f"{plain(grown.found.value)} times its length before; after it, it has "
        f"{plain(after.found.value)} times that length."
    )
    if grown.verdict is not Verdict.REPRODUCED and typical.found.high < 1.0:
        said += (
            f" Along most of the curve it is shorter than before (median "
            f"{percent(typical.found.value)}): the walls of the bend hold the direction that the "
            "corridor leaves free."
        )
    lines = pick(rows, "largest", "curve over before" + _HOW["lines"])
    return (
        f"{said} With lines cut from the whole scan it grows to {plain(lines.found.value)} times."
    )


def dc4(covariances: pd.DataFrame) -> Iterator[Claim]:
    """DC4: Hessian fast but wrong, sampling right but slow, Censi right and fast.

    Headlines are what the paper prints: planes of neighbours, the Hessian with the residual
    variance of points, sampling, and Censi's form by eqs. (6)-(8), where z is the last scan. Other
    metrics, residuals of what is fitted to many points, both scans as Censi published it and, point
    to point, matches that slide stand beside.
    """
    nees = nees_intervals(covariances)
    n = covariances["seed"].nunique()
    for metric in METRICS:
        is_beside = metric != METRICS[0]
        table = covariances[covariances["metric"] == metric]
        for place in PLACES:
            for method in _COVARIANCES:
                if method == "censi_sliding" and metric != "point_to_point":
                    continue
                found, (low, high) = nees[metric, place, method], CONSISTENT
                what = f"ANEES over dof of {method}, {metric}, {place}"
                claim = banded("DC4", what, found, low, high, n=n)
                if method.startswith("hessian"):
                    claim = replace(
                        claim,
                        verdict=_OPPOSITE[claim.verdict],
                        criterion=f"outside {low:g} and {high:g}",
                    )
                yield beside(claim, is_beside or method not in _PRINTED)
            bias = mean_interval(
                table[table["place"] == place].groupby("seed")["bias_of_motion"].first()
            )
            yield shown("DC4", f"median error along the motion over it, {metric}, {place}", bias)
        times = table.groupby(["method", "seed"])["time_us"].median().unstack("method").dropna()
        slower = log_ratio_interval(times["sampling"], times["censi_last"])
        label = f"time of sampling over Censi's closed form, {metric}"
        yield beside(banded("DC4", label, slower, at_least=10.0), is_beside)
        faster = log_ratio_interval(times["hessian"], times["sampling"])
        label = f"time of Hessian over sampling, {metric}"
        yield beside(banded("DC4", label, faster, at_most=0.1))


def dc4_sentence(rows: Sequence[Claim]) -> str:
    """Say how far each covariance is from the measured errors, and what it costs."""

    def over(method: str, metric: str = METRICS[0]) -> str:
        found = [r.found.value for r in rows if f"of {method}, {metric}" in r.statistic]
        return f"{plain(min(found))} to {plain(max(found))}"

    printed = [r for r in rows if f"of censi_last, {METRICS[0]}" in r.statistic]
    slower = pick(rows, "sampling over", METRICS[0]).found.value
    said = (
        f"With planes of neighbours, squared errors are {over('hessian_points')} times what the "
        f"Hessian expects from the residuals of points, {over('sampling')} times for sampling and "
        f"{over('censi_last')} times for the closed form as printed; sampling takes "
        f"{plain(slower)} times as long as the closed form."
    )
    if any(row.verdict is Verdict.NOT_REPRODUCED for row in printed):
        said += (
            " Eqs. (6)-(8) leave out the noise of the scan that is matched against; with both "
            f"scans, as Censi published it, the closed form has {over('censi')}, and "
            f"{over('censi', 'point_to_line')} with lines cut from the whole scan."
        )
    bias = pick(rows, "median error along", "point_to_point, corridor").found
    if bias.low > 0.0 or bias.high < 0.0:
        said += (
            f" Point to point has a bias of {plain(bias.value)} of the motion in corridors: its "
            "minimum itself is off, which no covariance of noise can tell."
        )
    return said


def nees_intervals(covariances: pd.DataFrame) -> dict[tuple[str, str, str], Interval]:
    """ANEES over dof, the mean over scenes, by metric, place and method."""
    known = covariances.dropna(subset="nees_over_dof").groupby(["metric", "place", "method"])
    return {key: mean_interval(nees) for key, nees in known["nees_over_dof"]}


def dc5(metrics: pd.DataFrame) -> Iterator[Claim]:
    """DC5: point to plane has the lower error and the lower time, over the same pairs.

    Both metrics start alike, match the same points and end by the same rule. The time has to be
    lower by a fifth, so that the verdict does not depend on the machine. Beside stand the lines cut
    from the whole scan, which have stages of their own.
    """
    wide = metrics.pivot(index=["class", "seed"], columns="metric")
    for kind in wide.index.unique("class"):
        for better in ("plane", "line"):
            for what, column, at_most in (
                ("position error", "error_m", 1.0),
                ("heading error", "error_rad", 1.0),
                ("time", "time_us", 0.8),
            ):
                pairs = (wide.loc[kind, (column, f"point_to_{to}")] for to in (better, "point"))
                ratio, n = log_ratio_interval(*pairs), len(wide.loc[kind])
                label = f"{what}, point to {better} over point to point, {kind}"
                claim = banded("DC5", label, ratio, at_most=at_most, n=n)
                yield beside(claim, better == "line")


def dc5_sentence(rows: Sequence[Claim]) -> str:
    """Say how much error and time point to plane saves."""

    def ranges(better: str) -> list[str]:
        found = {
            what: [
                row.found.value
                for row in rows
                if row.statistic.startswith(f"{what}, point to {better} over")
            ]
            for what in ("position error", "heading error", "time")
        }
        return [f"{plain(min(values))} to {plain(max(values))}" for values in found.values()]

    position, heading, time = ranges("plane")
    by_line = ranges("line")
    return (
        "Over the same pairs of scans, with the same points, start and stop rule, point to plane "
        f"has {position} times the position error of point to point, {heading} times its heading "
        f"error and {time} times its time; with lines cut from the whole scan it is {by_line[0]}, "
        f"{by_line[1]} and {by_line[2]}."
    )


def dc6(runs: pd.DataFrame) -> list[Claim]:
    """DC6: the map by fusion is the most accurate, the one by odometry the most distorted."""
    table = judged_runs(runs).assign(sharpness=lambda rows: np.exp(rows["map_entropy"]))
    return [
        beside(
            lower("DC6", f"{what}, {better} over {worse}", *_paired(table, column, better, worse)),
            (better, worse) not in _ORDER,
        )
        for better, worse in (*_ORDER, *_BESIDE)
        for what, column in (
            ("distance of map points to walls", "map_distance_m"),
            ("exp of map entropy", "sharpness"),
        )
    ]


def dc6_sentence(rows: Sequence[Claim]) -> str:
    """Say how far map points are from the walls, by method."""
    walls, sharp = (
        [pick(rows, what, pair) for pair in ("fusion over icp", "icp over odometry")]
        for what in ("distance", "entropy")
    )
    return (
        f"Map points by fusion are {plain(walls[0].found.value)} times as far from the true walls "
        f"as by ICP alone, and those by ICP alone {plain(walls[1].found.value)} times as far as by "
        f"odometry; the blur of the map (exp of its entropy) is {plain(sharp[0].found.value)} and "
        f"{plain(sharp[1].found.value)} times."
    )


def judged_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Rows at the printed 75 Hz on exact rays."""
    return runs.query(f"rate_hz == {RATE_HZ} and rays == 'exact'")


def _paired(table: pd.DataFrame, column: str, first: str, second: str) -> tuple[Array, Array]:
    """Values of two methods over the same recordings."""
    wide = table.pivot(index="seed", columns="method", values=column)[[first, second]].dropna()
    return wide[first].to_numpy(), wide[second].to_numpy()


def _region(ordering: pd.DataFrame) -> tuple[str, float]:
    """Cells in which the intervals of the order's ratios all lie below 1, and their share."""
    cells = ordering.groupby(["k_m", "sigma_range_m"])
    good = [
        f"k {k:g} sigma {sigma:g}"
        for (k, sigma), table in cells
        if all(
            log_ratio_interval(*_paired(table, column, *pair)).high < 1.0
            for pair in _ORDER
            for column in _ERRORS.values()
        )
    ]
    return ", ".join(good) or "nowhere", len(good) / max(len(cells), 1)
