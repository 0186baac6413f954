"""A run as pictures: what is drawn at each instant, of one robot or of several."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from experiments.evaluation.metrics import CHI2_95_2DOF
from experiments.viewing.grid import draw_grid
from experiments.viewing.playback import Playback, RobotTrack, last_row
from experiments.viewing.style import (
    BLACK,
    BLUE,
    ESTIMATE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    TRUTH,
    YELLOW,
    literal,
    plan_axes,
    subplots,
)
from experiments.viewing.team_figure import colour_of, sightings
from experiments.viewing.world import draw_world, drawable, points_in_base, sees_landmarks
from sim import se2
from sim.arrays import Array
from sim.errors import require
from sim.recording import Recording

Picture = NDArray[np.uint8]
Points = dict[str, Array]  # (N, 2) m, in map, of each layer
Bounds = tuple[float, float, float, float]  # x and y of the lower left and upper right corner, m
OTHERS = (ORANGE, GREEN, PURPLE, SKY, YELLOW)  # colours of further estimates
_MOST_PARTICLES = 1000  # drawn, of any number
_SEEN_S = 1.0  # how long a sighting is shown
_DPI = 100
_NONE = np.zeros((0, 2))


class Layer(NamedTuple):
    """How something that moves is drawn."""

    style: str
    colour: str
    label: str
    width: float = 1.4
    size: float = 6.0
    alpha: float = 1.0


def pictures(run: Playback) -> Iterator[Picture]:
    """The run as pictures (H, W, 3) with even sides; what never moves is drawn once."""
    x1, y1, x2, y2 = around = bounds(run)
    page, ax = subplots(8.0, float(np.clip(7.0 * (y2 - y1) / (x2 - x1), 2.0, 8.0)) + 1.2)
    page.set_dpi(_DPI)
    if run.grid is not None:
        draw_grid(ax, run.grid)
    recordings = [own.recording for own in run.robots]
    if recordings[0].world is not None:
        draw_world(ax, recordings[0].world, landmarks=any(map(sees_landmarks, recordings)))
    moving: dict[str, Any] = {
        name: ax.plot(
            *([], [], layer.style),
            color=layer.colour,
            label=layer.label,
            lw=layer.width,
            ms=layer.size,
            alpha=layer.alpha,
            animated=True,
        )[0]
        for name, layer in layers(run).items()
    }
    title = ax.text(0.0, 1.01, "", transform=ax.transAxes, animated=True)
    plan_axes(ax, xlim=(x1, x2), ylim=(y1, y2))
    handles, labels = ax.get_legend_handles_labels()
    page.legend(handles, labels, loc="outside lower center", ncols=4, fontsize="small")
    ax.set_title(" ")  # reserves the room

    canvas: Any = FigureCanvasAgg(page)
    canvas.draw()
    page.set_layout_engine("none")
    background = canvas.copy_from_bbox(page.bbox)
    for points, words in instants(run, around):
        canvas.restore_region(background)
        for name, line in moving.items():
            line.set_data(*points.get(name, _NONE).T)
            ax.draw_artist(line)
        title.set_text(words)
        ax.draw_artist(title)
        image = np.asarray(canvas.buffer_rgba())[..., :3]
        yield image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2].copy()


def layers(run: Playback) -> dict[str, Layer]:
    """What moves, from the lowest layer up; of several robots each has its colour."""
    if len(run.robots) == 1:
        return _layers_alone(run.robots[0], literal(run.name))
    found: dict[str, Layer] = {}
    for n, own in enumerate(run.robots):
        colour, label = colour_of(n), f"{literal(run.name)} and 95 % ellipse" if n == 0 else ""
        found |= {
            f"{n} seen": Layer("-", colour, "", width=0.7, alpha=0.6),
            f"{n} truth": Layer("-", colour, f"robot {n}", width=1.6),
            f"{n} robot": Layer("-", colour, ""),
        }
        if own.estimate is not None:
            found[f"{n} estimate"] = Layer("--", BLACK, label, width=1.0)
            found[f"{n} ellipse"] = Layer("-", BLACK, "", width=0.8)
    return found


def _layers_alone(own: RobotTrack, name: str) -> dict[str, Layer]:
    """What moves of a robot alone: its sensors' readings, particles and landmarks too."""
    extras = {} if own.estimate is None else own.estimate.extras
    particles, mapped = (
        any(value is not None and len(value) for value in extras.get(extra, []))
        for extra in ("particles", "landmarks")
    )
    readings = {}
    colours = itertools.cycle((RED, ORANGE, PURPLE, BLUE, YELLOW))
    for sensor, colour in zip(drawable(own.recording), colours, strict=False):
        few = own.recording.logs[sensor].splits is not None
        readings[sensor] = Layer("x" if few else ".", colour, sensor, size=5 if few else 2)
    true, estimated = own.recording.truth is not None, own.estimate is not None
    layers = {
        "particles": particles and Layer(".", SKY, "particles", size=3, alpha=0.6),
        **readings,
        "landmarks": mapped and Layer("-", GREEN, "landmarks, 95 %", width=0.8),
        "truth": true and Layer("-", TRUTH, "truth", width=1.6),
        "robot": true and Layer("-", TRUTH, ""),
        "estimate": estimated and Layer("--", ESTIMATE, name, width=1.3),
        "believed robot": estimated and Layer("-", ESTIMATE, ""),
        "ellipse": estimated and Layer("-", ESTIMATE, "its 95 % ellipse", width=0.9),
    }
    for k, (other, _) in enumerate(own.others):
        colour = OTHERS[k % len(OTHERS)]
        layers[f"other {k} estimate"] = Layer("--", colour, literal(other), width=1.3)
        layers[f"other {k} ellipse"] = Layer("-", colour, "", width=0.9)
    return {f"0 {name}": layer for name, layer in layers.items() if layer}


def instants(run: Playback, around: Bounds) -> Iterator[tuple[Points, str]]:
    """Of each picture: the points of the layers, and the title."""
    recordings = [own.recording for own in run.robots]
    sighted = [sightings(recordings, number) for number in range(len(recordings))]
    paths = [_true_path(own.recording) for own in run.robots]
    for stamp in run.stamps.tolist():
        points: Points = {}
        for n, (own, path, (when, lines)) in enumerate(
            zip(run.robots, paths, sighted, strict=True)
        ):
            frames = own.recording.frame_stamps
            at = float(np.clip(stamp, frames[0], frames[-1]))  # afterwards it stands there
            glyph_m = max(own.recording.robot.track_m / 2.0, 0.012 * (around[2] - around[0]))
            found = {"truth": path[frames[: len(path)] <= at + 1e-9, :2]}
            if len(path):
                found["robot"] = robot_outline(own.truth_at(np.array([at]))[0], glyph_m)
            found |= _believed(own, at, glyph_m)
            for k, (_, other) in enumerate(own.others):
                theirs = _believed(replace(own, estimate=other), at, glyph_m)
                found |= {f"other {k} {name}": there for name, there in theirs.items()}
            if len(run.robots) == 1:
                found |= {name: sensor_points(own, name, at) for name in drawable(own.recording)}
            now = (when <= stamp + 1e-9) & (when > stamp - _SEEN_S)
            gaps = np.full((int(now.sum()), 1, 2), np.nan)
            found["seen"] = np.concatenate([lines[now], gaps], axis=1).reshape(-1, 2)
            points |= {f"{n} {name}": there for name, there in found.items()}
        yield points, f"{run.clock(stamp)} s{_error_words(run, stamp)}"


def _error_words(run: Playback, stamp: float) -> str:
    """The position error of a robot alone, if it is known and the only one."""
    own = run.robots[0]
    if len(run.robots) > 1 or own.others or own.belief_row(stamp) < 0:
        return ""
    off = own.pose_at(stamp) - own.truth_at(np.array([stamp]))[0]
    return f", position error {np.hypot(*off[:2]):.3f} m" if np.isfinite(off).all() else ""


def _believed(own: RobotTrack, stamp: float, glyph_m: float) -> Points:
    """Points of what is believed of a robot."""
    row = own.belief_row(stamp)
    if own.estimate is None or row < 0:
        return {}
    mean, covariance = own.estimate.means[row], own.estimate.covariances[row]
    points = {
        "estimate": own.estimate.means[: row + 1, :2],
        "believed robot": robot_outline(mean, glyph_m),
    }
    if np.isfinite(covariance).all():
        points["ellipse"] = ellipse_outlines(mean[None, :2], covariance[None, :2, :2])
    extras = {k: v[row] for k, v in own.estimate.extras.items() if v[row] is not None}
    if "particles" in extras:
        particles = extras["particles"]
        points["particles"] = particles[:: -(-len(particles) // _MOST_PARTICLES) or 1, :2]
    if "landmarks" in extras and "landmark_covariances" in extras:
        flat = extras["landmark_covariances"][:, :2, :2]
        points["landmarks"] = ellipse_outlines(extras["landmarks"][:, :2], flat)
    return points


def sensor_points(own: RobotTrack, name: str, stamp: float) -> Array:
    """Points (N, 2) in map of a sensor's last reading up to a time."""
    stamps = own.recording.logs[name].stamps
    row = last_row(stamps, stamp)
    pose = own.pose_at(float(stamps[row])) if row >= 0 else np.full(3, np.nan)
    if not np.isfinite(pose).all():
        return _NONE
    return se2.transform(pose, points_in_base(own.recording, name, row))


def all_sensor_points(own: RobotTrack, stamp: float) -> Array:
    """Points (N, 2) in map of all sensors' last readings up to a time."""
    shown = (sensor_points(own, name, stamp) for name in drawable(own.recording))
    return np.concatenate([_NONE, *shown])


def _true_path(recording: Recording) -> Array:
    """True poses (T, 3) at the Frames; (0, 3) where they are not known."""
    known = recording.truth is not None
    return recording.truth_at(recording.frame_stamps) if known else np.zeros((0, 3))


def ellipse_outlines(means: Array, covariances: Array) -> Array:
    """95 % ellipses of means (N, 2), covariances (N, 2, 2) as one line, with gaps of NaN."""
    values, vectors = np.linalg.eigh(covariances)
    axes = vectors * np.sqrt(CHI2_95_2DOF * np.maximum(values, 0.0))[:, None, :]
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    outlines = means[:, None, :] + circle @ axes.transpose(0, 2, 1)
    return np.concatenate([outlines, np.full((len(means), 1, 2), np.nan)], axis=1).reshape(-1, 2)


def robot_outline(pose: Array, radius_m: float) -> Array:
    """A circle about a pose, and a line from it to where the robot heads, (N, 2)."""
    angle = pose[2] + np.linspace(0.0, 2.0 * np.pi, 25)
    circle = pose[:2] + radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    front = pose[:2] + 1.8 * radius_m * np.array([np.cos(pose[2]), np.sin(pose[2])])
    return np.concatenate([circle, front[None]])


def bounds(run: Playback) -> Bounds:
    """What the map shows: the world and the paths, with a margin.

    A diverging estimate is followed to twice the size of all else.
    """
    low, high = np.transpose([_bounds(own, run) for own in run.robots], (1, 0, 2))
    (x1, y1), (x2, y2) = low.min(axis=0).tolist(), high.max(axis=0).tolist()
    return x1, y1, x2, y2


def _bounds(own: RobotTrack, run: Playback) -> tuple[Array, Array]:
    """Lower left and upper right corner, (2,) m."""
    world = own.recording.world
    known = np.concatenate(
        [
            _true_path(own.recording)[:, :2],
            _NONE if world is None else world.walls.reshape(-1, 2),
            _NONE if run.grid is None else run.grid.corners_m,
        ]
    )
    means = np.concatenate([_NONE, *(each.means[:, :2] for each in own.estimates)])
    known, means = (points[np.isfinite(points).all(axis=1)] for points in (known, means))
    if len(known) and len(means):
        low, high = known.min(axis=0), known.max(axis=0)
        reach = (high - low).max() / 2.0
        means = np.clip(means, low - reach, high + reach)
    corners = np.concatenate([known, means])
    require(len(corners), "this log has no truth to show; give an estimate of its path")
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.05 * max((high - low).max(), 1.0) + own.recording.robot.track_m
    return low - margin, high + margin
