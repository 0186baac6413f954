"""What the study of localization in offices is made of, beside conf/study/mcl_office.yaml."""

import math

WITHIN_M, FOR_M = 30.0, 10.0  # localised: within so much travel, and then for so long
NEAR_M, NEAR_RAD = 0.5, math.radians(10.0)
