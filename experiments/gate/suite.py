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
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from pydantic import Field, Strict

from estimators.base import Estimate, Estimator
from experiments.runs import paths
from experiments.runs.compose import searched
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome
from experiments.runs.seeds import stream
from experiments.sweeps.commands import config_dir_option
from experiments.viewing.run_figure import run_figure
from experiments.viewing.style import save_figure
from sim.errors import InputError, printable, require
from sim.options import build, options
from sim.recording import Recording
from sim.team import Team
from sim.yaml_file import read_yaml

ERRORS = ("ate_rmse_m", "ate_aligned_rmse_m", "heading_rmse_rad")
_RESEEDED = 1000  # streams of one seeding; repeats of the next start beyond them
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


_Overrides = Annotated[tuple[str, ...], Strict(False), "a list of texts"]
_Repeats = Annotated[int, Field(ge=1, le=_RESEEDED)]


@options("group")
class _Group:
    """Recordings of a suite: how many, and the Hydra overrides that make them."""

    count: Annotated[int, Field(ge=2)]
    overrides: _Overrides


@options("entry")
class Entry:
    """An estimator of a suite.

    Attributes
    ----------
    name
        What its rows and its streams are called.
    recordings
        Name of the group of recordings that it reads.
    repeats
        Runs with streams of their own on each recording: of the baseline, and of a check.
    estimator
        Option of conf/estimator; its name by default.
    overrides
        Hydra overrides beside those of the recordings.
    revised
        Whether the trajectory of `finish` is judged, and not the online one.
    elsewhere
        Whether its trajectories are made elsewhere, and checked as a candidate's.
    """

    name: str
    recordings: str
    repeats: Annotated[
        tuple[_Repeats, _Repeats], Strict(False), f"two whole numbers from 1 to {_RESEEDED}"
    ]
    estimator: str = ""
    overrides: _Overrides = ()
    revised: bool = False
    elsewhere: bool = False

    def __post_init__(self) -> None:
        require(
            not (self.elsewhere and (self.estimator or self.overrides)),
            "entry.elsewhere: what is made elsewhere has neither estimator nor overrides here",
        )


@options("suite")
class _File:
    """A suite's YAML."""

    first_seed: Annotated[int, Field(ge=0)]
    recordings: dict[str, Any]
    estimators: Annotated[
        dict[str, Any], Field(min_length=1), "a mapping of names to entries, at least one"
    ]


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
    source
        The file; None of the package's own.
    config_dir
        A further folder of options, which the user names.
    """

    first_seed: int
    counts: Mapping[str, int]
    overrides: Mapping[str, tuple[str, ...]]
    estimators: tuple[Entry, ...]
    source: Path | None = None
    config_dir: Path | None = None

    def compose(self, overrides: Sequence[str]) -> Experiment:
        """Compose the experiment of overrides that it holds."""
        words = searched(self.config_dir)
        if self.source is None:
            return Experiment.compose([*words, *overrides])
        return Experiment.compose(words, data=overrides, source=self.source)

    def cut(self, share: float) -> Suite:
        """Return the same suite with this share of its recordings."""
        counts = {group: round(share * n) for group, n in self.counts.items()}
        return dataclasses.replace(self, counts=counts)

    def select(self, names: Sequence[str]) -> Suite:
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
        lacking = f"no estimator of {names} is marked `elsewhere: true` in the suite"
        candidate = f"{names}: made elsewhere; check a candidate's trajectories"
        require(chosen, lacking if elsewhere else candidate)
        return dataclasses.replace(self, estimators=chosen)


Planted = Callable[[Estimator, np.random.Generator], AbstractContextManager[object]]


def read_suite(path: Path, config_dir: Path | None = None) -> Suite:
    """Read a suite.

    Raises
    ------
    InputError
        If the file cannot be read, or a key is missing, unknown or of the wrong kind.
    """
    content = read_yaml(path)
    try:
        suite = _suite(build(_File, content, "suite"))
    except InputError as error:
        raise InputError(f"{path}: {error}; conf/suite/check.yaml is an example") from error
    own = path.resolve().is_relative_to(paths.CONF.resolve())
    return dataclasses.replace(suite, source=None if own else path, config_dir=config_dir)


def _suite(file: _File) -> Suite:
    groups = {
        name: build(_Group, settings, f"recordings.{name}")
        for name, settings in file.recordings.items()
    }
    entries = []
    for name, settings in file.estimators.items():
        where = f"estimators.{name}"
        require(isinstance(settings, Mapping), f"{where} must be a mapping, got {settings!r}")
        entry = build(Entry, {**settings, "name": name}, where)
        known = ", ".join(groups)
        require(
            entry.recordings in groups, f"{where}.recordings={entry.recordings!r}; known: {known}"
        )
        runs = "" if entry.elsewhere else entry.estimator or name
        entries.append(dataclasses.replace(entry, estimator=runs))
    return Suite(
        file.first_seed,
        {name: group.count for name, group in groups.items()},
        {name: group.overrides for name, group in groups.items()},
        tuple(entries),
    )


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
    jobs = []
    for group, count in suite.counts.items():
        runs = [
            (
                entry,
                suite.compose(overrides_of(suite, entry)).with_values(repeats=repeats[entry.name]),
                (planted or {}).get(entry.name),
            )
            for entry in suite.estimators
            if entry.recordings == group and entry.name in repeats
        ]
        if runs:
            jobs += [(suite.first_seed + i, runs, reseed) for i in range(count)]
    rows: list[dict[str, Any]] = []
    parts = Parallel(n_jobs=n_jobs, return_as="generator")(
        delayed(_run_recording)(*job) for job in jobs
    )
    for done, part in enumerate(parts, start=1):
        rows += part
        on_progress(done / len(jobs))
    return pd.DataFrame(rows)


def draw_run(suite: Suite, estimator: str, recording: int, path: Path) -> bool:
    """Draw the first run of an estimator over a recording of a suite; False if it fails."""
    (entry,) = suite.select([estimator]).estimators
    estimates: list[tuple[Recording, Estimate]] = []

    def keep(read: Recording, _: int, online: Estimate, revised: Estimate | None) -> None:
        estimates.append((read, revised if entry.revised and revised is not None else online))

    (row, *_) = evaluate(
        suite.compose(overrides_of(suite, entry, recording)).with_values(repeats=1),
        streams=partial(_stream, f"estimator/{estimator}", recording, 0),
        on_estimate=keep,
    )
    if estimates:
        save_figure(run_figure(estimates, estimator), path)
    return row["status"] != Outcome.FAILED


def command_of(suite: Suite, estimator: str, recording: int) -> str:
    """Return the command that runs one estimator over one recording of a suite, and draws it."""
    (entry,) = suite.select([estimator]).estimators
    return shlex.join(
        [
            "estima",
            "run",
            *overrides_of(suite, entry, recording),
            *config_dir_option(suite.config_dir),
        ]
    )


def overrides_of(suite: Suite, entry: Entry, seed: int | None = None) -> list[str]:
    """Overrides of an estimator over its recordings, or over the one of a seed."""
    seeds = [] if seed is None else [f"seed={seed}", f"world_seed={seed}"]
    of_group = suite.overrides[entry.recordings]
    return [*of_group, f"estimator={entry.estimator}", *entry.overrides, *seeds]


def _run_recording(
    seed: int, runs: Sequence[tuple[Entry, Experiment, Planted | None]], reseed: int
) -> list[dict[str, Any]]:
    """Rows of all runs over one recording."""
    rows = []
    recording = runs[0][1].with_values(seed=seed, world_seed=seed).recordings()
    origin = {"checksum": recording.checksum[:12], "fingerprint": fingerprint(recording)}
    for entry, experiment, planted in runs:
        for row in evaluate(
            experiment.with_values(seed=seed, world_seed=seed),
            lambda: recording,
            streams=partial(_stream, f"estimator/{entry.name}", seed, reseed),
            planted=planted and partial(_plant, planted, seed, reseed),
        ):
            prefix = "revised_" if entry.revised else ""
            require(
                not entry.revised or row["status"] != Outcome.OK or "revised_ate_rmse_m" in row,
                f"{entry.name} has no finish; drop `revised` from the suite",
            )
            # the estimator is not to blame for a collision
            at_fault = row["status"] == Outcome.FAILED and row["status_code"] != "recording"
            why = printable(f"{row['status_code']}: {row['status_detail']}") if at_fault else "ok"
            which = {"estimator": entry.name, "recording": seed, "repeat": row["repeat"]}
            errors = {name: row.get(prefix + name, math.nan) for name in ERRORS}
            rows.append({**which, **origin, **errors, "status": why})
    return rows


def _stream(axis: str, seed: int, reseed: int, repeat: int) -> np.random.Generator:
    return stream(seed, axis, repeat + _RESEEDED * reseed)


def _plant(
    planted: Planted, seed: int, reseed: int, estimator: Estimator, repeat: int
) -> AbstractContextManager[object]:
    return planted(estimator, _stream("fault", seed, reseed, repeat))


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
