"""Calibration from a sheet of end poses."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from experiments.calibration.sheet import COLUMNS, calibrate_sheet, read_sheet, unwrap_headings
from sim import se2
from sim.errors import InputError
from sim.robot.drive import DifferentialDrive
from sim.robot.kinematic import run_batch
from sim.routes.route import TABLE_1

EXAMPLE = Path(__file__).resolve().parents[3] / "docs" / "examples" / "end_poses.csv"
TRUE = DifferentialDrive(
    wheel_radius_m=0.05,
    track_m=0.19,
    kr=1.5e-4,
    kl=5e-5,
    bias_right=0.05,
    bias_left=-0.03,
    nominal_track_m=0.0836,
)
HEAD = "case,v_mps,omega_radps,duration_s,x_m,y_m,heading_rad\n"
COMMANDS = {name: route.segments[0] for name, route in TABLE_1.items()}


def write_sheet(path, commands, ends):
    rows = [
        [case, *commands[case], *(f"{value:.4f}" for value in pose)]
        for case, poses in ends.items()
        for pose in poses
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in [COLUMNS, *rows]) + "\n")


def rng():
    return np.random.default_rng(3)


@pytest.fixture(scope="module")
def ends():
    noise = rng()
    return {name: run_batch(TRUE, route, 5, noise).end_poses for name, route in TABLE_1.items()}


def refused(tmp_path, lines, *words, head=HEAD, **options):
    path = tmp_path / "sheet.csv"
    path.write_text(head + lines)
    with pytest.raises(InputError) as error:
        calibrate_sheet(path, TRUE, rng(), **options)
    for word in ("sheet.csv", *words):
        assert word in str(error.value)


def test_the_short_turns_of_a_robot_are_found(tmp_path, ends):
    """The controller's track is 0.44 of the true one; the sheet's headings are wrapped too."""
    wrapped = {name: np.column_stack([p[:, :2], se2.wrap(p[:, 2])]) for name, p in ends.items()}
    write_sheet(tmp_path / "sheet.csv", COMMANDS, wrapped)
    found = calibrate_sheet(tmp_path / "sheet.csv", TRUE, rng(), geometry=True)
    assert found.n_used == 45
    for name, interval in found.found.items():
        true, sigma = getattr(TRUE, name), (interval.high - interval.low) / 3.92
        assert abs(interval.value - true) < 3.0 * sigma, name
    assert found.track_m.high - found.track_m.low < 0.02 * TRUE.track_m


def test_a_robot_that_turns_three_times_too_far_is_found(tmp_path):
    """From the nominal geometry the likelihood would climb to another maximum."""
    robot, noise = dataclasses.replace(TRUE, nominal_track_m=0.57), rng()
    ends = {name: run_batch(robot, route, 5, noise).end_poses for name, route in TABLE_1.items()}
    write_sheet(tmp_path / "sheet.csv", COMMANDS, ends)
    found = calibrate_sheet(tmp_path / "sheet.csv", robot, rng(), geometry=True)
    assert found.track_m.value == pytest.approx(0.19, rel=0.01)
    assert found.kr.low < robot.kr < found.kr.high


def test_the_sheets_robot_brings_its_nominal_geometry_alone(tmp_path, ends):
    write_sheet(tmp_path / "sheet.csv", COMMANDS, ends)
    other = DifferentialDrive(wheel_radius_m=0.05, track_m=0.0836, kr=1.0, bias_left=0.5)
    results = [
        calibrate_sheet(tmp_path / "sheet.csv", robot, rng(), geometry=True)
        for robot in (TRUE, other)
    ]
    assert results[0] == results[1]


def test_a_sheet_reads_as_it_was_written(tmp_path, ends):
    write_sheet(tmp_path / "sheet.csv", COMMANDS, ends)
    commands, read = read_sheet(tmp_path / "sheet.csv")
    assert commands == COMMANDS
    for name, poses in ends.items():
        np.testing.assert_allclose(read[name], poses, atol=5.1e-5)


def test_wrapped_headings_follow_the_short_turns():
    headings = [
        np.array([1.2, 1.3]),
        np.array([4.1 - 2.0 * math.pi]),
        np.array([0.1]),
        np.array([9.0]),
    ]
    turns = [1.5, 5.0, 0.0, 3.0 * math.pi]
    found = unwrap_headings(headings, turns)
    np.testing.assert_allclose(np.concatenate(found), [1.2, 1.3, 4.1, 0.1, 9.0], atol=1e-12)
    # a robot that turns short did not wrap
    np.testing.assert_allclose(
        unwrap_headings([np.array([0.66]), np.array([2.2])], [1.5, 5.0])[1], 2.2
    )


def test_what_is_wrong_is_named_with_its_line(tmp_path):
    good = "a,0.5,0,2,1,0,0.01\na,0.5,0,2,1,0,-0.02\n"
    refused(tmp_path, "", ":1:", "the columns must be", head="case,x_m\n")
    refused(tmp_path, "", "holds no run")
    refused(tmp_path, good + "b,0.5,0,2,1,zero,0\n", ":4:", "y_m", "zero")
    refused(tmp_path, good + "b,0.5,0,2,1,nan,0\n", ":4:", "y_m", "finite")
    refused(tmp_path, good + "b,0.5,0,2,1\n", ":4:", "y_m", "None")
    refused(tmp_path, good + "b,0.5,0,2,1,0,0,7\n", ":4:", "more than 7 cells")
    refused(tmp_path, good + ",0.5,0,2,1,0,0\n", ":4:", "no name")
    refused(tmp_path, good + "a,0.6,0,2,1,0,0\n", ":4:", "another command")
    refused(tmp_path, good + "b,0.5,0,1e9,1,0,0\n", ":4:", "duration_s")
    refused(tmp_path, good + "b,0,0,2,1,0,0\n", ":4:", "must move")
    refused(tmp_path, good, "too few")
    turns = [f"t{i},0,0.5,{i + 1},0,0,{0.5 * (i + 1)}\n" for i in range(8)]
    refused(tmp_path, "".join(turns), "do not scatter", "repetitions")
    refused(tmp_path, 4 * good, "straights and turns", geometry=True)


def test_the_example_is_calibrated():
    robot = DifferentialDrive(wheel_radius_m=0.05, track_m=0.19, nominal_track_m=0.0836)
    found = calibrate_sheet(EXAMPLE, robot, rng(), geometry=True)
    assert found.track_m.low < 0.19 < found.track_m.high
    assert found.kr.low < 1.5e-4 < found.kr.high
