"""Independent random streams by axis, all from one study seed."""

import zlib

import numpy as np

from sim.errors import require


def stream(seed: int, axis: str, index: int = 0, *, key: str = "seed") -> np.random.Generator:
    """Generator of one axis of randomness.

    Streams of different axes, names or indices are independent, and none depends on the order
    in which they are asked for.

    Parameters
    ----------
    seed
        The study seed, a non-negative whole number.
    axis
        `world`, `route`, `slip`, `sensors`, or `estimator/NAME`.
    index
        Repetition.
    key
        The seed's place in the configuration, for messages.

    Raises
    ------
    InputError
        If the seed is anything else.
    """
    whole = isinstance(seed, int) and not isinstance(seed, bool)
    require(whole and seed >= 0, f"{key} must be a whole number from 0 on, got {seed!r}")
    spawn_key = (zlib.crc32(axis.encode()), index)
    return np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=spawn_key))
