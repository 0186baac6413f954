"""Panels of a picture by the white between them, so that a phone shows them one below another."""

from io import BytesIO
from itertools import pairwise

import numpy as np
from matplotlib.image import imread
from numpy.typing import NDArray

Box = tuple[int, int, int, int]  # left, top, right, bottom, pixels
Part = tuple[Box, ...]  # a panel; before it the labels of its axis, if another panel has them
Span = tuple[int, int]
Ink = NDArray[np.bool_]
_TALL = 0.1  # share of the height that a row of panels has, but no line of text
_BROAD = 0.18  # share of the width that a panel has, but no colour bar
_LINE = 0.6  # share of a panel's height that its axis has, but no text
_GUTTER = 8  # pixels between panels, at least
_LABELS = 12  # pixels that labels take beside an axis, but no ticks
_NEAR = 9  # pixels from an axis within which its labels begin, but no title of the next panel
_APART = 29  # pixels between the entries of a legend, but not between a mark and its words
_LINE_HEIGHT = 40  # pixels that no line of text is taller than, unless it is turned
_SPACING = 10  # pixels between the lines of a legend, but not between it and a panel's labels
_MARGIN = 6  # pixels around a part
_LEADING = 2  # pixels around a line of text, which end before the next one


def panels(png: bytes) -> list[Part]:
    """Parts that can stand alone, as they are read, with their labels; none if there is only one.

    Rows of panels are tall bands of ink with white above and below; panels are what white divides
    from top to bottom of such a row. One that shares the vertical axis of a panel to its left comes
    with that one's labels. Those that share a horizontal axis stay together. Titles and the entries
    of legends that belong to several panels are parts too.
    """
    pixels = imread(BytesIO(png), format="png")
    ink = _any(pixels[..., :3] < 0.98, 2) if pixels.ndim == 3 else pixels < 0.98
    bands = _runs(_any(ink, 1))
    rows: list[Span] = []
    for i, (top, bottom) in enumerate(bands):
        if bottom - top < _TALL * len(ink) or not _has_line(ink[top:bottom]):
            continue
        above = [band for band in bands[:i] if rows and band[0] >= rows[-1][1]]
        shares_axis = rows and not (above and above[0][0] - rows[-1][1] < _NEAR)
        rows = [*rows[:-1], (rows[-1][0], bottom)] if shares_axis else [*rows, (top, bottom)]
    cuts = [0, *(_widest_gap(bands, *pair) for pair in pairwise(rows)), len(ink)]
    spans = zip(pairwise(cuts), rows, strict=False)  # a picture may hold no row
    found = [box for span, row in spans for box in _in_row(ink, span, row, bands)]
    return found if len(found) > 1 else []


def _in_row(ink: Ink, span: Span, row: Span, bands: list[Span]) -> list[Part]:
    """Parts of the lines of pixels in `span`, which hold one row of panels."""
    inside = ink[slice(*row)]
    width = inside.shape[1]
    at, labels = [0], [_labels(inside, 0)]
    inked = dict(_runs(_any(inside, 0)))
    for left, right in _runs(~_any(inside, 0)):
        if right - left < _GUTTER or not left - at[-1] >= _BROAD * width <= width - right:
            continue
        own = _labels(inside, right)
        # without labels to its left it may be a colour bar
        if own or inked[right] - right >= _BROAD * width:
            at.append((left + right) // 2)
            labels.append(own or labels[-1])
    if len(at) == 1:
        return [(_trimmed(ink, (0, span[0], width, span[1])),)]
    lines = [band for band in bands if band[1] - band[0] <= _LINE_HEIGHT]
    shared = [band for band in lines if any(_crosses(ink[slice(*band)], x) for x in at[1:])]
    top = max([span[0], *(end for start, end in shared if span[0] <= start < row[0])])
    # what is nearest below a panel are its own labels
    bottom = min([span[1], *(start for start, _ in shared if row[1] + _NEAR < start < span[1])])
    for start, end in reversed(lines):
        if row[1] <= start < bottom < min(span[1], end + _SPACING):  # a line of the same legend
            bottom = start
    found: list[Part] = []
    ends = max(top, row[0] - _LABELS), min(bottom, row[1] + _LABELS)
    for left, right, near in zip(at, [*at[1:], width], labels, strict=True):
        panel = _trimmed(ink, (left, top, right, bottom))
        another = near is not None and near[0] < left
        strip = [_trimmed(ink, (near[0], ends[0], near[1], ends[1]))] if near and another else []
        found.append((*strip, panel))
    words = [(0, span[0], width, top), (0, bottom, width, span[1])]
    above, below = (
        [(each,) for each in _entries(ink, box)] if ink[box[1] : box[3]].any() else []
        for box in words
    )
    return [*above, *found, *below]


def _has_line(part: Ink) -> bool:
    """Whether there is a line from top to bottom, such as an axis, or an area as tall."""
    return bool((part.mean(axis=0) > _LINE).any())


def _labels(row: Ink, start: int) -> Span | None:
    """From where to where a panel's labels stand to the left of its axis; None if it has none."""
    part = row[:, start:]
    lines = np.flatnonzero(part.mean(axis=0) > _LINE)
    inked = _any(part, 0)
    first = int(np.argmax(inked))
    axis = int(lines[0]) if len(lines) else part.shape[1]
    if axis - first <= _LABELS:  # no more than ticks
        return None
    white = np.flatnonzero(~inked[:axis])
    return (start + first, start + int(white[-1]) if len(white) else start + axis)


def _crosses(band: Ink, x: int) -> bool:
    """Whether a line of text goes on across x: there is no more white than within a legend."""
    near = _any(band[:, max(0, x - 2 * _APART) : x + 2 * _APART], 0)
    left, right = np.split(near, [min(2 * _APART, x)])
    return bool(left.any() and right.any())


def _entries(ink: Ink, box: Box) -> list[Box]:
    """The entries of a legend, line by line; a sentence is one."""
    left, top, right, bottom = box
    found = []
    for above, below in _runs(_any(ink[top:bottom, left:right], 1)):
        runs = _runs(_any(ink[top + above : top + below, left:right], 0))
        starts = [a for i, (a, _) in enumerate(runs) if not i or a - runs[i - 1][1] >= _APART]
        for a, b in zip(starts, [*starts[1:], right - left], strict=True):
            entry = (left + a, top + above, left + b, top + below)
            found.append(_trimmed(ink, entry, _LEADING))
    return found


def _trimmed(ink: Ink, box: Box, margin: int = _MARGIN) -> Box:
    """A box without the white around what it holds, but for a margin."""
    left, top, right, bottom = box
    part = ink[top:bottom, left:right]
    x, y = (np.flatnonzero(_any(part, axis)) for axis in (0, 1))
    return (
        max(0, left + int(x[0]) - margin),
        max(0, top + int(y[0]) - margin),
        min(ink.shape[1], left + int(x[-1]) + 1 + margin),
        min(ink.shape[0], top + int(y[-1]) + 1 + margin),
    )


def _any(part: Ink, axis: int) -> Ink:
    """Where there is ink along an axis."""
    return np.asarray(part.any(axis=axis))


def _runs(is_so: Ink) -> list[Span]:
    """First and one past the last index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_so, [False]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _widest_gap(bands: list[Span], above: Span, below: Span) -> int:
    """Middle of the most white between two rows of panels; the last of about equal gaps."""
    between = [band for band in bands if above[1] <= band[1] and band[0] <= below[0]]
    gaps = [(b[0] - a[1], (b[0] + a[1]) // 2) for a, b in pairwise(between)]
    return [middle for gap, middle in gaps if gap >= 0.9 * max(gaps)[0]][-1]
