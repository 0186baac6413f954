"""Where in the region of its free settings a claim holds, what decides it, and the verdict.

At each of many points of the region the claim's log ratios are known in some worlds. A smooth
surface through their means predicts them everywhere, and is bootstrapped over worlds.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import Interval
from experiments.judging.claim import SMALLEST_EFFECT, Verdict
from experiments.judging.corner import corner
from experiments.judging.free_settings import (
    Anchor,
    Setting,
    are_choices,
    as_words,
    sample,
    snap,
    units_of,
)
from experiments.judging.surface import Surface, fit_surface
from experiments.runs.console import enumerate_words
from sim.arrays import Array
from sim.errors import require

MOST, LEAST = 0.8, 0.2  # of the region: a claim holds in it, or fails in it
NOWHERE, EVERYWHERE, NONE_ALONE = (
    "nowhere in the region",
    "everywhere in the region",
    "no single setting",
)
_NO_EFFECT = 1e-3  # spread of a log ratio over the region that no setting need explain
_LOCATED = 0.5  # of a setting's range, in which a boundary's interval must lie to be named
_N_SHARE, _N_OTHERS, _N_LEVELS, _N_LINE = 1024, 64, 16, 201


@dataclass(frozen=True)
class Side:
    """The claim's side of a log ratio: between two limits, one of which may be infinite.

    Attributes
    ----------
    effect
        Smallest effect of interest, a ratio less one: how far beyond a single limit the ratio must
        lie. A band with two ends is a margin already.
    """

    low: float = -math.inf
    high: float = math.inf
    effect: float = SMALLEST_EFFECT

    @property
    def needed(self) -> tuple[float, float]:
        """The limits, the single one moved inward by the smallest effect."""
        is_band = math.isfinite(self.low) and math.isfinite(self.high)
        need = 0.0 if is_band else math.log1p(self.effect)
        return self.low + need, self.high - need

    def margin(self, logs: Array) -> Array:
        """How far log ratios lie on the claim's side, by the smallest effect or more if > 0."""
        low, high = self.needed
        return np.asarray(np.minimum(logs - low, high - logs))


@dataclass(frozen=True)
class Fitted:
    """Surfaces of a claim's headlines, and its data resampled.

    Attributes
    ----------
    means
        For each headline, means (1 + B, P) at the points: first those found, then the resampled.
    columns
        For each headline, the settings that its surface takes; of several data sets, its own.
    """

    settings: tuple[Setting, ...]
    sides: tuple[Side, ...]
    surfaces: tuple[Surface, ...]
    means: tuple[Array, ...]
    columns: tuple[slice, ...]

    @property
    def n_points(self) -> int:
        """How many points were sampled."""
        return int(self.means[0].shape[1])

    def logs(self, headline: int, units: Array) -> Array:
        """Log ratio (1 + B, N) of a headline at places (N, D)."""
        weights = self.surfaces[headline].weights(units[:, self.columns[headline]])
        return np.asarray(self.means[headline] @ weights.T)

    def margins_apart(self, units: Array) -> Array:
        """Margin (H, 1 + B, N) of each headline at places (N, D)."""
        return np.stack([side.margin(self.logs(i, units)) for i, side in enumerate(self.sides)])

    def margins(self, units: Array) -> Array:
        """Margin (1 + B, N) of the worst headline at places (N, D)."""
        return np.asarray(self.margins_apart(units).min(axis=0))

    @cached_property
    def spread(self) -> tuple[Array, Array]:
        """Places (N, D) spread evenly over the region, and each headline's margin there."""
        units = units_of(self.settings, sample(self.settings, _N_SHARE, rng=None))
        return units, self.margins_apart(units)


@dataclass(frozen=True)
class Region:
    """What the region says of a claim.

    Attributes
    ----------
    anchor
        None: nothing but the region is judged.
    share
        Of the region, in which the claim holds by the smallest effect of interest.
    decided_by, boundary
        The setting that decides, and where the claim begins or ceases to hold along it, in words;
        where none decides alone or its boundary is not located, the corner in which it holds most.
    called
        The setting's name in sentences; empty: as it is.
    along
        In how much of the region the claim holds along that setting, in words; empty where the
        boundary is a corner's.
    failing
        The headline that misses its limit by most in the rest, in words; empty if there is one.
    """

    anchor: Anchor | None
    share: Interval
    decided_by: str
    boundary: str
    called: str = ""
    along: str = ""
    failing: str = ""

    def words(self, at_anchor: Verdict, level: str = "") -> str:
        """Say in how much of the region the claim holds, what decides, and what the anchor says.

        Parameters
        ----------
        level
            The printed level that the anchor has, in words.
        """
        value, low, high = map(_percent, (self.share.value, self.share.low, self.share.high))
        said = [
            "Over the settings that the paper leaves open, each within its plausible range, the "
            f"claim holds in {value} % [{low}, {high}]."
        ]
        is_one = self.decided_by != NONE_ALONE
        if self.along:
            said += [
                f"{self.along}.",
                f"With the others in the middle of their ranges, it {self.boundary}.",
            ]
        elif is_one:
            said += [f"{self.called} matters most, without a clear boundary; it {self.boundary}."]
        elif self.boundary not in (NOWHERE, EVERYWHERE):
            reverses = LEAST <= self.share.value <= MOST
            said += [
                "No single setting tells clearly where. What tells most is this division of the "
                f"region: it {self.boundary}."
                if reverses
                else f"No single setting reverses it; it {self.boundary}."
            ]
        if self.boundary in (NOWHERE, EVERYWHERE):
            said += ["Nothing beyond the ranges was tried, so what would change this is not known."]
        if self.failing:
            said += [
                "Where it does not hold, the headline that misses its limit by most is "
                f"{self.failing}."
            ]
        said += [
            f"The interval of this share contains {100 * limit:.0f} %, the limit between {what}, "
            "so the claim is undecided."
            for limit, what in (
                (LEAST, "failing and depending on the settings"),
                (MOST, "depending on the settings and holding"),
            )
            if limit in limits_spanned(self.share)
        ]
        if self.anchor is not None:
            where = "in the middle of the ranges, since the paper prints no level to match"
            if math.isfinite(self.anchor.level):
                where = f"where {level or 'our runs have the printed level'}"
            if at := self.anchor.of(self.decided_by):
                where += f", with {self.called or self.decided_by} = {at}"
            lies = {Verdict.REPRODUCED: "it holds", Verdict.NOT_REPRODUCED: "it does not hold"}
            said += [f"At the anchor, {where}, {lies.get(at_anchor, 'it is undecided')}."]
        return " ".join(each[:1].upper() + each[1:] for each in said)


def fit(
    settings: Sequence[Setting],
    points: pd.DataFrame,
    headlines: Sequence[tuple[Array, Side]],
    rng: np.random.Generator,
    *,
    shares_worlds: bool = False,
    n_resamples: int = 400,
) -> Fitted:
    """Fit a surface to the log ratios of each headline, and resample them by worlds.

    Parameters
    ----------
    points
        Settings (P) by name.
    headlines
        Log ratios (P, W) at each point in W worlds, and the claim's side.
    shares_worlds
        Whether a column is one world at all points; else each point has its own.
    """
    units = units_of(settings, points)
    n_points, n_worlds = headlines[0][0].shape
    require(n_worlds >= 2, "a region needs two worlds or more at each point")
    shape = (n_resamples, 1 if shares_worlds else n_points, n_worlds)
    drawn = rng.integers(n_worlds, size=shape)
    surfaces, means = [], []
    for logs, _ in headlines:
        require(logs.shape == (n_points, n_worlds), "headlines need the same points and worlds")
        require(bool(np.isfinite(logs).all()), "log ratios of a region must be finite")
        found = logs.mean(axis=1)
        away = (logs - found[:, None]) * math.sqrt(n_worlds / (n_worlds - 1.0))  # unbiased variance
        picked = np.take_along_axis(
            away[None], np.broadcast_to(drawn, (n_resamples, *logs.shape)), 2
        )
        surfaces.append(fit_surface(units, found, are_choices(settings)))
        means.append(np.vstack([found, found + picked.mean(axis=2)]))
    sides = tuple(side for _, side in headlines)
    columns = tuple(slice(None) for _ in headlines)
    return Fitted(tuple(settings), sides, tuple(surfaces), tuple(means), columns)


def share(fitted: Fitted) -> Interval:
    """Share of the region in which the claim holds by the smallest effect of interest.

    Of one that holds at all places, or at none, the interval reaches as far as the exact one of
    95 % for the points sampled, on the one side that is left.
    """
    _, margins = fitted.spread
    found = _interval((margins.min(axis=0) > 0.0).mean(axis=1))
    beyond = 1.0 - 0.05 ** (1.0 / fitted.n_points)
    if found.value == 0.0:
        return replace(found, high=max(found.high, beyond))
    return replace(found, low=min(found.low, 1.0 - beyond)) if found.value == 1.0 else found


def first_order(fitted: Fitted) -> Array:
    """First-order Sobol indices (1 + B, D) of the margin."""
    d = len(fitted.settings)
    others = units_of(fitted.settings, sample(fitted.settings, _N_OTHERS, rng=None))
    found = []
    for i in range(d):
        places = np.tile(others, (_N_LEVELS, 1, 1))
        places[..., i] = ((np.arange(_N_LEVELS) + 0.5) / _N_LEVELS)[:, None]
        margins = fitted.margins(snap(fitted.settings, places.reshape(-1, d)))
        by_level = margins.reshape(len(margins), _N_LEVELS, _N_OTHERS)
        total = np.maximum(by_level.var(axis=(1, 2)), _NO_EFFECT**2)
        found.append(by_level.mean(axis=2).var(axis=1) / total)
    return np.stack(found, axis=1)


def deciding(indices: Array) -> int | None:
    """The setting whose index is clear of all others', by the resampled ones; None: none is."""
    first = int(indices[0].argmax())
    ahead = indices[:, first] - np.delete(indices, first, axis=1).max(axis=1, initial=0.0)
    return first if np.quantile(ahead[1:], 0.025) > 0.0 else None


def holding(fitted: Fitted, i: int) -> tuple[Interval, Interval] | None:
    """The longest stretch of setting `i` in which the claim holds, the others at their middle.

    Its two ends, as shares of the range; 0 and 1 without spread where it reaches the range's end.
    None if the claim holds nowhere on the line.
    """
    line = np.full((_N_LINE, len(fitted.settings)), 0.5)
    line[:, i] = np.linspace(0.0, 1.0, _N_LINE)
    margins = fitted.margins(snap(fitted.settings, line))
    stretches = [_longest(row > 0.0) for row in margins]
    if stretches[0] is None:
        return None
    lost = (_N_LINE - 1, 0)  # where nothing is left, each end has met the other end of the range
    ends = np.array([each or lost for each in stretches]) / (_N_LINE - 1.0)
    low, high = _interval(ends[:, 0]), _interval(ends[:, 1])
    return (
        Interval.exact(0.0) if low.value == 0.0 else low,
        Interval.exact(1.0) if high.value == 1.0 else high,
    )


def boundary_in_words(fitted: Fitted, i: int) -> str:
    """Where along setting `i` the claim holds, the others at their middle; empty: not located."""
    setting, stretch = fitted.settings[i], holding(fitted, i)
    if setting.choices:
        line = np.full((len(setting.choices), len(fitted.settings)), 0.5)
        line[:, i] = setting.units(setting.choices)
        good = fitted.margins(snap(fitted.settings, line))[0] > 0.0
        named = [as_words(c) for c, holds in zip(setting.choices, good, strict=True) if holds]
        if good.all():
            return EVERYWHERE
        return f"holds where it is {' or '.join(named)}" if named else NOWHERE
    if stretch is None:
        return NOWHERE
    low, high = stretch
    if max(end.high - end.low for end in stretch) >= _LOCATED:
        return ""

    def words(end: Interval) -> str:
        value, least, most = map(as_words, setting.at([end.value, end.low, end.high]))
        return f"{value} [{least}, {most}]"

    parts = [f"above {words(low)}"] * (low.value > 0.0) + [f"below {words(high)}"] * (
        high.value < 1.0
    )
    return f"holds {' and '.join(parts)}" if parts else EVERYWHERE


def along_in_words(fitted: Fitted, i: int) -> str:
    """In how much of the region the claim holds along setting `i`, all others varied."""
    setting, (units, margins) = fitted.settings[i], fitted.spread
    good, u = margins[:, 0].min(axis=0) > 0.0, units[:, i]
    if setting.choices:
        parts = [
            f"{_percent(good[u == at].mean())} % where it is {as_words(choice)}"
            for choice, at in zip(setting.choices, setting.units(setting.choices), strict=True)
        ]
    else:
        low, high = (as_words(v) for v in setting.at([0.25, 0.75]))
        parts = [
            f"{_percent(good[u < 0.25].mean())} % where it is below {low}",
            f"{_percent(good[(u >= 0.25) & (u < 0.75)].mean())} % from there to {high}",
            f"{_percent(good[u >= 0.75].mean())} % above",
        ]
    return f"{setting.called} matters most: the claim holds in {enumerate_words(parts)}"


def failing_in_words(fitted: Fitted, headlines: Sequence[str]) -> str:
    """The headline that misses its limit by most where the claim does not hold."""
    each = fitted.spread[1][:, 0]
    failing = each[:, each.min(axis=0) <= 0.0]
    if len(headlines) < 2 or not failing.size:
        return ""
    count = np.bincount(failing.argmin(axis=0), minlength=len(headlines))
    most = int(count.argmax())
    part = count[most] / count.sum()
    mostly = " (in all of that part)" if part == 1.0 else f" (in {_percent(part)} % of that part)"
    return f'"{headlines[most]}"{mostly}'


def describe(fitted: Fitted, anchor: Anchor | None, headlines: Sequence[str] = ()) -> Region:
    """What a fitted region says of its claim, whose headlines are named in words."""
    indices = first_order(fitted)
    found, first = share(fitted), deciding(indices)
    fails = failing_in_words(fitted, headlines)
    if found.value in (0.0, 1.0):
        at = NOWHERE if found.value == 0.0 else EVERYWHERE
        return Region(anchor, found, NONE_ALONE, at, failing=fails)
    boundary = "" if first is None else boundary_in_words(fitted, first)
    if first is not None and boundary not in ("", NOWHERE, EVERYWHERE):
        own, along = fitted.settings[first], along_in_words(fitted, first)
        return Region(anchor, found, own.name, boundary, own.called, along, fails)
    units, margins = fitted.spread
    most = corner(fitted.settings, units, margins.min(axis=0) > 0.0)
    where = most.words if most else ""
    if first is None or boundary:
        return Region(anchor, found, NONE_ALONE, where, failing=fails)
    own = fitted.settings[first]
    return Region(anchor, found, own.name, where, own.called, failing=fails)


def limits_spanned(share: Interval) -> list[float]:
    """Those of the two limits of a region's share that lie in its interval."""
    return [limit for limit in (LEAST, MOST) if share.low <= limit <= share.high]


def rule(at_anchor: Verdict, found: Interval) -> Verdict:
    """The verdict on a claim by its headlines at the anchor and the region's share.

    Parameters
    ----------
    at_anchor
        Of the headlines together; `SHOWN` for a claim that is judged by its region alone.
    found
        Share of the region in which the claim holds.
    """
    spans = limits_spanned(found)
    if at_anchor is Verdict.UNDECIDED or spans or not math.isfinite(found.value):
        return Verdict.UNDECIDED
    if found.low > MOST and at_anchor is not Verdict.NOT_REPRODUCED:
        return Verdict.REPRODUCED
    if found.high < LEAST and at_anchor is not Verdict.REPRODUCED:
        return Verdict.NOT_REPRODUCED
    return Verdict.DEPENDS


def region_columns(region: Region | None, at_anchor: Verdict) -> Mapping[str, Any]:
    """The cells of verdicts.csv on the region; empty for a claim without free settings."""
    if region is None:
        return {}
    holds = {Verdict.REPRODUCED: "yes", Verdict.NOT_REPRODUCED: "no"}
    return {
        "anchor": region.anchor.words if region.anchor else "",
        "holds_at_anchor": holds.get(at_anchor, "unclear") if region.anchor else "",
        "region_share": region.share.value,
        "region_low": region.share.low,
        "region_high": region.share.high,
        "decided_by": region.decided_by,
        "boundary": region.boundary,
    }


def _percent(share: float) -> str:
    """A share in percent, near 0 and 1 with another digit."""
    is_near = 0.0 < share < 0.0495 or 0.9505 < share < 1.0
    return f"{100.0 * share:.1f}" if is_near else f"{100.0 * share:.0f}"


def _interval(values: Array) -> Interval:
    """The first value, and the interval of the others."""
    low, high = np.quantile(values[1:], [0.025, 0.975])
    return Interval(float(values[0]), float(min(low, values[0])), float(max(high, values[0])))


def _longest(holds: Array) -> tuple[int, int] | None:
    """First and last place of the longest stretch that holds; None if there is none."""
    edges = np.flatnonzero(np.diff(np.r_[0, holds.astype(int), 0]))
    if not len(edges):
        return None
    k = int((edges[1::2] - edges[::2]).argmax())
    return int(edges[2 * k]), int(edges[2 * k + 1]) - 1
