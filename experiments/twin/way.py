"""The best trajectory of a log: its truth, else a revised estimate, with the wheels between."""

import numpy as np

from estimators.base import Prior
from estimators.graph.graph_slam import GraphSlam
from estimators.graph.smoother import Smoother
from experiments.calibration.reference import spaced_rows
from experiments.runs.calibration import Slip
from experiments.runs.evaluate import run_over
from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.recording import Recording
from sim.robot.arc import arc_increment
from sim.sensors import Laser, StereoCamera

STEP_S = 0.1  # of a way
_KNOTS_S = 1.0  # between poses of a dense truth, whose noise would be taken for motion
_START = np.diag([1e-6] * 3)


def observer(recording: Recording) -> tuple[str, Laser | StereoCamera]:
    """Name and sensor of the first laser or camera of landmarks.

    Raises
    ------
    InputError
        If the log has neither.
    """
    for name in recording.logs:
        sensor = recording.sensors[name]
        if isinstance(sensor, (Laser, StereoCamera)):
            return name, sensor
    raise InputError("a twin needs a laser or a camera of landmarks, and the log has neither")


def best_poses(recording: Recording, slip: Slip) -> tuple[Array, Array]:
    """Stamps (N,) s and poses (N, 3): the truth, else what least squares makes of all sensors.

    Raises
    ------
    InputError
        If the log has no truth, and no sensor to make one of.
    """
    if recording.truth is not None:
        return recording.truth.stamps, recording.truth.poses
    name, sensor = observer(recording)
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
