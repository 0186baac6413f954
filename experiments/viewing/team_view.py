"""A team as an animation: all robots' paths, estimates and sightings on one clock."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimators.base import Estimate
from estimators.team import run_team
from experiments.runs.seeds import stream
from experiments.viewing.plotting import literal
from experiments.viewing.style import BLACK
from experiments.viewing.team_figure import colour_of, sightings
from experiments.viewing.view import (
    FPS,
    Layer,
    Picture,
    Playback,
    animated,
    bounds,
    ellipse_outlines,
    experiment_over,
    is_file_of_estimate,
    read_estimate,
    robot_outline,
    shown_rows,
)
from sim.arrays import Array
from sim.errors import InputError
from sim.team import Team
from sim.worlds.grid import OccupancyGrid

_SEEN_S = 1.0  # how long a sighting is shown


@dataclass(frozen=True)
class TeamPlayback:
    """What is shown of a team.

    Attributes
    ----------
    robots
        What is shown of each.
    stamps
        (n,) of the pictures, s.
    grid
        A map to draw underneath, or None.
    seconds
        How long it plays, s; None: in real time.
    """

    robots: tuple[Playback, ...]
    stamps: Array
    grid: OccupancyGrid | None = None
    seconds: float | None = None

    @classmethod
    def of(cls, team: Team, n_shown: int) -> "TeamPlayback":
        """The team at about `n_shown` instants, evenly spaced in time."""
        robots = tuple(Playback(robot, shown_rows(robot, n_shown)) for robot in team.robots)
        first = min(robot.frame_stamps[0] for robot in team.robots)
        last = max(robot.frame_stamps[-1] for robot in team.robots)
        return cls(robots, np.linspace(first, last, max(n_shown, 2)))

    def beside(self, estimates: Sequence[Estimate], name: str) -> "TeamPlayback":
        """The team with an estimate of each robot."""
        robots = zip(self.robots, estimates, strict=True)
        shown = tuple(replace(own, estimate=estimate, name=name) for own, estimate in robots)
        return replace(self, robots=shown)

    @property
    def fps(self) -> float:
        """Pictures a second."""
        return len(self.stamps) / (self.seconds or max(float(np.ptp(self.stamps)), 1.0 / FPS))

    def clock(self, stamp: float) -> str:
        """Time since the start, and the whole time."""
        return f"{stamp - self.stamps[0]:.1f} of {self.stamps[-1] - self.stamps[0]:.1f}"


def with_estimates(
    shown: TeamPlayback, team: Team, source: str, overrides: Sequence[str],
    on_step: Callable[[int], None],
) -> TeamPlayback:  # fmt: skip
    """The team with the estimates of a run's folder, or of an estimator to run now.

    The robots' starts are known, and they always talk.
    """
    path = Path(source)
    if is_file_of_estimate(path):
        if overrides:
            raise InputError(f"{overrides[0]}: overrides are for estimators that are run now")
        if not path.is_dir():
            raise InputError(f"{path}: an estimate of one robot; name the folder of a team's run")
        found = [
            read_estimate(robot, path / f"estimate_{number}.csv")
            for number, robot in enumerate(team.robots)
        ]
        name = "estimate"
    else:
        experiment, name = experiment_over(team.robots[0], source, overrides), source
        priors = [experiment.prior(robot, number) for number, robot in enumerate(team.robots)]
        answers = run_team(
            experiment.team_estimator,
            team,
            priors,
            lambda robot: stream(experiment.seed, f"estimator/{experiment.estimator_name}", robot),
            on_step=on_step,
        )
        found = [revised or online for online, revised in answers]
    return shown.beside(found, name)


def pictures(run: TeamPlayback) -> Iterator[Picture]:
    """The team as pictures, one for each stamp."""
    recordings = [own.recording for own in run.robots]
    sides = np.array([bounds(own, _truth(own)) for own in run.robots])
    around = (*sides[:, :2].min(axis=0).tolist(), *sides[:, 2:].max(axis=0).tolist())
    seen = [sightings(recordings, number) for number in range(len(recordings))]
    layers: dict[str, Layer] = {}
    for number, own in enumerate(run.robots):
        colour, label = colour_of(number), f"robot {number}"
        layers[f"seen {number}"] = ("-", colour, "", {"lw": 0.7, "alpha": 0.6})
        layers[f"truth {number}"] = ("-", colour, label, {"lw": 1.6})
        layers[f"robot {number}"] = ("-", colour, "", {"lw": 1.4})
        if own.estimate is not None:
            label = f"{literal(own.name)} and 95 % ellipse" if number == 0 else ""
            layers[f"estimate {number}"] = ("--", BLACK, label, {"lw": 1.0})
            layers[f"ellipse {number}"] = ("-", BLACK, "", {"lw": 0.8})

    def instant(stamp: float) -> tuple[dict[str, Array], str]:
        points: dict[str, Array] = {}
        for number, own in enumerate(run.robots):
            when, lines = seen[number]
            now = (when <= stamp + 1e-9) & (when > stamp - _SEEN_S)
            gaps = np.full((int(now.sum()), 1, 2), np.nan)
            points[f"seen {number}"] = np.concatenate([lines[now], gaps], axis=1).reshape(-1, 2)
            stamps = own.recording.frame_stamps
            at = float(np.clip(stamp, stamps[0], stamps[-1]))  # afterwards it stands there
            radius_m = max(own.recording.robot.track_m / 2.0, 0.012 * (around[2] - around[0]))
            if (truth := _truth(own)) is not None:
                points[f"truth {number}"] = truth[stamps <= at + 1e-9, :2]
                points[f"robot {number}"] = robot_outline(own.truth_at(np.array([at]))[0], radius_m)
            row = own.belief_row(at)
            if own.estimate is not None and row >= 0:
                mean, covariance = own.estimate.means[row], own.estimate.covariances[row]
                points[f"estimate {number}"] = own.estimate.means[: row + 1, :2]
                if np.isfinite(covariance).all():
                    ellipse = ellipse_outlines(mean[None, :2], covariance[None, :2, :2])
                    points[f"ellipse {number}"] = ellipse
        return points, f"{run.clock(stamp)} s"

    world = recordings[0].world
    return animated(around, world, run.grid, layers, map(instant, run.stamps.tolist()))


def _truth(own: Playback) -> Array | None:
    recording = own.recording
    return None if recording.truth is None else recording.truth_at(recording.frame_stamps)
