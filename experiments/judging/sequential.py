"""Claims that stop as soon as they are decided: their designs, their judgement, and the blocks.

A design stands in the study's design.yaml before its judged run: the smallest effect of interest,
the spread that it was planned from, and the looks, of which the last is the most recordings. At
every look the claim is decided, or shown to be within its margin, or goes on; at the last it is
capped, and states the power that it had. `experiments.evaluation.sequential` holds the error over
all looks.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from experiments.evaluation.sequential import SPENT, look_errors, power_at, repeated_interval
from experiments.evaluation.statistics import Interval, log_ratios
from experiments.judging import folders
from experiments.judging.claim import (
    EQUIVALENCE,
    SMALLEST_EFFECT,
    Claim,
    Role,
    Subject,
    Verdict,
    effect_in_words,
    judge_interval,
    judge_one_side,
    power_of,
)
from experiments.judging.results import Profile, first_seed
from sim.errors import InputError, require

T = TypeVar("T")
N_QUICK = 3  # worlds of the quick profile


@dataclass(frozen=True)
class Design:
    """How a claim on a ratio is judged as recordings are added.

    Attributes
    ----------
    spread
        Standard deviation of the paired log ratios, from other seeds than the judged ones.
    looks
        Recordings at each look; the last is the cap.
    effect
        Smallest effect of interest, a ratio less one; of an equivalence, its margin.
    """

    spread: float
    looks: tuple[int, ...]
    effect: float = SMALLEST_EFFECT

    @property
    def power(self) -> float:
        """Power with which the smallest effect is decided at the cap, if the spread is right."""
        error = look_errors(self.looks)[-1]
        return power_at(self.looks[-1], error, math.log1p(self.effect), self.spread)


def designs(study: str) -> dict[str, Design]:
    """Return the sequential designs of a study's claims, by their ids, from its design.yaml.

    Raises
    ------
    InputError
        If one lacks a number, or its looks do not increase.
    """
    found = {}
    for name, given in folders.design(study).get("designs", {}).items():
        where = f"{study}/design.yaml: designs.{name}"
        try:
            design = Design(float(given["spread"]), tuple(given["looks"]), float(given["effect"]))
            look_errors(design.looks)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{where}: needs spread, looks and effect ({error})") from error
        require(min(design.spread, design.effect) > 0.0, f"{where}: spread and effect must be > 0")
        found[name] = design
    return found


def judge_ratio(
    about: Subject,
    statistic: str,
    arms: tuple[ArrayLike, ArrayLike],
    design: Design,
    at_least: float = -math.inf,
    at_most: float = math.inf,
) -> Claim:
    """Judge the geometric mean of paired ratios at the look that their number has reached.

    With both limits, equivalence is shown or not. With one, the ratio lies on one side of it, or is
    shown to be within the smallest effect of interest of it; then the claim does not
    hold. The facts are `n`, `look`, `cap` and `is_open`, whether it goes on.

    Parameters
    ----------
    arms
        Positive values (N,) of both arms, a pair a recording, in the order of the recordings.
    at_least, at_most
        Criterion for the first arm over the second.
    """
    logs, band = log_ratios(*arms), (at_least, at_most)
    limits = [end for end in band if math.isfinite(end)]
    spent = SPENT * len(limits)  # equivalence is two tests, each of which may err so often
    found = repeated_interval(logs, design.looks, spent)
    found = Interval(*(math.exp(v) for v in (found.value, found.low, found.high)))
    verdict, reason = judge_interval(found, *band), ""
    if len(limits) == 1:
        near = limits[0] / (1.0 + design.effect), limits[0] * (1.0 + design.effect)
        verdict, is_near = judge_one_side(found, *band, near)
        smallest = f"{100.0 * design.effect:.3g} %, its smallest effect of interest"
        reason = f"within {smallest}" if is_near else ""
    look, cap = int(np.searchsorted(design.looks, len(logs), side="right")), design.looks[-1]
    is_open = verdict is Verdict.UNDECIDED and len(logs) < cap
    words = " and ".join(
        [f"at least {at_least:.3g}"] * (at_least > -math.inf)
        + [f"at most {at_most:.3g}"] * (at_most < math.inf)
    )
    power = power_of(found, design.effect, band, level=1.0 - _error(design, look, spent))
    seen = EQUIVALENCE if len(limits) == 2 else effect_in_words(design.effect)
    facts = {"n": min(len(logs), cap), "look": look, "cap": cap, "is_open": is_open}
    criterion = f"{words}, {len(design.looks)} looks"
    return Claim(
        about, statistic, found, criterion, verdict, reason, effect=seen, power=power, facts=facts
    )


def _error(design: Design, look: int, spent: float) -> float:
    return look_errors(design.looks, spent)[max(look, 1) - 1]


def run_until_decided(
    looks: Sequence[int],
    run_to: Callable[[int], T],
    judge: Callable[[T], Sequence[Claim]],
) -> tuple[T, list[Claim]]:
    """Run a study in blocks until its headline claims are decided, or the most recordings are in.

    Parameters
    ----------
    looks
        Recordings after each block, such as a Design's.
    run_to
        Adds the recordings up to so many, and returns all results so far.
    judge
        Judges the claims by them.
    """
    for n in looks:
        results = run_to(n)
        claims = list(judge(results))
        if not any(c.role is Role.HEADLINE and c.facts.get("is_open") for c in claims):
            break
    return results, claims


def run_worlds(
    study: str,
    claims: Sequence[str],
    profile: Profile,
    rows_of: Callable[[Sequence[int]], Mapping[str, pd.DataFrame]],
    judge: Callable[[Mapping[str, pd.DataFrame]], Sequence[Claim]],
    on_progress: Callable[[float], None] = lambda _: None,
) -> dict[str, pd.DataFrame]:
    """Run the worlds of claims that share tables until all are decided by their designs.

    Each claim is judged at its own looks. The quick profile has a few worlds of tuning seeds.

    Parameters
    ----------
    rows_of
        Gives the tables of the worlds with these seeds.
    on_progress
        Called after each look with its share of the most worlds that may be run.
    """
    given = [each for name, each in designs(study).items() if name in claims]
    looks = sorted({n for each in given for n in each.looks})
    looks = looks if profile is Profile.FULL else [N_QUICK]
    first, tables, done = first_seed(study, claims[0], profile), dict[str, pd.DataFrame](), 0

    def run_to(n: int) -> Mapping[str, pd.DataFrame]:
        nonlocal done
        for name, new in rows_of(range(first + done, first + n)).items():
            both = [tables[name], new] if name in tables else [new]
            tables[name] = pd.concat(both, ignore_index=True)
        done = n
        on_progress(done / looks[-1])
        return tables

    run_until_decided(looks, run_to, judge)
    return tables
