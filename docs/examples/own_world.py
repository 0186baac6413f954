"""Your own world: walls, boxes, landmarks and a tour in a YAML, and a laser in it.

`estima view --world world=from_file world.path=my_world.yaml` draws it. Writes own_world.png into
the current folder.
"""

from pathlib import Path

import estima

WORLD = Path(__file__).with_name("my_world.yaml")

recording = estima.simulate(
    "world=from_file",
    f"world.path='{WORLD}'",
    "sensors=lms291",
    "simulation.physics=kinematic",
    "route.waypoints=[[1, 1], [4, 1], [4, 5], [7, 5]]",  # null: the world's own tour
)
run = estima.run(recording, "prior.map=world", "estimator.min_particles=200", estimator="mcl")
print(f"{recording.status}: position RMSE {run.row['ate_rmse_m']:.3f} m in the known map")
run.plot("own_world.png")
