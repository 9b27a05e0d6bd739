"""D, with which rows of B are scaled."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array


def row_weights(blocks: Array, scaling: str, comm: MPI.Intracomm) -> Array:
    """D: at each node the mean of the diagonal of K, over the smallest of them; or ones.

    One number for a node: then a scene that is turned has the rows of the scene, turned.
    Collective.

    Args:
        blocks: The block of K of each local primal node, shape ``(num_nodes, bs, bs)``.
        scaling: "stiffness", or "multiplicity" for ones.
        comm: Communicator.

    Returns:
        One for each unknown, shape ``(num_nodes * bs,)``.
    """
    diagonals = np.diagonal(blocks, axis1=1, axis2=2)
    if scaling == "multiplicity":
        return np.ones(diagonals.size)
    means = np.mean(np.maximum(diagonals, 0.0), axis=1)
    positive = means > 0.0  # what is not is reported when Blocks are built
    lowest = float(np.min(means[positive], initial=np.inf))
    D = np.where(positive, means / comm.allreduce(lowest, op=MPI.MIN), 1.0)
    return np.repeat(D, blocks.shape[1])
