"""The claims MX1-MX5 of maximo2024, and three of our own on simulated clouds and kidnapping."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
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
from experiments.judging.by_words import (
    Claim,
    Conclusion,
    Role,
    Verdict,
    banded,
    beside,
    conclude,
    equivalent,
    lower,
    overall,
    percent,
    pick,
    plain,
    remarked,
    shown,
)
from experiments.judging.results import Results
from experiments.papers.maximo2024.settings import (
    BETWEEN_NODES_S,
    JUDGED_QUALITY,
    NAMES,
    RECOVERED_WITHIN,
    WITHIN,
)

_LEAST_M = 1e-3  # added to dispersions that may be zero, before a logarithm


def judge(made: Results) -> list[Claim]:
    """Judge MX1-MX8 by the tables."""
    quality = made.table("quality")
    runs = made.table("runs") if made.has_table("runs") else None
    return [
        *mx1(made.table("weighting"), quality, runs),
        *mx2(made.table("particles"), made.table("times")),
        *mx3(made.table("dispersion"), quality),
        *mx4(made.table("starts")),
        *mx5(made.table("clusters")),
        mx6(made.table("campus_starts")),
        mx7(made.table("campus_starts")),
        *mx8(made.table("kidnapping")),
    ]


def conclusions(_made: Results, claims: Sequence[Claim]) -> list[Conclusion]:
    """Verdict and sentence of MX1-MX8."""
    sentences: dict[str, Callable[[Sequence[Claim]], str]] = {
        "MX1": mx1_sentence,
        "MX2": mx2_sentence,
        "MX3": mx3_sentence,
        "MX4": mx4_sentence,
        "MX5": mx5_sentence,
        "MX6": mx6_sentence,
        "MX7": mx7_sentence,
        "MX8": mx8_sentence,
    }
    return conclude(claims, sentences, "worlds")


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
                claim = remarked(claim, _where(compare, quality, name))
                yield beside(claim, name not in decisive)
    if runs is not None:
        errors = runs.pivot_table(index="run", columns="method", values="error_m")
        for hits, what in (
            (errors["M2"] < errors["M1"], "M2 below M1"),
            (errors["M3"] > 5.0 * errors["M2"], "M3 worse than 5 times M2"),
        ):
            found = share_interval(int(hits.sum()), len(hits))
            yield shown("MX1", f"share of Oxford runs, real positions, with {what}", found)


def _m3_error(name: str, errors: pd.DataFrame) -> Claim | None:
    """Judge M3 by the errors of worlds: it fails on Oxford, and holds on UMH."""
    if name.startswith("oxford"):
        label = f"share of worlds with M3 worse than 5 times M2, {NAMES[name]}"
        return _share("MX1", label, errors["M3"] > 5.0 * errors["M2"], at_least=0.8)
    if name.startswith("umh"):
        label = f"error of M3 over M2, {NAMES[name]}"
        return equivalent("MX1", label, errors["M3"], errors["M2"], 0.25)
    return None


def _m2_error(name: str, errors: pd.DataFrame) -> Claim:
    return lower("MX1", f"error of M2 over M1, {NAMES[name]}", errors["M2"], errors["M1"])


def mx1_sentence(rows: Sequence[Claim]) -> str:
    """Say which weighting errs least, and where M3 fails."""
    judged_rows = list(filter(_is_headline, rows))
    below = [row for row in judged_rows if row.statistic.startswith("error of M2 over M1")]
    parts = [f"{plain(row.found.value, 3)} on {_place(row)} ({_p(row)})" for row in below]
    fails = pick(judged_rows, "5 times M2")
    said = (
        f"With shared parameters M2's error over M1's is {' and '.join(parts)}. M3 is worse than 5 "
        f"times M2 in {percent(fails.found.value)} of worlds on Oxford"
    )
    same = [row for row in judged_rows if "error of M3 over M2" in row.statistic]
    if same:
        said += f", and has {plain(same[0].found.value)} times M2's error on UMH"
    where = f" Of the numbers B tried, that on Oxford {fails.reason}." if fails.reason else ""
    return f"{said}.{where}"


def mx3(dispersion: pd.DataFrame, quality: pd.DataFrame) -> Iterator[Claim]:
    """MX3: the choice of the weighting influences the dispersion of the particles, at step 10.

    The text says no more than that. All three are compared: M2 and M3, each with M1.
    """
    at_10 = dispersion[dispersion["step"] == 10]
    decisive = headlines(at_10["geometry"])
    for compare in (_m2_dispersion, _m3_dispersion):
        for name in geometries(at_10):
            worlds = _by_world(at_10[at_10["geometry"] == name], "dispersion_m")
            claim = compare(name, worlds)
            where = _where(compare, quality, name)
            yield beside(remarked(claim, where), name not in decisive)


def _m2_dispersion(name: str, worlds: pd.DataFrame) -> Claim:
    return _less_dispersed("M2", name, worlds)


def _m3_dispersion(name: str, worlds: pd.DataFrame) -> Claim:
    return _less_dispersed("M3", name, worlds)


def _less_dispersed(method: str, name: str, worlds: pd.DataFrame) -> Claim:
    label = f"dispersion of {method} over M1 at step 10, {NAMES[name]}"
    return lower("MX3", label, worlds[method] + _LEAST_M, worlds["M1"] + _LEAST_M)


def mx3_sentence(rows: Sequence[Claim]) -> str:
    """Say how far particles have concentrated after ten steps, by the weighting."""
    judged_rows = list(filter(_is_headline, rows))
    parts = [
        f"{row.statistic.removeprefix('dispersion of ').split(' at ')[0]} on {_place(row)} "
        f"{plain(row.found.value)} ({_p(row)})"
        for row in judged_rows
    ]
    return f"Ratios of the dispersions after ten steps: {'; '.join(parts)}."


def _is_headline(row: Claim) -> bool:
    return row.role is Role.HEADLINE


def _place(row: Claim) -> str:
    """The geometry, which ends a statistic."""
    return row.statistic.split(", ", 1)[1].removesuffix(" (90 % interval)")


def _p(row: Claim) -> str:
    return f"p = {row.reason.split('p = ')[-1].split(';')[0]}"


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
        Columns noise_weight, n_nearest, statistic, value, verdict.
    """
    part = quality[quality["geometry"] == name]
    rows = []
    for key, cell in part.groupby(["noise_weight", "n_nearest"]):
        claim = compare(name, _by_world(cell, COMPARISONS[compare]))
        if claim is not None:
            rows.append((*key, claim.statistic, claim.found.value, claim.verdict))
    columns = ["noise_weight", "n_nearest", "statistic", "value", "verdict"]
    return pd.DataFrame(rows, columns=columns)


def _where(compare: Compare, quality: pd.DataFrame, name: str) -> str:
    """Name the B at which a comparison holds in the map, at the descriptors of the study."""
    cells = judged_map(quality, name, compare)
    cells = cells[cells["noise_weight"] == JUDGED_QUALITY]
    good = cells.loc[cells["verdict"] == Verdict.REPRODUCED, "n_nearest"]
    where = f"B = {', '.join(map(str, good))}" if len(good) else "no B"
    tried = ", ".join(map(str, cells["n_nearest"]))
    return "" if cells.empty else f"holds at {where} of {tried}"


def mx2(particles: pd.DataFrame, times: pd.DataFrame) -> Iterator[Claim]:
    """MX2: the error does not depend on the number of particles, the time grows with it.

    Bounds on times leave a factor of ten for other machines.
    """
    for name, part in particles.groupby("geometry", sort=False):
        errors = _by_world(part, "error_m", "per_node")
        label = (
            f"error with more or fewer particles a node over that with 4, the worst, {NAMES[name]}"
        )
        each = {n: equivalent("MX2", label, errors[n], errors[4], 0.05) for n in errors if n != 4}
        worst = max(each, key=lambda n: abs(math.log(each[n].found.value)))
        verdict, more = (
            overall([c.verdict for c in each.values()]),
            max(c.more for c in each.values()),
        )
        claim = replace(each[worst], verdict=verdict, more=more)
        claim = remarked(claim, f"{worst} particles a node")
        yield beside(claim, name not in headlines(particles["geometry"]))
    for name, part in times.groupby("geometry", sort=False):
        counts = part.groupby("particles")["time_s"]
        shares = {"the paper's": part["time_s"] / part["paper_s"]}
        if name.startswith("oxford"):
            shares[f"{BETWEEN_NODES_S:g} s between nodes"] = part["time_s"] / BETWEEN_NODES_S
        for what, share in shares.items():
            label = f"time a node over {what}, the largest, {NAMES[name]}"
            each = share.groupby(part["particles"])
            most = each.median().idxmax()
            found = Interval(
                *(float(getattr(each, end)()[most]) for end in ("median", "min", "max"))
            )
            yield banded("MX2", label, found, at_most=0.1)
        (least, fewest), *_, (most, largest) = ((k, v.to_numpy()) for k, v in counts)
        grown = Interval(
            float(np.median(largest) / np.median(fewest)),
            float(largest.min() / fewest.max()),
            float(largest.max() / fewest.min()),
        )
        label = f"time a node with the most particles over that with the fewest, {NAMES[name]}"
        claim = banded("MX2", label, grown, at_least=1.0, criterion="above 1")
        yield remarked(claim, f"{most} particles over {least}")
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
        yield banded("MX2", label, found, at_least=1.0, criterion="above 1")


def mx2_sentence(rows: Sequence[Claim]) -> str:
    """Say how the error and the time depend on the number of particles."""
    judged_rows = list(filter(_is_headline, rows))
    errors = [row for row in judged_rows if row.statistic.startswith("error")]
    parts = [
        f"{plain(row.found.value, 3)} times as large on {_place(row).split(', ', 1)[-1]}"
        for row in errors
    ]
    share, gap, grows = (
        max(row.found.value for row in judged_rows if words in row.statistic)
        for words in ("over the paper's", "between nodes", "the fewest")
    )
    slower = pick(judged_rows, "over that of UMH").found.value
    return (
        f"Against 4 particles a node, the error with another number is at its farthest "
        f"{' and '.join(parts)}. The time grows up to {plain(grows)} times, is at most "
        f"{plain(100.0 * share)} % of the paper's and {plain(100.0 * gap)} % of the time between "
        f"nodes, and on Oxford is at least {plain(slower)} times that on UMH."
    )


def _share(claim: str, statistic: str, hits: pd.Series[bool], **judging: Any) -> Claim:
    found = share_interval(int(hits.sum()), len(hits))
    return banded(claim, statistic, found, **judging, n=len(hits))


def mx4(starts: pd.DataFrame) -> list[Claim]:
    """MX4: any starting node works."""
    return [
        beside(
            _share(
                "MX4",
                f"share of starts that M2 localises within {WITHIN} steps, {NAMES[name]}",
                part["settled_at"] <= WITHIN,
                at_least=0.95,
                criterion="lower bound above 0.95",
            ),
            name not in headlines(starts["geometry"]),
        )
        for name, part in starts.groupby("geometry", sort=False)
    ]


def mx4_sentence(rows: Sequence[Claim]) -> str:
    """Say from how many starts the robot is localized."""
    return f"Within {WITHIN} steps M2 is localized from {_shares(rows)} of the starts."


def mx5(clusters: pd.DataFrame) -> list[Claim]:
    """MX5: clusters of descriptors are stretches of the route.

    On the synthetic field this holds by construction. Scan Context is left out, since it turns
    with the robot, which k-means does not allow for.
    """
    asked = clusters[clusters["descriptor"] != "scan_context"]
    shares = asked.groupby(["geometry", "descriptor"], sort=False)["contiguous"]
    return [
        beside(
            banded(
                "MX5",
                f"share of nodes with a route neighbour in their cluster, {NAMES[name]}"
                + (f", {descriptor}" if descriptor != "synthetic" else ""),
                mean_interval(part),
                at_least=0.8,
                criterion="above 0.8",
                n=len(part),
            ),
            name not in headlines(asked["geometry"]),
        )
        for (name, descriptor), part in shares
    ]


def mx5_sentence(rows: Sequence[Claim]) -> str:
    """Say how contiguous the clusters are, on the made descriptors and on those of clouds."""
    ours = [row for row in rows if not _is_headline(row) and "campus" in row.statistic]
    said = (
        f"A route neighbour shares the cluster of {_shares(rows)} of the nodes, where the made "
        "descriptors are contiguous by construction"
    )
    if ours:
        return f"{said}; with descriptors of simulated clouds, of {_shares(ours, all_rows=True)}."
    return f"{said}."


def mx6(starts: pd.DataFrame) -> Claim:
    """Our own: global localization on simulated clouds."""
    return _share(
        "MX6",
        "share of starts localised on campus clouds (our own)",
        starts["settled_at"] <= WITHIN,
        at_least=0.95,
    )


def mx6_sentence(rows: Sequence[Claim]) -> str:
    """Say from how many starts on the campus the robot is localized."""
    (row,) = rows
    return (
        f"On simulated clouds {percent(row.found.value)} of the starts are localized within "
        f"{WITHIN} steps (at least {percent(row.found.low)})."
    )


def mx7(starts: pd.DataFrame) -> Claim:
    """Our own, the paper's future work: registration brings the error below the spacing."""
    worlds = starts.dropna(subset="rms_m").groupby("seed")[["spacing_m", "rms_m"]].mean()
    ratio = log_ratio_interval(worlds["spacing_m"], worlds["rms_m"])
    statistic = "node spacing over RMS error with refinement, campus clouds (our own)"
    return banded("MX7", statistic, ratio, at_least=5.0, n=len(worlds))


def mx7_sentence(rows: Sequence[Claim]) -> str:
    """Say how far below the spacing registration brings the error."""
    (row,) = rows
    low = row.found.low
    bound = f"at least {plain(low)} times" if math.isfinite(low) else "too few worlds for a bound"
    return (
        f"With registration the RMS error is {plain(row.found.value)} times smaller than the node "
        f"spacing ({bound})."
    )


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


def mx8_sentence(rows: Sequence[Claim]) -> str:
    """Say how often a kidnapped robot is found again."""
    found, lost = (
        [row.found for row in rows if f"{how} injection" in row.statistic]
        for how in ("with", "without")
    )
    return (
        f"With injection {percent(min(f.value for f in found))} of kidnapped robots are found "
        f"again within {RECOVERED_WITHIN} nodes, whatever the route (at least "
        f"{percent(min(f.low for f in found))}); without it at most "
        f"{percent(max(f.value for f in lost))}."
    )


def _shares(rows: Sequence[Claim], *, all_rows: bool = False) -> str:
    """Shares of the headlines, or of all rows, with their geometries."""
    wanted = [row for row in rows if all_rows or _is_headline(row)]
    return " and ".join(
        f"{percent(row.found.value)} ({row.statistic.split(', ', 1)[-1]})" for row in wanted
    )
