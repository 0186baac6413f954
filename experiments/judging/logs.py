"""Real logs: where they lie, and the recordings of them that conf/study/*.yaml name.

They are not part of the project; they are expected in ../shared/data.
"""

import dataclasses
from typing import Literal

import numpy as np

from estimators.base import Estimate, Estimator, Prior
from estimators.laser.icp_odometry import IcpOdometry
from experiments.calibration.from_log import calibrate_log
from experiments.calibration.logs import calibrate_wheels
from experiments.runs.calibration import Calibration
from experiments.runs.evaluate import run_over
from experiments.runs.paths import SOURCE
from sim import se2
from sim.arrays import Array
from sim.formats import carmen, mrclam, wean
from sim.formats import intel as intel_lab
from sim.formats.khepera import WheelLaserLog
from sim.formats.relations import Relations, read_relations
from sim.recording import Recording, WheelLog
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser, Mount

DATA = SOURCE.parent / "shared" / "data"
MRCLAM_6 = DATA / "mrclam6" / "MRCLAM_Dataset6.tar.xz"
INTEL_910 = tuple(DATA / "intel_lab" / f"intel_{part}_910.json.gz" for part in ("raw", "gmapping"))
GRAPHS = {  # logs with the poses of a graph that others optimised
    "intel": DATA / "intel_lab" / "intel-lab.flirt.log.gz",
    "fr079": DATA / "fr079_flirt" / "fr079.flirt.log.gz",
}
TUNED_SHARE = 0.4  # of the Intel log, on which options were chosen; the rest judges
CALIBRATED_S = 300.0  # from the start of a log of MRCLAM; the rest judges


def why_missing() -> str:
    """Why a study of real logs cannot run; empty if it can."""
    return "" if DATA.is_dir() else f"the real logs are not in {DATA.parent.name}/{DATA.name}"


def relations_of(name: str) -> Relations:
    """True relations of the log of a graph."""
    return read_relations(GRAPHS[name].parent / f"{name}.relations.gz")


def intel(version: Literal["sparse", "logged", "calibrated"]) -> Recording:
    """The Intel Research Lab: 910 scans with a mapper's poses, or the log with all its scans."""
    if version == "sparse":
        return intel_lab.read_intel(*INTEL_910)
    logged, _ = _thinned_intel()
    return calibrate_by_scans(logged, tuned_until_s(logged)) if version == "calibrated" else logged


def intel_known_stamps(recording: Recording) -> Array:
    """Stamps (N,) s of those scans of the log with all its scans whose stamps are not guessed."""
    stamps: Array = recording.log("laser").stamps[_thinned_intel()[1].astype(np.int64)]
    return stamps


def _thinned_intel() -> tuple[Recording, Array]:
    folder = DATA / "intel_lab"
    return intel_lab.read_thinned_intel(
        folder / "intel_mrpt_scans_converted.txt.gz",
        folder / "intel_mrpt_ODO.txt.gz",
        folder / "intel_mrpt_reference_matches.csv.gz",
    )


def freiburg() -> Recording:
    """Freiburg 079; its wheels are the edges of a graph that others optimised."""
    return carmen.to_recording(carmen.read_carmen(GRAPHS["fr079"]))


def landmarks(robot: int, calibrated: bool, identifies: bool) -> Recording:
    """One robot of MRCLAM 6, with ranges and bearings to landmarks."""
    logged = mrclam.read_mrclam(MRCLAM_6, robot, identifies)
    return calibrate_by_truth(logged).apply_to(logged) if calibrated else logged


def wean_hall(number: int) -> Recording:
    """Log 1 or 2 of Wean Hall."""
    return wean.read_wean(DATA / "wean_hall_mcl" / f"robotdata{number}.log.gz")


def known_start(recording: Recording, start: Array | None = None) -> Prior:
    """Prior at a pose (3,) known to 1 mm and 1 mrad; by default at the true start."""
    mean = recording.truth_at(recording.frame_stamps[:1])[0] if start is None else start
    return Prior(recording.robot, recording.sensors, mean, np.diag([1e-6] * 3))


def track(estimator: Estimator, recording: Recording) -> tuple[Estimate, Estimate | None]:
    """Online and revised estimate from the origin."""
    prior, rng = known_start(recording, np.zeros(3)), np.random.default_rng(0)
    return run_over(recording, estimator, prior, rng, keep=("registration_status",))


def tuned_until_s(logged: Recording) -> float:
    """End of the part of the Intel log that options were chosen on, s."""
    return float(np.quantile(logged.log("laser").stamps, TUNED_SHARE))


def calibrate_by_scans(recording: Recording, until_s: float) -> Recording:
    """The recording with wheels, track and laser calibrated by scan matching before `until_s`.

    The wheels of a log of poses are rebuilt with nominal sizes, so the calibration corrects those.
    """
    matcher = IcpOdometry(kr=3e-3, kl=3e-3, sigma_range_m=0.03, reference="previous")
    estimate, _ = track(matcher, recording)
    stamps, wheels = recording.log("laser").stamps, recording.wheels
    rows = np.searchsorted(estimate.stamps, stamps)
    poses, travel = estimate.means[rows], wheels.at(stamps)
    status = np.array([str(estimate.extras["registration_status"][i]) for i in rows])
    trusted = (status[1:] == "ok") & (stamps[1:] < until_s)
    log = WheelLaserLog(
        np.diff(stamps)[trusted],
        2.0 * np.diff(travel, axis=0)[trusted],
        se2.between(poses[:-1], poses[1:])[trusted],
    )
    right, left, axle_m, x, y, yaw = calibrate_wheels(log, 1.0, recording.robot.track_m).values
    laser = recording.sensor("laser", Laser)
    mount = Mount(x_m=x, y_m=y, z_m=laser.mount.z_m, yaw_rad=laser.mount.yaw_rad + yaw)
    return dataclasses.replace(
        recording,
        wheels=WheelLog(wheels.stamps.copy(), wheels.position_m * np.array([right, left])),
        robot=RobotGeometry(recording.robot.wheel_radius_m, axle_m),
        sensors={**recording.sensors, "laser": dataclasses.replace(laser, mount=mount)},
    )


def calibrate_by_truth(recording: Recording) -> Calibration:
    """Calibration on the first `CALIBRATED_S`, with the noise that the log believes.

    What is believed of the noise was chosen on the robots that do not judge.
    """
    found = calibrate_log(recording, CALIBRATED_S).calibration
    sensors = {
        name: dataclasses.replace(belief, sigma_column_px=None, sigma_disparity_px=None)
        for name, belief in found.sensors.items()
    }
    return dataclasses.replace(found, sensors=sensors)
