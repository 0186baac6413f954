"""Baselines of a suite: read, checked against, renewed and written."""

import contextlib
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.gate.candidate import candidate_rows
from experiments.gate.compare import WHICH, Finding, compare, failed_runs, how, how_to_renew
from experiments.gate.suite import ERRORS, Suite, read_suite, run_suite, suite_path
from experiments.runs.paths import packaged, results
from experiments.runs.row import Outcome
from experiments.runs.version import code_version
from sim.errors import InputError, require
from sim.files import write_text

_COUNT = re.compile(r"(\d+) rows")  # in a baseline's first line, to recognise one cut short
_COLUMNS = (*WHICH, "checksum", "fingerprint", *ERRORS, "status")
_TEXTS = ("estimator", "checksum", "status")


@dataclass(frozen=True)
class AcceptedBaseline:
    """What was accepted.

    Attributes
    ----------
    written
        Files of the new baseline.
    copied
        Files of the old one that came with the package and now stand beside it, unchanged.
    findings
        How it compares with the baselines that were there.
    """

    written: list[Path]
    copied: list[Path]
    findings: list[Finding]


@dataclass(frozen=True)
class Baseline:
    """Rows of a baseline, and its history: when, which code, which estimators, and why."""

    rows: pd.DataFrame
    history: tuple[str, ...] = ()


def baseline_folder() -> Path:
    """Folder of the main suite's baselines: in the results, else in the package."""
    own = results() / "baselines"
    return own if own.exists() else packaged("results/baselines")


def read_baseline(path: Path) -> Baseline:
    """Read a baseline.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    restore = f"restore it, e.g. git checkout -- {path}"
    try:
        text = path.read_text(encoding="utf-8")
        rows = pd.read_csv(path, comment="#", dtype=dict.fromkeys(_TEXTS, "str"), low_memory=False)
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: no baseline yet; accept a check with a reason to make one"
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot read this baseline ({error.strerror})") from error
    except ValueError as error:
        why = str(error).splitlines()[0]
        raise InputError(f"{path}: damaged ({why}); {restore}") from error
    if damage := _damage(text, rows):
        raise InputError(f"{path}: damaged ({damage}); {restore}")
    lines = (line[2:] for line in text.splitlines() if line.startswith("# "))
    return Baseline(rows, tuple(line for line in lines if not _COUNT.fullmatch(line)))


def _damage(text: str, rows: pd.DataFrame) -> str:
    """What is wrong with a baseline; empty if it is sound."""
    if missing := [name for name in _COLUMNS if name not in rows]:
        return f"no column {missing[0]}"
    count = _COUNT.fullmatch(text.partition("\n")[0].removeprefix("# "))
    if not text.endswith("\n") or (count and int(count[1]) != len(rows)):
        return f"cut short at {len(rows)} rows"
    for name in _COLUMNS:
        cells = rows[name]
        if name not in _TEXTS:
            numbers = pd.to_numeric(cells, errors="coerce")
            if len(wrong := cells[numbers.isna() & cells.notna()]):
                return f"{name} {wrong.iloc[0]!r} is not a number"
            if name in ERRORS and (numbers < 0.0).any():
                return f"{name} {numbers.min():g} is below zero"
            cells = numbers.replace([np.inf, -np.inf], np.nan)
        if name not in ERRORS and cells.isna().any():
            return f"a row without {name}"
    if len(strange := rows["status"][~rows["status"].isin([*Outcome])]):
        return f"status {strange.iloc[0]!r} is unknown"
    sound = rows["status"] != Outcome.FAILED
    for name in ERRORS:
        if rows.loc[sound, name].isna().any():
            return f"a row that did not fail without {name}"
    twice = rows[rows.duplicated(list(WHICH))]
    if len(twice):
        return "two rows of {}, recording {}, repeat {}".format(*twice.iloc[0][list(WHICH)])
    runs = rows.groupby(["estimator", "recording"]).size().groupby("estimator").nunique()
    if (runs > 1).any():
        return f"rows of {runs.idxmax()} are missing"
    return ""


def write_baseline(baseline: Baseline, path: Path) -> None:
    """Write a baseline: the number of its rows and its history as comments, then its rows."""
    head = "".join(f"# {line}\n" for line in (f"{len(baseline.rows)} rows", *baseline.history))
    table = baseline.rows[list(_COLUMNS)].to_csv(index=False, float_format="%.9g")
    write_text(path, head + table)


def renew_baseline(
    old: Baseline | None,
    rows: pd.DataFrame,
    names: Sequence[str],
    reason: str,
    known: Sequence[str],
) -> Baseline:
    """Replace the rows of these estimators, and add the reason to the history.

    Estimators that the suite no longer has are dropped.
    """
    today = datetime.now(UTC).date().isoformat()
    line = f"{today} code {code_version()}: {', '.join(names)}: {' '.join(reason.split())}"
    fresh = rows[rows["estimator"].isin(names)]
    if old is None:
        return Baseline(fresh.reset_index(drop=True), (line,))
    kept = old.rows[old.rows["estimator"].isin(set(known) - set(names))]
    return Baseline(pd.concat([kept, fresh], ignore_index=True), (*old.history, line))


def is_main(suite: str) -> bool:
    """Whether this is the main suite, conf/suite/check.yaml."""
    return os.path.realpath(suite_path(suite)) == os.path.realpath(suite_path("check"))


def baseline_paths(suite: str, *, own: bool = False) -> dict[str, Path]:
    """Files of a suite's baselines: the last accepted, and the one pinned at a release.

    Those of a suite other than conf/suite/check.yaml lie beside it: `mine.baselines/check.csv`.

    Parameters
    ----------
    own
        Where they are written; until then they are read from the package.
    """
    folder = suite_path(suite).with_suffix(".baselines")
    if is_main(suite):
        folder = results() / "baselines" if own else baseline_folder()
    return {"accepted": folder / "check.csv", "release": folder / "release.csv"}


def check(
    suite_name: str,
    only: Sequence[str] = (),
    on_progress: Callable[[float], None] = lambda _: None,
    candidate: Path | None = None,
    config_dir: Path | None = None,
) -> list[Finding]:
    """Run a suite, or some of its estimators, and compare it with its baselines.

    Parameters
    ----------
    candidate
        Folder of trajectories that were made elsewhere, to judge in place of a run.
    config_dir
        A further folder of options, such as those of estimators of one's own.

    Raises
    ------
    InputError
        If the suite or a baseline cannot be used.
    """
    whole = read_suite(suite_path(suite_name), config_dir)
    suite = whole.select(only).made(elsewhere=candidate is not None)
    baselines = {
        key: read_baseline(path).rows
        for key, path in baseline_paths(suite_name).items()
        if key == "accepted" or path.exists()
    }
    for key, rows in baselines.items():
        absent = [e.name for e in suite.estimators if e.name not in set(rows["estimator"])]
        words = f"the {key} baseline has no {', '.join(absent)}; {how_to_renew(key)}"
        require(not absent, words)
    return compare(baselines, _rows(suite, 1, candidate, on_progress))


def accept(
    suite_name: str,
    reason: str,
    only: Sequence[str] = (),
    *,
    release: bool = False,
    on_progress: Callable[[float], None] = lambda _: None,
    candidate: Path | None = None,
    config_dir: Path | None = None,
) -> AcceptedBaseline:
    """Run a suite and make it the baseline, with the reason written into the file.

    With `only`, the other estimators keep their baselines. The release baseline stays as it is,
    unless there is none, or `release` pins it to this too.
    """
    require(reason.strip(), "accepting needs a reason, such as 'faster matching, 2 % worse'")
    whole = read_suite(suite_path(suite_name), config_dir)
    suite = whole.select(only).made(elsewhere=candidate is not None)
    names = [entry.name for entry in suite.estimators]
    paths = baseline_paths(suite_name)
    n_alike = sum(e.elsewhere == (candidate is not None) for e in whole.estimators)
    old = {key: read_baseline(path) for key, path in paths.items() if path.exists()}
    for key, path in paths.items():
        require(
            key in old or len(names) >= n_alike,
            f"{path}: no baseline yet, and one of {', '.join(names)} alone would not do; "
            "accept the whole suite",
        )
    rows = _rows(suite, 0, candidate, on_progress)
    for _, first in rows[failed_runs(rows)].head(1).iterrows():
        raise InputError(
            f"{first['estimator']} fails on recording {first['recording']} ({how(first)}); a "
            "baseline of failures guards nothing"
        )
    findings = [f for key in old for f in _compared({key: old[key].rows}, rows)]
    known = [entry.name for entry in whole.estimators]
    written, copied = [], []
    for key, path in baseline_paths(suite_name, own=True).items():
        if key == "accepted" or release or key not in old:
            write_baseline(renew_baseline(old.get(key), rows, names, reason, known), path)
            written.append(path)
        elif path != paths[key]:  # the package's comes along
            write_baseline(old[key], path)
            copied.append(path)
    return AcceptedBaseline(written, copied, findings)


def _rows(
    suite: Suite, side: int, candidate: Path | None, on_progress: Callable[[float], None]
) -> pd.DataFrame:
    """Rows of a baseline (side 0) or of a check (1)."""
    repeats = {entry.name: entry.repeats[side] for entry in suite.estimators}
    if candidate is not None:
        return candidate_rows(suite, candidate, repeats, on_progress)
    return run_suite(suite, repeats, on_progress=on_progress)


def _compared(baseline: dict[str, pd.DataFrame], rows: pd.DataFrame) -> list[Finding]:
    """Findings of those estimators that the baseline can be compared with."""
    findings: list[Finding] = []
    for _, of_one in rows.groupby("estimator", sort=False):
        with contextlib.suppress(InputError):  # new, or on other recordings
            findings += compare(baseline, of_one)
    return findings
