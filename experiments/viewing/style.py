"""The style of all figures: size, fonts, plans, and colours for colour-blind people too.

The picture of a run needs no more, so nothing here imports tables or statistics.
"""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import ArrayLike

from experiments.evaluation.metrics import CHI2_95_2DOF
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


def plan_axes(ax: Axes, **settings: Any) -> None:
    """Make axes those of a plan in the map frame, in metres."""
    ax.set(xlabel="x, m", ylabel="y, m", aspect="equal", **settings)


def draw_ellipses(
    ax: Axes, means: ArrayLike, covariances: ArrayLike, label: str = "", **style: Any
) -> None:
    """Draw 95 % ellipses at means (N, 2 or more), m, from covariances of x and y, m^2.

    They share one label in the legend.
    """
    planes = np.asarray(covariances)[:, :2, :2]
    for mean, values, vectors in zip(np.asarray(means), *np.linalg.eigh(planes), strict=True):
        width, height = 2.0 * np.sqrt(CHI2_95_2DOF * np.maximum(values[::-1], 0.0))
        angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        ax.add_patch(Ellipse(mean[:2], width, height, angle=angle, label=label, **style))
        label = ""


def literal(text: str) -> str:
    """A text of a file as Matplotlib shows it, which reads what is between two $ as mathematics."""
    return text.replace("$", r"\$")


def save_figure(page: Figure, path: Path) -> None:
    """Write a figure whole, in the format of the path's suffix; its bytes carry no date.

    A PNG notes its panels, for pages on phones.
    """
    require(path.suffix in _SUFFIXES, f"{path}: a picture is {', '.join(_SUFFIXES)}")
    metadata = {"Software": None} if path.suffix == ".png" else {"Date": None}
    with write_whole(path) as part:
        page.savefig(part, dpi=_DPI, metadata=metadata)
        if path.suffix == ".png":
            note_panels(part, page, _DPI)


_SUFFIXES = (".png", ".pdf", ".svg")
_DPI = 130
