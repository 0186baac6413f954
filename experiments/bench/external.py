"""What a program as an estimator costs beyond its own work: a Frame there, a belief back."""

import sys
from collections.abc import Iterator

import numpy as np

from estimators.base import Prior
from estimators.programs.external import External
from experiments.bench.measure import Measurement, median_time_s
from sim.recording import Frame
from sim.robot.drive import RobotGeometry

_N_BEAMS = 721
_GOAL_US = 500.0
_ECHO = """
import sys
for line in sys.stdin.buffer:
    sys.stdout.buffer.write(b'{"mean":[0,0,0],"covariance":[[1,0,0],[0,1,0],[0,0,1]]}\\n')
    sys.stdout.buffer.flush()
"""


def run() -> Iterator[Measurement]:
    """Time of a step with a child that answers at once."""
    rng = np.random.default_rng(0)
    ranges_m = rng.uniform(0.5, 20.0, (20, _N_BEAMS)).astype(np.float32)
    ranges_m[rng.random(ranges_m.shape) < 0.05] = np.inf
    frames = [
        Frame(0.1 * i, 0.1, rng.standard_normal(2), {"laser": {"ranges_m": scan}})
        for i, scan in enumerate(ranges_m)
    ]
    estimator = External(command=[sys.executable, "-c", _ECHO])
    estimator.reset(Prior(RobotGeometry(0.1, 0.3), mean=np.zeros(3), covariance=np.eye(3)), rng)
    median_s = median_time_s(estimator.step, [(frame,) for frame in frames])
    estimator.finish()
    note = f"{_N_BEAMS} beams, echo child"
    yield Measurement("external.roundtrip_us", 1e6 * median_s, "µs", _GOAL_US, note=note)
