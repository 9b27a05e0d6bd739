"""The coarse problem of Gλ = e: projectors P and Q, on all rows or on a face."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import TINY, Array, LocalMatrix
from tfeti_dolfinx.common.parallel import bcast_from_root, summed
from tfeti_dolfinx.qp.sets import Face

# of the largest forces on an equation: those on a light one beside it count as so large at least,
# since the rounding of the largest reaches them
LIGHT = 1e-4

# what ``imbalance`` says where Gλ = e holds as well as factors can tell
HELD = 1e-9

NOTHING: Array = np.zeros(0)


class Coarse:
    """The constraint Gλ = e, λ in a face with the free directions Z.

    With G_f = GZ the projectors are Q = Z G_fᵀ(G_f G_fᵀ)⁺G_f Zᵀ and P = ZZᵀ − Q. Vectors are this
    rank's parts, in the layout of all rows. Without a face Z = I, so that P = I − Q. All methods
    but ``restricted``, ``solve``, ``combined`` and ``particular`` are collective. Without
    equations P = ZZᵀ, and nothing is communicated for it.

    Where rows follow others, λ = (I + C)u with u in the face, the constraint is G(I + C)u = e and
    P = Z(I − G_fᵀH⁺G(I + C)Z)Zᵀ with H = G(I + C)ZG_fᵀ in the place of G_fG_fᵀ. That is oblique,
    and not for ``project_against`` and ``norm_Q``; G(I + C)u = 0 for u = Px.

    Attributes:
        comm: Communicator.
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        e: Right side, replicated, shape ``(r,)``.
        solve: (G_fG_fᵀ)⁺y for a replicated y in the range of G, orthogonal to the free motions.
        dimension: Number r of equations.
        restricted: ZZᵀx, the part of x in the face.
        followed: (I + C)u.
        face: The face; None: all rows.
        on_face: Of all rows: the constraint on a face of them.
        damped_solve: Of all rows: (G_f G_fᵀ + damping·GGᵀ)⁻¹y of a face f, y and the damping.
    """

    on_face: Callable[[Face], Coarse]
    damped_solve: Callable[[Face, Array, float], Array]

    def __init__(
        self,
        comm: MPI.Intracomm,
        Gt: csr_array,
        e: Array,
        solve: Callable[[Array], Array],
        face: Face | None = None,
        followed: Callable[[Array], Array] = np.asarray,
    ) -> None:
        self.comm, self.Gt, self.e, self.solve, self.face = comm, Gt, e, solve, face
        self.dimension = int(Gt.shape[1])
        self.restricted: Callable[[Array], Array] = np.asarray if face is None else face.restricted
        self.followed = followed

    @cached_property
    def rows(self) -> LocalMatrix:
        """Gᵀ, for products."""
        return LocalMatrix(self.Gt)

    @cached_property
    def moduli(self) -> LocalMatrix:
        """The moduli of its entries."""
        entries = self.rows.entries()
        return LocalMatrix(entries._replace(data=np.abs(entries.data)))

    def G(self, x: Array) -> Array:
        """G of (I + C)ZZᵀx, replicated."""
        if not self.dimension:
            return NOTHING
        return summed(self.comm, self.rows.transposed(self.followed(self.restricted(x))))

    def residual(self, x: Array) -> Array:
        """e − G(I + C)ZZᵀx, replicated."""
        return np.asarray(self.e - self.G(x))

    def terms(self, x: Array) -> Array:
        """Σ|G||(I + C)ZZᵀx|, replicated."""
        if not self.dimension:
            return NOTHING
        own = np.abs(self.followed(self.restricted(x)))
        return summed(self.comm, self.moduli.transposed(own))

    def coordinates(self, x: Array) -> Array:
        """(G_fG_fᵀ)⁺G_fZᵀx, replicated."""
        return self.solve(self.G(x))

    def combined(self, mu: Array) -> Array:
        """ZZᵀGᵀμ."""
        return self.restricted(self.rows @ mu) if self.dimension else np.zeros(self.Gt.shape[0])

    def project(self, x: Array) -> Array:
        """P x."""
        return self.restricted(x - self.rows @ self.coordinates(x) if self.dimension else x)

    def project_against(
        self, x: Array, y: Array, more: Array = NOTHING
    ) -> tuple[Array, float, float, Array]:
        """P x, yᵀPx and yᵀy, y in the face, and sums over ranks of more. One reduction.

        What rounding has left of y outside of the range of P is not taken for a part of yᵀPx, which
        ranks may round differently.
        """
        own, r = self.restricted(x), self.dimension
        if not r:
            rest = summed(self.comm, np.concatenate(((own @ y, y @ y), more)))
            return own, float(rest[0]), float(rest[1]), rest[2:]
        products = self.rows.transposed(own), self.rows.transposed(y), (own @ y, y @ y)
        sums = summed(self.comm, np.concatenate((*products, more)))
        mu, rest = self.solve(sums[:r]), sums[2 * r :]
        Px = self.restricted(x - self.rows @ mu)
        return Px, float(rest[0] - sums[r : 2 * r] @ mu), float(rest[1]), rest[2:]

    def Q(self, x: Array) -> Array:
        """Q x."""
        return self.combined(self.coordinates(x))

    def norm_Q(self, x: Array) -> float:
        """‖Q x‖; the same on all ranks, since loops end by it."""
        if not self.dimension:
            return 0.0
        Gx = self.G(x)
        return bcast_from_root(self.comm, float(np.sqrt(max(float(Gx @ self.solve(Gx)), 0.0))))

    def particular(self) -> Array:
        """Z G_fᵀ(G_fG_fᵀ)⁺e, the smallest solution of Gλ = e in the face, if it has one."""
        return self.combined(self.solve(self.e))


def imbalance(coarse: Coarse, x: Array) -> float:
    """Return the largest entry of Gx − e over the size of its terms, at most 1. Collective."""
    if not coarse.dimension:
        return 0.0
    forces = coarse.terms(x) + np.abs(coarse.e)
    floor = max(LIGHT * float(forces.max(initial=0.0)), TINY)
    own = np.max(np.abs(coarse.residual(x)) / np.maximum(forces, floor), initial=0.0)
    return bcast_from_root(coarse.comm, float(own))
