"""Sweeps that run until they are decided: seeds in blocks, without the arms that have lost.

Arms are runs over one recording, such as those of several estimators; each has many seeds. Runs
over other recordings, such as those of another robot, are decided apart. The looks, and the error
over all of them, are those of `experiments.evaluation.sequential`. Arms and recordings share the
error equally (Bonferroni): at 95 % the best arm is not left out, and the one named is at most the
margin worse. Decisions follow from the rows alone, so a sweep that was killed comes to the same.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.sequential import SPENT, plan_looks, repeated_interval
from experiments.evaluation.statistics import Interval
from experiments.runs.columns import COLUMNS, Average, average_of
from experiments.runs.console import show, warn
from experiments.runs.paths import short
from experiments.runs.row import Outcome
from experiments.runs.store import read_runs
from experiments.sweeps.averages import pool_repeats
from experiments.sweeps.collect import (
    DRAWN,
    describe_arm,
    distinguishing_settings,
    no_column,
    with_answers,
)
from experiments.sweeps.plan import Numbers, Plan
from experiments.sweeps.summary import ERROR
from sim.errors import InputError, require
from sim.files import write_text

DECIDED = "decided.json"  # beside the rows: every comparison at every look
FIRST_LOOK = 12  # seeds
MARGIN = 0.1  # a ratio of 1.1 counts as equal
Measure = Callable[[Any], Interval]  # the interval of paired logs at a look
_WORDS = ("until=", "margin=", "against=")


class Found(StrEnum):
    """What a comparison with another arm has come to."""

    LOST = "lost"
    BETTER = "better"
    EQUAL = "equal"  # within the margin
    OPEN = "open"
    FAILED = "failed"  # some of its runs failed, so that it is not compared


@dataclass(frozen=True)
class Comparison:
    """One arm over another after so many seeds.

    Attributes
    ----------
    over_recordings
        What distinguishes their recordings, in words; empty if all arms share them.
    value, low, high
        Ratio of the metric with the interval over all looks.
    """

    seeds: int
    over_recordings: str
    arm: str
    against: str
    value: float
    low: float
    high: float
    found: Found

    def __str__(self) -> str:
        words = {
            Found.LOST: "loses to",
            Found.BETTER: "is better than",
            Found.EQUAL: "equals",
            Found.OPEN: "is undecided against",
        }
        where = f"{self.over_recordings}: " if self.over_recordings else ""
        if self.found is Found.FAILED:
            return f"{where}{self.arm} is left out, runs of it failed"
        ratio = f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"
        return f"{where}{self.arm} {words[self.found]} {self.against} ({ratio})"


@dataclass(frozen=True)
class Until:
    """What a sweep is to decide.

    Attributes
    ----------
    metric
        Column by which arms are compared.
    margin
        A ratio less one up to which arms count as equal.
    against
        Estimators that each of the others is compared with; by default the best is looked for.
    """

    metric: str = ERROR
    margin: float = MARGIN
    against: tuple[str, ...] = ()

    @classmethod
    def of(cls, arguments: Sequence[str]) -> tuple[Until | None, list[str]]:
        """Read `until=decided[:METRIC]`, `margin=` and `against=`; return the other arguments.

        Raises
        ------
        InputError
            If one of them is wrong, or stands without `until`.
        """
        own = [a for a in arguments if a.startswith(_WORDS)]
        rest = [a for a in arguments if a not in own]
        given = dict(argument.split("=", 1) for argument in own)
        if "until" not in given:
            require(not own, f"{' '.join(own)}: goes with until=decided")
            return None, rest
        word, colon, metric = given["until"].partition(":")
        require(
            word == "decided" and (metric or not colon),
            f"until={given['until']}: give until=decided, or until=decided:METRIC",
        )
        metric = metric or ERROR
        known = [n for n, c in COLUMNS.items() if c.better and c.average is not Average.PLAIN]
        if metric not in known:
            near = [name for name in known if metric.lower() in name]
            near += get_close_matches(metric, known, n=3, cutoff=0.3)
            raise InputError(
                f"until=decided:{metric}: not an error or time of the rows; nearest: "
                f"{', '.join(list(dict.fromkeys(near))[:3]) or ERROR}"
            )
        try:
            margin = float(given.get("margin", MARGIN))
        except ValueError:
            margin = math.nan
        require(0.0 < margin < math.inf, f"margin={given.get('margin')}: give a share, such as 0.1")
        return cls(metric, margin, tuple(filter(None, given.get("against", "").split(",")))), rest

    def blocks(self, plan: Plan, folder: Path) -> Iterator[Numbers]:
        """Give the runs of one block after the other; their rows decide whether another follows.

        Raises
        ------
        InputError
            If the seed is not swept, or fewer than two arms share a recording.
        """
        runs = _Runs.of(plan)
        arms = pd.Series(runs.arm).groupby(runs.recording).nunique()
        require(
            int(arms.max()) > 1,
            "until=decided: compares runs over one recording; sweep several estimators, or their "
            "settings",
        )
        known = sorted({family.first.estimator_name for family in plan.families})
        missing = ", ".join(sorted({*self.against} - {*known}))
        require(not missing, f"against={missing}: the sweep has {', '.join(known)}")
        looks = plan_looks(runs.n_seeds, FIRST_LOOK)
        spent = SPENT / float((arms - 1).sum() * max(len(self.against), 1))
        interval = functools.partial(repeated_interval, looks=looks, spent=spent)
        total, made, at = len(np.unique(plan.keys)), 0, 0
        alive, settled, history = {*runs.arm.tolist()}, set[tuple[int, int]](), list[Comparison]()
        for look in looks:
            block = (runs.place >= at) & (runs.place < look) & np.isin(runs.arm, [*alive])
            some = np.flatnonzero(block)
            yield some
            made, at = made + len(np.unique(plan.keys[some])), look
            table = _Table.of(folder, plan, runs, look, self.metric)
            found, alive = self._decide(table, alive, settled, interval)
            history += [replace(each, seeds=look) for each in found]
            warn(f"{look} of {looks[-1]} seeds: {'; '.join(map(str, found))}")
            _write(folder, self, history, (made, total), looks)
            if not alive:
                break
        lines = [] if self.against else _best(history)
        state = "not decided" if alive else "decided"
        share = 100.0 * (1.0 - made / total)
        lines += [
            f"{state} after {at} of {looks[-1]} seeds; {total - made} of the {total} runs of all "
            f"seeds saved ({share:.0f} %)"
        ]
        show("\n".join(lines))

    def _decide(
        self, table: _Table, alive: set[int], settled: set[tuple[int, int]], interval: Measure
    ) -> tuple[list[Comparison], set[int]]:
        """Compare the arms that are left, over each recording; return which go on.

        `settled` holds, and takes, the pairs that are decided against a named estimator.
        """
        comparisons: list[Comparison] = []
        going: set[int] = set()
        for where, arms in table.arms.items():
            here = [arm for arm in arms if arm in alive]
            sound = [arm for arm in here if arm not in table.failed]
            comparisons += [
                Comparison(
                    0, where, table.names[arm], "", math.nan, math.nan, math.nan, Found.FAILED
                )
                for arm in here
                if arm not in sound
            ]
            rivals = [arm for arm in sound if table.estimators[arm] in self.against]
            if sound and not self.against:
                rivals = [table.best(sound, self.metric)]
            found = {
                (arm, rival): self._compare(table, arm, rival, where, interval)
                for rival in rivals
                for arm in sound
                if arm not in rivals and (arm, rival) not in settled
            }
            comparisons += found.values()
            undecided = {pair for pair, one in found.items() if one.found is Found.OPEN}
            if self.against:
                settled |= {*found} - undecided
                going |= {arm for pair in undecided for arm in pair}
            elif undecided:
                going |= {*sound} - {a for (a, _), one in found.items() if one.found is Found.LOST}
        return comparisons, going

    def _compare(
        self, table: _Table, arm: int, rival: int, where: str, interval: Measure
    ) -> Comparison:
        """Compare two arms over their common seeds."""
        pairs = table.logs[[arm, rival]].dropna()
        found = interval((pairs[arm] - pairs[rival]).to_numpy())
        sign = 1.0 if COLUMNS[self.metric].better == "lower" else -1.0
        bounds = sorted((sign * found.low, sign * found.high))
        outcome, near = Found.OPEN, math.log1p(self.margin)
        if bounds[0] > 0.0:
            outcome = Found.LOST
        elif bounds[1] < 0.0:
            outcome = Found.BETTER
        elif -near < bounds[0] and bounds[1] < near:
            outcome = Found.EQUAL
        value, low, high = (math.exp(v) for v in (found.value, found.low, found.high))
        names = table.names[arm], table.names[rival]
        return Comparison(0, where, *names, value, low, high, outcome)


@dataclass(frozen=True)
class _Runs:
    """Of each run of a plan: the place of its seed, its arm, and its recording but for the seed."""

    place: Numbers
    arm: Numbers
    recording: Numbers
    n_seeds: int

    @classmethod
    def of(cls, plan: Plan) -> _Runs:
        seeds: dict[Any, int] = {}
        place, rest = np.empty_like(plan.number), np.empty_like(plan.number)
        for f, family in enumerate(plan.families):
            mine = plan.family == f
            axis = next((i for i, a in enumerate(family.axes) if a.leaves[0] == ("seed",)), None)
            if axis is None:
                raise InputError(
                    "until=decided: adds seeds, and the seed is not swept; give the most that it "
                    "may run, such as seed='range(1000,1200)'"
                )
            values = family.axes[axis].values
            for value in values:
                seeds.setdefault(value, len(seeds))
            at = list(np.unravel_index(plan.number[mine], family.shape))
            place[mine] = np.array([seeds[value] for value in values])[at[axis]]
            at[axis] = np.zeros_like(at[axis])
            rest[mine] = np.ravel_multi_index(at, family.shape)
        arm = np.unique(np.stack([plan.family, rest]), axis=1, return_inverse=True)[1]
        first = place == 0
        by_arm = dict(zip(arm[first].tolist(), plan.recordings[first].tolist(), strict=True))
        require(
            len(by_arm) == arm.max() + 1,
            "until=decided: its parts begin with other seeds; give all of them the same one",
        )
        recording = np.unique([by_arm[a] for a in arm.tolist()], return_inverse=True)[1]
        return cls(place, arm, recording, len(seeds))


@dataclass(frozen=True)
class _Table:
    """Rows up to a look.

    Attributes
    ----------
    logs
        Log of the metric by the seed's place, a column an arm.
    arms
        Arms by what distinguishes their recordings, in words.
    names, estimators
        Of each arm: what distinguishes it from others over its recordings, and its estimator.
    failed
        Arms some of whose runs failed.
    """

    logs: pd.DataFrame
    arms: Mapping[str, Sequence[int]]
    names: Mapping[int, str]
    estimators: Mapping[int, str]
    failed: set[int]

    @classmethod
    def of(cls, folder: Path, plan: Plan, runs: _Runs, look: int, metric: str) -> _Table:
        """Read those rows that belong to the first seeds."""
        wanted = np.flatnonzero(runs.place < look)
        of_key = dict(zip(plan.keys[wanted].tolist(), wanted.tolist(), strict=True))
        table = with_answers(read_runs(folder).copy(), [metric])
        run = table["run_key"].map(lambda key: of_key.get(int(key, 16), -1))
        table = table.assign(_run=run)[run >= 0]
        place = table["_run"].to_numpy()
        table = table.assign(
            _arm=runs.arm[place], _place=runs.place[place], _recording=runs.recording[place]
        ).sort_values(["_arm", "_place"], kind="stable")
        failed = table["status"] == Outcome.FAILED
        if metric not in table or not pd.api.types.is_numeric_dtype(table[metric]):
            raise no_column(table, metric, metric=True)
        sound = table[~failed & (table[metric] > 0.0)]
        values = pool_repeats(sound, ["_arm", "_place"], metric)
        firsts = table.drop_duplicates("_arm").set_index("_arm")
        names: dict[int, str] = {}
        arms: dict[str, list[int]] = {}
        settings = distinguishing_settings(table.drop(columns=[*DRAWN], errors="ignore"))
        shared = [s for s in settings if (firsts.groupby("_recording")[s].nunique() < 2).all()]
        for _, rows in firsts.groupby("_recording"):
            where = describe_arm(rows.iloc[0], shared)
            arms.setdefault(where, []).extend(rows.index.tolist())
            own = distinguishing_settings(rows.drop(columns=[*DRAWN, *shared], errors="ignore"))
            names |= {arm: describe_arm(row, own) for arm, row in rows.iterrows()}
        return cls(
            np.log(values).unstack("_arm").sort_index(),
            arms,
            names,
            firsts["choice.estimator"].to_dict(),
            {*table.loc[failed, "_arm"].tolist()},
        )

    def best(self, arms: Sequence[int], metric: str) -> int:
        """Arm with the best mean over the seeds that all have."""
        means = self.logs[list(arms)].dropna().mean()
        return int(means.idxmin() if COLUMNS[metric].better == "lower" else means.idxmax())


def _best(history: Sequence[Comparison]) -> list[str]:
    """Say which arm is the best over each recording, and which are as good."""
    lines = []
    for where in dict.fromkeys(each.over_recordings for each in history):
        here = [c for c in history if c.over_recordings == where and c.found is not Found.FAILED]
        last = [c for c in here if c.seeds == here[-1].seeds]
        if not last:
            continue
        as_good, unknown = (
            ", ".join(c.arm for c in last if c.found is kind) for kind in (Found.EQUAL, Found.OPEN)
        )
        words = f"{where}: " * bool(where) + f"{last[-1].against} is the best"
        words += f"; as good within the margin: {as_good}" * bool(as_good)
        lines.append(words + f"; undecided: {unknown}" * bool(unknown))
    return lines


def _write(
    folder: Path,
    until: Until,
    history: Sequence[Comparison],
    runs: tuple[int, int],
    looks: Sequence[int],
) -> None:
    """Write all comparisons; `runs` are those made, and those of all seeds."""
    rows = pd.DataFrame(map(asdict, history)).replace(np.nan, None).to_dict("records")
    found = {"metric": until.metric, "margin": until.margin, "looks": [*looks],
             "made": runs[0], "total": runs[1], "comparisons": rows}  # fmt: skip
    write_text(folder / DECIDED, json.dumps(found, indent=1) + "\n")


def _comparison(row: Mapping[str, Any]) -> Comparison:
    known: dict[str, Any] = {key: math.nan if v is None else v for key, v in row.items()}
    return Comparison(**known | {"found": Found(row["found"])})


def read_decided(folder: Path) -> dict[str, Any] | None:
    """Read the comparisons of a sweep that ran until it was decided; None if it did not.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    path = folder / DECIDED
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        rows = [_comparison(row) for row in found["comparisons"]]
        sound = {"metric", "margin", "looks", "made", "total"} <= set(found) and average_of(
            found["metric"]
        ) is not Average.PLAIN
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{short(path)}: damaged ({error}); delete it") from error
    require(sound, f"{short(path)}: damaged; delete it")
    return {**found, "comparisons": rows}
