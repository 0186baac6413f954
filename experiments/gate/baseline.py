"""Baselines of a suite: their files, a check against them, and their renewal."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.gate.compare import WHICH, Finding, compare, failed, how
from experiments.gate.suite import ERRORS, Suite, read_suite, run_suite, suite_path
from experiments.runs.paths import packaged, results
from experiments.runs.version import code_version
from sim.errors import InputError
from sim.files import write_whole

_COUNT = re.compile(r"(\d+) rows")  # in a baseline's first line, so that one cut short is known
_COLUMNS = (*WHICH, "checksum", "fingerprint", *ERRORS, "status")


@dataclass(frozen=True)
class Baseline:
    """Rows of a baseline and the history written over them: when, which code, which, and why."""

    rows: pd.DataFrame
    history: tuple[str, ...] = ()


def baseline_folder() -> Path:
    """Folder of the main suite's baselines: that of the results, else those that came along."""
    own = results() / "baselines"
    return own if own.exists() else packaged("results/baselines")


def read_baseline(path: Path) -> Baseline:
    """Read a baseline.

    Raises
    ------
    InputError
        If it is not there, or is no baseline.
    """
    restore = f"restore it, e.g. git checkout -- {path}"
    try:
        text = path.read_text(encoding="utf-8")
        texts = dict.fromkeys(("estimator", "checksum", "status"), "str")
        rows = pd.read_csv(path, comment="#", dtype=texts, low_memory=False)
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: no baseline yet; check with --accept REASON to make one"
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
    """What no baseline that was written whole has; nothing if it is sound."""
    for name in _COLUMNS:
        if name not in rows:
            return f"no column {name}"
    count = _COUNT.fullmatch(text.partition("\n")[0].removeprefix("# "))
    if not text.endswith("\n") or (count and int(count[1]) != len(rows)):
        return f"cut short at {len(rows)} rows"
    for name in ("recording", "repeat", "fingerprint", *ERRORS):
        numbers = pd.to_numeric(rows[name], errors="coerce")
        wrong = numbers.isna() & rows[name].notna()
        if wrong.any():
            return f"{name} {rows.loc[wrong, name].iloc[0]!r} is no number"
        if name not in ERRORS and not np.isfinite(numbers.to_numpy(np.float64)).all():
            return f"a row without {name}"
    for name in ("estimator", "checksum", "status"):
        if rows[name].isna().any():
            return f"a row without {name}"
    twice = rows.duplicated(list(WHICH))
    if twice.any():
        which = rows.loc[twice, list(WHICH)].iloc[0]
        return "two rows of {}, recording {}, repeat {}".format(*which)
    runs = rows.groupby(["estimator", "recording"]).size().groupby("estimator").nunique()
    if (runs > 1).any():
        return f"rows of {runs.idxmax()} are missing"
    return ""


def write_baseline(baseline: Baseline, path: Path) -> None:
    """Write a baseline: the number of its rows and its history as comments, then its rows."""
    head = "".join(f"# {line}\n" for line in (f"{len(baseline.rows)} rows", *baseline.history))
    table = baseline.rows[list(_COLUMNS)].to_csv(index=False, float_format="%.9g")
    with write_whole(path) as part:
        part.write_text(head + table, encoding="utf-8")


def renewed(
    old: Baseline | None,
    rows: pd.DataFrame,
    estimators: Iterable[str],
    reason: str,
    known: Iterable[str],
) -> Baseline:
    """Baseline with the rows of these estimators in place of its own, and why in its history.

    Estimators that the suite no longer knows are dropped.
    """
    names = list(estimators)
    today = datetime.now(UTC).date().isoformat()
    line = f"{today} code {code_version()}: {', '.join(names)}: {' '.join(reason.split())}"
    fresh = rows[rows["estimator"].isin(names)]
    if old is None:
        return Baseline(fresh.reset_index(drop=True), (line,))
    kept = old.rows[~old.rows["estimator"].isin(names)]
    kept = kept[kept["estimator"].isin(list(known))]
    return Baseline(pd.concat([kept, fresh], ignore_index=True), (*old.history, line))


def is_main(suite: str) -> bool:
    """Whether this is the suite of the project's own gate, conf/suite/check.yaml."""
    return suite_path(suite).resolve() == suite_path("check").resolve()


def baseline_paths(suite: str, *, own: bool = False) -> dict[str, Path]:
    """Files of a suite's baselines: the last accepted, and the one pinned at a release.

    Those of a suite other than conf/suite/check.yaml lie beside it: `mine.baselines/check.csv`.

    Parameters
    ----------
    own
        Where baselines are written; they are read from the package if there are none yet.
    """
    folder = suite_path(suite).with_suffix(".baselines")
    if is_main(suite):
        folder = results() / "baselines" if own else baseline_folder()
    return {"accepted": folder / "check.csv", "release": folder / "release.csv"}


def check(
    suite_name: str,
    only: Sequence[str] = (),
    on_progress: Callable[[float], None] | None = None,
) -> list[Finding]:
    """Run a suite, or some of its estimators, and compare it with its baselines.

    Raises
    ------
    InputError
        If the suite or a baseline cannot be used.
    """
    suite = read_suite(suite_path(suite_name)).of(only)
    paths = baseline_paths(suite_name)
    baselines = {"accepted": read_baseline(paths["accepted"]).rows}
    if paths["release"].exists():
        baselines["release"] = read_baseline(paths["release"]).rows
    rows = run_suite(suite, repeats_of(suite, of_baseline=False), on_progress=on_progress)
    return compare(baselines, rows)


def accept(
    suite_name: str,
    reason: str,
    only: Sequence[str] = (),
    *,
    release: bool = False,
    on_progress: Callable[[float], None] | None = None,
) -> list[Path]:
    """Run a suite and make it the baseline, with the reason written into the file.

    With `only` the baselines of the other estimators stay.

    The release baseline stays pinned, but for estimators that are worse than it: they are what
    the reason is given for. With `release` the whole of it is pinned again.

    Returns
    -------
    list of Path
        Files written.
    """
    if not reason.strip():
        raise InputError('--accept needs a reason, such as --accept "faster matching, 2 % worse"')
    whole = read_suite(suite_path(suite_name))
    suite = whole.of(only)
    names = [entry.name for entry in suite.estimators]
    known = [entry.name for entry in whole.estimators]
    paths = baseline_paths(suite_name)
    old = {k: read_baseline(path) if path.exists() else None for k, path in paths.items()}
    for key, baseline in old.items():
        if baseline is None and len(names) < len(known):
            raise InputError(
                f"{paths[key]}: no baseline yet, and one of {', '.join(names)} alone would not do; "
                "accept the whole suite, without --only"
            )
    rows = run_suite(suite, repeats_of(suite, of_baseline=True), on_progress=on_progress)
    bad = rows[failed(rows)]
    if len(bad):
        first = bad.iloc[0]
        raise InputError(
            f"{first['estimator']} fails on recording {first['recording']} ({how(first)}); a "
            "baseline of failures guards nothing"
        )
    changes = {"accepted": names}
    pinned = old["release"]
    if release or pinned is None:
        changes["release"] = names
    elif worse := _cannot_stay(pinned.rows, rows, names):
        changes["release"] = worse
    written = []
    for key, path in baseline_paths(suite_name, own=True).items():
        before, changed = old[key], changes.get(key)
        if changed is not None:
            write_baseline(renewed(before, rows, changed, reason, known), path)
        elif before is not None and path != paths[key]:  # the package's comes along
            write_baseline(before, path)
        else:
            continue
        written.append(path)
    return written


def _cannot_stay(pinned: pd.DataFrame, rows: pd.DataFrame, names: Sequence[str]) -> list[str]:
    """Estimators that are worse than the release, or cannot be compared with it any more."""
    out = []
    for name in names:
        try:
            found = compare({"release": pinned}, rows[rows["estimator"] == name])
        except InputError:
            out.append(name)
            continue
        if any(finding.alarms for finding in found):
            out.append(name)
    return out


def repeats_of(suite: Suite, *, of_baseline: bool) -> dict[str, int]:
    """Runs of each estimator on each recording."""
    return {entry.name: entry.repeats[0 if of_baseline else 1] for entry in suite.estimators}
