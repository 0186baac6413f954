"""Plans: axes in metres, ellipses, texts as they are; all that the picture of a run needs."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
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
