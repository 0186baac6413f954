"""From a red check to the commit: `estima bisect`.

The paired gate compares the ends of the history. For the error that it calls worse, every commit
in between is then placed on the side of the end that it is nearer to, over the same recordings and
streams. Where chance leaves that open, all three run again with other streams.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
import scipy

from experiments.bench.against import checkout, clone_of, commit_of, git
from experiments.gate.compare import Change, Finding, by_repeat, compare, failed_runs
from experiments.gate.report import sentence
from experiments.gate.revision import rows_in
from experiments.gate.suite import read_suite, suite_path
from experiments.runs.console import show, warn
from sim.errors import InputError, printable, require

SURE = 3.3  # standard errors from the middle; the side is wrong in 1 of 2000 cases
MAX_SEEDINGS = 6
Measure = Callable[[str, Sequence[str], int], pd.DataFrame]  # commit, estimators, seeding: rows


@dataclass(frozen=True)
class Blame:
    """What a search found.

    Attributes
    ----------
    commit
        The first one that is worse.
    skipped
        Those that do not run, between it and the last sound one: it may be one of them too.
    finding
        How the ends of the history compare.
    p_wrong
        Probability that chance has put a commit on the wrong side.
    n_checks
        Commits checked, the ends included.
    """

    commit: str
    skipped: tuple[str, ...]
    finding: Finding
    p_wrong: float
    n_checks: int


def find_commit(commits: Sequence[str], measure: Measure, only: Sequence[str] = ()) -> Blame:
    """Find the commit that made an error worse, among those after the first.

    Parameters
    ----------
    commits
        In their order, from one that is sound to one that is worse.
    measure
        Raises InputError for a commit that does not run.

    Raises
    ------
    InputError
        If nothing is worse at the last than at the first, or one of these does not run.
    """
    ends = commits[0], commits[-1]
    good, bad = (measure(commit, only, 0) for commit in ends)
    alarms = [f for f in compare({"accepted": good}, bad) if f.alarms]
    require(alarms, f"nothing is worse at {ends[1]} than at {ends[0]}")
    finding = min(alarms, key=lambda f: (f.verdict is not Change.FAILED, max(_ps(f))))
    known = {(ends[0], 0): good, (ends[1], 0): bad}

    @cache
    def rows(commit: str, seeding: int) -> pd.DataFrame:
        found = known.get((commit, seeding))
        return measure(commit, [finding.estimator], seeding) if found is None else found

    left, skipped, n_checks, p_wrong = list(commits), set[str](), 2, 0.0
    while len(left) > 2:
        middle = len(left) // 2
        try:
            n_checks += 1
            z = _side(finding, partial(rows, ends[0]), partial(rows, left[middle]),
                      partial(rows, ends[1]))  # fmt: skip
        except InputError as error:
            warn(f"{left[middle][:12]}: skipped, {error}")
            skipped.add(left.pop(middle))
            continue
        p_wrong += float(scipy.stats.norm.sf(abs(z)))
        left = left[: middle + 1] if z > 0.0 else left[middle:]
    between = commits[commits.index(left[0]) + 1 : commits.index(left[1])]
    return Blame(left[1], tuple(c for c in between if c in skipped), finding, p_wrong, n_checks)


def _ps(finding: Finding) -> tuple[float, float]:
    return finding.p_real[0], finding.p_general[0]


def _side(
    finding: Finding,
    good: Callable[[int], pd.DataFrame],
    middle: Callable[[int], pd.DataFrame],
    bad: Callable[[int], pd.DataFrame],
) -> float:
    """Standard errors from halfway between both ends: above zero, a commit is with the bad one."""
    if finding.verdict is Change.FAILED:
        return math.inf if failed_runs(middle(0)).any() else -math.inf
    seen: list[np.ndarray] = []
    z = 0.0
    for seeding in range(MAX_SEEDINGS):
        logs = (
            np.log(by_repeat(_of(finding.estimator, at(seeding)), finding.error)).mean(axis=1)
            for at in (good, middle, bad)
        )
        first, here, last = logs
        seen.append(here - (first + last) / 2.0)
        away = np.mean(seen, axis=0)
        away = away[np.isfinite(away)]
        error = float(away.std(ddof=1)) / math.sqrt(len(away))
        z = float(away.mean()) / error if error > 0.0 else math.copysign(math.inf, away.mean())
        if abs(z) >= SURE:
            break
    return z


def _of(estimator: str, rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows["estimator"] == estimator]


def history(good: str, bad: str, folder: Path | None = None) -> list[str]:
    """Commits from a good one to a bad one, both included, along the first parents."""
    first, last = (commit_of(name, folder) for name in (good, bad))
    commits = [last]
    while commits[0] != first:
        parents = git("cat-file", "-p", commits[0], folder=folder).partition("\n\n")[0]
        before = re.search("^parent (.*)$", parents, re.MULTILINE)
        if before is None:
            raise InputError(f"{good} is not before {bad}")
        commits.insert(0, before[1])
    require(len(commits) > 1, f"{good} is {bad}")
    return commits


def run_bisect(
    good: str, bad: str, suite: str, only: Sequence[str], config_dir: Path | None = None
) -> None:
    """Do what `estima bisect` does.

    Raises
    ------
    InputError
        If the history or the suite cannot be used, or nothing is worse.
    """
    path = suite_path(suite).resolve()
    read_suite(path, config_dir).select(only)
    clone = clone_of(path)
    commits = history(good, bad, clone)

    def measure(commit: str, names: Sequence[str], seeding: int) -> pd.DataFrame:
        show(f"checking {commit[:12]}")
        return rows_in(checkout(commit, clone).folder, path, names, seeding, config_dir)

    show(as_text(find_commit(commits, measure, only), clone))


def as_text(blame: Blame, folder: Path | None = None) -> str:
    """The commit, its message, what it made worse, and on which recordings."""
    lines = [
        printable(line) for line in git("show", "-s", blame.commit, folder=folder).splitlines()
    ]
    lines += ["", sentence(blame.finding)]
    lines += [
        f"seed {seed}: {then:.3g} before, {now:.3g} now"
        for seed, then, now in blame.finding.worst
        if math.isfinite(then)
    ]
    lines += [f"or {commit}, which does not run" for commit in blame.skipped]
    return "\n".join(
        [*lines, f"{blame.n_checks} checks; by chance another commit: p {blame.p_wrong:.1g}"]
    )
