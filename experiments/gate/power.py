"""The planted-regression experiment: how often `estima check` alarms wrongly and rightly.

Each fault is graded to a worsening of 10 %: its size is searched for until the geometric mean of
the position errors over all recordings of the pool has risen by that much.

All runs are made once and pooled, and whole checks are then drawn from the pool. Recordings are
drawn with replacement, so that the luck of the suite's own seeds does not count. Of estimators that
draw at random, the baseline's and the check's runs are drawn separately among the pool's seedings.
A check on equivalent code draws both from sound runs; a check on a fault draws the check's runs of
one estimator from its faulty runs.

    python -m experiments.gate.power                # about half an hour on two cores
    python -m experiments.gate.power --share 0.1    # a few minutes; rough
"""

import argparse
import dataclasses
import math
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import scipy
from matplotlib.figure import Figure

from estimators.base import Estimator, Prior
from experiments.evaluation.statistics import share_interval
from experiments.gate.baseline import (
    baseline_folder,
    baseline_paths,
    read_baseline,
)
from experiments.gate.compare import (
    ALPHA,
    Change,
    Finding,
    by_repeat,
    compare,
    examine,
    judge,
)
from experiments.gate.faults import FAULTS, Fault
from experiments.gate.report import LABELS
from experiments.gate.suite import ERRORS, Planted, Suite, read_suite, run_suite, suite_path
from experiments.report.export import to_markdown
from experiments.runs.console import progress
from experiments.runs.paths import SOURCE, results
from experiments.runs.row import write_frame
from experiments.runs.seeds import stream
from experiments.viewing.style import BLUE, GREEN, ORANGE, WALL, save_figure, subplots
from sim.arrays import Array
from sim.files import write_text

TARGET = 0.10  # worsening that faults are graded to
_NEAR = 0.01  # of it
_MOST_TRIALS = 8
_RANDOM = 10  # seedings of the pool for each recording
_FAULTY_RANDOM = 3
_CHANGE_OF_SIZE = 6.0
_BEGIN, _END = "<!-- measured -->", "<!-- end of what was measured -->"
_COMMAND = (sys.executable, "-m", "experiments.gate.power")


# Conditions that change results within chance only: the process's environment, and whether its
# random numbers are drawn in another order
VARIANTS: dict[str, tuple[dict[str, str], bool]] = {
    "streams reseeded": ({}, False),
    "draws reordered": ({}, True),
    "NumPy and BLAS without AVX": (
        {
            "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL",
            "OPENBLAS_CORETYPE": "Nehalem",
        },
        False,
    ),
    "compiled for a generic processor": ({"NUMBA_CPU_NAME": "generic"}, False),
    "two threads": (
        {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"},
        False,
    ),
}


def reorder_draws(estimator: Estimator, rng: np.random.Generator) -> AbstractContextManager[object]:
    """Draw one number before all others, so that each of them has another use."""
    sound = estimator.reset

    def reset(prior: Prior, stream_: np.random.Generator) -> None:
        stream_.standard_normal()
        sound(prior, stream_)

    return mock.patch.object(estimator, "reset", reset)


@dataclasses.dataclass(frozen=True)
class Pool:
    """Runs of a suite, (n, runs) of each estimator and error, in the order of the recordings.

    Attributes
    ----------
    suite
        What is checked; the pool may hold fewer recordings.
    sound
        Sound runs of all estimators.
    faulty
        Of each (estimator, kind): the fault's size, and the runs with it.
    """

    suite: Suite
    sound: dict[tuple[str, str], Array]
    faulty: dict[tuple[str, str], tuple[float, dict[str, Array]]]


def arrays(rows: pd.DataFrame) -> dict[tuple[str, str], Array]:
    """Errors (n, runs) of each estimator and error."""
    return {
        (str(name), error): by_repeat(group, error)
        for name, group in rows.groupby("estimator", sort=False)
        for error in ERRORS
    }


def worsening(then: Array, now: Array) -> float:
    """Rise of the geometric mean over the recordings, as a share, without failed runs."""
    rises = np.log(now).mean(axis=1) - np.log(then).mean(axis=1)
    return math.expm1(float(np.nanmean(rises)))


def grade(
    fault: Fault, start: float, measure: Callable[[Planted], pd.DataFrame], sound: Array, name: str
) -> tuple[float, pd.DataFrame]:
    """Size at which a fault raises the position error by TARGET, and the runs with it."""
    low, high, size = 0.0, math.inf, start
    rise_low, rise_high = 0.0, math.inf
    trials = []
    for _ in range(_MOST_TRIALS):
        rows = measure(fault(size))
        rise = worsening(sound, arrays(rows)[name, "ate_rmse_m"])
        trials.append((abs(rise - TARGET), size, rows))
        if abs(rise - TARGET) < _NEAR:
            break
        if rise < TARGET:
            low, rise_low = size, rise
        else:
            high, rise_high = size, rise
        if low == 0.0 or not math.isfinite(high):  # as if the rise were proportional to the size
            times = TARGET / rise if rise > 0.0 else _CHANGE_OF_SIZE
            size *= min(max(times, 1.0 / _CHANGE_OF_SIZE), _CHANGE_OF_SIZE)
        else:
            share = (TARGET - rise_low) / (rise_high - rise_low)
            size = low + min(max(share, 0.15), 0.85) * (high - low)
    return min(trials, key=lambda trial: trial[0])[1:]


def fill_pool(
    suite: Suite, share: float, folder: Path, on_progress: Callable[[float], None]
) -> Pool:
    """Make the pool's runs over this share of the recordings, or read those that are there."""
    pooled = suite.cut(share)
    random = {entry.name for entry in suite.estimators if entry.repeats[0] > 1}

    def runs_of(file: str, make: Callable[[], pd.DataFrame]) -> pd.DataFrame:
        path = folder / f"{file}.parquet"
        if not path.exists():
            write_frame(make(), path)
        return pd.read_parquet(path)

    def measure(name: str, planted: Planted) -> pd.DataFrame:
        runs = {name: _FAULTY_RANDOM if name in random else 1}
        return run_suite(pooled, runs, reseed=2, planted={name: planted})

    def graded(name: str, fault: Fault, start: float) -> pd.DataFrame:
        position = sound[name, "ate_rmse_m"]
        size, rows = grade(fault, start, partial(measure, name), position, name)
        return rows.assign(size=size)

    n_runs = {entry.name: _RANDOM if entry.name in random else 1 for entry in suite.estimators}
    sound = arrays(runs_of("sound", lambda: run_suite(pooled, n_runs, reseed=1)))
    kinds = [
        (entry.name, kind, *fault)
        for entry in suite.estimators
        for kind, fault in FAULTS.get(entry.estimator, {}).items()
    ]
    faulty = {}
    for done, (name, kind, fault, start) in enumerate(kinds, start=1):
        rows = runs_of(f"{name}_{kind}", partial(graded, name, fault, start))
        of_error = {error: by_repeat(rows, error) for error in ERRORS}
        faulty[name, kind] = float(rows["size"].iloc[0]), of_error
        on_progress(done / len(kinds))
    return Pool(suite, sound, faulty)


def draw_check(
    pool: Pool, rng: np.random.Generator, fault: tuple[str, str] | None = None
) -> list[Finding]:
    """Draw a whole check against two baselines, with one fault planted or none."""
    n_pooled = {e.recordings: len(pool.sound[e.name, ERRORS[0]]) for e in pool.suite.estimators}
    counts = pool.suite.counts
    chosen = {group: rng.integers(n, size=counts[group]) for group, n in n_pooled.items()}
    findings = []
    for entry in pool.suite.estimators:
        name, rows = entry.name, chosen[entry.recordings]
        planted = pool.faulty[fault][1] if fault is not None and fault[0] == name else None
        if entry.repeats[0] == 1 and planted is None:
            continue  # equal to rounding, for which no test is needed
        n_then, n_now = entry.repeats
        n_runs = pool.sound[name, ERRORS[0]].shape[1]
        n_faulty = 0 if planted is None else planted[ERRORS[0]].shape[1]
        n_rest = n_runs - n_now if planted is None else n_runs
        order, faulty_order, again = (
            np.argsort(rng.random((len(rows), n)), axis=1) for n in (n_runs, n_faulty, n_rest)
        )
        for error in ERRORS:
            runs = np.take_along_axis(pool.sound[name, error][rows], order, axis=1)
            now, rest = runs[:, :n_now], runs[:, n_now:]
            if planted is not None:
                drawn = np.take_along_axis(planted[error][rows], faulty_order, axis=1)
                now, rest = drawn[:, :n_now], runs
            others = np.take_along_axis(rest, again, axis=1)
            for baseline, left in (("accepted", rest), ("release", others)):
                then = left[:, :n_then]
                findings.append(examine((name, error, baseline), then, now, rng))
    return judge(findings)


def alarms(
    pool: Pool, n_checks: int, seed: int, fault: tuple[str, str] | None = None
) -> tuple[int, int]:
    """Of drawn checks: how many alarm, and how many of those (also) name the faulty estimator."""
    from joblib import Parallel, delayed

    axis = "/".join(("planted", *(fault or ())))

    def alarmed(i: int) -> set[str]:
        return {f.estimator for f in draw_check(pool, stream(seed, axis, i), fault) if f.alarms}

    checks = Parallel(n_jobs=-1)(delayed(alarmed)(i) for i in range(n_checks))
    named = sum(fault is not None and fault[0] in names for names in checks)
    return sum(map(bool, checks)), named


def smallest_detectable(pool: Pool, fault: tuple[str, str]) -> float:
    """Worsening, as a share, that 95 % of checks find of a fault that spreads as this one does.

    For each error: what the t test over the recordings finds and, of an estimator that draws at
    random, what the permutation test finds, at the first level of Holm's method: the others of its
    kind are sound. The error that finds it first counts, and the result is the rise of the
    position error that goes with it.
    """
    entry = next(e for e in pool.suite.estimators if e.name == fault[0])
    _, of_error = pool.faulty[fault]
    n_random = sum(each.repeats[0] > 1 for each in pool.suite.estimators)
    n_baselines = 2
    n_tests = n_baselines * len(ERRORS) * (n_random if entry.repeats[0] > 1 else 1)
    level = ALPHA / 2.0 / n_tests
    found = []
    for error in ERRORS:
        then, now = np.log(pool.sound[fault[0], error]), np.log(of_error[error])
        d = now[:, : entry.repeats[1]].mean(axis=1) - then[:, : entry.repeats[0]].mean(axis=1)
        d, n = d[np.isfinite(d)], pool.suite.counts[entry.recordings]
        spread = float(d.std(ddof=1)) / math.sqrt(n)
        least = (scipy.stats.t.isf(level, n - 1) + scipy.stats.norm.ppf(0.95)) * spread
        if entry.repeats[0] > 1:
            own = float(np.nanmean(then.var(axis=1, ddof=1)))
            noise = math.sqrt(own * sum(1.0 / count for count in entry.repeats) / n)
            real = scipy.stats.norm.isf(level) * noise
            least = max(least, real + scipy.stats.norm.ppf(0.95) * spread)
        if d.mean() > 0.0:
            found.append(least / float(d.mean()))
    position = worsening(pool.sound[fault[0], ERRORS[0]], of_error[ERRORS[0]])
    return min(found, default=math.inf) * position


def power_table(pool: Pool, n_checks: int, on_progress: Callable[[float], None]) -> pd.DataFrame:
    """Each fault: its size, the worsening it makes, and the share of checks that find it."""
    rows = []
    for done, (fault, (size, of_error)) in enumerate(pool.faulty.items(), start=1):
        name, kind = fault
        _, named = alarms(pool, n_checks, 1, fault)
        share = share_interval(named, n_checks)
        rows.append(
            {
                "estimator": name,
                "fault": kind,
                "size": size,
                **{f"rise_{e}": worsening(pool.sound[name, e], of_error[e]) for e in ERRORS},
                "checks": n_checks,
                "found": share.value,
                "found_low": share.low,
                "found_high": share.high,
                "smallest": smallest_detectable(pool, fault),
            }
        )
        on_progress(done / len(pool.faulty))
    return pd.DataFrame(rows)


def run_variant(name: str, suite: Suite) -> pd.DataFrame:
    """Run a whole suite under one of VARIANTS, in this process's environment."""
    repeats = {entry.name: entry.repeats[1] for entry in suite.estimators}
    planted = dict.fromkeys(repeats, reorder_draws) if VARIANTS[name][1] else None
    return run_suite(suite, repeats, reseed=10 + list(VARIANTS).index(name), planted=planted)


def variants(
    suite_name: str, share: float, folder: Path, on_progress: Callable[[float], None]
) -> list[dict[str, str]]:
    """Check the same code under each of VARIANTS, each in a process of its own; in words."""
    rows = []
    then = {key: read_baseline(path).rows for key, path in baseline_paths(suite_name).items()}
    for done, (name, (environment, _)) in enumerate(VARIANTS.items(), start=1):
        path = folder / f"variant_{done}.parquet"
        if not path.exists():
            given = ("--variant", name, "--share", str(share), "--suite", suite_name)
            own = {}
            if environment:  # the last bits of recordings change too
                own = {
                    "NUMBA_CACHE_DIR": str(folder / f"compiled_{done}"),
                    "ESTIMA_RESULTS": str(folder / f"results_{done}"),
                }
            subprocess.run(
                [*_COMMAND, *given, "--out", str(path)],
                check=True,
                env={**os.environ, **environment, **own},
            )
        rows_now = pd.read_parquet(path)
        known = rows_now["recording"].groupby(rows_now["estimator"]).max()
        of_pool = {  # the pool may hold fewer recordings
            key: rows_then[rows_then["recording"] <= rows_then["estimator"].map(known)]
            for key, rows_then in then.items()
        }
        findings = compare(of_pool, rows_now)
        fixed = [f for f in findings if f.verdict is Change.IDENTICAL]
        largest = max((abs(f.ratio - 1.0) for f in fixed), default=0.0)
        least_p = min((f.p_real[0] for f in findings if f not in fixed), default=1.0)
        rows.append(
            {
                "condition": name,
                "tests": str(len(findings)),
                "equal to rounding": str(len(fixed)),
                "largest change of those": f"{largest:.1g}",
                "least p of the others": f"{least_p:.2g}",
                "alarms": str(sum(f.alarms for f in findings)),
            }
        )
        on_progress(done / len(VARIANTS))
    return rows


def measured_text(
    pool: Pool, null: tuple[int, int], power: pd.DataFrame, equal: list[dict[str, str]]
) -> str:
    """Markdown of what was measured, for docs/regression.md."""
    hits, n_checks = null
    share = share_interval(hits, n_checks)
    counts = ", ".join(
        f"{len(pool.sound[entry.name, ERRORS[0]])} {entry.recordings}"
        for entry in {e.recordings: e for e in pool.suite.estimators}.values()
    )
    n_found = (power["found"] * power["checks"]).sum()
    overall = share_interval(round(n_found), int(power["checks"].sum()))
    lines = (
        f"Pool: {counts} recordings; {_RANDOM} sound seedings of each estimator that draws at "
        f"random, and {_FAULTY_RANDOM} of each of its faults.",
        "",
        f"**False alarms:** {hits} in {n_checks} whole checks drawn from reseeded runs "
        f"({100 * share.value:.2f} %, 95 % interval {100 * share.low:.2f} to "
        f"{100 * share.high:.2f} %; the goal is at most 1 in 50).",
        "",
        "Whole checks of the same code under other conditions, against the tracked baselines "
        "(every estimator reseeded, recordings simulated again where the processor changes):",
        "",
        to_markdown(pd.DataFrame(equal)),
        "**Power** at faults graded to a rise of the position error by 10 %, in whole checks "
        f"drawn from the pool ({power['checks'].iloc[0]} each):",
        "",
        to_markdown(pd.DataFrame([_fault(row) for row in power.to_dict("records")])),
        "![The smallest rise that 95 % of checks find, of each estimator and fault; dashed: "
        "the goal]"
        "(figures/regression.png)",
        "",
        f"All faults together: {100 * overall.value:.1f} % found (95 %: {100 * overall.low:.1f} to "
        f"{100 * overall.high:.1f}); {(power['found'] >= 0.95).sum()} of {len(power)} faults reach "
        "95 %.",
    )
    return "\n".join(lines)


def _fault(row: dict[str, Any]) -> dict[str, str]:
    found, low, high = (100 * row[name] for name in ("found", "found_low", "found_high"))
    return {
        "estimator": row["estimator"],
        "fault": row["fault"],
        "size": f"{row['size']:.3g}",
        **{LABELS[error]: f"{100 * row[f'rise_{error}']:+.1f} %" for error in ERRORS},
        "found": f"{found:.1f} % ({low:.1f} to {high:.1f})",
        "95 % found from": f"{100 * row['smallest']:.1f} %",
    }


def _write_measured(page: Path, text: str) -> None:
    """Put the text between the page's marks."""
    head, _, rest = page.read_text().partition(_BEGIN)
    tail = rest.partition(_END)[2]
    write_text(page, f"{head}{_BEGIN}\n{text}\n{_END}{tail}")


_KINDS = {"derivative": (BLUE, "o"), "lost": (ORANGE, "s"), "noise": (GREEN, "^")}


def draw_detectable(power: pd.DataFrame, target: float) -> Figure:
    """Worsening that 95 % of checks find, of each estimator and kind of fault, beside the goal."""
    page, axes = subplots(6.0, 3.4)
    names = list(dict.fromkeys(power["estimator"]))
    for k, (kind, (colour, marker)) in enumerate(_KINDS.items()):
        rows = power[power["fault"] == kind]
        heights = [names.index(name) + 0.2 * (k - 1) for name in rows["estimator"]]
        axes.plot(100.0 * rows["smallest"], heights, marker, color=colour, label=kind)
    axes.axvline(100.0 * target, color=WALL, linestyle="--", linewidth=1.0)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(
        xlim=(0.0, None), xlabel="smallest rise of the position error that 95 % of checks find, %"
    )
    axes.legend(title="fault", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return page


def main() -> None:
    """Run the experiment; write its table and figure, and the section of the docs."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.gate.power",
        description="How often `estima check` alarms wrongly, and how often rightly.",
    )
    parser.add_argument("--suite", default="check")
    parser.add_argument(
        "--share", type=float, default=1.0, help="share of the recordings in the pool (0.1: quick)"
    )
    parser.add_argument("--folder", type=Path, default=results() / "runs" / "planted")
    parser.add_argument("--variant", choices=list(VARIANTS), help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    suite = read_suite(suite_path(given.suite))
    if given.variant:
        run_variant(given.variant, suite.cut(given.share)).to_parquet(given.out, index=False)
        return
    if not 0.05 <= given.share <= 1.0:
        parser.error("--share must lie in 0.05..1")
    folder: Path = given.folder / f"{Path(given.suite).stem}_{given.share:g}"
    folder.mkdir(parents=True, exist_ok=True)
    n_null, n_power = 4000, 400 if given.share == 1.0 else 200
    with progress("grading the faults", 1.0) as on_progress:
        pool = fill_pool(suite, given.share, folder, on_progress)
    with progress("looking for the faults", 1.0) as on_progress:
        power = power_table(pool, n_power, on_progress)
    hits, _ = alarms(pool, n_null, 0)
    print(f"{hits} false alarms in {n_null} checks")
    print(power.to_string(index=False))
    write_frame(power, baseline_folder() / "power.csv")
    save_figure(draw_detectable(power, TARGET), SOURCE / "docs" / "figures" / "regression.png")
    page = SOURCE / "docs" / "regression.md"
    _write_measured(page, measured_text(pool, (hits, n_null), power, []))
    with progress("other conditions", 1.0) as on_progress:
        equal = variants(given.suite, given.share, folder, on_progress)
    _write_measured(page, measured_text(pool, (hits, n_null), power, equal))
    print(page)


if __name__ == "__main__":
    main()
