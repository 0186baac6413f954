"""Figures of the study of peers: errors and processor times."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.judging.results import Results
from experiments.studies.peers.settings import LASER, MAP, STEREO, TUNED
from experiments.viewing.plotting import set_axes
from experiments.viewing.style import BLUE, ORANGE, WALL, subplots

_WORLDS = {"room": "s", "rooms": "^", "office": "D"}


def draw(results: Results) -> dict[str, Figure]:
    """Draw the study's figure."""
    return {"peers_errors": errors(results.table("methods"))}


def errors(methods: pd.DataFrame) -> Figure:
    """Draw the error of each method, the best on top, with its processor time beside it."""
    groups = [sensor for sensor in (LASER, MAP, STEREO) if (methods["sensor"] == sensor).any()]
    parts = {sensor: methods[methods["sensor"] == sensor] for sensor in groups}
    heights = [len(part) for part in parts.values()]
    page, rows = subplots(
        9.5,
        0.7 + 0.5 * len(parts) + 0.3 * sum(heights),
        len(parts),
        2,
        gridspec_kw={"height_ratios": heights},
        squeeze=False,
    )
    for (sensor, part), (left, right) in zip(parts.items(), rows, strict=True):
        names = list(part["estimator"])
        places = np.arange(len(names))[::-1]
        for place, (_, method) in zip(places, part.iterrows(), strict=True):
            color = BLUE if method["project"] == "Estima" else ORANGE
            filled = color if method["tuned"] else "white"
            mark = {"color": color, "mfc": filled, "ls": "", "zorder": 2}
            for world, shape in _WORLDS.items():
                error_m = method[f"ate_rmse_m_{world}"]
                left.plot(error_m, place, shape, ms=5, color=WALL, mec="white", mew=0.5, zorder=3)
            left.plot(method["ate_rmse_m"], place, "o", ms=8, **mark)
            right.plot(method["cpu_time_us"], place, "o", ms=8, **mark)
        for axes, label in ((left, "RMS position error, m"), (right, "processor time a Frame, µs")):
            set_axes(axes, plain="x", xlabel=label, ylim=(-0.7, len(names) - 0.3))
            axes.grid(axis="y", color="0.92")
        right.tick_params(axis="y", length=0)
        left.set_yticks(places, list(map(_label, names, part["answer"])))
        right.set_yticks(places, [""] * len(names))
        left.set_title(f"{sensor} and wheels", fontsize=9, loc="left")
    page.legend(handles=_legend(), loc="outside lower center", ncols=4, fontsize=8)
    return page


def _label(name: str, answer: str) -> str:
    """A method's name with what is said of it: whether it is tuned, and revised."""
    said = {"tuned": name.endswith(TUNED), "revised": answer == "revised"}
    marks = ", ".join(mark for mark, holds in said.items() if holds)
    return name.removesuffix(TUNED) + (f" ({marks})" if marks else "")


def _legend() -> list[Line2D]:
    """One entry a colour, a filling and a world."""
    return [
        Line2D([], [], color=color, mfc=filled, ls="", marker=shape, ms=size, label=label)
        for label, color, filled, shape, size in [
            ("ours", BLUE, BLUE, "o", 7),
            ("of another project", ORANGE, ORANGE, "o", 7),
            ("default", "black", "white", "o", 7),
            ("tuned", "black", "black", "o", 7),
            *((world, WALL, WALL, shape, 4) for world, shape in _WORLDS.items()),
        ]
    ]
