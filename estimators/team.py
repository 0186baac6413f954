"""How a team's estimators run: what each knows of the other robots, and when."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from estimators.base import Belief, Estimate, Prior
from estimators.gaussian import Gaussian
from estimators.landmarks.sightings import dead_reckoning
from estimators.options import require_choices
from sim.compiled import wall_s
from sim.errors import require, required
from sim.recording import Frame
from sim.team import Team

Kind = Literal["always", "range", "delayed", "never"]
Step = tuple[float, Belief, float]  # stamp, belief, seconds of the step
Answer = tuple[Estimate, Estimate | None]  # of one robot: online and revised


class TeamEstimator(Protocol):
    """A method for teams. It may also have `finish_team() -> list[Estimate]`, revised paths."""

    wheels: Any

    def reset_team(self, priors: Sequence[Prior], rng: np.random.Generator) -> None:
        """Forget everything and start from the priors of the robots."""
        ...

    def step_team(self, frames: Sequence[Frame]) -> list[Belief]:
        """Take in Frames of one instant; the belief of each of their robots."""
        ...


@dataclass(frozen=True)
class Communication:
    """Which Frames reach whom.

    Attributes
    ----------
    kind
        `always`: one filter has all Frames at once. `never`: each robot has its own, and cannot use
        its sightings. `range`: each robot has a filter of the team; robots within `range_m`, also
        by way of others, give each other all Frames that they have, each once. `delayed`: one
        filter, whose answers come `delay_s` late; meanwhile a robot reckons by its wheels.
    range_m, delay_s
        Of these kinds; None for the others.
    """

    kind: Kind = "always"
    range_m: float | None = None
    delay_s: float | None = None

    def __post_init__(self) -> None:
        require_choices("team.communication.", kind=(self.kind, Kind))
        for kind, name in (("range", "range_m"), ("delayed", "delay_s")):
            value = getattr(self, name)
            if self.kind == kind:
                number = isinstance(value, (int, float)) and not isinstance(value, bool)
                sound = number and 0.0 < value < np.inf
                require(
                    sound, f"team.communication.{name} must be a positive number, got {value!r}"
                )
            else:
                require(
                    value is None,
                    f"team.communication.{name} has no effect on kind={self.kind}; set it to null",
                )


def run_team(
    make: Callable[[], TeamEstimator],
    team: Team,
    priors: Sequence[Prior],
    rng: Callable[[int], np.random.Generator],
    communication: Communication | None = None,
    contacts: NDArray[np.bool_] | None = None,
    on_step: Callable[[int], None] | None = None,
) -> list[Answer]:
    """Run estimators over a team's recordings, instant by instant.

    Parameters
    ----------
    make
        Makes an estimator.
    rng
        Gives the generator of each robot's filter; a common filter has that of robot 0.
    communication
        By default always.
    contacts
        (T, R, R), for the kind `range`: which robots are in range at each instant.
    on_step
        Called with the number of Frames done.

    Returns
    -------
    list
        Of each robot, the online estimate at its Frames, and the revised one or None.
    """
    kind = (communication or Communication()).kind
    counted = _counter(on_step or (lambda _: None))
    if kind == "never":
        return [
            _run_alone(make(), map(counted, recording.frames()), prior, rng(number))
            for number, (recording, prior) in enumerate(zip(team.robots, priors, strict=True))
        ]
    instants = (tuple(map(counted, frames)) for frames in team.instants())
    if kind == "range":
        near = required(contacts, "communication by range needs the contacts of the robots")
        return _run_in_contact(make, instants, priors, rng, near)
    estimator = make()
    estimator.reset_team(priors, rng(0))
    steps: list[list[Step]] = [[] for _ in priors]
    for frames in instants:
        for robot, each in _stepped(estimator, frames).items():
            steps[robot].append(each)
    if communication is not None and communication.delay_s is not None:
        late = dead_reckoning(estimator.wheels, priors)
        return [
            (_estimate(_late(*each, communication.delay_s), estimator), None)
            for each in zip(steps, team.robots, priors, late, strict=True)
        ]
    revised = _revised(estimator, len(priors))
    return [(_estimate(each, estimator), path) for each, path in zip(steps, revised, strict=True)]


def _counter(on_step: Callable[[int], None]) -> Callable[[Frame], Frame]:
    """Function that passes Frames on, and tells how many."""
    numbers = itertools.count(1)

    def counted(frame: Frame) -> Frame:
        on_step(next(numbers))
        return frame

    return counted


def _stepped(estimator: TeamEstimator, frames: Sequence[Frame]) -> dict[int, Step]:
    """Beliefs by robot after one instant; the time is shared out evenly."""
    begun = wall_s()
    beliefs = estimator.step_team(frames)
    share_s = (wall_s() - begun) / len(frames)
    return {
        frame.robot: (frame.stamp, belief, share_s)
        for frame, belief in zip(frames, beliefs, strict=True)
    }


def _run_alone(
    estimator: TeamEstimator, frames: Iterator[Frame], prior: Prior, rng: np.random.Generator
) -> Answer:
    estimator.reset_team((prior,), rng)
    steps = [_stepped(estimator, (frame,))[0] for frame in frames]
    return _estimate(steps, estimator), _revised(estimator, 1)[0]


def _run_in_contact(
    make: Callable[[], TeamEstimator],
    instants: Iterator[tuple[Frame, ...]],
    priors: Sequence[Prior],
    rng: Callable[[int], np.random.Generator],
    contacts: NDArray[np.bool_],
) -> list[Answer]:
    """Each robot with a filter of the team, which takes in each Frame that reaches it once."""
    n = len(priors)
    filters = [make() for _ in range(n)]
    for number, each in enumerate(filters):
        each.reset_team(priors, rng(number))
    logs: list[list[Frame]] = [[] for _ in range(n)]
    known, taken = np.zeros((2, n, n), np.int64)  # of each robot, how many Frames of each other
    steps: list[list[Step]] = [[] for _ in range(n)]
    for frames, near in zip(instants, contacts, strict=True):
        for frame in frames:
            logs[frame.robot].append(frame)
            known[frame.robot, frame.robot] += 1
        linked = np.linalg.matrix_power(near.astype(np.int64) + np.eye(n, dtype=np.int64), n) > 0
        known = np.array([known[own].max(axis=0) for own in linked])
        for frame in frames:
            robot = frame.robot
            news = [
                one
                for log, have, get in zip(logs, taken[robot], known[robot], strict=True)
                for one in log[have:get]
            ]
            taken[robot] = known[robot]
            news.sort(key=lambda one: (one.stamp, one.robot))
            for _, instant in itertools.groupby(news, key=lambda one: one.stamp):
                beliefs = _stepped(filters[robot], tuple(instant))
            steps[robot].append(beliefs[robot])
    return [
        (_estimate(each, one), _revised(one, n)[number])
        for number, (each, one) in enumerate(zip(steps, filters, strict=True))
    ]


def _late(
    steps: list[Step], recording: Any, prior: Prior, wheels: Any, delay_s: float
) -> list[Step]:
    """Beliefs that answers so late leave: the last answer, carried on by the wheels."""
    frames = list(recording.frames())
    motions = [wheels.predict(frame) for frame in frames]
    nowhere = np.full(3, np.nan), np.full((3, 3), np.nan)
    known = prior.mean is not None and prior.covariance is not None
    start = Gaussian(*((prior.mean, prior.covariance) if known else nowhere))
    answered, found = -1, []
    for row, frame in enumerate(frames):
        while answered + 1 < row and steps[answered + 1][0] <= frame.stamp - delay_s + 1e-9:
            answered += 1
        last = steps[answered][1] if answered >= 0 else None
        belief = start if last is None else Gaussian(last.mean, last.covariance)
        for motion in motions[answered + 1 : row + 1]:
            belief = belief.then(motion)
        found.append((frame.stamp, Belief(belief.mean, belief.covariance), steps[row][2]))
    return found


def _revised(estimator: TeamEstimator, n_robots: int) -> Sequence[Estimate | None]:
    finish = getattr(estimator, "finish_team", None)
    paths: Sequence[Estimate | None] = [None] * n_robots if finish is None else finish()
    return paths


def _estimate(steps: Sequence[Step], estimator: TeamEstimator) -> Estimate:
    odd = (
        f"{belief.extras['status']} at {stamp:.2f} s"
        for stamp, belief, _ in steps
        if belief.extras.get("status", "ok") != "ok"
    )
    return Estimate(
        stamps=np.array([stamp for stamp, _, _ in steps]),
        means=np.array([belief.mean for _, belief, _ in steps]),
        covariances=np.array([belief.covariance for _, belief, _ in steps]),
        step_seconds=np.array([seconds for _, _, seconds in steps]),
        map=getattr(estimator, "map", None),
        status=next(odd, "ok"),
    )
