"""Who won a sweep, by how much, and by which test: the answer that its page opens with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import holm, log_ratio_interval
from experiments.runs.console import pluralize
from experiments.runs.row import GAP, Outcome
from experiments.sweeps.averages import MIN_UNITS, RECORDING, difference_p, pool_repeats
from experiments.sweeps.collect import DRAWN, describe_arm, distinguishing_settings, with_answers
from experiments.sweeps.summary import ERROR

_LEVEL = 0.05  # of all tests together
_ARM, _BETWEEN, _ESTIMATOR = "arm", ", ", "choice.estimator"


@dataclass(frozen=True)
class Rival:
    """An arm beside the winner, over their common recordings.

    Attributes
    ----------
    ratio, low, high
        Its error over the winner's, a geometric mean, with its 95 % interval.
    differs
        Whether it is worse by the paired test, Holm's over all pairs of arms.
    """

    name: str
    ratio: float
    low: float
    high: float
    differs: bool

    def __str__(self) -> str:
        interval = f" [{self.low:.3g}, {self.high:.3g}]" if math.isfinite(self.low) else ""
        return f"{self.name} ({self.ratio:.3g}{interval} times as large)"

    @property
    def equal(self) -> bool:
        """Whether the errors are the same on every recording."""
        return self.ratio == 1.0 and not self.low < self.high


@dataclass(frozen=True)
class Winner:
    """The arm with the least error.

    Attributes
    ----------
    name, error_m
        The arm, and the geometric mean of its error over the recordings.
    rivals
        The others, the best first.
    out
        Arms of which runs failed or have gaps; they cannot win.
    """

    name: str
    error_m: float
    n_recordings: int
    rivals: tuple[Rival, ...]
    out: tuple[str, ...]

    def sentences(self) -> list[str]:
        """The answer: the winner, the margin, what is level, and the test."""
        equal = [rival.name for rival in self.rivals if rival.equal]
        level = [str(rival) for rival in self.rivals if not (rival.differs or rival.equal)]
        behind = [str(rival) for rival in self.rivals if rival.differs]
        smallest, tested = f"{self.name} has the smallest error", self.n_recordings >= MIN_UNITS
        if equal and not (level or behind):
            said = [f"{_BETWEEN.join([self.name, *equal])}: the same error, {self.error_m:.3g} m."]
            return [*said, f"Over {pluralize(self.n_recordings, 'recording')}."]
        smallest = f"{smallest} (as {_BETWEEN.join(equal)})" if equal else smallest
        if level and tested:
            said = [
                f"No single winner: {smallest}, {self.error_m:.3g} m, but not significantly "
                f"smaller than that of {_BETWEEN.join(level)}."
            ]
        else:
            said = [f"{smallest}: {self.error_m:.3g} m."]
            said += [f"Behind it, untested: {_BETWEEN.join(level)}."] if level else []
        if behind:
            more = f", and {len(behind) - 1} more" if len(behind) > 1 else ""
            said.append(f"Significantly worse: {behind[0]}{more}.")
        if self.out:
            said.append(f"Left out, since runs failed or have gaps: {_BETWEEN.join(self.out)}.")
        return [*said, self._test()]

    def _test(self) -> str:
        n = pluralize(self.n_recordings, "recording")
        if not self.rivals:
            return f"Over {n}; nothing to compare it with."
        if self.n_recordings < MIN_UNITS:
            return f"Over {n}, too few for a test: more seeds would tell."
        all_pairs = " of all pairs" if len(self.rivals) > 1 else ""
        holm_s = " in all (Holm)" if all_pairs else ""
        return f"Paired t tests of the logs{all_pairs} over {n}, at 5 %{holm_s}."


def find_winner(table: pd.DataFrame) -> Winner | None:
    """Compare the estimators of a sweep; of one estimator, its settings.

    Arms are compared over the recordings that all of them have, by the position error of their
    best answers, averaged over their other settings. None where there is no such recording, or
    nothing was swept.
    """
    table = with_answers(table, [ERROR])
    swept = [name for name in distinguishing_settings(table) if name not in DRAWN]
    arms = [_ESTIMATOR] if _ESTIMATOR in swept else swept
    if not arms or ERROR not in table:
        return None
    table = table.assign(**{_ARM: [describe_arm(row, arms) for _, row in table.iterrows()]})
    whole, out = _whole(table)
    others = [name for name in swept if name not in arms]
    errors = pool_repeats(whole, [_ARM, RECORDING], ERROR, others).unstack(0).dropna()
    if errors.empty or not (errors > 0.0).all(axis=None):
        return None
    means = np.exp(np.log(errors).mean()).sort_values()
    best = str(means.index[0])
    differ = differing_pairs(errors) if len(errors) >= MIN_UNITS else set()
    rivals = [
        _rival(str(name), errors[name], errors[best], {best, str(name)} in differ)
        for name in means.index[1:]
    ]
    return Winner(best, float(means.iloc[0]), len(errors), tuple(rivals), tuple(out))


def differing_pairs(errors: pd.DataFrame) -> set[frozenset[Any]]:
    """Pairs of arms that differ; all are tested, since the best is chosen by the same data."""
    pairs = list(combinations(errors, 2))
    p = [difference_p(errors[first], errors[second], ERROR) for first, second in pairs]
    rejected = holm([1.0 if math.isnan(each) else each for each in p], _LEVEL)
    return {frozenset(pair) for pair, is_one in zip(pairs, rejected, strict=True) if is_one}


def _rival(name: str, theirs: pd.Series[float], best: pd.Series[float], differs: bool) -> Rival:
    found = log_ratio_interval(theirs, best)
    if len(theirs) < MIN_UNITS:
        return Rival(name, found.value, math.nan, math.nan, differs)
    return Rival(name, found.value, found.low, found.high, differs)


def _whole(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Rows of the arms that answered everywhere, and the names of the others."""
    code = table.get("status_code", table["status"])
    short = (table["status"] == Outcome.FAILED) | (code == GAP) | table[ERROR].isna()
    out = sorted(table.loc[short, _ARM].unique())
    return table[~table[_ARM].isin(out)], out
