"""Settings that a paper leaves open: their plausible ranges, a sample of them, and the anchor.

They stand in the study's design.yaml, fixed before the judged run:

    regions:
      MX1:
        effect: 0.1 # smallest of interest, a ratio less one
        printed: # level of the reference arm, and where it comes out on tuning seeds
          Oxford: {column: oxford_m2_m, value: 9.61, anchor: {...}, level: 9.5}
        settings:
          estimator.n_nearest: {words: B, low: 2, high: 20, scale: integer, source: "..."}
          estimator.noise_at: {choices: [measured, predicted], source: "..."}
      MX3: {like: MX1} # the same settings and runs
      MX9: {like: MX1, is_alone: true} # judged by its region alone, without an anchor

The names are configuration keys, or say what they stand for. They stand there, not in conf/study,
as they belong to a claim, and a claim's runs may be composed from several of those files.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import qmc

from experiments.judging.claim import SMALLEST_EFFECT
from experiments.judging.folders import design
from experiments.judging.surface import fit_surface
from sim.arrays import Array
from sim.errors import InputError, require
from sim.yaml_file import number


class Scale(StrEnum):
    """How a setting's range is divided evenly."""

    LINEAR = "linear"
    LOG = "log"
    INTEGER = "integer"
    CHOICE = "choice"  # without an order


@dataclass(frozen=True)
class Setting:
    """A setting that a paper leaves open.

    Attributes
    ----------
    name
        Its configuration key.
    low, high
        Ends of the plausible range; of choices, the first and the last index.
    source
        Where the range comes from.
    words
        What sentences and figures call it, with its unit; empty: the name.
    """

    name: str
    scale: Scale
    low: float
    high: float
    source: str
    choices: tuple[str | float | bool, ...] = ()
    words: str = ""

    @property
    def called(self) -> str:
        """Its name in sentences and figures."""
        return self.words or self.name

    def at(self, units: ArrayLike) -> list[Any]:
        """Values at places (N,) in the range, each from 0 to 1."""
        u = np.asarray(units, float)
        if self.scale is Scale.LINEAR:
            return list((self.low + u * (self.high - self.low)).tolist())
        if self.scale is Scale.LOG:
            return list((self.low * (self.high / self.low) ** u).tolist())
        steps = np.floor(self.low + u * (self.high - self.low + 1.0))
        whole = [int(v) for v in np.clip(steps, self.low, self.high)]
        return [self.choices[i] for i in whole] if self.choices else whole

    def units(self, values: Sequence[Any]) -> Array:
        """Places (N,) of values in the range, each from 0 to 1."""
        if self.choices:
            values = [self.choices.index(v) for v in values]
        v = np.asarray(values, float)
        if self.scale is Scale.LINEAR:
            return np.asarray((v - self.low) / (self.high - self.low))
        if self.scale is Scale.LOG:
            return np.asarray(np.log(v / self.low) / math.log(self.high / self.low))
        return np.asarray((v - self.low + 0.5) / (self.high - self.low + 1.0))


@dataclass(frozen=True)
class Anchor:
    """Settings at which the reference arm has its printed level, and the level there.

    Where nothing is printed, the settings are the middle of the ranges, and the level is NaN.
    """

    settings: Mapping[str, Any]
    level: float = math.nan

    @property
    def words(self) -> str:
        """The settings in words."""
        return ", ".join(f"{name} = {as_words(value)}" for name, value in self.settings.items())

    def of(self, name: str) -> str:
        """A setting's value in words; of several data sets, each one's."""
        own = {
            key.removeprefix(name): v for key, v in self.settings.items() if key.startswith(name)
        }
        return " and ".join(f"{as_words(value)}{place}" for place, value in own.items())


def as_words(value: Any) -> str:
    """A setting's value for a sentence."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}".replace("e-0", "e-") if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Printed:
    """A level of the reference arm that the paper prints.

    Attributes
    ----------
    column
        Of the region's runs, with that level.
    anchor
        Where it comes out on tuning seeds; None: nowhere.
    """

    column: str
    value: float
    anchor: Anchor | None


@dataclass(frozen=True)
class FreeSettings:
    """The free settings of a claim.

    Attributes
    ----------
    runs
        The claim whose runs over the region these are.
    effect
        Smallest effect of interest, a ratio less one.
    printed
        Printed levels by where they apply, such as a data set.
    is_alone
        Whether the claim is judged by its region alone, as it is about the printed level itself.
    n_points, n_worlds
        Points of the region, a power of two, and worlds at each.
    """

    settings: tuple[Setting, ...]
    runs: str
    effect: float = SMALLEST_EFFECT
    printed: Mapping[str, Printed] = field(default_factory=dict)
    is_alone: bool = False
    n_points: int = 64
    n_worlds: int = 3

    @property
    def anchor(self) -> Anchor | None:
        """The anchor, of several data sets together; None for a claim that has none."""
        if self.is_alone:
            return None
        if not self.printed:
            return middle(self.settings)
        known = {place: each.anchor for place, each in self.printed.items() if each.anchor}
        one = len(self.printed) == 1
        settings = {
            name if one else f"{name} ({place})": value
            for place, anchor in known.items()
            for name, value in anchor.settings.items()
        }
        return Anchor(settings, min(a.level for a in known.values())) if known else None

    @property
    def drawn_anchor(self) -> Anchor | None:
        """The anchor that a figure shows; None if it does not know each setting."""
        at = self.anchor
        return at if at and {s.name for s in self.settings_apart} <= set(at.settings) else None

    @property
    def places(self) -> tuple[str, ...]:
        """The data sets, if there are several: each has settings of its own."""
        return tuple(self.printed) if len(self.printed) > 1 else ()

    @property
    def settings_apart(self) -> tuple[Setting, ...]:
        """The settings of each data set, one data set after another."""
        return (
            tuple(
                replace(each, name=f"{each.name} ({place})", words=f"{each.called} ({place})")
                for place in self.places
                for each in self.settings
            )
            or self.settings
        )


def free_settings(study: str) -> dict[str, FreeSettings]:
    """Return the free settings of a study's claims, by their ids, from its design.yaml.

    Raises
    ------
    InputError
        If a range is empty, of an unknown scale, or without a source.
    """
    found: dict[str, FreeSettings] = {}
    for claim, given in design(study).get("regions", {}).items():
        where = f"{study}/design.yaml: regions.{claim}"
        effect = number(given.get("effect", SMALLEST_EFFECT), f"{where}.effect")
        require(effect > 0.0, f"{where}.effect must be > 0")
        is_alone = bool(given.get("is_alone"))
        if "like" in given:
            require(given["like"] in found, f"{where}.like: no region before it has that name")
            first = found[given["like"]]
            found[claim] = replace(first, effect=effect, is_alone=is_alone)
            continue
        require(isinstance(given, dict) and given.get("settings"), f"{where}: needs settings")
        settings = tuple(
            _setting(name, of, f"{where}.settings.{name}") for name, of in given["settings"].items()
        )
        printed = {
            str(place): _printed(of, settings, f"{where}.printed.{place}")
            for place, of in given.get("printed", {}).items()
        }
        sizes = {f"n_{name}": int(given[name]) for name in ("points", "worlds") if name in given}
        found[claim] = FreeSettings(settings, claim, effect, printed, is_alone, **sizes)
    return found


def _printed(given: Any, settings: Sequence[Setting], where: str) -> Printed:
    require(isinstance(given, dict) and given.get("column"), f"{where}: needs a column")
    value, at = number(given.get("value"), f"{where}.value"), given.get("anchor")
    require(value > 0.0, f"{where}.value must be > 0")
    if at is None:
        return Printed(str(given["column"]), value, None)
    names = [each.name for each in settings]
    require(list(at) == names, f"{where}.anchor must set {', '.join(names)}, in this order")
    return Printed(str(given["column"]), value, Anchor(at, number(given["level"], where)))


def _setting(name: str, given: Any, where: str) -> Setting:
    require(isinstance(given, dict) and given.get("source"), f"{where}: needs a source")
    choices = tuple(given.get("choices", ()))
    low, high, source = 0.0, len(choices) - 1.0, str(given["source"])
    words = str(given.get("words", ""))
    scale = Scale.CHOICE
    if not choices:
        low, high = (number(given.get(end), f"{where}.{end}") for end in ("low", "high"))
        known = [each for each in Scale if each is not Scale.CHOICE]
        require(given.get("scale") in known, f"{where}.scale must be one of {', '.join(known)}")
        scale = Scale(given["scale"])
    require(low < high, f"{where}: low must be below high, or choices two or more")
    require(scale is not Scale.LOG or low > 0.0, f"{where}: a log scale needs low > 0")
    return Setting(name, scale, low, high, source, choices, words)


def table_at(settings: Sequence[Setting], units: Array) -> pd.DataFrame:
    """Values at places (N, D) of the region: a column a setting."""
    return pd.DataFrame({s.name: s.at(u) for s, u in zip(settings, units.T, strict=True)})


def units_of(settings: Sequence[Setting], table: pd.DataFrame) -> Array:
    """Places (N, D) in the region of a table's rows."""
    return np.stack([s.units(table[s.name].tolist()) for s in settings], axis=1)


def snap(settings: Sequence[Setting], units: Array) -> Array:
    """Places (N, D) of the values that settings take: whole numbers and choices are steps."""
    return units_of(settings, table_at(settings, units))


def are_choices(settings: Sequence[Setting]) -> tuple[bool, ...]:
    """Whether each setting is a choice without an order."""
    return tuple(s.scale is Scale.CHOICE for s in settings)


def sample(
    settings: Sequence[Setting], n: int = 64, *, rng: np.random.Generator | None
) -> pd.DataFrame:
    """Scrambled Sobol points (n) of the region, a column a setting; n is a power of two.

    Without a generator they are not scrambled, and lie in the middles of their cells.
    """
    require(n > 0 and n & (n - 1) == 0, f"a Sobol sample has a power of two points, not {n}")
    points = qmc.Sobol(len(settings), scramble=rng is not None, rng=rng).random(n)
    return table_at(settings, points if rng else points + 0.5 / n)


def middle(settings: Sequence[Setting]) -> Anchor:
    """The middle of all ranges: the anchor where nothing is printed."""
    return Anchor({s.name: s.at([0.5])[0] for s in settings})


def find_anchor(
    settings: Sequence[Setting],
    points: pd.DataFrame,
    levels: ArrayLike,
    printed: float,
    measure: Callable[[Mapping[str, Any]], float],
    *,
    tolerance: float = 0.05,
    tries: int = 5,
) -> Anchor | None:
    """Settings nearest the middle at which the reference arm's level is the printed one.

    A surface through the logs of the levels proposes them. The level is measured there, and by
    what it is off, the surface is shifted for the next proposal.

    Parameters
    ----------
    points, levels
        Settings (N) and the reference arm's level (N,) at each, on tuning seeds.
    measure
        The level at other settings, on the same seeds.
    tolerance
        Of the level, as a share.

    Returns
    -------
    Anchor or None
        None if no settings of the region have that level.
    """
    logs = np.log(np.asarray(levels, float))
    if not np.isfinite(logs).all():
        raise InputError("levels of the reference arm must be positive numbers")
    surface = fit_surface(units_of(settings, points), logs, are_choices(settings))
    tried = snap(settings, units_of(settings, sample(settings, 4096, rng=None)))
    foreseen = surface.weights(tried) @ logs
    distance = np.linalg.norm(tried - 0.5, axis=1)
    shift, near = math.log(printed), math.log1p(tolerance)
    for _ in range(tries):
        off = np.abs(foreseen - shift)
        if off.min() > near:
            return None
        reached = np.flatnonzero(off <= max(near / 5.0, float(off.min())))
        best = int(reached[distance[reached].argmin()])
        values = table_at(settings, tried[[best]]).iloc[0].to_dict()
        level = float(measure(values))
        if abs(math.log(level / printed)) <= near:
            return Anchor(values, level)
        shift = math.log(printed) - (math.log(level) - float(foreseen[best]))
    return None
