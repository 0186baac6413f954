import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sim import se2
from sim.formats import assemble
from sim.robot.arc import arc_increment


def drive(wheels, track_m):
    """Poses at the wheel stamps."""
    poses = np.zeros((len(wheels.stamps), 3))
    for i, step in enumerate(arc_increment(np.diff(wheels.position_m, axis=0), track_m)):
        poses[i + 1] = se2.compose(poses[i], step)
    return poses


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1.0))
def test_rebuilt_wheels_drive_through_any_poses(seed, track_m):
    rng = np.random.default_rng(seed)
    poses = np.cumsum(rng.normal(0.0, [0.5, 0.5, 1.5], (20, 3)), axis=0)
    poses[0] = 0.0
    poses[:, 2] = se2.wrap(poses[:, 2])
    stamps = np.arange(20.0)
    wheels = assemble.wheels_from_poses(stamps, poses, track_m, {})
    assert np.all(np.diff(wheels.stamps) > 0.0)
    rows = np.searchsorted(wheels.stamps, stamps)
    np.testing.assert_array_equal(wheels.stamps[rows], stamps)
    reached = drive(wheels, track_m)[rows]
    off = se2.between(poses, reached)
    # motions with less than 2 % or 1 mm to the side stay arcs
    assert np.abs(off[:, :2]).max() < 0.3
    np.testing.assert_allclose(off[:, 2], 0.0, atol=1e-9)


def test_arcs_stay_arcs_and_sideways_motion_is_noted():
    stamps = np.arange(4) * 0.1
    steps = np.array([[0.1, 0.05], [0.1, 0.1], [-0.05, 0.1]])
    poses = np.zeros((4, 3))
    for i, step in enumerate(arc_increment(steps, 0.3)):
        poses[i + 1] = se2.compose(poses[i], step)
    notes = {}
    wheels = assemble.wheels_from_poses(stamps, poses, 0.3, notes)
    np.testing.assert_allclose(np.diff(wheels.position_m, axis=0), steps, atol=1e-12)
    assert notes["sideways_share"] < 1e-9
    slid = poses + np.array([0.0, 0.02, 0.0]) * np.arange(4)[:, None]
    assemble.wheels_from_poses(stamps, slid, 0.3, notes)
    assert notes["sideways_share"] > 0.1


def test_velocities_hold_but_not_for_ever():
    stamps = np.array([0.0, 1.0, 11.0, 12.0])
    velocity = np.array([[0.2, 0.5], [0.1, 0.0], [0.3, -0.5], [9.0, 9.0]])
    wheels = assemble.wheels_from_velocities(stamps, velocity, 0.4, longest_hold_s=1.5)
    np.testing.assert_allclose(wheels.stamps, [0.0, 1.0, 2.5, 11.0, 12.0])
    middle = wheels.position_m.mean(axis=1)
    np.testing.assert_allclose(middle, [0.0, 0.2, 0.35, 0.35, 0.65])
    turn = np.diff(wheels.position_m[:, 0] - wheels.position_m[:, 1]) / 0.4
    np.testing.assert_allclose(turn, [0.5, 0.0, 0.0, -0.5], atol=1e-12)


def test_order_and_repetition_are_noted():
    notes = {}
    rows = assemble.in_order(np.array([1.0, 3.0, 2.0, 3.0, 4.0]), "scans", notes)
    np.testing.assert_array_equal(rows, [0, 2, 3, 4])
    assert notes == {"scans_backward": 1, "scans_repeated": 1, "scans_longest_gap_s": 1.0}


def test_frames_are_dense_enough_and_within_the_wheels_span():
    wheels = np.arange(0.0, 10.0, 0.01)
    scans = np.array([-1.0, 0.5, 0.55, 3.0, 9.5, 20.0])
    frames = assemble.frame_stamps(wheels, [scans], longest_s=0.2)
    assert set(scans[1:5]) <= set(frames)
    assert frames[0] == wheels[0]
    assert frames[-1] == wheels[-1]
    assert np.diff(frames).max() < 0.2 + 0.011
    assert len(frames) < 70  # about ten seconds' worth
    sparse = assemble.frame_stamps(np.array([0.0, 5.0, 10.0]), [np.array([1.0, 9.0])])
    np.testing.assert_array_equal(sparse, [0.0, 1.0, 5.0, 9.0, 10.0])
