"""GGᵀ, its factors and projectors, on faces too."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array, csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import splu

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, summed
from tfeti_dolfinx.errors import FactorError, raised_on_all_ranks
from tfeti_dolfinx.feti.rigid_bodies import NullBasis
from tfeti_dolfinx.qp.coarse import NOTHING
from tfeti_dolfinx.qp.sets import Face
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError

# --- Gram matrices GGᵀ ------------------------------------------------------------------------


class Grams:
    """GGᵀ, and G_f G_fᵀ of faces f; the part of gluing and Dirichlet rows is made once.

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
    """Return the sum of all ranks' sparse matrices, on all ranks. Collective."""
    local = part.tocoo()
    row, column = (np.concatenate(comm.allgather(index)) for index in local.coords)
    value = np.concatenate(comm.allgather(local.data))
    return coo_array((value, (row, column)), shape=part.shape).tocsr()


# --- Factors of the coarse problem ------------------------------------------------------------

# Added to a unit diagonal, where pivots are lost to rounding; so small a shift is made good by
# refinement in all directions that stand out from rounding.
SHIFTS = (0.0, 1e-14, 1e-13, 1e-12)
# each divides the error in a direction of eigenvalue σ by σ / shift: three do for σ from 1e-8 on
REFINEMENTS = 3


class SemidefiniteFactor:
    """A⁺ of a sparse positive semidefinite A with a known null space, on each rank.

    S A S + E Eᵀ with a unit diagonal of S A S, E unit vectors of entries that determine the null
    modes: an exact generalised inverse for right sides orthogonal to them.

    Args:
        A: scipy CSR, shape ``(r, r)``, the same on all ranks.
        null: Its null space.
        comm: Communicator. The constructor is collective.
        what: Name of A for messages.
        prefix: Prefix of the factor's PETSc options.

    Attributes:
        comm: Communicator.

    Raises:
        FactorError: The factor could not be made.
    """

    def __init__(
        self,
        A: csr_array,
        null: NullBasis,
        comm: MPI.Intracomm,
        what: str,
        prefix: str = "tfeti_coarse_",
    ) -> None:
        self.comm, self._null, diagonal = comm, null, A.diagonal()
        pinned = np.where(diagonal > 0.0, 0.0, 1.0)  # what nothing holds at all stands for itself
        self._scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
        pinned[null.pins(self._scale)] = 1.0
        scaled = csr_array(A, copy=True)  # quicker than products of sparse matrices
        scaled.data *= np.repeat(self._scale, np.diff(A.indptr))
        scaled.data *= self._scale[A.indices]
        self._A = csr_array(scaled + diags_array(pinned)) if np.any(pinned) else scaled
        self._factor: CholeskyFactor | None = None
        for self._shift in SHIFTS if A.shape[0] else ():
            if self._factored(comm, what, prefix):
                return

    def _factored(self, comm: MPI.Intracomm, what: str, prefix: str) -> bool:
        """Factor A with the present shift; return whether that succeeded everywhere. Collective."""
        lost: NotPositiveDefiniteError | None = None
        with raised_on_all_ranks(comm):
            try:
                shift = self._shift * eye_array(self._A.shape[0])
                self._factor = CholeskyFactor(self._A + shift if self._shift else self._A, prefix)
            except NotPositiveDefiniteError as error:
                lost = error
                if self._shift == SHIFTS[-1]:
                    raise type(error)(f"{what}: {error}") from error
            except FactorError as error:
                raise FactorError(f"{what}: {error}") from error
        if not comm.allreduce(lost is not None, op=MPI.LOR):
            return True
        self.destroy()
        return False

    def solve(self, y: Array) -> Array:
        """A⁺ y up to null modes that are removed, y orthogonal to them."""
        if self._factor is None:
            return y
        b = self._scale * self._null.removed(y)
        x = self._factor.solve(b)
        for _ in range(REFINEMENTS if self._shift else 0):
            x += self._factor.solve(b - self._A @ x)
        return self._null.removed(self._scale * x)

    def destroy(self) -> None:
        """Free the factor."""
        if self._factor is not None:
            self._factor.destroy()
            self._factor = None


# --- Oblique projectors -----------------------------------------------------------------------


class ObliqueProjectors:
    """P = Z(I − G_fᵀH⁺G(I + C)Z)Zᵀ with H = G(I + C)ZG_fᵀ, of a face and C.

    λ = (I + C)u moves with u in the face: G(I + C)u = 0 for u = Pv, and P makes nothing of what
    G_fᵀ gives. With C = 0 it is the orthogonal projector of the face.

    Args:
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        grams: G_f G_fᵀ of faces.
        face: The face.
        C: What follows what, on this rank, scipy CSR, shape ``(m_local, m_local)``.
        null: null(Gᵀ).
        comm: Communicator. The constructor is collective.

    Raises:
        FactorError: H is singular.
    """

    def __init__(
        self,
        Gt: csr_array,
        grams: Grams,
        face: Face,
        C: csr_array,
        null: NullBasis,
        comm: MPI.Intracomm,
    ) -> None:
        self._comm, self._face, self._Gt = comm, face, Gt
        self._following = csr_array(C.T @ Gt)
        part = csr_array((face.Z.T @ self._following).T @ (face.Z.T @ Gt))
        self._factor = GeneralFactor(grams.of_face(face), replicated(part, comm), null, comm)

    def coordinates(self, x: Array) -> Array:
        """H⁺G(I + C)ZZᵀx, replicated, shape ``(r,)`` or ``(r, q)``. Collective."""
        own = self._face.restricted(x)
        return self._factor.solve(summed(self._comm, self._Gt.T @ own + self._following.T @ own))

    def combine(self, mu: Array) -> Array:
        """ZZᵀGᵀμ, this rank's part. Not collective."""
        return self._face.restricted(self._Gt @ mu)

    def project(self, x: Array) -> Array:
        """P x, shapes ``(m_local,)`` or ``(m_local, q)``. Collective."""
        return self._face.restricted(x) - self.combine(self.coordinates(x))

    def restoring(self, y: Array) -> Array:
        """Return u = ZG_fᵀH⁺y, which solves G(I + C)u = y if that is solvable. Not collective."""
        return self.combine(self._factor.solve(y))


class GeneralFactor:
    """(A + N)⁺ of a sparse positive semidefinite A, with a null space that N keeps, on each rank.

    Scaled to a unit diagonal of A, with unit vectors added as in ``SemidefiniteFactor``.

    Args:
        A: scipy CSR, shape ``(r, r)``, the same on all ranks.
        N: The same.
        null: The null space of both, and of their transposes.
        comm: Communicator. The constructor is collective.

    Raises:
        FactorError: The sum is singular besides.
    """

    def __init__(self, A: csr_array, N: csr_array, null: NullBasis, comm: MPI.Intracomm) -> None:
        self._null, diagonal = null, A.diagonal()
        pinned = np.where(diagonal > 0.0, 0.0, 1.0)
        self._scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
        pinned[null.pins(self._scale)] = 1.0
        S = diags_array(self._scale)
        with raised_on_all_ranks(comm):
            try:
                self._factor = splu(csc_array(S @ (A + N) @ S + diags_array(pinned)))
            except RuntimeError as error:
                raise FactorError(f"the coarse problem of a face with friction: {error}") from error

    def solve(self, y: Array) -> Array:
        """The solution without null modes, for y orthogonal to them; ``(r,)`` or ``(r, q)``."""
        x = self._factor.solve((self._scale * self._null.removed(y).T).T)
        return self._null.removed((self._scale * x.T).T)


# --- Orthogonal projectors, on all rows or on a face ------------------------------------------


class CoarseFactor(Protocol):
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
    _factor: CoarseFactor

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
        return self.terms(x.array_r) + np.abs(self.e)

    def terms(self, x: Array) -> Array:
        """Σ|G||x|, shape ``(r,)``."""
        return summed(self.comm, abs(self.Gt).T @ np.abs(self.restricted(x)))

    def solve(self, y: Array) -> Array:
        """(GGᵀ)⁺ y for y in the range of G, orthogonal to the free motions."""
        return self._factor.solve(y)

    def restricted(self, x: Array) -> Array:
        """Return the part of x in the face: all of it."""
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
        return bcast_from_root(self.comm, float(np.sqrt(max(float(Gx @ self.solve(Gx)), 0.0))))

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
        """Return a factor of a Gram matrix. Collective.

        Raises:
            FactorError: It could not be made.
        """
        self.count[kind] += 1
        what = f"GGᵀ of the {'coarse problem' if kind == 'whole' else 'rows of a face'}"
        return SemidefiniteFactor(gram, self._null, self.comm, what, self._prefix)


class AllRows(Protocol):
    """Data of all rows that projectors of a face need."""

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

    def __init__(self, whole: AllRows, face: Face, factors: FaceFactors) -> None:
        self.comm, self._whole, self._face = whole.comm, whole, face
        self.Gt, self.e = whole.Gt, whole.e
        self._factor = factors.factor(whole.grams.of_face(face))
        self._factors = factors

    def restricted(self, x: Array) -> Array:
        """ZZᵀ x."""
        return self._face.restricted(x)

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """Solve with the damped coarse matrix of all rows."""
        return self._whole.damped_solve(face, y, damping)

    def on_face(self, face: Face) -> FaceProjectors:
        """Return the projectors of another face of all rows."""
        return FaceProjectors(self._whole, face, self._factors)
