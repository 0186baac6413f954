"""Topological localization: time per node for the particle counts of maximo2024, table 2.

One node is one observation of a 512-d descriptor: the B most similar of all nodes, the weights M2,
resampling, the hop, the mean. The note of each figure gives the paper's time, on its machine.
"""

from collections.abc import Iterator

import numpy as np

from estimators.topological.topological_mcl import TopologicalMcl
from experiments.bench.measure import Measurement, time_steps
from experiments.runs.evaluate import limit_blas
from experiments.runs.experiment import Experiment

PAPER_S = {
    "oxford": {794: 0.26, 1588: 0.36, 2382: 0.46, 3176: 0.58},
    "umh": {272: 0.09, 544: 0.12, 816: 0.15, 1088: 0.18},
}
_GOAL_MS = 0.3


def run() -> Iterator[Measurement]:
    """Each count with the paper's filter; the largest ones with the defaults too."""
    for name, times_s in PAPER_S.items():
        experiment = Experiment.compose([f"study=maximo2024/{name}", "seed=1000"])
        for n_particles, paper_s in times_s.items():
            row, ms = f"topological.node_{n_particles}", 1e3 * node_s(experiment, n_particles)
            note = f"{name}, 512-d; paper {1e3 * paper_s:.0f} ms"
            yield Measurement(f"{row}_ms", ms, "ms", _GOAL_MS, note=note)
            if n_particles == max(times_s):
                ms = 1e3 * node_s(experiment, n_particles, paper=False)
                yield Measurement(f"{row}_odometry_ms", ms, "ms", note=note)


def node_s(experiment: Experiment, n_particles: int, *, paper: bool = True) -> float:
    """Median processor time of a node with so many particles in all, over two runs of the route.

    By an experiment's filter, the paper's, or with the defaults. A first run compiles.
    """
    recording = experiment.recording()
    prior = experiment.prior(recording)
    per_node = n_particles // len(prior.map)
    estimator = (
        experiment.with_estimator(particles_per_node=per_node).estimator()
        if paper
        else TopologicalMcl(particles_per_node=per_node)
    )
    runs = []
    with limit_blas():
        for rng in map(np.random.default_rng, range(3)):
            estimator.reset(prior, rng)
            runs.append([seconds for seconds, _ in time_steps(estimator, recording.frames())])
    return float(np.median(runs[1:]))
