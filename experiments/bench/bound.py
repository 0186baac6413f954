"""What the bound of a recording costs beside a run of `ekf_icp` over it."""

import dataclasses
import statistics
import time
from collections.abc import Iterator

from experiments.bench.measure import Measurement
from experiments.evaluation.recording_bound import bound_recording
from experiments.runs.evaluate import limit_blas, run_over
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream

_DRIVE = ["world=rooms", "robot=robocom", "route.distance_m=30", "prior.map=world"]
_CASES = {"laser": "hokuyo", "stereo": "laser_stereo"}
_ROUNDS = 5


def run() -> Iterator[Measurement]:
    """Processor time of the bound over that of `ekf_icp`, in turn."""
    for read, sensors in _CASES.items():
        one = Experiment.compose([*_DRIVE, f"sensors={sensors}", "estimator=ekf_icp"])
        recording = one.recording()
        prior = one.prior(recording)
        if read == "stereo":
            prior = dataclasses.replace(prior, map=None)
        ratios, times_s = [], []
        for again in range(_ROUNDS + 1):
            # another checksum, since a bound is made once for equal recordings
            meta = dataclasses.replace(recording, config={**recording.config, "again": again})
            begun = time.process_time()
            with limit_blas():
                assert bound_recording(meta, prior, [read]) is not None
            bound_s = time.process_time() - begun
            online, _ = run_over(recording, one.estimator(), prior, stream(0, "estimator"))
            if again:  # the first compiles
                times_s.append(bound_s)
                ratios.append(bound_s / float(online.cpu_seconds or 1.0))
        note = f"{statistics.median(times_s):.2f} s a drive of 30 m"
        yield Measurement(
            f"bound.{read}_over_ekf_icp", statistics.median(ratios), "x", 0.1, note=note
        )
