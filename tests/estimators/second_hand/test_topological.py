"""The filter of maximo2024, secs. 2.1 and 2.3, written out in plain NumPy, step by step.

The product's multinomial draws are recorded: their chances are compared with the written-out
weights, and their counts are where both filters go on from. Nothing else is shared.
"""

import numpy as np
import pytest

from estimators.base import Prior
from estimators.topological.topological_map import from_arrays
from estimators.topological.topological_mcl import TopologicalMcl
from sim.recording import Frame
from sim.robot.drive import RobotGeometry
from sim.sensors import PlaceDescriptor

N, COPIES, B, SIGMA_L_M, SIGMA_M = 14, 4, 5, 2.5, 0.3
PRINTED = {
    "motion": "paper",
    "resampling": "always",
    "scheme": "multinomial",
    "injection": 0.0,
    "estimate": "mean",
    "refine": False,
}


class Tape:
    """A generator that keeps its multinomial draws: chances and counts."""

    def __init__(self, seed):
        self._rng, self.drawn = np.random.default_rng(seed), []

    def multinomial(self, n, chances):
        self.drawn.append((chances, self._rng.multinomial(n, chances)))
        return self.drawn[-1][1]

    def random(self, n):
        return self._rng.random(n)


def hopped(counts):
    """Sec. 2.1: each particle goes to the next node the way it faces, and turns at the ends.

    `counts` (N, 2) are the particles at each node that face the node after it, or before it.
    """
    moved = np.zeros_like(counts)
    for i in range(N):
        after, before = counts[i]
        if after:
            moved[i + 1, 0 if i + 1 < N - 1 else 1] += after
        if before:
            moved[i - 1, 1 if i > 1 else 0] += before
    return moved


def weights(method, nodes, descriptors, d_t):
    """Eqs. (1)-(3) of a particle at each node; Sigma_m as the text defines it."""
    away = np.sqrt(((descriptors - d_t) ** 2).sum(axis=1))
    nearest = np.argsort(away)[:B]
    h = away[nearest] / away[nearest].sum()
    inverse_l, inverse_m = np.diag([1.0, 1.0]) / SIGMA_L_M**2, 1.0 / SIGMA_M**2
    found = []
    for at in nodes:
        terms = []
        for j, h_j in zip(nearest, h, strict=True):
            v = nodes[j] - at
            by_place, by_look = np.exp(-v @ inverse_l @ v), np.exp(-h_j * inverse_m * h_j)
            terms.append(by_place * (1.0 if method == "M1" else by_look))
        found.append(np.prod(terms) if method == "M3" else np.sum(terms))
    return np.array(found)


def differences(method, seed, **options):
    """Largest differences of chances, means (4) and dispersions over a drive of both filters."""
    rng, tape = np.random.default_rng([seed, 3]), Tape(seed)
    nodes = np.column_stack([2.0 * np.arange(N), np.cumsum(rng.normal(0.0, 0.3, N))])
    descriptors = np.cumsum(rng.normal(0.0, 0.4, (N, 8)), axis=0).astype(np.float32)
    believed = PRINTED | {"weighting": method, "n_nearest": B, "particles_per_node": COPIES}
    believed |= {"sigma_l_m": SIGMA_L_M, "sigma_m": SIGMA_M}
    filtered = TopologicalMcl(**believed | options)
    known = from_arrays(nodes, descriptors)
    filtered.reset(Prior(RobotGeometry(0.1, 0.4), {"place": PlaceDescriptor()}, map=known), tape)
    counts = np.full((N, 2), COPIES // 2)
    counts[0], counts[-1] = (COPIES, 0), (0, COPIES)
    off = np.zeros(3)
    for step in range(N - 1):
        d_t = (descriptors[step] + rng.normal(0.0, 0.1, 8)).astype(np.float32)
        belief = filtered.step(Frame(float(step), 1.0, np.zeros(2), {"place": {"descriptor": d_t}}))
        counts = hopped(counts) if step else counts
        chances = counts * weights(method, nodes, descriptors, d_t)[:, None]
        given, drawn = tape.drawn[-1]
        held = counts > 0
        off[0] = max(off[0], np.abs(given - chances[held] / chances.sum()).max())
        counts = np.zeros_like(counts)
        counts[held] = drawn
        share = counts.sum(axis=1) / counts.sum()
        mean = share @ nodes
        spread = share @ np.hypot(*(nodes - mean).T)
        off[1] = max(off[1], np.abs(belief.mean[:2] - mean).max())
        off[2] = max(off[2], abs(belief.extras["dispersion_m"] - spread))
    return off


@pytest.mark.parametrize("method", ["M1", "M2", "M3"])
@pytest.mark.parametrize("seed", range(3))
def test_each_step_is_the_printed_one(method, seed):
    assert np.all(differences(method, seed) < [1e-6, 1e-9, 1e-9])


@pytest.mark.parametrize(("method", "other"), [("M1", {"n_nearest": 4}), ("M2", {"sigma_m": 0.5})])
def test_a_filter_that_differs_is_seen(method, other):
    assert differences(method, 0, **other)[0] > 1e-4
