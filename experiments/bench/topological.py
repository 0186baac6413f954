"""Topological localization: time per node for the particle counts of maximo2024, table 2.

One node is one observation of a 512-d descriptor: the B most similar of all nodes, the weights M2,
resampling, the hop, the mean. The note of each figure gives the paper's time, on its machine.
"""

from collections.abc import Iterator

import numpy as np

from estimators.base import Estimator, Prior
from estimators.base import run as run_estimator
from estimators.topological.topological_mcl import TopologicalMcl
from experiments.bench.measure import Measurement
from experiments.runs.experiment import Experiment
from sim.recording import Recording

PAPER_S = {
    "oxford": {794: 0.26, 1588: 0.36, 2382: 0.46, 3176: 0.58},
    "umh": {272: 0.09, 544: 0.12, 816: 0.15, 1088: 0.18},
}
_GOAL_MS = 0.3


def run() -> Iterator[Measurement]:
    """Each count with the paper's filter; the largest ones with the defaults too."""
    for name, times_s in PAPER_S.items():
        experiment = Experiment.compose([f"study=maximo2024/{name}", "seed=1000"])
        recording = experiment.recording()
        prior = experiment.prior(recording)
        for n_particles, paper_s in times_s.items():
            per_node = n_particles // len(prior.map)
            filters = {"": _filter(experiment, per_node)}
            if n_particles == max(times_s):
                filters["_odometry"] = TopologicalMcl(particles_per_node=per_node)
            for suffix, estimator in filters.items():
                yield Measurement(
                    f"topological.node_{n_particles}{suffix}_ms",
                    1e3 * _median_step_s(estimator, recording, prior),
                    "ms",
                    None if suffix else _GOAL_MS,
                    note=f"{name}, 512-d; paper {1e3 * paper_s:.0f} ms",
                )


def node_s(experiment: Experiment, n_particles: int) -> float:
    """Median time of a node by an experiment's filter with this many particles in all."""
    recording = experiment.recording()
    prior = experiment.prior(recording)
    per_node = n_particles // len(prior.map)
    return _median_step_s(_filter(experiment, per_node), recording, prior)


def _filter(experiment: Experiment, per_node: int) -> Estimator:
    return experiment.with_estimator(particles_per_node=per_node).estimator()


def _median_step_s(estimator: Estimator, recording: Recording, prior: Prior) -> float:
    """Median time of a step over two runs of the route, after a first one that compiles."""
    rngs = map(np.random.default_rng, range(3))
    runs = [run_estimator(estimator, recording, prior, rng).step_seconds for rng in rngs]
    return float(np.median(runs[1:]))
