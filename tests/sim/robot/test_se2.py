import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sim import se2

coordinate = st.floats(-50.0, 50.0)
pose = st.tuples(coordinate, coordinate, st.floats(-np.pi + 1e-3, np.pi)).map(np.array)


def close(a, b, tolerance=1e-9):
    difference = np.asarray(a) - np.asarray(b)
    difference[..., 2] = se2.wrap(difference[..., 2])
    return np.allclose(difference, 0.0, atol=tolerance)


@given(pose, pose, pose)
def test_group_laws(a, b, c):
    assert close(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))
    assert close(se2.compose(a, se2.inverse(a)), np.zeros(3))
    assert close(se2.compose(a, se2.between(a, b)), b)


@given(pose, pose)
def test_compose_is_the_product_of_homogeneous_matrices(a, b):
    def matrix(p):
        c, s = np.cos(p[2]), np.sin(p[2])
        return np.array([[c, -s, p[0]], [s, c, p[1]], [0, 0, 1]])

    assert np.allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-9)
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    expected = (matrix(a) @ np.column_stack([points, np.ones(2)]).T).T[:, :2]
    assert np.allclose(se2.transform(a, points), expected, atol=1e-9)


@given(st.floats(-1e4, 1e4))
def test_wrap_keeps_the_direction_in_range(angle):
    wrapped = float(se2.wrap(angle))
    assert -np.pi < wrapped <= np.pi
    assert np.isclose(np.cos(wrapped), np.cos(angle), atol=1e-9)
    assert np.isclose(np.sin(wrapped), np.sin(angle), atol=1e-9)


def test_wrap_takes_pi_for_both_ends():
    assert float(se2.wrap(-np.pi)) == np.pi
    assert float(se2.wrap(np.pi)) == np.pi


@given(arrays(float, 3, elements=st.floats(-3.0, 3.0)))
def test_log_inverts_exp(twist):
    assert np.allclose(se2.log(se2.exp(twist)), twist, atol=1e-8)


@given(st.floats(-2e-4, 2e-4))
def test_exp_and_log_have_no_step_at_the_small_angle_switch(angle):
    reached = se2.exp([2.0, -1.0, angle])
    quarter = se2.exp(np.array([2.0, -1.0, angle]) / 4)
    four = se2.compose(se2.compose(quarter, quarter), se2.compose(quarter, quarter))
    assert close(reached, four, 1e-13)
    assert np.allclose(se2.log(reached), [2.0, -1.0, angle], atol=1e-12)


def test_log_of_an_unwrapped_heading_is_the_longer_way_round():
    twist = np.array([1.0, 0.2, 5.0])
    end = se2.exp(twist)
    end[2] = 5.0
    assert np.allclose(se2.log(end), twist, atol=1e-12)


@pytest.mark.parametrize("name", ["compose", "between"])
def test_jacobians_match_finite_differences(name):
    rng = np.random.default_rng(0)
    function, jacobians = getattr(se2, name), getattr(se2, f"{name}_jacobians")
    a, b = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    by_first, by_second = jacobians(a, b)
    step = 1e-6
    for i in range(3):
        d = np.zeros(3)
        d[i] = step
        first = function(a + d, b) - function(a - d, b)
        second = function(a, b + d) - function(a, b - d)
        for numeric, exact in ((first, by_first[..., i]), (second, by_second[..., i])):
            numeric[:, 2] = se2.wrap(numeric[:, 2])
            assert np.allclose(numeric / (2 * step), exact, atol=1e-8)
