"""The claims DC1-DC6 of decristoforis2020."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from experiments.evaluation.registration_errors import METRICS
from experiments.evaluation.statistics import Interval, log_ratio_interval, mean_interval
from experiments.evaluation.verdict import (
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
from experiments.papers.decristoforis2020.settings import CONSISTENT, PLACES
from experiments.papers.results import Results
from sim.arrays import Array

_ERRORS = {"position": "ate_rmse_m", "heading": "heading_rmse_rad"}
_ORDER = (("fusion", "icp"), ("icp", "odometry"))
_BESIDE = (("fusion_clone", "icp_keyframe"), ("fusion_clone", "fusion"))
_OPPOSITE = {
    Verdict.REPRODUCED: Verdict.NOT_REPRODUCED,
    Verdict.NOT_REPRODUCED: Verdict.REPRODUCED,
    Verdict.UNDECIDED: Verdict.UNDECIDED,
}
# The Hessian with residuals of points, as printed, or of fitted lines in tables without it; Censi's
# form as printed (the last scan), and beside it as he published it (both scans)
_COVARIANCES = ("hessian_points", "hessian", "sampling", "censi_last", "censi")


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
    sentences: dict[str, Callable[[Sequence[Claim]], str]] = {
        "DC1": dc1_sentence,
        "DC2": dc2_sentence,
        "DC3": dc3_sentence,
        "DC4": dc4_sentence,
        "DC5": dc5_sentence,
        "DC6": dc6_sentence,
    }
    return conclude(claims, sentences)


def dc1(runs: pd.DataFrame, ordering: pd.DataFrame) -> list[Claim]:
    """DC1: fusion beats ICP, and ICP beats odometry, in position and in heading.

    Headlines are the paper's own forms. Beside stand the key frames and the clone; ICP started from
    the wheels, as the fusion is, which tells what the start adds from what fusion adds; and the
    region of slip and range noise in which the paper's order holds.
    """
    table = judged_runs(runs)
    pairs = [*_ORDER, *_BESIDE]
    if "icp_guess" in set(table["method"]):
        pairs += [("fusion", "icp_guess"), ("icp_guess", "icp")]
    claims = [
        beside(
            lower(
                "DC1", f"{name} RMSE, {better} over {worse}", *_paired(table, column, better, worse)
            ),
            (better, worse) not in _ORDER,
        )
        for better, worse in pairs
        for name, column in _ERRORS.items()
    ]
    region, share = _region(ordering)
    what = "share of (k, range noise) at which the order holds in both errors"
    return [*claims, shown("DC1", what, Interval.exact(share), f"at {region}")]


def dc1_sentence(rows: Sequence[Claim]) -> str:
    """Say what fusion gains over registration, and registration over odometry."""
    position, heading, over_position, over_heading = (
        plain(pick(rows, f"{error} RMSE, {pair}").found.value)
        for pair in ("fusion over icp", "icp over odometry")
        for error in _ERRORS
    )
    said = (
        f"Fusion has {position} times the position error of ICP alone and {heading} times its "
        f"heading error; ICP alone has {over_position} and {over_heading} times those of odometry."
    )
    fused = [pick(rows, f"{error} RMSE, fusion over icp") for error in _ERRORS]
    cloned = [pick(rows, f"{error} RMSE, fusion_clone over fusion") for error in _ERRORS]
    if all(row.verdict is Verdict.REPRODUCED for row in fused):
        return said
    if all(row.verdict is Verdict.REPRODUCED for row in cloned):
        said += (
            " The printed filter takes successive registrations as independent, which they are "
            f"not: cloning a reference pose brings its errors to {plain(cloned[0].found.value)} "
            f"and {plain(cloned[1].found.value)} of what they were."
        )
    return said


def dc2(ellipses: pd.DataFrame) -> list[Claim]:
    """DC2: on a bare corridor the ellipse stretches along it, and shrinks near objects."""
    ratio = mean_interval(ellipses["axis_ratio_bare"])
    tilt = mean_interval(ellipses["tilt_bare_deg"])
    shrinks = log_ratio_interval(ellipses["long_objects_m"], ellipses["long_bare_m"])
    n = len(ellipses)
    return [
        banded("DC2", "long over short axis on the bare stretch", ratio, at_least=3.0, n=n),
        banded("DC2", "angle of the long axis to the corridor, deg", tilt, at_most=10.0, n=n),
        banded("DC2", "long axis near objects over bare", shrinks, at_most=0.5, n=n),
    ]


def dc2_sentence(rows: Sequence[Claim]) -> str:
    """Say how long the ellipse is on the bare stretch and near objects."""
    ratio, tilt, shrinks = (
        pick(rows, words).found.value for words in ("long over short", "angle", "near objects")
    )
    return (
        f"On the bare corridor the long axis is {plain(ratio)} times the short one and "
        f"{plain(tilt)} deg off the corridor's direction; near objects it has {percent(shrinks)} "
        "of that length."
    )


def dc3(ellipses: pd.DataFrame) -> Iterator[Claim]:
    """DC3: in a curve the ellipse turns and grows, then shrinks again; beside, in a sharp bend."""
    n = len(ellipses)
    for bend in ("curve", "corner"):
        before = ellipses[f"long_before_{bend}_m"]
        grown, typical, after = (
            log_ratio_interval(ellipses[f"long_{part}_{bend}_m"], before)
            for part in ("in", "median_in", "after")
        )
        turned = mean_interval(ellipses[f"turned_in_{bend}_deg"])
        claims = (
            banded("DC3", f"largest long axis in the {bend} over before", grown, 1.5, n=n),
            beside(banded("DC3", f"median long axis in the {bend} over before", typical, 1.5, n=n)),
            banded("DC3", f"long axis after the {bend} over before", after, at_most=1.2, n=n),
            banded("DC3", f"turn of the long axis in the {bend}, deg", turned, 10.0, n=n),
        )
        yield from (beside(claim, bend == "corner") for claim in claims)


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
    if grown.verdict is Verdict.NOT_REPRODUCED and typical.found.high < 1.0:
        said += (
            f" Along most of the curve it is shorter than before (median "
            f"{percent(typical.found.value)}): the walls of the bend hold the direction that the "
            "corridor leaves free."
        )
    return said


def dc4(covariances: pd.DataFrame) -> Iterator[Claim]:
    """DC4: Hessian fast but wrong, sampling right but slow, Censi right and fast.

    Headlines are point to line, the paper's metric: the Hessian with the residuals of points,
    sampling, and Censi's form by eqs. (6)-(8) as printed, where z is the last scan. Both scans, as
    Censi published it, the residuals of fitted lines and point to point stand beside.
    """
    nees = nees_intervals(covariances)
    n, there = covariances["seed"].nunique(), set(covariances["method"])
    hessian = "hessian_points" if "hessian_points" in there else "hessian"
    printed = {hessian, "sampling", "censi_last"}
    for metric in METRICS:
        is_beside = metric != "point_to_line"
        for place in PLACES:
            for method in (name for name in _COVARIANCES if name in there):
                found, (low, high) = nees[metric, place, method], CONSISTENT
                what = f"ANEES over dof of {method}, {metric}, {place}"
                claim = banded("DC4", what, found, low, high, n=n)
                if method.startswith("hessian"):
                    claim = replace(
                        claim,
                        verdict=_OPPOSITE[claim.verdict],
                        criterion=f"outside {low:g} and {high:g}",
                    )
                yield beside(claim, is_beside or method not in printed)
        table = covariances[covariances["metric"] == metric]
        times = table.groupby(["method", "seed"])["time_us"].median().unstack("method").dropna()
        slower = log_ratio_interval(times["sampling"], times["censi"])
        label = f"time of sampling over Censi's closed form, {metric}"
        yield beside(banded("DC4", label, slower, at_least=10.0), is_beside)
        faster = log_ratio_interval(times["hessian"], times["sampling"])
        label = f"time of Hessian over sampling, {metric}"
        yield beside(banded("DC4", label, faster, at_most=0.1), is_beside)


def dc4_sentence(rows: Sequence[Claim]) -> str:
    """Say how far each covariance is from the measured errors, and what it costs."""

    def over(method: str) -> str:
        found = [row.found.value for row in rows if f"of {method}, point_to_line" in row.statistic]
        return f"{plain(min(found))} to {plain(max(found))}"

    has_points = any("hessian_points" in row.statistic for row in rows)
    hessian, residuals = ("hessian_points", "points") if has_points else ("hessian", "fitted lines")
    printed = [r for r in rows if "of censi_last, point_to_line" in r.statistic]
    said = (
        f"With point to line, squared errors are {over(hessian)} times what the Hessian expects "
        f"from the residuals of {residuals}, "
        f"{over('sampling')} times for sampling and {over('censi_last')} times for the closed form "
        f"as printed; sampling takes {plain(pick(rows, 'sampling over', 'to_line').found.value)} "
        "times as long as the closed form."
    )
    if any(row.verdict is Verdict.NOT_REPRODUCED for row in printed):
        said += (
            " Eqs. (6)-(8) leave out the noise of the scan that is matched against; with both "
            f"scans, as Censi published it, the closed form has {over('censi')}."
        )
    return said


def nees_intervals(covariances: pd.DataFrame) -> dict[tuple[str, str, str], Interval]:
    """ANEES over dof, the mean over scenes, by metric, place and method."""
    known = covariances.dropna(subset="nees_over_dof").groupby(["metric", "place", "method"])
    return {key: mean_interval(nees) for key, nees in known["nees_over_dof"]}


def dc5(metrics: pd.DataFrame) -> Iterator[Claim]:
    """DC5: point to line has the lower error and the lower time, over the same pairs.

    The time has to be lower by half, so that the verdict does not depend on the machine.
    """
    wide = metrics.pivot(index=["class", "seed"], columns="metric")
    for kind in wide.index.unique("class"):
        for what, column, at_most in (
            ("position error", "error_m", 1.0),
            ("heading error", "error_rad", 1.0),
            ("time", "time_us", 0.5),
        ):
            pairs = (wide.loc[kind, (column, f"point_to_{to}")] for to in ("line", "point"))
            ratio, n = log_ratio_interval(*pairs), len(wide.loc[kind])
            label = f"{what}, point to line over point to point, {kind}"
            yield banded("DC5", label, ratio, at_most=at_most, n=n)


def dc5_sentence(rows: Sequence[Claim]) -> str:
    """Say how much error and time point to line saves."""
    greatest = {
        what: max(row.found.value for row in rows if row.statistic.startswith(what))
        for what in ("position", "heading", "time")
    }
    return (
        f"Over the same pairs of scans, point to line has at most {percent(greatest['position'])} "
        f"of the position error of point to point, {percent(greatest['heading'])} of its heading "
        f"error and {percent(greatest['time'])} of its time, each where it gains least."
    )


def dc6(runs: pd.DataFrame) -> list[Claim]:
    """DC6: the map by fusion is the most accurate, the one by odometry the most distorted."""
    table = judged_runs(runs).assign(sharpness=lambda rows: np.exp(rows["map_entropy"]))
    return [
        beside(
            lower("DC6", f"{what}, {better} over {worse}", *_paired(table, column, better, worse)),
            (better, worse) not in _ORDER,
        )
        for better, worse in (*_ORDER, ("fusion_clone", "icp_keyframe"))
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
