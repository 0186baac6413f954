"""The Hydra application: one configuration -> rows.

`estima run` hands its arguments here. Rows go to results/runs/<name>/<key>.parquet, where the key
is the digest of the resolved configuration and of the code.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from estimators.base import Estimate, run
from experiments.build import (
    Config,
    check,
    default_cache,
    make_estimator,
    make_prior,
    make_recording,
)
from experiments.console import end, progress
from experiments.metrics import score
from experiments.seeds import stream
from experiments.table import Row, write_rows
from experiments.version import ROOT, code_version
from sim.errors import InputError
from sim.recording import Recording

RESULTS = ROOT / "results"
_NOT_IN_KEY = ("name", "picture", "recording")


class RunFailedError(Exception):
    """A run ended badly; its row says how."""


def run_key(config: Config, recording_checksum: str) -> str:
    """Digest of what decides a run's rows: configuration, recording, code."""
    settings = {key: value for key, value in config.items() if key not in _NOT_IN_KEY}
    text = json.dumps([settings, recording_checksum, code_version()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_configuration(config: Config, choices: dict[str, str]) -> tuple[list[Row], Path]:
    """Make the recording, run the estimator `repeats` times, write one row each.

    Parameters
    ----------
    config
        Resolved configuration, plain values.
    choices
        Name of the chosen option of each configuration group, for the rows.

    Returns
    -------
    tuple
        Rows, and the folder that holds them.
    """
    check(config)
    estimator = make_estimator(config)
    with progress("simulating, s") as on_progress:
        recording = make_recording(config, default_cache(), on_progress)
    prior = make_prior(config, recording)
    key = run_key(config, recording.checksum)
    folder = RESULTS / "runs" / config["name"]
    rows: list[Row] = []
    name = choices.get("estimator") or config["estimator"]["_target_"]
    for repeat in range(config["repeats"]):
        row = _labels(config, choices, recording, key, repeat)
        try:
            with progress(name, len(recording.frame_stamps)) as on_step:
                rng = stream(config["seed"], f"estimator/{name}", repeat)
                estimate = run(estimator, recording, prior, rng, config["keep"], on_step)
        except InputError:
            raise
        except Exception as error:
            rows.append({**row, "status": f"error: {type(error).__name__}: {error}"})
            write_rows(rows, folder / f"{key}.parquet")
            raise
        rows.append({**row, "status": _status(recording, estimate), **score(recording, estimate)})
        if repeat == 0 and config["picture"]:
            _show(recording, estimate, folder / key, name)
    write_rows(rows, folder / f"{key}.parquet")
    return rows, folder / key


def _labels(
    config: Config, choices: dict[str, str], recording: Recording, key: str, repeat: int
) -> Row:
    """What a row says of its origin: choices, every configuration key, versions, checksum."""
    kept = {k: v for k, v in config.items() if k not in ("keep", "picture")}
    return {
        **{f"choice.{group}": name for group, name in choices.items()},
        **_flat(kept),
        "repeat": repeat,
        "run_key": key,
        "code_version": code_version(),
        "recording_checksum": recording.checksum,
    }


def _flat(tree: Any, prefix: str = "") -> Row:
    """Flatten nested mappings to dotted keys; lists become their text."""
    flat: Row = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            flat.update(_flat(value, f"{name}."))
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
    from experiments.export import write_odometry_csv
    from experiments.figures.run import run_figure
    from experiments.figures.style import save_figure

    write_odometry_csv(estimate, folder / "estimate.csv")
    save_figure(run_figure(recording, estimate, name), folder / "run.png")


@hydra.main(version_base="1.3", config_path=str(ROOT / "conf"), config_name="config")
def application(cfg: DictConfig) -> None:
    """Run one job of Hydra's."""
    config: Config = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    runtime = HydraConfig.get()
    groups = ("world", "robot", "sensors", "route", "estimator")
    choices = {g: str(runtime.runtime.choices.get(g)) for g in groups}
    single = runtime.mode == RunMode.RUN
    config["picture"] = config["picture"] and single
    try:
        rows, folder = run_configuration(config, choices)
        if single:
            _print(rows, folder, config["picture"])
        bad = [row for row in rows if row["status"] != "ok"]
        if bad:
            raise RunFailedError(str(bad[0]["status"]))
    except (InputError, RunFailedError) as error:
        if not single:
            raise
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
    head = f"{first['choice.estimator']} in {first['choice.world']}, seed {first['seed']}"
    print(f"{head}: {first['status']}")
    for key, label, unit in _SHOWN:
        values = [float(v) for row in rows if isinstance(v := row.get(key), (int, float))]
        if values:
            mean = sum(values) / len(values)
            print(f"  {label:<30} {mean:10.4g} {unit}")
    for path in [folder.with_suffix(".parquet"), *([folder / "run.png"] if picture else [])]:
        print(f"  {_short(path)}")


def _short(path: Path) -> str:
    """The path as one would type it from here."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
