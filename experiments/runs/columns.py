"""Columns of results: what a metric is called, its unit, and how tables and plots show it.

This is the one schema of rows: by its name, a column is a setting, a metric, a status or an origin.
"""

import dataclasses
from collections.abc import Iterable
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
    "unused_share": Column(
        "share of scans or sightings not used", "unused", "", "linear", average=Average.PLAIN
    ),
    "closures": Column("closures of loops", "closures", "", "linear", None, Average.PLAIN),
    "false_closures": Column(
        "false closures", "false closures", "", "linear", average=Average.PLAIN
    ),
    "revisits": Column("key frames at old places", "revisits", "", "linear", None, Average.PLAIN),
    "revisits_closed": Column(
        "share of revisits that are closed",
        "revisits closed",
        "",
        "linear",
        "higher",
        Average.PLAIN,
    ),
    "n_relations": Column("relations", "relations", "", "linear", None, Average.PLAIN),
    "worst_robot_rmse_m": Column("position RMSE of a team's worst robot", "worst robot", "m"),
    "n_sightings": Column("sightings of robots", "sightings", "", "linear", None, Average.PLAIN),
}
_OF_THE_PATH = {
    "step_time_us": Column("time per step", "step", "µs", average=Average.FACTOR),
    "ate_rmse_m": Column("position RMSE", "RMSE", "m"),
    "ate_mean_m": Column("mean position error", "mean error", "m"),
    "ate_aligned_rmse_m": Column("position RMSE after alignment", "RMSE aligned", "m"),
    "heading_rmse_rad": Column("heading RMSE", "heading", "rad"),
    "bound_rmse_m": Column("least position RMSE of any method", "bound", "m", better=None),
    "bound_heading_rad": Column(
        "least heading RMSE of any method", "heading bound", "rad", better=None
    ),
    "heading_aligned_rmse_rad": Column("heading RMSE after alignment", "heading aligned", "rad"),
    "final_position_error_m": Column("final position error", "final error", "m"),
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
    "nees_median": Column(
        "median NEES (2.37 when consistent)", "NEES median", better=None, average=Average.PLAIN
    ),
    "relation_translation_m": Column("mean translation error of relations", "relations", "m"),
    "relation_rotation_rad": Column("mean rotation error of relations", "rotations", "rad"),
    **{
        f"inside_{percent}_share": Column(
            f"share of poses inside the {percent} % ellipsoid",
            f"inside {percent} %",
            "",
            "linear",
            None,
            Average.PLAIN,
        )
        for percent in (50, 90, 95)
    },
    "sharpness_m": Column("position RMSE by the own covariance", "own RMSE", "m", better=None),
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
_BOUNDS = {"ate_rmse_m": "bound_rmse_m", "heading_rmse_rad": "bound_heading_rad"}
PATH = "answer"  # which path the answer is: online or revised
# The answer of a method is its revised path if it has one, else the online one. Its columns are not
# in the files: tables and plots derive them (`sweeps.collect`).
COLUMNS = {
    **OF_THE_RUN,
    **_OF_THE_PATH,
    **_OF_THE_MAP,
    **_of(REVISED, ", revised path", " revised"),
    **_of(ANSWER, "", ""),
}
STATUS = ("status", "status_code", "status_detail")
REPEAT = "repeat"  # counts the runs of an estimator over one recording
ORIGIN = ("run_key", "code_version", "recording_checksum")
DEPENDENCIES = "dependencies"  # digest of what a row depends on; see `experiments.runs.store`
_SETTINGS = ("seed", "world_seed", "repeats", "isolated", "recording", "calibration", "name")


def bound_of(name: str) -> str:
    """Column of the least that an error can be; empty for one without."""
    own = name.removeprefix(REVISED).removeprefix(ANSWER)
    return name.removesuffix(own) + _BOUNDS[own] if own in _BOUNDS else ""


def is_setting(name: str) -> bool:
    """Whether a column is a key of the configuration: a dotted one, or one at its top."""
    return "." in name or name in _SETTINGS


_UNITS = {
    **{unit: unit for unit in ("m", "rad", "deg", "s", "ms", "px", "kg")},
    **{"us": "µs", "hz": "Hz", "mps": "m/s", "mps2": "m/s²", "radps": "rad/s", "m2": "m²"},
    **{"rad2": "rad²", "radps_per_sqrt_s": "rad/s/√s", "gib": "GiB", "percent": "%"},
}
_IN_METRES = ("kr", "kl")  # of settings, whose names do not say it
_WORDS = {  # of names
    **{"target": "class", "fov": "field of view", "focal": "focal length"},
    **{"ess": "ESS", "kld": "KLD", "dof": "degrees of freedom"},
    **{word: word.upper() for word in ("ate", "nees", "rms", "rmse", "sd")},
}
_GROUPS = {"choice": "", "simulation": "", "robots": "robot camera", "lidar3d": "3D lidar"}
_SETTINGS_IN_WORDS = {  # where the rule does not give what one would say
    "estimator.kr": "believed kr",
    "estimator.kl": "believed kl",
    "estimator.encoder_tick_m": "believed encoder tick",
    "estimator.finish_s": "time limit of finish",
    "estimator.forward_slip_m": "believed forward slip",
    "estimator.limit_s": "estimator time limit",
    "estimator.min_particles": "min. number of particles",
    "estimator.max_particles": "max. number of particles",
    "estimator.n_nearest": "number of nearest nodes",
    "estimator.n_rivals": "number of rival particles",
    "estimator.repeat_s": "least time between repeated landmarks",
    "estimator.robots": "sensor of sightings",
    "robot.bias_left": "left wheel bias",
    "robot.bias_right": "right wheel bias",
    "robot.kr": "true kr",
    "robot.kl": "true kl",
    "robot.unmodelled_slip": "rate of unmodelled slip",
    "robot.unmodelled_slip_m": "size of unmodelled slip",
    "scoring.after_s": "start of scoring",
    "scoring.longest_gap_s": "longest gap of the truth",
    "team.communication.kind": "communication",
    "world.bare_after_m": "length of the second bare stretch",
    "world.bare_m": "length of the bare stretch",
    "world.block_m": "block size",
    "world.corridor_m": "corridor width",
    "world.door_m": "door width",
    "world.look_alike_share": "share of look-alike landmarks",
    "world.n_x": "number of rooms or blocks along x",
    "world.n_y": "number of rooms or blocks along y",
    "world.objects_m": "length of the stretch with objects",
    "world.on_walls_share": "share of landmarks on walls",
    "world.room_m": "room size",
    "world.rooms_visited": "number of rooms visited",
    "world.second_leg_m": "length of the second leg",
    "world.street_m": "street width",
    "world.third_leg_m": "length of the third leg",
    "world.tour_m": "tour length",
}


def title(name: str, *, short: bool = False) -> str:
    """Label (or symbol) and unit of a metric, a setting, or any other column by its own words.

    Examples
    --------
    >>> title("ate_rmse_m"), title("choice.world"), title("sensors.stereo.max_distance_m")
    ('position RMSE, m', 'world', 'stereo max distance, m')
    >>> title("omega_radps"), title("ate_rmse_m_office"), title("recall_at_1_percent")
    ('omega, rad/s', 'RMSE (office), m', 'recall at 1, %')
    """
    if name in COLUMNS:
        column = COLUMNS[name]
        words, unit = column.symbol if short else column.label, column.unit
    elif name.startswith(RELATIVE):
        words, unit = f"RMSE / that of {name.removeprefix(RELATIVE)}", ""
    elif "." in name:
        words, unit = _setting(name)
    elif metric := next((m for m in COLUMNS if name.startswith(f"{m}_")), ""):
        of = name.removeprefix(f"{metric}_").replace("_", " ")
        words, unit = f"{COLUMNS[metric].symbol} ({of})", COLUMNS[metric].unit
    else:
        own, unit = _parted(name)
        words = " ".join(["number of", *own[1:]] if own[0] == "n" and own[1:] else own)
    return f"{words}, {unit}" if unit else words


def _setting(name: str) -> tuple[str, str]:
    """Words and unit of a dotted setting: its group, then its own name."""
    *_, above, group, last = ["", *name.split(".")]
    own, unit = _parted(last)
    if name in _SETTINGS_IN_WORDS:
        return _SETTINGS_IN_WORDS[name], unit
    if own[0] == "sigma":
        own = [*own[1:], "sigma"]
        group = "believed" if group == "estimator" else group
    groups = [above, group] if group == "mount" else [group]
    if ("n" in own[:1] or "per" in own) and above != "sensors":
        groups = []  # of all of the world or the estimator
    counted = ["number of"] if own[0] == "n" else []
    named = [_GROUPS.get(each, each) for each in groups]
    return " ".join(filter(None, [*counted, *named, *own[len(counted) :]])), unit


def _parted(name: str) -> tuple[list[str], str]:
    """Words of a name, and the unit that it ends with."""
    longest = max((unit for unit in _UNITS if name.endswith(f"_{unit}")), key=len, default="")
    own = name.removesuffix(f"_{longest}").strip("_").split("_")
    if own[-1].isdigit() and longest == "m":  # share_beyond_10_m
        own, longest = [*own, longest], ""
    unit = _UNITS.get(longest, "m" if name in _IN_METRES else "")
    return [_WORDS.get(word, word) for word in own], unit


def format_alike(values: Iterable[float], digits: int = 4) -> list[str]:
    """Numbers of one setting as texts: all with powers of ten if one of them needs it.

    Examples
    --------
    >>> alike([1e-5, 1e-4, 0.0]), alike([1e-4, 0.25, 2000.0])
    (['1e-5', '1e-4', '0'], ['0.0001', '0.25', '2000'])
    """
    rounded = [float(f"{value:.{digits}g}") for value in values]
    texts = [f"{value:.{max(digits, 6)}g}" for value in rounded]
    if not any("e" in text for text in texts):
        return texts
    parts = [f"{value:.{digits - 1}e}".partition("e") for value in rounded]
    return [
        f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}" if value and exponent else text
        for text, value, (mantissa, _, exponent) in zip(texts, rounded, parts, strict=True)
    ]


def average_of(name: str) -> Average:
    """How a column is averaged; one that is in no schema, arithmetically."""
    return COLUMNS[name].average if name in COLUMNS else Average.PLAIN


def as_text() -> str:
    """List the metrics: name, unit, which direction is better, what it is."""
    lines = [("column", "unit", "better", "")]
    lines += [(name, c.unit, c.better or "", c.label) for name, c in COLUMNS.items()]
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.ljust, cells, widths)).rstrip() for cells in lines)
