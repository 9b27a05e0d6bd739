"""Orthogonal projectors of Gλ = e, r-vectors replicated: on all rows, or on a face."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.grams import Grams
from tfeti_dolfinx.dual.null_basis import NullBasis
from tfeti_dolfinx.dual.semidefinite import SemidefiniteFactor
from tfeti_dolfinx.parallel import agreed, summed
from tfeti_dolfinx.qp.coarse import NOTHING
from tfeti_dolfinx.qp.faces import Face


class Factor(Protocol):
    """A generalised inverse on r-vectors."""

    def solve(self, y: Array) -> Array:
        """A⁺ y."""
        ...

    def destroy(self) -> None:
        """Free it."""
        ...


class Projectors:
    """P and Q of the rows Gᵀ: what ``Coarse`` of ``qp/coarse.py`` promises, but for faces.

    Attributes:
        comm: Communicator; all methods but ``combine`` are collective.
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        e: Right side, shape ``(r,)``.
    """

    comm: MPI.Intracomm
    Gt: csr_array
    e: Array
    _factor: Factor

    def G(self, x: Array) -> Array:
        """G x, shape ``(r,)``, from this rank's part of x."""
        return summed(self.comm, self.Gt.T @ self.restricted(x))

    @property
    def dimension(self) -> int:
        """Number r of equations."""
        return self.Gt.shape[1]

    def residual(self, x: PETSc.Vec) -> Array:
        """e − Gx, shape ``(r,)``."""
        return np.asarray(self.e - self.G(x.array_r))

    def forces(self, x: PETSc.Vec) -> Array:
        """Σ|G||x| + |e|, shape ``(r,)``."""
        return self.terms(x) + np.abs(self.e)

    def terms(self, x: PETSc.Vec) -> Array:
        """Σ|G||x|, shape ``(r,)``."""
        Gt = self.Gt
        moduli = csr_array((np.abs(Gt.data), Gt.indices, Gt.indptr), shape=Gt.shape)
        return summed(self.comm, moduli.T @ np.abs(self.restricted(x.array_r)))

    def solve(self, y: Array) -> Array:
        """(GGᵀ)⁺ y for y in the range of G, orthogonal to the free motions."""
        return self._factor.solve(y)

    def restricted(self, x: Array) -> Array:
        """The part of x in the face: all of it."""
        return x

    def project(self, x: PETSc.Vec) -> None:
        """x ← P x."""
        self._take_away(x, self.coordinates(x))

    def project_against(
        self, x: PETSc.Vec, y: PETSc.Vec, more: Array = NOTHING
    ) -> tuple[float, float, Array]:
        """x ← P x; yᵀPx and yᵀy, y in the face; and more sums. One reduction.

        What rounding has left of y outside of the range of P is not taken for a part of yᵀPx.
        """
        own, r = self.restricted(x.array_r), self.dimension
        products = self.Gt.T @ np.stack((own, y.array_r), axis=1)
        scalars = (own @ y.array_r, y.array_r @ y.array_r)
        sums = summed(self.comm, np.concatenate((products.T.ravel(), scalars, more)))
        mu, rest = self.solve(sums[:r]), sums[2 * r :]
        self._take_away(x, mu)
        return float(rest[0] - sums[r : 2 * r] @ mu), float(rest[1]), rest[2:]

    def _take_away(self, x: PETSc.Vec, mu: Array) -> None:
        x.array[:] = self.restricted(x.array_r - self.Gt @ mu)

    def apply_Q(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = Gᵀ(GGᵀ)⁻¹G x."""
        self.combine(self.coordinates(x), y)

    def norm_Q(self, x: PETSc.Vec) -> float:
        """‖Q x‖; the same on all ranks, since loops end by it."""
        Gx = self.G(x.array_r)
        return agreed(self.comm, float(np.sqrt(max(float(Gx @ self.solve(Gx)), 0.0))))

    def particular(self, x: PETSc.Vec) -> None:
        """x = Gᵀ(GGᵀ)⁻¹e."""
        self.combine(self.solve(self.e), x)

    def coordinates(self, x: PETSc.Vec) -> Array:
        """(GGᵀ)⁻¹G x, shape ``(r,)``."""
        return self.solve(self.G(x.array_r))

    def combine(self, mu: Array, x: PETSc.Vec) -> None:
        """x = Gᵀ μ. Not collective."""
        x.array[:] = self.restricted(self.Gt @ mu)

    def destroy(self) -> None:
        """Free the factor."""
        self._factor.destroy()


class FaceFactors:
    """Factors of the Gram matrices of faces, counted.

    Args:
        comm: Communicator.
        null: What no row resists.
        prefix: Prefix of the factors' PETSc options.

    Attributes:
        count: How many factors there were so far: of the whole, and of faces.
    """

    def __init__(self, comm: MPI.Intracomm, null: NullBasis, prefix: str) -> None:
        self.comm, self._null, self._prefix = comm, null, prefix
        self.count: Counter[str] = Counter()

    def factor(self, gram: csr_array, kind: str = "face") -> SemidefiniteFactor:
        """A factor of a Gram matrix. Collective.

        Raises:
            FactorError: It could not be made.
        """
        self.count[kind] += 1
        what = f"GGᵀ of the {'coarse problem' if kind == 'whole' else 'rows of a face'}"
        return SemidefiniteFactor(gram, self._null, self.comm, what, self._prefix)


class Whole(Protocol):
    """What projectors of a face know of all rows."""

    comm: MPI.Intracomm
    Gt: csr_array
    e: Array
    grams: Grams

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """(G_f G_fᵀ + damping·GGᵀ)⁻¹y."""
        ...


class FaceProjectors(Projectors):
    """P and Q on a face of the rows: G_f = GZ, vectors in the layout of all rows.

    A face that leaves motions free that all rows hold has a G_f without full rank: harmless for
    P and Q, since what the factor makes of such a motion G_fᵀ does not see.

    Args:
        whole: Gᵀ of all rows, e, and the factors of other faces.
        face: The face.
        factors: Makes the factor. Collective.
    """

    def __init__(self, whole: Whole, face: Face, factors: FaceFactors) -> None:
        self.comm, self._whole, self._face = whole.comm, whole, face
        self.Gt, self.e = whole.Gt, whole.e
        self._factor = factors.factor(whole.grams.of_face(face))
        self._factors = factors

    def restricted(self, x: Array) -> Array:
        """ZZᵀ x."""
        return self._face.restricted(x)

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """As on all rows."""
        return self._whole.damped_solve(face, y, damping)

    def on_face(self, face: Face) -> FaceProjectors:
        """The projectors of another face of all rows."""
        return FaceProjectors(self._whole, face, self._factors)
