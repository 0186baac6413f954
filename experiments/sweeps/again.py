"""A run of a sweep made again, from the row that it left."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.errors import HydraException, MissingConfigException

from experiments.runs.columns import REPEAT, is_setting
from experiments.runs.compose import searched
from experiments.runs.experiment import Experiment
from experiments.runs.schema import Config
from experiments.runs.store import read_runs
from experiments.runs.targets import checked
from experiments.runs.team import recorded
from experiments.sweeps.collect import commands, folder_of
from sim.errors import InputError, require
from sim.recording import Recording
from sim.team import Team

_SHORT = 10  # digits of a key that tell tens of thousands of runs apart


@dataclass(frozen=True)
class Again:
    """An experiment of a sweep, which of its repeats, and the checksum of its recording."""

    experiment: Experiment
    repeat: int
    checksum: str

    def recording(self) -> Recording | Team:
        """What the run read.

        Raises
        ------
        InputError
            If it is no longer the same.
        """
        read = recorded(self.experiment)
        require(read.checksum == self.checksum, "the recording of the run is not what it was")
        return read


def short_key(row: pd.Series[Any]) -> str:
    """What a run of a sweep is called: the first digits of its key, and its repeat."""
    repeat = int(row[REPEAT])
    return f"{row['run_key'][:_SHORT]}" + (f".{repeat}" if repeat else "")


def row_of(word: str) -> pd.Series[Any] | None:
    """Row of a run that is called NAME/KEY or NAME/KEY.REPEAT; None if there is no sweep NAME.

    Raises
    ------
    InputError
        If the sweep has no such run, or several whose keys begin so.
    """
    path = Path(word)
    try:
        rows = read_runs(folder_of(str(path.parent)))
    except InputError:
        return None
    key, _, repeat = path.name.partition(".")
    if not key or not {"run_key", REPEAT} <= set(rows):
        return None
    found = rows[
        rows["run_key"].str.startswith(key) & (rows[REPEAT].astype(str) == (repeat or "0"))
    ]
    require(len(found) > 0, f"{word}: the sweep {path.parent} has no such run")
    require(len(found) == 1, f"{word}: {len(found)} runs have keys that begin so; give more digits")
    return found.iloc[0]


def noted_config_dir(folder: Path) -> str | None:
    """The folder of options that the last sweep into a folder of rows named, if any did."""
    for command in reversed(commands(folder)):
        try:
            words = shlex.split(command)
        except ValueError:  # edited by hand
            continue
        if "--config-dir" in words[:-1]:
            return words[words.index("--config-dir") + 1]
    return None


def run_again(
    row: pd.Series[Any], config_dir: str | Path | None = None, noted: str | None = None
) -> Again:
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
    chosen = {c.partition(".")[2]: v for c, v in settings.items() if c.startswith("choice.")}
    choices = [f"{group}={name}" for group, name in chosen.items() if isinstance(name, str)]
    if config_dir is None and noted is not None and Path(noted).is_dir():
        config_dir = noted
    try:
        base = Experiment.compose([*searched(config_dir), *choices])
    except MissingConfigException as error:
        was = f" (the sweep's was {noted})" if noted is not None else ""
        raise InputError(
            f"{error.missing_cfg_file} is no option here; add --config-dir with its folder{was}"
        ) from error
    except HydraException as error:
        raise InputError(f"{', '.join(choices)}: {str(error).splitlines()[0]}") from error
    config: Config = json.loads(json.dumps(base.config))
    defaults = base.labels("")
    for name in [*(n for n in defaults if n in settings), *settings]:
        value, default = settings[name], defaults.get(name)
        if not name.startswith("choice.") and (name in defaults or _known(value)):
            _set(config, name, _plain(value, default) if _known(value) else None)
    again = Experiment(config, base.choices)
    made = again.labels("")
    for name, value in settings.items():
        mine = made.get(name)
        require(
            str(mine) == str(value) or mine == value or not (_known(mine) or _known(value)),
            f"the run had {name}={value}, and would have {mine} if it was made again",
        )
    checked(config["estimator"], "estimator")  # without its module its version is another
    require(
        made["code_version"] == row["code_version"],
        f"the run is of another version of the code, {row['code_version']}; run the sweep again",
    )
    return Again(again, int(row[REPEAT]), str(row["recording_checksum"]))


def _known(value: Any) -> bool:
    return value is not None and not pd.isna(value)


def _plain(value: Any, default: Any) -> Any:
    """A setting as its configuration had it.

    Tables hold lists and very long numbers as texts, and whole numbers as floats where other runs
    have none.
    """
    value = value.item() if hasattr(value, "item") else value
    if isinstance(value, str) and value.startswith("["):
        return json.loads(value)
    return int(value) if isinstance(value, (str, float)) and type(default) is int else value


def _set(config: Config, name: str, value: Any) -> None:
    """Set a dotted key."""
    *groups, last = name.split(".")
    for group in groups:
        if not isinstance(config.get(group), dict):
            config[group] = {}
        config = config[group]
    config[last] = value
