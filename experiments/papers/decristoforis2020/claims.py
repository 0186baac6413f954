"""The claims DC1-DC6 of decristoforis2020."""

import itertools
from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from experiments.evaluation.registration_errors import METRICS
from experiments.evaluation.statistics import Interval, log_ratio_interval, mean_interval
from experiments.judging.claim import (
    Claim,
    Subject,
    beside,
    judge_bounds,
    judge_lower,
    own_design,
    shown,
    with_remark,
)
from experiments.judging.region import Region
from experiments.judging.region_runs import Compared, Headlines, judge_tables, judged_regions
from experiments.judging.results import Results
from experiments.judging.sequential import Design, designs, judge_ratio
from experiments.papers.decristoforis2020.settings import CONSISTENT, PLACES, PRINTED, WRONG_M
from sim.arrays import Array

_ERRORS = {"position": "ate_rmse_m", "heading": "heading_rmse_rad"}
_COSTS = (("position error", "error_m"), ("heading error", "error_rad"), ("time", "time_us"))
_OVER_10_M = "rpe_10m_heading_rmse_rad"
_ORDER = (("fusion", "icp"), ("fusion", "odometry"))
_BESIDE = (
    ("icp", "odometry"), ("fusion", "icp_guess"), ("icp_guess", "icp"), ("fusion_clone", "icp"),
    ("fusion_clone", "fusion"),
)  # fmt: skip
_FAR_TURN_DEG = 45.0  # of the ellipse: turns lie far below or far above
_HOW = {  # of the ellipses
    "printed": "",
    "lines": ", lines and both scans",
}
# Residuals from what was fitted to many points; both scans, as Censi published his form
_COVARIANCES = (*PRINTED, "hessian", "censi", "censi_sliding")


HEADLINES: Headlines = {
    **{
        claim: [
            Compared(
                f"{better}_{column}",
                f"{worse}_{column}",
                f"{better} / {worse}, {what}",
                at_most=1.0,
            )
            for better, worse in _ORDER
            for what, column in columns.items()
        ]
        for claim, columns in {"DC1": _ERRORS, "DC6": {"map": "map_distance_m"}}.items()
    },
    "DC2": [Compared("long_objects_m", "long_bare_m", "near objects / bare", at_most=1.0)],
    "DC3": [
        Compared("long_in_curve_m", "long_before_curve_m", "in the curve / before", at_least=1.0),
        Compared("long_after_curve_m", "long_in_curve_m", "after the curve / in it", at_most=1.0),
    ],
    "DC4": [
        Compared(
            "censi_last_off", "hessian_points_off", "Censi / Hessian, factor off", at_most=1.0
        ),
        Compared("sampling_time_us", "censi_last_time_us", "time, sampling / Censi", at_least=10.0),
    ],
    "DC5": [
        Compared(f"plane_{key}", f"point_{key}", f"plane / point, {what}", at_most=1.0)
        for what, key in _COSTS
    ],
}


def judge(results: Results) -> list[Claim]:
    """Judge DC1-DC6 by the tables."""
    return judge_tables(results, {
        "DC1": (dc1, {"runs": ()}),
        "DC2": (dc2, {"ellipses": ()}),
        "DC3": (dc3, {"ellipses": ()}),
        "DC4": (dc4, {"covariances": (), "closed_form": ("nees_over_dof",)}),
        "DC5": (dc5, {"metrics": ("failed",)}),
        "DC6": (dc6, {"runs": ("map_by_rotation_m",)}),
    })  # fmt: skip


def regions(results: Results) -> Mapping[str, Region]:
    """Where DC1-DC6 hold over the settings that the paper leaves open."""
    return judged_regions(results, HEADLINES)


def dc1(runs: pd.DataFrame, design: Design | None = None) -> list[Claim]:
    """DC1: fusion beats ICP alone and odometry alone, in position and in heading.

    Headlines are the paper's own forms. Beside: ICP alone against odometry, which the paper does
    not claim; the heading error over 10 m; ICP started from the wheels, as the fusion is, which
    distinguishes what the start adds from what fusion adds; and our fusion.
    """
    table, design = judged_runs(runs), design or designs("decristoforis2020")["DC1"]
    columns = {**_ERRORS}
    if _OVER_10_M in table:  # drives of the quick profile are shorter
        columns["heading over 10 m"] = _OVER_10_M
    claims = [
        beside(
            _order("DC1", f"{name} RMSE", table, column, pair, design),
            pair not in _ORDER or column == _OVER_10_M,
        )
        for pair in (*_ORDER, *_BESIDE)
        for name, column in columns.items()
    ]
    alone = [_paired(table, column, *pair) for pair in _ORDER for column in _ERRORS.values()]
    hits = np.logical_and.reduce([better < worse for better, worse in alone])
    return [*claims, own_design("DC1", "one drive", hits)]


def dc2(ellipses: pd.DataFrame) -> Iterator[Claim]:
    """DC2: on a bare corridor the ellipse stretches along it, and shrinks near objects."""
    for method, where in _HOW.items():
        table = ellipses[ellipses["method"] == method]
        if table.empty:
            continue
        ratio = mean_interval(table["axis_ratio_bare"])
        tilt = mean_interval(table["tilt_bare_deg"])
        shrinks = log_ratio_interval(table["long_objects_m"], table["long_bare_m"])
        for quantity, label, found, bounds in (
            ("ratio", "long over short axis on the bare stretch", ratio, (3.0,)),
            ("tilt", "angle of the long axis to the corridor, deg", tilt, (-np.inf, 10.0)),
            ("near objects", "long axis near objects over bare", shrinks, (-np.inf, 1.0)),
        ):
            about = Subject("DC2", quantity, method=method)
            yield beside(judge_bounds(about, label + where, found, *bounds), method != "printed")
    own = ellipses[ellipses["method"] == "printed"]
    yield own_design("DC2", "one corridor", own["long_objects_m"] < own["long_bare_m"])


def dc3(ellipses: pd.DataFrame, design: Design | None = None) -> list[Claim]:
    """DC3: in a curve the ellipse turns and grows, then shrinks again; beside, in a sharp bend.

    Before and after are bare legs of like lengths.
    """
    claims, design = [], design or designs("decristoforis2020")["DC3"]
    for (method, where), bend in itertools.product(_HOW.items(), ("curve", "corner")):
        table = ellipses[ellipses["method"] == method]
        if table.empty:
            continue
        is_beside = bend == "corner" or method != "printed"
        before, inside = table[f"long_before_{bend}_m"], table[f"long_in_{bend}_m"]
        after, median = table[f"long_after_{bend}_m"], table[f"long_median_in_{bend}_m"]
        what = f"the {bend}{where}"
        for quantity, label, arms, bounds in (
            ("grows", f"largest long axis in {what} over before", (inside, before), (1.0,)),
            (
                "shrinks",
                f"long axis after {what} over the largest",
                (after, inside),
                (-np.inf, 1.0),
            ),
        ):
            about = Subject("DC3", quantity, method=method, place=bend)
            claims.append(beside(judge_ratio(about, label, arms, design, *bounds), is_beside))
        turned = mean_interval(table[f"turned_in_{bend}_deg"])
        about = Subject("DC3", "turn", method=method, place=bend)
        claim = judge_bounds(about, f"turn of the long axis in {what}, deg", turned, 10.0)
        by_world = table[f"turned_in_{bend}_deg"].to_numpy()
        far = by_world[by_world > _FAR_TURN_DEG]
        near = by_world[by_world <= _FAR_TURN_DEG]
        facts = {"n": len(by_world), "far": far.tolist(), "near": near.tolist()}
        claims.append(beside(with_remark(claim, "", **facts), is_beside))
        about = Subject("DC3", "median", method=method, place=bend)
        typical = log_ratio_interval(median, before)
        claims.append(shown(about, f"median long axis in {what} over before", typical))
        if not is_beside:
            hits = (inside > before) & (after < inside) & (table[f"turned_in_{bend}_deg"] > 10.0)
            claims.append(own_design("DC3", "one curve", hits))
    return claims


def dc4(
    covariances: pd.DataFrame, closed_form: pd.DataFrame, design: Design | None = None
) -> Iterator[Claim]:
    """DC4: the closed form nearer to the truth than the Hessian, and far faster than sampling.

    How far off a covariance is, is the factor between its NEES over dof and one, over all places of
    a world. Headlines are what the paper prints: planes of neighbours, the Hessian with the
    residual variance of points, and Censi's form by eqs. (6)-(8), where z is the last scan; they
    have worlds of their own. Beside stand each place, our band for the NEES, the other metrics, and
    both scans as Censi published.
    """
    yield from closed_form_against_hessian(closed_form, design)
    for metric in METRICS:
        table = covariances[covariances["metric"] == metric]
        for place in (None, *PLACES):
            mean = _off(table if place is None else table[table["place"] == place])
            about = Subject("DC4", "off", method="censi_last", over="hessian_points",
                            metric=metric, place=place)  # fmt: skip
            label = f"factor by which Censi's form is off over the Hessian's, {metric}"
            label += f", {place}" if place else ""
            claim = judge_lower(about, label, mean["censi_last"], mean["hessian_points"])
            if place or metric != METRICS[0]:
                yield beside(claim)
        if metric != METRICS[0]:
            yield beside(_slower(table, metric))
        times = table.groupby(["method", "seed"])["time_us"].median().unstack("method").dropna()
        faster = log_ratio_interval(times["hessian"], times["sampling"])
        label = f"time of Hessian over sampling, {metric}"
        about = Subject("DC4", "time", method="hessian", over="sampling", metric=metric)
        yield beside(judge_bounds(about, label, faster, at_most=0.1))
        yield from _nees(covariances, metric)


def closed_form_against_hessian(
    closed_form: pd.DataFrame, design: Design | None = None
) -> Iterator[Claim]:
    """The headlines of DC4."""
    mean, metric = _off(closed_form), METRICS[0]
    arms = mean["censi_last"], mean["hessian_points"]
    about = Subject("DC4", "off", method="censi_last", over="hessian_points", metric=metric)
    label = f"factor by which Censi's form is off over the Hessian's, {metric}"
    design = design or designs("decristoforis2020")["DC4"]
    yield judge_ratio(about, label, arms, design, at_most=1.0)
    yield own_design("DC4", "one world", arms[0] < arms[1])
    yield _slower(closed_form, metric)


def _off(table: pd.DataFrame) -> pd.DataFrame:
    """How far off each covariance is, as a factor over the places of a world (seed x method)."""
    nees = table.pivot_table(
        index=["place", "seed"], columns="method", values="nees_over_dof", sort=False
    )
    return np.exp(np.log(nees).abs().groupby("seed").mean()).dropna()


def _slower(table: pd.DataFrame, metric: str) -> Claim:
    times = table.groupby(["method", "seed"])["time_us"].median().unstack("method").dropna()
    slower = log_ratio_interval(times["sampling"], times["censi_last"])
    label = f"time of sampling over Censi's closed form, {metric}"
    about = Subject("DC4", "time", method="sampling", over="censi_last", metric=metric)
    return judge_bounds(about, label, slower, at_least=10.0)


def _nees(covariances: pd.DataFrame, metric: str) -> Iterator[Claim]:
    """Judge each covariance against our band, and show the bias of the registrations."""
    nees, (low, high) = nees_intervals(covariances), CONSISTENT
    table = covariances[covariances["metric"] == metric]
    for place, method in itertools.product(PLACES, _COVARIANCES):
        if method != "censi_sliding" or metric == "point_to_point":
            what = f"ANEES over dof of {method}, {metric}, {place}"
            about = Subject("DC4", "ANEES", method=method, metric=metric, place=place)
            yield beside(judge_bounds(about, what, nees[metric, place, method], low, high))
    for place in PLACES:
        part = table[table["place"] == place]
        bias = mean_interval(part.groupby("seed")["bias_of_motion"].first())
        about = Subject("DC4", "bias", metric=metric, place=place)
        yield shown(about, f"median error along the motion over it, {metric}, {place}", bias)


def nees_intervals(covariances: pd.DataFrame) -> dict[tuple[str, str, str], Interval]:
    """ANEES over dof, the mean over scenes, by metric, place and method."""
    known = covariances.dropna(subset="nees_over_dof").groupby(["metric", "place", "method"])
    return {key: mean_interval(nees) for key, nees in known["nees_over_dof"]}


def dc5(metrics: pd.DataFrame, design: Design | None = None) -> Iterator[Claim]:
    """DC5: point to plane has the lower error and the lower time, over the same pairs.

    Both metrics start alike, match the same points and end by the same rule; a world's pairs of
    scans are averaged. Beside stand each kind of pair, the lines cut from the whole scan, which
    have stages of their own, and whether point to point is more stable: it fails less often.
    """
    design = design or designs("decristoforis2020")["DC5"]
    wide = metrics.pivot(index=["seed", "class"], columns="metric")
    kinds = wide.index.unique("class")
    for better, kind in itertools.product(("plane", "line"), (None, *kinds)):
        part = wide if kind is None else wide.xs(kind, level="class", drop_level=False)
        hits = []
        for what, column in _COSTS:
            logs = np.log(part[column].clip(lower=1e-9)).groupby("seed").mean()
            first, second = (np.exp(logs[f"point_to_{to}"]) for to in (better, "point"))
            label = f"{what}, point to {better} over point to point{', ' + kind if kind else ''}"
            about = Subject("DC5", what, metric=f"point_to_{better}", place=kind)
            claim = judge_ratio(about, label, (first, second), design, at_most=1.0)
            yield beside(claim, better == "line" or kind is not None)
            hits.append(first < second)
        if better == "plane" and kind is None:
            yield own_design("DC5", "one world", np.logical_and.reduce(hits))
    fails = wide["failed"].astype(float).groupby("seed").mean()
    found = mean_interval(fails["point_to_point"] - fails["point_to_plane"])
    about = Subject("DC5", "failures", metric="point_to_point", over="point_to_plane")
    label = f"share of failures ({WRONG_M:g} m off), point to point less point to plane"
    claim = judge_bounds(about, label, found, at_most=0.0, criterion="below 0", effect=0.05)
    shares = {to: float(fails[f"point_to_{to}"].mean()) for to in ("point", "plane")}
    yield beside(
        with_remark(claim, "the paper calls point to point more stable", wrong_m=WRONG_M, **shares)
    )


def dc6(runs: pd.DataFrame, design: Design | None = None) -> list[Claim]:
    """DC6: the map by fusion is truer than by ICP and by odometry, whose rotation is to blame."""
    table = judged_runs(runs).assign(sharpness=lambda rows: np.exp(rows["map_entropy"]))
    design = design or designs("decristoforis2020")["DC6"]
    what = "distance of map points to walls"
    claims = [
        beside(_order("DC6", name, table, column, pair, design), name != what or pair not in _ORDER)
        for pair in (*_ORDER, *_BESIDE)
        for name, column in (
            (what, "map_distance_m"),
            ("exponential of the map's entropy (its blur)", "sharpness"),
        )
    ]
    own = table[table["method"] == "odometry"]
    arms = own["map_by_rotation_m"], own["map_by_translation_m"]
    about = Subject("DC6", "cause", method="rotation", over="translation")
    label = (
        "distance of map points to walls by odometry's rotation alone over its translation alone"
    )
    claims.append(judge_ratio(about, label, arms, design, at_least=1.0))
    pairs = [_paired(table, "map_distance_m", *pair) for pair in _ORDER]
    hits = np.logical_and.reduce([better < worse for better, worse in pairs])
    return [*claims, own_design("DC6", "one drive", hits)]


def _order(
    claim: str,
    quantity: str,
    table: pd.DataFrame,
    column: str,
    pair: tuple[str, str],
    design: Design,
) -> Claim:
    """Judge that a column is lower by the first method of a pair than by the second."""
    about = Subject(claim, quantity, method=pair[0], over=pair[1])
    label, arms = f"{quantity}, {pair[0]} over {pair[1]}", _paired(table, column, *pair)
    return judge_ratio(about, label, arms, design, at_most=1.0)


def judged_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Rows at the rate of most drives, on exact rays."""
    exact = runs[runs["rays"] == "exact"]
    return exact[exact["rate_hz"] == exact["rate_hz"].mode()[0]]


def _paired(table: pd.DataFrame, column: str, first: str, second: str) -> tuple[Array, Array]:
    """Values of two methods over the same recordings."""
    wide = table.pivot(index="seed", columns="method", values=column)[[first, second]].dropna()
    return wide[first].to_numpy(), wide[second].to_numpy()
