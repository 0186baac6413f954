"""A run as a recording for the Rerun viewer: what an animation shows, and the errors over time."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb

from experiments.viewing.animation import Layer, bounds, instants, layers
from experiments.viewing.grid import grid_picture
from experiments.viewing.playback import Playback
from experiments.viewing.player import PATHS, error_curves, still
from sim.arrays import Array
from sim.errors import how_to_install, require
from sim.worlds.grid import OccupancyGrid

_TIME = "time"
_GROUND_M = -0.01  # height of a map, below what is drawn on it


def check_installed(path: Path) -> None:
    """Refuse a file for Rerun if its package is not there."""
    found = importlib.util.find_spec("rerun") is not None
    require(found, f"{path}: .rrd needs Rerun's package: {how_to_install('rerun')}")


def write_rerun(
    run: Playback, path: Path, on_progress: Callable[[float], None], title: str = "A run"
) -> None:
    """Write a run as `.rrd`: a map seen from above, and the errors beneath it.

    Parameters
    ----------
    on_progress
        Called with the share done.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    out = rr.RecordingStream("estima")
    x1, y1, x2, y2 = around = bounds(run)
    middle, height_m = [(x1 + x2) / 2.0, (y1 + y2) / 2.0], max(x2 - x1, y2 - y1)
    flat = rrb.Spatial3DView(
        origin="map",
        name=title,
        background=rrb.Background(color=[255, 255, 255]),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            position=[*middle, height_m], look_target=[*middle, 0.0], eye_up=[0.0, 1.0, 0.0]
        ),
    )
    errors = rrb.TimeSeriesView(origin="errors", name="position error and 95 % bound, m")
    out.save(path, default_blueprint=rrb.Vertical(flat, errors, row_shares=[3, 1]))
    out.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if run.grid is not None:
        out.log("map/grid", _ground(run.grid), static=True)
    for part in still(run):
        rows = np.array(part["rows"], float)
        drawn = _lines(rows.reshape(-1, 2, 2), part) if rows.shape[1] == 4 else _dots(rows, part)
        out.log(rr.new_entity_path(["map", part["label"]]), drawn, static=True)
    shown = layers(run)
    names = {name: rr.new_entity_path(parts) for name, parts in parts_of(run).items()}
    stamps = (run.stamps - run.stamps[0]).tolist()
    for k, (points, _) in enumerate(instants(run, around)):
        out.set_time(_TIME, duration=stamps[k])
        for name, layer in shown.items():
            if not name.endswith(PATHS) or k == len(stamps) - 1:  # a path is there as a whole
                out.log(names[name], _drawn(points.get(name), layer), static=name.endswith(PATHS))
        on_progress((k + 1) / len(stamps))
    for curve in error_curves(run):
        for kind in ("error", "bound"):
            name = rr.new_entity_path(["errors", *filter(None, [curve["label"]]), kind])
            width = 2.0 if kind == "error" else 1.0
            colours = [_rgb(curve["colour"])]
            out.log(name, rr.SeriesLines(colors=colours, widths=[width]), static=True)
            values = np.array([np.nan if v is None else v for v in curve[kind]])
            out.send_columns(
                name,
                [rr.TimeColumn(_TIME, duration=curve["t"])],
                rr.Scalars.columns(scalars=values),
            )
    out.disconnect()


def parts_of(run: Playback) -> dict[str, list[str]]:
    """Where each layer stands among the entities, by what the legend calls it."""
    alone, others = len(run.robots) == 1, dict(enumerate(n for n, _ in run.robots[0].others))
    found = {}
    for name in layers(run):
        robot, _, what = name.partition(" ")
        parts = [what]
        if what.startswith("other "):
            _, k, kind = what.split(" ", 2)
            parts = [others[int(k)], kind]
        elif what in ("estimate", "ellipse", "believed robot") and alone:
            parts = [run.name, what]
        found[name] = ["map", *parts] if alone else ["map", f"robot {robot}", *parts]
    return found


def _drawn(points: Array | None, layer: Layer) -> Any:
    """A layer's points (N, 2) as lines, broken at NaN, or as dots."""
    about = {"label": layer.label, "colour": layer.colour}
    if points is None or not len(points):
        points = np.zeros((0, 2))
    if layer.style not in ("-", "--"):
        return _dots(points[np.isfinite(points).all(axis=1)], about)
    gaps = np.flatnonzero(~np.isfinite(points).all(axis=1))
    pieces = [p[np.isfinite(p).all(axis=1)] for p in np.split(points, gaps)]
    return _lines([p for p in pieces if len(p) > 1], about)


def _lines(strips: Any, about: dict[str, Any]) -> Any:
    import rerun as rr

    flat = [np.column_stack([strip, np.zeros(len(strip))]) for strip in strips]
    return rr.LineStrips3D(flat, colors=[_rgb(about["colour"])], radii=[rr.Radius.ui_points(1.0)])


def _dots(points: Array, about: dict[str, Any]) -> Any:
    import rerun as rr

    flat = np.column_stack([points, np.zeros(len(points))])
    return rr.Points3D(flat, colors=[_rgb(about["colour"])], radii=[rr.Radius.ui_points(2.0)])


def _rgb(colour: str) -> list[int]:
    return [round(255 * part) for part in to_rgb(colour)]


def _ground(grid: OccupancyGrid) -> Any:
    """A grid as a picture that lies beneath the map."""
    import rerun as rr

    return rr.Mesh3D(
        vertex_positions=np.column_stack([grid.corners_m, np.full(4, _GROUND_M)]),
        vertex_texcoords=[[0, 1], [1, 1], [1, 0], [0, 0]],
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        albedo_texture=np.ascontiguousarray(grid_picture(grid)[::-1]),
    )
