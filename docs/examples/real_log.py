"""A real log: read it, follow the robot by laser and wheels, and write the trajectory for evo.

    python real_log.py fr079.log.gz

Without a log it writes one of the CARMEN format, room.log. Writes trajectory.tum into the current
folder.
"""

import sys
from pathlib import Path

import estima
from experiments.trajectories.convert import write_estimate, write_recording

if len(sys.argv) > 1:
    log = Path(sys.argv[1])
else:
    log = Path("room.log")
    write_recording(
        log, estima.simulate("sensors=hokuyo", "simulation.physics=kinematic", "route.distance_m=6")
    )

recording = estima.load(log)  # the format is known by the contents; docs/formats.md lists them
print(f"{log}: {recording.duration_s:.0f} s, {len(recording.frame_stamps)} frames")

# Nobody knows the slip of a real robot's wheels: give it, or see `estima calibrate`
slip = ("estimator.kr=1e-4", "estimator.kl=1e-4")
run = estima.run(recording, *slip, estimator="ekf_icp")
print(f"{run.row['status']}; {run.row['step_time_us']:.0f} us a frame; no errors without a truth")
write_estimate(Path("trajectory.tum"), run.online)
