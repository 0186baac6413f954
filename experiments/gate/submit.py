"""Methods that others submit: a folder with a program or a class, checked and scored alone.

The folder's submission.yaml names it. It is run in a process of its own, over drives through six
classes of world whose seeds are drawn by whoever judges, and published with the scores.
"""

import dataclasses
import hashlib
import json
import secrets
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field, Strict

from estimators.programs.program import ProgramError
from experiments.gate.conform import CheckResult, check_estimator, example
from experiments.runs import paths
from experiments.runs.columns import STATUS
from experiments.runs.console import pluralize, progress, show
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Row
from experiments.runs.schema import is_ours
from experiments.runs.version import code_version, describe_machine
from experiments.sweeps.averages import RECORDING, averages
from sim.errors import InputError, naming, printable, require
from sim.files import write_text
from sim.options import build, options
from sim.yaml_file import read_yaml

BOARD = "board"  # column of the class of world
CLASSES = tuple(n for n in paths.option_names("study/board") if n != "drive")
_SEEDS = (10_000, 2**31)  # of hidden drives: none that anything here was tuned or judged on
_MOST_FILES, _MOST_BYTES = 10_000, 1 << 30
SHOWN = {  # columns of the table
    "ate_rmse_m": "error, m",
    "heading_rmse_rad": "heading, rad",
    "nees_mean": "NEES",
    "step_time_us": "time a step, us",
}
_Words = Annotated[tuple[str, ...], Strict(False), "a list of texts"]


@options("submission")
class Submission:
    """What a folder's submission.yaml says."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][\w-]{0,60}$"), "one word"]
    """What its rows are called."""
    license: Annotated[str, Field(min_length=1)]
    """Its licence, as SPDX names it, such as MIT."""
    address: Annotated[str, Field(min_length=1)]
    """Where the source can be had."""
    estimator: dict[str, Any]
    """Its `_target_` and options, as in conf/estimator; file names are those of the folder."""
    build: _Words = ()
    """Command that makes it, run in the folder, such as [g++, -O2, -o, mine, mine.cpp]."""
    map: Literal["none", "world"] = "none"
    """Whether it is given the map: `world`, or `none`."""
    about: str = ""
    """The method in a sentence."""


@dataclasses.dataclass(frozen=True)
class Score:
    """What a check of a submission found.

    Attributes
    ----------
    checks
        Of `estima conform`.
    rows
        A row a drive and method; `board` says in which class of world.
    """

    submission: Submission
    checks: list[CheckResult]
    rows: pd.DataFrame

    @property
    def passed(self) -> bool:
        """Whether it passed all checks and no drive failed."""
        return all(check.passed for check in self.checks) and self.n_lost == 0

    @property
    def n_lost(self) -> int:
        """Drives on which it failed."""
        own = self.rows[self.rows["choice.estimator"] == self.submission.name]
        return int((own[STATUS[0]] == Outcome.FAILED).sum())


def check_submission(
    folder: Path, out: Path | None = None, *, drives: int, seed: int | None = None
) -> tuple[Score, Path]:
    """Build a submission, check it, score it on hidden drives beside dead reckoning, write it all.

    Parameters
    ----------
    folder
        With submission.yaml. Its program runs with the rights of whoever calls this.
    out
        Folder of rows.csv and submission.json; by default results/submissions/NAME.
    drives
        In each class of world.
    seed
        Of the first drive; drawn at random by default.

    Returns
    -------
    score, out
        The score, and the folder that was written.

    Raises
    ------
    InputError
        If the folder is not a submission, or it cannot be built.
    """
    submission = read_submission(folder)
    out = out or paths.results() / "submissions" / submission.name
    require(not out.exists() or out.is_dir(), f"{out}: not a folder; name one with -o")
    first = secrets.choice(range(*_SEEDS)) if seed is None else seed
    digest = _digest(folder)
    if submission.build:
        show(f"building: {printable(' '.join(submission.build))}")
        _build(folder, submission.build)
    with _importable(folder):
        settings = _settings(folder, submission)
        checks = _checks(settings, submission)
        rows = _rows(settings, submission, range(first, first + drives))
    score = Score(submission, checks, rows)
    _write(score, out, {"files": digest, "first_seed": first, "drives": drives})
    return score, out


def read_submission(folder: Path) -> Submission:
    """What a folder's submission.yaml says.

    Raises
    ------
    InputError
        Naming the key.
    """
    require(folder.is_dir(), f"{folder}: no such folder; docs/do/submit.md says what it holds")
    path = folder / "submission.yaml"
    require(path.exists(), f"{folder}: no submission.yaml; docs/do/submit.md has one to copy")
    content = read_yaml(path)
    with naming(path):
        submission = build(Submission, {} if content is None else content, "submission")
        ours = paths.option_names("estimator")
        require(submission.name not in ours, f"name: {submission.name} is a method of ours")
    return submission


def _build(folder: Path, words: Sequence[str]) -> None:
    try:
        subprocess.run(words, cwd=folder, check=True, capture_output=True, timeout=600.0)
    except subprocess.CalledProcessError as error:
        said = " ".join(error.stderr.decode(errors="replace").split())[:300]
        raise InputError(f"{folder}: its build failed: {printable(said)}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"{folder}: its build cannot be run ({error})") from error


@contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """Let the child process find the folder's modules."""
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))


def _settings(folder: Path, submission: Submission) -> dict[str, Any]:
    """Settings of the estimator, with the folder's files by their full names."""
    settings = dict(submission.estimator)
    require("_target_" in settings, f"{folder}: estimator._target_ is missing")
    command = settings.get("command")
    if command is not None:
        require(
            isinstance(command, list) and command and all(isinstance(w, str) for w in command),
            f"{folder}: estimator.command must be a list such as [node, mine.js]",
        )
        files = [folder.resolve() / word for word in command]
        settings["command"] = [
            str(f) if f.is_file() else w for f, w in zip(files, command, strict=True)
        ]
    return settings


def _experiment(settings: dict[str, Any], submission: Submission, board: str) -> Experiment:
    """Its drives of a class; a class of Python runs in a process of its own."""
    overrides = [f"study=board/{board}", f"prior.map={submission.map}"]
    experiment = Experiment.compose(overrides)
    return dataclasses.replace(
        experiment.with_values(estimator=settings, isolated=not is_ours(settings)),
        choices={**experiment.choices, "estimator": submission.name},
    )


def _checks(settings: dict[str, Any], submission: Submission) -> list[CheckResult]:
    experiment = _experiment(settings, submission, CLASSES[0])
    recording, prior = example()
    prior = prior if submission.map == "world" else dataclasses.replace(prior, map=None)
    try:
        experiment.estimator()
        return check_estimator(experiment.estimator, recording, prior, n_frames=30)
    except ProgramError as error:
        return [CheckResult("runs", False, printable(str(error)))]


def _rows(settings: dict[str, Any], submission: Submission, seeds: range) -> pd.DataFrame:
    """A row a drive, of the submission and of dead reckoning."""
    rows: list[Row] = []
    total = len(CLASSES) * len(seeds)
    with progress("drives", float(total)) as on_progress:
        for board in CLASSES:
            own = _experiment(settings, submission, board)
            baseline = Experiment.compose([f"study=board/{board}", "estimator=odometry"])
            for seed in seeds:
                for one in (own, baseline):
                    drive = one.with_values(seed=seed, world_seed=seed)
                    rows += [{BOARD: board, **row} for row in evaluate(drive)]
                on_progress(len(rows) / 2)
    return pd.DataFrame(rows)


def _digest(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of the folder, as it was handed in."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink())
    size = sum(p.stat().st_size for p in files)
    require(
        len(files) <= _MOST_FILES and size <= _MOST_BYTES,
        f"{folder}: {len(files)} files of {size} bytes; a submission has at most {_MOST_FILES} of "
        f"{_MOST_BYTES}: leave out what it can download or build",
    )
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def _write(score: Score, out: Path, origin: dict[str, Any]) -> None:
    """Write the rows, and what makes them again."""
    said = {
        **dataclasses.asdict(score.submission),
        **origin,
        "passed": score.passed,
        "checks": [dataclasses.asdict(check) for check in score.checks],
        "code_version": code_version(),
        "machine": describe_machine(),
    }
    write_text(out / "rows.csv", score.rows.to_csv(index=False))
    write_text(out / "submission.json", json.dumps(said, indent=2) + "\n")


def table_of(score: Score) -> pd.DataFrame:
    """A line a class of world: means over its drives, and the error over dead reckoning's."""
    sound = score.rows[score.rows[STATUS[0]] != Outcome.FAILED]
    by = [BOARD, "choice.estimator"]
    means = {n: averages(sound, by, RECORDING, n)["value"].unstack() for n in SHOWN if n in sound}
    own = {c: means[n].get(score.submission.name) for n, c in SHOWN.items() if n in means}
    errors = means["ate_rmse_m"]
    ratio = errors.get(score.submission.name, np.nan * errors["odometry"]) / errors["odometry"]
    return pd.DataFrame({**own, "error over odometry's": ratio}).reset_index()


def summary(score: Score) -> str:
    """The outcome, in a line."""
    n_failed = sum(not check.passed for check in score.checks)
    fault = f"{pluralize(n_failed, 'check')} and {pluralize(score.n_lost, 'drive')} failed"
    return f"{score.submission.name}: {'ok' if score.passed else fault}"
