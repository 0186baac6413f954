"""Matrices of least squares: normal equations by blocks, their factors, and stacks of 3 x 3."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular
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

    def joints(self) -> Array:
        """(n - 1, 6, 6) covariance of each pose with the next."""
        rows = 3 * np.arange(self.n // 3 - 1)[:, None] + np.arange(6)
        found: Array = self.inverse[rows[:, :, None], rows[:, None, :]]
        return found


class Chain:
    """A matrix of 3 x 3 blocks on the diagonal and next to it, factorised block by block.

    Parameters
    ----------
    own, following
        (n, 3, 3) on the diagonal, and (n - 1, 3, 3) to the right of it.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """

    def __init__(self, own: Array, following: Array) -> None:
        pivots = own.copy()
        self._gains = np.empty_like(following)
        for i, beside in enumerate(following):
            self._gains[i] = np.linalg.solve(pivots[i], beside)
            pivots[i + 1] -= beside.T @ self._gains[i]
        np.linalg.cholesky(pivots)
        self._inverses = inverse(pivots)

    def solve(self, right: Array) -> Array:
        """The matrix's inverse times (3 n, K)."""
        solved: Array = right.reshape(len(self._inverses), 3, -1).copy()
        for i, gain in enumerate(self._gains):
            solved[i + 1] -= gain.T @ solved[i]
        solved = self._inverses @ solved
        for i in range(len(self._gains) - 1, -1, -1):
            solved[i] -= self._gains[i] @ solved[i + 1]
        return solved.reshape(right.shape)

    def near(self) -> tuple[Array, Array]:
        """Blocks of the inverse: (n, 3, 3) on the diagonal, (n - 1, 3, 3) to the right of it."""
        own, following = self._inverses.copy(), np.empty_like(self._gains)
        for i in range(len(self._gains) - 1, -1, -1):
            following[i] = -self._gains[i] @ own[i + 1]
            own[i] -= following[i] @ self._gains[i].T
        return own, following


class Arrow:
    """Information about a chain of n poses, and N landmarks seen from them: poses go first.

    So what is left to factorise as a dense matrix is as large as the map, however long the drive.

    Parameters
    ----------
    H
        (3 n, 3 n) of the poses, blocks on the diagonal and next to it.
    W
        (3 N, 3 n) of the landmarks with the poses.
    V
        (N, 3, 3) of the landmarks.
    """

    def __init__(self, H: bsr_array, W: bsr_array, V: Array) -> None:
        self.n = H.shape[0]
        rows = np.repeat(np.arange(self.n // 3), np.diff(H.indptr))
        blocks = np.zeros((2, self.n // 3, 3, 3))
        for side in (0, 1):
            chosen = H.indices - rows == side
            blocks[side, rows[chosen]] = H.data[chosen]
        self._chain = Chain(blocks[0], blocks[1, :-1])
        self._gain = self._chain.solve(W.toarray().T)
        S = -(W @ self._gain)
        n_landmarks, each = len(V), np.arange(len(V))
        S.reshape(n_landmarks, 3, n_landmarks, 3)[each, :, each] += V
        self._map = cho_factor((S + S.T) / 2.0, lower=True, check_finite=False)

    def step(self, g: Array, h: Array) -> tuple[Array, Array]:
        """The inverse times (n, 3) of the poses and (N, 3) of the landmarks."""
        of_landmarks = cho_solve(
            self._map, h.ravel() - self._gain.T @ g.ravel(), check_finite=False
        )
        of_poses = self._chain.solve(g.reshape(-1, 1))[:, 0] - self._gain @ of_landmarks
        return of_poses.reshape(-1, 3), of_landmarks.reshape(-1, 3)

    def joints(self) -> Array:
        """(n - 1, 6, 6) covariance of each pose with the next."""
        root = solve_triangular(self._map[0], self._gain.T, lower=True)
        root = root.reshape(len(root), -1, 3).transpose(1, 2, 0)
        own, following = self._chain.near()
        own = own + root @ root.transpose(0, 2, 1)
        following = following + root[:-1] @ root[1:].transpose(0, 2, 1)
        return np.block([[own[:-1], following], [transpose(following), own[1:]]])

    @property
    def of_landmarks(self) -> Array:
        """(N, 3, 3) covariance of each landmark."""
        n = len(self._map[0]) // 3
        whole = cho_solve(self._map, np.eye(3 * n)).reshape(n, 3, n, 3)
        return np.asarray(whole[np.arange(n), :, np.arange(n)])

    @property
    def inverse(self) -> Array:
        """(3 n, 3 n) covariance of all poses."""
        alone = self._chain.solve(np.eye(self.n))
        whole: Array = alone + self._gain @ cho_solve(self._map, self._gain.T)
        return (whole + whole.T) / 2.0


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
