"""Doors that open and close, now and then, and before whoever comes near."""

from collections.abc import Sequence

import numpy as np

from sim.arrays import Array, Bools
from sim.robot.base import TICK_S
from sim.routes.feedback import CONTROL_TICKS

_MEAN_S = 20.0  # that a door stays open, or closed
_SLIDE_S = 1.0  # to open or close
_NEAR_M = 2.0  # from the middle of a door, where it opens for everybody
DOOR_M = 2.1  # height


class Doors:
    """The sliding doors of a world at work.

    Parameters
    ----------
    leaves
        (D, 4) m: where each door is closed.
    others
        (N, 2) m: who stands there at the start.
    """

    def __init__(self, leaves: Array, others: Array, rng: np.random.Generator) -> None:
        self._leaves, self._rng = leaves, rng
        self._wants_open = rng.random(len(leaves)) < 0.5
        self._next_s = rng.exponential(_MEAN_S, len(leaves))
        self._open = np.where(self._wants_open | self._near(others), 1.0, 0.0)  # share

    def advance(self, tick: int, others: Sequence[Array] | Array) -> None:
        """Let it be this tick, with robots and people at points (N, 2) m."""
        if tick % CONTROL_TICKS:
            return
        due = self._next_s <= tick * TICK_S
        self._wants_open ^= due
        self._next_s[due] += self._rng.exponential(_MEAN_S, int(due.sum()))
        towards = np.where(self._wants_open | self._near(np.asarray(others)), 1.0, -1.0)
        step = CONTROL_TICKS * TICK_S / _SLIDE_S
        self._open = np.clip(self._open + step * towards, 0.0, 1.0)

    def faces(self) -> tuple[Array, Array]:
        """What stands in the doorways now: faces (K, 4), and their bottoms and tops (K, 2), m."""
        shut = self._open < 0.99
        leaves, share = self._leaves[shut], self._open[shut, None]
        ends = leaves[:, 2:] + share * (leaves[:, :2] - leaves[:, 2:])
        return np.hstack([leaves[:, :2], ends]), np.tile([0.0, DOOR_M], (len(leaves), 1))

    def _near(self, others: Array) -> Bools:
        """Whether somebody is near each door (D,)."""
        middles = (self._leaves[:, :2] + self._leaves[:, 2:]) / 2.0
        gaps = np.hypot(*(middles[:, None] - others[None, :, :2]).transpose(2, 0, 1))
        return np.asarray(gaps.min(axis=1, initial=np.inf) < _NEAR_M)
