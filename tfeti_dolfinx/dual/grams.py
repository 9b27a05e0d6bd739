"""GGᵀ of all rows and of faces, sparse, on all ranks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array, csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import any_rank
from tfeti_dolfinx.qp.faces import Face


class Grams:
    """GGᵀ, and G_f G_fᵀ of faces f: what gluing and Dirichlet rows add to all is made once.

    An entry is stored for each pair of coordinates that meet in a row, so that storage grows with
    the number of subdomains. A face costs what its contact rows cost. All methods are collective.

    Args:
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        bounded: Local rows that some set may constrain.
        comm: Communicator. The constructor is collective.

    Attributes:
        whole: GGᵀ, shape ``(r, r)``.
    """

    def __init__(self, Gt: csr_array, bounded: Array, comm: MPI.Intracomm) -> None:
        self._comm, self._Gt, self._bounded = comm, Gt, bounded
        self._always = np.ones(Gt.shape[0], dtype=bool)
        self._always[bounded] = False
        self._contact = csr_array(Gt[bounded])
        self._base = replicated_gram(csr_array(Gt[self._always]), comm)
        self.whole = csr_array(self._base + replicated_gram(self._contact, comm))

    def of_rows(self, kept: Array) -> csr_array:
        """G_f G_fᵀ of the local rows flagged, shape ``(r, r)``."""
        contact = csr_array(self._contact[kept[self._bounded]])
        all_others = bool(np.all(kept[self._always]))
        return self._sum(contact, all_others, lambda: csr_array(self._Gt[kept]))

    def of_face(self, face: Face) -> csr_array:
        """GZ(GZ)ᵀ, shape ``(r, r)``."""
        contact = csr_array(face.Z[self._bounded].T @ self._contact)
        all_others = not np.any(face.constrained[self._always])
        return self._sum(contact, all_others, lambda: csr_array(face.Z.T @ self._Gt))

    def _sum(
        self, contact: csr_array, all_others: bool, rows: Callable[[], csr_array]
    ) -> csr_array:
        """With contact rows; with all of the rows anew where some other one is constrained."""
        if any_rank(self._comm, not all_others):
            return replicated_gram(rows(), self._comm)
        return csr_array(self._base + replicated_gram(contact, self._comm))


def replicated_gram(Gt: csr_array, comm: MPI.Intracomm) -> csr_array:
    """GGᵀ from all ranks' rows of Gᵀ, shape ``(r, r)``; on all ranks. Collective."""
    return replicated(csr_array(Gt.T @ Gt), comm)


def replicated(part: csr_array, comm: MPI.Intracomm) -> csr_array:
    """The sum of all ranks' sparse matrices, on all ranks. Collective."""
    local = part.tocoo()
    row, column = (np.concatenate(comm.allgather(index)) for index in local.coords)
    value = np.concatenate(comm.allgather(local.data))
    return coo_array((value, (row, column)), shape=part.shape).tocsr()
