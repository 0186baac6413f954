"""Calibrations of files: recordings, a sheet of end poses, a real log."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.calibration.calibrate import calibrate_recordings
from experiments.calibration.from_log import Residuals, calibrate_log
from experiments.calibration.result import CalibrationResult
from experiments.calibration.sheet import calibrate_sheet
from experiments.calibration.slip import BLOCK_S
from experiments.runs.calibration import write_calibration
from experiments.runs.compose import searched
from experiments.runs.console import read_log
from experiments.runs.experiment import Experiment
from experiments.viewing.style import BLACK, BLUE, save_figure, subplots
from sim.arrays import Array
from sim.errors import require
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
    found = calibrate_log(read_log(log, robot), until_s)
    intervals = {name: [x.low, x.high] for name, x in found.intervals.items()}
    write_calibration(out, found.calibration, intervals)
    save_figure(residual_figure(found.residuals), out.with_suffix(".png"))
    return f"{found.as_text()}\n{out}, {out.with_suffix('.png')}"


def residual_figure(left: Residuals) -> Figure:
    """Errors of the wheels over blocks in time, and those of the sensor by range and bearing."""
    page, axes = subplots(9.0, 5.6, 2, 2)
    seconds = left.block_stamps - left.block_stamps[0]
    over = f"over {BLOCK_S:g} s"
    _points(axes[0, 0], seconds, np.degrees(left.turn_rad), "time, s", f"turn {over}, deg")
    _points(axes[0, 1], seconds, 100.0 * left.forward_m, "time, s", f"advance {over}, cm")
    _points(axes[1, 0], left.range_m, 100.0 * left.range_error_m, "range, m", "range error, cm")
    if len(left.bearing_rad):
        bearing = np.degrees(left.bearing_rad)
        error = np.degrees(left.bearing_error_rad)
        _points(axes[1, 1], bearing, error, "bearing, deg", "bearing error, deg")
    else:
        axes[1, 1].set_axis_off()
    page.suptitle("what the calibration leaves: reference less calibrated log", fontsize="medium")
    return page


def _points(ax: Any, x: Array, y: Array, x_label: str, y_label: str) -> None:
    some = np.linspace(0, len(x) - 1, min(len(x), 4000)).astype(int) if len(x) else slice(0)
    ax.plot(x[some], y[some], ".", color=BLUE, ms=2.5, alpha=0.5)
    ax.axhline(0.0, color=BLACK, lw=0.6)
    ax.set(xlabel=x_label, ylabel=y_label)
    if not len(x):
        ax.set_axis_off()
