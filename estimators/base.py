"""What every estimator takes and gives: Prior, Belief, Estimate, and the protocol itself."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from sim.arrays import Array
from sim.compiled import wall_s
from sim.errors import InputError, require
from sim.recording import Frame, Recording
from sim.robot.drive import RobotGeometry
from sim.sensors import Sensors


@dataclass(frozen=True)
class Prior:
    """What an estimator knows before the first Frame.

    Attributes
    ----------
    robot
        Believed geometry.
    sensors
        By name, believed mounting and noise.
    mean, covariance
        First belief, (3,) and (3, 3), m, m, rad in map; None for global localization.
    map
        World, OccupancyGrid or TopologicalMap, or None for SLAM.

    Raises
    ------
    InputError
        If the mean or the covariance is not finite.
    """

    robot: RobotGeometry
    sensors: Sensors = field(default_factory=dict)
    mean: Array | None = None
    covariance: Array | None = None
    map: Any = None

    def __post_init__(self) -> None:
        for name, values in (("mean", self.mean), ("covariance", self.covariance)):
            sound = values is None or bool(np.isfinite(values).all())
            require(sound, f"the {name} of the prior must be finite, got {values}")


@dataclass(frozen=True)
class Belief:
    """What an estimator holds true after a Frame.

    Attributes
    ----------
    mean
        (3,) m, m, rad: base_link in map.
    covariance
        (3, 3); zeros where the method gives none.
    extras
        Named arrays for those who look closer: `particles` (M, 3), `log_weights` (M,), `ess`,
        `registration_covariance` (3, 3), `associations` (K,), `landmarks` (N, 3),
        `landmark_covariances` (N, 3, 3), `status`.
    """

    mean: Array
    covariance: Array
    extras: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Estimate:
    """A trajectory of beliefs.

    Attributes
    ----------
    stamps, means, covariances
        (T,) s, (T, 3), (T, 3, 3).
    kind
        `online` (each belief saw only its past) or `revised` (best lineage, batch solution).
    step_seconds
        (T,) computing time of each step; empty for a revised estimate.
    cpu_seconds
        Processor time of the whole run, `finish` and programs included; None where not measured.
        Neither it nor the time of a step has that of compiling code.
    map
        What the estimator made of the world, or None.
    extras
        Each recorded key to its values, one a Frame.
    status
        `ok`, or what went wrong.
    left_out
        One line on what its poses leave out of the file that they were read from; or empty.
    """

    stamps: Array
    means: Array
    covariances: Array
    kind: Literal["online", "revised"] = "online"
    step_seconds: Array = field(default_factory=lambda: np.zeros(0))
    cpu_seconds: float | None = None
    map: Any = None
    extras: dict[str, list[Any]] = field(default_factory=dict)
    status: str = "ok"
    left_out: str = ""


class Estimator(Protocol):
    """A localization method. It may also have `finish() -> Estimate`, the revised trajectory.

    An estimate of `finish` whose kind is `online` takes the place of the beliefs of the steps; None
    stands for no trajectory. With `answers_at_finish` its beliefs are no answer of its own.
    `program_seconds` is the processor time of a program that does the work.

    `needs`, if it has that, is the set of its options that name a sensor it cannot do without
    (`laser`, whose value is the sensor's name), and `map`.
    """

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Forget everything and start from the prior."""
        ...

    def step(self, frame: Frame) -> Belief:
        """Take in one Frame and answer with the belief after it."""
        ...


def run(
    estimator: Estimator,
    recording: Recording,
    prior: Prior,
    rng: np.random.Generator,
    keep: Collection[str] = (),
    on_step: Callable[[int], None] | None = None,
) -> Estimate:
    """Run an estimator over a recording, Frame by Frame.

    Parameters
    ----------
    keep
        Names of the Belief extras to record.
    on_step
        Called with the number of Frames done, for a progress bar.

    Returns
    -------
    Estimate
        The online estimate at the Frame stamps.

    Raises
    ------
    InputError
        If the first step returns no Belief, or one of other shapes.
    """
    n_frames = len(recording.frame_stamps)
    means, covariances = np.empty((n_frames, 3)), np.empty((n_frames, 3, 3))
    seconds = np.empty(n_frames)
    extras: dict[str, list[Any]] = {name: [] for name in keep}
    status = "ok"
    estimator.reset(prior, rng)
    for i, frame in enumerate(recording.frames()):
        begun = wall_s()
        belief = estimator.step(frame)
        seconds[i] = wall_s() - begun
        if i == 0:
            _check_belief(belief, estimator)
        means[i], covariances[i] = belief.mean, belief.covariance
        for name in keep:
            extras[name].append(belief.extras.get(name))
        if status == "ok" and belief.extras.get("status", "ok") != "ok":
            status = f"{belief.extras['status']} at {frame.stamp:.2f} s"
        if on_step is not None:
            on_step(i + 1)
    return Estimate(
        stamps=recording.frame_stamps.copy(),
        means=means,
        covariances=covariances,
        step_seconds=seconds,
        map=getattr(estimator, "map", None),
        extras=extras,
        status=status,
    )


def _check_belief(belief: Any, estimator: Estimator) -> None:
    wanted = (
        f"{type(estimator).__name__}.step must return a Belief with a mean of shape (3,) "
        "and a covariance of shape (3, 3)"
    )
    require(isinstance(belief, Belief), f"{wanted}, got {type(belief).__name__}")
    try:
        shapes = np.shape(belief.mean), np.shape(belief.covariance)
    except ValueError as error:  # ragged lists
        raise InputError(f"{wanted}: {error}") from error
    require(shapes == ((3,), (3, 3)), f"{wanted}, got shapes {shapes[0]} and {shapes[1]}")
