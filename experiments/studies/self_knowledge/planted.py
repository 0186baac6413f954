"""Faults that are planted in a drive."""

import dataclasses

import numpy as np

from sim.recording import Recording

LIFTED = (0.4, 0.5)  # share of the drive


def lift_wheels(recording: Recording) -> Recording:
    """The recording with encoders that stand for a part of the drive."""
    wheels = recording.wheels
    ends = np.quantile(wheels.stamps, LIFTED)
    begin_m, end_m = wheels.at(ends)
    before, after = (wheels.stamps < ends[0])[:, None], (wheels.stamps > ends[1])[:, None]
    stands = np.where(after, wheels.position_m - end_m + begin_m, begin_m)
    position_m = np.where(before, wheels.position_m, stands)
    return dataclasses.replace(recording, wheels=dataclasses.replace(wheels, position_m=position_m))
