"""How a team's estimators run: what each knows of the other robots, and when."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimators.base import (
    Answer,
    Estimate,
    Journal,
    Prior,
    detach,
    finish,
    run,
    run_and_finish,
    share_processor_time,
    walk,
)
from estimators.gaussian import Gaussian, stack
from estimators.landmarks.sightings import dead_reckoning
from sim.compiled import processor_s
from sim.errors import require, required
from sim.options import Positive, options
from sim.recording import Frame, Recording
from sim.team import Team

Kind = Literal["always", "range", "delayed", "never"]


@options("team.communication")
class Communication:
    """Which Frames reach whom."""

    kind: Kind = "always"
    """`always`: one filter has all Frames at once. `never`: each robot has its own, and cannot use
    its sightings. `range`: each robot has a filter of the team; robots within `range_m`, also
    by way of others, give each other all Frames that they have, each once. `delayed`: one
    filter, whose answers come `delay_s` late; meanwhile a robot reckons by its wheels."""
    range_m: Positive | None = None
    """Distance at which robots of `range` hear each other, m; null for the others."""
    delay_s: Positive | None = None
    """Time by which the answers of `delayed` are late, s; null for the others."""

    def __post_init__(self) -> None:
        for kind, name in (("range", "range_m"), ("delayed", "delay_s")):
            where, missing = f"team.communication.{name}", getattr(self, name) is None
            require(
                not missing or self.kind != kind, f"{where} must be a positive number, got None"
            )
            require(
                missing or self.kind == kind,
                f"{where} has no effect on kind={self.kind}; set it to null",
            )


def run_team(
    make: Callable[[], Any],
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
        Makes a `TeamEstimator`; of robots that never communicate, any `Estimator`.
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
        Of each robot, the online estimate at its Frames, and the revised one or None. Robots that
        communicate share the processor time.
    """
    communication = communication or Communication()
    count = itertools.count(1)
    tell = None if on_step is None else lambda _: on_step(next(count))
    if communication.kind == "never":
        return [
            run_and_finish(one, functools.partial(run, one, *of_robot, rng(number), on_step=tell))
            for number, of_robot in enumerate(zip(team.robots, priors, strict=True))
            for one in [make()]
        ]
    believed = [prior.robot.wheel_radius_m for prior in priors]
    own = [one.with_wheel_radius(m) for one, m in zip(team.robots, believed, strict=True)]
    team = Team(tuple(own))
    begun, n = processor_s(), len(team)
    filters = [make() for _ in range(n if communication.kind == "range" else 1)]
    for number, each in enumerate(filters):
        each.reset_team(*detach(priors, rng(number), *team.robots))
    of_robots = filters if len(filters) == n else n * filters
    journals = {
        number: Journal(each, recording, on_step=tell)
        for number, (each, recording) in enumerate(zip(of_robots, team.robots, strict=True))
    }
    if communication.kind == "range":
        near = required(contacts, "communication by range needs the contacts of the robots")
        for robot, instants in _heard(team.instants(), near):
            walk(filters[robot].step_team, instants, {robot: journals[robot]})
    else:
        walk(filters[0].step_team, team.instants(), journals)
    online = [journal.estimate() for journal in journals.values()]
    revised: Sequence[Estimate | None] = [None] * n
    if communication.delay_s is not None:
        late = dead_reckoning(filters[0], priors)
        online = [
            _late(*each, communication.delay_s)
            for each in zip(online, team.robots, priors, late, strict=True)
        ]
    else:
        paths = [finish(each, n) for each in filters]
        revised = paths[0] if len(filters) == 1 else [own[k] for k, own in enumerate(paths)]
    return share_processor_time(online, revised, processor_s() - begun)


def _heard(
    instants: Iterator[tuple[Frame, ...]], contacts: NDArray[np.bool_]
) -> Iterator[tuple[int, list[tuple[Frame, ...]]]]:
    """Number of each robot that has a Frame, and the instants that it did not know before.

    Each Frame reaches each robot once; its own at once, and last of all.
    """
    n = contacts.shape[1]
    logs: list[list[Frame]] = [[] for _ in range(n)]
    known, taken = np.zeros((2, n, n), np.int64)  # of each robot, how many Frames of each other
    for frames, near in zip(instants, contacts, strict=True):
        for frame in frames:
            logs[frame.robot].append(frame)
            known[frame.robot, frame.robot] += 1
        linked = np.linalg.matrix_power(near.astype(np.int64) + np.eye(n, dtype=np.int64), n) > 0
        known = np.array([known[own].max(axis=0) for own in linked])
        for frame in frames:
            robot = frame.robot
            ranges = zip(logs, taken[robot], known[robot], strict=True)
            unheard = [one for log, have, get in ranges for one in log[have:get]]
            taken[robot] = known[robot]
            unheard.sort(key=lambda one: (one.stamp, one.robot))
            grouped = itertools.groupby(unheard, key=lambda one: one.stamp)
            yield robot, [tuple(instant) for _, instant in grouped]


def _late(
    online: Estimate, recording: Recording, prior: Prior, wheels: Any, delay_s: float
) -> Estimate:
    """What estimates so late leave: the last one known, carried on by the wheels."""
    frames = list(recording.frames())
    motions = [wheels.predict(frame) for frame in frames]
    start = prior.start or Gaussian(np.full(3, np.nan), np.full((3, 3), np.nan))
    answered, beliefs = -1, []
    for row, frame in enumerate(frames):
        while answered + 1 < row and online.stamps[answered + 1] <= frame.stamp - delay_s + 1e-9:
            answered += 1
        belief = start
        if answered >= 0:
            belief = Gaussian(online.means[answered], online.covariances[answered])
        for motion in motions[answered + 1 : row + 1]:
            belief = belief.then(motion)
        beliefs.append(belief)
    means, covariances = stack(beliefs)
    return dataclasses.replace(online, means=means, covariances=covariances, status="ok")
