"""A twin of a log: the world, the way, the robot and its sensors, found from the log."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from estimators.base import Prior
from estimators.graph.graph_slam import GraphSlam
from estimators.graph.smoother import Smoother
from experiments.calibration.from_log import LogCalibration, calibrate_log
from experiments.calibration.reference import names_of, spaced_rows
from experiments.runs.calibration import Slip
from experiments.runs.evaluate import run_over
from experiments.runs.seeds import stream
from experiments.twin.sensors import poses_at, real_camera, real_laser
from experiments.viewing.map import grid_along
from sim import se2
from sim.arrays import Array
from sim.errors import require
from sim.recording import Recording
from sim.robot.arc import arc_increment
from sim.robot.drive import DifferentialDrive
from sim.routes.timetable import Drive
from sim.sensors import Encoder, Laser, RealCamera, RealLaser, Sensor, StereoCamera
from sim.simulate import Member, record
from sim.worlds.floor_plan import WALL_HEIGHT_M
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World

CELL_M = 0.05
_SIGMAS = 2.0 * 1.96  # in a 95 % interval
_CLEAR_M = 0.05  # beyond the robot's footprint, for a controller that is not perfect


@dataclass(frozen=True)
class Twin:
    """What a simulation of a log needs.

    Attributes
    ----------
    found
        The calibration, by the part before the split.
    rest
        The log's part from the split on, put right by the calibration.
    stamps, way
        (T,) s from the start of `rest`, and poses (T, 3) that the robot drives through.
    robot
        The robot at the mean of the calibrated parameters.
    sensors, landmarks, grid
        Sensors by name; landmarks (L, 3) m; walls, or None.
    """

    found: LogCalibration
    rest: Recording
    stamps: Array
    way: Array
    robot: DifferentialDrive
    sensors: dict[str, Sensor]
    landmarks: Array
    grid: OccupancyGrid | None

    def drawn(self, rng: np.random.Generator) -> tuple[DifferentialDrive, dict[str, Sensor]]:
        """Return a robot and sensors drawn from what the calibration leaves open.

        The calibration is believed: a gain below it makes an encoder read too much, and the track
        is off from the nominal one.
        """
        wheels = self.found.calibration.wheels
        believed = np.array([wheels.gain_right, wheels.gain_left, wheels.track_m])
        right, left, track_m = rng.multivariate_normal(believed, self.found.geometry_covariance)
        slips = {
            name: getattr(self.robot, name)
            * math.exp(rng.standard_normal() * self._log_sigma(name))
            for name in ("kr", "kl", "forward_slip_m")
        }
        robot = dataclasses.replace(
            self.robot,
            bias_right=float(wheels.gain_right / right - 1.0),
            bias_left=float(wheels.gain_left / left - 1.0),
            track_m=float(track_m),
            **slips,
        )
        return robot, {
            name: self._moved(name, sensor, rng) for name, sensor in self.sensors.items()
        }

    @property
    def world(self) -> World:
        """Walls of the grid, or landmarks."""
        walls = np.zeros((0, 4)) if self.grid is None else self.grid.walls()
        return World(
            "twin",
            walls,
            np.tile([0.0, WALL_HEIGHT_M], (len(walls), 1)),
            self.landmarks,
            np.zeros((len(self.landmarks), 0), np.float32),
        )

    def simulate(self, seed: int) -> Recording:
        """Simulate the drive by a drawn robot and sensors; believed are the calibrated ones."""
        robot, sensors = self.drawn(stream(seed, "twin"))
        streams = {axis: stream(seed, axis) for axis in ("slip", "sensors")}
        drive = Drive(self.stamps, self.way)
        made = record(
            self.world, Member(robot, sensors, drive, streams), physics="kinematic", rays="exact"
        )
        return dataclasses.replace(made, sensors=self.sensors)

    def _log_sigma(self, name: str) -> float:
        """Standard deviation of the logarithm of a slip coefficient, from its interval."""
        found = self.found.intervals[f"slip.{name}"]
        return math.log(found.high / found.low) / _SIGMAS if found.low > 0.0 else 0.0

    def _moved(self, name: str, sensor: Any, rng: np.random.Generator) -> Sensor:
        """Return the sensor with mount and scale drawn from their uncertainty."""

        def off(key: str) -> float:
            found = self.found.intervals.get(f"sensors.{name}.{key}")
            sigma = 0.0 if found is None else (found.high - found.low) / _SIGMAS
            return float(sigma * rng.standard_normal())

        if not isinstance(sensor, (RealLaser, RealCamera)):
            return sensor  # type: ignore[no-any-return]
        mount = dataclasses.replace(
            sensor.mount,
            **{key: getattr(sensor.mount, key) + off(key) for key in ("x_m", "y_m", "yaw_rad")},
        )
        if isinstance(sensor, RealLaser):
            return dataclasses.replace(sensor, mount=mount)
        return dataclasses.replace(sensor, mount=mount, scale=sensor.scale * (1.0 + off("scale")))


def make_twin(log: Recording, split_s: float | None = None) -> Twin:
    """Make the twin of a log's part from `split_s` on, half of the log by default.

    How the robot slips and its sensors err comes from what is before the split alone. The place and
    the way are those of the whole log: they are what is asked about, not what is predicted.

    Raises
    ------
    InputError
        If the log has too little to be calibrated, or no laser and no camera of landmarks.
    """
    name, sensor = find_observer(log)
    split_s = log.duration_s / 2.0 if split_s is None else split_s
    found = calibrate_log(log, split_s)
    calibration = found.calibration
    right = calibration.apply_to(log)
    known, poses = best_poses(right, calibration.slip)
    stamps, way = way_of(right, known, poses)
    begin = _first_frame(right, stamps, log.frame_stamps[0] + split_s)
    rest = dataclasses.replace(right, frame_stamps=right.frame_stamps[right.frame_stamps >= begin])
    end = min(float(stamps[-1]), float(right.frame_stamps[-1]))
    early = known <= begin
    late = (stamps >= begin) & (stamps <= end)
    robot = DifferentialDrive(
        wheel_radius_m=right.robot.wheel_radius_m,
        track_m=right.robot.track_m,
        nominal_track_m=right.robot.track_m,
        kr=calibration.slip.kr,
        kl=calibration.slip.kl,
        forward_slip_m=calibration.slip.forward_slip_m,
        forward_slip_length_m=calibration.slip.forward_slip_length_m,
    )
    landmarks, grid = np.zeros((0, 3)), None
    if isinstance(sensor, Laser):
        grid, _ = grid_along(right, known, poses, resolution_m=CELL_M, laser=name)
        grid = _cleared(grid, way, robot)
    else:
        landmarks = np.zeros((0, 3)) if right.world is None else right.world.landmarks
        missing = "a twin of a camera needs a log that knows its landmarks' places"
        require(len(landmarks), missing)
    driven = late & (stamps > begin)
    twin = Twin(
        found,
        rest,
        np.append(0.0, stamps[driven] - begin),
        np.concatenate([poses_at(stamps, way, np.array([begin])), way[driven]]),
        robot,
        {"encoder": Encoder(rate_hz=None)},
        landmarks,
        grid,
    )
    seen = right, name, known[early], poses[early], twin.world
    made: Sensor
    if isinstance(sensor, Laser):
        scans = right.log(name).stamps
        made = real_laser(*seen, scans[(scans >= begin) & (scans <= end)] - begin)
    else:
        made = real_camera(*seen)
    return dataclasses.replace(twin, sensors={**twin.sensors, name: made})


def _first_frame(recording: Recording, stamps: Array, split: float) -> float:
    """Stamp of the first Frame after the split whose true pose is known, if there is a truth."""
    frames = recording.frame_stamps[recording.frame_stamps >= max(split, stamps[0])]
    if recording.truth is not None:
        frames = frames[np.isfinite(recording.truth_at(frames, 0.25)).all(axis=1)]
    require(len(frames) >= 2, "no Frame after the split has a known pose; split the log earlier")
    return float(frames[0])


def _cleared(grid: OccupancyGrid, way: Array, robot: DifferentialDrive) -> OccupancyGrid:
    """Clear the grid's cells where the robot drove: what was there has moved."""
    half = [
        max(robot.body_length_m / 2.0, robot.wheel_radius_m),
        max(robot.body_width_m, robot.track_m) / 2.0,
    ]
    reach = (math.hypot(*half) + _CLEAR_M) / grid.resolution_m
    passed = np.ones(grid.probability.shape, bool)
    cells = np.floor((way[:, :2] - grid.origin[:2]) / grid.resolution_m).astype(int)
    rows, columns = grid.probability.shape
    on = (cells >= 0).all(axis=1) & (cells < [columns, rows]).all(axis=1)
    passed[cells[on, 1], cells[on, 0]] = False
    near = scipy.ndimage.distance_transform_edt(passed) <= reach + 1.0
    return dataclasses.replace(
        grid, probability=np.where(near, np.float32(0.0), grid.probability).astype(np.float32)
    )


STEP_S = 0.1  # of a way
_KNOTS_S = 1.0  # between poses of a dense truth, whose noise would be taken for motion
_START = np.diag([1e-6] * 3)


def find_observer(recording: Recording) -> tuple[str, Laser | StereoCamera]:
    """Name and sensor of the first laser or camera of landmarks.

    Raises
    ------
    InputError
        If the log has neither.
    """
    names = names_of(recording, Laser, StereoCamera)
    require(names, "a twin needs a laser or a camera of landmarks, and the log has neither")
    sensor: Any = recording.sensors[names[0]]
    return names[0], sensor


def best_poses(recording: Recording, slip: Slip) -> tuple[Array, Array]:
    """Stamps (N,) s and poses (N, 3): the truth, else what least squares makes of all sensors.

    Raises
    ------
    InputError
        If the log has no truth, and no sensor to make one of.
    """
    if recording.truth is not None:
        return recording.truth.stamps, recording.truth.poses
    name, sensor = find_observer(recording)
    batch: GraphSlam | Smoother = (
        GraphSlam(kr=slip.kr, kl=slip.kl, laser=name)
        if isinstance(sensor, Laser)
        else Smoother(kr=slip.kr, kl=slip.kl, robust="cauchy", stereo=name)
    )
    prior = Prior(recording.robot, recording.sensors, np.zeros(3), _START)
    _, found = run_over(recording, batch, prior, np.random.default_rng(0))
    assert found is not None
    return found.stamps, found.means


def way_of(recording: Recording, stamps: Array, poses: Array) -> tuple[Array, Array]:
    """Stamps (T,) s, a tenth of a second apart, and poses (T, 3) of a drive through known poses.

    Between two of them, a second or more apart, the robot moves as its wheels say, and what is left
    is spread evenly over the time: a truth's noise, or its gaps, do not become motion.
    """
    wheels = recording.wheels
    inside = (stamps >= wheels.stamps[0]) & (stamps <= wheels.stamps[-1])
    stamps, poses = stamps[inside], poses[inside]
    require(len(stamps) >= 2, "a twin needs two poses or more within the time of the wheels")
    rows = spaced_rows(stamps, _KNOTS_S)
    stamps, poses = stamps[rows], poses[rows]
    times = np.unique(np.concatenate([np.arange(stamps[0], stamps[-1], STEP_S), stamps]))
    travel_m = wheels.at(times)
    rolled = se2.chain(arc_increment(np.diff(travel_m, axis=0), recording.robot.track_m))
    knots = np.searchsorted(times, stamps)
    before = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(stamps) - 2)
    by_wheels = se2.between(rolled[knots[:-1]], rolled[knots[1:]])
    left = se2.log(se2.between(by_wheels, se2.between(poses[:-1], poses[1:])))
    share = (times - stamps[before]) / np.diff(stamps)[before]
    moved = se2.between(rolled[knots[before]], rolled)
    spread = se2.exp(share[:, None] * left[before])
    way: Array = se2.compose(poses[before], se2.compose(moved, spread))
    return times, way
