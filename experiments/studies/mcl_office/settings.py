"""Constants of the study; the rest is in conf/study/mcl_office.yaml."""

import math

WITHIN_M, FOR_M = 30.0, 10.0  # localised: within this travel, and then for this long
NEAR_M, NEAR_RAD = 0.5, math.radians(10.0)
N_STARTS = 20  # in each office
