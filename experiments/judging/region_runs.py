"""The runs over the regions of a study's claims, and what they say of each claim.

A study's `region_run(name, values, seed, profile)` drives all arms at free settings in one world
and returns their levels, which are columns of the table `region_NAME`. Claims with the same
settings share it (`like` in the design).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.judging.claim import Claim, waiting
from experiments.judging.folders import findings
from experiments.judging.free_settings import FreeSettings, free_settings, sample
from experiments.judging.jobs import Tables
from experiments.judging.region import Fitted, Region, Side, describe, fit
from experiments.judging.region_figure import draw_region
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import Profile, Results, first_seed
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.errors import require

Run = Callable[[str, Mapping[str, Any], int, Profile], Row]
Job = tuple[Callable[..., Tables], Run, str, int, Mapping[str, Any], int, Profile]
N_QUICK = 16, 2  # points of the quick profile, and worlds at each
_APART = {Profile.FULL: 1000, Profile.QUICK: 0}  # from the seeds of the worlds at the anchor
_LEAST_POINTS = 8


@dataclass(frozen=True)
class Compared:
    """A headline over the region: the ratio of two columns, and the claim's side of it.

    Attributes
    ----------
    first, second
        Columns; without a second, the first is the ratio itself.
    words
        The ratio in words.
    at_least, at_most
        The criterion, as a ratio.
    printed
        The paper's own ratio, if it prints one.
    place
        Its data set, where the claim's settings belong to one of several.
    """

    first: str
    second: str
    words: str
    at_least: float = 0.0
    at_most: float = math.inf
    printed: float | None = None
    place: str = ""

    def logs(self, table: pd.DataFrame) -> Array:
        """Log ratio of each row; not finite where a run failed."""
        below = table[self.second] if self.second else 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log((table[self.first] / below).to_numpy(float)))

    def side(self, effect: float) -> Side:
        """The claim's side, by the smallest effect of interest."""
        low = math.log(self.at_least) if self.at_least else -math.inf
        return Side(low, math.log(self.at_most), effect)


Headlines = Mapping[str, Sequence[Compared]]  # by the claim's id


def region_jobs(study: str, run: Run, profile: Profile, only: str | None = None) -> list[Job]:
    """The calls that make the tables of a study's regions, or only one's, for `operator.call`."""
    jobs: list[Job] = []
    for name, free in free_settings(study).items():
        if free.runs != name or only not in (None, name):
            continue
        first = first_seed(study, name, profile) + _APART[profile]
        n_points, n_worlds = sizes(free, profile)
        drawn = sample(free.settings, n_points, rng=stream(0, f"region/{study}/{name}"))
        points = [{str(k): v for k, v in row.items()} for row in drawn.to_dict("records")]
        jobs += [
            (_region_row, run, name, point, values, first + n_points * world + point, profile)
            for world in range(n_worlds)  # further ones leave the seeds of these as they are
            for point, values in enumerate(points)
        ]
    return jobs


def sizes(free: FreeSettings, profile: Profile) -> tuple[int, int]:
    """Points of a claim's region, and worlds at each."""
    return (free.n_points, free.n_worlds) if profile is Profile.FULL else N_QUICK


def _region_row(
    run: Run, name: str, point: int, values: Mapping[str, Any], seed: int, profile: Profile
) -> Tables:
    row = {"point": point, "seed": seed, **values, **run(name, values, seed, profile)}
    return {f"region_{name}": [row]}


def remake_region(study: str, run: Run, table: str, row: Cells) -> Remake:
    """The call that makes a row of a region's table again."""
    name = table.removeprefix("region_")
    values = {each.name: row[each.name] for each in free_settings(study)[name].settings}
    return _region_row, (run, name, int(row["point"]), values, int(row["seed"]), Profile.FULL)


def is_there(results: Results, claim: str) -> bool:
    """Whether a claim has no region, or the runs over it are there."""
    free = free_settings(results.paper).get(claim)
    return free is None or results.optional_table(f"region_{free.runs}") is not None


def judge_tables(
    results: Results,
    claims: Mapping[
        str, tuple[Callable[..., Claim | Iterable[Claim]], Mapping[str, Sequence[str]]]
    ],
) -> list[Claim]:
    """Judge each claim by its tables; one whose tables are older than its definition waits.

    Parameters
    ----------
    claims
        By id: what judges it, and the tables that it is given, with the columns that older ones
        lack. A table that has such columns may be missing as a whole.
    """
    found: list[Claim] = []
    for claim, (judge, tables) in claims.items():
        given = [
            results.optional_table(name) if columns else results.table(name)
            for name, columns in tables.items()
        ]
        is_old = any(
            table is None or not set(columns) <= set(table)
            for table, columns in zip(given, tables.values(), strict=True)
        )
        if is_old or not is_there(results, claim):
            found.append(waiting(claim))
            continue
        made = judge(*given)
        found += [made] if isinstance(made, Claim) else list(made)
    return found


def fitted_regions(
    results: Results, headlines: Headlines
) -> Iterator[tuple[str, FreeSettings, pd.DataFrame, Fitted]]:
    """Give each claim's id, free settings, sampled points, and surfaces, as far as runs are there.

    Points at which a run failed are left out.
    """
    for claim, free in free_settings(results.paper).items():
        table = results.optional_table(f"region_{free.runs}")
        if table is None:
            continue
        table = table.sort_values(["point", "seed"])
        every = np.stack([each.logs(table) for each in headlines[claim]])
        is_whole = pd.Series(np.isfinite(every).all(axis=0), table.index)
        kept = is_whole.groupby(table["point"]).transform("all").to_numpy()
        points = table[kept].groupby("point", as_index=False).first()
        words = f"region of {claim}: runs failed at all but {len(points)} points"
        require(len(points) >= _LEAST_POINTS, words)
        arms = [
            (logs[kept].reshape(len(points), -1), each.side(free.effect))
            for logs, each in zip(every, headlines[claim], strict=True)
        ]
        fitted = fit(free.settings, points, arms, stream(0, f"region/{claim}"))
        yield (
            claim,
            free,
            *set_apart(free, points, fitted, [each.place for each in headlines[claim]]),
        )


def set_apart(
    free: FreeSettings, points: pd.DataFrame, fitted: Fitted, places: Sequence[str]
) -> tuple[pd.DataFrame, Fitted]:
    """The same with settings of each data set's own, if there are several; they were run alike."""
    if not free.places:
        return points, fitted
    n, apart = len(free.settings), free.settings_apart
    columns = tuple(slice(k * n, (k + 1) * n) for k in map(free.places.index, places))
    values = {each.name: points[free.settings[i % n].name] for i, each in enumerate(apart)}
    return pd.DataFrame(values), replace(fitted, settings=apart, columns=columns)


def judged_regions(results: Results, headlines: Headlines) -> dict[str, Region]:
    """What each claim's region says of it, as far as the runs are there."""
    return {
        claim: describe(fitted, free.anchor, [each.words for each in headlines[claim]])
        for claim, free, _, fitted in fitted_regions(results, headlines)
    }


def region_pages(results: Results, headlines: Headlines) -> dict[str, Figure]:
    """A figure of each claim's region, as far as the runs are there."""
    says = findings(results.paper)["claims"]
    return {
        f"{results.paper}_region_{claim}": draw_region(
            fitted, points, free.drawn_anchor, title=f"{claim}: {says[claim]}",
            quantities=[each.words for each in headlines[claim]],
            printed=[each.printed for each in headlines[claim]],
        )
        for claim, free, points, fitted in fitted_regions(results, headlines)
    }  # fmt: skip
