"""Least squares over a long drive: the chain of poses goes first, with the same solution."""

import dataclasses
import signal

import numpy as np
import pytest

from estimators.graph import least_squares
from estimators.graph.fixed_lag import FixedLag
from estimators.graph.least_squares import LeastSquaresOptions, solve
from estimators.graph.matrices import Arrow, Chain, Factor
from estimators.graph.smoother import Smoother
from experiments.runs.evaluate import run_over
from experiments.runs.processes import hold_interrupts
from tests.estimators.graph.test_smoother import CAMERA, small_problem
from tests.fixtures.fakes import circle, tracking_prior

NEVER = 10**9


# Coarse, since a fine one makes the equations so ill-conditioned that either way of elimination
# loses half of the digits
COARSE = dataclasses.replace(
    CAMERA, sigma_column_px=10.0, sigma_row_px=10.0, sigma_disparity_px=2.0
)


def chain_problem(n_poses=120):
    """A long problem without its closed loop."""
    problem, guess, _, _ = small_problem(3, COARSE, n_poses=n_poses, n_landmarks=15)
    return dataclasses.replace(
        problem,
        first=problem.first[:-1],
        second=problem.second[:-1],
        motions=problem.motions[:-1],
        motion_covariances=problem.motion_covariances[:-1],
    ), guess


@pytest.mark.parametrize("robust", ["none", "cauchy"])
def test_both_eliminations_agree(robust, monkeypatch):
    problem, guess = chain_problem()
    how = LeastSquaresOptions(robust=robust)
    by_chain = solve(problem, guess, how, tolerance=1e-13)
    assert isinstance(by_chain.information, Arrow)
    monkeypatch.setattr(least_squares, "_SPARSE_POSES", NEVER)
    dense = solve(problem, guess, how, tolerance=1e-13)
    assert isinstance(dense.information, Factor)
    assert by_chain.iterations == dense.iterations
    for name in ("poses", "landmarks", "landmark_covariances", "covariance"):
        mine, theirs = getattr(by_chain, name), getattr(dense, name)
        np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-9 * np.abs(theirs).max())
    mine, theirs = by_chain.information.joints(), dense.information.joints()
    np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-9 * np.abs(theirs).max())


def test_a_closed_loop_is_no_chain():
    problem, guess, _, _ = small_problem(3, n_poses=120, n_landmarks=15)
    assert isinstance(solve(problem, guess).information, Factor)


def test_blocks_of_a_chains_inverse():
    rng = np.random.default_rng(0)
    whole = np.zeros((30, 30))
    for i in range(9):
        rows = slice(3 * i, 3 * i + 6)
        root = rng.standard_normal((6, 6))
        whole[rows, rows] += root @ root.T
    blocks = whole.reshape(10, 3, 10, 3)
    each = np.arange(10)
    chain = Chain(blocks[each, :, each], blocks[each[:-1], :, each[1:]])
    inverse = np.linalg.inv(whole)
    right = rng.standard_normal((30, 2))
    np.testing.assert_allclose(chain.solve(right), inverse @ right, rtol=1e-8, atol=1e-8)
    own, following = chain.near()
    inverse = inverse.reshape(10, 3, 10, 3)
    np.testing.assert_allclose(own, inverse[each, :, each], rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(following, inverse[each[:-1], :, each[1:]], rtol=1e-7, atol=1e-8)
    with pytest.raises(np.linalg.LinAlgError):
        Chain(blocks[each, :, each] - 50.0 * np.eye(3), blocks[each[:-1], :, each[1:]])


@pytest.mark.parametrize("estimator", [Smoother(), FixedLag(lag_images=2)])
def test_finish_says_that_it_goes_on_and_can_be_stopped(estimator):
    recording = circle(n_frames=60)
    prior, calls = tracking_prior(recording), []
    run_over(recording, estimator, prior, np.random.default_rng(0), on_step=calls.append)
    assert calls.count(60) > 1  # the last Frame, and the steps of finish

    def interrupted():
        with hold_interrupts() as interrupt:

            def step(done):
                if done == 60:
                    signal.raise_signal(signal.SIGINT)
                interrupt()

            run_over(recording, estimator, prior, np.random.default_rng(0), on_step=step)

    with pytest.raises(KeyboardInterrupt):
        interrupted()
