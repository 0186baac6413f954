"""Calibrations of files: recordings, a sheet of end poses, a real log."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.calibration.calibrate import calibrate_recordings
from experiments.calibration.from_log import calibrate_log
from experiments.calibration.residual_figure import residual_figure
from experiments.calibration.result import CalibrationResult
from experiments.calibration.sheet import calibrate_sheet
from experiments.runs.calibration import write_calibration
from experiments.runs.compose import searched
from experiments.runs.experiment import Experiment
from experiments.viewing.style import save_figure
from sim.errors import require
from sim.formats.detect import read_any
from sim.recording import load

METHODS = ("wheel-truth", "end-poses")


def calibrate_files(files: Sequence[str], method: str, geometry: bool) -> CalibrationResult:
    """Calibrate from recordings' files, no two of which are the same; by one of `METHODS`."""
    loaded = [load(Path(file)) for file in files]
    first: dict[str, str] = {}
    for file, recording in zip(files, loaded, strict=True):
        same = first.get(recording.checksum)
        require(same is None, f"{file} is the same recording as {same}")
        first[recording.checksum] = file
    kind: Any = method.replace("-", "_")
    return calibrate_recordings(loaded, kind, geometry=geometry)


def calibrate_sheet_file(
    sheet: Path, overrides: Sequence[str], config_dir: Path | None, geometry: bool
) -> CalibrationResult:
    """Calibrate from a sheet of the robot that overrides choose; they may say nothing else."""
    for override in overrides:
        require(
            override.lstrip("+~").startswith(("robot=", "robot.")),
            f"{override}: with a sheet give the robot alone, such as robot=puzzlebot or "
            "robot.track_m=0.19",
        )
    robot = Experiment.compose([*searched(config_dir), *overrides]).robot()
    return calibrate_sheet(sheet, robot, np.random.default_rng(0), geometry=geometry)


def calibrate_log_file(
    log: Sequence[Path], out: Path, robot: int | None = None, until_s: float | None = None
) -> str:
    """Calibrate a real log, and write its YAML file and, beside it, a picture of the residuals.

    Parameters
    ----------
    robot
        Which robot of a log of several.
    until_s
        The log's first seconds are used; None: all of it.
    """
    require(log, "no log to calibrate; name one")
    require(out.suffix in (".yaml", ".yml"), f"{out}: a calibration is a .yaml file")
    found = calibrate_log(read_any(log, robot), until_s)
    intervals = {name: [x.low, x.high] for name, x in found.intervals.items()}
    write_calibration(out, found.calibration, intervals)
    save_figure(residual_figure(found.residuals), out.with_suffix(".png"))
    return f"{found.as_text()}\n{out}, {out.with_suffix('.png')}"
