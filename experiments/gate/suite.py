"""A suite: estimators over fixed short recordings, one row of errors for each run.

A suite is a YAML file (conf/suite/check.yaml is the one that `estima check` runs). Its recordings
follow from their seeds, so every version of an estimator meets the same ones.
"""

from __future__ import annotations

import dataclasses
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from estimators.base import Estimate, Estimator
from experiments.runs import paths
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome
from experiments.runs.seeds import stream
from experiments.viewing.run_figure import run_figure
from experiments.viewing.style import save_figure
from sim.errors import InputError, printable, require
from sim.recording import Recording
from sim.team import Team
from sim.yaml_file import read_yaml

ERRORS = ("ate_rmse_m", "ate_aligned_rmse_m", "heading_rmse_rad")
_RESEEDED = 1000  # streams of one seeding; repeats of the next start beyond them
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True)
class Entry:
    """An estimator of a suite.

    Attributes
    ----------
    name
        What its rows and its streams are called.
    estimator
        Option of conf/estimator.
    recordings
        Name of the group of recordings that it reads.
    repeats
        Runs with streams of their own on each recording: of the baseline, and of a check.
    overrides
        Hydra overrides beside those of the recordings.
    revised
        Whether the trajectory of `finish` is judged, and not the online one.
    elsewhere
        Whether its trajectories are made elsewhere, and checked by `--candidate`.
    """

    name: str
    estimator: str
    recordings: str
    repeats: tuple[int, int]
    overrides: tuple[str, ...] = ()
    revised: bool = False
    elsewhere: bool = False


@dataclass(frozen=True)
class Suite:
    """Groups of recordings, and the estimators that read them.

    Attributes
    ----------
    first_seed
        Seed of the first recording of each group.
    counts, overrides
        Of each group: how many recordings, and the Hydra overrides that make them.
    estimators
        In the order of the file.
    """

    first_seed: int
    counts: Mapping[str, int]
    overrides: Mapping[str, tuple[str, ...]]
    estimators: tuple[Entry, ...] = field(default_factory=tuple)

    def cut(self, share: float) -> Suite:
        """Return the same suite with this share of its recordings."""
        counts = {group: round(share * n) for group, n in self.counts.items()}
        return dataclasses.replace(self, counts=counts)

    def of(self, names: Sequence[str]) -> Suite:
        """Return the same suite with these estimators only; with all if none is named."""
        known = {entry.name: entry for entry in self.estimators}
        for name in names:
            require(name in known, f"the suite has no estimator {name}; it has {', '.join(known)}")
        chosen = tuple(entry for entry in self.estimators if not names or entry.name in names)
        return dataclasses.replace(self, estimators=chosen)

    def made(self, *, elsewhere: bool) -> Suite:
        """Return the same suite with the estimators that it runs, or those that are run elsewhere.

        Raises
        ------
        InputError
            If there are none.
        """
        chosen = tuple(entry for entry in self.estimators if entry.elsewhere == elsewhere)
        names = ", ".join(entry.name for entry in self.estimators)
        require(
            chosen,
            f"no estimator of {names} is marked `elsewhere: true` in the suite; --candidate judges "
            "those"
            if elsewhere
            else f"{names}: made elsewhere; check by --candidate DIR",
        )
        return dataclasses.replace(self, estimators=chosen)


Planted = Callable[[Estimator, np.random.Generator], AbstractContextManager[object]]


def read_suite(path: Path) -> Suite:
    """Read a suite.

    Raises
    ------
    InputError
        If the file cannot be read, or a key is missing, unknown or of the wrong kind.
    """
    content = read_yaml(path)
    try:
        groups = content["recordings"]
        suite = Suite(
            content["first_seed"],
            {name: group["count"] for name, group in groups.items()},
            {name: _overrides(group["overrides"]) for name, group in groups.items()},
            tuple(_entry(name, given) for name, given in content["estimators"].items()),
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            f"{path}: a suite holds first_seed, recordings (count, overrides) and estimators "
            "(estimator, recordings, repeats, overrides, revised), as conf/suite/check.yaml does "
            f"({error!r})"
        ) from error
    checks = [
        (
            _is_whole(suite.first_seed, 0),
            f"first_seed must be a whole number, zero or more, got {suite.first_seed!r}",
        ),
        (suite.estimators, "estimators is empty; name at least one of conf/estimator"),
        *(
            (_is_whole(n, 2), f"recordings.{group}.count must be 2 or more, got {n!r}")
            for group, n in suite.counts.items()
        ),
        *(
            (
                entry.recordings in suite.counts,
                f"estimators.{entry.name}.recordings={entry.recordings!r}; known: "
                f"{', '.join(map(str, suite.counts))}",
            )
            for entry in suite.estimators
        ),
        *(
            (
                all(_is_whole(n, 1, _RESEEDED) for n in entry.repeats),
                f"estimators.{entry.name}.repeats must lie in 1..{_RESEEDED}, got "
                f"{list(entry.repeats)}",
            )
            for entry in suite.estimators
        ),
    ]
    for sound, complaint in checks:
        require(sound, f"{path}: {complaint}")
    return suite


def _is_whole(value: Any, least: int, most: float = math.inf) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _overrides(given: Any) -> tuple[str, ...]:
    if not (isinstance(given, list) and all(isinstance(override, str) for override in given)):
        raise TypeError(f"overrides must be a list of texts, got {given!r}")
    return tuple(given)


def _entry(name: Any, given: dict[str, Any]) -> Entry:
    baseline, check = given["repeats"]
    known = ("estimator", "recordings", "repeats", "overrides", "revised", "elsewhere")
    unknown = set(given) - set(known)
    if unknown:
        raise KeyError(f"{name}.{sorted(map(str, unknown))[0]}")
    texts = name, option, group = name, given.get("estimator", name), given["recordings"]
    flags = revised, elsewhere = given.get("revised", False), given.get("elsewhere", False)
    if not (all(isinstance(t, str) for t in texts) and all(isinstance(f, bool) for f in flags)):
        raise TypeError(
            f"{name}: names and recordings must be texts, revised and elsewhere true or false"
        )
    overrides = _overrides(given.get("overrides") or [])
    if elsewhere and (overrides or "estimator" in given):
        raise TypeError(f"{name}: what is made elsewhere has neither estimator nor overrides here")
    return Entry(name, option, group, (baseline, check), overrides, revised, elsewhere)


def suite_path(name: str) -> Path:
    """File of a suite by its name, or the path itself."""
    return Path(name) if name.endswith(".yaml") else paths.CONF / "suite" / f"{name}.yaml"


def run_suite(
    suite: Suite,
    repeats: Mapping[str, int],
    *,
    reseed: int = 0,
    planted: Mapping[str, Planted] | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    n_jobs: int = -1,
) -> pd.DataFrame:
    """Errors of each run: `estimator`, `recording` (seed), `repeat`, and ERRORS.

    Parameters
    ----------
    repeats
        Runs of each estimator on each recording; estimators that are not named are left out.
    reseed
        Number of the seeding of the estimators' streams.
    planted
        Faults planted in estimators, by name: a context in which the estimator is faulty.
    on_progress
        Called with the share of the recordings done.

    Returns
    -------
    pandas.DataFrame
        Also: `checksum`, the first digits of the recording's; `fingerprint`, a number that
        rounding hardly moves; and `status`, `ok` or the exception that ended the run.
    """
    from joblib import Parallel, delayed

    jobs = []
    for group, count in suite.counts.items():
        runs = [
            (entry, _experiment(suite, entry, repeats), (planted or {}).get(entry.name))
            for entry in suite.estimators
            if entry.recordings == group and entry.name in repeats
        ]
        if runs:
            jobs += [(suite.first_seed + i, runs, reseed) for i in range(count)]
    rows: list[dict[str, Any]] = []
    done = Parallel(n_jobs=n_jobs, return_as="generator")(
        delayed(_run_recording)(*job) for job in jobs
    )
    for i, part in enumerate(done, start=1):
        rows.extend(part)
        on_progress(i / len(jobs))
    return pd.DataFrame(rows)


def draw_run(suite: Suite, estimator: str, recording: int, path: Path) -> bool:
    """Draw the first run of an estimator over a recording of a suite; False if it fails."""
    (entry,) = suite.of([estimator]).estimators

    found: list[tuple[Recording, Estimate]] = []

    def keep(made: Recording, _: int, online: Estimate, revised: Estimate | None) -> None:
        found.append((made, revised if entry.revised and revised is not None else online))

    rows = evaluate(
        _experiment(suite, entry, {estimator: 1}).replaced(seed=recording, world_seed=recording),
        streams=partial(_stream, f"estimator/{estimator}", recording, 0),
        on_estimate=keep,
    )
    if found:
        save_figure(run_figure(found, estimator), path)
    return rows[0]["status"] != Outcome.FAILED


def command_of(suite: Suite, estimator: str, recording: int) -> str:
    """Return the command that runs one estimator over one recording of a suite, and draws it."""
    (entry,) = suite.of([estimator]).estimators
    overrides = [
        *suite.overrides[entry.recordings],
        f"estimator={entry.estimator}",
        *entry.overrides,
        f"seed={recording}",
        f"world_seed={recording}",
    ]
    return shlex.join(["estima", "run", *overrides])


def _experiment(suite: Suite, entry: Entry, repeats: Mapping[str, int]) -> Experiment:
    """An estimator over its recordings, whatever their seed."""
    overrides = [
        *suite.overrides[entry.recordings],
        f"estimator={entry.estimator}",
        *entry.overrides,
    ]
    return Experiment.compose(overrides).replaced(repeats=repeats[entry.name])


def _run_recording(
    seed: int, runs: Sequence[tuple[Entry, Experiment, Planted | None]], reseed: int
) -> list[dict[str, Any]]:
    """Rows of all runs over one recording."""
    rows = []
    recording = runs[0][1].replaced(seed=seed, world_seed=seed).recordings()
    origin = {"checksum": recording.checksum[:12], "fingerprint": fingerprint(recording)}
    for entry, experiment, planted in runs:
        for row in evaluate(
            experiment.replaced(seed=seed, world_seed=seed),
            lambda: recording,
            streams=partial(_stream, f"estimator/{entry.name}", seed, reseed),
            planted=None if planted is None else _plant(planted, seed, reseed),
        ):
            prefix = "revised_" if entry.revised else ""
            require(
                not entry.revised or row["status"] != Outcome.OK or "revised_ate_rmse_m" in row,
                f"{entry.name} has no finish; drop `revised` from the suite",
            )
            # a collision is no fault of the estimator
            at_fault = row["status"] == Outcome.FAILED and row["status_code"] != "recording"
            why = printable(f"{row['status_code']}: {row['status_detail']}") if at_fault else "ok"
            which = {"estimator": entry.name, "recording": seed, "repeat": row["repeat"]}
            errors = {name: row.get(prefix + name, math.nan) for name in ERRORS}
            rows.append({**which, **origin, **errors, "status": why})
    return rows


def _stream(axis: str, seed: int, reseed: int, repeat: int) -> np.random.Generator:
    return stream(seed, axis, repeat + _RESEEDED * reseed)


def _plant(
    planted: Planted, seed: int, reseed: int
) -> Callable[[Estimator, int], AbstractContextManager[object]]:
    return lambda estimator, repeat: planted(estimator, _stream("fault", seed, reseed, repeat))


def fingerprint(read: Team) -> float:
    """Sum of weighted means over each sensor's first field, and over the true positions.

    That of a team is the sum of its robots'.

    Machines that differ in the last bits make recordings with different checksums, but with
    fingerprints that agree to a millionth; those of different recordings do not.
    """
    return sum(map(_fingerprint, read.robots))


def _fingerprint(recording: Recording) -> float:
    first = [next(iter(log.values.values())) for log in recording.logs.values()]
    logs = [recording.wheels.position_m, *first]
    if recording.truth is not None:
        logs.append(recording.truth.poses[:, :2])
    total = 0.0
    for log in logs:
        values = np.asarray(log, np.float64).ravel()
        weights = 0.5 + np.mod(_GOLDEN * np.arange(1, len(values) + 1), 1.0)
        total += float(np.mean(weights * np.where(np.isfinite(values), np.abs(values), 0.0)))
    return total
