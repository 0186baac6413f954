"""Weights of a particle at each node, by the places whose descriptors are most alike."""

from typing import Literal

import numpy as np

from sim.arrays import Array

Weighting = Literal["M1", "M2", "M3"]


def node_log_weights(
    nodes_m: Array,
    nearest_m: Array,
    descriptor_distances: Array,
    weighting: Weighting,
    sigma_l_m: float,
    sigma_m: float,
) -> Array:
    """Log weights (N,) of a particle at each node (maximo2024, eqs. (1)-(3)).

    With v_j the way from the node to place j of the B most alike, and h_j their descriptors'
    distances, scaled to sum to one over the B:

    - M1: sum_j exp(-|v_j|^2 / sigma_l^2)
    - M2: sum_j exp(-|v_j|^2 / sigma_l^2) exp(-h_j^2 / sigma_m^2)
    - M3: the product of M2's terms in place of their sum.

    Parameters
    ----------
    nodes_m, nearest_m
        (N, 2) and (B, 2) m.
    descriptor_distances
        (B,) not negative, not yet scaled.
    sigma_l_m, sigma_m
        Spread in metres, and of the scaled distances.

    Notes
    -----
    Eqs. (2) and (3) print Sigma_l in the descriptor's factor; the text has a Sigma_m of its own,
    which is used here, with sigma_m as a spread. In M3 that factor is the same for every
    particle and cancels, so M3 is a Gaussian of variance sigma_l^2 / (2 B) about the centroid of
    the B places: one look-alike among them drags it away.
    """
    away = (nodes_m[:, :1] - nearest_m[:, 0]) ** 2 + (nodes_m[:, 1:] - nearest_m[:, 1]) ** 2
    exponents = away / -(sigma_l_m**2)
    if weighting != "M1":
        exponents -= (scale(descriptor_distances) / sigma_m) ** 2
    if weighting == "M3":
        return np.asarray(exponents.sum(axis=1))
    highest = exponents.max(axis=1)
    return np.asarray(highest + np.log(np.exp(exponents - highest[:, None]).sum(axis=1)))


def scale(distances: Array) -> Array:
    """Scale distances (B,) to sum to one; those that are all zero stay so."""
    total = float(distances.sum())
    return distances / total if total > 0.0 else distances
