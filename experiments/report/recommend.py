"""Which estimators fit a robot and its sensors, and how they did in the nearest judged settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from estimators.peers import MissingPackageError
from experiments.report.export import significant
from experiments.runs import paths
from experiments.runs.compose import Composer, open_composer
from experiments.runs.experiment import Experiment
from experiments.runs.row import read_rows
from experiments.runs.schema import leaves
from sim.errors import require

Setting = dict[str, Any]
_ERROR = "answer_ate_rmse_m"
_ALWAYS = (  # compared for every estimator
    "world", "world.changed_share", "people.n", "team.size", "prior.start", "robot.kr", "robot.kl",
    "route.distance_m",
)  # fmt: skip
_WITHOUT_IDS = "estimator.association=mahalanobis"
_MOST_CHANGES, _MOST_SHOWN, _MOST_TRIED = 6, 8, 4
_TUNED = "_tuned"
_COMPOSED = 0.7  # share of the time that goes to the estimators; the rest, to the tables
SURE = "sure"  # name of the sweep


@dataclass(frozen=True)
class Judged:
    """A mean position RMSE from a table of results.

    Attributes
    ----------
    table
        The study's name.
    estimator
        Name of its option, without its folder.
    setting
        Keys and values that made the recordings; of the estimator those that were swept.
    error_m, low_m, high_m
        The mean, m, and its 95 % interval; NaN where the table has none.
    runs
        How many it is the mean of.
    """

    table: str
    estimator: str
    setting: Mapping[str, Any]
    error_m: float
    low_m: float
    high_m: float
    runs: int


@dataclass(frozen=True)
class Candidate:
    """An estimator, and why it cannot run in the asked setting.

    Attributes
    ----------
    option
        Its option, such as `peers/kiss_icp`.
    experiment
        The asked setting with this estimator.
    missing
        What it needs and does not get, in words.
    installed
        Whether its package is there.
    associates
        Whether it finds out itself which landmark is which, since the sensor does not tell.
    """

    option: str
    experiment: Experiment
    missing: Sequence[str] = ()
    installed: bool = True
    associates: bool = False

    @property
    def name(self) -> str:
        """Name without the folder."""
        return self.option.rpartition("/")[2]


class Advice(NamedTuple):
    """What to tell, and the arguments of the sweep `SURE` that settles it; none if nothing fits."""

    text: str
    sweep: list[str]


def recommend(
    overrides: Sequence[str], on_progress: Callable[[float], None] = lambda _: None
) -> Advice:
    """Find which estimators fit, what they did in the nearest judged settings, and what to run.

    Parameters
    ----------
    overrides
        Hydra's, of the robot, its sensors, the world and the prior.
    on_progress
        Called with the share that is done.

    Raises
    ------
    InputError
        If an override is wrong, or names an estimator.
    """
    for key, reason in {
        "estimator": "every one is considered",
        "recording": "say what it was made with, such as sensors=lms291 robot.kr=1e-5; "
        "`estima info LOG` says what a log holds",
    }.items():
        require(
            not any(o.lstrip("+~").startswith(key) for o in overrides),
            f"leave the {key} out: {reason}",
        )
    with open_composer() as composer:
        Experiment(*composer.compose(overrides).resolve()).check()
        everyone = list(_candidates(composer, overrides, on_progress))
        rows = judged(composer)
    on_progress(1.0)
    fits = [each for each in everyone if not each.missing]
    nearest = sorted(_by_table(fits, rows), key=lambda found: found.apart)
    here = [each.option for each in fits if each.installed]
    absent = [each.option for each in fits if not each.installed]
    lines, shown = [f"Fits: {', '.join(here)}." if here else "None fits."], set[str]()
    if absent:
        lines.append(f"Not installed, but would fit: {', '.join(absent)}.")
    if unread := _unread(fits):
        lines.append(f"None of these reads {' or '.join(unread)}.")
    lines.append("")
    if any(each.associates for each in fits):
        lines += [f"Landmarks without ids need {_WITHOUT_IDS}; the errors below are with ids.", ""]
    for found in nearest:
        lines += found.lines(fits, shown)
        shown.update(found.rows)
    if not rows:
        lines += [
            "No tables of results are here (they come with a clone): nothing is measured.",
            "",
        ]
    lines += _needed(each for each in everyone if each.missing)
    return Advice("\n".join(lines), _to_be_sure(overrides, fits, nearest))


def _candidates(
    composer: Composer, overrides: Sequence[str], on_progress: Callable[[float], None]
) -> Iterable[Candidate]:
    options = paths.option_names("estimator")
    for number, option in enumerate(options):
        on_progress(_COMPOSED * number / len(options))
        asked = [*overrides, f"estimator={option}"]
        experiment = Experiment(*composer.compose(asked).resolve())
        if experiment.lacks_program:
            continue
        missing, blind = experiment.missing(), _without_ids(experiment)
        associates = bool(blind) and "association" in experiment.options_of("estimator")
        if blind and not associates:
            missing = [*missing, f"landmarks with ids ({blind}=true)"]
        try:
            if not missing:
                experiment.check()
        except MissingPackageError:
            yield Candidate(option, experiment, installed=False, associates=associates)
        else:
            yield Candidate(option, experiment, missing, associates=associates)


def _without_ids(experiment: Experiment) -> str:
    """Key of a camera that the estimator reads and that does not tell landmarks apart, if any."""
    setting = _setting(experiment)
    keys = (f"sensors.{name}.identifies" for name in experiment.sensors_needed())
    return next((key for key in keys if setting.get(key) is False), "")


# What was measured


def judged(composer: Composer) -> list[Judged]:
    """Rows of the tables that compare many estimators; none in a wheel, which has no tables."""
    return [
        row
        for study, read in (
            ("leaderboard", _of_means),
            ("all_estimators", _of_means),
            ("peers", _of_peers),
        )
        if (path := _table(study)).exists()
        for row in read(study, read_rows(path), composer)
    ]


def _table(study: str) -> Path:
    """Table of a study: of the current folder's results, else of the clone's."""
    name = f"{study}_{'methods' if study == 'peers' else 'means'}.csv"
    here = paths.results() / "tables" / name
    return here if here.exists() else paths.SOURCE / "results" / "tables" / name


def _of_means(study: str, table: pd.DataFrame, composer: Composer) -> Iterable[Judged]:
    compose = _settings_of(study, composer)
    asked = [c for c in table if "." in c and not c.startswith(("estimator.", "choice.est"))]
    for _, row in table.dropna(subset=_ERROR).iterrows():
        given = {column.removeprefix("choice."): row[column] for column in asked}
        setting = compose(tuple((k, v) for k, v in given.items() if not pd.isna(v)))
        own = {c: row[c] for c in table if c.startswith("estimator.") and not pd.isna(row[c])}
        error, low, high = (float(row[f"{_ERROR}{end}"]) for end in ("", "_low", "_high"))
        yield Judged(
            study, row["choice.estimator"], {**setting, **own}, error, low, high, int(row["runs"])
        )


def _of_peers(study: str, table: pd.DataFrame, composer: Composer) -> Iterable[Judged]:
    compose = _settings_of(study, composer)
    worlds = [c.removeprefix("ate_rmse_m_") for c in table if c.startswith("ate_rmse_m_")]
    for _, row in _of_options(table).iterrows():
        for world in worlds:
            error, runs = float(row[f"ate_rmse_m_{world}"]), int(row["runs"]) // len(worlds)
            setting = compose((("study/board", world),))
            yield Judged(study, row["estimator"], setting, error, math.nan, math.nan, runs)


def _of_options(table: pd.DataFrame) -> pd.DataFrame:
    """A row an option of an estimator: of its best answer, with our information if that was run."""
    able = table[table["competes"]]
    order = able.assign(informed=able["arm"] == "informed").sort_values(["answer", "informed"])
    return able.loc[order.drop_duplicates("estimator", keep="last").index]


def _settings_of(
    study: str, composer: Composer
) -> Callable[[tuple[tuple[str, Any], ...]], Setting]:
    """Gives the setting of a study with some keys changed; each is composed once."""

    @cache
    def compose(changed: tuple[tuple[str, Any], ...]) -> Setting:
        overrides = [f"study={study}", *(f"{key}={value}" for key, value in changed)]
        setting = _setting(Experiment(*composer.compose(overrides).resolve()))
        return {key: v for key, v in setting.items() if not key.startswith("estimator.")}

    return compose


def _setting(experiment: Experiment) -> Setting:
    """Keys and values of an experiment; of its world, the option's name."""
    flat = {".".join(map(str, leaf)): value for leaf, value in leaves(experiment.config)}
    return {**flat, "world": experiment.choices["world"]}


def seconds_a_frame() -> dict[str, float]:
    """Median processor time per Frame, s, by estimator, as the study of peers measured it."""
    path = _table("peers")
    if not path.exists():
        return {}
    table = _of_options(read_rows(path))
    return dict(zip(table["estimator"], table["cpu_time_us"] / 1e6, strict=True))


# How far it is


@dataclass(frozen=True)
class Nearest:
    """The nearest rows of one table.

    Attributes
    ----------
    table
        The study's name.
    rows
        By estimator, its rows of the least distance: several where the table's worlds are equally
        far.
    apart
        Median of the estimators' distances.
    changes
        Keys that differ: what was asked, what was judged, and how far they are apart.
    """

    table: str
    rows: Mapping[str, Sequence[Judged]]
    apart: float
    changes: Mapping[str, tuple[Any, set[Any], float]]

    def errors(self) -> list[tuple[float, str]]:
        """Geometric mean of each estimator's errors, m, the least first."""
        return sorted((_mean(r.error_m for r in rows), name) for name, rows in self.rows.items())

    def lines(self, fits: Sequence[Candidate], shown: set[str]) -> list[str]:
        """What the setting differs in, and the best estimators, if a nearer table lacks some."""
        errors = self.errors()
        if shown.issuperset(self.rows):
            return []
        ordered = sorted(self.changes.items(), key=lambda change: -change[1][2])
        said = [
            f"{key} {_shown(asked)} (there {' or '.join(sorted(map(_shown, there)))})"
            for key, (asked, there, _) in ordered[:_MOST_CHANGES]
        ]
        said += [f"and {len(ordered) - len(said)} more"] * (len(ordered) > len(said))
        away = f"differs in {', '.join(said)}" if said else "the same setting"
        where = "Farther away" if shown else "Nearest judged setting"
        lines = [f"{where}: study={self.table}, distance {self.apart:.2g}; {away}."]
        absent = {each.name for each in fits if not each.installed}
        times, width = seconds_a_frame(), max(len(name) for _, name in errors[:_MOST_SHOWN])
        for error, name in errors[:_MOST_SHOWN]:
            rows = self.rows[name]
            low, high = min(r.low_m for r in rows), max(r.high_m for r in rows)
            words = [f"  {name:{width}}  position RMSE {_mm(error)} mm"]
            words[0] += "" if math.isnan(low) else f" [{_mm(low)}, {_mm(high)}]"
            words += [f"in {sum(r.runs for r in rows)} runs"]
            words += [f"{significant(times[name] * 1e3, 2)} ms per Frame"] if name in times else []
            lines.append(", ".join(words) + "  (not installed)" * (name in absent))
        more = len(errors) - _MOST_SHOWN
        return [*lines, *([f"  and {more} with larger errors"] if more > 0 else []), ""]


def _by_table(fits: Sequence[Candidate], rows: Sequence[Judged]) -> Iterable[Nearest]:
    """The nearest rows of each table that has any."""
    for table in dict.fromkeys(row.table for row in rows):
        nearest, distances = {}, []
        changes: dict[str, tuple[Any, set[Any], float]] = {}
        for each in fits:
            own = [row for row in rows if row.table == table and row.estimator == each.name]
            if not own:
                continue
            asked, keys = _setting(each.experiment), _compared(each)
            apart = [_changes(asked, row, keys) for row in own]
            far = [round(sum(change.values()), 9) for change in apart]
            least = min(far)
            at = [place for place, distance in enumerate(far) if distance == least]
            nearest[each.name] = [own[place] for place in at]
            distances.append(least)
            for place in at:
                for key, distance in apart[place].items():
                    there = changes.setdefault(key, (asked.get(key), set(), distance))[1]
                    there.add(own[place].setting.get(key))
        if nearest:
            yield Nearest(table, nearest, float(pd.Series(distances).median()), changes)


def _compared(candidate: Candidate) -> list[str]:
    """Keys that decide how far a setting is: slip, route, and the sensors that are needed."""
    needed = tuple(f"sensors.{name}." for name in candidate.experiment.sensors_needed())
    own = [key for key in _setting(candidate.experiment) if needed and key.startswith(needed)]
    return [*_ALWAYS, *(key for key in own if ".mount." not in key)]


def _changes(asked: Setting, row: Judged, keys: Iterable[str]) -> dict[str, float]:
    """Keys in which a row's setting differs, and how far: in decades, or 1."""
    swept = [key for key in row.setting if key.startswith("estimator.")]
    pairs = {  # 0 is none of it
        key: (asked.get(key) or None, row.setting.get(key) or None) for key in [*keys, *swept]
    }
    return {key: _apart(*pair) for key, pair in pairs.items() if pair[0] != pair[1]}


def _apart(asked: Any, there: Any) -> float:
    numbers = all(isinstance(v, (int, float)) and v > 0 for v in (asked, there))
    return abs(math.log10(asked / there)) if numbers else 1.0


# Words


def _needed(others: Iterable[Candidate]) -> list[str]:
    """What the other estimators lack."""
    lack: dict[str, list[str]] = {}
    for each in others:
        lack.setdefault(" and ".join(each.missing), []).append(each.name)
    return [f"Needs {words}: {', '.join(names)}." for words, names in lack.items()]


def _unread(fits: Sequence[Candidate]) -> list[str]:
    """Sensors, beside the wheels, that no estimator reads."""
    read = {name for each in fits for name in each.experiment.sensors_needed()}
    read |= {str(v) for each in fits for v in each.experiment.options_of("estimator").values()}
    settings = (_setting(each.experiment) for each in fits[:1])  # all have the same sensors
    there = {key.split(".")[1] for flat in settings for key in flat if key.startswith("sensors.")}
    return sorted(there - read - {"encoder"})


def _to_be_sure(
    overrides: Sequence[str], fits: Sequence[Candidate], nearest: Sequence[Nearest]
) -> list[str]:
    """Arguments of a sweep of the best, on seeds that none was tuned on; none if nothing fits."""
    associating = any(each.associates for each in fits)
    able = [each for each in fits if each.installed and each.associates >= associating]
    options = {each.name: each.option for each in able}
    ranked = [name for found in nearest for _, name in found.errors() if name in options]
    best: dict[str, str] = {}  # of a method and its tuned variant
    for name in [*ranked, *options]:
        best.setdefault(name.removesuffix(_TUNED), options[name])
    tried = [*best.values()][:_MOST_TRIED]
    if not tried:
        return []
    exact = any(override.startswith("simulation.") for override in overrides)
    words = [*overrides, *([] if exact else ["simulation.rays=exact"])]
    words += [_WITHOUT_IDS] * associating
    words += [f"estimator={','.join(tried)}", "seed=range(1000,1010)", f"name={SURE}"]
    return words


def _mean(errors: Iterable[float]) -> float:
    """Geometric mean."""
    logs = [math.log(error) for error in errors]
    return math.exp(sum(logs) / len(logs))


def _mm(length_m: float) -> str:
    return significant(length_m * 1e3, 2)


def _shown(value: Any) -> str:
    words = "null" if value is None else str(value).rpartition(".")[2]
    return f"{value:.4g}" if isinstance(value, float) else words
