"""Panels of a figure, noted in its PNG, so that a phone can show them one below another."""

import struct
import zlib
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

_KEY = "Panels"
_MARGIN = 4.0  # pixels around a part
_HEADER = 33  # bytes of a PNG before its second chunk


def note_panels(png: Path, page: Figure, dpi: float) -> None:
    """Add the panels of a figure to its PNG, which has so many dots per inch."""
    own = page.dpi
    try:
        page.set_dpi(dpi)
        page.draw_without_rendering()  # letters, and so legends, do not scale as the rest does
        text = panels(page)
    finally:
        page.set_dpi(own)
    if text:
        data = png.read_bytes()
        chunk = b"tEXt" + f"{_KEY}\0{text}".encode("ascii")
        sealed = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        png.write_bytes(data[:_HEADER] + sealed + data[_HEADER:])


def read_panels(image: Image.Image) -> str:
    """Panels of a picture as `panels` wrote them; empty if it has none."""
    text = image.info.get(_KEY, "")
    return text if isinstance(text, str) else ""


def panels(page: Figure) -> str:
    """Parts of a drawn figure that can stand alone, as they are read; empty if there is only one.

    A part is a panel with all that is written around it; panels that share a horizontal axis are
    one part. Titles and the entries of legends that belong to several panels are parts too.

    Returns
    -------
    str
        Parts, separated by blanks, each a box `left,top,right,bottom`, pixels from the top left
        corner. Before that of a panel that has the vertical axis of another, and a plus, is the box
        of that one's labels.
    """
    hosts: dict[Axes, list[Axes]] = {}
    for ax in page.axes:
        hosts.setdefault(_host(ax, list(hosts)), []).append(ax)
    parts = {
        host: Bbox.union([ax.get_tightbbox() or ax.bbox for ax in own])
        for host, own in hosts.items()
    }
    for host in list(parts):
        below = [ax for ax in _labelled(host, "x") if ax in parts]
        if below and host not in below:
            parts[below[0]] = Bbox.union([parts[below[0]], parts.pop(host)])
    if len(parts) < 2:
        return ""
    found = []
    for host, box in parts.items():
        boxes = [box]
        left = [ax for ax in _labelled(host, "y") if ax in parts]
        if left and host not in left:
            labels, axis = parts[left[0]], left[0].bbox.x0 - (_MARGIN + 1.0)
            boxes = [Bbox.from_extents(labels.x0, box.y0, axis, box.y1), box]
        found.append((-round(host.bbox.y1 / 10.0), box.x0, boxes))
    texts = [text for text in page.texts if text.get_text()]
    if page.get_suptitle():
        texts.append(page._suptitle)  # type: ignore[attr-defined]
    for legend in page.legends:
        columns = legend._legend_handle_box.get_children()  # type: ignore[attr-defined]
        texts += [legend.get_title(), *(entry for each in columns for entry in each.get_children())]
    for text in texts:
        box = text.get_window_extent()
        if box.width > 1.0:
            found.append((-round(box.y1 / 10.0), box.x0, [box]))
    height = page.bbox.height
    return " ".join("+".join(_pixels(box, height) for box in boxes) for *_, boxes in
                    sorted(found, key=lambda part: part[:2]))  # fmt: skip


def _host(ax: Axes, others: list[Axes]) -> Axes:
    """The axes that a colour bar or a second axis belongs to; else those themselves."""
    bar = getattr(ax, "_colorbar", None)
    if bar is not None and bar.mappable.axes in others:
        return bar.mappable.axes  # type: ignore[no-any-return]
    return next((other for other in others if other.bbox.bounds == ax.bbox.bounds), ax)


def _labelled(ax: Axes, name: str) -> list[Axes]:
    """Axes in the same column or row that share the x or y axis and have its labels."""
    start, key = ("x0", "labelbottom") if name == "x" else ("y0", "labelleft")
    return [
        other
        for other in getattr(ax, f"get_shared_{name}_axes")().get_siblings(ax)
        if abs(getattr(other.bbox, start) - getattr(ax.bbox, start)) < 1.0
        and getattr(other, f"{name}axis").get_tick_params()[key]
    ]


def _pixels(box: Bbox, height: float) -> str:
    """A box with a margin, pixels from the top left corner."""
    left, right = box.x0 - _MARGIN, box.x1 + _MARGIN
    top, bottom = height - box.y1 - _MARGIN, height - box.y0 + _MARGIN
    return ",".join(str(max(0, round(end))) for end in (left, top, right, bottom))
