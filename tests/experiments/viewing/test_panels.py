"""A figure's panels, noted in its PNG."""

import numpy as np
import pytest
from PIL import Image

from experiments.viewing.panels import read_panels
from experiments.viewing.plotting import with_legend
from experiments.viewing.style import save_figure, subplots


@pytest.fixture
def parts(tmp_path):
    """Boxes of a page's parts as its PNG notes them, and the axes that each part holds."""

    def of(page):
        save_figure(page, tmp_path / "page.png")
        with Image.open(tmp_path / "page.png") as image:
            image.load()
            scale, height = image.width / page.bbox.width, image.height
            text = read_panels(image)
        found = [
            [tuple(map(int, box.split(","))) for box in part.split("+")] for part in text.split()
        ]
        held = []
        for *_, (left, top, right, bottom) in found:
            middles = [(ax.bbox.p0 + ax.bbox.p1) / 2 * scale for ax in page.axes]
            held.append(
                [
                    i
                    for i, (x, y) in enumerate(middles)
                    if left < x < right and top < height - y < bottom
                ]
            )
        return found, held

    return of


def drawn(n_rows, n_cols, **shared):
    page, axes = subplots(8.0, 2.5 * n_rows, n_rows, n_cols, squeeze=False, **shared)
    for i, ax in enumerate(axes.flat):
        ax.plot([0, 1, 2], [0.3, 1.0, 2.0 + i], label="a method with a long name")
        ax.plot([0, 1, 2], [0.3, 0.5, 0.2], label="another method with a long name")
        ax.set(xlabel="distance, m", ylabel="error, m", title=f"panel {i}")
    return page, axes


def test_panels_stand_alone_as_they_are_read(parts):
    page, _ = drawn(2, 2)
    found, held = parts(page)
    assert held == [[0], [1], [2], [3]]
    boxes = np.array([box for (box,) in found])
    assert (boxes[:, 2:] > boxes[:, :2]).all()
    assert boxes.min() >= 0


def test_a_legend_of_several_panels_is_parts_of_its_own(parts, tmp_path):
    page, _ = drawn(1, 2)
    found, held = parts(with_legend(page, ncols=2))
    assert held == [[0], [1], [], []]
    assert all(bottom - top < 50 for ((_, top, _, bottom),) in found[2:])
    with Image.open(tmp_path / "page.png") as image:
        inked = np.asarray(image.convert("L")) < 200
    boxed = np.zeros_like(inked)
    for (box,) in found[2:]:
        left, top, right, bottom = box
        boxed[top:bottom, left:right] = True
    below = max(bottom for ((_, _, _, bottom),) in found[:2])
    assert inked[below:].any()
    assert not (inked & ~boxed)[below:].any()


@pytest.mark.parametrize(
    ("shape", "shared", "expected"),
    [
        ((2, 2), {"sharex": True}, [[0, 2], [1, 3]]),
        ((1, 1), {}, []),
    ],
)
def test_panels_that_share_a_horizontal_axis_stay_together(parts, shape, shared, expected):
    page, axes = drawn(*shape, **shared)
    for ax in axes[:-1].flat:
        ax.set(xlabel="")
    assert parts(page)[1] == expected


def test_panels_that_share_a_vertical_axis_come_with_its_labels(parts):
    page, axes = drawn(1, 3, sharey=True)
    for ax in axes.flat[1:]:
        ax.set(ylabel="")
    found, held = parts(page)
    assert held == [[0], [1], [2]]
    (first,), (of_second, second), (of_third, third) = found
    assert of_second == of_third
    left, top, right, bottom = of_second
    axis = axes.flat[0].bbox.x0 * 1.3
    assert first[0] <= left < right <= axis  # all that stands to the left of the first axis
    assert axis - right < 15
    assert first[1] <= top < bottom <= first[3]
    assert second[0] > axis
    assert third[0] > second[0]


def test_a_colour_bar_stays_with_its_panel(parts):
    page, axes = drawn(1, 2)
    image = axes[0, 0].imshow(np.eye(4), aspect="auto")
    page.colorbar(image, ax=axes[0, 0], label="share")
    assert parts(page)[1] == [[0, 2], [1]]


def test_a_picture_without_axes_is_whole(parts):
    page, axes = drawn(1, 1)
    axes[0, 0].remove()
    assert parts(page)[0] == []
