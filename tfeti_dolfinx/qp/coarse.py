"""The coarse problem of Gλ = e: projectors P and Q, on all rows or on a face."""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csc_array, csr_array

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import bcast_from_root, summed
from tfeti_dolfinx.qp.sets import Face

# of the largest forces on an equation: those on a light one beside it count as so large at least,
# since the rounding of the largest reaches them
LIGHT = 1e-4

# what ``imbalance`` says where Gλ = e holds as well as factors can tell
HELD = 1e-9

NOTHING: Array = np.zeros(0)


class GramFactor(Protocol):
    """A generalised inverse of G_fG_fᵀ."""

    def solve(self, y: Array) -> Array:
        """(G_fG_fᵀ)⁺y, y replicated."""
        ...

    def destroy(self) -> None:
        """Free it."""
        ...


class Coarse:
    """The constraint Gλ = e, λ in a face with the free directions Z.

    With G_f = GZ the projectors are Q = Z G_fᵀ(G_f G_fᵀ)⁺G_f Zᵀ and P = ZZᵀ − Q. Vectors keep the
    layout of all rows. Without a face Z = I, so that P = I − Q. All methods but ``solve`` and
    ``combine`` are collective. Without equations P = ZZᵀ, and nothing is communicated for it.

    Attributes:
        comm: Communicator.
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        e: Right side, replicated, shape ``(r,)``.
        factor: That of G_fG_fᵀ.
    """

    comm: MPI.Intracomm
    Gt: csr_array
    e: Array
    factor: GramFactor

    def restricted(self, x: Array) -> Array:
        """ZZᵀx, the part of x in the face: all of it."""
        return x

    def on_face(self, face: Face) -> Coarse:
        """Return the same constraint on (another) face of all rows."""
        raise NotImplementedError

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """(G_f G_fᵀ + damping·GGᵀ)⁻¹y, f a face of all rows."""
        raise NotImplementedError

    @cached_property
    def dimension(self) -> int:
        """Number r of equations."""
        return int(self.Gt.shape[1])

    @cached_property
    def own(self) -> csc_array:
        """This rank's columns of G, shape ``(r, m_local)``."""
        return self.Gt.T

    @cached_property
    def moduli(self) -> csc_array:
        """The moduli of their entries."""
        return abs(self.own)

    def G(self, x: Array) -> Array:
        """G_fZᵀx, replicated, from this rank's part of x."""
        return summed(self.comm, self.own @ self.restricted(x)) if self.dimension else NOTHING

    def terms(self, x: Array) -> Array:
        """Σ|G_fZᵀ||x|, replicated, from this rank's part of x."""
        if not self.dimension:
            return NOTHING
        return summed(self.comm, self.moduli @ np.abs(self.restricted(x)))

    def residual(self, x: PETSc.Vec) -> Array:
        """e − G_fZᵀx, replicated."""
        return np.asarray(self.e - self.G(x.array_r))

    def forces(self, x: PETSc.Vec) -> Array:
        """Return the sum of the moduli of the terms of each entry of the residual."""
        return self.terms(x.array_r) + np.abs(self.e)

    def solve(self, y: Array) -> Array:
        """(G_fG_fᵀ)⁺y for y in the range of G, orthogonal to the free motions."""
        return self.factor.solve(y)

    def coordinates(self, x: PETSc.Vec) -> Array:
        """(G_fG_fᵀ)⁺G_fZᵀx, replicated."""
        return self.solve(self.G(x.array_r))

    def combine(self, mu: Array, x: PETSc.Vec) -> None:
        """x = ZZᵀGᵀμ."""
        x.array[:] = self.restricted(self.Gt @ mu) if self.dimension else 0.0

    def project(self, x: PETSc.Vec) -> None:
        """x ← P x."""
        away = self.Gt @ self.coordinates(x) if self.dimension else 0.0
        x.array[:] = self.restricted(x.array_r - away)

    def project_against(
        self, x: PETSc.Vec, y: PETSc.Vec, more: Array = NOTHING
    ) -> tuple[float, float, Array]:
        """x ← P x; yᵀPx and yᵀy, y in the face, and sums over ranks of more. One reduction.

        What rounding has left of y outside of the range of P is not taken for a part of yᵀPx, which
        ranks may round differently.
        """
        own, r = self.restricted(x.array_r), self.dimension
        scalars = (own @ y.array_r, y.array_r @ y.array_r)
        if not r:
            rest = summed(self.comm, np.concatenate((scalars, more)))
            x.array[:] = own
            return float(rest[0]), float(rest[1]), rest[2:]
        products = self.own @ np.stack((own, y.array_r), axis=1)
        sums = summed(self.comm, np.concatenate((products.T.ravel(), scalars, more)))
        mu, rest = self.solve(sums[:r]), sums[2 * r :]
        x.array[:] = self.restricted(x.array_r - self.Gt @ mu)
        return float(rest[0] - sums[r : 2 * r] @ mu), float(rest[1]), rest[2:]

    def apply_Q(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = Q x."""
        self.combine(self.coordinates(x), y)

    def norm_Q(self, x: PETSc.Vec) -> float:
        """‖Q x‖; the same on all ranks, since loops end by it."""
        if not self.dimension:
            return 0.0
        Gx = self.G(x.array_r)
        return bcast_from_root(self.comm, float(np.sqrt(max(float(Gx @ self.solve(Gx)), 0.0))))

    def particular(self, x: PETSc.Vec) -> None:
        """x = Z G_fᵀ(G_fG_fᵀ)⁺e, the smallest Gλ = e of the face, if it has one."""
        self.combine(self.solve(self.e), x)

    def destroy(self) -> None:
        """Free the factor."""
        self.factor.destroy()


def imbalance(coarse: Coarse, x: PETSc.Vec) -> float:
    """Return the largest entry of Gx − e over the size of its terms, at most 1. Collective."""
    if not coarse.dimension:
        return 0.0
    forces = coarse.forces(x)
    floor = max(LIGHT * float(forces.max(initial=0.0)), TINY)
    own = np.max(np.abs(coarse.residual(x)) / np.maximum(forces, floor), initial=0.0)
    return bcast_from_root(x.getComm().tompi4py(), float(own))


class DenseCoarse(Coarse):
    """A constraint from a dense G, for a program on one rank.

    Args:
        G: Shape ``(r, m)``.
        e: Shape ``(r,)``.
        face: The face; default all rows.
    """

    def __init__(self, G: Array, e: Array, face: Face | None = None) -> None:
        self.comm, self.Gt, self.e, self._face = MPI.COMM_SELF, csr_array(G.T), e, face
        Gt = self.restricted(G.T)
        self.factor = DenseFactor(Gt.T @ Gt)

    def restricted(self, x: Array) -> Array:
        """ZZᵀx."""
        return x if self._face is None else self._face.restricted(x)

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """(G_f G_fᵀ + damping·GGᵀ)⁺y."""
        G_f = face.restricted(Gt := self.Gt.toarray())
        return DenseFactor(Gt.T @ G_f + damping * Gt.T @ Gt).solve(y)

    def on_face(self, face: Face) -> DenseCoarse:
        """Return the same G on a face."""
        return DenseCoarse(self.Gt.T.toarray(), self.e, face)


class DenseFactor:
    """A⁺ of a dense positive semidefinite A."""

    def __init__(self, A: Array) -> None:
        self._inverse = np.linalg.pinv(A, hermitian=True)

    def solve(self, y: Array) -> Array:
        """A⁺y."""
        return np.asarray(self._inverse @ y)

    def destroy(self) -> None:
        """Nothing to free."""


class Oblique(Protocol):
    """Projectors of a face Z on whose vectors u others depend: λ = (I + C)u.

    With G_f = GZ and H = G(I + C)ZG_fᵀ: P = Z(I − Z G_fᵀH⁺G(I + C)Z)Zᵀ. Vectors are this rank's
    parts, in the layout of all rows.
    """

    def coordinates(self, x: Array) -> Array:
        """H⁺G(I + C)ZZᵀx, replicated, shape ``(r,)``. Collective."""
        ...

    def project(self, x: Array) -> Array:
        """P x, shapes ``(m,)`` or ``(m, q)``. Collective."""
        ...

    def restoring(self, y: Array) -> Array:
        """Return u = ZG_fᵀH⁺y, which solves G(I + C)u = y if that is solvable. Not collective."""
        ...
