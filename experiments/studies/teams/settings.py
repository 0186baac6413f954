"""Constants of the study of teams; the configuration is in conf/study/teams.yaml."""

from typing import Any

from estimators.team import Kind
from experiments.judging.results import Profile

SIZES = (2, 3, 4, 5)
WORLDS = {Profile.FULL: 8, Profile.QUICK: 1}  # of the batch; of the filters, by design
PRINTED = "fastslam_paper"  # with 200 particles, the least from which gil2008 sees no gain
FILTERS = (PRINTED, "fastslam", "ekf_slam")
N_PARTICLES = {PRINTED: 200, "fastslam": 1000}  # 1000 chosen on seeds 0 to 5
CALIBRATED = (0.90, 0.99)  # share of true positions inside the 95 % ellipse
LINKED = 3  # robots of the team whose communication is varied
ALWAYS = "always"
LINKS: dict[str, dict[str, object]] = {
    "range, 6 m": {"team.communication.kind": "range", "team.communication.range_m": 6.0},
    "delayed, 5 s": {"team.communication.kind": "delayed", "team.communication.delay_s": 5.0},
    "never": {"team.communication.kind": "never"},
}
# MRCLAM: as EKF-SLAM with a gate in the single robots' study, conf/study/real_logs/mrclam.yaml
MRCLAM_OPTIONS: dict[str, Any] = {"gate_probability": 1e-6, "repeat_s": 0.5, "kr": 1e-3, "kl": 1e-3}
MRCLAM_ARMS = ("alone", "team", "team with sightings")
MRCLAM_LINKS: tuple[Kind, ...] = ("never", "always", "always")  # communication in each
