"""The regression gate: errors of a suite against a baseline, by paired tests.

A baseline and a check run the same recordings, so d = log(error now) - log(error then), one number
a recording, holds neither the recordings' difficulty nor their noise. An estimator that draws at
random has several runs a recording, and d is the difference of their means. Two questions follow:

1. Is the difference real? Code that differs in its bits alone draws its errors from the same
   distributions, so runs of then and now can be exchanged within each recording: a permutation
   test, at 0.002 over all estimators, errors and baselines of a check together (Holm). Where
   nothing is drawn at random equal code gives equal errors to rounding, and any difference
   beyond 1e-6 is real.
2. Is it one for the worse? A change may raise errors on some recordings and lower them on
   others; so the mean of d must be above zero by a t test over the recordings, at 0.05.

`worse` is what answers yes to both, and `better` likewise.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from experiments.gate.suite import ERRORS, Suite, read_suite, run_suite, suite_path
from experiments.runs.paths import packaged, results
from experiments.runs.seeds import stream
from experiments.runs.version import code_version
from sim.errors import InputError
from sim.files import write_whole

Array = NDArray[np.float64]
Verdict = Literal["identical", "equal", "changed", "better", "worse", "failed"]


def baseline_folder() -> Path:
    """Folder of the main suite's baselines: that of the results, else those that came along."""
    own = results() / "baselines"
    return own if own.exists() else packaged("results/baselines")


ALPHA_REAL = 0.002  # of a whole check
ALPHA_GENERAL = 0.05  # of one error of one estimator
ROUNDING = 1e-6  # of an error, as a share; machines differ by less than 1e-9
N_DRAWS = 40_000
_MOST_WAYS = 2**15 - 1  # to exchange a recording's runs; where there are more,
_DRAWN_WAYS = 4096  # so many are drawn
_PLAIN = 2.0  # standard deviations
_LEAST_ERROR = 1e-12  # an error of nothing has no logarithm
_WHICH = ("estimator", "recording", "repeat")
_COUNT = re.compile(r"(\d+) rows")  # in a baseline's first line, so that one cut short is known
_COLUMNS = (*_WHICH, "checksum", "fingerprint", *ERRORS, "status")


@dataclass(frozen=True)
class Baseline:
    """Rows of a baseline and the history written over them: when, which code, which, and why."""

    rows: pd.DataFrame
    history: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finding:
    """One error of one estimator beside one baseline.

    Attributes
    ----------
    estimator, error, baseline
        Whose, which of ERRORS, and `accepted` or `release`.
    n_recordings
        On which both ran to the end.
    ratio, low, high
        Geometric mean of now / then over the recordings, with its 90 % t interval: it leaves out
        1 where a one-sided test at 0.05 tells a direction.
    p_real, p_general
        (worse, better) of either question.
    verdict
        `identical`: to rounding. `equal`: no difference is shown. `changed`: it is another
        result, neither worse nor better on the whole. `failed`: runs end that used not to.
    message
        What failed.
    n_suite
        Recordings of the suite; `n_recordings` may be fewer.
    """

    estimator: str
    error: str
    baseline: str
    n_recordings: int
    ratio: float
    low: float
    high: float
    p_real: tuple[float, float]
    p_general: tuple[float, float]
    verdict: Verdict
    message: str = ""
    n_suite: int = 0

    @property
    def alarms(self) -> bool:
        """Whether the check fails by it."""
        return self.verdict in ("worse", "failed")


def exchange_p(
    then: Array, now: Array, rng: np.random.Generator, n_draws: int = N_DRAWS
) -> tuple[float, float]:
    """P that runs exchanged within each recording differ as far as these, up and down.

    Parameters
    ----------
    then, now
        (n, B) and (n, C) logs of errors.
    """
    runs, n_now = np.concatenate([now, then], axis=1), now.shape[1]
    sums = _exchanged_sums(runs - runs.mean(axis=1, keepdims=True), n_now, rng)
    seen = float(sums[:, 0].sum())
    spread = math.sqrt(float(sums.var(axis=1).sum()))
    if abs(seen) <= _PLAIN * spread:  # the normal law tells well enough that there is nothing
        above = float(stats.norm.sf(seen / spread)) if spread > 0.0 else 1.0
        return above, 1.0 - above if spread > 0.0 else 1.0
    drawn = np.zeros(n_draws)
    for of_recording in sums:
        drawn += of_recording[rng.integers(sums.shape[1], size=n_draws, dtype=np.int16)]
    slack = 1e-9 * (1.0 + abs(seen))  # sums of the same numbers in another order
    n_above, n_below = np.sum(drawn >= seen - slack), np.sum(drawn <= seen + slack)
    return float((1 + n_above) / (1 + n_draws)), float((1 + n_below) / (1 + n_draws))


def _exchanged_sums(runs: Array, n_now: int, rng: np.random.Generator) -> Array:
    """Sums of n_now of each recording's (n, B) runs, (n, ways); the first is of those seen."""
    sums: Array
    if math.comb(runs.shape[1], n_now) <= _MOST_WAYS:
        picks = np.array(list(itertools.combinations(range(runs.shape[1]), n_now)))
        sums = runs[:, picks].sum(axis=2)
        return sums
    sums = np.empty((len(runs), _DRAWN_WAYS))
    for row, of_recording in zip(sums, runs, strict=True):
        ways = np.tile(of_recording, (_DRAWN_WAYS, 1))
        rng.permuted(ways[1:], axis=1, out=ways[1:])
        row[:] = ways[:, :n_now].sum(axis=1)
    return sums


def general_p(differences: Array) -> tuple[float, float]:
    """P of the one-sided t tests that the mean of (n,) paired differences is above, below zero."""
    n, mean = len(differences), float(differences.mean())
    spread = float(differences.std(ddof=1)) / math.sqrt(n)
    if spread == 0.0:
        return (0.0 if mean > 0.0 else 1.0), (0.0 if mean < 0.0 else 1.0)
    above = float(stats.t.sf(mean / spread, n - 1))
    return above, 1.0 - above


def holm(p_values: Sequence[float], alpha: float) -> list[bool]:
    """Which hypotheses fall, with the chance of any falling wrongly at most alpha (Holm 1979)."""
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    falls = [False] * len(p_values)
    for rank, i in enumerate(order):
        if p_values[i] > alpha / (len(p_values) - rank):
            break
        falls[i] = True
    return falls


def examine(then: Array, now: Array, rng: np.random.Generator, n_draws: int = N_DRAWS) -> Finding:
    """Look at one error, (n, B) then and (n, C) now; the verdict is still open.

    It is `identical`, or else `equal` where runs differ by chance, or `changed` where they do not.
    """
    logs_then, logs_now = (np.log(np.maximum(runs, _LEAST_ERROR)) for runs in (then, now))
    shared = min(then.shape[1], now.shape[1])
    same = np.abs(logs_now[:, :shared] - logs_then[:, :shared]).max() < ROUNDING
    if same:  # by the same draws, as far as both go
        logs_then, logs_now = logs_then[:, :shared], logs_now[:, :shared]
    differences = logs_now.mean(axis=1) - logs_then.mean(axis=1)
    n, mean = len(differences), float(differences.mean())
    half = float(stats.t.ppf(1.0 - ALPHA_GENERAL, n - 1) * differences.std(ddof=1) / math.sqrt(n))
    ratio, low, high = (math.exp(v) for v in (mean, mean - half, mean + half))
    verdict: Verdict
    p_real, p_general = (1.0, 1.0), (1.0, 1.0)
    if same:
        verdict = "identical"
    elif then.shape[1] == 1:  # nothing random in it
        verdict, p_real, p_general = "changed", (0.0, 0.0), general_p(differences)
    else:
        verdict = "equal"
        p_real, p_general = exchange_p(logs_then, logs_now, rng, n_draws), general_p(differences)
    return Finding("", "", "", n, ratio, low, high, p_real, p_general, verdict)


def judge(findings: Sequence[Finding]) -> list[Finding]:
    """Give the verdicts of a whole check."""
    judged = list(findings)
    open_ones = [i for i, f in enumerate(findings) if f.verdict in ("equal", "changed")]
    verdicts: tuple[Verdict, Verdict] = ("worse", "better")
    for side, verdict in enumerate(verdicts):
        real = holm([findings[i].p_real[side] for i in open_ones], ALPHA_REAL)
        for i, is_real in zip(open_ones, real, strict=True):
            if is_real and findings[i].p_general[side] <= ALPHA_GENERAL:
                judged[i] = dataclasses.replace(findings[i], verdict=verdict)
    return judged


def compare(
    baselines: dict[str, pd.DataFrame], current: pd.DataFrame, n_draws: int = N_DRAWS
) -> list[Finding]:
    """Findings of a check against baselines, by name.

    Raises
    ------
    InputError
        If the baselines lack an estimator or a recording, or hold others of the same seed.
    """
    findings = []
    for name, baseline in baselines.items():
        for estimator, now in current.groupby("estimator", sort=False):
            then = baseline[baseline["estimator"] == estimator]
            _same_recordings(str(estimator), name, then, now)
            failure = _newly_failing(then, now)
            for error in ERRORS:
                rng = stream(0, f"exchange/{estimator}/{error}")
                found = _examined(then, now, error, failure, rng, n_draws)
                findings.append(
                    dataclasses.replace(
                        found,
                        estimator=str(estimator),
                        error=error,
                        baseline=name,
                        n_suite=now["recording"].nunique(),
                    )
                )
    return judge(findings)


def _examined(
    then: pd.DataFrame,
    now: pd.DataFrame,
    error: str,
    failure: str,
    rng: np.random.Generator,
    n_draws: int,
) -> Finding:
    """One error on the recordings where all runs succeed, then and now."""
    tables = [t.pivot(index="recording", columns="repeat", values=error) for t in (then, now)]
    errors_then, errors_now = (table.to_numpy(np.float64) for table in tables)
    sound = np.isfinite(errors_then).all(axis=1) & np.isfinite(errors_now).all(axis=1)
    n = int(sound.sum())
    if failure or n < 2:
        nan, ones = math.nan, (1.0, 1.0)
        told = failure or "no run succeeds"
        return Finding("", "", "", n, nan, nan, nan, ones, ones, "failed", told)
    return examine(errors_then[sound], errors_now[sound], rng, n_draws)


def _same_recordings(estimator: str, name: str, then: pd.DataFrame, now: pd.DataFrame) -> None:
    remedy = "; check with --accept REASON to start a new baseline"
    if then.empty:
        raise InputError(f"the {name} baseline does not know {estimator}{remedy}")
    before = then.drop_duplicates("recording").set_index("recording")
    after = now.drop_duplicates("recording").set_index("recording")
    if set(before.index) != set(after.index):
        raise InputError(f"the {name} baseline of {estimator} has other recordings{remedy}")
    after = after.loc[before.index]
    away = np.abs(after["fingerprint"] - before["fingerprint"])
    near = away <= ROUNDING * np.abs(before["fingerprint"])  # NaN is near to nothing
    other = ~near & (after["checksum"] != before["checksum"])
    if other.any():
        raise InputError(
            f"recording {other.idxmax()} of {estimator} is not that of the {name} baseline: what "
            f"simulates it has changed, and errors cannot be compared run by run{remedy}"
        )


def _failed(rows: pd.DataFrame) -> pd.Series:
    """Which runs ended in an exception or in errors that are not finite."""
    finite = np.isfinite(rows[list(ERRORS)].to_numpy(np.float64)).all(axis=1)
    return (rows["status"] != "ok") | ~finite


def _how(run: pd.Series) -> str:
    return str(run["status"]) if run["status"] != "ok" else "errors that are not finite"


def _newly_failing(then: pd.DataFrame, now: pd.DataFrame) -> str:
    """What ends runs now on recordings where none of the baseline's failed; else nothing."""
    bad = now[_failed(now)]
    new = bad[~bad["recording"].isin(then.loc[_failed(then), "recording"])]
    if new.empty:
        return ""
    first = new.iloc[0]
    return f"{len(bad)} of {len(now)} runs fail; recording {first['recording']}: {_how(first)}"


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
    twice = rows.duplicated(list(_WHICH))
    if twice.any():
        which = rows.loc[twice, list(_WHICH)].iloc[0]
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


def baseline_paths(suite: str) -> dict[str, Path]:
    """Files of a suite's baselines: what was last accepted, and what is pinned at a release.

    Those of a suite other than conf/suite/check.yaml lie beside it: `mine.baselines/check.csv`.
    """
    folder = baseline_folder() if is_main(suite) else suite_path(suite).with_suffix(".baselines")
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
    the reason is given for. With `release` it is pinned anew as a whole.

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
    bad = rows[_failed(rows)]
    if len(bad):
        first = bad.iloc[0]
        raise InputError(
            f"{first['estimator']} fails on recording {first['recording']} ({_how(first)}); a "
            "baseline of failures guards nothing"
        )
    changes = {"accepted": names}
    pinned = old["release"]
    if release or pinned is None:
        changes["release"] = names
    elif worse := _cannot_stay(pinned.rows, rows, names):
        changes["release"] = worse
    for key, changed in changes.items():
        write_baseline(renewed(old[key], rows, changed, reason, known), paths[key])
    return [paths[key] for key in changes]


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
