"""What a calibration leaves unexplained, drawn."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.calibration.from_log import Residuals
from experiments.calibration.slip import BLOCK_S
from experiments.viewing.style import BLACK, BLUE, subplots
from sim.arrays import Array


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
