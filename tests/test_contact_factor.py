"""Factors of the contact rows of a face, wherever the rows are."""

import numpy as np
import pytest
from petsc4py import PETSc

from tfeti_dolfinx.feti.preconditioner import ContactFactor


def matrix(rows):
    """4 on the diagonal and −1 beside it, so many rows on this rank."""
    A = PETSc.Mat().createAIJ(((rows, None), (rows, None)), nnz=3)
    first, last = A.getOwnershipRange()
    size = A.getSize()[0]
    for i in range(first, last):
        for j, value in ((i - 1, -1.0), (i, 4.0), (i + 1, -1.0)):
            if 0 <= j < size:
                A.setValue(i, j, value)
    A.assemble()
    return A


@pytest.mark.parametrize("where", ["all", "last", "not the first"])
def test_a_factor_is_the_inverse_wherever_its_rows_are(comm, where):
    first = {"all": 0, "last": comm.size - 1, "not the first": min(1, comm.size - 1)}[where]
    A = matrix(13 if comm.rank >= first else 0)
    x, b = A.createVecs()
    for _ in range(3):
        x.array[:] = np.random.default_rng(comm.rank).standard_normal(x.local_size)
        A.mult(x, b)
        factor = ContactFactor(A.copy(), "test_contact_factor_")
        assert np.allclose(factor.solve(b.array_r), x.array_r, rtol=0, atol=1e-12)
        factor.destroy()
