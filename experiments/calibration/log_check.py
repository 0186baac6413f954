"""Warnings about a log: clocks, gaps, and sensors that disagree with the motion."""

import math

import numpy as np

from experiments.calibration.from_log import LogCalibration, calibrate_log
from sim.arrays import Array
from sim.errors import InputError
from sim.recording import Recording, WheelLog

DELAY_S = 0.05  # a delay of the wheels above this is reported
GAIN = 0.01  # so is a gain or scale that is this far from 1
TURN = 0.02  # and a track that is this share off
SIDEWAYS = 0.25  # share of the way; raw logs have up to 0.06, even of poses seconds apart
_LONG_GAP = 20.0  # in median steps
_JUMP, _JUMP_M = 10.0, 0.5  # of the wheels: times the speed of 95 % of the steps, and a step
_DECIMALS = (0.001, 0.01, 0.1, 1.0)


def check_log(recording: Recording) -> list[str]:
    """Warnings, a line each; empty if nothing is odd.

    Wheels and sensors are checked of a log with a truth, scans or landmarks, against which
    `calibrate_log` compares them.
    """
    try:
        compared = check_calibration(recording, calibrate_log(recording))
    except InputError as error:
        compared = [f"wheels and sensors are not compared: {error}"]
    return check_clocks(recording) + compared


def check_clocks(recording: Recording) -> list[str]:
    """Warnings about the stamps of a log, its poses, and what it writes where nothing was seen."""
    notes = recording.config.get("notes", {})
    warnings = [
        f"{name.removesuffix(ending).replace('_', ' ')}: {count} readings {what}"
        for name, count in (notes.items() if isinstance(notes, dict) else ())
        for ending, what in (
            ("_repeated", "repeat the stamp of another, and were dropped"),
            ("_backward", "were out of order, and were moved"),
            ("_of_other_size", "have another number of beams than most, and were dropped"),
            (
                "_of_other_geometry",
                "have other angles or another maximum range than most, and were dropped",
            ),
        )
        if name.endswith(ending)
    ]
    clocks = {"wheels": recording.wheels.stamps}
    clocks |= {name: log.stamps for name, log in recording.logs.items()}
    if recording.truth is not None:
        clocks["truth"] = recording.truth.stamps
    for name, stamps in clocks.items():
        warnings += _clock(name, stamps)
    warnings += _jumps(recording.wheels)
    share = notes.get("sideways_share", 0.0) if isinstance(notes, dict) else 0.0
    if isinstance(share, float) and share > SIDEWAYS:
        warnings.append(
            f"wheels: {100.0 * share:.0f} % of their way is sideways, which wheels cannot do: its "
            "poses look corrected by a mapper; give the raw log"
        )
    return warnings


def _jumps(wheels: WheelLog) -> list[str]:
    """Steps of the wheels that no robot takes."""
    steps_m = np.abs(np.diff(wheels.position_m, axis=0)).max(axis=1)
    speeds = steps_m / np.maximum(np.diff(wheels.stamps), 1e-3)
    usual = float(np.quantile(speeds, 0.95)) if len(speeds) else 0.0
    jumps = (steps_m > _JUMP_M) & (speeds > _JUMP * usual)
    if not jumps.any():
        return []
    first, n = int(np.argmax(jumps)), int(jumps.sum())
    return [
        f"wheels: {n} jump{'s' * (n > 1)}, the first of {steps_m[first]:.3g} m at "
        f"{wheels.stamps[first] - wheels.stamps[0]:.1f} s (usually up to {usual:.2g} m/s); was the "
        "pose reset there?"
    ]


def _clock(name: str, stamps: Array) -> list[str]:
    """Gaps, and stamps of few decimals."""
    gaps = np.diff(stamps)
    if len(gaps) < 3:
        return []
    warnings, usual = [], float(np.median(gaps))
    longest = int(np.argmax(gaps))
    if gaps[longest] > max(_LONG_GAP * usual, 0.5):
        n = int(np.sum(gaps > max(_LONG_GAP * usual, 0.5)))
        warnings.append(
            f"{name}: {n} gap{'s' * (n > 1)}, the longest {gaps[longest]:.3g} s at "
            f"{stamps[longest] - stamps[0]:.1f} s (usually {usual:.3g} s apart)"
        )
    rounding_s = 1e-9 + 4.0 * np.spacing(np.abs(stamps).max())  # 1 us of Unix time
    for step in reversed(_DECIMALS):
        off_s = np.abs(stamps - step * np.round(stamps / step)).max()
        if off_s < rounding_s:
            if step > 0.1 * usual:
                warnings.append(
                    f"{name}: stamps are whole steps of {step:g} s, which is coarse for readings "
                    f"{usual:.3g} s apart"
                )
            break
    return warnings


def check_calibration(recording: Recording, found: LogCalibration) -> list[str]:
    """Warnings where the wheels and the sensors of a log are not as it has them."""
    wheels, track_m = found.calibration.wheels, recording.robot.track_m
    warnings, against = [], f"against the {found.source}"
    if abs(wheels.delay_s) >= DELAY_S:
        side = "ahead" if wheels.delay_s > 0.0 else "behind"
        warnings.append(f"wheels: their stamps are {abs(wheels.delay_s):.2f} s {side}, {against}")
    for side, gain in (("right", wheels.gain_right), ("left", wheels.gain_left)):
        if abs(gain - 1.0) > GAIN:
            warnings.append(
                f"wheels: the {side} one travels {gain:.3f} m a logged metre, {against}"
            )
    if abs(wheels.track_m / track_m - 1.0) > TURN:
        warnings.append(
            f"wheels: they turn the robot as {wheels.track_m:.3f} m apart do, not {track_m:.3f} m"
        )
    for name, sensor in found.calibration.sensors.items():
        if sensor.mirrored:
            warnings.append(f"{name}: its beams run the other way: it is mounted upside down")
        if abs(sensor.scale - 1.0) > GAIN:
            longer = 100.0 * (sensor.scale - 1.0)
            warnings.append(f"{name}: ranges are {longer:+.1f} % off, {against}")
    left = found.residuals
    if len(left.bearing_rad):
        warnings += _by_bearing(left.range_m, left.range_error_m, np.abs(left.bearing_rad))
    return warnings + [
        f"{name.partition(':')[0]}: {100.0 * share.value:.2g} % of its readings are outliers"
        for name, share in found.intervals.items()
        if name.endswith(": outliers") and share.low > 0.0
    ]


def _by_bearing(depth_m: Array, error_m: Array, bearing_rad: Array) -> list[str]:
    """Depths whose relative error changes with the bearing are ranges, not depths."""
    inner, outer = np.quantile(bearing_rad, [0.3, 0.8])
    share = error_m / depth_m
    near, far = share[bearing_rad < inner], share[bearing_rad > outer]
    enough = min(len(near), len(far)) >= 20
    change = float(np.median(far) - np.median(near)) if enough else 0.0
    if abs(change) < GAIN:
        return []
    return [
        f"landmarks: relative depth errors change by {100.0 * change:+.1f} % from the image's "
        f"middle to {math.degrees(outer):.0f} degrees off it; are they ranges?"
    ]
