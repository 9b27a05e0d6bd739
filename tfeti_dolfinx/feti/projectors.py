"""GGᵀ, its factors and projectors, on faces too."""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.linalg.lapack import dpotrf, dpotrs
from scipy.sparse import coo_array, csc_array, csr_array, eye_array
from scipy.sparse.linalg import splu

from tfeti_dolfinx.common.arrays import TINY, Array, Entries, LocalMatrix, plus, rows_of, transposed
from tfeti_dolfinx.common.parallel import any_rank, joined_over, summed
from tfeti_dolfinx.errors import FactorError, raised_on_all_ranks
from tfeti_dolfinx.feti.rigid_bodies import independent, parts_of_columns
from tfeti_dolfinx.qp.friction_newton import Following
from tfeti_dolfinx.qp.sets import Face, Status
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError

# --- Gram matrices GGᵀ ------------------------------------------------------------------------

# of the diagonal of GGᵀ, a square: a face with less of it holds that motion by rounding alone
UNHELD = 1e-28


class Grams:
    """GGᵀ, and GZ(GZ)ᵀ of faces; the part of gluing and Dirichlet rows is made once.

    An entry is stored for each pair of coordinates that meet in a row, so that storage grows with
    the number of subdomains. A face costs what its contact rows cost, ``bounded``, which some set
    may constrain: rows of the same coordinates make a dense block, and the sum of these is reduced
    over ranks as far as contact rows reach. Collective. ``Gt`` is this rank's Gᵀ, and
    ``whole`` GGᵀ, shape ``(r, r)``.
    """

    def __init__(self, Gt: csr_array, bounded: Array, comm: MPI.Intracomm) -> None:
        self.comm, self.Gt, size = comm, Gt, Gt.shape[1]
        self._always = np.ones(Gt.shape[0], dtype=bool)
        self._always[bounded] = False
        always = rows_of(Gt, np.flatnonzero(self._always))
        base = replicated(transposed(always).csr() @ always.csr(), comm)
        # 1. the entries that contact rows reach, on all ranks, and those of the whole
        parts = list(_blocks(Gt, bounded))
        own = np.unique(np.concatenate([np.empty(0, np.int64), *(pairs for *_, pairs in parts)]))
        reached = np.unique(joined_over(comm, own))
        base.sort_indices()
        whole = plus(base, *np.divmod(reached, max(size, 1)), np.zeros(len(reached)))
        # 2. where they stand
        self._base, self._like = whole.data, whole.csr()
        row = np.repeat(np.arange(size), np.diff(whole.indptr))
        self._reached = np.searchsorted(row * size + whole.indices, reached)
        self._blocks = [(rows, G, np.searchsorted(reached, pairs)) for rows, G, pairs in parts]
        everything, self._unheld = np.ones(Gt.shape[0], dtype=bool), np.zeros(size)
        self.whole = self.of_face(Face(everything, np.full(len(everything), Status.FREE)))
        self._unheld = UNHELD * self.whole.diagonal()

    def of_face(self, face: Face, damping: float = 0.0) -> csr_array:
        """GZ(GZ)ᵀ + damping·GGᵀ, shape ``(r, r)``, 0 for motions held by rounding alone.

        Of all rows anew where a set constrains others than ``bounded``.
        """
        size = self.Gt.shape[1]
        if not size:
            return csr_array((0, 0))
        sums: Array = np.zeros(len(self._reached) + 2)
        for rows, G, places in self._blocks:
            G_f = G[face.free[rows]]
            sums[places] += (G_f.T @ G_f).ravel()
        sums[-2:] = np.any(face.status[self._always] != Status.FREE), len(face.tangents)
        sums = summed(self.comm, sums)
        others, tangents = sums[-2:]
        if others:
            along = face.Z.T @ self.Gt
            gram = replicated(along.T.tocsr() @ along, self.comm)
            return gram + damping * self.whole if damping else gram
        data = np.array(self._base)
        data[self._reached] += sums[:-2]
        if damping:
            data += damping * self.whole.data
        gram = copy(self._like)  # with the same pattern, which is not looked at again
        gram.data = data
        if tangents:
            count, width = face.tangents.shape
            each = rows_of(self.Gt, face.tangent_rows.ravel(), face.tangents.ravel())
            # the rows of a tangent as one: of what cancels in it squares keep no rounding
            along = each._replace(indptr=each.indptr[::width], shape=(count, size)).csr()
            along.sum_duplicates()
            gram = gram + replicated((along.T @ along).tocsr(), self.comm)
        held = gram.diagonal() > self._unheld
        if not np.all(held):
            both = np.repeat(held, np.diff(gram.indptr)) & held[gram.indices]
            gram.data = np.where(both, gram.data, 0.0)
        return gram


def _blocks(Gt: csr_array, some: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Rows with the same coordinates, their entries, dense, and numbers of pairs of coordinates."""
    own = rows_of(Gt, some)
    stored = own.data != 0.0
    row = np.repeat(np.arange(len(some)), np.diff(own.indptr))[stored]
    indices, data = own.indices[stored].astype(np.int64), own.data[stored]
    counts = np.bincount(row, minlength=len(some))
    begins = np.cumsum(counts) - counts
    for count in np.unique(counts[counts > 0]):
        at = np.flatnonzero(counts == count)
        places = begins[at][:, None] + np.arange(count)
        columns, order = indices[places], np.lexsort(indices[places].T)
        others = np.diff(columns[order], axis=0).any(axis=1)
        for rows in np.split(order, np.flatnonzero(others) + 1):
            pairs = (columns[rows[0], :, None] * Gt.shape[1] + columns[rows[0]]).ravel()
            yield some[at[rows]], data[places[rows]], pairs


def replicated(part: csr_array, comm: MPI.Intracomm) -> csr_array:
    """Return the sum of all ranks' sparse matrices, scipy CSR, on all ranks. Collective."""
    if comm.size == 1:
        return part
    own = np.repeat(np.arange(part.shape[0]), np.diff(part.indptr)), part.indices
    row, column = (joined_over(comm, index.astype(np.int64)) for index in own)
    return coo_array((joined_over(comm, part.data), (row, column)), shape=part.shape).tocsr()


# --- Factors of the coarse problem ------------------------------------------------------------

# Added to a unit diagonal, where pivots are lost to rounding, as on faces that leave a body free
SHIFTS = (0.0, 1e-14, 1e-13, 1e-12)
DENSE = 100  # rows of a matrix whose factor is dense


class NullModes:
    """Orthonormal columns that a semidefinite matrix makes nothing of, shape ``(r, k)``.

    ``removed`` is x less its part in the null space, shape ``(r,)`` or ``(r, q)``.
    """

    def __init__(self, columns: csr_array) -> None:
        self._parts = [(rows, dense) for _, rows, dense in parts_of_columns(columns)]
        self.removed: Callable[[Array], Array] = np.asarray
        if self._parts:
            C = LocalMatrix(columns)
            self.removed = lambda x: np.asarray(x - C @ C.transposed(x))

    def pinned(self, scale: Array) -> Array:
        """1 at entries that determine the modes, scaled by 1/``scale``; 0 at others."""
        pinned = np.zeros(len(scale))
        for rows, dense in self._parts:
            modes = dense / scale[rows, None]
            size = np.maximum(np.linalg.norm(modes, axis=0), TINY)
            pinned[rows[independent(modes / size)]] = 1.0
        return pinned


class DenseFactor:
    """A = L Lᵀ of a matrix of few rows, where a call of a sparse factor takes longer than its work.

    Creation raises a NotPositiveDefiniteError where A is not positive definite.
    """

    def __init__(self, A: Entries | csr_array) -> None:
        dense = np.zeros(A.shape)
        dense[np.repeat(np.arange(len(dense)), np.diff(A.indptr)), A.indices] = A.data
        self._L, failed = dpotrf(dense, lower=True)
        if failed or not np.isfinite(self._L).all():
            raise NotPositiveDefiniteError("not positive definite (found by LAPACK)")
        self.entries = float(self._L.size)

    def solve(self, b: Array) -> Array:
        """A⁻¹ b, shapes ``(n,)`` or ``(n, q)``."""
        return np.asarray(dpotrs(self._L, b, lower=True)[0])


class SemidefiniteFactor:
    """A⁺ of a sparse positive semidefinite A, the same on all ranks, on each of them. Collective.

    S A S + E Eᵀ with a unit diagonal of S A S, E unit vectors of entries that determine the null
    modes ``null``: an exact generalised inverse for right sides orthogonal to them. Where a pivot
    is lost a small shift takes its place, made good by three steps of refinement: each divides the
    error in a direction of eigenvalue σ by σ / shift. Creation raises a FactorError where the
    factor could not be made.
    """

    def __init__(
        self,
        A: csr_array,
        null: NullModes,
        comm: MPI.Intracomm,
        what: str,
        prefix: str = "tfeti_coarse_",
    ) -> None:
        self._null, (self._scale, pinned) = null, _scaling(A, null)
        few = A.shape[0] <= DENSE and not PETSc.Options(prefix).getAll()
        scaled = _scaled(A, self._scale, pinned)
        self._factor: CholeskyFactor | DenseFactor | None = None
        self._shift = 0.0
        for self._shift in SHIFTS if A.shape[0] else ():
            lost = False
            with raised_on_all_ranks(comm):
                try:
                    shifted: Entries | csr_array = scaled
                    if self._shift:  # only refinement needs the matrix
                        self._A = scaled.csr()
                        shifted = csr_array(self._A + self._shift * eye_array(A.shape[0]))
                    self._factor = DenseFactor(shifted) if few else CholeskyFactor(shifted, prefix)
                except FactorError as error:
                    lost = isinstance(error, NotPositiveDefiniteError)
                    if not lost or self._shift == SHIFTS[-1]:
                        raise type(error)(f"{what}: {error}") from error
            if not any_rank(comm, lost):
                break
            self._factor = None

    def solve(self, y: Array) -> Array:
        """A⁺ y up to null modes that are removed, y orthogonal to them."""
        if self._factor is None:
            return y
        b = self._scale * self._null.removed(y)
        x = self._factor.solve(b)
        for _ in range(3 if self._shift else 0):
            x += self._factor.solve(b - self._A @ x)
        return self._null.removed(self._scale * x)


def _scaling(A: csr_array, null: NullModes) -> tuple[Array, Array]:
    """S of a unit diagonal of SAS; flags of entries that determine the null modes, or are 0."""
    diagonal = A.diagonal()
    scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
    # what nothing holds at all stands for itself
    return scale, np.where(diagonal > 0.0, null.pinned(scale), 1.0)


def _scaled(A: csr_array, scale: Array, pinned: Array) -> Entries:
    """SAS + diag(pinned)."""
    A.sum_duplicates()
    data = A.data * np.repeat(scale, np.diff(A.indptr)) * scale[A.indices]
    at = np.flatnonzero(pinned)
    return plus(Entries(data, A.indices, A.indptr, A.shape), at, at, pinned[at])


class ObliqueFactor:
    """H⁺ of H = G(I + C)ZG_fᵀ, of a face and C, led by rows that move on their own. Collective.

    H is G_fG_fᵀ and a part that has the same null space; scaled and pinned as in
    ``SemidefiniteFactor``. Creation raises a FactorError where H is singular.
    """

    def __init__(self, grams: Grams, face: Face, C: Following, null: NullModes) -> None:
        led = rows_of(grams.Gt, C.leaders, C.ratios * face.free[C.leaders]).csr()
        of_C = transposed(rows_of(grams.Gt, C.rows)).csr() @ led
        A, N = grams.of_face(face), replicated(of_C, grams.comm)
        self._null, self._factor = null, None
        self._scale, pinned = _scaling(A, null)
        with raised_on_all_ranks(grams.comm):
            try:
                if A.shape[1]:
                    H = _scaled(A + N, self._scale, pinned)
                    # arrays of rows are those of the transpose's columns
                    self._factor = splu(csc_array(H[:3], shape=H.shape))
            except RuntimeError as error:
                raise FactorError(f"active set with friction: coarse problem: {error}") from error

    def solve(self, y: Array) -> Array:
        """H⁺y without null modes, for y orthogonal to them; shape ``(r,)`` or ``(r, q)``."""
        if self._factor is None:
            return y
        x = self._factor.solve((self._scale * self._null.removed(y).T).T, "T")
        return self._null.removed((self._scale * x.T).T)


# --- Factors of faces -----------------------------------------------------------------------


@dataclass
class FaceFactors:
    """Factors of the Gram matrices of faces, and how many were made."""

    comm: MPI.Intracomm
    null: NullModes
    prefix: str
    count: int = 0

    def factor(self, gram: csr_array, of: str = "active set") -> SemidefiniteFactor:
        """Return a factor of a Gram matrix, or raise a FactorError. Collective."""
        self.count += int(gram.shape[0] > 0)
        return SemidefiniteFactor(gram, self.null, self.comm, f"GGᵀ of the {of}", self.prefix)
