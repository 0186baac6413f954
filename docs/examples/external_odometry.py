"""A program that Estima asks for its beliefs: dead reckoning in plain Python.

    estima run estimator=external 'estimator.command=[python3,docs/examples/external_odometry.py]'

It reads one JSON message a line, and answers each with one line; docs/programs.md is the protocol.
"""

import json
import math
import sys

for line in sys.stdin:
    message = json.loads(line)
    answer = {}
    if message["type"] == "reset":
        track_m = message["robot"]["track_m"]
        x, y, heading = message["prior"]["mean"]
        covariance = message["prior"]["covariance"]
    elif message["type"] == "frame":
        right_m, left_m = message["wheel_increments_m"]
        forward_m, turn_rad = (right_m + left_m) / 2, (right_m - left_m) / track_m
        x += forward_m * math.cos(heading + turn_rad / 2)
        y += forward_m * math.sin(heading + turn_rad / 2)
        heading += turn_rad
        for i in range(3):  # a guess: 1 mm^2 and 1 mrad^2 a metre
            covariance[i][i] += 1e-6 * abs(forward_m)
        answer = {"mean": [x, y, heading], "covariance": covariance}
    print(json.dumps(answer), flush=True)
