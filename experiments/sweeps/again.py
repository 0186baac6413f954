"""A run of a sweep made again, from the row that it left."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.errors import HydraException, MissingConfigException

from experiments.runs.columns import REPEAT, is_setting
from experiments.runs.compose import find_option, open_composer, searched
from experiments.runs.experiment import Experiment
from experiments.runs.schema import GROUPS
from experiments.runs.store import fresh_rows, read_runs
from experiments.sweeps.collect import folder_of
from experiments.sweeps.commands import noted_config_dir
from experiments.viewing.estimates import OnStep, with_estimates_by
from experiments.viewing.play import Showing, play
from experiments.viewing.playback import Playback
from sim.errors import InputError, require
from sim.team import Team

_SHORT = 10  # digits of a key that tell tens of thousands of runs apart


@dataclass(frozen=True)
class RecordedRun:
    """An experiment of a sweep, which of its repeats, and the checksum of its recording."""

    experiment: Experiment
    repeat: int
    checksum: str

    def recordings(self) -> Team:
        """What the run read.

        Raises
        ------
        InputError
            If it is no longer the same.
        """
        read = self.experiment.recordings()
        require(read.checksum == self.checksum, "the run's recording has changed")
        return read


def short_key(row: pd.Series[Any]) -> str:
    """What a run of a sweep is called: the first digits of its key, and its repeat."""
    repeat = int(row[REPEAT])
    return f"{row['run_key'][:_SHORT]}" + (f".{repeat}" if repeat else "")


def row_of(word: str) -> pd.Series[Any] | None:
    """Row of a run that is called NAME/KEY or NAME/KEY.REPEAT; None without a sweep NAME.

    Raises
    ------
    InputError
        If the sweep has no such run, or several whose keys begin so; or if code or files that it
        depends on have changed.
    """
    path = Path(word)
    try:
        folder = folder_of(str(path.parent))
        rows = read_runs(folder)
    except InputError:
        return None
    key, _, repeat = path.name.partition(".")
    if not key or not {"run_key", REPEAT} <= set(rows):
        return None
    same = rows["run_key"].str.startswith(key) & (rows[REPEAT].astype(str) == (repeat or "0"))
    require(same.any(), f"{word}: the sweep {path.parent} has no such run")
    same &= fresh_rows(rows, folder)
    require(same.any(), f"{word}: it comes from another version of the code; run the sweep again")
    require(same.sum() == 1, f"{word}: {same.sum()} runs have keys that begin so; give more digits")
    return rows[same].iloc[0]


def run_of_row(
    row: pd.Series[Any], config_dir: str | Path | None = None, noted: str | None = None
) -> RecordedRun:
    """The experiment that left a row.

    Parameters
    ----------
    config_dir
        A folder of further options.
    noted
        That of the sweep; it is taken where none is given, if it is there.

    Raises
    ------
    InputError
        If this code or the options here would make another run.
    """
    settings = {str(c): row[c] for c in row.index if is_setting(str(c)) and str(c) != "name"}
    source, user = f"the row of {row['run_key']}", searched(config_dir)
    if config_dir is None and noted is not None and Path(noted).is_dir():
        config_dir = noted
    choices = []
    for group in GROUPS:
        if isinstance(name := settings.get(f"choice.{group}"), str):
            require(re.fullmatch(r"\w[\w.-]*", name), f"{source}: choice.{group}={name}: no option")
            choices.append(f"{group}={find_option(group, name, config_dir)}")
    folders = [] if user else searched(config_dir)
    try:
        with open_composer(user, [*folders, *choices], source) as composer:
            base = Experiment(*composer.compose(composer.words).resolve())
    except MissingConfigException as error:
        was = f" (the sweep's was {noted})" if noted is not None else ""
        raise InputError(
            f"{error.missing_cfg_file} is not an option here; name its folder of options{was}"
        ) from error
    except HydraException as error:
        raise InputError(f"{', '.join(choices)}: {str(error).splitlines()[0]}") from error
    defaults, changed = base.labels(""), []
    for name in [*(n for n in defaults if n in settings), *settings]:
        value, default = settings[name], defaults.get(name)
        if not name.startswith("choice.") and (name in defaults or _known(value)):
            plain = _plain(value, default) if _known(value) else None
            changed.append((tuple(name.split(".")), plain))
    again = base.with_leaves(changed)
    composer.check_values(again.config)
    made = again.labels("")
    for name, value in settings.items():
        mine = made.get(name)
        require(
            str(mine) == str(value) or mine == value or not (_known(mine) or _known(value)),
            f"the run had {name}={value}, and would have {mine} if it was made again",
        )
    again.check_estimator()  # without its module its version is another
    return RecordedRun(again, int(row[REPEAT]), str(row["recording_checksum"]))


def draw_recorded_run(
    row: pd.Series[Any],
    how: Showing,
    called: str,
    config_dir: Path | None = None,
    folder: str | None = None,
) -> str:
    """Show a run of a sweep as it moves; see `viewing.play.play`.

    Parameters
    ----------
    called
        What the run is called, NAME/KEY.
    config_dir, folder
        A folder of further options, and that of the sweep's rows, by default that of NAME.
    """
    noted = noted_config_dir(folder_of(folder or str(Path(called).parent)))
    again = run_of_row(row, config_dir, noted)
    name = again.experiment.estimator_name

    def estimated(shown: Playback, on_step: OnStep) -> Playback:
        return with_estimates_by(shown, again.experiment, again.repeat, on_step)

    return play(again.recordings(), how, called, [name], estimated)


def _known(value: Any) -> bool:
    return value is not None and not pd.isna(value)


def _plain(value: Any, default: Any) -> Any:
    """A setting as its configuration had it.

    Tables hold lists and very long numbers as texts, and whole numbers as floats where other runs
    have none.
    """
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, str) and value.startswith("["):
        with suppress(ValueError, RecursionError):  # a text that only begins so
            return json.loads(value)
    return int(value) if isinstance(value, (str, float)) and type(default) is int else value
