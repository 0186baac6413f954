"""Odometry by Karto's correlative scan matcher, as slam_toolbox runs it before it closes loops.

Olson, Real-time correlative scan matching, ICRA 2009. The package `karto-scanmatcher` has the
matcher alone, without Karto's pose graph and loop search; the chain of last scans around it is that
of slam_toolbox. It is under the GPL, so it runs in a process of its own (`karto_child.py`).
"""

import importlib.util
import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

from estimators.base import Belief, Estimate, LaserOptions, Prior
from estimators.peers import MissingPackageError
from estimators.programs.external import External
from sim.errors import how_to_install
from sim.options import Count, NonNegative, Positive, options
from sim.recording import Frame

_CHILD = Path(__file__).with_name("karto_child.py")


@options("estimator")
class KartoOptions(LaserOptions):
    """Karto's own options, with the values of slam_toolbox's mapper_params_online_async.yaml."""

    minimum_travel_m: NonNegative = 0.5
    """A scan is matched once the wheels have gone this far since the last one, m,"""
    minimum_turn_rad: NonNegative = 0.5
    """or have turned by this angle, rad,"""
    minimum_interval_s: NonNegative = 0.5
    """and this much time has passed, s."""
    buffer_size: Count = 10
    """Scans against which one is matched, at most,"""
    buffer_distance_m: Positive = 10.0
    """and the greatest distance of the first of them from the last, m."""
    search_size_m: Positive = 0.5
    """Side of the square that is searched, m."""
    resolution_m: Positive = 0.01
    """Cells of the matcher's grid, m."""
    smear_m: Positive = 0.1
    """Deviation by which points are smeared over the grid, m."""
    distance_penalty: Positive = 0.5
    """`distance_variance_penalty`; its square counts, as in slam_toolbox."""
    angle_penalty: Positive = 1.0
    """`angle_variance_penalty`, likewise."""
    minimum_distance_penalty: Positive = 0.5
    """Least factor by which a distance from the wheels' pose lowers a response."""
    minimum_angle_penalty: Positive = 0.9
    """The same of an angle."""
    coarse_offset_rad: Positive = 0.349
    """Angles that are searched, to either side, rad,"""
    coarse_step_rad: Positive = 0.0349
    """in steps of this, rad,"""
    fine_step_rad: Positive = 0.00349
    """and then of this, rad."""
    max_range_m: Positive = 20.0
    """Ranges beyond it are left out, m."""

    def __post_init__(self) -> None:
        if importlib.util.find_spec("karto_scanmatcher") is None:
            raise MissingPackageError(
                f"karto_scanmatcher is not installed; {how_to_install('peers')}"
            )


class Karto(KartoOptions):
    """Ask the matcher in its process for the pose at each Frame.

    Notes
    -----
    Between matches it follows the wheels. It gives no covariance: that of a match is the spread of
    responses over the grid. Its processor time is the child's, and counts the reading of Frames.
    """

    needs = frozenset({"laser"})
    global_or_grid = True  # its grid does not turn with the world

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start the process, at the prior's pose."""
        prior.require_laser(self.laser, "karto")
        prior.require_start("karto")
        self._child = External(command=[sys.executable, str(_CHILD), json.dumps(asdict(self))])
        self._child.reset(prior, rng)

    def step(self, frame: Frame) -> Belief:
        """Pose after a Frame."""
        return self._child.step(frame)

    def finish(self) -> Estimate | None:
        """Let the process end; the estimate is an online one."""
        found = self._child.finish()
        self.program_seconds = self._child.program_seconds
        return found
