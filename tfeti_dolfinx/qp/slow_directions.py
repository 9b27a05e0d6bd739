"""Directions that conjugate gradients were slow in on one face: a coarse space for the next."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed, any_rank, summed
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

    Attributes:
        count: Their number.
    """

    def __init__(self) -> None:
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
        if self._wrong or any_rank(kept.comm, bool(np.any(face.status >= Status.STICK))):
            return 0
        largest, parts = agreed(kept.comm, kept.ritz_vectors(HIGH, LOOSE))
        if largest > WRONG:
            self._wrong = True
            self._V, self._FV = (np.zeros((0, 0)) for _ in range(2))
        if self._wrong or len(parts) == 0:
            return 0
        V, FV = kept.combined(parts)
        if self.count == 0:
            self._V, self._FV = np.zeros((0, V.shape[1])), np.zeros((0, V.shape[1]))
        for _ in range(2):
            a = summed(kept.comm, V @ self._FV.T)
            V, FV = V - a @ self._V, FV - a @ self._FV
        energies, Q = np.linalg.eigh(summed(kept.comm, V @ FV.T))
        new = energies > NEW
        Q = agreed(kept.comm, Q[:, new] / np.sqrt(energies[new]))
        self._V = np.concatenate((self._V, Q.T @ V))[-MOST:]
        self._FV = np.concatenate((self._FV, Q.T @ FV))[-MOST:]
        return int(Q.shape[1])

    def beside(self, on_face: FaceOperator, face: Face) -> FaceOperator:
        """M_f with V as a coarse space; M_f itself where nothing was slow.

        Args:
            on_face: M_f, which is taken over.
            face: The face.
        """
        return _Beside(on_face, face, self._V, self._FV) if self.count else on_face


class _Beside:
    """(I − V(FV)ᵀ) M_f (I − FV Vᵀ) + V Vᵀ, V and FV as far as they lie in a face.

    Mandel, Comm. Numer. Methods Engrg. 9 (1993) 233–241. Positive definite whatever V and FV are,
    and for FV = F V the inverse of F on V.
    """

    def __init__(self, on_face: FaceOperator, face: Face, V: Array, FV: Array) -> None:
        self._on_face, self._face, self._V, self._FV = on_face, face, V, FV

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x, x in the face. Collective; two reductions besides those of M_f."""
        comm, rest = x.getComm().tompi4py(), x.copy()
        on = summed(comm, self._V @ x.array_r)
        rest.array[:] -= self._face.restricted(on @ self._FV)
        self._on_face.mult(rest, y)
        rest.destroy()
        of = summed(comm, self._FV @ y.array_r)
        y.array[:] += self._face.restricted((on - of) @ self._V)

    def dependent(self, x: Array) -> Array | None:
        """As M_f says."""
        return self._on_face.dependent(x)

    def destroy(self) -> None:
        """Free M_f. Collective."""
        self._on_face.destroy()
