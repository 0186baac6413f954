"""What scoring a trajectory costs beside evo, for the same number from the same files."""

import re
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from experiments.bench.measure import Measurement
from experiments.runs.experiment import Experiment
from experiments.trajectories.convert import write_recording
from sim.errors import how_to_install, require, required
from sim.formats.tum import write_tum

_DRIVE = ["sensors=hokuyo", "route.distance_m=30", "simulation.physics=kinematic"]
_ROUNDS = 9


def run() -> Iterator[Measurement]:
    """Processor time of `estima score` over that of `evo_ape tum`, whole processes in turn."""
    evo = Path(sys.executable).with_name("evo_ape")
    require(evo.exists(), f"evo is missing; {how_to_install('dev')}")
    with tempfile.TemporaryDirectory() as folder:
        log, truth, path = (Path(folder) / name for name in ("run.npz", "truth.tum", "path.tum"))
        recording = Experiment.compose(_DRIVE).recording()
        write_recording(log, recording)
        write_recording(truth, recording)
        stamps, poses = recording.known_truth.stamps, recording.known_truth.poses
        write_tum(path, stamps, poses + 0.01 * stamps[:, None])
        ours = [sys.executable, "-m", "experiments.cli", "--results", folder]
        commands = [
            [*ours, "score", str(log), str(path), "--match", "nearest"],
            [str(evo), "tum", str(truth), str(path)],
        ]
        first, second = (_rmse_m(_cpu_s(command)[0]) for command in commands)
        require(abs(first - second) < 1e-6, f"evo says {second} m, estima {first} m")
        times = [[_cpu_s(command)[1] for command in commands] for _ in range(_ROUNDS)]
    ratio = statistics.median(own / theirs for own, theirs in times)
    own_s, evo_s = (statistics.median(column) for column in zip(*times, strict=True))
    note = f"{own_s:.2f} s beside {evo_s:.2f} s, {len(stamps)} poses"
    yield Measurement("score.cpu_ratio_evo", ratio, "x", 1.2, note=note)


def _cpu_s(command: Sequence[str]) -> tuple[str, float]:
    """What a command prints, and the processor time of its process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return printed, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _rmse_m(printed: str) -> float:
    """RMSE of the positions as either prints it."""
    found = re.search(r"(?:position error, m|rmse)\s+([\d.e-]+)", printed)
    return float(required(found, f"no error in what it prints: {printed}")[1])
