"""A run as a page: vector paths that one can zoom, a slider of time, and the errors over time."""

import base64
import html
import io
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from estimators.base import Estimate
from experiments.evaluation.metrics import CHI2_95_2DOF
from experiments.viewing.animation import OTHERS, Bounds, Layer, bounds, instants, layers
from experiments.viewing.grid import grid_picture
from experiments.viewing.playback import Playback, RobotTrack
from experiments.viewing.style import ESTIMATE, ORANGE, PURPLE, WALL
from experiments.viewing.team_figure import colour_of
from experiments.viewing.world import sees_landmarks
from sim.arrays import Array
from sim.worlds.grid import OccupancyGrid

_PLAYER = Path(__file__).parent / "player.html"
PATHS = (" truth", " estimate")  # layers that grow from picture to picture
_GAP = 65535  # stands for NaN among whole numbers of two bytes
_MARGIN = 0.5  # of the map's sides, around it: what lies farther out is not shown
_MOST_ERRORS = 1500  # of a curve


def write_page(
    run: Playback, path: Path, on_progress: Callable[[float], None], title: str = "A run"
) -> None:
    """Write a run as a page of its own that plays, with nothing from elsewhere.

    Parameters
    ----------
    on_progress
        Called with the share done.
    """
    around = bounds(run)
    shown = layers(run)
    points: dict[str, list[Array]] = {name: [] for name in shown}
    times: list[str] = []
    for each, _ in instants(run, around):
        for name in shown:
            points[name].append(each.get(name, np.zeros((0, 2))))
        times.append(f"{run.clock(float(run.stamps[len(times)]))} s")
        on_progress(len(times) / len(run.stamps))
    data = {
        "bounds": around,
        "times": times,
        "stamps": (run.stamps - run.stamps[0]).round(4).tolist(),
        "fps": round(run.fps, 4),
        "grid": None if run.grid is None else _underlay(run.grid),
        "still": still(run),
        "layers": [_layer(name, layer, points[name], around) for name, layer in shown.items()],
        "errors": error_curves(run),
    }
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    page = _PLAYER.read_text(encoding="utf-8")
    for name, value in {"title": html.escape(title), "speed": run.speed, "data": text}.items():
        page = page.replace(f"@{name}@", value)
    path.write_text(page, encoding="utf-8")


def _layer(name: str, layer: Layer, points: list[Array], around: Bounds) -> dict[str, Any]:
    """A layer: how it is drawn, its points, and where those of each picture end.

    Of a path that grows, the points are those of the last picture.
    """
    grows = name.endswith(PATHS)
    flat = points[-1] if grows else np.concatenate(points)
    lengths = [len(each) for each in points]
    return {
        "label": layer.label,
        "colour": layer.colour,
        "style": layer.style,
        "width": layer.width,
        "size": layer.size,
        "alpha": layer.alpha,
        "grows": grows,
        "ends": lengths if grows else np.cumsum(lengths).tolist(),
        **_packed(flat, around),
    }


def _packed(points: Array, around: Bounds) -> dict[str, Any]:
    """Points (N, 2) as whole numbers of two bytes: times `unit`, from `origin`; both in metres."""
    low, high = np.array(around[:2]), np.array(around[2:])
    origin = low - _MARGIN * (high - low)
    unit = float(max((1.0 + 2.0 * _MARGIN) * (high - low).max() / (_GAP - 1), 1e-4))
    steps = np.round((points - origin) / unit)
    inside = (
        np.isfinite(steps).all(axis=1) & (steps >= 0.0).all(axis=1) & (steps < _GAP).all(axis=1)
    )
    codes = np.where(inside[:, None], steps, _GAP).astype("<u2")
    return {
        "origin": origin.round(6).tolist(),
        "unit": unit,
        "points": base64.b64encode(codes.tobytes()).decode(),
    }


def still(run: Playback) -> list[dict[str, Any]]:
    """What never moves: walls (W, 4), those of the map if they differ, and landmarks (N, 2), m."""
    recording = run.robots[0].recording
    world = recording.world
    if world is None:
        return []
    parts = [("walls", WALL, world.walls)]
    if world.known is not world:
        parts.insert(0, ("walls of the map", ORANGE, world.known.walls))
    if any(sees_landmarks(own.recording) for own in run.robots):
        parts.append(("landmarks of the world", PURPLE, world.landmarks[:, :2]))
    return [
        {"label": label, "colour": colour, "rows": np.round(rows, 4).tolist()}
        for label, colour, rows in parts
        if len(rows)
    ]


def _underlay(grid: OccupancyGrid) -> dict[str, Any]:
    """A grid as a picture, its origin and the size of its cells, m."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(grid_picture(grid)[::-1]).save(data, format="PNG")
    return {
        "picture": "data:image/png;base64," + base64.b64encode(data.getvalue()).decode(),
        "origin": list(grid.origin),
        "cell_m": grid.resolution_m,
        "shape": list(grid.probability.shape),
    }


def error_curves(run: Playback) -> list[dict[str, Any]]:
    """Curves of all estimates whose errors are known; those of a robot alone have names."""
    start, alone = float(run.stamps[0]), run.robots[0]
    if len(run.robots) > 1:
        shown = [(own, "", own.estimate, colour_of(n)) for n, own in enumerate(run.robots)]
    else:
        named = [(run.name, alone.estimate), *alone.others]
        colours = itertools.chain([ESTIMATE], itertools.cycle(OTHERS))
        shown = [(alone, *each, colour) for each, colour in zip(named, colours, strict=False)]
    return [
        {"label": label, "colour": colour, **_curve(own, estimate, start)}
        for own, label, estimate, colour in shown
        if estimate is not None and own.recording.truth is not None
    ]


def _curve(own: RobotTrack, estimate: Estimate, start: float) -> dict[str, list[float | None]]:
    """Position error and the semi-major axis of the 95 % ellipse over time."""
    step = -(-len(estimate.stamps) // _MOST_ERRORS)
    stamps = estimate.stamps[::step]
    flat = estimate.means[::step, :2] - own.truth_at(stamps)[:, :2]
    covariances = estimate.covariances[::step, :2, :2]
    axes = np.linalg.eigvalsh(np.nan_to_num(covariances, nan=-1.0))
    known = np.isfinite(covariances).all(axis=(1, 2))
    bound = np.where(known, np.sqrt(CHI2_95_2DOF * np.maximum(axes[:, 1], 0.0)), np.nan)
    return {
        "t": (stamps - start).round(4).tolist(),
        "error": _numbers(np.hypot(*flat.T)),
        "bound": _numbers(bound),
    }


def _numbers(values: Array) -> list[float | None]:
    return [float(f"{v:.4g}") if np.isfinite(v) else None for v in values]
