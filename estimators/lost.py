"""Whether a method is lost: by readings that its belief does not explain, and by its own spread."""

import math
from collections import deque

from sim.arrays import Array

FAR_M = 1.0  # from where a method believes that it is
_WINDOW_S = 5.0


class Unexplained:
    """The readings of the last seconds, and how many of them a belief did not explain."""

    def __init__(self) -> None:
        self._noted: deque[tuple[float, int, int]] = deque()

    def note(self, stamp_s: float, unexplained: int, of: int) -> None:
        """Note how many of the readings of one instant were improbable under the belief."""
        self._noted.append((stamp_s, unexplained, of))
        self._forget(stamp_s)

    def lost(self, stamp_s: float, covariance: Array) -> float:
        """How far to believe that one is lost, from 0 to 1.

        One is not if a reading drawn from the last ones was explained and the position is right
        within `FAR_M`. The latter has at least the probability that it would have if the error were
        as great in all directions as in the worst.

        Parameters
        ----------
        covariance
            (3, 3) of the pose.
        """
        self._forget(stamp_s)
        unexplained, of = sum(far for _, far, _ in self._noted), sum(n for *_, n in self._noted)
        (xx, xy), (_, yy) = covariance[0, :2].tolist(), covariance[1, :2].tolist()
        worst_m2 = (xx + yy) / 2.0 + math.hypot((xx - yy) / 2.0, xy)
        far = math.exp(-(FAR_M**2) / (2.0 * worst_m2)) if worst_m2 > 0.0 else 0.0
        return 1.0 - (1.0 - unexplained / max(of, 1)) * (1.0 - far)

    def _forget(self, stamp_s: float) -> None:
        """Drop what was read before the window that ends now."""
        while self._noted and self._noted[0][0] <= stamp_s - _WINDOW_S:
            self._noted.popleft()
