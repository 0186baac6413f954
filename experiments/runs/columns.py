"""Columns of results: what a metric is called, its unit, and how tables and plots show it.

This is the one schema of rows: by its name, a column is a setting, a metric, a status or an origin.
"""

import dataclasses
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


class Average(StrEnum):
    """How runs are averaged; `sweeps.averages` does it."""

    ERROR = "error"  # repeats by their squares, recordings geometrically
    FACTOR = "factor"  # repeats arithmetically, recordings geometrically
    PLAIN = "plain"  # both arithmetically


@dataclass(frozen=True)
class Column:
    """A metric, as `evaluation.metrics.score` gives it.

    Attributes
    ----------
    label
        For the axes of plots.
    symbol
        Short, for the headings of wide tables.
    unit
        Empty if there is none.
    scale
        Axis on which it is drawn when it spans decades.
    better
        Which direction is better; None where neither is.
    average
        How runs are averaged.
    """

    label: str
    symbol: str
    unit: str = ""
    scale: Literal["linear", "log"] = "log"
    better: Literal["lower", "higher"] | None = "lower"
    average: Average = Average.ERROR


OF_THE_RUN = {
    "duration_s": Column("duration", "t", "s", "linear", None, Average.PLAIN),
    "distance_m": Column("distance travelled", "d", "m", "linear", None, Average.PLAIN),
    "cpu_time_us": Column("processor time per Frame", "cpu", "µs", average=Average.FACTOR),
    "stamps_scored": Column("stamps scored", "scored", "", "linear", None, Average.PLAIN),
    "stamps_left_out": Column(
        "stamps without a true pose", "left out", "", "linear", average=Average.PLAIN
    ),
    "longest_gap_s": Column(
        "longest time without a pose", "gap", "s", "linear", average=Average.PLAIN
    ),
    "dispersion_final_m": Column("final dispersion of the particles", "dispersion", "m"),
    "worst_robot_rmse_m": Column("position RMSE of a team's worst robot", "worst robot", "m"),
    "n_sightings": Column("sightings of robots", "sightings", "", "linear", None, Average.PLAIN),
}
_OF_THE_PATH = {
    "step_time_us": Column("time per step", "step", "µs", average=Average.FACTOR),
    "ate_rmse_m": Column("position RMSE", "ATE", "m"),
    "ate_mean_m": Column("mean position error", "mean error", "m"),
    "ate_aligned_rmse_m": Column("position RMSE after alignment", "ATE aligned", "m"),
    "heading_rmse_rad": Column("heading RMSE", "heading", "rad"),
    "heading_aligned_rmse_rad": Column("heading RMSE after alignment", "heading aligned", "rad"),
    "final_position_error_m": Column("final position error", "final ATE", "m"),
    "final_heading_error_rad": Column("final heading error", "final heading", "rad"),
    "nees_counted_share": Column(
        "share of stamps with a usable covariance",
        "NEES counted",
        "",
        "linear",
        "higher",
        Average.PLAIN,
    ),
    "ellipse_area_final_m2": Column(
        "area of the final 95 % ellipse", "ellipse", "m²", better=None, average=Average.FACTOR
    ),
    "final_in_ellipse": Column(
        "share of final positions in the 95 % ellipse",
        "in ellipse",
        "",
        "linear",
        None,
        Average.PLAIN,
    ),
    "nees_mean": Column(
        "mean NEES (3 when consistent)", "NEES", better=None, average=Average.PLAIN
    ),
    "rpe_1m_rmse_m": Column("position RMSE over 1 m", "RPE 1 m", "m"),
    "rpe_1m_heading_rmse_rad": Column("heading RMSE over 1 m", "RPE heading 1 m", "rad"),
    "rpe_10m_rmse_m": Column("position RMSE over 10 m", "RPE 10 m", "m"),
    "rpe_10m_heading_rmse_rad": Column("heading RMSE over 10 m", "RPE heading 10 m", "rad"),
}
_OF_THE_MAP = {
    "n_landmarks": Column("landmarks in the map", "N", "", "linear", None, Average.PLAIN),
    "map_rmse_m": Column("RMSE of the map's landmarks", "map", "m"),
    "map_aligned_rmse_m": Column("RMSE of the map's landmarks after alignment", "map aligned", "m"),
}


def _of(prefix: str, label: str, symbol: str) -> dict[str, Column]:
    """Return the columns of another path than the online one."""
    return {
        f"{prefix}{name}": dataclasses.replace(
            column, label=f"{column.label}{label}", symbol=f"{column.symbol}{symbol}"
        )
        for name, column in _OF_THE_PATH.items()
    }


REVISED, ANSWER = "revised_", "answer_"
RELATIVE = "ate_rmse_over_"  # and an estimator: of position errors, on the same recordings
PATH = "answer"  # which path the answer is: online or revised
# The answer of a method is its revised path if it has one, else the online one. Its columns are not
# in the files: tables and plots derive them (`sweeps.collect`).
COLUMNS = {
    **OF_THE_RUN,
    **_OF_THE_PATH,
    **_OF_THE_MAP,
    **_of(REVISED, ", revised path", " revised"),
    **_of(ANSWER, ", best answer", ""),
}
STATUS = ("status", "status_code", "status_detail")
REPEAT = "repeat"  # counts the runs of an estimator over one recording
ORIGIN = ("run_key", "code_version", "recording_checksum")
_SETTINGS = ("seed", "world_seed", "repeats", "recording", "calibration", "name")


def is_setting(name: str) -> bool:
    """Whether a column is a key of the configuration: a dotted one, or one at its top."""
    return "." in name or name in _SETTINGS


_UNITS = (
    *("m", "rad", "deg", "s", "ms", "us", "hz", "mps", "radps", "m2", "rad2", "px", "gib"),
    "percent",
)
_SPELT = {
    **{"us": "µs", "hz": "Hz", "mps": "m/s", "radps": "rad/s", "m2": "m²", "rad2": "rad²"},
    **{"gib": "GiB", "percent": "%"},
}
_ACRONYMS = ("ate", "ess", "nees", "rms", "rmse", "sd")
_IN_METRES = ("kr", "kl")  # of settings, whose names do not say it


def title(name: str, *, short: bool = False) -> str:
    """Label (or symbol) and unit of a metric, a setting, or any other column by its own words.

    Examples
    --------
    >>> title("ate_rmse_m"), title("choice.world"), title("sensors.stereo.max_distance_m")
    ('position RMSE, m', 'world', 'max distance (stereo), m')
    >>> title("omega_radps"), title("ate_rmse_m_office"), title("recall_at_1_percent")
    ('omega, rad/s', 'ATE (office), m', 'recall at 1, %')
    """
    if name in COLUMNS:
        column = COLUMNS[name]
        words, unit = column.symbol if short else column.label, column.unit
    elif name.startswith(RELATIVE):
        words, unit = f"ATE / that of {name.removeprefix(RELATIVE)}", ""
    elif "." in name:
        words, unit = _setting(name)
    else:
        metric = next((m for m in COLUMNS if name.startswith(f"{m}_")), "")
        if metric:
            of = name.removeprefix(f"{metric}_").replace("_", " ")
            words, unit = f"{COLUMNS[metric].symbol} ({of})", COLUMNS[metric].unit
        else:
            words, unit = _worded(name)
    return f"{words}, {unit}" if unit else words


def _setting(name: str) -> tuple[str, str]:
    """Words and unit of a dotted setting."""
    *_, group, last = name.split(".")
    words, unit = _worded(last)
    return (words if group == "choice" else f"{words} ({group})"), unit


def _worded(name: str) -> tuple[str, str]:
    """Words of a name, and the unit that it ends with."""
    words, _, unit = name.rpartition("_")
    if not words or unit not in _UNITS or (words[-1].isdigit() and unit == "m"):  # beyond_10_m
        words, unit = name, "m" if name in _IN_METRES else ""
    words = " ".join(w.upper() if w in _ACRONYMS else w for w in words.strip("_").split("_"))
    words = f"number of {words[2:]}" if words.startswith("n ") else words
    return words, _SPELT.get(unit, unit)


def average_of(name: str) -> Average:
    """How a column is averaged; one that is in no schema, arithmetically."""
    return COLUMNS[name].average if name in COLUMNS else Average.PLAIN


def as_text() -> str:
    """List the metrics: name, unit, which direction is better, what it is."""
    lines = [("column", "unit", "better", "")]
    lines += [(name, c.unit, c.better or "", c.label) for name, c in COLUMNS.items()]
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.ljust, cells, widths)).rstrip() for cells in lines)
