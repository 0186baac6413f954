"""Landmark EKFs of all particles, kept in contiguous batches (gil2008, sec. IV-D).

Each particle has a map of its own; slot n of a map holds one landmark, a mean (3,) and a covariance
of 6 unique entries in map axes. In memory come slots, then blocks of `LANES` particles, then the
nine numbers, a row of `LANES` each: an observation of the slot that all particles share runs
through memory once, and a vector unit works on as many particles as it is wide.
`estimators.landmarks.particle_kernels` computes on them.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimators.landmarks.particle_kernels import FLOATS, LANES, NUMBERS, near_slots
from sim.arrays import Array, Ints
from sim.compiled import njit

Maps = Literal["shared", "contiguous"]

_GENERATIONS = 256


class LandmarkMaps:
    """The maps of M particles, and how they survive resampling.

    `contiguous` copies the map of every particle that is replaced, O(N) each. `shared` copies
    nothing: a slot that no image has touched since is left as it was, and is gathered along the
    ancestry when it is next touched. A landmark is so shared by all descendants of the particle
    that saw it last. Once in 256 generations all slots are gathered. Both give the same bits.

    With `births` particles start landmarks apart, and each slot carries what it is.

    Attributes
    ----------
    data
        (rows, blocks, 9 * LANES); a slot's row is in `place`.
    place
        (capacity,) row of each slot.
    births
        (capacity, M) number that each landmark carries; (capacity, 0) if particles start the
        same ones.
    counts
        (M,) landmarks of each particle.
    """

    def __init__(self, n_particles: int, maps: Maps, *, births: bool) -> None:
        self.n_particles, self.maps = n_particles, maps
        self.n_blocks = -(-n_particles // LANES)
        self.data = np.zeros((1, self.n_blocks, NUMBERS * LANES))
        self.place = np.zeros(0, np.int64)
        self.births = np.zeros((0, n_particles if births else 0), np.int64)
        self.counts = np.zeros(n_particles, np.int64)
        self._spare = 0  # the row that no slot is in
        self._epoch = np.zeros(0, np.int64)  # generation in which each slot was last touched
        self._ancestry = np.zeros((_GENERATIONS, n_particles), np.int32)  # of each generation
        self._generation = 0

    @property
    def n_slots(self) -> int:
        """Slots in use by any particle."""
        return int(self.counts.max())

    @property
    def bytes_per_particle(self) -> float:
        """Memory of the maps over the number of particles."""
        parts = (self.data, self.births, self._ancestry)
        return sum(part.nbytes for part in parts) / self.n_particles

    def reserve(self, n_slots: int) -> None:
        """Make room for this many slots."""
        have = len(self.place)
        if n_slots <= have:
            return
        more = max(n_slots, 2 * have, 8) - have
        self.place = np.concatenate([self.place, np.arange(len(self.data), len(self.data) + more)])
        self.data = np.concatenate([self.data, np.zeros((more, *self.data.shape[1:]))])
        born = np.zeros((more, self.births.shape[1]), np.int64)
        self.births = np.concatenate([self.births, born])
        self._epoch = np.concatenate([self._epoch, np.full(more, self._generation)])

    def resample(self, ancestors: Ints) -> None:
        """Give particle m the map of `ancestors[m]`, (M,) as from `particles.in_place`."""
        n_slots = self.n_slots
        self.counts = self.counts[ancestors]
        if self.maps == "contiguous":
            moved = np.flatnonzero(ancestors != np.arange(self.n_particles))
            _copy_particles(self.data, self.births, self.place[:n_slots], moved, ancestors[moved])
            return
        if self._generation == _GENERATIONS:
            self.touch(np.arange(n_slots))
            self._epoch[:], self._generation = 0, 0
        self._ancestry[self._generation] = ancestors
        self._generation += 1
        self._epoch[n_slots:] = self._generation

    def touch(self, slots: Ints) -> None:
        """Bring slots up to date before they are read or written."""
        stale = slots[self._epoch[slots] < self._generation]
        if len(stale):
            order = stale[np.argsort(-self._epoch[stale], kind="stable")]
            self._spare = _gather(
                self.data.reshape(len(self.data), -1),
                self.births,
                order,
                self._epoch,
                self.place,
                self._spare,
                self._ancestry[: self._generation],
            )
            self._epoch[stale] = self._generation

    def rows(self, slots: Ints) -> Ints:
        """Rows of `data` of slots; negative ones stay negative."""
        return np.where(slots >= 0, self.place[slots], -1) if len(self.place) else slots

    def of_particle(self, particle: int) -> tuple[Array, Array, Ints]:
        """Means (N, 3) m, covariances (N, 3, 3) m^2 and births (N,) of one particle's map."""
        n = int(self.counts[particle])
        ancestor = np.empty(self._generation + 1, np.int64)  # by generation
        ancestor[-1] = particle
        for generation in range(self._generation - 1, -1, -1):
            ancestor[generation] = self._ancestry[generation, ancestor[generation + 1]]
        column = ancestor[self._epoch[:n]]
        numbers = self.data.reshape(len(self.data), self.n_blocks, NUMBERS, LANES)
        values = numbers[self.place[:n], column // LANES, :, column % LANES]
        covariances = values[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(n, 3, 3)
        return values[:, :3].copy(), covariances, self.birth_of(np.arange(n), column)

    def birth_of(self, slots: Ints, particles: Ints | int) -> Ints:
        """Births of the slots, which have been touched, of particles."""
        return self.births[slots, particles] if self.births.shape[1] > 0 else slots

    def nearby(self, state: Array, reach_m: float) -> Ints:
        """Slots that some particle has before its camera, within reach; all are touched."""
        self.touch(np.arange(self.n_slots))
        return near_slots(self.data, self.place, self.counts, state, reach_m)


@njit(**FLOATS)
def _gather(
    maps: Array,
    births: Ints,
    slots: Ints,
    epoch: Ints,
    place: Ints,
    spare: int,
    ancestry: NDArray[np.int32],
) -> int:
    """Rewrite slots, each into the spare row, with the numbers of each particle's ancestor.

    `maps` is (rows, numbers); the slots come latest epoch first. Returns the row that is spare in
    the end.
    """
    size = NUMBERS * LANES
    n_particles = ancestry.shape[1]
    ancestors = np.arange(n_particles)
    offsets = np.zeros(maps.shape[1] // NUMBERS, np.int64)
    generation = len(ancestry)
    for slot in slots:
        if generation > epoch[slot]:
            while generation > epoch[slot]:
                generation -= 1
                for m in range(n_particles):
                    ancestors[m] = ancestry[generation, ancestors[m]]
            for m in range(n_particles):
                offsets[m] = (ancestors[m] // LANES) * size + ancestors[m] % LANES
        source, target = maps[place[slot]], maps[spare]
        for block in range(len(offsets) // LANES):
            lanes = offsets[block * LANES : (block + 1) * LANES]
            T = target[block * size : (block + 1) * size]
            for k in range(NUMBERS):
                for j in range(LANES):
                    T[k * LANES + j] = source[lanes[j] + k * LANES]
        place[slot], spare = spare, place[slot]
        older = births[slot].copy()
        for m in range(len(older)):
            births[slot, m] = older[ancestors[m]]
    return spare


@njit(**FLOATS)
def _copy_particles(maps: Array, births: Ints, rows: Ints, targets: Ints, sources: Ints) -> None:
    """Copy whole maps from particles to others, slot by slot."""
    apart = births.shape[1] > 0
    for slot in range(len(rows)):
        for i in range(len(targets)):
            to, of = targets[i], sources[i]
            T, F = maps[rows[slot], to // LANES], maps[rows[slot], of // LANES]
            for k in range(NUMBERS):
                T[k * LANES + to % LANES] = F[k * LANES + of % LANES]
            if apart:
                births[slot, to] = births[slot, of]
