"""The style of all figures: size, fonts, and colours that colour-blind people can distinguish."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
from cycler import cycler
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.viewing.panels import note_panels
from sim.errors import require
from sim.files import write_whole

# Okabe and Ito's palette.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, RED, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY, BLACK)
# Twelve series that differ in colour and in marker; the first seven are CYCLE
_MORE = ("#882255", "#999933", "#332288", "#777777", "#661100")
SERIES = tuple(zip((*CYCLE, *_MORE), "osD^vPX<>p*h", strict=True))
TRUTH, ESTIMATE, ODOMETRY, WALL = BLACK, BLUE, ORANGE, "#555555"

_SETTINGS: dict[str, Any] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": cycler(color=CYCLE),
    "legend.frameon": False,
    "svg.hashsalt": "estima",
    "svg.fonttype": "none",  # text stays text
    "pdf.fonttype": 42,  # IEEE refuses type 3
}


def figure(width_in: float, height_in: float, font_pt: float = 9.0) -> Figure:
    """Empty page with the house style and a layout in which nothing overlaps."""
    mpl.rcParams.update(_SETTINGS | {"font.size": font_pt})  # type: ignore[arg-type]
    page = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(page)
    return page


def subplots(
    width_in: float,
    height_in: float,
    n_rows: int = 1,
    n_cols: int = 1,
    *,
    suptitle: str = "",
    **options: Any,
) -> tuple[Figure, Any]:
    """Page in the house style and its axes, as `matplotlib.pyplot.subplots` gives them.

    The title above them is small.
    """
    page = figure(width_in, height_in)
    if suptitle:
        page.suptitle(suptitle, size=9)
    return page, page.subplots(n_rows, n_cols, **options)


def save_figure(page: Figure, path: Path) -> None:
    """Write a figure whole, in the format of the path's suffix; its bytes carry no date.

    A PNG notes its panels, for pages on phones.
    """
    require(path.suffix in _SUFFIXES, f"{path}: a picture is {', '.join(_SUFFIXES)}")
    metadata = {"Software": None} if path.suffix == ".png" else {"Date": None}
    with write_whole(path) as part:
        page.savefig(part, dpi=_DPI, metadata=metadata)
        if path.suffix == ".png":
            note_panels(part, page, _DPI / page.dpi)


_SUFFIXES = (".png", ".pdf", ".svg")
_DPI = 130
