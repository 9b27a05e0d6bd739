"""Directions that conjugate gradients were slow in on one face: a coarse space for the next."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed, any_rank, summed
from tfeti_dolfinx.qp.balanced import Balanced
from tfeti_dolfinx.qp.directions import Conjugates
from tfeti_dolfinx.qp.faces import Face, Status
from tfeti_dolfinx.qp.problem import FaceOperator

# eigenvalues of M_f F from which on a direction is slow; they begin at 1
HIGH = 5.0
# an eigenvalue from which on M_f is bad altogether, as with cells 1000 : 1: such are many
WRONG = 300.0
# of an eigenvalue: how far it may be from one of M_f F on the whole face
LOOSE = 0.6
# directions at most
MOST = 40
# energy, of HIGH at least, that a direction has beside those known; with less it is one of them
NEW = 0.1


class SlowDirections:
    """F-orthonormal directions V, and FV, of the faces left.

    They are Ritz vectors of M_f F in what conjugate gradients have searched there (Gosselet, Rey,
    Pebrel, Internat. J. Numer. Methods Engrg. 94, 2013, 60–83), and cost no multiplication. Where
    another face holds some of their rows V is only near to what it was, but what is made of it
    remains a preconditioner.

    Args:
        comm: Communicator.

    Attributes:
        count: Their number.
    """

    def __init__(self, comm: MPI.Intracomm) -> None:
        self._comm = comm
        self._V, self._FV = (np.zeros((0, 0)) for _ in range(2))
        self._wrong = False

    @property
    def count(self) -> int:
        """Number of directions."""
        return len(self._V)

    def learn(self, kept: Conjugates, face: Face) -> int:
        """Take what was slow among the directions of a face. Collective.

        Where there are too many the oldest go. Nothing is learnt where points stick or slip: from
        one face to the next too much of that changes. Where M_f turns out to be bad altogether
        all of them go, and none come any more: they are few of many then, and help none.

        Returns:
            How many have come.
        """
        if self._wrong or any_rank(self._comm, bool(np.any(face.status >= Status.STICK))):
            return 0
        largest, parts = agreed(self._comm, kept.ritz_vectors(HIGH, LOOSE))
        if largest > WRONG:
            self._wrong = True
            self._V, self._FV = (np.zeros((0, 0)) for _ in range(2))
        if self._wrong or len(parts) == 0:
            return 0
        V, FV = kept.combined(parts)
        if self.count == 0:
            self._V, self._FV = np.zeros((0, V.shape[1])), np.zeros((0, V.shape[1]))
        for _ in range(2):
            a = summed(self._comm, V @ self._FV.T)
            V, FV = V - a @ self._V, FV - a @ self._FV
        energies, Q = np.linalg.eigh(summed(self._comm, V @ FV.T))
        new = energies > NEW
        Q = agreed(self._comm, Q[:, new] / np.sqrt(energies[new]))
        self._V = np.concatenate((self._V, Q.T @ V))[-MOST:]
        self._FV = np.concatenate((self._FV, Q.T @ FV))[-MOST:]
        return int(Q.shape[1])

    def beside(self, on_face: FaceOperator, face: Face) -> FaceOperator:
        """M_f with V as a coarse space; M_f itself where nothing was slow.

        Args:
            on_face: M_f, which is taken over.
            face: The face.
        """
        if self.count == 0:
            return on_face
        return Balanced(on_face, _Slow(self._comm, face, self._V, self._FV))


class _Slow:
    """C = V, Y = (FV)ᵀ, D = I, V and FV as far as they lie in a face.

    Args:
        comm: Communicator.
        face: The face.
        V: Directions, shape ``(k, m)``, m on this rank.
        FV: Their images.
    """

    def __init__(self, comm: MPI.Intracomm, face: Face, V: Array, FV: Array) -> None:
        self._comm, self._face, self._V, self._FV = comm, face, V, FV
        self.energy = np.ones(len(V))

    def coordinates(self, x: Array) -> Array:
        """V x."""
        return summed(self._comm, self._V @ x)

    def forces(self, c: Array) -> Array:
        """(FV)ᵀ c."""
        return self._face.restricted(c @ self._FV)

    def moved(self, y: Array) -> Array:
        """FV y."""
        return summed(self._comm, self._FV @ y)

    def directions(self, c: Array) -> Array:
        """Vᵀ c."""
        return self._face.restricted(c @ self._V)

    def destroy(self) -> None:
        """Nothing of PETSc is kept."""
