"""The claims PB1-PB4 of puzzlebot2024."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import Interval, mean_interval, share_interval
from experiments.judging.claim import (
    EQUIVALENCE,
    Claim,
    Subject,
    Verdict,
    beside,
    holds,
    judge_bounds,
    judge_interval,
    overall,
    power_of,
    shown,
)
from experiments.judging.region_runs import judge_tables
from experiments.judging.results import Results
from experiments.papers.puzzlebot2024.settings import NOMINAL, REPORTED_TURN_RATIO, REPORTS
from sim.arrays import Array

# Sigma_1 and Sigma_2 as printed, each with half a unit of its last digit
PRINTED = (
    (((0.5, 0.01, 0.01), (0.01, 0.5, 0.01), (0.01, 0.01, 0.2)), 0.005),
    (((0.9998, 0.0207, 0.0180), (0.0207, 1.0040, 0.0399), (0.0180, 0.0399, 0.4000)), 0.00005),
)


HELD_UP_TO_M = 1e-4  # k up to which the ellipse has to hold
_BAND = (0.93, 0.97)
_OUT_AND_BACK = "out and back"


def judge(results: Results) -> list[Claim]:
    """Judge PB1-PB4 by the tables."""
    return judge_tables(results, {
        "PB1": (pb1, {}),
        "PB2": (pb2, {"areas": (), "crossover": ()}),
        "PB3": (pb3, {
            "calibration": ("runs",), "gradient_descent": (), "engine_k": (), "short_turns": (),
            "short_turns_found": (),
        }),
        "PB4": (pb4, {"coverage": ("runs_without_lag",), "engine": (), "table_1": ()}),
    })  # fmt: skip


def worked_matrices() -> tuple[Array, Array]:
    """Sigma_1 and Sigma_2 of puzzlebot2024, eqs. (7)-(9).

    The recursion is eq. (1) with Q as given in eq. (7) and H of eq. (4) for v = 1 m/s and
    dt = 0.1 s. The heading that enters H is 0 at the first step and, with w = 1 rad/s, 0.1 rad
    at the second.
    """
    Q = np.array([[0.5, 0.01, 0.01], [0.01, 0.5, 0.01], [0.01, 0.01, 0.2]])
    v, w, dt = 1.0, 1.0, 0.1
    H = np.eye(3)
    H[:2, 2] = -dt * v * math.sin(w * dt), dt * v * math.cos(w * dt)
    return Q, H @ Q @ H.T + Q


def pb1() -> list[Claim]:
    """PB1: the worked matrices come out to the printed digit (0.998 read as 0.9998)."""
    worst = max(
        float(np.abs(worked - printed).max()) / half_unit
        for worked, (printed, half_unit) in zip(worked_matrices(), PRINTED, strict=True)
    )
    statistic = "largest deviation of Sigma_1 and Sigma_2, in half units of the last printed digit"
    about = Subject("PB1", "deviation")
    return [Claim(about, statistic, Interval.exact(worst), "at most 1", holds(worst <= 1.0))]


def pb2(
    areas: pd.DataFrame, crossover: pd.DataFrame, track_m: float = NOMINAL.track_m
) -> Iterator[Claim]:
    """PB2: the ellipse grows on straights and arcs; heading takes over at track sqrt(3) / 2."""
    for name, table in areas.groupby("manoeuvre", sort=False):
        steps = np.concatenate([np.diff(part["area_m2"]) for _, part in table.groupby("k_m")])
        shrinking = float(np.mean(steps < -1e-9 * table["area_m2"].max()))
        statistic = f"share of steps in which the 95 % ellipse shrinks, {name}"
        found, about = Interval.exact(shrinking), Subject("PB2", "shrinks", arm=str(name))
        if name == _OUT_AND_BACK:
            yield shown(about, statistic, found, "it shrinks on the way back")
        else:
            yield Claim(about, statistic, found, "0", holds(shrinking <= 0.0))
    ratio = mean_interval(crossover["crossover_m"] / (track_m * math.sqrt(3.0) / 2.0))
    statistic = "distance at which heading-borne spread overtakes, over track sqrt(3) / 2"
    yield judge_bounds(Subject("PB2", "crossover"), statistic, ratio, 0.98, 1.02)


def pb3(
    calibration: pd.DataFrame,
    descent: pd.DataFrame,
    engine_k: pd.DataFrame,
    ends: pd.DataFrame | None = None,
    found: pd.DataFrame | None = None,
) -> Iterator[Claim]:
    """PB3: kr, kl from nine open-loop runs, by the report's own program.

    The biases of kr and kl are judged apart, since opposite ones would cancel; the worse is stated.
    Beside stand sound methods (wheel truth, and end poses by the sampled and by the linearised
    likelihood) with nine runs and with 180, gains and track, and PyBullet's robot.
    """
    kinds = calibration.groupby(["method", "joint", "k_m", "runs"], sort=False)
    for (method, joint, k, runs), table in kinds:
        arm = "gain and track joint" if joint else "nominal geometry"
        where = f"{method}, {runs} runs, k = {k:g} m, {arm}"
        about = Subject(
            "PB3", "bias", method=str(method), setting=float(k), size=int(runs),
            arm="joint" if joint else None,
        )  # fmt: skip
        is_slip = table["parameter"].isin(["kr", "kl"])
        slips, parts = table[is_slip], {"kr and kl": table[is_slip]}
        if joint:
            parts["gains and track"] = table[~is_slip]
        for names, part in parts.items() if method != REPORTS else ():
            share = _clustered_share(part["truth"].between(part["low"], part["high"]), part["seed"])
            label = f"coverage of the 95 % intervals of {names}: {where}"
            covered = dataclasses.replace(about, quantity="coverage", metric=names)
            yield beside(judge_bounds(covered, label, share, 0.90, 0.99))
        relative = slips["value"] / slips["truth"] - 1.0
        biases = [mean_interval(part) for _, part in relative.groupby(slips["parameter"])]
        worse = max(biases, key=lambda bias: abs(bias.value))
        label = f"relative bias, the worse of kr and kl: {where}"
        verdict = overall([judge_interval(bias, -0.05, 0.05) for bias in biases])
        claim = dataclasses.replace(judge_bounds(about, label, worse, -0.05, 0.05), verdict=verdict)
        repetitions = int(slips["seed"].nunique())
        claim = dataclasses.replace(claim, facts={**claim.facts, "repetitions": repetitions})
        yield beside(claim, method != REPORTS)
    for row in engine_k.itertuples():
        label = (
            f"{row.parameter} of PyBullet's robot by wheel truth, over the truth, k = {row.k_m:g} m"
        )
        ratio = Interval(row.value / row.truth, row.low / row.truth, row.high / row.truth)
        about = Subject("PB3", "k of PyBullet's robot", setting=row.k_m, metric=row.parameter)
        yield beside(judge_bounds(about, label, ratio, 0.95, 1.05))
    limits = np.abs(descent["k_in_the_end"] - 0.5)
    what = "the report's program: largest distance of its limit from 1/2, on its example data"
    about = Subject("PB3", "gradient descent")
    remark = "its limit should be kr or kl, which are some 1e-5 to 1e-3 m"
    yield shown(about, what, Interval.exact(float(limits.max())), remark)
    if ends is not None and found is not None:
        yield from pb3_short_turns(ends, found)


def pb3_short_turns(ends: pd.DataFrame, found: pd.DataFrame) -> Iterator[Claim]:
    """PB3: the robot of the report, whose turns come out at 0.44 of the command, is calibrated.

    All beside: the report says how far the robot turns, and finds no cause.
    """
    turns = ends[ends["omega_radps"] != 0.0]
    where = "the robot with the wrong track"
    for who, label in (("real", "as it came"), ("calibrated", "with the track found")):
        ratios = turns[f"{who}_heading_mean_rad"] / turns["ideal_heading_rad"]
        what = f"turns over commanded ones, {where}, {label}"
        reported = f"the report: {REPORTED_TURN_RATIO}" if who == "real" else ""
        yield shown(Subject("PB3", "turns", arm=who), what, mean_interval(ratios), reported)
    row = found.set_index("parameter").loc["track_m"]
    ratio = Interval(*(float(row[name] / row["truth"]) for name in ("value", "low", "high")))
    what = f"track over the true one, {where}, gains and track by sampled end poses"
    yield beside(judge_bounds(Subject("PB3", "track"), what, ratio, 0.98, 1.02))


def pb4(coverage: pd.DataFrame, engine: pd.DataFrame, cases: pd.DataFrame) -> Iterator[Claim]:
    """PB4, our own: the true end lies in the ideal robot's 95 % ellipse, per k; where that ends.

    Headlines are the k up to 1e-4 m, where the ellipse has to hold. The manoeuvre that does worst
    is a fact, and its length, if it is a straight.

    Parameters
    ----------
    cases
        Velocities and duration of each manoeuvre, `case`.
    """
    straights = cases[cases["omega_radps"] == 0.0].set_index("case")
    length_m = straights["v_mps"] * straights["duration_s"]
    left = []
    for k, table in coverage.groupby("k_m"):
        shares = [share_interval(int(row.in_ellipse), int(row.runs)) for row in table.itertuples()]
        worst = int(np.argmin([share.value for share in shares]))
        parts = [judge_interval(share, *_BAND) for share in shares]
        powers = [power_of(share, band=_BAND) for share in shares]
        case, runs = table.iloc[worst]["case"], int(table.iloc[worst]["runs"])
        n_within = f"{parts.count(Verdict.REPRODUCED)} of {len(parts)}"
        claim = Claim(
            Subject("PB4", "ends in the ellipse", setting=float(k)),
            f"least share of ends in the 95 % ellipse over nine manoeuvres, k = {k:g}",
            shares[worst],
            "every manoeuvre's interval within 0.93 and 0.97",
            overall(parts),
            f"{n_within} manoeuvres within; the least in {case}",
            effect=EQUIVALENCE,
            power=min(powers),
            facts={
                "case": case, "runs": runs, "straight_m": length_m.get(case), "band": _BAND,
                "within": parts.count(Verdict.REPRODUCED), "cases": len(parts),
            },
        )  # fmt: skip
        yield beside(claim, k > HELD_UP_TO_M * (1 + 1e-9))
        left += [k] if claim.verdict is Verdict.NOT_REPRODUCED else []
    label = "distance of PyBullet's end from the kinematic robot's, same noise, over the spread"
    gap = mean_interval(_engine_gap(engine))
    yield beside(judge_bounds(Subject("PB4", "engine"), label, gap, at_most=0.05))
    if "runs_without_lag" in coverage:
        for k, table in coverage.groupby("k_m"):
            columns = ("in_ellipse", "runs"), ("in_ellipse_without_lag", "runs_without_lag")
            lagging, at_once = (table[hits] / table[n] for hits, n in columns)
            change = at_once - lagging
            most = float(change[change.abs().idxmax()])
            label = (
                "share of ends in the ellipse, slip at once less slip with its lag, the manoeuvre "
                f"in which it differs most, k = {k:g}"
            )
            yield shown(Subject("PB4", "lag", setting=float(k)), label, Interval.exact(most))
    for case, table in coverage.groupby("case", sort=False):
        shares = table.sort_values("k_m")
        within = (shares["in_ellipse"] / shares["runs"]).between(*_BAND).cummin()
        held_m = float(shares["k_m"][within].max()) if within.any() else 0.0
        about = Subject("PB4", "held up to", place=str(case), setting=held_m)
        label = f"k up to which the share of ends in the ellipse is within the band, m, {case}"
        yield shown(about, label, Interval.exact(held_m))
    if left:
        what = "least k at which a manoeuvre leaves the band, m"
        yield shown(Subject("PB4", "limit"), what, Interval.exact(left[0]))


def _engine_gap(engine: pd.DataFrame) -> pd.Series[float]:
    """RMS, per seed, of the end's gap in x, y and heading over that case's own spread."""
    kinematic = engine.filter(like="kinematic_")
    spread = kinematic.groupby(engine["case"]).transform("std")
    gap = (engine.filter(like="bullet_").to_numpy() - kinematic) / spread
    return (gap**2).mean(axis=1).groupby(engine["seed"]).mean() ** 0.5


def _clustered_share(hits: pd.Series[bool], seeds: pd.Series[int]) -> Interval:
    """Share of hits with its Clopper-Pearson interval.

    One repetition gives several hits or misses. As far as these are correlated, they count as fewer
    trials, by the ratio of the repetitions' variance to that of independent trials.
    """
    share, by_seed = float(hits.mean()), hits.groupby(seeds).mean()
    alone = share * (1.0 - share) * len(by_seed) / len(hits)
    trials = round(len(hits) / (max(1.0, float(by_seed.var()) / alone) if alone > 0.0 else 1.0))
    return dataclasses.replace(share_interval(round(share * trials), trials), value=share)
