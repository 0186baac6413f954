"""Small logs of every text format, made by hand, for the tests of the readers."""

import json
from pathlib import Path

import numpy as np

DATA = Path(__file__).resolve().parents[2] / "shared/data"

ARC = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.2, 0.01, 0.2), (0.3, 0.05, 0.5)]
RANGES = [[1.0, 2.0, 3.0, 81.83], [1.1, 0.0, 3.1, 4.1], [1.2, 2.2, 3.2, 4.2]]


def flaser_log():
    lines = ["# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp"]
    lines += ["PARAM robot_frontlaser_offset 0.1 0 host 0"]
    for i, (x, y, a) in enumerate(ARC):
        lines.append(f"ODOM {x} {y} {a} 0.1 0 0 {10.0 + i} host {i}")
    for i, scan in enumerate(RANGES):
        x, y, a = ARC[i]
        laser = f"{x + 0.1 * np.cos(a)} {y + 0.1 * np.sin(a)} {a}"
        numbers = " ".join(str(r) for r in scan)
        lines.append(f"FLASER 4 {numbers} {laser} {x} {y} {a} {10.5 + i} host {i}")
    return "\n".join(lines).encode() + b"\n"


def robotlaser_log():
    lines = []
    for i, scan in enumerate(RANGES):
        x, y, a = ARC[i]
        numbers = " ".join(str(r) for r in scan)
        lines.append(f"VERTEX2 {7 * i} {x} {y} {a}")
        lines.append(
            f"ROBOTLASER1 0 -1.5 3.0 1.0 50.0 0.1 0 4 {numbers} 1 0.5 "
            f"{x} {y} {a} {x} {y} {a} 0 0 0 0 0 {20.0 + i} host {i}"
        )
    lines += ["#SEQUENTIAL", "EDGE2 0 7 0.1 0 0 1 0 1 1 0 0", "EDGE2 7 14 0.1 0.01 0.2 1 0 1 1 0 0"]
    return "\n".join(lines).encode()


def intel_json():
    entries = {
        f"{10.0 + i}": {"range": scan, "x": ARC[i][0], "y": ARC[i][1], "theta": ARC[i][2]}
        for i, scan in enumerate(RANGES)
    }
    return json.dumps({"map": entries}, indent=1).encode()


def relations():
    return b"1.0 2.0 0.5 0.1 0 0 0 0.2\n2.0,3.0,0.4,-0.1,0,0,0,-0.1\n"


def mrclam_members():
    header = b"# a comment\n"
    return {
        "Robot1_Odometry.dat": header + b"0.0 0.1 0.0\n0.5 0.1 0.2\n1.0 0.1 0.2\n",
        "Robot1_Measurement.dat": b"0.2 72 2.0 0.1\n0.2 5 1.0 0.0\n0.6 25 3.0 -0.2\n0.7 99 1 1\n",
        "Robot1_Groundtruth.dat": b"0.0 0 0 0\n0.5 0.05 0 0\n1.0 0.1 0 0.1\n",
        "Landmark_Groundtruth.dat": b"6 2 0.2 0 0\n7 3 -0.6 0 0\n",
        "Barcodes.dat": b"1 5\n2 14\n6 72\n7 25\n",
    }


def rawseeds_odometry():
    return "".join(f"{10 + i}.5, {i}, 3, 4, {x}, {y}, {a}\n" for i, (x, y, a) in enumerate(ARC))


def rawseeds_sick():
    return "".join(f"{11 + i}, 4, 0, {', '.join(map(str, r))}\n" for i, r in enumerate(RANGES))


def rawseeds_truth():
    return "".join(f"{10 + i},{x},{y},{a}" + ",0" * 9 + "\n" for i, (x, y, a) in enumerate(ARC))


def lego_motors():
    return b"M 200 100 0 0 0 50 0 0 0 0 0 0 0\nM 400 110 0 0 0 62 0 0 0 0 0 0 0\n"


def lego_scans():
    return b"S 210 3 500 600 700\nS 390 3 510 0 20000\n"


def lego_reference():
    return b"P 200 1000 1000\nP 300 1050 1000\nP 400 1100 1000\n"


def wean_log():
    scan = " ".join(["100"] * 179 + ["8183"])
    return (
        f"O 0 0 0 0.1\nO 10 0 0 0.3\nL 5 0 0 30 0 0 {scan} 0.2\nL 10 0 0 35 0 0 {scan} 0.3\n"
    ).encode()


def wean_map():
    header = b"robot_specifications->resolution 10\n\nglobal_map[0]: 2 3\n"
    return header + b"-1 0.5 1\n0 0.25 -1\n"


TUM = b"1.0 1 2 0 0 0 0 1\n2.0 1.5 2 0 0 0 0.0998334 0.9950042\n"
KHEPERA = b'{"T": 0.8, "phi_l": 0.5, "phi_r": 0.4, "sm": [0.01, 0, 0.1]}\n' * 3
