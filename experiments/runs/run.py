"""The Hydra application: one configuration -> rows.

`estima run` hands its arguments here. Rows go to results/runs/<name>/<key>.parquet, where the key
is the digest of the resolved configuration and of the code.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from estimators.base import Estimate, run
from experiments.evaluation.metrics import score
from experiments.runs.console import end, progress
from experiments.runs.experiment import (
    Config,
    check,
    default_cache,
    files_digest,
    make_estimator,
    make_prior,
    make_recording,
    recording_settings,
)
from experiments.runs.row import Row, write_rows
from experiments.runs.seeds import stream
from experiments.runs.version import ROOT, version_with
from sim.errors import InputError
from sim.recording import Recording

RESULTS = ROOT / "results"
_NOT_IN_KEY = ("name", "picture", "recording")
GROUPS = ("world", "robot", "sensors", "route", "estimator")
_FAILURES = ("error", "recording", "not finite")


class RunFailedError(Exception):
    """A run ended badly; its row says how."""


def failed(status: str) -> bool:
    """Whether a row's status tells of a failure; others only remark on what happened."""
    return status.startswith(_FAILURES)


def run_key(config: Config) -> str:
    """Digest of what decides a run's rows: configuration, recording, map, code."""
    settings = {key: value for key, value in config.items() if key not in _NOT_IN_KEY}
    known_map = files_digest(config["prior"].get("map"))
    parts = [settings, recording_settings(config), known_map, version_with(_targets(config))]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def _targets(tree: Any) -> set[str]:
    """Every `_target_` of the configuration."""
    if not isinstance(tree, dict):
        return set()
    here = {tree["_target_"]} if isinstance(tree.get("_target_"), str) else set()
    return here.union(*(_targets(value) for value in tree.values()))


def rows_folder(config: Config) -> Path:
    """Folder of the configuration's rows.

    Raises
    ------
    InputError
        If the name is not one word.
    """
    name = config["name"]
    if not (isinstance(name, str) and re.fullmatch(r"[\w.-]*\w", name)):
        raise InputError(
            f"name must be one word for a folder of results, such as slip_2, got {name!r}"
        )
    return RESULTS / "runs" / name


def run_configuration(
    config: Config,
    choices: dict[str, str],
    fetch: Callable[[Config], Recording] | None = None,
) -> tuple[list[Row], Path]:
    """Make the recording, run the estimator `repeats` times, write one row each.

    Parameters
    ----------
    config
        Resolved configuration, plain values.
    choices
        Name of the chosen option of each configuration group, for the rows.
    fetch
        Where the recording comes from; by default it is read, found in the cache or simulated.

    Returns
    -------
    tuple
        Rows, and the folder that holds them.
    """
    check(config)
    folder = rows_folder(config)
    estimator = make_estimator(config)
    recording = _fetch(config) if fetch is None else fetch(config)
    prior = make_prior(config, recording)
    key = run_key(config)
    rows: list[Row] = []
    name = choices.get("estimator") or config["estimator"]["_target_"]
    for repeat in range(config["repeats"]):
        row = labels(config, choices, recording.checksum, key, repeat)
        try:
            # in a sweep the runs are counted, and their steps are not
            shown = progress(name, len(recording.frame_stamps)) if fetch is None else None
            with shown or nullcontext() as on_step:
                rng = stream(config["seed"], f"estimator/{name}", repeat)
                estimate = run(estimator, recording, prior, rng, config["keep"], on_step)
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            rows.append({**row, "status": f"error: {type(error).__name__}: {error}"})
            write_rows(rows, folder / f"{key}.parquet")
            raise
        found = score(recording, estimate) | _revised_score(recording, estimator)
        rows.append({**row, "status": _status(recording, estimate), **found})
        if repeat == 0 and config["picture"]:
            _show(recording, estimate, folder / key, name)
    write_rows(rows, folder / f"{key}.parquet")
    return rows, folder / key


def _revised_score(recording: Recording, estimator: object) -> dict[str, float]:
    """Scores of the path that the estimator gives in the end, if it gives one."""
    finish = getattr(estimator, "finish", None)
    if finish is None:
        return {}
    found = score(recording, finish())
    return {f"revised_{k}": v for k, v in found.items() if k not in ("duration_s", "distance_m")}


def _fetch(config: Config) -> Recording:
    with progress("simulating, s") as on_progress:
        recording = make_recording(config, default_cache(), on_progress)
    made_with, believed = recording.config.get("robot"), config["robot"]
    if isinstance(config["recording"], str) and isinstance(made_with, dict):
        for key in ("kr", "kl"):
            if key in made_with and made_with[key] != believed[key]:
                print(
                    f"{config['recording']} was made with robot.{key}={made_with[key]:g}; "
                    f"{believed[key]:g} is believed unless robot.{key} or estimator.{key} is set",
                    file=sys.stderr,
                )
    return recording


def labels(config: Config, choices: dict[str, str], checksum: str, key: str, repeat: int) -> Row:
    """What a row says of its origin: choices, every configuration key, versions, checksum."""
    kept = {k: v for k, v in config.items() if k not in ("keep", "picture")}
    if config["recording"] is not None:  # it brings its own
        brought = ("world", "sensors", "route")
        choices = {group: name for group, name in choices.items() if group not in brought}
    return {
        **{f"choice.{group}": name for group, name in choices.items()},
        **_flat(kept),
        "repeat": repeat,
        "run_key": key,
        "code_version": version_with(_targets(config)),
        "recording_checksum": checksum,
    }


def _flat(tree: Any, prefix: str = "") -> Row:
    """Flatten nested mappings to dotted keys; lists become their text."""
    flat: Row = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            flat.update(_flat(value, f"{name}."))
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            flat[name] = str(value)  # wider than a column of a table
        elif value is None or isinstance(value, (bool, int, float, str)):
            flat[name] = value
        else:
            flat[name] = json.dumps(value)
    return flat


def _status(recording: Recording, estimate: Estimate) -> str:
    """`ok`, or what the recording or the estimator has to report."""
    if recording.status != "ok":
        return f"recording: {recording.status}"
    sound = np.isfinite(estimate.means).all(axis=1)
    sound &= np.isfinite(estimate.covariances).all(axis=(1, 2))
    if estimate.status == "ok" and not sound.all():
        return f"not finite at {estimate.stamps[np.argmin(sound)]:.2f} s"
    return estimate.status


def _show(recording: Recording, estimate: Estimate, folder: Path, name: str) -> None:
    """Write what one looks at after a single run: a picture and the trajectory."""
    from experiments.trajectories.odometry import write_odometry_csv
    from experiments.viewing.run_figure import run_figure
    from experiments.viewing.style import save_figure

    write_odometry_csv(estimate, folder / "estimate.csv")
    save_figure(run_figure(recording, estimate, name), folder / "run.png")


@hydra.main(version_base="1.3", config_path=str(ROOT / "conf"), config_name="config")
def application(cfg: DictConfig) -> None:
    """Run one configuration; sweeps are those of `experiments.sweeps.launch`."""
    config: Config = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    config.pop("sweeps")
    chosen = HydraConfig.get().runtime.choices
    try:
        rows, folder = run_configuration(config, {g: str(chosen.get(g)) for g in GROUPS})
        _print(rows, folder, config["picture"])
        for row in rows:
            if failed(str(row["status"])):
                raise RunFailedError(str(row["status"]))
    except (InputError, RunFailedError) as error:
        end(error)  # here, since Hydra would add a line of its own


_SHOWN = (
    ("distance_m", "travelled", "m"),
    ("ate_rmse_m", "position RMSE", "m"),
    ("heading_rmse_rad", "heading RMSE", "rad"),
    ("final_position_error_m", "final position error", "m"),
    ("nees_mean", "mean NEES (3 when consistent)", ""),
    ("step_time_us", "time per step", "us"),
)


def _print(rows: list[Row], folder: Path, picture: bool) -> None:
    first = rows[0]
    where = first.get("choice.world") or first.get("recording") or "a recording"
    print(f"{first['choice.estimator']} on {where}, seed {first['seed']}: {first['status']}")
    for key, label, unit in _SHOWN:
        values = [float(v) for row in rows if isinstance(v := row.get(key), (int, float))]
        if values:
            mean = sum(values) / len(values)
            print(f"  {label:<30} {mean:10.4g} {unit}")
    for path in [folder.with_suffix(".parquet"), *([folder / "run.png"] if picture else [])]:
        print(f"  {short(path)}")


def short(path: Path) -> str:
    """The path as one would type it from here."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
