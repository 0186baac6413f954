"""The bound on the errors over a recording, beside which the estimates' own stand.

What is bounded is the error of a method that knows the law of the wheels and of the sensors, their
true figures, the start within its prior, and which landmark is which. Per recording the information
is evaluated at its own true path, so it is the bound on the error pooled over recordings of the
setting (Tichavsky, Muravchik and Nehorai average the information over paths before they invert it,
which is lower, by Jensen); a single recording may come out below it. It is that of the linearised
problem: it means little where errors are so great that lines are no longer straight, as after long
dead reckoning. The encoder's error is taken as white beside what the encoder shows, and what
landmarks are *not* seen, or which beams return nothing, tells nothing.
"""

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimators.base import Prior
from experiments.evaluation.pose_bound import (
    Chain,
    PathBound,
    Sights,
    bound_dead_reckoning,
    bound_path,
)
from experiments.evaluation.sensor_information import (
    WheelNoise,
    laser_information,
    motion_terms,
    stereo_information,
)
from sim.arrays import Array, Ints
from sim.recording import Recording
from sim.robot.arc import arc_increment, arc_increment_jacobian
from sim.robot.base import robot_from_config
from sim.robot.drive import DifferentialDrive
from sim.sensors import Encoder, Laser, RobotCamera, Sensor, StereoCamera
from sim.team import Team
from sim.worlds.world import World

_BENT_RAD2 = 0.3**2  # variance of a heading from which on sensors are not linearised


@dataclass(frozen=True)
class _Known:
    """What the bound depends on; the recordings by their checksum."""

    checksum: str
    sensors: tuple[str, ...]
    starts: tuple[bytes, ...]
    landmarks: bool
    team: Team = field(compare=False, repr=False)


def bound_recording(recording: Recording, prior: Prior, names: Iterable[str]) -> PathBound | None:
    """Bound at each Frame of a recording, as `bound_team` has it."""
    bounds = bound_team(Team((recording,)), [prior], names)
    return None if bounds is None else bounds[0]


def bound_team(team: Team, priors: Sequence[Prior], names: Iterable[str]) -> list[PathBound] | None:
    """Bound at each Frame of each robot, as if all told each other all at once.

    It is made once for several runs. None where there is no bound: over a recording that was not
    simulated, without a start, of a robot or a sensor of another law, with a laser but without a
    map, where rounding loses what is known of a landmark, and where a heading is off by more than
    the linearised problem allows.

    Parameters
    ----------
    names
        Sensors that are read.
    """
    first, starts = team.robots[0], [prior.covariance for prior in priors]
    read = tuple(name for name in names if not isinstance(first.sensors.get(name), Encoder))
    if len(team) == 1:  # alone, it knows the place of no other robot
        read = tuple(n for n in read if not isinstance(first.sensors.get(n), RobotCamera))
    blind = any(isinstance(first.sensors.get(name), Laser) for name in read)
    if blind and any(prior.map is None for prior in priors):
        return None
    if not all(_is_known(one, [one.sensors.get(name) for name in read]) for one in team.robots):
        return None
    begun = tuple(start.tobytes() for start in starts if start is not None)
    mapped = all(isinstance(prior.map, World) for prior in priors)
    if len(begun) < len(team):
        return None
    bounds = _bound(_Known(team.checksum, read, begun, mapped, team))
    if bounds is None or not all(np.isfinite(bound.online).all() for bound in bounds):
        return None
    headings = [bound.online[:, 2, 2].max() for bound in bounds]
    headings += [start[2, 2] for start in starts if start is not None]
    return bounds if not read or max(headings) < _BENT_RAD2 else None


def bound_scores(covariances: Array) -> dict[str, float]:
    """Root mean squares of bounds (T, 3, 3) over Frames, as columns of a row."""
    x, y, heading = np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0)
    return {
        "bound_rmse_m": float(np.sqrt(x + y)),
        "bound_heading_rad": float(np.sqrt(heading)),
    }


def _is_known(recording: Recording, sensors: list[Sensor | None]) -> bool:
    """Whether the law of the wheels and of the sensors is known, and the sensors see a world."""
    truth, made_with = recording.truth, recording.config.get("robot")
    if truth is None or truth.world is None or not len(truth.wheel_travel_m):
        return False
    ours = f"{DifferentialDrive.__module__}.{DifferentialDrive.__qualname__}"
    # a file does not choose what code runs
    if not isinstance(made_with, dict) or made_with.get("_target_", ours) != ours:
        return False
    return all(
        (type(sensor) is Laser and sensor.sigma_range_m > 0.0 and sensor.sweep_s == 0.0)
        or (
            isinstance(sensor, StereoCamera | RobotCamera)
            and min(sensor.sigma_column_px, sensor.sigma_row_px, sensor.sigma_disparity_px) > 0.0
        )
        for sensor in sensors
    )


@functools.lru_cache(maxsize=4)
def _bound(known: _Known) -> list[PathBound] | None:
    """The bound over all Frames of each robot; None where rounding has spoilt it."""
    robots, starts = known.team.robots, [np.frombuffer(s).reshape(3, 3) for s in known.starts]
    driven = [_travel_and_slip(robot) for robot in robots]
    if not known.sensors:
        alone = [
            bound_dead_reckoning(
                start,
                arc_increment(travel_m, wheels.track_m),
                arc_increment_jacobian(travel_m, wheels.track_m),
                wheels.covariances(travel_m),
            )
            for start, (travel_m, wheels) in zip(starts, driven, strict=True)
        ]
        return [PathBound(each, each) for each in alone]
    instants = np.unique(np.concatenate([robot.frame_stamps for robot in robots]))
    at = [np.searchsorted(instants, robot.frame_stamps) for robot in robots]
    n_instants, n = len(instants), 3 * len(robots)
    chain = Chain(
        np.zeros((n, n)),
        np.tile(np.eye(n), (n_instants, 1, 1)),
        *np.zeros((2, n_instants, n, n)),
    )
    poses = np.full((len(robots), n_instants, 3), np.nan)
    for number, (robot, by) in enumerate(zip(robots, driven, strict=True)):
        here = at[number][:, None, None], *np.ix_(_own(number), _own(number))
        chain.start[here[1:]] = starts[number]
        poses[number, at[number]] = truth = robot.truth_at(robot.frame_stamps)
        chain.by_before[here], chain.noise[here] = motion_terms(truth, *by)
    seen = [
        _inform(chain.information, known, number, name, instants, poses)
        for number in range(len(robots))
        for name in known.sensors
    ]
    chain = chain._replace(sights=_in_order([own for own in seen if own is not None]))
    try:
        bound = bound_path(chain)
    except np.linalg.LinAlgError:
        return None
    of = [(at[number][:, None, None], *np.ix_(*2 * (_own(number),))) for number in range(len(at))]
    return [PathBound(bound.online[own], bound.revised[own]) for own in of]


def _own(robot: int) -> Ints:
    """Rows of a robot's pose among those of all."""
    return np.arange(3 * robot, 3 * robot + 3)


def _inform(
    information: Array, known: _Known, number: int, name: str, instants: Array, poses: Array
) -> Sights | None:
    """Add what a robot's sensor tells of the poses (T, n, n); the unknown landmarks that it sees.

    Their numbers are the world's.

    Parameters
    ----------
    instants
        (T,) s.
    poses
        (R, T, 3) true ones; NaN where a robot has no Frame.
    """
    recording = known.team.robots[number]
    sensor, log = recording.sensors[name], recording.logs[name]
    frames = np.searchsorted(instants, log.stamps)

    def add(told: Array, first: int, second: int) -> None:
        rows, columns = _own(first)[:, None], _own(second)
        np.add.at(information, (frames[:, None, None], rows, columns), told)

    if isinstance(sensor, Laser):
        world = recording.known_world
        told = laser_information(world, sensor, poses[number, frames], log["ranges_m"])
        add(told, number, number)
        return None
    seen = np.asarray(recording.known_truth.readings[name]["true_ids"], np.int64)
    frames = np.repeat(frames, np.diff(log.known_splits))
    if isinstance(sensor, RobotCamera):
        own_frames = frames
        for robot in np.unique(seen[seen < len(poses)]):
            theirs = poses[robot, own_frames]
            of = (seen == robot) & np.isfinite(theirs[:, 0])
            frames = own_frames[of]
            markers = np.column_stack([theirs[of, :2], np.full(of.sum(), sensor.marker_z_m)])
            told, cross, other = stereo_information(sensor.camera, poses[number, frames], markers)
            flat = np.diag([1.0, 1.0, 0.0])  # its height is known, and no heading is seen
            add(told, number, number)
            add(cross @ flat, number, robot)
            add(flat @ cross.transpose(0, 2, 1), robot, number)
            add(flat @ other @ flat, robot, robot)
        return None
    assert isinstance(sensor, StereoCamera)
    points = recording.known_world.landmarks[seen]
    told, cross, of_landmark = stereo_information(sensor, poses[number, frames], points)
    add(told, number, number)
    if known.landmarks:
        return None
    of_all = np.zeros((len(seen), information.shape[1], 3))
    of_all[:, _own(number)] = cross
    return Sights(frames, seen, of_all, of_landmark)


def _in_order(sights: Sequence[Sights]) -> Sights | None:
    """Sights of several sensors in the order of their Frames, landmarks numbered as they appear."""
    if not sights:
        return None
    rows, seen, cross, own = (np.concatenate(parts) for parts in zip(*sights, strict=True))
    order = np.argsort(rows, kind="stable")
    return Sights(rows[order], _by_first_sight(seen[order]), cross[order], own[order])


def _travel_and_slip(recording: Recording) -> tuple[Array, WheelNoise]:
    """Ground travel (T, 2) of the wheels by the encoders, and how far it may be off."""
    robot: Any = robot_from_config(recording.config["robot"])
    gain = 1.0 + robot.slip_bias  # the encoder reads so much more than the wheel rolls
    # shared slip that lasts is not white; without it the bound is lower
    together = 0.0 if robot.forward_slip_length_m else robot.forward_slip_m / float(gain.max()) ** 2
    rolled_m = recording.wheels.at(recording.frame_stamps) / gain
    slip = WheelNoise(robot.slip_variance_per_m / gain**2, together, robot.track_m)
    return np.diff(rolled_m, axis=0, prepend=rolled_m[:1]), slip


def _by_first_sight(ids: Ints) -> Ints:
    """Number (K,) of each landmark in the order in which they first appear."""
    _, first, inverse = np.unique(ids, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse], np.int64)
