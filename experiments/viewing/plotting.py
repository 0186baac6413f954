"""Parts of many figures: plans, 95 % ellipses, plain numbers on logarithmic axes, one legend."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import LogLocator
from numpy.typing import ArrayLike

from experiments.evaluation.metrics import CHI2_95_2DOF


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


def plain_ticks(ax: Axes, values: Iterable[float], **text: Any) -> None:
    """Put the ticks of a logarithmic x axis at the values; both axes lose their minor ticks."""
    ticks = sorted(set(values))
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks], **text)
    ax.minorticks_off()


def plain_log(axis: Axis, multiples: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Label a logarithmic axis with plain numbers, at these multiples of each decade."""
    axis.set_major_locator(LogLocator(subs=multiples))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")


def with_legend(
    page: Figure, ncols: int, loc: str = "outside lower center", markerscale: float = 1.0
) -> Figure:
    """Add one legend for all axes, of what the first of them shows; return the page."""
    handles, labels = page.axes[0].get_legend_handles_labels()
    page.legend(handles, labels, loc=loc, ncols=ncols, markerscale=markerscale)  # type: ignore[call-overload]
    return page
