"""Constants of the study of twins; the estimators' configuration is in conf/study/twins/*.yaml."""

from pathlib import Path

from experiments.judging.logs import GRAPHS, INTEL_910, MRCLAM_6
from experiments.judging.results import Profile

LOGS: dict[str, tuple[tuple[Path, ...], int | None]] = {  # name: files, and the robot in them
    **{f"MRCLAM 6, robot {robot}": ((MRCLAM_6,), robot) for robot in range(1, 6)},
    "fr079": ((GRAPHS["fr079"],), None),
    "Intel": (INTEL_910, None),
}
SHOWN = ("MRCLAM 6, robot 1", "MRCLAM 6, robot 2")  # the twin was built on them; others judge
LANDMARKS, SCANS = "landmarks", "scans"  # kinds of logs
METHODS = {  # of conf/study/twins/KIND.yaml, in its order
    LANDMARKS: ("dead reckoning", "EKF-SLAM", "EKF-SLAM, invariant", "FastSLAM", "fixed lag"),
    SCANS: (
        "dead reckoning",
        "ICP from the wheels",
        "ICP from the wheels, scan to scan",
        "ICP alone",
        "EKF of wheels and ICP",
    ),
}
SEGMENT_S = 60.0
COVERED = 0.85  # of the real errors over a minute, in intervals of 95 %
RUNS = {Profile.QUICK: 4, Profile.FULL: 50}
TAU = 0.3  # the smallest effect of interest
LEAST_SHARE = 17.0 / 20.0  # of the pairs of log and estimator
WIDEST, WIDEST_OTHERS = {"dead reckoning": 12.0}, 4.0  # ends of an interval, as a ratio
