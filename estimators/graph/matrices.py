"""Matrices of least squares: normal equations by blocks, their factors, and stacks of 3 x 3."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import splu

from sim.arrays import Array, Ints

_AT_ONCE = 50  # poses whose columns of a covariance are solved for together


class Factor:
    """A symmetric, positive definite matrix, factorised: sparse, or dense.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """

    def __init__(self, matrix: Array | bsr_array) -> None:
        self.n = matrix.shape[0]
        if isinstance(matrix, np.ndarray):
            self._dense = cho_factor(matrix, lower=True, check_finite=False)
            return
        self._dense = None
        try:  # with the pivots on the diagonal L U is L D L'
            self._sparse = splu(
                csc_array(matrix),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise np.linalg.LinAlgError(str(error)) from None
        if not (self._sparse.U.diagonal() > 0.0).all():
            raise np.linalg.LinAlgError("not positive definite")

    def solve(self, right: Array) -> Array:
        """The matrix's inverse times (n,) or (n, K)."""
        if self._dense is not None:
            return np.asarray(cho_solve(self._dense, right), dtype=np.float64)
        return np.asarray(self._sparse.solve(right), dtype=np.float64)

    def columns(self, poses: Ints) -> Array:
        """(n, 3 K) columns of the inverse: covariances of all with these K poses."""
        chosen = (3 * np.asarray(poses)[:, None] + np.arange(3)).ravel()
        units = np.zeros((self.n, len(chosen)))
        units[chosen, np.arange(len(chosen))] = 1.0
        return self.solve(units)

    def joint(self, poses: Ints) -> Array:
        """(3 K, 3 K) joint covariance of these poses."""
        chosen = (3 * np.asarray(poses)[:, None] + np.arange(3)).ravel()
        block: Array = self.columns(poses)[chosen]
        return (block + block.T) / 2.0

    def marginals(self, poses: Ints) -> Array:
        """(K, 3, 3) covariance of each of these poses."""
        found = np.empty((len(poses), 3, 3))
        for begin in range(0, len(poses), _AT_ONCE):
            part = np.asarray(poses)[begin : begin + _AT_ONCE]
            own = self.columns(part).reshape(-1, 3, len(part), 3)[part, :, np.arange(len(part))]
            found[begin : begin + len(part)] = (own + transpose(own)) / 2.0
        return found

    @cached_property
    def inverse(self) -> Array:
        """(n, n)."""
        if self._dense is None:
            return self.columns(np.arange(self.n // 3))
        lower = np.tril(lapack.dpotri(self._dense[0], lower=1)[0])
        return np.asarray(lower + np.tril(lower, -1).T, dtype=np.float64)


class NormalEquations:
    """Information and gradient of squared residuals, summed over n poses; the matrix is sparse.

    Attributes
    ----------
    g
        (n, 3) gradient.
    """

    def __init__(self, n: int) -> None:
        self._n = n
        self._places: list[Ints] = []
        self._values: list[Array] = []
        self.g = np.zeros((n, 3))

    def add(
        self, rows: Sequence[Ints], sides: Sequence[Array], e: Array, weights: Array | None = None
    ) -> None:
        """Add K residuals e (K, 3), of weights (K,) if not of 1.

        `rows` are the one or more poses (K,) of each, and `sides` the derivatives (K, 3, 3) by
        them.
        """
        for own, by_own in zip(rows, sides, strict=True):
            weighted = transpose(by_own)
            if weights is not None:
                weighted = weights[:, None, None] * weighted
            np.add.at(self.g, own, times(weighted, e))
            for other, by_other in zip(rows, sides, strict=True):
                self._places.append(own * self._n + other)  # which may come twice
                self._values.append(weighted @ by_other)

    def matrix(self) -> bsr_array:
        """(3 n, 3 n)."""
        n = self._n
        places, row_of = np.unique(np.concatenate(self._places), return_inverse=True)
        summed = np.zeros((len(places), 3, 3))
        np.add.at(summed, row_of, np.concatenate(self._values))
        starts = np.searchsorted(places, n * np.arange(n + 1))
        return bsr_array((summed, places % n, starts), shape=(3 * n, 3 * n))


def times(matrices: Array, vectors: Array) -> Array:
    """Products (K, m) of matrices (K, m, n) and vectors (K, n)."""
    return (matrices @ vectors[:, :, None])[:, :, 0]


def transpose(matrices: Array) -> Array:
    """Each of the matrices (K, m, n) transposed."""
    return matrices.transpose(0, 2, 1)


def inverse(matrices: Array) -> Array:
    """Inverses of matrices (K, m, m)."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def whitening_of(covariances: Array) -> Array:
    """Matrices (..., 3, 3) that make residuals of these covariances unit white noise."""
    return inverse(np.asarray(np.linalg.cholesky(covariances), dtype=np.float64))
