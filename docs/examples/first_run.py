"""A first run: drive through an office, reckon the way from the wheels, and look at the errors.

Writes first_run.png into the current folder.
"""

import estima

recording = estima.simulate(
    "world=office", "route.distance_m=40", "simulation.physics=kinematic", "seed=3"
)
print(f"{recording.duration_s:.0f} s, {len(recording.frame_stamps)} frames: {recording.status}")

run = estima.run(recording, estimator="odometry")
scores = estima.score(recording, run.online)
print(f"position RMSE {scores['ate_rmse_m']:.3f} m after {scores['distance_m']:.0f} m")
print(f"mean NEES {scores['nees_mean']:.1f}: 3 when the covariance is right")

run.plot("first_run.png")
