"""Algebra on parts of columns that do not meet, against dense algebra on all of them."""

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from tfeti_dolfinx.feti.rigid_bodies import orthonormal_columns, parts_of_columns


def scattered(rng):
    """Two groups of columns on rows of their own, and a row of none, in any order."""
    dense = block_diag(rng.standard_normal((4, 2)), rng.standard_normal((5, 3)), np.zeros((1, 0)))
    return dense[rng.permutation(10)][:, rng.permutation(5)]


def test_parts_do_not_meet_and_are_all():
    dense = scattered(np.random.default_rng(0))
    again = np.zeros_like(dense)
    sizes = []
    for columns, rows, part in parts_of_columns(csr_array(dense)):
        again[np.ix_(rows, columns)] = part
        sizes.append(part.shape)
    assert np.array_equal(again, dense)
    assert sorted(sizes) == [(4, 2), (5, 3)]


def test_orthonormal_columns_span_the_same():
    dense = scattered(np.random.default_rng(1))
    Q = orthonormal_columns(csr_array(dense))
    assert Q.nnz <= 4 * 2 + 5 * 3
    assert np.allclose((Q.T @ Q).toarray(), np.eye(5), atol=1e-14)
    assert np.allclose(Q @ (Q.T @ dense), dense, atol=1e-14)
