"""What an animation shows: robots with what is believed of them, on one clock."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimators.base import Estimate
from sim.arrays import Array, Ints
from sim.recording import Recording
from sim.team import Team
from sim.worlds.grid import OccupancyGrid

FPS = 10


@dataclass(frozen=True)
class RobotTrack:
    """A robot's recording, and beliefs or None; they have extras at the shown Frames.

    Attributes
    ----------
    others
        Estimates of the same drive to draw over it, by name, without their extras.
    """

    recording: Recording
    estimate: Estimate | None = None
    others: tuple[tuple[str, Estimate], ...] = ()

    @property
    def estimates(self) -> list[Estimate]:
        """All of them, its own first."""
        own = [] if self.estimate is None else [self.estimate]
        return [*own, *(other for _, other in self.others)]

    def belief_row(self, stamp: float) -> int:
        """Row of the last belief up to a time; -1 before the first, or without an estimate."""
        return -1 if self.estimate is None else last_row(self.estimate.stamps, stamp)

    def pose_at(self, stamp: float) -> Array:
        """Where the robot is believed to be, else where it is; NaN if neither is known."""
        row = self.belief_row(stamp)
        if self.estimate is None or row < 0:
            return np.asarray(self.truth_at(np.array([stamp]))[0])
        return np.asarray(self.estimate.means[row])

    def truth_at(self, stamps: Array) -> Array:
        """True poses (N, 3) at stamps (N,); NaN where they are not known."""
        known = self.recording.truth is not None
        return self.recording.truth_at(stamps) if known else np.full((len(stamps), 3), np.nan)


@dataclass(frozen=True)
class Playback:
    """What is shown of one robot or of several.

    Attributes
    ----------
    robots
        What is shown of each.
    stamps
        (n,) of the pictures, s.
    name
        Of the estimates.
    grid
        A map to draw underneath, or None.
    seconds
        How long it plays, s; None: in real time.
    """

    robots: tuple[RobotTrack, ...]
    stamps: Array
    name: str = "estimate"
    grid: OccupancyGrid | None = None
    seconds: float | None = None

    @classmethod
    def of(cls, team: Team, n_shown: int) -> "Playback":
        """Show a team at about `n_shown` instants, evenly spaced in time.

        A robot alone is shown at its Frames, at which its particles are kept.
        """
        frames = [robot.frame_stamps for robot in team.robots]
        first, last = min(own[0] for own in frames), max(own[-1] for own in frames)
        stamps = np.linspace(first, last, max(n_shown, 2))
        if len(frames) == 1:
            rows = np.clip(np.searchsorted(frames[0], stamps), 0, len(frames[0]) - 1)
            stamps = frames[0][np.unique(rows)]
        return cls(tuple(map(RobotTrack, team.robots)), stamps)

    @property
    def rows(self) -> Ints:
        """Rows (n,) of robot 0's Frames that are shown."""
        frames = self.robots[0].recording.frame_stamps
        return np.minimum(np.searchsorted(frames, self.stamps), len(frames) - 1)

    @property
    def fps(self) -> float:
        """Pictures a second."""
        return len(self.stamps) / (self.seconds or max(float(np.ptp(self.stamps)), 1.0 / FPS))

    def with_estimates(self, estimates: Sequence[Estimate], name: str) -> "Playback":
        """Show an estimate of each robot too."""
        robots = zip(self.robots, estimates, strict=True)
        shown = (replace(own, estimate=estimate) for own, estimate in robots)
        return replace(self, robots=tuple(shown), name=name)

    def clock(self, stamp: float) -> str:
        """Time since the start, and the whole time."""
        return f"{stamp - self.stamps[0]:.1f} of {self.stamps[-1] - self.stamps[0]:.1f}"

    @property
    def speed(self) -> str:
        """How fast it plays, in words."""
        factor = float(f"{np.ptp(self.stamps) * self.fps / len(self.stamps):.2g}")
        return "real time" if factor == 1.0 else f"{factor:g} times real time"


def last_row(stamps: Array, stamp: float) -> int:
    """Row of the last of the stamps up to a time, or -1."""
    return int(np.searchsorted(stamps, stamp + 1e-9, side="right")) - 1
