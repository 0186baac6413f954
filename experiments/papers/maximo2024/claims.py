"""The claims MX1-MX5 of maximo2024, and three of our own on simulated clouds and kidnapping."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
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
from experiments.evaluation.verdict import (
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
    plain,
    remarked,
)
from experiments.papers.maximo2024.settings import (
    BETWEEN_NODES_S,
    NAMES,
    RECOVERED_WITHIN,
    WITHIN,
)
from experiments.papers.results import Results

# The tracked tables have M3 on Oxford at B = 1, and the other methods at B = 2
_OTHER_B = "to be judged at the next full run, at the B of the others"
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


def headlines(table: pd.DataFrame) -> set[str]:
    """Geometries of the paper's two data sets: UMH, and Oxford at its real positions if there."""
    known = set(table["geometry"])
    return known & {"umh", "oxford_real" if "oxford_real" in known else "oxford"}


def _by_world(table: pd.DataFrame, column: str, by: str = "method") -> pd.DataFrame:
    """Mean over repeats: one row per world, one column per value of `by`."""
    return table.pivot_table(index="seed", columns=by, values=column, aggfunc="mean")


def mx1(weighting: pd.DataFrame, quality: pd.DataFrame) -> Iterator[Claim]:
    """MX1: M2 is the best weighting; M3 fails on Oxford and holds on UMH.

    The methods share the parameters at which M2, the paper's choice, errs least. The reason says
    where M3 fails with other ones. A table that does not name its parameters has M3 of Oxford at
    B = 1, where all methods are the same filter: M3 is not judged by it.
    """
    for name in geometries(weighting):
        errors = _by_world(weighting[weighting["geometry"] == name], "error_m")
        is_beside = name not in headlines(weighting)
        if name.startswith("oxford"):
            label = f"share of worlds with M3 worse than 5 times M2, {NAMES[name]}"
            share = _share("MX1", label, errors["M3"] > 5.0 * errors["M2"], at_least=0.8)
            claim = remarked(share, _where_m3_fails(quality, "oxford"))
            yield beside(_as_shared(claim, weighting), is_beside)
        if name == "umh":
            claim = equivalent("MX1", "error of M3 over M2, UMH", errors["M3"], errors["M2"], 0.25)
            yield beside(remarked(claim, _where_m3_fails(quality, "umh")), is_beside)
    yield from _m2_below_m1("MX1", "error", weighting, quality)


def mx1_sentence(rows: Sequence[Claim]) -> str:
    """Say which weighting errs least, and where M3 fails."""
    below = [row for row in rows if row.statistic.startswith("error of M2 over M1")]
    parts = [f"{plain(r.found.value, 3)} on {_where(r)}" for r in below if r.role is Role.HEADLINE]
    oxford = next(row for row in rows if "5 times M2" in row.statistic and _is_headline(row))
    said = f"M2's error over M1's is {' and '.join(parts)}."
    if _OTHER_B in oxford.reason:
        said += f" M3 on Oxford is {_OTHER_B}."
    else:
        said += (
            f" M3 is worse than 5 times M2 in {percent(oxford.found.value)} of worlds on Oxford."
        )
    umh = [row for row in rows if "M3 over M2, UMH" in row.statistic]
    if umh:
        said += f" On UMH it has {plain(umh[0].found.value)} times M2's error."
    return (
        f"{said} With other parameters that they share, on Oxford {oxford.reason.split('; ')[-1]}."
    )


def mx3(dispersion: pd.DataFrame, quality: pd.DataFrame) -> Iterator[Claim]:
    """MX3: the weighting decides how fast particles concentrate: dispersions at step 10."""
    at_10 = dispersion.query("step == 10").eval("dispersion_m = dispersion_m + @_LEAST_M")
    yield from _m2_below_m1("MX3", "dispersion", at_10, quality, " at step 10")
    for name in geometries(at_10):
        worlds = _by_world(at_10[at_10["geometry"] == name], "dispersion_m")
        label = f"dispersion of M3 over M1 at step 10, {NAMES[name]}"
        claim = lower("MX3", label, worlds["M3"], worlds["M1"])
        if name.startswith("oxford"):
            claim = _as_shared(claim, dispersion)
        yield beside(claim, name not in headlines(at_10))


def mx3_sentence(rows: Sequence[Claim]) -> str:
    """Say how far particles have concentrated after ten steps, by the weighting."""
    parts = []
    for row in filter(_is_headline, rows):
        pair = row.statistic.removeprefix("dispersion of ").split(" at ")[0]
        p = row.reason.split("p = ")[-1].split(";")[0]
        ratio = _OTHER_B if _OTHER_B in row.reason else f"{plain(row.found.value)} (p = {p})"
        parts.append(f"{pair} on {_where(row)}: {ratio}")
    return f"Ratios of the dispersions after ten steps: {'; '.join(parts)}."


def _m2_below_m1(
    claim: str, what: str, table: pd.DataFrame, quality: pd.DataFrame, at: str = ""
) -> Iterator[Claim]:
    """Judge on each geometry whether M2 is below M1; the reason: where with other parameters."""
    for name in geometries(table):
        worlds = _by_world(table[table["geometry"] == name], f"{what}_m")
        label = f"{what} of M2 over M1{at}, {NAMES[name]}"
        found = lower(claim, label, worlds["M2"], worlds["M1"])
        where = _where_less(quality[quality["geometry"] == name], f"{what}_m")
        found = replace(found, reason="; ".join(filter(None, [found.reason, where])))
        yield beside(found, name not in headlines(table))


def _as_shared(claim: Claim, table: pd.DataFrame) -> Claim:
    """Leave a claim on Oxford's M3 undecided if the table has it at another B than M1 and M2."""
    if "n_nearest" in table:
        return claim
    return remarked(replace(claim, verdict=Verdict.UNDECIDED, more=0), _OTHER_B)


def _is_headline(row: Claim) -> bool:
    return row.role is Role.HEADLINE


def _where(row: Claim) -> str:
    """The geometry, which ends a statistic."""
    return next(name for name in NAMES.values() if name in row.statistic)


def _where_less(quality: pd.DataFrame, column: str) -> str:
    """Name the B at which M2 is below M1 when both have the same parameters, at a noise of 0.8."""
    part = quality[(quality["noise_weight"] == 0.8) & (quality["n_nearest"] > 1)]
    by_b = {b: _by_world(rows, column) + _LEAST_M for b, rows in part.groupby("n_nearest")}
    less = [
        str(b)
        for b, worlds in by_b.items()
        if lower("", "", worlds["M2"], worlds["M1"]).verdict is Verdict.REPRODUCED
    ]
    where = f"B = {', '.join(less)}" if less else "no B tried"
    return "" if part.empty else f"with other parameters at {where}"


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
    return f"M3 fails {where}"


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
        yield remarked(claim, f"{worst} particles a node")
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


def mx2_sentence(rows: Sequence[Claim]) -> str:
    """Say how the error and the time depend on the number of particles."""
    errors = [row for row in rows if row.statistic.startswith("error")]
    parts = [f"{plain(row.found.value, 3)} on {_where(row)}" for row in errors]
    share = max(row.found.value for row in rows if "over the paper's" in row.statistic)
    gap = max(row.found.value for row in rows if "between nodes" in row.statistic)
    grows = max(row.found.value for row in rows if "the fewest" in row.statistic)
    return (
        f"Against 4 particles a node, other numbers change the error by a factor of at most "
        f"{' and '.join(parts)}. The time grows up to {plain(grows)} times, and is at most "
        f"{plain(100.0 * share)} % of the paper's and {plain(100.0 * gap)} % of the time between "
        "nodes."
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
            name not in headlines(starts),
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
            name not in headlines(asked),
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
    return (
        f"With registration the RMS error is {plain(row.found.value)} times below the node spacing "
        f"(at least {plain(row.found.low)})."
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
    least, most = (
        [row.found.value for row in rows if f"{how} injection" in row.statistic]
        for how in ("with", "without")
    )
    return (
        f"With injection at least {percent(min(least))} of kidnapped robots are found again within "
        f"{RECOVERED_WITHIN} nodes, on any route; without it at most {percent(max(most))}."
    )


def _shares(rows: Sequence[Claim], *, all_rows: bool = False) -> str:
    """Shares of the headlines, or of all rows, with their geometries."""
    wanted = [row for row in rows if all_rows or _is_headline(row)]
    return " and ".join(
        f"{percent(row.found.value)} ({row.statistic.split(', ', 1)[-1]})" for row in wanted
    )
