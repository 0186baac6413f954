"""Figure of the study of peers: errors by class of world, with intervals and ties."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.judging.results import Results
from experiments.studies.peers.settings import CLASSES, LASER, MAP, STEREO, TUNED
from experiments.studies.peers.study import is_ours
from experiments.viewing.plotting import set_axes
from experiments.viewing.style import BLUE, ORANGE, WALL, subplots

_BOARDS = [(s, a) for s in (LASER, MAP, STEREO) for a in ("online", "revised")]
_ENDS = ("ate_low_m", "ate_high_m")
_PLACES = {"all classes": "", **{name: f"_{name}" for name in CLASSES}}


def draw(results: Results) -> dict[str, Figure]:
    """Draw the study's figure."""
    return {"peers_errors": errors(results.table("methods"))}


def errors(methods: pd.DataFrame) -> Figure:
    """Draw the error of each method that competes by class, the best over all classes on top."""
    able = methods[methods["competes"]]
    parts = {b: able[(able["sensor"] == b[0]) & (able["answer"] == b[1])] for b in _BOARDS}
    parts = {board: part for board, part in parts.items() if len(part)}
    heights = [len(part) + 1 for part in parts.values()]
    page, rows = subplots(
        13.0,
        1.0 + 0.3 * len(parts) + 0.22 * sum(heights),
        len(parts),
        len(_PLACES),
        gridspec_kw={"height_ratios": heights},
        squeeze=False,
        sharex=True,
    )
    errors_m = able[[f"ate_rmse_m{place}" for place in _PLACES.values()]]
    limits = (errors_m.min(axis=None) / 3.0, errors_m.max(axis=None) * 3.0)
    for axes, title in zip(rows[0], _PLACES, strict=True):
        axes.set_title(title, fontsize=9)
    for (board, part), line in zip(parts.items(), rows, strict=True):
        at = np.arange(len(part))[::-1]
        for axes, place in zip(line, _PLACES.values(), strict=True):
            for y, (_, row) in zip(at, part.iterrows(), strict=True):
                value, low, high = (row[f"{c}{place}"] for c in ("ate_rmse_m", *_ENDS))
                colour = BLUE if is_ours(row["estimator"]) else ORANGE
                filled = colour if row[f"level{place}"] else "white"
                axes.plot([low, high], [y, y], color=colour, lw=1.2)
                axes.plot(value, y, "o", ms=5, color=colour, mfc=filled)
            set_axes(axes, xscale="log", xlim=limits, ylim=(-0.7, len(part) - 0.3))
            axes.grid(axis="y", color="0.92")
            axes.tick_params(axis="y", length=0)
            axes.set_yticks(at, [""] * len(part))
        line[0].set_yticks(at, [_label(row) for _, row in part.iterrows()], fontsize=7)
        line[0].set_ylabel(f"{board[0]},\n{board[1]}", fontsize=8)
    for axes in rows[-1]:
        axes.set_xlabel("position RMSE, m", fontsize=8)
    page.legend(handles=_legend(), loc="outside lower center", ncols=4, fontsize=8)
    return page


def _label(row: "pd.Series[str]") -> str:
    """A method with its arm, and a mark if it is given a map."""
    arm = f", {row['arm']}" if not is_ours(row["estimator"]) else ""
    mapped = " (map)" if row["sensor"] == MAP else ""
    return f"{row['estimator'].removesuffix(TUNED)}{arm}{mapped}"


def _legend() -> list[Line2D]:
    """One entry a colour and a filling."""
    return [
        Line2D([], [], color=color, mfc=filled, ls="", marker="o", ms=6, label=label)
        for label, color, filled in [
            ("ours", BLUE, BLUE),
            ("another project's", ORANGE, ORANGE),
            ("level with the best of its board", WALL, WALL),
            ("worse (Holm over all pairs)", WALL, "white"),
        ]
    ]
