"""The claims GI1-GI8 of gil2008.

A world is the unit of inference: runs that share one are pooled (squares, then the root) before
anything is compared. Errors of position and map are those of the revised path and of the map of the
best particle, as the paper has them, raw and rigidly aligned.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray

from experiments.evaluation.statistics import (
    Interval,
    log_log_slope,
    log_ratio_interval,
    mean_interval,
    median_interval,
    page_trend_p,
)
from experiments.judging.claim import (
    OWN_DESIGN,
    SMALLEST_EFFECT,
    Claim,
    Role,
    Subject,
    Verdict,
    beside,
    effect_in_words,
    holds,
    judge_bounds,
    judge_equivalent,
    own_design,
    power_of,
    shown,
    with_remark,
)
from experiments.judging.region import Region
from experiments.judging.region_runs import Compared, Headlines, judge_tables, judged_regions
from experiments.judging.results import Results
from experiments.judging.sentences import percent
from experiments.judging.sequential import Design, designs, judge_ratio
from experiments.papers.gil2008.settings import DESCRIPTORS, P0
from sim.arrays import Array

POSITION = "revised_ate_rmse_m"
ERRORS = {
    POSITION: "position",
    "revised_ate_aligned_rmse_m": "aligned position",
    "map_rmse_m": "map",
    "map_aligned_rmse_m": "aligned map",
}
MEASURED = {POSITION: "position", "map_rmse_m": "map"}  # figures 9(a) and (b)
HEADING = "revised_heading_rmse_rad"
NAMES = {
    "paper": "the filter as printed",
    "fastslam2": "FastSLAM 2.0",
    "ekf_slam": "EKF-SLAM",
}
NOISE = {"paper": "noise of 10 px", "pixel": "noise of 1 px"}
BOUNDED = 0.5  # share of odometry's error below which the error of SLAM counts as bounded
REVISITS_GROW = 1.25  # error at later visits over that at the first: odometry must be above it
FALLS, NOT_WORSE = 1.5, 1.3  # 3 m over 10 m, at least; 10 m over 20 m, at most
DIVERGE_MORE = 0.2  # share of worlds: the smallest effect of interest
DIVERGE_WORLDS = 80  # at least: they tell such a difference from none with a power of 0.98


HEADLINES: Headlines = {
    "GI1": [
        Compared("m200_10m_position_m", "odometry_rmse_m", "SLAM / odometry", at_most=BOUNDED),
    ],
    "GI2": [
        Compared(f"m1000_10m_{what}_m", f"m10_10m_{what}_m", f"M = 1000 / 10, {what}", at_most=1.0)
        for what in ("position", "map")
    ],
    "GI3": [
        Compared("m200_10m_position_m", "m1000_10m_position_m", "M = 200 / 1000, position",
                 1.0 / 1.25, 1.25),
    ],
    "GI4": [
        Compared(f"m200_3m_{what}_m", f"m200_10m_{what}_m", f"3 m / 10 m, {what}", FALLS)
        for what in ("position", "map")
    ],
    "GI5": [
        Compared(f"m200_10m_{what}_m", f"m200_20m_{what}_m", f"10 m / 20 m, {what}",
                 at_most=NOT_WORSE)
        for what in ("position", "map")
    ],
    "GI7": [
        Compared("descriptor_m", "known_m", "by descriptor / known", at_most=1.5),
        Compared("ekf_m", "distance_m", "EKF-SLAM / FastSLAM, by distance", at_least=1.0),
    ],
}  # fmt: skip


def judge(results: Results) -> list[Claim]:
    """Judge GI1-GI8 by the tables."""
    return judge_tables(results, {
        "GI1": (gi1, {"particles": ("odometry_heading_rmse_rad",), "laps": ()}),
        "GI2": (gi2, {"particles": (), "bound": ()}),
        "GI3": (gi3, {"particles": (), "repeats": ()}),
        "GI4": (gi4, {"distance": ()}),
        "GI5": (gi5, {"distance": ()}),
        "GI6": (gi6, {"observations": ()}),
        "GI7": (gi7_on_fresh_worlds, {"association": (), "divergence": ("association",)}),
        "GI8": (gi8, {"cost": ("association",)}),
    })  # fmt: skip


def regions(results: Results) -> Mapping[str, Region]:
    """Where GI1-GI5 and GI7 hold over the settings that the paper leaves open."""
    return judged_regions(results, HEADLINES)


def pool_by_world(table: pd.DataFrame, column: str, by: str) -> pd.DataFrame:
    """Root mean square of a column, one row per world and one column per value of `by`."""
    squares = (table[column] ** 2).groupby([table["seed"], table[by]]).mean()
    return squares.unstack(by).dropna() ** 0.5


def ratios(table: pd.DataFrame, column: str, by: str, first: object, second: object) -> Array:
    """Ratio of a column's values at two values of `by`, one a world.

    The ratio is taken within each recording, and its log averaged over a world's recordings: those
    that share a world are not independent.
    """
    wide = table.pivot_table(index=["seed", "draw"], columns=by, values=column)
    logs = np.log(wide[first]) - np.log(wide[second])
    return np.asarray(np.exp(logs.dropna().groupby("seed").mean()))


def gi1(particles: pd.DataFrame, laps: pd.DataFrame) -> Iterator[Claim]:
    """GI1: against odometry the error of SLAM stays bounded.

    On the course of the other studies its error is compared with odometry's. On another, of several
    laps, its error at later visits of places is compared with that at the first visit; odometry has
    to fail this test, or the laps are too few.
    """
    design = designs("gil2008")["GI1"]
    yield from over_odometry(particles, design)
    yield from revisits(laps, design)
    own = mean_interval(particles.groupby("seed")["odometry_rmse_m"].mean())
    about = Subject("GI1", "odometry")
    yield shown(about, "RMS position error of odometry, m (figure 7: some 3)", own)


def over_odometry(particles: pd.DataFrame, design: Design) -> Iterator[Claim]:
    """Judge the errors of path and heading (figure 7) over odometry's, the worst of M >= 50."""
    enough = particles[particles["n_particles"] >= 50]
    for (noise, name), table in enough.groupby(["noise", "filter"], sort=False):
        where, is_beside = f"{NAMES[name]}, {NOISE[noise]}", not _printed(name, noise)
        for quantity, column, odometry, limit in (
            ("over odometry", POSITION, "odometry_rmse_m", BOUNDED),
            ("heading", HEADING, "odometry_heading_rmse_rad", 1.0),
        ):
            found = {}
            for m, part in table.groupby("n_particles"):
                arms = [pool_by_world(part, c, "filter")[name] for c in (column, odometry)]
                both = pd.concat(arms, axis=1, join="inner").to_numpy().T
                about = Subject("GI1", quantity, method=name, noise=noise, size=int(m))
                label = f"{quantity}: error of SLAM over odometry's, the worst of M >= 50: {where}"
                found[m] = judge_ratio(about, label, tuple(both), design, at_most=limit), both
            m = max(found, key=lambda each: found[each][0].found.value)
            claim, (ours, theirs) = found[m]
            yield beside(with_remark(claim, f"M = {m}"), is_beside)
            if not is_beside and quantity == "over odometry":
                yield own_design("GI1", "one drive", ours < BOUNDED * theirs)


def revisits(laps: pd.DataFrame, design: Design) -> Iterator[Claim]:
    """Judge the error at later visits of places over that at the first, and odometry's."""
    label = "at later visits of a place over that at the first"
    own = _growth(laps.drop_duplicates("seed"), "odometry_revisit_ratio")
    about, words = Subject("GI1", "revisits", method="odometry"), f"error of odometry {label}"
    grows = judge_ratio(about, words, (own, np.ones(len(own))), design, at_least=REVISITS_GROW)
    yield beside(grows)
    for (noise, name), table in laps.groupby(["noise", "filter"], sort=False):
        growth, words = _growth(table, "revisit_ratio"), f"{NAMES[name]}, {NOISE[noise]}"
        about, words = Subject("GI1", "revisits", method=name, noise=noise), f"{label}: {words}"
        arms = growth, np.ones(len(growth))
        claim = judge_ratio(about, f"error of SLAM {words}", arms, design, at_most=REVISITS_GROW)
        if grows.verdict is not Verdict.REPRODUCED:
            claim = _undecided(claim, "odometry's is not clearly above it on this course")
            claim = replace(claim, facts={**claim.facts, "is_open": grows.facts["is_open"]})
        yield beside(claim, not _printed(name, noise))


def gi2(particles: pd.DataFrame, bound: pd.DataFrame) -> Iterator[Claim]:
    """GI2: more particles, less error; and how far from the best possible."""
    first = particles[particles["draw"] == 0]
    for (noise, name), table in first.groupby(["noise", "filter"], sort=False):
        where, is_beside = f"{NAMES[name]}, {NOISE[noise]}", not _printed(name, noise)
        about = Subject("GI2", "", method=name, noise=noise)
        for claim in _trends(about, table, "n_particles", "M", 0.001, where):
            yield beside(claim, is_beside)
        best = bound[bound["noise"] == noise].set_index("seed")
        some = table[table["n_particles"] == 500].groupby("seed").first()
        for column, what in list(ERRORS.items())[:2]:
            found = median_interval((some[column] / best[column]).dropna().to_numpy())
            label = f"{what} error at M = 500 over the batch baseline, median of worlds: {where}"
            yield shown(replace(about, quantity=f"{what} over bound"), label, found, "ours: 2")


def gi3(
    particles: pd.DataFrame, repeats: pd.DataFrame | None = None, design: Design | None = None
) -> Iterator[Claim]:
    """GI3: nothing significant is gained past 200 particles.

    Judged by equivalence, since few data would make any gain insignificant, and by a sequential
    design. Beside: whether the gain is significant, and what the paper's own design, one drive
    with 20 runs, shows.
    """
    design = design or designs("gil2008")["GI3"]
    if repeats is not None:
        yield _one_drive(repeats)
    table = particles[(particles["noise"] == "paper") & particles["n_particles"].isin([200, 1000])]
    for name, part in table.groupby("filter", sort=False):
        for column, what in ERRORS.items():
            values = ratios(part, column, "n_particles", 200, 1000)
            n_recordings = len(part.drop_duplicates(["seed", "draw"]))
            remark = f"{n_recordings} recordings in {len(values)} worlds"
            is_beside = name != "paper" or column != POSITION
            label, ones = f"{what} error, M = 200 over M = 1000", np.ones(len(values))
            about = Subject("GI3", what, method=name, noise="paper")
            words, margin = f"{label}: {NAMES[name]}", design.effect
            claim = (
                judge_equivalent(about, words, values, ones, margin)
                if is_beside
                else judge_ratio(
                    about, words, (values, ones), design, 1.0 / (1.0 + margin), 1.0 + margin
                )
            )
            claim = with_remark(claim, remark, n_recordings=n_recordings, n_worlds=len(values))
            yield beside(claim, is_beside)
            found, about = log_ratio_interval(values, ones), replace(about, arm="significance")
            verdict = holds(not found.low > 1.0) if np.isfinite(found.low) else Verdict.UNDECIDED
            label = f"{label}, its gain's significance: {NAMES[name]}"
            criterion = "1 is in the interval"
            yield Claim(about, label, found, criterion, verdict, remark, role=Role.BESIDE)


def _one_drive(repeats: pd.DataFrame) -> Claim:
    """What the paper's own design shows: one drive, with new observations in each run."""
    own = repeats[(repeats["filter"] == "paper") & (repeats["image_draw"] > 0)]
    some, many = (own.loc[own["n_particles"] == n, POSITION].to_numpy() for n in (200, 1000))
    p = float(scipy.stats.ttest_ind(some, many, equal_var=False).pvalue)
    found = Interval.exact(float(some.mean() / many.mean()))
    said = (
        f"The paper's own design, one drive with {len(some)} runs, shows a ratio of "
        f"{found.value:.3g} with p = {p:.2g}: it sees "
        f"{'a gain' if p < 0.05 else 'no gain, being too small to show one'}."
    )
    about = Subject("GI3", OWN_DESIGN, arm="one drive")
    return shown(about, "position error, M = 200 over M = 1000, one drive", found, said, p=p)


def gi4(distance: pd.DataFrame) -> Iterator[Claim]:
    """GI4: the error of path and map (figures 9(a) and (b)) falls with dmax."""
    design = designs("gil2008")["GI4"]
    for about, words, is_beside, is_ours, part in _kinds("GI4", distance[distance["occluded"]]):
        hits = []
        for column, what in MEASURED.items():
            errors = pool_by_world(part, column, "max_distance_m")
            label = f"{what} error, dmax = 3 m over 10 m: {words}"
            arms = errors[3], errors[10]
            claim = judge_ratio(replace(about, metric=what), label, arms, design, at_least=FALLS)
            only = shown(claim.about, label, claim.found) if is_ours else beside(claim, is_beside)
            yield only
            hits.append(arms[0] > FALLS * arms[1])
        if not is_beside:
            yield own_design("GI4", "one drive", np.logical_and.reduce(hits))


def gi5(distance: pd.DataFrame) -> Iterator[Claim]:
    """GI5: nothing significant is gained past 10 m, because of the noise of far landmarks.

    The test is one-sided: an error that grows beyond 10 m agrees with the paper.
    """
    design = designs("gil2008")["GI5"]
    for about, words, is_beside, is_ours, part in _kinds("GI5", distance):
        far = float(part[part["max_distance_m"] == 20]["share_beyond_10_m"].mean())
        hits = []
        for column, what in MEASURED.items():
            values = ratios(part, column, "max_distance_m", 10, 20)
            label, own = (
                f"{what} error, dmax = 10 m over 20 m: {words}",
                replace(about, metric=what),
            )
            arms = values, np.ones(len(values))
            claim = judge_ratio(own, label, arms, design, at_most=NOT_WORSE)
            if far < 0.1:
                claim = _undecided(claim, "too few far observations")
            claim = with_remark(claim, f"{percent(far)} of observations beyond 10 m", far=far)
            yield (
                shown(own, label, claim.found, claim.reason)
                if is_ours
                else beside(claim, is_beside)
            )
            hits.append(values < NOT_WORSE)
        if not is_beside:
            yield own_design("GI5", "one drive", np.logical_and.reduce(hits))


def gi6(observations: pd.DataFrame) -> Iterator[Claim]:
    """GI6: the error against the number of observations of an image."""
    for name, table in observations.groupby("filter", sort=False):
        about = Subject("GI6", "", method=name)
        for claim in _trends(about, table, "n_seen", "B", 0.01, NAMES[name]):
            yield beside(claim, name != "paper")


def gi7_on_fresh_worlds(association: pd.DataFrame, divergence: pd.DataFrame) -> list[Claim]:
    """GI7 with its headlines in worlds of their own, and all other arms beside."""
    headlines = list(gi7(divergence))
    judged = {claim.about for claim in headlines}
    return [*headlines, *(claim for claim in gi7(association) if claim.about not in judged)]


def gi7(association: pd.DataFrame) -> Iterator[Claim]:
    """GI7: each particle's own association survives errors; descriptors make it more robust.

    Headlines are the printed filter's, at the paper's noise. A run diverges if its error is above
    odometry's.
    """
    printed, design = "paper", designs("gil2008")["GI7"]
    ours = association[(association["filter"] != "ekf_slam") & np.isclose(association["p0"], P0)]
    for (noise, name), table in ours.groupby(["noise", "filter"], sort=False):
        where, is_beside = f"{NAMES[name]}, {NOISE[noise]}", (noise, name) != ("paper", printed)
        known = table[table["association"] == "known"].set_index("seed")[POSITION]
        for sigma, part in table[table["association"] == "descriptor"].groupby("sigma_descriptor"):
            right, alone = part["right_share"].mean(), part["matching_precision"].mean()
            label = (
                "position error by distance and descriptor over known association, noise of "
                f"descriptors {sigma:g}: {where}"
            )
            both = pd.concat([part.set_index("seed")[POSITION], known], axis=1, join="inner")
            about = Subject("GI7", "descriptor", method=name, noise=noise, setting=sigma)
            arms, margin = (both.iloc[:, 0], both.iloc[:, 1]), 1.0 + design.effect
            claim = judge_ratio(about, label, arms, design, 1.0 / margin, margin)
            words = f"descriptors alone match {percent(alone)}, together {percent(right)} are right"
            yield beside(with_remark(claim, words), is_beside or sigma != DESCRIPTORS)
        guessed = table[table["association"] == "mahalanobis"].set_index("seed")
        single = association[
            (association["filter"] == "ekf_slam") & (association["noise"] == noise)
        ]
        if "noise_at" in table:  # R where the particle filter takes it
            single = single[single["noise_at"] == table["noise_at"].iloc[0]]
        single = single.set_index("seed")
        if guessed.empty:
            continue
        relative = [p["ate_rmse_m"] / p["odometry_rmse_m"] for p in (single, guessed)]
        ekf, particles = pd.concat(relative, axis=1, join="inner").to_numpy().T
        about = Subject("GI7", "divergence", method=name, noise=noise)
        alone = table[(table["association"] == "known")]
        known_share = float((alone["ate_rmse_m"] > alone["odometry_rmse_m"]).mean())
        claim = _divergence(about, ekf > 1.0, particles > 1.0, where)
        claim = replace(claim, facts={**claim.facts, "known": known_share})
        yield beside(claim, is_beside)
        if not is_beside:
            yield own_design("GI7", "one drive", ekf > particles)
        label = f"error of EKF-SLAM over FastSLAM's, both by Mahalanobis distance: {where}"
        about = replace(about, quantity="EKF-SLAM over FastSLAM")
        yield beside(judge_bounds(about, label, log_ratio_interval(ekf, particles), 1.0))


def _divergence(
    about: Subject, ekf: NDArray[np.bool_], fastslam: NDArray[np.bool_], where: str
) -> Claim:
    """Judge by McNemar's test that EKF-SLAM diverges in more worlds than FastSLAM.

    Only worlds in which one of them diverges tell; under the null hypothesis either is as likely.
    Not reproduced if the difference's interval has nothing from the smallest effect of interest on:
    then there is no effect that matters.
    """
    found = mean_interval(ekf.astype(float) - fastslam)
    alone, other = int(np.sum(ekf & ~fastslam)), int(np.sum(fastslam & ~ekf))
    n = alone + other
    p = float(scipy.stats.binomtest(alone, n, alternative="greater").pvalue) if n else 1.0
    label = f"share of runs that diverge, EKF-SLAM less FastSLAM, both by Mahalanobis: {where}"
    verdict = Verdict.UNDECIDED
    if len(ekf) >= 2 and p < 0.01:
        verdict = Verdict.REPRODUCED
    elif found.high < DIVERGE_MORE:
        verdict = Verdict.NOT_REPRODUCED
    shares = f"EKF-SLAM in {percent(ekf.mean())}, FastSLAM in {percent(fastslam.mean())}"
    reason = f"{shares}, with more than odometry's error; p = {p:.2g}"
    is_open = len(ekf) < DIVERGE_WORLDS
    facts = {"ekf": float(ekf.mean()), "fastslam": float(fastslam.mean()), "p": p, "n": len(ekf)}
    facts["is_open"] = is_open
    power = power_of(found, DIVERGE_MORE, error=0.01)
    return Claim(
        about, label, found, f"above 0, McNemar's p < 0.01; not so below {DIVERGE_MORE:g}", verdict,
        reason,
        effect=f"a share greater by {DIVERGE_MORE:g}", power=power, facts=facts,
    )  # fmt: skip


def gi8(cost: pd.DataFrame) -> Iterator[Claim]:
    """GI8: time of a step against N, with shared and with contiguous maps.

    The shared maps are blocks that particles hold in common until one of them writes, not the
    paper's tree, so that O(M log N) is not ours to claim; by distance, every landmark near is
    asked. The bounds leave a margin for other machines: 0.7 to 1.5 for an exponent of 1.
    """
    bands = {"shared": (-np.inf, 0.3), "contiguous": (0.7, 1.5)}
    for (maps, ids), table in cost.groupby(["maps", "association"], sort=False):
        repeats = table.groupby("repeat")
        found = mean_interval([log_log_slope(p["n_landmarks"], p["step_ms"]) for _, p in repeats])
        label = f"exponent of N in the time of a step, {maps} maps, {ids} association"
        about = Subject("GI8", "exponent", arm=str(maps), method=str(ids))
        yield beside(judge_bounds(about, label, found, *bands[maps]), ids != "known")
    known = cost[cost["association"] == "known"]
    wide = known.groupby(["n_landmarks", "maps"])["step_ms"].median().unstack("maps")
    for n, ratio in (wide["contiguous"] / wide["shared"]).items():
        label = f"time of a step, contiguous over shared, at N = {n}"
        about = Subject("GI8", "contiguous over shared", size=int(n))
        yield shown(about, label, Interval.exact(float(ratio)))


def _printed(name: str, noise: str) -> bool:
    """Whether these are the filter and the noise that the paper prints."""
    return (name, noise) == ("paper", "paper")


def _growth(table: pd.DataFrame, column: str) -> Array:
    """Ratio in each world (N,); a world's recordings are averaged first, in logs."""
    logs = np.log(table[column]).groupby(table["seed"]).mean().dropna()
    return np.asarray(np.exp(logs.to_numpy()))


def _kinds(
    claim: str, distance: pd.DataFrame
) -> Iterator[tuple[Subject, str, bool, bool, pd.DataFrame]]:
    """Runs that differ in dmax alone.

    Yields what the claim is about, the same in words, whether they stand beside the paper's,
    whether no claim is about them (the nearest landmarks are our addition), and their rows.
    """
    keys = ["filter", "occluded", "noise", "n_seen", "rule"]
    for (name, occluded, noise, n_seen, rule), part in distance.groupby(keys, sort=False):
        seen = f"{n_seen} {rule}" if n_seen else "all visible"
        walls = "behind walls" if occluded else "no walls"
        words = f"{NAMES[name]}, {seen}, {walls}, {NOISE[noise]}"
        about = Subject(claim, "dmax", method=name, noise=noise, arm=seen, place=walls)
        is_beside = not _printed(name, noise) or not occluded or n_seen > 0
        yield about, words, is_beside, rule == "nearest", part


def _undecided(claim: Claim, reason: str) -> Claim:
    return replace(claim, verdict=Verdict.UNDECIDED, reason=reason, power=math.nan)


def _trends(
    about: Subject, table: pd.DataFrame, by: str, symbol: str, limit: float, where: str
) -> Iterator[Claim]:
    """Judge by Page's test that errors fall; few worlds or p up to 5 % are undecided.

    Aligned errors are ours, and stand beside.
    """
    for column, what in ERRORS.items():
        errors = pool_by_world(table, column, by)
        (first, *_, last), p, n = errors.columns, page_trend_p(errors), len(errors)
        verdict = Verdict.NOT_REPRODUCED
        if p < limit:
            verdict = Verdict.REPRODUCED
        elif p < 0.05 or n < 20:
            verdict = Verdict.UNDECIDED
        label = f"{what} error, {symbol} = {last} over {symbol} = {first}: {where}"
        found = log_ratio_interval(errors[last], errors[first])
        criterion, reason = f"Page's p below {limit:g}", f"Page's p = {p:.2g}"
        claim = Claim(
            replace(about, quantity=what), label, found, criterion, verdict, reason,
            effect=effect_in_words(SMALLEST_EFFECT), power=power_of(found, error=limit),
            facts={"p": p},
        )  # fmt: skip
        yield beside(claim, what.startswith("aligned"))
