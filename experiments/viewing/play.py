"""A run as it moves: in a window, or in a file. Pictures of worlds and maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from experiments.runs import paths
from experiments.runs.console import enumerate_words, progress, say_choice
from experiments.runs.experiment import Experiment
from experiments.viewing import live, movie
from experiments.viewing.estimates import OnStep, with_all_estimates
from experiments.viewing.grid import grid_figure
from experiments.viewing.playback import FPS, Playback
from experiments.viewing.style import save_figure
from experiments.viewing.world import world_figure
from sim.errors import require
from sim.formats.detect import read_all
from sim.team import Team
from sim.worlds.grid_file import read_grid

MOST_PICTURES = 200  # of a file: a page of 1 to 3 MB
REAL_TIME_S = 70.0  # longest drive of which so many show three instants a second
SECONDS = 20.0  # how long a longer drive plays


@dataclass(frozen=True)
class Showing:
    """How a run is shown.

    Attributes
    ----------
    out
        File to write; None for a window, which shows one robot.
    seconds
        How long it plays, s; None: in real time, or if a file of a long drive, `SECONDS`.
    grid
        File of a map to draw underneath, in files only.

    Raises
    ------
    InputError
        If the file could not be written, or a window should show a map.
    """

    out: Path | None = None
    seconds: float | None = None
    grid: Path | None = None

    def __post_init__(self) -> None:
        seconds = self.seconds
        require(
            seconds is None or 0.0 < seconds <= 3600.0,
            f"seconds must lie between 0 and 3600, got {seconds}",
        )
        require(
            self.out is not None or self.grid is None,
            f"{self.grid}: a map is drawn in files only; name one, such as run.html",
        )
        if self.out is not None:
            movie.check_output(self.out)

    def length_s(self, drive_s: float) -> float:
        """How long a drive plays, s."""
        in_real_time = self.out is None or drive_s <= REAL_TIME_S
        return self.seconds or (drive_s if in_real_time else SECONDS)

    def n_pictures(self, drive_s: float) -> int:
        """How many pictures of it are shown."""
        count = int(self.length_s(drive_s) * (live.FPS if self.out is None else FPS))
        limited = self.out is not None and self.seconds is None
        return min(count, MOST_PICTURES) if limited else count


def play(
    team: Team,
    how: Showing,
    called: str,
    names: Sequence[str] = (),
    estimated: Callable[[Playback, OnStep], Playback] = lambda shown, _: shown,
) -> str:
    """Show a run; say what was written, or nothing of a window.

    Parameters
    ----------
    called
        What the run is called.
    names
        Of the estimates, drawn over one another; empty for the recordings alone.
    estimated
        Gives the playback with its estimates.
    """
    many = "several estimates are drawn in files, of a robot alone; name one, such as run.html"
    require(len(names) < 2 or (len(team) == 1 and how.out is not None), many)
    grid = None if how.grid is None else read_grid(how.grid)
    if how.out is None:
        require(len(team) == 1, "a team is drawn in files; name one, such as team.html")
        live.check_display()
    shown, label = (
        Playback.of(team, how.n_pictures(team.duration_s)),
        enumerate_words([Path(name).name for name in names]),
    )
    if names:
        n_steps = len(names) * sum(len(robot.frame_stamps) for robot in team.robots)
        with progress(label, n_steps) as on_step:
            shown = estimated(shown, on_step)
    if how.out is None:
        live.watch(shown, how.seconds)
        return ""
    shown = replace(shown, grid=grid, seconds=how.length_s(team.duration_s))
    title = f"{label}: {called}" if names else called
    with progress(f"drawing {how.out.name}", 1.0) as on_progress:
        movie.save(shown, how.out, on_progress, title)
    size = f"{len(shown.stamps)} pictures, {shown.seconds:.1f} s"
    return f"{paths.short(how.out)}: {size}, {shown.speed}"


def play_file(log: Path, sources: Sequence[str], overrides: Sequence[str], how: Showing) -> str:
    """Show a log, with the estimates of sources if they are given; see `play`.

    Parameters
    ----------
    sources, overrides
        As for `viewing.estimates.with_all_estimates`.
    """
    team = read_all([log])
    say_choice(log, team.robots[0])
    return play(
        team,
        how,
        log.name,
        sources,
        lambda shown, on_step: with_all_estimates(shown, sources, overrides, on_step),
    )


def draw_world(overrides: Sequence[str], out: Path) -> Path:
    """Write the picture of the world of a configuration."""
    given = [f"world={o}" if "=" not in o else o for o in overrides]
    save_figure(world_figure(Experiment.compose(given).world()), out)
    return out


def draw_map(path: Path, out: Path) -> Path:
    """Write the picture of an occupancy grid's file."""
    save_figure(grid_figure(read_grid(path), path.stem), out)
    return out
