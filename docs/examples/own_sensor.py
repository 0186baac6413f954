"""Your own sensors: a beacon like GPS and a second laser, fused by your own estimator.

The beacon and the estimator lie in `beacon/`, each in a file, with a YAML that names it. On the
command line: `estima run --config-dir beacon sensors=two_lasers_beacon
estimator=fused`.
"""

import sys
from pathlib import Path

import estima
from sim.recording import save

FOLDER = Path(__file__).resolve().parent / "beacon"
SENSORS = (f"hydra.searchpath=[file://{FOLDER}]", "sensors=two_lasers_beacon")

if __name__ == "__main__":
    sys.path.insert(0, str(FOLDER))
    recording = estima.simulate(
        *SENSORS, "simulation.physics=kinematic", "route.distance_m=6", "seed=3"
    )
    save(recording, Path("beacon.npz"))
    recording = estima.load("beacon.npz")
    for name, log in recording.logs.items():
        print(f"{name:<8} {len(log.stamps)} readings of {', '.join(log.schema)}")
    for options in (["odometry"], ["ekf_icp", "estimator.laser=rear"], ["fused"]):
        row = estima.run(recording, SENSORS[0], *options[1:], estimator=options[0]).row
        name = " ".join(options)
        print(f"{name:<29} RMSE {row['ate_rmse_m']:.4f} m, mean NEES {row['nees_mean']:.1f}")
