"""What worlds with objects and landmarks have in common."""

import numpy as np
from pydantic import NonNegativeInt

from sim.options import Share, options
from sim.worlds.floor_plan import Plan
from sim.worlds.vary import Shares, vary
from sim.worlds.world import World


@options("world")
class FurnishedOptions:
    """What worlds with objects and landmarks have in common."""

    n_landmarks: NonNegativeInt = 100
    look_alike_share: Share = 0.0
    """Share of the landmarks that look like another one."""
    changed_share: Share = 0.0
    """Share of the objects that have changed since the map was made that estimators get: a third of
    them stand elsewhere in it, are not in it, and have another like them beside."""
    glass_share: Share = 0.0
    """Share of the walls that are glass, to cameras and to lasers with a `glass_angle_rad`."""
    dark_share: Share = 0.0
    """Share of the walls that are black, to lasers with a `reach_at_10_percent_m`."""

    doors_share: Share = 0.0
    """Share of the doorways that have a door, which opens and closes, and is not on the map."""

    def finish(
        self, plan: Plan, name: str, rng: np.random.Generator, on_walls_share: float = 0.7
    ) -> World:
        """Finish a plan by these options."""
        world = plan.world(
            name,
            rng,
            n_landmarks=self.n_landmarks,
            on_walls_share=on_walls_share,
            look_alike_share=self.look_alike_share,
        )
        shares = self.changed_share, self.glass_share, self.dark_share, self.doors_share
        return vary(plan, world, rng, Shares(*shares))
