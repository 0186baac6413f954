"""The claims MX1-MX5 and MX9 of maximo2024, and three of our own on clouds and kidnapping.

The descriptors are made, but for the clouds of a simulated campus (MX5 to MX8).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import (
    Interval,
    log_ratio_interval,
    mean_interval,
    median_interval,
    share_interval,
)
from experiments.judging.claim import (
    Claim,
    Subject,
    beside,
    judge_bounds,
    judge_equivalent,
    overall,
    own_design,
    shown,
    with_remark,
)
from experiments.judging.region import Region
from experiments.judging.region_runs import Compared, Headlines, judge_tables, judged_regions
from experiments.judging.results import Results
from experiments.judging.sequential import Design, designs, judge_ratio
from experiments.papers.maximo2024.settings import (
    BETWEEN_NODES_S,
    LEAST_M,
    NAMES,
    PLACES,
    PRINTED_1,
    RECOVERED_WITHIN,
    WITHIN,
)

_PAPERS, _BETWEEN = "the paper's", f"{BETWEEN_NODES_S:g} s between nodes"
_FAILS, _HOLDS = 5.0, 1.25  # M3's error over M2's: above on Oxford, within on UMH
_EQUAL = 1.15  # errors by number of particles, and from other starts
_NEAREST = 1.1  # M2's error over the distance to the nearest node, or its inverse
_WORST_MX2 = f"error with 2, 6 or 8 particles a node over 4, within {_EQUAL:g}"


def _both(first: str, second: str, words: str, most: float, least: float = 0.0) -> list[Compared]:
    """A headline on each route, the columns named without it."""
    return [
        Compared(
            f"{route}_{first}",
            f"{route}_{second}",
            f"{words}, {PLACES[route]}",
            least,
            most,
            place=place,
        )
        for route, place in (("oxford", "Oxford"), ("umh", "UMH"))
    ]


def _printed(name: str, method: str, over: str) -> float:
    return PRINTED_1[name, method][0] / PRINTED_1[name, over][0]


HEADLINES: Headlines = {
    "MX1": [
        Compared("oxford_m2_m", "oxford_m1_m", "M2 / M1, Oxford", at_most=1.0,
                 printed=_printed("oxford", "M2", "M1"), place="Oxford"),
        Compared("oxford_m3_m", "oxford_m2_m", "M3 / M2, Oxford", at_least=_FAILS,
                 printed=_printed("oxford", "M3", "M2"), place="Oxford"),
        Compared("umh_m2_m", "umh_m1_m", "M2 / M1, UMH", at_most=1.0,
                 printed=_printed("umh", "M2", "M1"), place="UMH"),
        Compared("umh_m3_m", "umh_m2_m", "M3 / M2, UMH", 1.0 / _HOLDS, _HOLDS,
                 printed=_printed("umh", "M3", "M2"), place="UMH"),
    ],
    "MX2": [
        headline
        for n in (2, 8)
        for headline in _both(f"m2_{n}_m", "m2_m", f"{n} particles over 4", _EQUAL, 1.0 / _EQUAL)
    ],
    "MX3": [
        headline
        for method in ("m2", "m3")
        for headline in _both(
            f"{method}_dispersion_m", "m1_dispersion_m", f"{method.upper()} / M1, dispersion", 1.0
        )
    ],
    "MX4": _both("most_start_m", "least_start_m", "worst over best start", _EQUAL, 1.0 / _EQUAL),
    "MX9": _both("m2_m", "nearest_m", "M2 / nearest node", _NEAREST, 1.0 / _NEAREST),
}  # fmt: skip


def judge(results: Results) -> list[Claim]:
    """Judge MX1-MX9 by the tables."""
    runs = results.optional_table("runs")
    return [
        *judge_tables(results, {
            "MX1": (mx1, {"weighting": ()}),
            "MX2": (mx2, {"particles": (), "times": ()}),
            "MX3": (mx3, {"dispersion": ()}),
            "MX4": (mx4, {"starts": (), "start_errors": ("most_start_m",)}),
            "MX5": (mx5, {"clusters": (), "cloud_clusters": ("contiguous",)}),
            "MX6": (mx6, {"campus_starts": ()}),
            "MX7": (mx7, {"campus_starts": ()}),
            "MX8": (mx8, {"kidnapping": ()}),
            "MX9": (mx9, {"weighting": (), "region_MX1": ("oxford_m2_m",)}),
        }),
        *([] if runs is None else oxford_runs(runs)),
    ]  # fmt: skip


def regions(results: Results) -> Mapping[str, Region]:
    """Where MX1-MX4 and MX9 hold over the settings that the paper leaves open."""
    return judged_regions(results, HEADLINES)


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


def mx1(weighting: pd.DataFrame, design: Design | None = None) -> Iterator[Claim]:
    """MX1: M2 is the best weighting; M3 fails on Oxford and holds on UMH.

    At the anchor, where M2 has its printed error; M1 and M3 are predicted there. Queries off the
    route, as a control, and a campus stand beside.
    """
    design = design or designs("maximo2024")["MX1"]
    decisive, shows = headlines(weighting["geometry"]), []
    for name in geometries(weighting):
        errors = _by_world(weighting[weighting["geometry"] == name], "error_m")
        about = Subject("MX1", "error", method="M2", over="M1", place=NAMES[name])
        arms = errors["M2"], errors["M1"]
        label = f"error of M2 over M1, {NAMES[name]}"
        claims = [judge_ratio(about, label, arms, design, at_most=1.0)]
        hits = errors["M2"] < errors["M1"]
        if name != "campus":
            is_oxford = name.startswith("oxford")
            low, high = (_FAILS, math.inf) if is_oxford else (1.0 / _HOLDS, _HOLDS)
            arms, about = (errors["M3"], errors["M2"]), replace(about, method="M3", over="M2")
            label = f"error of M3 over M2, {NAMES[name]}"
            claims.append(judge_ratio(about, label, arms, design, low, high))
            hits &= (errors["M3"] / errors["M2"]).between(low, high)
        levels = ", ".join(f"{m} {errors[m].mean():.3g} m" for m in errors)
        yield from (beside(with_remark(c, levels), name not in decisive) for c in claims)
        shows += [hits] * (name in decisive)
    # worlds of both routes with the same number stand for the paper's two routes
    if shows:
        together = np.logical_and.reduce(
            [hits.to_numpy()[: min(map(len, shows))] for hits in shows]
        )
        yield own_design("MX1", "one route of each data set, ten runs", together)


def oxford_runs(runs: pd.DataFrame) -> Iterator[Claim]:
    """MX1 on each Oxford run, at its real positions."""
    errors = runs.pivot_table(index="run", columns="method", values="error_m")
    for method, hits, what in (
        ("M2", errors["M2"] < errors["M1"], "M2 below M1"),
        ("M3", errors["M3"] > _FAILS * errors["M2"], "M3 worse than 5 times M2"),
    ):
        found = share_interval(int(hits.sum()), len(hits))
        label = f"share of Oxford runs, real positions, with {what}"
        yield shown(Subject("MX1", "runs", method=method), label, found)


def mx9(weighting: pd.DataFrame, region: pd.DataFrame) -> Iterator[Claim]:
    """MX9: M2 errs as the distance to the nearest node; judged by its region alone.

    Beside stands the ratio at the anchor, which was found by M2's error.
    """
    for headline in HEADLINES["MX9"]:
        logs = headline.logs(region)
        low, middle, high = np.exp(np.quantile(logs[np.isfinite(logs)], [0.025, 0.5, 0.975]))
        about = Subject("MX9", "error", over="nearest node", place=headline.place, arm="region")
        label = f"{headline.words}, median over the region and 95 % of its points"
        yield shown(about, label, Interval(float(middle), float(low), float(high)))
    own = weighting[weighting["method"] == "M2"]
    for name in geometries(own):
        part = own[own["geometry"] == name].groupby("seed")[["error_m", "nearest_node_m"]].mean()
        found = log_ratio_interval(part["error_m"], part["nearest_node_m"])
        arm = "data set" if name in headlines(own["geometry"]) else "control"
        about = Subject("MX9", "error", over="nearest node", place=NAMES[name], arm=arm)
        yield shown(
            about, f"error of M2 over the distance to the nearest node, {NAMES[name]}", found
        )


def mx3(dispersion: pd.DataFrame, design: Design | None = None) -> Iterator[Claim]:
    """MX3: the choice of the weighting influences the dispersion of the particles, at step 10.

    The text says no more than that. All three are compared: M2 and M3, each with M1.
    """
    design = design or designs("maximo2024")["MX3"]
    at_10 = dispersion[dispersion["step"] == 10]
    decisive, shows = headlines(at_10["geometry"]), []
    for name in geometries(at_10):
        worlds = _by_world(at_10[at_10["geometry"] == name], "dispersion_m") + LEAST_M
        for method in ("M2", "M3"):
            about = Subject("MX3", "dispersion", method=method, over="M1", place=NAMES[name])
            label = f"dispersion of {method} over M1 at step 10, {NAMES[name]}"
            arms = worlds[method], worlds["M1"]
            claim = judge_ratio(about, label, arms, design, at_most=1.0)
            yield beside(claim, name not in decisive)
        if name in decisive:
            shows.append((worlds[["M2", "M3"]].max(axis=1) < worlds["M1"]).to_numpy())
    if shows:
        n = min(map(len, shows))
        every = np.logical_and.reduce([hits[:n] for hits in shows])
        yield own_design("MX3", "one route of each data set", every)


def mx2(particles: pd.DataFrame, times: pd.DataFrame) -> Iterator[Claim]:
    """MX2: the error does not depend on the number of particles, the time grows with it.

    Bounds on times leave a factor of ten for other machines.
    """
    for name, part in particles.groupby("geometry", sort=False):
        errors = _by_world(part, "error_m", "per_node")
        label = f"{_WORST_MX2}: the worst, {NAMES[name]}"
        about = Subject("MX2", "error", over="4 particles a node", place=NAMES[name])
        each = {
            n: judge_equivalent(about, label, errors[n], errors[4], _EQUAL - 1.0)
            for n in errors
            if n != 4
        }
        worst = max(each, key=lambda n: abs(math.log(each[n].found.value)))
        verdict = overall([c.verdict for c in each.values()])
        claim = replace(each[worst], verdict=verdict, power=min(c.power for c in each.values()))
        claim = with_remark(claim, f"{worst} particles a node")
        is_beside = name not in headlines(particles["geometry"])
        yield beside(claim, is_beside)
        counts = sorted(errors)
        some, ends = (np.exp(np.log(errors[c]).mean(axis=1)) for c in (counts[1:-1], counts[::3]))
        label = f"error by an intermediate number of particles over the extremes', {NAMES[name]}"
        about = Subject("MX2", "intermediate", place=NAMES[name])
        ratio = log_ratio_interval(some, ends)
        yield beside(judge_bounds(about, label, ratio, at_most=1.0, criterion="below 1"))
        if not is_beside:
            all_equal = errors.max(axis=1) < _EQUAL * errors.min(axis=1)
            yield own_design("MX2", f"one route ({PLACES[name]})", all_equal)
    for name, part in times.groupby("geometry", sort=False):
        shares = {_PAPERS: part["time_s"] / part["paper_s"]}
        if name.startswith("oxford"):
            shares[_BETWEEN] = part["time_s"] / BETWEEN_NODES_S
        for what, share in shares.items():
            label = f"time a node over {what}, the largest, {NAMES[name]}"
            most = share.groupby(part["particles"]).median().idxmax()
            found = median_interval(share[part["particles"] == most])
            about = Subject("MX2", "time", over=what, place=NAMES[name])
            yield judge_bounds(about, label, found, at_most=0.1)
        turns = part.pivot(index="repeat", columns="particles", values="time_s")
        low, most = turns.columns.min(), turns.columns.max()
        grown = median_interval(turns[most] / turns[low])
        label = f"time a node with the most particles over that with the fewest, {NAMES[name]}"
        about = Subject("MX2", "time", over="the fewest", place=NAMES[name])
        claim = judge_bounds(about, label, grown, at_least=1.0, criterion="above 1")
        yield with_remark(claim, f"{most} particles over {low}")
    yield from _oxford_slower(times)


def _oxford_slower(times: pd.DataFrame) -> Iterator[Claim]:
    """Judge that Oxford, which has more nodes, takes longer, with as many particles a node."""
    counts = times.groupby("geometry")["particles"]
    per_node = (times["particles"] / counts.transform("min")).rename("per_node")  # of the fewest
    turns = times.assign(per_node=per_node).set_index(["geometry", "per_node", "repeat"])["time_s"]
    for oxford in {name for name in times["geometry"] if name.startswith("oxford")}:
        ratios = turns[oxford] / turns["umh"]
        least = ratios.groupby("per_node").median().idxmin()
        found = median_interval(ratios[least])
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


def mx4(starts: pd.DataFrame, start_errors: pd.DataFrame) -> Iterator[Claim]:
    """MX4: any starting node works, and the error hardly depends on it."""
    decisive = headlines(starts["geometry"])
    for name, part in starts.groupby("geometry", sort=False):
        label = f"share of starts that M2 localises within {WITHIN} steps, {NAMES[name]}"
        about = Subject("MX4", "starts", place=NAMES[name], setting=WITHIN)
        settled = part["settled_at"] <= WITHIN
        claim = _share(about, label, settled, at_least=0.95, criterion="lower bound above 0.95")
        yield beside(claim, name not in decisive)
    for name, part in start_errors.groupby("geometry", sort=False):
        found = log_ratio_interval(part["most_start_m"], part["least_start_m"])
        label = f"mean error from the worst of three starts over that from the best, {NAMES[name]}"
        about = Subject("MX4", "worst start", over="best start", place=NAMES[name])
        claim = judge_bounds(about, label, found, at_most=_EQUAL)
        yield beside(claim, name not in decisive)
        if name in decisive:
            equal = part["most_start_m"] < _EQUAL * part["least_start_m"]
            yield own_design("MX4", f"three starts on one route ({PLACES[name]})", equal)


def mx5(made: pd.DataFrame, of_clouds: pd.DataFrame) -> Iterator[Claim]:
    """MX5: clusters of descriptors are stretches of the route.

    Judged on descriptors of simulated clouds: on the made field it holds by construction.
    """
    shares = pd.concat([made, of_clouds]).groupby(["geometry", "descriptor"], sort=False)[
        "contiguous"
    ]
    for (name, descriptor), part in shares:
        is_made = descriptor == "synthetic"
        place = NAMES[name] if is_made else f"{NAMES[name]}, {descriptor}"
        about = Subject("MX5", "contiguous", method=descriptor, place=place)
        label = f"share of nodes with a route neighbour in their cluster, {place}"
        found = mean_interval(part)
        claim = judge_bounds(about, label, found, at_least=0.8, criterion="above 0.8")
        facts = {"n": len(part), "below": int((part < 0.8).sum())}
        yield beside(with_remark(claim, "", **facts), is_made)


def mx6(starts: pd.DataFrame) -> Claim:
    """Our own: global localization on simulated clouds."""
    label = "share of starts localised on campus clouds (our own)"
    about = Subject("MX6", "starts", setting=WITHIN)
    claim = _share(about, label, starts["settled_at"] <= WITHIN, at_least=0.95)
    facts = {"n": len(starts), "worlds": int(starts["seed"].nunique())}
    return with_remark(claim, "", **facts)


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
        claim = _share(about, label, recovered, *((0.95,) if injects else (-math.inf, 0.5)))
        yield with_remark(claim, "", n=len(recovered))
