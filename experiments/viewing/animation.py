"""A run as an animation: what is shown at each instant, and files of it.

The same `Playback` is drawn to a file here (MP4, GIF, HTML), and in a window by `viewing.live`.
"""

import base64
import dataclasses
import html
import io
import itertools
import shutil
import subprocess
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from estimators.base import Belief, Estimate, Estimator
from estimators.base import run as run_estimator
from experiments.evaluation.metrics import CHI2_95_2DOF
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from experiments.trajectories.odometry import read_odometry_csv
from experiments.trajectories.read import SUFFIXES as TRAJECTORIES
from experiments.trajectories.read import read_trajectory
from experiments.viewing.grid import draw_grid
from experiments.viewing.plotting import literal, plan_axes
from experiments.viewing.style import (
    BLUE,
    ESTIMATE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    TRUTH,
    YELLOW,
    subplots,
)
from experiments.viewing.world import draw_world, sees_landmarks
from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.files import write_whole
from sim.recording import Frame, Recording
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World

Picture = NDArray[np.uint8]
Layer = tuple[str, str, str, dict[str, Any]]  # style, colour, label, further settings
_Layer = tuple[bool, str, str, str, dict[str, Any]]  # whether drawn, and the Layer
SUFFIXES = (".mp4", ".gif", ".html")
FPS = 10
MOST_PICTURES = 200  # a page of some 6 MB
REAL_TIME_S = 70.0  # longest drive of which so many show three instants a second
SECONDS = 20.0  # how long a longer drive plays
_EXTRAS = ("particles", "landmarks", "landmark_covariances")
_MOST_PARTICLES = 1000  # drawn, of any number
_DPI = 100


@dataclass(frozen=True)
class Playback:
    """What is shown.

    Attributes
    ----------
    recording
        Sensors, and the truth if it is known.
    rows
        (n,) rows of the Frames that are shown, increasing.
    estimate
        Beliefs, or None. They have extras at the shown Frames.
    name
        Of the estimate.
    grid
        A map to draw underneath, or None.
    seconds
        How long it plays, s; None: in real time.
    """

    recording: Recording
    rows: NDArray[np.int64]
    estimate: Estimate | None = None
    name: str = "estimate"
    grid: OccupancyGrid | None = None
    seconds: float | None = None

    @property
    def stamps(self) -> Array:
        """Stamps (n,) of the rows shown, s."""
        return self.recording.frame_stamps[self.rows]

    @property
    def fps(self) -> float:
        """Pictures a second."""
        return len(self.rows) / (self.seconds or max(float(np.ptp(self.stamps)), 1.0 / FPS))

    def clock(self, stamp: float) -> str:
        """Time since the start, and the whole time."""
        stamps = self.recording.frame_stamps
        return f"{stamp - stamps[0]:.1f} of {stamps[-1] - stamps[0]:.1f}"

    def belief_row(self, stamp: float) -> int:
        """Row of the last belief up to a time; -1 before the first, or without an estimate."""
        return -1 if self.estimate is None else _last(self.estimate.stamps, stamp)

    def pose_at(self, stamp: float) -> Array:
        """Where the robot is believed to be, else where it is; NaN if neither is known."""
        row = self.belief_row(stamp)
        poses = (
            self.truth_at(np.array([stamp]))
            if self.estimate is None or row < 0
            else self.estimate.means[row:]
        )
        return np.asarray(poses[0])

    def truth_at(self, stamps: Array) -> Array:
        """True poses (N, 3) at stamps (N,); NaN where they are not known."""
        known = self.recording.truth is not None
        return self.recording.truth_at(stamps) if known else np.full((len(stamps), 3), np.nan)


def shown_rows(recording: Recording, n_shown: int) -> NDArray[np.int64]:
    """Rows of the Frames nearest to `n_shown` instants, evenly spaced in time."""
    stamps = recording.frame_stamps
    instants = np.linspace(stamps[0], stamps[-1], max(n_shown, 2))
    return np.unique(np.clip(np.searchsorted(stamps, instants), 0, len(stamps) - 1))


def estimate_of(
    recording: Recording,
    source: str,
    overrides: Sequence[str],
    rows: NDArray[np.int64],
    on_step: Callable[[int], None],
) -> tuple[Estimate, str]:
    """Read an estimate, or make one.

    Parameters
    ----------
    source
        A trajectory's file, the folder of a run with an `estimate.csv`, or the name of an estimator
        to run over the recording.
    overrides
        Hydra overrides for that estimator.
    rows
        Frames at which particles and landmarks are kept.
    on_step
        Called with the number of Frames done.

    Returns
    -------
    tuple
        The estimate and its name.
    """
    path = Path(source)
    if is_file_of_estimate(path):
        if overrides:
            raise InputError(f"{overrides[0]}: overrides are for estimators that are run now")
        return read_estimate(recording, path), "estimate"
    return estimate_by(
        experiment_over(recording, source, overrides), recording, rows, on_step
    ), source


def estimate_by(
    experiment: Experiment,
    recording: Recording,
    rows: NDArray[np.int64],
    on_step: Callable[[int], None],
    repeat: int = 0,
) -> Estimate:
    """Online estimate of an experiment's estimator, with what is drawn at the shown Frames."""
    if "keep_map" in experiment.config["estimator"]:
        experiment = experiment.with_estimator(keep_map=True)
    sparing = _Sparing(experiment.estimator(), set(rows.tolist()))
    rng = stream(experiment.seed, f"estimator/{experiment.estimator_name}", repeat)
    return run_estimator(sparing, recording, experiment.prior(recording), rng, _EXTRAS, on_step)


def is_file_of_estimate(path: Path) -> bool:
    """Whether a word is a trajectory's file or a run's folder, and no estimator's name."""
    of_run = path.is_dir() and (len(path.parts) > 1 or any(path.glob("estimate*.csv")))
    return path.suffix in TRAJECTORIES or of_run


def read_estimate(recording: Recording, path: Path) -> Estimate:
    """Read a recording's estimate from a file, or from the folder of a run.

    Raises
    ------
    InputError
        If it cannot be read, is not finite, or belongs to another recording.
    """
    if path.is_dir():
        require(
            not (path / "estimate_0.csv").exists(),
            f"{path}: the run of a team; its robots' estimates are {path}/estimate_0.csv and on",
        )
        path /= "estimate.csv"
    stamps = recording.frame_stamps
    estimate = read_odometry_csv(path) if path.suffix == ".csv" else read_trajectory(path)
    require(
        ((estimate.stamps >= stamps[0]) & (estimate.stamps <= stamps[-1])).any(),
        f"{path}: no stamp of it lies within the recording; is it another's?",
    )
    sound = np.isfinite(estimate.means).all(axis=1)
    require(sound.all(), f"{path}:{2 + int(np.argmin(sound))}: a pose that is not finite")
    return estimate


def experiment_over(recording: Recording, estimator: str, overrides: Sequence[str]) -> Experiment:
    """Experiment of an estimator's option over a recording, with the recording's own robot."""
    robot = dataclasses.asdict(recording.robot)  # and its slip, if that is known
    made_with = recording.config.get("robot")
    if isinstance(made_with, dict):  # else, of a log of many robots, the number of one
        robot |= {key: value for key, value in made_with.items() if key in ("kr", "kl")}
    given = [f"robot.{key}={value}" for key, value in robot.items()]
    return Experiment.compose([f"estimator={estimator}", *given, *overrides])


class _Sparing:
    """An estimator whose extras are kept at the shown Frames only, to save memory."""

    def __init__(self, estimator: Estimator, shown: Collection[int]) -> None:
        self._estimator, self._shown, self._row = estimator, shown, -1

    def reset(self, prior: Any, rng: np.random.Generator) -> None:
        self._row = -1
        self._estimator.reset(prior, rng)

    def step(self, frame: Frame) -> Belief:
        belief = self._estimator.step(frame)
        self._row += 1
        kept = _EXTRAS if self._row in self._shown else ()
        copied = {k: np.array(v) for k, v in belief.extras.items() if k in kept}
        return Belief(belief.mean, belief.covariance, copied)


def seen_points(run: Playback, name: str, stamp: float) -> Array:
    """Points (N, 2) in map of a sensor's last reading up to a time."""
    log, sensor = run.recording.logs[name], run.recording.sensors[name]
    row = _last(log.stamps, stamp)
    pose = run.pose_at(float(log.stamps[row])) if row >= 0 else np.full(3, np.nan)
    if not np.isfinite(pose).all():
        return np.zeros((0, 2))
    drawn: Any = getattr(sensor, "points_in_base")(log.reading(row))  # noqa: B009
    return se2.transform(pose, drawn[:, :2])


def seen(run: Playback, stamp: float) -> Array:
    """Points (N, 2) in map of all sensors' last readings up to a time."""
    names = _sensor_layers(run.recording)
    return np.concatenate([np.zeros((0, 2)), *(seen_points(run, name, stamp) for name in names)])


def _last(stamps: Array, stamp: float) -> int:
    """Row of the last of the stamps up to a time, or -1."""
    return int(np.searchsorted(stamps, stamp + 1e-9, side="right")) - 1


def ellipse_outlines(means: Array, covariances: Array) -> Array:
    """95 % ellipses of means (N, 2), covariances (N, 2, 2) as one line, with gaps of NaN."""
    values, vectors = np.linalg.eigh(covariances)
    axes = vectors * np.sqrt(CHI2_95_2DOF * np.maximum(values, 0.0))[:, None, :]
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    outlines = means[:, None, :] + circle @ axes.transpose(0, 2, 1)
    return np.concatenate([outlines, np.full((len(means), 1, 2), np.nan)], axis=1).reshape(-1, 2)


def pictures(run: Playback) -> Iterator[Picture]:
    """The run as pictures (H, W, 3) with even sides, one for each row shown."""
    recording = run.recording
    truth = None if recording.truth is None else recording.truth_at(recording.frame_stamps)
    around = bounds(run, truth)
    glyph_m = max(recording.robot.track_m / 2.0, 0.012 * (around[2] - around[0]))
    layers = _layers(run, truth is not None)
    instants = (_instant(run, int(row), truth, glyph_m) for row in run.rows)
    landmarks = sees_landmarks(recording)
    yield from animated(around, recording.world, run.grid, layers, instants, landmarks)


def animated(
    around: tuple[float, float, float, float],
    world: World | None,
    grid: OccupancyGrid | None,
    layers: Mapping[str, Layer],
    instants: Iterable[tuple[dict[str, Array], str]],
    landmarks: bool = True,
) -> Iterator[Picture]:
    """Pictures (H, W, 3) with even sides of what moves on a map; what never moves is drawn once.

    Parameters
    ----------
    around
        What the map shows: x and y of its lower left and of its upper right corner, m.
    layers
        What moves, from the lowest up.
    instants
        Of each picture: points (N, 2) of the layers, and the title.
    landmarks
        Whether those of the world are drawn.
    """
    x1, y1, x2, y2 = around
    page, ax = subplots(8.0, float(np.clip(7.0 * (y2 - y1) / (x2 - x1), 2.0, 8.0)) + 1.2)
    page.set_dpi(_DPI)
    if grid is not None:
        draw_grid(ax, grid)
    if world is not None:
        draw_world(ax, world, landmarks=landmarks)
    moving = {
        key: ax.plot([], [], style, color=color, label=label, animated=True, **more)[0]
        for key, (style, color, label, more) in layers.items()
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
    for points, words in instants:
        canvas.restore_region(background)
        for key, line in moving.items():
            line.set_data(*points.get(key, np.zeros((0, 2))).T)
            ax.draw_artist(line)
        title.set_text(words)
        ax.draw_artist(title)
        image = np.asarray(canvas.buffer_rgba())[..., :3]
        yield image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2].copy()


def _layers(run: Playback, known: bool) -> dict[str, Layer]:
    """Moving layers from the lowest up: style, colour, label, further settings."""
    recording = run.recording
    extras = {} if run.estimate is None else run.estimate.extras
    particles, mapped = (
        any(value is not None and len(value) for value in extras.get(name, []))
        for name in ("particles", "landmarks")
    )
    estimated = run.estimate is not None
    layers: dict[str, _Layer] = {
        "particles": (particles, ".", SKY, "particles", {"ms": 3, "alpha": 0.6}),
        **_sensor_layers(recording),
        "landmarks": (mapped, "-", GREEN, "landmarks, 95 %", {"lw": 0.8}),
        "truth": (known, "-", TRUTH, "truth", {"lw": 1.6}),
        "truth robot": (known, "-", TRUTH, "", {"lw": 1.4}),
        "estimate": (estimated, "--", ESTIMATE, literal(run.name), {"lw": 1.3}),
        "estimate robot": (estimated, "-", ESTIMATE, "", {"lw": 1.4}),
        "ellipse": (estimated, "-", ESTIMATE, "its 95 % ellipse", {"lw": 0.9}),
    }
    return {name: layer[1:] for name, layer in layers.items() if layer[0]}


def _sensor_layers(recording: Recording) -> dict[str, _Layer]:
    """Layers of the sensors whose readings can be drawn: dots of scans, crosses of landmarks."""
    layers: dict[str, _Layer] = {}
    shown = [n for n in recording.logs if hasattr(recording.sensors[n], "points_in_base")]
    for name, color in zip(shown, itertools.cycle((RED, ORANGE, PURPLE, BLUE, YELLOW))):
        few = recording.logs[name].splits is not None
        layers[name] = (True, "x" if few else ".", color, name, {"ms": 5 if few else 2})
    return layers


def _instant(
    run: Playback, frame: int, truth: Array | None, glyph_m: float
) -> tuple[dict[str, Array], str]:
    """Points of every moving layer at a Frame, and the title."""
    stamps = run.recording.frame_stamps
    stamp = float(stamps[frame])
    points = {name: seen_points(run, name, stamp) for name in _sensor_layers(run.recording)}
    words = f"{run.clock(stamp)} s"
    if truth is not None:
        points["truth"] = truth[: frame + 1, :2]
        points["truth robot"] = robot_outline(truth[frame], glyph_m)
    row = run.belief_row(stamp)
    if run.estimate is None or row < 0:
        return points, words
    mean, covariance = run.estimate.means[row], run.estimate.covariances[row]
    points["estimate"] = run.estimate.means[: row + 1, :2]
    points["estimate robot"] = robot_outline(mean, glyph_m)
    if np.isfinite(covariance).all():
        points["ellipse"] = ellipse_outlines(mean[None, :2], covariance[None, :2, :2])
    extras = {k: v[row] for k, v in run.estimate.extras.items() if v[row] is not None}
    if "particles" in extras:
        particles = extras["particles"]
        points["particles"] = particles[:: -(-len(particles) // _MOST_PARTICLES) or 1, :2]
    if "landmarks" in extras and "landmark_covariances" in extras:
        flat = extras["landmark_covariances"][:, :2, :2]
        points["landmarks"] = ellipse_outlines(extras["landmarks"][:, :2], flat)
    if truth is not None and np.isfinite(truth[frame]).all():
        words += f", position error {np.hypot(*(mean - truth[frame])[:2]):.3f} m"
    return points, words


def robot_outline(pose: Array, radius_m: float) -> Array:
    """A circle about a pose, and a line from it to where the robot heads, (N, 2)."""
    angle = pose[2] + np.linspace(0.0, 2.0 * np.pi, 25)
    circle = pose[:2] + radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    front = pose[:2] + 1.8 * radius_m * np.array([np.cos(pose[2]), np.sin(pose[2])])
    return np.concatenate([circle, front[None]])


def bounds(run: Playback, truth: Array | None) -> tuple[float, float, float, float]:
    """What the map shows: the world and the path, with a margin.

    A diverging estimate is followed to twice the size of all else.
    """
    world = run.recording.world
    none = np.zeros((0, 2))
    known = np.concatenate(
        [
            none if truth is None else truth[:, :2],
            none if world is None else world.walls.reshape(-1, 2),
            none if run.grid is None else run.grid.corners_m,
        ]
    )
    means = none if run.estimate is None else run.estimate.means[:, :2]
    known, means = (points[np.isfinite(points).all(axis=1)] for points in (known, means))
    if len(known) and len(means):
        low, high = known.min(axis=0), known.max(axis=0)
        reach = (high - low).max() / 2.0
        means = np.clip(means, low - reach, high + reach)
    corners = np.concatenate([known, means])
    require(len(corners), "this log has no truth to show; name an estimator with --estimate")
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.05 * max((high - low).max(), 1.0) + run.recording.robot.track_m
    x1, y1, x2, y2 = (float(side) for side in (*(low - margin), *(high + margin)))
    return x1, y1, x2, y2


def check_output(path: Path) -> None:
    """Refuse a file that could not be written, before anything is computed."""
    require(path.suffix in SUFFIXES, f"{path}: animations are {', '.join(SUFFIXES)}")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise InputError(f"{path}: MP4 needs ffmpeg, which is not installed; take .gif or .html")


class Played(Protocol):
    """What plays: a robot's run, or a team's."""

    @property
    def stamps(self) -> Array:
        """Stamps (n,) of the pictures, s."""

    @property
    def fps(self) -> float:
        """Pictures a second."""

    def clock(self, stamp: float) -> str:
        """Time since the start, and the whole time."""


def speed(run: Played) -> str:
    """How fast a run plays, in words."""
    factor = float(f"{np.ptp(run.stamps) * run.fps / len(run.stamps):.2g}")
    return "real time" if factor == 1.0 else f"{factor:g} times real time"


def save(
    run: Played,
    images: Iterator[Picture],
    path: Path,
    on_progress: Callable[[float], None],
    title: str = "A run",
) -> None:
    """Write a run's pictures as `.mp4` (needs ffmpeg), `.gif` or `.html`, whole or not at all.

    Parameters
    ----------
    on_progress
        Called with the share done.
    title
        Of an `.html`.
    """
    check_output(path)

    def counted() -> Iterator[Picture]:
        for done, picture in enumerate(images, start=1):
            yield picture
            on_progress(done / len(run.stamps))

    with write_whole(path) as part:
        if path.suffix == ".html":
            _write_html(run, counted(), part, title)
        else:
            {".mp4": _write_mp4, ".gif": _write_gif}[path.suffix](run, counted(), part)


def _write_mp4(run: Played, images: Iterator[Picture], path: Path) -> None:
    first = next(images)
    size = f"{first.shape[1]}x{first.shape[0]}"
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{run.fps:.4f}", "-i", "-"]
    command = ["ffmpeg", "-y", "-loglevel", "error", *raw, "-pix_fmt", "yuv420p", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        try:
            process.stdin.write(first.tobytes())
            for image in images:
                process.stdin.write(image.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # its message says why
        message = process.stderr.read().decode(errors="replace").strip()
    require(
        not process.returncode,
        f"ffmpeg: {(message.splitlines() or ['failed'])[-1]}; take .gif or .html",
    )


def _reduced(image: Picture) -> Any:
    """The picture with a palette of its own: a third of the size, with no visible difference."""
    from PIL import Image

    return Image.fromarray(image).quantize(96, method=Image.Quantize.FASTOCTREE)


def _write_gif(run: Played, images: Iterator[Picture], path: Path) -> None:
    first, *rest = (_reduced(image) for image in images)
    duration_ms = round(1000.0 / run.fps)
    first.save(path, "GIF", save_all=True, append_images=rest, duration=duration_ms, loop=0)


def _write_html(run: Played, images: Iterator[Picture], path: Path, title: str) -> None:
    frames: list[str] = []
    for image in images:
        data = io.BytesIO()
        _reduced(image).save(data, format="PNG")
        frames.append("data:image/png;base64," + base64.b64encode(data.getvalue()).decode())
    values = {
        "width": image.shape[1],
        "height": image.shape[0],
        "last": len(frames) - 1,
        "speed": speed(run),
        "fps": f"{run.fps:.4f}",
        "times": ", ".join(f'"{run.clock(float(stamp))} s"' for stamp in run.stamps),
        "first": frames[0],
        "frames": ",\n".join(f'"{frame}"' for frame in frames),
        "title": html.escape(title),
    }
    page = (Path(__file__).parent / "player.html").read_text(encoding="utf-8")
    for name, value in values.items():
        page = page.replace(f"@{name}@", str(value))
    path.write_text(page, encoding="utf-8")
