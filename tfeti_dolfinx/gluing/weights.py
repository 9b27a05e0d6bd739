"""D, with which rows of B are scaled."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array


def row_weights(diagonal: Array, scaling: str, comm: MPI.Intracomm) -> Array:
    """D: the diagonal of K over its smallest entry, or ones. Collective.

    Args:
        diagonal: Diagonal of K on the local primal unknowns.
        scaling: "stiffness", or "multiplicity" for ones.
        comm: Communicator.
    """
    if scaling == "multiplicity":
        return np.ones(len(diagonal))
    positive = diagonal > 0.0  # what is not is reported when Blocks are built
    lowest = float(np.min(diagonal[positive], initial=np.inf))
    return np.where(positive, diagonal / comm.allreduce(lowest, op=MPI.MIN), 1.0)
