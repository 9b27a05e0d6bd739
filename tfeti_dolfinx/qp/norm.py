"""The norm of PFP, which step lengths are relative to."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.problem import Operator

# an off-diagonal entry this small in units of the norm ends the method: the space is exhausted
EXHAUSTED = 1e-12


def estimate_norm(F: Operator, coarse: Coarse, like: PETSc.Vec, steps: int = 15) -> float:
    """‖PFP‖ by the Lanczos method: the largest Ritz value, and its residual on top. Collective.

    The Ritz value alone is a lower bound. There is an eigenvalue within the residual of it, the
    largest one in practice: the sum is an upper bound that is close. The start is random, but
    the same in every run on the same number of ranks. (Parlett, The Symmetric Eigenvalue
    Problem, SIAM 1998, section 13.2.)

    Args:
        F: Symmetric positive semidefinite operator.
        coarse: Gives the projector P.
        like: A vector of the right layout.
        steps: Most multiplications by F.
    """
    v, previous, w = (like.duplicate() for _ in range(3))
    rng = np.random.default_rng(like.getComm().getRank())
    v.array[:] = rng.standard_normal(v.getLocalSize())
    coarse.project(v)
    previous.set(0.0)
    diagonal: list[float] = []
    beside: list[float] = [v.norm()]
    comm = like.getComm().tompi4py()
    while len(diagonal) < steps and agreed(comm, beside[-1] > EXHAUSTED * _size(diagonal, beside)):
        v.scale(1.0 / beside[-1])
        F.mult(v, w)
        coarse.project(w)
        diagonal.append(w.dot(v))
        w.axpy(-diagonal[-1], v)
        if len(diagonal) > 1:
            w.axpy(-beside[-1], previous)
        beside.append(w.norm())
        previous, v, w = v, w, previous
    for vec in (v, previous, w):
        vec.destroy()
    if not diagonal:
        return 0.0
    off = np.array(beside[1:-1])
    values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1))
    return agreed(comm, float(values[-1] + beside[-1] * abs(vectors[-1, -1])))


def _size(diagonal: list[float], beside: list[float]) -> float:
    """Size of the entries so far; 0 before the first step, whose vector may have any length."""
    return max(diagonal) + max(beside[1:]) if diagonal else 0.0
