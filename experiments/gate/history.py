"""Errors and step times of a suite's estimators over the commits: `estima history`.

A Parquet file keeps the rows of every commit that was appended. A commit is judged by the paired
gate beside the last one at which the estimator changed, so that steps too small to be seen add up.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.bench.against import checkout, clone_of, commit_of, git
from experiments.evaluation.statistics import log_ratio_interval
from experiments.gate.baseline import baseline_paths
from experiments.gate.compare import WHICH, Change, Finding, by_repeat, check_recordings, compare
from experiments.gate.revision import rows_in
from experiments.gate.speed import MARGIN, step_ratios
from experiments.gate.suite import ERRORS, read_suite, suite_path
from experiments.runs import paths
from experiments.runs.console import show, warn
from experiments.runs.row import read_rows, write_frame
from sim.errors import InputError, require

STEP = "step"  # the metric beside ERRORS: a step's time over that at another revision
NEW = "new recordings"  # the mark where a line begins; the others are verdicts
_TEXTS = ("commit", "subject", "estimator", "checksum", "status", "against")
COLUMNS = ("commit", "committed_s", "depth", "subject", *WHICH, "checksum", "fingerprint", *ERRORS,
           "status", "against", "step_ratio", "step_low", "step_high")  # fmt: skip
_MARKED = (Change.WORSE, Change.BETTER, Change.CHANGED, Change.FAILED)


def history_path(suite: str) -> Path:
    """Where a suite's history lies: of the package's suites in the results, else beside it."""
    path = suite_path(suite)
    if path.resolve().is_relative_to(paths.CONF.resolve()):
        return paths.results() / "baselines" / f"{path.stem}.parquet"
    return baseline_paths(suite)["accepted"].with_name("history.parquet")


def read_history(path: Path) -> pd.DataFrame:
    """Read a history.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    require(path.exists(), f"{path}: no history yet; append a commit")
    rows = read_rows(path, f"restore it, e.g. git checkout -- {path}")
    for name in COLUMNS:
        require(name in rows, f"{path}: damaged (no column {name})")
        is_text = name in _TEXTS
        require(
            is_text == (not pd.api.types.is_numeric_dtype(rows[name])),
            f"{path}: damaged ({name} holds no {'texts' if is_text else 'numbers'})",
        )
    twice = rows.duplicated(["commit", *WHICH])
    require(not twice.any(), f"{path}: damaged (two rows of one run)")
    order = ["committed_s", "depth"]  # commits of one second are told by their ancestors
    return rows.sort_values(order, kind="stable", ignore_index=True)


def append(
    suite: str,
    revisions: Sequence[str],
    path: Path,
    speed: str | None = None,
    config_dir: Path | None = None,
) -> None:
    """Run a suite at revisions and add their rows; one that does not run is left out.

    Parameters
    ----------
    speed
        Revision that steps are timed against, in turn; by default they are not timed.

    Raises
    ------
    InputError
        If the suite, the file or all revisions cannot be used.
    """
    source = suite_path(suite).resolve()
    whole, clone = read_suite(source, config_dir), clone_of(source)
    kept = [read_history(path)] if path.exists() else []
    known = {commit for rows in kept for commit in rows["commit"]}
    failed = []
    old = checkout(speed, clone) if speed is not None else None
    for revision in revisions:
        commit = commit_of(revision, clone)
        if commit in known:
            show(f"{commit[:12]} is there")
            continue
        show(f"running {source.stem} at {commit[:12]}")
        folder = _folder_of(commit, clone)
        try:
            rows = rows_in(folder, source, [], config_dir=config_dir)
        except InputError as error:
            failed.append(commit)
            warn(f"{commit[:12]}: left out, {error}")
            continue
        rows = rows.assign(commit=commit, **_about(commit, clone))
        rows[["against", "step_ratio", "step_low", "step_high"]] = "", np.nan, np.nan, np.nan
        if old is not None:
            runs = whole.made(elsewhere=False)
            for name, ratio in step_ratios(runs, folder, old.folder).items():
                of_one = rows["estimator"] == name
                cells = old.commit, ratio.value, ratio.low, ratio.high
                rows.loc[of_one, ["against", "step_ratio", "step_low", "step_high"]] = cells
        kept.append(rows[list(COLUMNS)].astype(dict.fromkeys(ERRORS, float)))
        write_frame(pd.concat(kept, ignore_index=True), path)
    require(len(failed) < max(1, len(revisions)), f"{source.stem} runs at none of them")


def _about(commit: str, clone: Path | None) -> dict[str, Any]:
    """When a commit was made, how many it follows, and the first line of its message."""
    head, _, message = git("cat-file", "-p", commit, folder=clone).partition("\n\n")
    (committed,) = re.findall(r"^committer .* (\d+) \S+$", head, re.MULTILINE)
    return {
        "committed_s": float(committed),
        "depth": float(len(git("rev-list", commit, folder=clone).splitlines())),
        "subject": message.partition("\n")[0],
    }


def _folder_of(commit: str, clone: Path | None) -> Path:
    """Folder with the code of a commit: the clone itself if it holds just that."""
    place = clone or paths.SOURCE
    if not git("diff", "HEAD", folder=place) and git("rev-parse", "HEAD", folder=place) == commit:
        return place
    return checkout(commit, clone).folder


def trace(rows: pd.DataFrame) -> pd.DataFrame:
    """Points of every line, one a commit, an estimator and a metric (ERRORS and STEP).

    Returns
    -------
    pandas.DataFrame
        `number` of the commit, from 0, `commit`, `committed_s` and `subject`; `estimator`;
        `metric`; `value`, of an error the geometric mean over the recordings, with `low` and
        `high`, those of its paired ratio to the line's first, with 95 %; `mark`, a verdict, NEW, or
        empty; and `change`, a marked verdict's ratio to the last change.
    """
    starts: dict[str, pd.DataFrame] = {}
    changed: dict[str, pd.DataFrame] = {}
    points: list[dict[str, Any]] = []
    groups = rows.groupby("commit", sort=False)
    for number, (commit, now) in enumerate(groups):
        which = {"number": number, "commit": commit, **now.iloc[0][["committed_s", "subject"]]}
        by_name = {str(name): some for name, some in now.groupby("estimator", sort=False)}
        fresh = [name for name, some in by_name.items() if not _follows(name, changed, some)]
        starts |= {name: by_name[name] for name in fresh}
        changed |= {name: by_name[name] for name in fresh}
        old = [name for name in by_name if name not in fresh]
        findings = {(f.estimator, f.error): f for f in _judged(old, changed, by_name)}
        for name, some in by_name.items():
            for metric in ERRORS:
                found = findings.get((name, metric))
                cells = {**_error_of(starts[name], some, metric), **_mark_of(found)}
                points.append({**which, "estimator": name, "metric": metric, **cells})
            verdicts = {findings[name, e].verdict for e in ERRORS if name in old}
            if verdicts & {Change.WORSE, Change.BETTER, Change.CHANGED}:
                changed[name] = some
    every = pd.DataFrame([*points, *_steps(rows)])
    return every.sort_values("number", kind="stable", ignore_index=True)


def _follows(name: str, changed: dict[str, pd.DataFrame], now: pd.DataFrame) -> bool:
    """Whether an estimator ran over the recordings of its last change."""
    try:
        if name in changed:
            check_recordings(name, "last", changed[name], now)
    except InputError:
        return False
    return name in changed


def _judged(
    names: Sequence[str], changed: dict[str, pd.DataFrame], now: dict[str, pd.DataFrame]
) -> list[Finding]:
    if not names:
        return []
    then, after = (pd.concat([side[name] for name in names]) for side in (changed, now))
    return compare({"last": then}, after)


def _error_of(start: pd.DataFrame, now: pd.DataFrame, metric: str) -> dict[str, float]:
    """Geometric mean over the recordings that both have, and its interval by the paired ratio."""
    first, last = (np.log(by_repeat(rows, metric)).mean(axis=1) for rows in (start, now))
    both = np.isfinite(first) & np.isfinite(last)
    if not both.any():
        return {"value": np.nan, "low": np.nan, "high": np.nan}
    level = float(np.exp(first[both].mean()))
    ratio = log_ratio_interval(np.exp(last[both]), np.exp(first[both]))
    return {name: level * getattr(ratio, name) for name in ("value", "low", "high")}


def _mark_of(found: Finding | None) -> dict[str, Any]:
    if found is None:
        return {"mark": NEW, "change": np.nan}
    marked = found.verdict in _MARKED
    return {
        "mark": str(found.verdict) if marked else "",
        "change": found.ratio if marked else np.nan,
    }


def _steps(rows: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Points of the steps' ratios; marked where one leaves the margin around the last mark's."""
    numbers = {commit: number for number, commit in enumerate(rows["commit"].unique())}
    timed = rows[rows["step_ratio"].notna()].drop_duplicates(["commit", "estimator"])
    for name, some in timed.groupby("estimator", sort=False):
        last: Any = None
        for _, row in some.iterrows():
            mark, change = NEW, np.nan
            if last is not None and last["against"] == row["against"]:
                change = row["step_ratio"] / last["step_ratio"]
                half = np.hypot(*(np.log(r["step_high"] / r["step_ratio"]) for r in (last, row)))
                is_apart = abs(np.log(change)) - half > np.log(MARGIN)
                mark = ("worse" if change > 1.0 else "better") if is_apart else ""
            last = row if mark else last
            yield {
                "number": numbers[row["commit"]],
                **row[["commit", "committed_s", "subject"]],
                "estimator": name,
                "metric": STEP,
                **{key: row[f"step_{key}"] for key in ("low", "high")},
                "value": row["step_ratio"],
                "mark": mark,
                "change": change if mark not in ("", NEW) else np.nan,
            }
