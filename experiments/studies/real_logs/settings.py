"""Constants of the studies of real logs; the runs' configuration is in conf/study."""

import math

from experiments.judging.results import Profile

RAWSEEDS = {  # printed with the logs: SE(2)-aligned ATE by session, m
    "25a": {
        "amcl_beam_model_default": "0.149",
        "amcl_likelihood_default": "0.227",
        "ndt_mcl_0.5": "0.079",
        "muse_default_params": "0.142",
        "GROUNDTRUTH-CARTOGRAPHER": "0.059",
        "GT-extended": "0.031",
    },
    "25b": {
        "amcl_beam_model_default": "0.178",
        "amcl_likelihood_default": "0.174",
        "ndt_mcl_0.5": "0.077",
        "muse_default_params": "0.132",
        "GROUNDTRUTH-CARTOGRAPHER": "0.062",
        "GT-extended": "0.042",
        "GraphSLAM Laser": "0.074",
    },
}
KUEMMERLE = {  # as quoted with the logs: mean and standard deviation of the translation, m
    "intel": {"scan matching": (0.220, 0.296), "RBPF": (0.070, 0.083), "graph": (0.031, 0.026)},
    "fr079": {"scan matching": (0.258, 0.427), "RBPF": (0.061, 0.044), "graph": (0.056, 0.042)},
}
KHEPERA = {  # published: right and left diameter, axle, m
    "l90": (0.0414408, 0.0411796, 0.0880134),
    "lmov": (0.0415888, 0.0414217, 0.0883953),
}
HELD_OUT = "calibrated on the first half, judged on the second"
LEGO_START_RAD = math.radians(213.0)

# Names of the runs of conf/study/real_logs/*.yaml, in their order
LOGGED = "odometry, as logged"
FUSION = "EKF of wheels and ICP"
GMAPPING = "GMapping, 910 poses"
INTEL = (
    "odometry, 910 scans",
    LOGGED,
    "odometry, calibrated",
    "ICP alone",
    "ICP from the wheels",
    FUSION,
)
INTEL_DRAWN = (INTEL[2], INTEL[4], FUSION)
FREIBURG = ("graph's own edges", "ICP alone", "ICP from the edges")
MRCLAM_METHODS = {  # by name: kind, ids, and what is changed
    ", ".join(parts): parts
    for parts in (
        ("dead reckoning", "as logged"),
        ("dead reckoning", "calibrated"),
        ("FastSLAM", "known"),
        ("FastSLAM", "known", "wider noise"),
        ("FastSLAM", "unknown", "wider noise"),
        ("FastSLAM", "known", "slip in bursts"),
        ("EKF-SLAM", "known"),
        ("EKF-SLAM", "known", "wider noise"),
        ("EKF-SLAM", "unknown", "wider noise"),
        ("EKF-SLAM", "known", "gated"),
        ("EKF-SLAM", "known", "repeats once"),
        ("EKF-SLAM", "known", "invariant"),
    )
}
MRCLAM = tuple(MRCLAM_METHODS)
MRCLAM_BASE = MRCLAM[1]
MRCLAM_CHOSEN = (MRCLAM[4], MRCLAM[5], MRCLAM[8], MRCLAM[11])  # the headlines of RL3
MRCLAM_DRAWN = (MRCLAM_BASE, MRCLAM[5])
MRCLAM_SHOWN = (*MRCLAM[:3], *MRCLAM[4:7], MRCLAM[8], MRCLAM[11])  # as many as there are colours

RESOLUTION_M = 0.05  # of the grid maps
TUNED_ROBOTS = (1, 2)  # of MRCLAM; robots 3 to 5 judge
DRAWN_ROBOT = 4
MRCLAM_ROBOTS = {Profile.QUICK: (1, 4), Profile.FULL: (1, 2, 3, 4, 5)}
FASTSLAM_SEEDS = {Profile.QUICK: 1, Profile.FULL: 5}
WEAN_LOGS = {Profile.QUICK: "1", Profile.FULL: "1,2"}
