"""What Hydra composes from files of options, which takes it 50 ms; kept while they are the same."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose
from omegaconf import DictConfig, OmegaConf

from experiments.runs import paths
from experiments.runs.dependencies.recorder import is_recording

State = tuple[Any, ...]


class FromFiles(NamedTuple):
    """A configuration as Hydra composes it.

    Attributes
    ----------
    cfg
        The configuration, without Hydra's own.
    choices
        Name of the chosen option of each group.
    params
        `hydra.sweeper.params` of a study's file.
    """

    cfg: DictConfig
    choices: Mapping[str, str]
    params: Mapping[str, str]


def compose_files(overrides: Sequence[str], state: State | None) -> FromFiles:
    """Compose a configuration; the caller may change it.

    While dependencies are recorded, the files are read each time, so that they are seen.

    Parameters
    ----------
    state
        Of the files, by `state_of_files`; None to read them in any case.
    """
    if state is None or is_recording():
        return _composed(tuple(overrides))
    kept = _kept(tuple(overrides), state)
    return kept._replace(cfg=kept.cfg.copy())


def state_of_files(places: Sequence[str]) -> State | None:
    """Names, times and sizes of the package's options and of those in further places.

    None where a place is not a folder.
    """
    if not all(place.startswith("file://") for place in places):
        return None
    folders = [paths.CONF, *(Path(place.removeprefix("file://")) for place in places)]
    files = [path for folder in folders for path in sorted(folder.rglob("*.yaml"))]
    states = ((str(path), path.stat()) for path in files)
    return tuple((name, s.st_mtime_ns, s.st_size, s.st_ino) for name, s in states)


def _composed(overrides: tuple[str, ...]) -> FromFiles:
    cfg = compose("config", overrides=list(overrides), return_hydra_config=True)
    choices, params = dict(cfg.hydra.runtime.choices), cfg.hydra.sweeper.get("params") or {}
    OmegaConf.set_struct(cfg, False)
    del cfg["hydra"]
    return FromFiles(cfg, choices, dict(params))


@functools.lru_cache(maxsize=256)
def _kept(overrides: tuple[str, ...], _state: State) -> FromFiles:
    return _composed(overrides)
