"""Time to compile all numerical code, by two processes side by side as set-up does.

`python -m experiments.bench.compile` fills the cache of compiled code that later runs read.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping

from experiments.bench.measure import Measurement
from experiments.runs import paths
from sim.compiled import note_compiling

_PROCESSES = ("scans", "others")
_ROOM = (
    "world=room",
    "sensors=laser_stereo",
    "route.distance_m=2",
    "simulation.physics=kinematic",
)


def run() -> Iterator[Measurement]:
    """Wall time with an empty cache."""
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        fill({"NUMBA_CACHE_DIR": folder})
        seconds = time.perf_counter() - begun
    note = "all numerical code, empty cache, two processes, imports included"
    yield Measurement("compile.first_s", seconds, "s", 12.0, note=note)


def fill(settings: Mapping[str, str]) -> None:
    """Compile everything in two processes, whose environment has these settings too."""
    with tempfile.TemporaryDirectory() as results:
        environment = {**os.environ, "ESTIMA_RESULTS": results, **settings}
        command = [sys.executable, "-m", "experiments.bench.compile"]
        children = [subprocess.Popen([*command, name], env=environment) for name in _PROCESSES]
        for child in children:
            if child.wait():
                raise subprocess.CalledProcessError(child.returncode, child.args)


def _scans() -> None:
    """Registration of scans by both metrics, and its covariances."""
    import numpy as np

    from estimators.laser import icp_covariance
    from estimators.laser.icp import prepare, register
    from experiments.bench.icp import BEARINGS_RAD, pair

    drawn = pair("room", "small", 0)
    source, target = (prepare(r, BEARINGS_RAD) for r in (drawn.source_m, drawn.target_m))
    found = register(source, target)
    icp_covariance.censi(found, source, target, 0.01)
    icp_covariance.censi(found, source, target, 0.01, matches="sliding")
    icp_covariance.hessian(found)
    register(source, target, metric="point_to_point")
    icp_covariance.sampling(found, source, target, np.random.default_rng(0), 0.01)


def _others() -> None:
    """Casting, landmarks, particles, maps, calibration."""
    import numpy as np

    from experiments.calibration.end_pose_model import EndPoseModel
    from experiments.runs.evaluate import run_over
    from experiments.runs.experiment import Experiment
    from sim.robot.drive import DifferentialDrive
    from sim.robot.kinematic import run_batch
    from sim.routes.route import TABLE_1
    from sim.sensors import Laser
    from sim.worlds.grid_mapping import map_scans

    robot, route = DifferentialDrive(0.05, 0.19), TABLE_1["linear_1"]
    rng = np.random.default_rng(0)
    run_batch(robot, route, 1, rng)
    model = EndPoseModel(route.profile(robot), robot, rng, "sampled", n_samples=4)
    model.moments(np.full(2, 1e-5), np.zeros(2), robot.track_m)
    for overrides in (
        [*_ROOM, "estimator=fastslam", "estimator.ess_share=1"],
        [*_ROOM, "estimator=fastslam", "estimator.association=mahalanobis"],
        [*_ROOM, "estimator=mcl", "prior.map=world"],
        ["study=maximo2024/umh"],
    ):
        experiment = Experiment.compose(overrides)
        recording = experiment.recording()
        if "estimator=mcl" in overrides:
            laser, scan = recording.sensor("laser", Laser), recording.log("laser")["ranges_m"][:1]
            map_scans(np.zeros((1, 3)), scan, laser, resolution_m=0.5)
        prior = experiment.prior(recording)
        run_over(recording.cut(12), experiment.estimator(), prior, rng)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        note_compiling(paths.results() / "compiling")  # who began this says it
        {"scans": _scans, "others": _others}[sys.argv[1]]()
    else:
        fill({})
