"""What every estimator takes and gives: Prior, Belief, Estimate, and the protocol itself."""

from __future__ import annotations

import copy
import hashlib
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeVar

import numpy as np

from estimators.gaussian import Gaussian
from sim.arrays import Array
from sim.compiled import processor_s, wall_s
from sim.errors import InputError, one_line, require, required
from sim.formats.trajectory import FARTHEST_M, sound_covariances
from sim.options import options
from sim.recording import Frame, Recording
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser, Sensors, StereoCamera, sensor_of

S = TypeVar("S")
P = TypeVar("P")


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

    @property
    def start(self) -> Gaussian | None:
        """First belief; None where it is not known."""
        if self.mean is None or self.covariance is None:
            return None
        return Gaussian(self.mean, self.covariance)

    def require_start(self, estimator: str) -> Gaussian:
        """A copy of the first belief; an error if there is none."""
        start = required(self.start, f"{estimator} needs a start pose; set prior.start=tracking")
        return Gaussian(start.mean.copy(), start.covariance.copy())

    def require_laser(self, name: str, estimator: str) -> Laser:
        """Laser of a name, without which this estimator cannot start."""
        return self._required(name, Laser, estimator)

    def require_stereo(self, name: str, estimator: str) -> StereoCamera:
        """Stereo camera of a name, without which this estimator cannot start."""
        return self._required(name, StereoCamera, estimator)

    def _required(self, name: str, kind: type[S], estimator: str) -> S:
        try:
            return sensor_of(self.sensors, name, kind)
        except InputError as error:
            raise InputError(f"{estimator}: {error}") from None


@options("estimator")
class LaserOptions:
    """Options of a method that reads a laser."""

    laser: str = "laser"
    """Name of the laser that it reads."""


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


@dataclass(frozen=True, repr=False)
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

    def __repr__(self) -> str:
        return f"Estimate({self.kind}, {len(self.means)} beliefs, {self.status})"


Answer = tuple[Estimate, Estimate | None]  # of one robot: online and revised


class BeliefError(Exception):
    """A step or `finish` returned something else than it must; the run's Status says what."""


class Estimator(Protocol):
    """A localization method. It may also have `finish() -> Estimate`, the revised trajectory.

    An estimate of `finish` whose kind is `online` takes the place of the beliefs of the steps; None
    stands for no trajectory. With `answers_at_finish` only `finish` gives its estimate.
    `program_seconds` is the processor time of a program that does the work.

    `needs`, if it has that, is the set of its options that name a sensor it cannot do without
    (`laser`, whose value is the sensor's name), and `map`.
    """

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Forget everything and start from the prior."""
        ...

    def step(self, frame: Frame) -> Belief:
        """Process one Frame and return the belief after it."""
        ...


class TeamEstimator(Protocol):
    """A method for teams of any size, which a robot alone is too.

    It may also have `finish_team() -> list[Estimate]`, the revised trajectories.
    """

    def reset_team(self, priors: Sequence[Prior], rng: np.random.Generator) -> None:
        """Forget everything and start from the priors of the robots."""
        ...

    def step_team(self, frames: Sequence[Frame]) -> list[Belief]:
        """Take in Frames of one instant; the belief of each of their robots."""
        ...

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start a robot alone from its prior."""
        self.reset_team((prior,), rng)

    def step(self, frame: Frame) -> Belief:
        """Take in a Frame of a robot alone; the belief after it."""
        return self.step_team((frame,))[0]


def detach(
    prior: P, rng: np.random.Generator, *recordings: Recording
) -> tuple[P, np.random.Generator]:
    """Prior, or priors, and a generator that are an estimator's own, and lead to nothing else.

    What it writes to them reaches no other estimator. The generator draws the same numbers. Its
    seed sequence does not lead to the study's seed: it is a digest, by SHA-256, of its own and of
    the recordings with their truth.
    """
    seeds: Any = rng.bit_generator.seed_seq
    known = [getattr(seeds, "entropy", None), getattr(seeds, "spawn_key", None)]
    text = repr([*known, *(recording.checksum for recording in recordings)])
    hidden = int.from_bytes(hashlib.sha256(text.encode()).digest())
    own = type(rng.bit_generator)(hidden)
    own.state = rng.bit_generator.state
    return copy.deepcopy(prior), np.random.Generator(own)


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
    journal = Journal(estimator, recording, keep, on_step)
    estimator.reset(*detach(prior, rng, recording))
    seen = recording.with_wheel_radius(prior.robot.wheel_radius_m)
    frames = ((frame,) for frame in seen.frames())
    walk(lambda instant: [estimator.step(*instant)], frames, {0: journal})
    return journal.estimate()


def run_and_finish(
    estimator: Estimator,
    run_online: Callable[[], Estimate],
    on_step: Callable[[], None] | None = None,
) -> Answer:
    """Online estimate of an estimator's run, and the revised one of `finish`, or None.

    `on_step` is called now and then by a `finish` that takes it.

    The online one has the processor time of all, `finish` included, but for compiling code.
    """
    begun = processor_s()
    online = run_online()
    revised = finish(estimator, 1, on_step)
    own_s = processor_s() - begun
    spent_s = getattr(estimator, "program_seconds", own_s)  # without the transport to it
    return share_processor_time([online], revised, spent_s)[0]


def finish(
    estimator: Any, n_robots: int, on_step: Callable[[], None] | None = None
) -> Sequence[Estimate | None]:
    """Estimate of each robot that `finish` or `finish_team` gives, or None.

    Raises
    ------
    BeliefError
        If it gives something else.
    """
    if n_robots == 1 and hasattr(estimator, "finish"):
        told = "on_step" in inspect.signature(estimator.finish).parameters
        paths = [estimator.finish(on_step) if told else estimator.finish()]
    elif hasattr(estimator, "finish_team"):
        paths = estimator.finish_team()
    else:
        paths = [None] * n_robots
    for path in paths:
        if not isinstance(path, Estimate | None):
            who = type(estimator).__name__
            raise BeliefError(
                f"{who}.finish must return an Estimate or None, got {type(path).__name__}"
            )
    return paths


def share_processor_time(
    online: Sequence[Estimate], revised: Sequence[Estimate | None], spent_s: float
) -> list[Answer]:
    """Results of each robot; processor time is divided in proportion to their Frames."""
    answers: list[Answer] = []
    n_frames = sum(len(own.stamps) for own in online)
    for own, path in zip(online, revised, strict=True):
        share_s = spent_s * (len(own.stamps) / n_frames)
        if path is not None and path.kind == "online":
            own, path = path, None
        answers.append((replace(own, cpu_seconds=share_s), path))
    return answers


def walk(
    step: Callable[[tuple[Frame, ...]], Sequence[Belief]],
    instants: Iterable[tuple[Frame, ...]],
    journals: Mapping[int, Journal],
) -> None:
    """Take in instant by instant, and note the beliefs of the robots that have a journal.

    Parameters
    ----------
    step
        Takes in the Frames of one instant; the belief of each of their robots.
    journals
        By number of the robot. The time of a step is shared out evenly among its Frames.
    """
    for frames in instants:
        begun = wall_s()
        beliefs = step(frames)
        share_s = (wall_s() - begun) / len(frames)
        for frame, belief in zip(frames, beliefs, strict=True):
            if frame.robot in journals:
                journals[frame.robot].note(frame, belief, share_s)


class Journal:
    """The beliefs that an estimator holds of a robot, one for each of its Frames.

    Parameters
    ----------
    keep, on_step
        As in `run`.
    """

    def __init__(
        self,
        estimator: Any,
        recording: Recording,
        keep: Collection[str] = (),
        on_step: Callable[[int], None] | None = None,
    ) -> None:
        n_frames = len(recording.frame_stamps)
        self._estimator, self._stamps, self._on_step = estimator, recording.frame_stamps, on_step
        self._who = type(estimator).__name__
        self._means, self._covariances = np.empty((n_frames, 3)), np.empty((n_frames, 3, 3))
        self._seconds, self._n_noted = np.empty(n_frames), 0
        self._extras: dict[str, list[Any]] = {name: [] for name in keep}
        self._status = "ok"

    def note(self, frame: Frame, belief: Belief, seconds: float) -> None:
        """Add the belief after a Frame, which took a step of this time.

        Raises
        ------
        BeliefError
            If it is not a Belief, or has other shapes; of the first, InputError.
        """
        i = self._n_noted
        try:
            self._means[i], self._covariances[i] = read_belief(belief, self._who)
        except BeliefError as error:
            require(i > 0, str(error))
            raise BeliefError(f"{error}, at {self._since_start(i)}, step {i}") from error
        self._seconds[i] = seconds
        for name, values in self._extras.items():
            values.append(belief.extras.get(name))
        if self._status == "ok" and belief.extras.get("status", "ok") != "ok":
            said = one_line(str(belief.extras["status"]))
            self._status = f"{said} at {self._since_start(i)}"
        self._n_noted = i + 1
        if self._on_step is not None:
            self._on_step(i + 1)

    def _since_start(self, step: int) -> str:
        return since_start(self._stamps, step)

    def estimate(self) -> Estimate:
        """Online estimate of what was noted."""
        return Estimate(
            stamps=self._stamps.copy(),
            means=self._means,
            covariances=self._covariances,
            step_seconds=self._seconds,
            map=getattr(self._estimator, "map", None),
            extras=self._extras,
            status=self._status,
        )


def since_start(stamps: Sequence[float] | Array, step: int) -> str:
    """When a step is, in seconds after the first stamp: a log's own clock says nothing to a reader.

    Examples
    --------
    >>> since_start(np.array([976052857.0, 976052891.65]), 1)
    '34.65 s'
    """
    return f"{stamps[step] - stamps[0]:.2f} s"


def read_belief(belief: Any, who: str) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of what `step` returned."""
    wanted = "step must return a Belief with a mean of shape (3,) and a covariance of shape (3, 3)"
    if not isinstance(belief, Belief):
        raise BeliefError(f"{who}.{wanted}, got {type(belief).__name__}")
    try:
        mean, covariance = np.asarray(belief.mean), np.asarray(belief.covariance)
    except ValueError as error:  # ragged lists
        raise BeliefError(f"{who}.{wanted}: {error}") from error
    if mean.shape != (3,) or covariance.shape != (3, 3):
        raise BeliefError(f"{who}.{wanted}, got shapes {mean.shape} and {covariance.shape}")
    if mean.dtype.kind not in "fiu" or covariance.dtype.kind not in "fiu":
        raise BeliefError(f"{who}.{wanted}, of real numbers")
    return mean, covariance


def explain_unsound(estimate: Estimate) -> str:
    """What the first belief of an estimate lacks, with its step and stamp; empty if they are sound.

    Its mean is finite and within `FARTHEST_M`, its covariance as `sound_covariances` has it. What
    an estimate with a status leaves open, with NaN, is passed over.
    """
    stamps, means, covariances = estimate.stamps, estimate.means, estimate.covariances
    n = len(stamps)
    shapes = np.shape(stamps), np.shape(means), np.shape(covariances)
    if shapes != ((n,), (n, 3), (n, 3, 3)):
        return "stamps, means and covariances of shapes {}, {} and {}".format(*shapes)
    finite = np.isfinite(means) & np.isfinite(stamps)[:, None]
    checks: dict[str, Any] = {
        "stamp is not after the last": np.diff(stamps, prepend=-np.inf) > 0.0,
        "mean is not finite": finite.all(axis=1),
        f"mean is farther away than {FARTHEST_M:g} m": ~(np.abs(means) > FARTHEST_M).any(axis=1),
        "covariance is not finite, symmetric and positive semidefinite": (
            sound_covariances(covariances)
        ),
    }
    given = np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    for fault, sound in checks.items():
        faulty = ~sound if estimate.status == "ok" else ~sound & given
        if faulty.any():
            step = int(np.argmax(faulty))
            return f"the {fault} at {since_start(stamps, step)}, step {step}"
    return ""
