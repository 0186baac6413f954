"""A smooth surface over settings: the mean of a Gaussian process with a length for each setting.

Chosen by its error on seven planted functions (linear, stepped, bent, crossed; three and five
settings, 64 points): where the function has a step it errs half to an eighth of what a quadratic
with ridge does. The quadratic is better without an effect, and on one bent function at high noise.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from sim.arrays import Array


@dataclass(frozen=True)
class Surface:
    """Settings (P, D) in units of their ranges, and the kernel over them.

    Attributes
    ----------
    choices
        Of which settings (D) only equality counts, not distance.
    lengths
        Distance (D,) over which the surface changes.
    noise
        Variance of a point about the surface over the surface's own.
    """

    units: Array
    choices: tuple[bool, ...]
    lengths: Array
    noise: float

    def weights(self, units: Array) -> Array:
        """Weights (N, P) by which the points' values make the surface at places (N, D)."""
        n = len(self.units)
        own = self._kernel(self.units) + self.noise * np.eye(n)
        near = np.linalg.solve(own, self._kernel(units).T).T
        return np.asarray(near + (1.0 - near.sum(axis=1, keepdims=True)) / n)

    def _kernel(self, units: Array) -> Array:
        gaps = gaps_between(units, self.units, self.choices)
        return np.asarray(np.exp(-0.5 * np.tensordot(self.lengths**-2.0, gaps, 1)))


def gaps_between(first: Array, second: Array, choices: tuple[bool, ...]) -> Array:
    """Squared distance (D, N, M) of places (N, D) and (M, D) by each setting; 1 between choices."""
    gaps = (first[:, None] - second[None]).transpose(2, 0, 1)
    is_choice = np.array(choices)[:, None, None]
    return np.where(is_choice, (np.abs(gaps) > 1e-9).astype(float), gaps**2)


def fit_surface(units: Array, values: Array, choices: tuple[bool, ...]) -> Surface:
    """Fit lengths and noise to values (P,) at settings (P, D), by their likelihood."""
    n, d = units.shape
    spread = float(values.std())
    y = (values - values.mean()) / spread if spread > 0.0 else np.zeros(n)
    gaps = gaps_between(units, units, choices)

    def loss(p: Array) -> tuple[float, Array]:
        inverse_squares, signal, noise = np.exp(-2.0 * p[:d]), np.exp(p[d]), np.exp(p[d + 1])
        smooth = signal * np.exp(-0.5 * np.tensordot(inverse_squares, gaps, 1))
        precision = np.linalg.inv(smooth + noise * np.eye(n))
        solved = precision @ y
        inner = precision - np.outer(solved, solved)
        by_length = [np.sum(inner * smooth * gap) for gap in gaps] * inverse_squares
        slope = 0.5 * np.array([*by_length, np.sum(inner * smooth), noise * np.trace(inner)])
        slope[:d] += p[:d] / _PRIOR**2
        likelihood = 0.5 * (y @ solved - np.linalg.slogdet(precision)[1])
        return float(likelihood + 0.5 * np.sum((p[:d] / _PRIOR) ** 2)), slope

    start = np.array([0.0] * d + [np.log(0.7), np.log(0.3)])
    bounds = [(-2.5, 3.0)] * d + [(-9.0, 4.0), (-7.0, 1.0)]
    found = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B").x
    return Surface(units, choices, np.exp(found[:d]), float(np.exp(found[d + 1] - found[d])))


_PRIOR = 1.5  # of the logs of lengths: a surface changes over the order of the range
