"""Methods that others submit: a folder with a program or a class, checked and scored alone.

The folder's submission.yaml names it. It is run in a process of its own, over drives through six
classes of world whose seeds are drawn by whoever judges, and published with the scores.
"""

import dataclasses
import functools
import hashlib
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field, Strict

from estimators.programs.external import ExternalOptions
from estimators.programs.offline import Offline
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
from experiments.sweeps.collect import with_answers
from sim.errors import InputError, naming, printable, require
from sim.files import write_text
from sim.options import build, options
from sim.yaml_file import read_yaml

BOARD = "board"  # column of the class of world
CLASSES = tuple(n for n in paths.option_names("study/board") if n != "drive")
_SEEDS = (10_000, 2**31)  # of hidden drives: none that anything here was tuned or judged on
_MOST_FILES, _MOST_BYTES = 10_000, 1 << 30
SHOWN = {  # columns of the table
    "answer_ate_rmse_m": "error, m",
    "answer_heading_rmse_rad": "heading, rad",
    "answer_nees_mean": "NEES",
    "step_time_us": "time a step, us",
}
_BUILD_S, _TAIL = 600.0, 300  # longest time of a build; characters of what it said that are shown
_LIMITS = {  # longest times that a submission may ask for, s
    **{name: getattr(ExternalOptions, name) for name in ("start_s", "step_s", "finish_s")},
    "limit_s": Offline.limit_s,
}
_Words = Annotated[tuple[str, ...], Strict(False), "a list of texts"]
_WORD = "one word of letters, digits, _ and -, a letter first"


_SPDX = r"^[A-Za-z0-9.+-]+( (AND|OR|WITH) [A-Za-z0-9.+-]+)*$"
_URL = r"^((https?|ssh|git)://|git@)[!-~]+$"


@options("submission")
class Submission:
    """What a folder's submission.yaml says."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,60}$"), _WORD]
    """What its rows are called."""
    license: Annotated[str, Field(pattern=_SPDX), "an SPDX identifier, such as MIT"]
    """Its licence, as SPDX names it, such as MIT."""
    address: Annotated[str, Field(pattern=_URL), "an address such as https://example.org/mine"]
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
    def lost(self) -> pd.DataFrame:
        """Rows of the drives on which it failed."""
        if not len(self.rows):
            return self.rows
        own = self.rows["choice.estimator"] == self.submission.name
        return self.rows[own & (self.rows[STATUS[0]] == Outcome.FAILED)]

    @property
    def n_lost(self) -> int:
        """Drives on which it failed."""
        return len(self.lost)


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
        In each class of world; none are driven if a check fails.
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
    _check_out(out, submission)
    first = secrets.choice(range(*_SEEDS)) if seed is None else seed
    digest = _digest(folder)
    out = out.absolute()
    with _copy(folder) as place, _importable(place):
        if submission.build:
            show(f"building: {printable(' '.join(submission.build))}")
            _build(folder, place, submission.build)
        settings = _settings(folder, place, submission)
        show("checking")
        checks = _checks(settings, submission)
        sound = all(check.passed for check in checks)
        seeds = range(first, first + (drives if sound else 0))
        rows = _rows(settings, submission, seeds).replace(f"{place}{os.sep}", "", regex=True)
    score = Score(submission, checks, rows)
    _write(score, out, {"files": digest, "first_seed": first, "drives": drives})
    return score, out


def _check_out(out: Path, submission: Submission) -> None:
    """Refuse what is not a folder, or holds the scores of somebody else's method."""
    require(not out.exists() or out.is_dir(), f"{out}: not a folder; name one with -o")
    said = out / "submission.json"
    if not said.exists():
        return
    with suppress(ValueError, OSError, AttributeError):
        address = json.loads(said.read_text()).get("address")
        require(
            address == submission.address,
            f"{paths.short(out)} holds the scores of {printable(str(address))}; name another "
            "folder with -o",
        )


def read_submission(folder: Path) -> Submission:
    """What a folder's submission.yaml says.

    Raises
    ------
    InputError
        Naming the key.
    """
    require(not folder.is_file(), f"{folder}: a file; name its folder")
    require(folder.is_dir(), f"{folder}: no such folder; docs/do/submit.md says what it holds")
    path = folder / "submission.yaml"
    require(path.exists(), f"{folder}: no submission.yaml; docs/do/submit.md has one to copy")
    content = read_yaml(path)
    with naming(path):
        submission = build(Submission, {} if content is None else content, "submission")
        ours = paths.option_names("estimator")
        require(submission.name not in ours, f"name: {submission.name} is a method of ours")
    return submission


@contextmanager
def _copy(folder: Path) -> Iterator[Path]:
    """A copy of the folder, in which it is built and run."""
    with tempfile.TemporaryDirectory(prefix="submission-") as temporary:
        place = Path(temporary).resolve() / "folder"
        shutil.copytree(folder, place, symlinks=True)
        with chdir(place):
            yield place


def _build(folder: Path, place: Path, words: Sequence[str]) -> None:
    """Run the build in the copy; what it leaves running is ended."""
    with tempfile.TemporaryFile() as said:
        try:
            process = subprocess.Popen(
                _with_files(place, words), cwd=place, stdin=subprocess.DEVNULL, stdout=said,
                stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise InputError(f"{folder}: its build cannot be run ({error})") from error
        try:
            code: int | str = process.wait(_BUILD_S)
        except subprocess.TimeoutExpired:
            code = f"none within {_BUILD_S:.0f} s"
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        said.seek(max(said.seek(0, os.SEEK_END) - _TAIL, 0))
        last = " ".join(said.read().decode(errors="replace").split())
    require(code == 0, f"{folder}: its build failed, code {code}: {printable(last) or 'no output'}")


class _Blind:
    """Finds no module: this process imports nothing from the folder, its children do."""

    def find_spec(self, *_: object) -> None:
        """Find nothing."""


@contextmanager
def _importable(place: Path) -> Iterator[None]:
    """Let child processes find the folder's modules, after all others."""
    path = str(place)
    sys.path.append(path)
    sys.path_importer_cache[path] = _Blind()
    try:
        yield
    finally:
        sys.path.remove(path)
        sys.path_importer_cache.pop(path, None)


def _with_files(place: Path, words: Sequence[str]) -> list[str]:
    """Words of a command, those that are files of the folder by their full names."""

    def full(word: str) -> str:
        with suppress(OSError, ValueError):  # too long for a name
            if (place / word).is_file():
                return str(place / word)
        return word

    return [full(word) for word in words]


def _settings(folder: Path, place: Path, submission: Submission) -> dict[str, Any]:
    """Settings of the estimator, with the folder's files by their full names."""
    settings, file = dict(submission.estimator), folder / "submission.yaml"
    require("_target_" in settings, f"{file}: estimator._target_ is missing")
    require(
        "${" not in json.dumps(settings, default=str),
        f"{file}: estimator: ${{...}} is not resolved in a submission; write the value",
    )
    for name, most_s in _LIMITS.items():
        asked = settings.get(name, 0.0)
        require(
            isinstance(asked, int | float) and asked <= most_s,
            f"{file}: estimator.{name} is at most {most_s:g} s in a submission, got {asked!r}",
        )
    command = settings.get("command")
    if command is not None:
        form = f"{file}: estimator.command must be a list such as [node, mine.js]"
        require(isinstance(command, list) and bool(command), form)
        for word in command:
            require(isinstance(word, str), f'{form}; got {word!r}: write it in quotes, "{word}"')
        settings["command"] = words = _with_files(place, command)
        is_own = words[0] != command[0]
        require(
            not is_own or os.access(words[0], os.X_OK),
            f"{file}: estimator.command: {command[0]} is not executable; chmod +x it, or name what "
            f"runs it, such as [python3, {command[0]}]",
        )
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
                drives = [o.with_values(seed=seed, world_seed=seed) for o in (own, baseline)]
                # in memory alone: a program could read the cache
                driven = functools.cache(drives[1].simulate_team)
                for drive in drives:
                    rows += [{BOARD: board, **row} for row in evaluate(drive, fetch=driven)]
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
    """A line a class of world: means over its drives, and the error over dead reckoning's.

    A class with a drive that failed has no means.
    """
    name, by = score.submission.name, [BOARD, "choice.estimator"]
    if not len(score.rows):
        return pd.DataFrame()
    rows = with_answers(score.rows, list(SHOWN))
    lost = score.lost[BOARD].value_counts()
    sound = rows[~rows[BOARD].isin(lost.index)]
    means = {n: averages(sound, by, RECORDING, n)["value"].unstack() for n in SHOWN if n in sound}
    table = pd.DataFrame(index=pd.Index(sorted(set(rows[BOARD])), name=BOARD))
    for column, title in SHOWN.items():
        table[title] = means[column].get(name, np.nan) if column in means else np.nan
    errors = means.get("answer_ate_rmse_m", pd.DataFrame())
    own, reckoned = (errors.get(one, np.nan) for one in (name, "odometry"))
    table["error over odometry's"] = own / reckoned
    table["failed"] = [int(lost.get(board, 0)) for board in table.index]
    return table.reset_index()


def failures(score: Score) -> list[str]:
    """Why drives failed: a line a cause, with the command that repeats its first."""
    return [
        f"{pluralize(len(part), 'drive')} failed: {printable(str(cause))} (first: "
        f"{part[BOARD].iloc[0]}, seed {part['seed'].iloc[0]})"
        for cause, part in score.lost.groupby(STATUS[2], sort=False)
    ]


def summary(score: Score) -> str:
    """The outcome, in a line."""
    n_failed = sum(not check.passed for check in score.checks)
    faults = [pluralize(n, what) for n, what in ((n_failed, "check"), (score.n_lost, "drive")) if n]
    fault = f"{' and '.join(faults)} failed"
    undriven = "; no drives, as the checks come first" if n_failed and not len(score.rows) else ""
    return f"{score.submission.name}: {'ok' if score.passed else fault + undriven}"
