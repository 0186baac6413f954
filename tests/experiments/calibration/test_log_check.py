"""`estima info --check`: each oddity is told where it is planted, and only there."""

import dataclasses
import re

import numpy as np
import pytest

from experiments.calibration import log_check
from experiments.calibration.log_check import check_log
from sim.recording import Truth
from tests.experiments.calibration.test_from_log import log_of


@pytest.fixture(scope="module")
def warnings():
    return check_log(log_of(120.0))


def test_planted_delay_gains_and_scale_are_told(warnings):
    text = "\n".join(warnings)
    assert re.search(
        r"wheels: their stamps are 0\.(1[89]|2[012]?) s ahead, against the truth", text
    )
    assert "the right one travels 0.9" in text
    assert re.search(r"as 0\.2[01]\d m apart do, not 0\.190 m", text)
    assert "stereo: ranges are +4." in text
    assert "outliers" in text
    assert "are they ranges?" not in text


def test_ranges_read_as_depths_are_told():
    log = log_of(120.0)
    points = log.log("stereo")["points_in_camera"].copy()
    points *= (np.hypot(points[:, 0], points[:, 2]) / points[:, 2])[:, None]
    stereo = log.log("stereo")
    values = {**stereo.values, "points_in_camera": points}
    wrong = log.with_log("stereo", dataclasses.replace(stereo, values=values))
    assert "are they ranges?" in "\n".join(check_log(wrong))


def test_clocks():
    log = log_of(120.0).without("stereo")
    stamps = np.round(log.truth.stamps, 6) + 0.0123456
    kept = (stamps < 30.0) | (stamps > 38.0)
    truth = Truth(stamps[kept], log.truth.poses[kept])
    odd = dataclasses.replace(
        log,
        truth=truth,
        config={"notes": {"scans_repeated": 3, "scans_backward": 2, "scans_of_other_geometry": 4}},
    )
    text = "\n".join(check_log(odd))
    assert "scans: 3 readings repeat the stamp of another" in text
    assert "scans: 2 readings were out of order" in text
    assert "scans: 4 readings have other angles" in text
    assert "truth: 1 gap, the longest 8.0" in text
    assert "wheels: stamps are whole steps of 0.01 s" in text
    assert "truth: stamps are whole steps" not in text


def test_a_pose_that_was_reset_is_a_jump():
    log = log_of(120.0).without("stereo")
    assert not log_check._jumps(log.wheels)
    stamps, position_m = log.wheels.stamps, log.wheels.position_m.copy()
    position_m[len(stamps) // 2 :] += 500.0
    (said,) = log_check._jumps(dataclasses.replace(log.wheels, position_m=position_m))
    assert re.fullmatch(r"wheels: 1 jump, the first of 500 m at [\d.]+ s \(usually .*", said)


@pytest.mark.parametrize("begin_s", [0.0, 1_700_000_000.0])
def test_unix_time_is_no_coarse_clock(begin_s):
    fine = begin_s + 0.0371931 * np.arange(200)
    assert log_check._clock("wheels", fine) == []
    assert "whole steps of 0.1 s" in log_check._clock("wheels", begin_s + 0.3 * np.arange(200))[0]
    coarse = begin_s + np.round(fine - begin_s, 2)
    assert "whole steps of 0.01 s" in log_check._clock("wheels", coarse)[0]
