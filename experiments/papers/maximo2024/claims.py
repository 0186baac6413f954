"""The claims MX1-MX5 of maximo2024, and three of our own on simulated clouds and kidnapping."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import (
    Interval,
    log_ratio_interval,
    mean_interval,
    share_interval,
)
from experiments.judging.claim import (
    Claim,
    Subject,
    Verdict,
    beside,
    judge_bounds,
    judge_equivalent,
    judge_lower,
    overall,
    shown,
    with_remark,
)
from experiments.judging.results import Results
from experiments.papers.maximo2024.settings import (
    BETWEEN_NODES_S,
    JUDGED_QUALITY,
    NAMES,
    RECOVERED_WITHIN,
    WITHIN,
)

_PAPERS, _BETWEEN = "the paper's", f"{BETWEEN_NODES_S:g} s between nodes"
_LEAST_M = 1e-3  # added to dispersions that may be zero, before a logarithm


def judge(results: Results) -> list[Claim]:
    """Judge MX1-MX8 by the tables."""
    quality = results.table("quality")
    return [
        *mx1(results.table("weighting"), quality, results.optional_table("runs")),
        *mx2(results.table("particles"), results.table("times")),
        *mx3(results.table("dispersion"), quality),
        *mx4(results.table("starts")),
        *mx5(results.table("clusters")),
        mx6(results.table("campus_starts")),
        mx7(results.table("campus_starts")),
        *mx8(results.table("kidnapping")),
    ]


def geometries(table: pd.DataFrame) -> list[str]:
    """Geometries of a table, the paper's before our own."""
    return [name for name in NAMES if name in set(table["geometry"])]


def headlines(names: Iterable[str]) -> set[str]:
    """Geometries of the paper's two data sets: UMH, and Oxford at its real positions if there."""
    known = set(names)
    return known & {"umh", "oxford_real" if "oxford_real" in known else "oxford"}


def _by_world(table: pd.DataFrame, column: str, by: str = "method") -> pd.DataFrame:
    """Mean over repeats: one row per world, one column per value of `by`."""
    return table.pivot_table(index="seed", columns=by, values=column, aggfunc="mean")


def mx1(
    weighting: pd.DataFrame, quality: pd.DataFrame, runs: pd.DataFrame | None = None
) -> Iterator[Claim]:
    """MX1: M2 is the best weighting; M3 fails on Oxford and holds on UMH.

    The methods share the parameters at which M2, the paper's choice, errs least on tuning worlds.
    The reason says at which B it holds in the map over B and noise. All Oxford runs, each on its
    real positions, stand beside, and so do queries off the route, as a control.
    """
    decisive = headlines(weighting["geometry"])
    for name in geometries(weighting):
        errors = _by_world(weighting[weighting["geometry"] == name], "error_m")
        for compare in (_m3_error, _m2_error):
            claim = compare(name, errors)
            if claim is not None:
                yield beside(_where(claim, compare, quality, name), name not in decisive)
    if runs is not None:
        errors = runs.pivot_table(index="run", columns="method", values="error_m")
        for method, hits, what in (
            ("M2", errors["M2"] < errors["M1"], "M2 below M1"),
            ("M3", errors["M3"] > 5.0 * errors["M2"], "M3 worse than 5 times M2"),
        ):
            found = share_interval(int(hits.sum()), len(hits))
            label = f"share of Oxford runs, real positions, with {what}"
            yield shown(Subject("MX1", "runs", method=method), label, found)


def _m3_error(name: str, errors: pd.DataFrame) -> Claim | None:
    """Judge M3 by the errors of worlds: it fails on Oxford, and holds on UMH."""
    about = Subject("MX1", "error", method="M3", over="M2", place=NAMES[name])
    if name.startswith("oxford"):
        label = f"share of worlds with M3 worse than 5 times M2, {NAMES[name]}"
        fails = replace(about, quantity="failures")
        return _share(fails, label, errors["M3"] > 5.0 * errors["M2"], at_least=0.8)
    if name.startswith("umh"):
        label = f"error of M3 over M2, {NAMES[name]}"
        return judge_equivalent(about, label, errors["M3"], errors["M2"], 0.25)
    return None


def _m2_error(name: str, errors: pd.DataFrame) -> Claim:
    about = Subject("MX1", "error", method="M2", over="M1", place=NAMES[name])
    return judge_lower(about, f"error of M2 over M1, {NAMES[name]}", errors["M2"], errors["M1"])


def mx3(dispersion: pd.DataFrame, quality: pd.DataFrame) -> Iterator[Claim]:
    """MX3: the choice of the weighting influences the dispersion of the particles, at step 10.

    The text says no more than that. All three are compared: M2 and M3, each with M1.
    """
    at_10 = dispersion[dispersion["step"] == 10]
    decisive = headlines(at_10["geometry"])
    for compare in (_m2_dispersion, _m3_dispersion):
        for name in geometries(at_10):
            claim = compare(name, _by_world(at_10[at_10["geometry"] == name], "dispersion_m"))
            yield beside(_where(claim, compare, quality, name), name not in decisive)


def _dispersion(method: str, name: str, worlds: pd.DataFrame) -> Claim:
    about = Subject("MX3", "dispersion", method=method, over="M1", place=NAMES[name])
    label = f"dispersion of {method} over M1 at step 10, {NAMES[name]}"
    return judge_lower(about, label, worlds[method] + _LEAST_M, worlds["M1"] + _LEAST_M)


_m2_dispersion, _m3_dispersion = partial(_dispersion, "M2"), partial(_dispersion, "M3")


Compare = Callable[[str, pd.DataFrame], Claim | None]
# The comparisons of weightings, each with the column of errors or dispersions that it reads
COMPARISONS: dict[Compare, str] = {
    _m2_error: "error_m",
    _m3_error: "error_m",
    _m2_dispersion: "dispersion_m",
    _m3_dispersion: "dispersion_m",
}


def judged_map(quality: pd.DataFrame, name: str, compare: Compare) -> pd.DataFrame:
    """Value and verdict of a comparison at each noise weight and B of a geometry.

    Returns
    -------
    DataFrame
        Columns noise_weight, n_nearest, about (a `Subject`), value, verdict.
    """
    part = quality[quality["geometry"] == name]
    rows = []
    for key, cell in part.groupby(["noise_weight", "n_nearest"]):
        claim = compare(name, _by_world(cell, COMPARISONS[compare]))
        if claim is not None:
            rows.append((*key, claim.about, claim.found.value, claim.verdict))
    return pd.DataFrame(rows, columns=["noise_weight", "n_nearest", "about", "value", "verdict"])


def _where(claim: Claim, compare: Compare, quality: pd.DataFrame, name: str) -> Claim:
    """Add the B at which a comparison holds in the map, at the descriptors of the study."""
    cells = judged_map(quality, name, compare)
    cells = cells[cells["noise_weight"] == JUDGED_QUALITY]
    tried = cells["n_nearest"].tolist()
    good = cells.loc[cells["verdict"] == Verdict.REPRODUCED, "n_nearest"].tolist()
    where = f"B = {', '.join(map(str, good))}" if good else "no B"
    remark = f"holds at {where} of {', '.join(map(str, tried))}" if tried else ""
    return with_remark(claim, remark, holds_at=good, tried=tried)


def mx2(particles: pd.DataFrame, times: pd.DataFrame) -> Iterator[Claim]:
    """MX2: the error does not depend on the number of particles, the time grows with it.

    Bounds on times leave a factor of ten for other machines.
    """
    for name, part in particles.groupby("geometry", sort=False):
        errors = _by_world(part, "error_m", "per_node")
        label = (
            f"error with more or fewer particles a node over that with 4, the worst, {NAMES[name]}"
        )
        about = Subject("MX2", "error", over="4 particles a node", place=NAMES[name])
        each = {
            n: judge_equivalent(about, label, errors[n], errors[4], 0.05) for n in errors if n != 4
        }
        worst = max(each, key=lambda n: abs(math.log(each[n].found.value)))
        verdict = overall([c.verdict for c in each.values()])
        claim = replace(each[worst], verdict=verdict, power=min(c.power for c in each.values()))
        claim = with_remark(claim, f"{worst} particles a node")
        yield beside(claim, name not in headlines(particles["geometry"]))
    for name, part in times.groupby("geometry", sort=False):
        counts = part.groupby("particles")["time_s"]
        shares = {_PAPERS: part["time_s"] / part["paper_s"]}
        if name.startswith("oxford"):
            shares[_BETWEEN] = part["time_s"] / BETWEEN_NODES_S
        for what, share in shares.items():
            label = f"time a node over {what}, the largest, {NAMES[name]}"
            each = share.groupby(part["particles"])
            most = each.median().idxmax()
            found = Interval(
                *(float(getattr(each, end)()[most]) for end in ("median", "min", "max"))
            )
            about = Subject("MX2", "time", over=what, place=NAMES[name])
            yield judge_bounds(about, label, found, at_most=0.1)
        (low, fewest), *_, (most, largest) = ((k, v.to_numpy()) for k, v in counts)
        grown = Interval(
            float(np.median(largest) / np.median(fewest)),
            float(largest.min() / fewest.max()),
            float(largest.max() / fewest.min()),
        )
        label = f"time a node with the most particles over that with the fewest, {NAMES[name]}"
        about = Subject("MX2", "time", over="the fewest", place=NAMES[name])
        claim = judge_bounds(about, label, grown, at_least=1.0, criterion="above 1")
        yield with_remark(claim, f"{most} particles over {low}")
    yield from _oxford_slower(times)


def _oxford_slower(times: pd.DataFrame) -> Iterator[Claim]:
    """Judge that Oxford, which has more nodes, takes longer, with as many particles a node."""
    counts = times.groupby("geometry")["particles"]
    per_node = (times["particles"] / counts.transform("min")).rename("per_node")  # of the fewest
    each = times.groupby(["geometry", per_node])["time_s"].agg(["median", "min", "max"])
    for oxford in {name for name in times["geometry"] if name.startswith("oxford")}:
        ours, other = each.loc[oxford], each.loc["umh"]
        least = (ours["median"] / other["median"]).idxmin()
        found = Interval(
            float(ours["median"][least] / other["median"][least]),
            float(ours["min"][least] / other["max"][least]),
            float(ours["max"][least] / other["min"][least]),
        )
        label = f"time a node over that of UMH, the smallest, {NAMES[oxford]}"
        about = Subject("MX2", "time", over="UMH", place=NAMES[oxford])
        yield judge_bounds(about, label, found, at_least=1.0, criterion="above 1")


def _share(
    about: Subject,
    label: str,
    hits: pd.Series[bool],
    at_least: float = -math.inf,
    at_most: float = math.inf,
    *,
    criterion: str = "",
) -> Claim:
    found = share_interval(int(hits.sum()), len(hits))
    return judge_bounds(about, label, found, at_least, at_most, criterion=criterion)


def mx4(starts: pd.DataFrame) -> Iterator[Claim]:
    """MX4: any starting node works."""
    decisive = headlines(starts["geometry"])
    for name, part in starts.groupby("geometry", sort=False):
        label = f"share of starts that M2 localises within {WITHIN} steps, {NAMES[name]}"
        about = Subject("MX4", "starts", place=NAMES[name], setting=WITHIN)
        settled = part["settled_at"] <= WITHIN
        claim = _share(about, label, settled, at_least=0.95, criterion="lower bound above 0.95")
        yield beside(claim, name not in decisive)


def mx5(clusters: pd.DataFrame) -> Iterator[Claim]:
    """MX5: clusters of descriptors are stretches of the route.

    On the synthetic field this holds by construction. Scan Context is left out, since it turns
    with the robot, which k-means does not allow for.
    """
    asked = clusters[clusters["descriptor"] != "scan_context"]
    decisive = headlines(asked["geometry"])
    shares = asked.groupby(["geometry", "descriptor"], sort=False)["contiguous"]
    for (name, descriptor), part in shares:
        place = NAMES[name] if descriptor == "synthetic" else f"{NAMES[name]}, {descriptor}"
        about = Subject("MX5", "contiguous", method=descriptor, place=place)
        label = f"share of nodes with a route neighbour in their cluster, {place}"
        found = mean_interval(part)
        claim = judge_bounds(about, label, found, at_least=0.8, criterion="above 0.8")
        yield beside(claim, name not in decisive)


def mx6(starts: pd.DataFrame) -> Claim:
    """Our own: global localization on simulated clouds."""
    label = "share of starts localised on campus clouds (our own)"
    about = Subject("MX6", "starts", setting=WITHIN)
    return _share(about, label, starts["settled_at"] <= WITHIN, at_least=0.95)


def mx7(starts: pd.DataFrame) -> Claim:
    """Our own, the paper's future work: registration brings the error below the spacing."""
    worlds = starts.dropna(subset="rms_m").groupby("seed")[["spacing_m", "rms_m"]].mean()
    ratio = log_ratio_interval(worlds["spacing_m"], worlds["rms_m"])
    label = "node spacing over RMS error with refinement, campus clouds (our own)"
    return judge_bounds(Subject("MX7", "spacing"), label, ratio, at_least=5.0)


def mx8(kidnapping: pd.DataFrame) -> Iterator[Claim]:
    """Our own: a kidnapped robot is found again with injection, and not without."""
    known = kidnapping[kidnapping["known_before"]]
    back = known["settled_at"] <= RECOVERED_WITHIN
    trials = back.groupby([known["geometry"], known["injection"] > 0.0], sort=False)
    for (name, injects), recovered in trials:
        arm = "with" if injects else "without"
        about = Subject("MX8", "recovered", arm=arm, place=NAMES[name], setting=RECOVERED_WITHIN)
        label = (
            f"share recovered within {RECOVERED_WITHIN} nodes {arm} injection, "
            f"{NAMES[name]} (our own)"
        )
        yield _share(about, label, recovered, *((0.95,) if injects else (-math.inf, 0.5)))
