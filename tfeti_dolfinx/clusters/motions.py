"""Motions of clusters in the preconditioner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.linalg import eigvalsh_tridiagonal
from scipy.sparse import coo_array, csr_array, diags_array

from tfeti_dolfinx.clusters.subdomains import ClusteredSubdomains, InnerMotions
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import (
    Exchange,
    bcast_from_root,
    chunk_offsets,
    joined_over,
    steering,
    summed,
)
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.feti.coarse import CoarseSpace, products, side_by_side
from tfeti_dolfinx.feti.operator import mean_stiffness
from tfeti_dolfinx.feti.preconditioner import chebyshev
from tfeti_dolfinx.feti.projectors import FaceFactors, NullModes, SemidefiniteFactor, replicated
from tfeti_dolfinx.qp.problem import FaceOperator
from tfeti_dolfinx.qp.sets import Face, Status
from tfeti_dolfinx.subdomains.factor import CholeskyFactor

# --- Chebyshev iteration between clusters -----------------------------------------------------


@dataclass(frozen=True)
class StepParameters:
    """Parameters of Chebyshev's steps between clusters.

    Attributes:
        left: What the steps leave of an interval.
        widest: Ratio of its ends at most: 13 steps.
        seen: Steps of Lanczos' method for the spectrum.
        below, above: How far the spectrum may reach beyond what they see.
        nothing: Residual, over the first, at which nothing is left to be seen.
        shift: Relative, added to the diagonal of D_A: motions of clusters that no row holds.
        free: Relative, added to the diagonal of motions of whole clusters that no row holds.
        rounded: Of the terms that it is the sum of, added, too: what rounding makes of motions of
            a body that no row of a face holds.
    """

    left: float = 0.05
    widest: float = 50.0
    seen: int = 10
    below: float = 0.8
    above: float = 1.1
    nothing: float = 1e-12
    shift: float = 1e-8
    free: float = 1e-12
    rounded: float = 1e-14


PARAMETERS = StepParameters()


class ClusterSteps:
    """X ≈ A⁺, A = Ĝ_fĜ_fᵀ + D/σ: Chebyshev's steps with the clusters' blocks of A.

    Between them what moves whole clusters is solved for: with N their motions among those of the
    subdomains, E = N(NᵀAN)⁺Nᵀ and Π = I − EA, X = E + Π q(D_A⁻¹ΠᵀA) D_A⁻¹ Πᵀ, which is symmetric
    and positive definite (Nicolaides, SIAM J. Numer. Anal. 24, 1987, 355–365; Saad, section 12.3).

    Args:
        comm: Communicator.
        own: This rank's motions.
        whole: (NᵀAN)⁻¹; taken over.
        A: A; taken over. The constructor and ``solve`` are collective.
        prefix: Prefix of the factor's PETSc options.
    """

    def __init__(
        self,
        comm: MPI.Intracomm,
        own: InnerMotions,
        whole: SemidefiniteFactor,
        A: PETSc.Mat,
        prefix: str,
    ) -> None:
        self._comm, self._own, self._whole, self._A = comm, own, whole, A
        offsets = chunk_offsets(comm, own.whole.shape[1])
        self._sizes = np.diff(offsets)
        self._part = slice(int(offsets[comm.rank]), int(offsets[comm.rank + 1]))
        self._x, self._y = A.createVecs()
        self._blocks: CholeskyFactor | None = None
        with raised_on_all_ranks(comm):
            if len(own.cluster):
                self._blocks = CholeskyFactor(_blocks(A, own.cluster), prefix)
        low, top = self._spectrum()
        self._steps = chebyshev(_count(low, top), low, top)

    def solve(self, b: Array) -> Array:
        """X b, this rank's entries."""
        u = self._of_clusters(b)
        rest, change = b - self._times(u), np.zeros_like(b)
        for k, (a, c) in enumerate(self._steps):
            if k:
                rest -= self._times(change)
            s = self._solved(rest)
            change = a * change + c * (s - self._of_clusters(self._times(s)))
            u += change
        return u

    def _of_clusters(self, b: Array) -> Array:
        """E b."""
        e = np.empty(int(self._sizes.sum()))
        self._comm.Allgatherv(self._own.whole.T @ b, [e, self._sizes.tolist()])
        return np.asarray(self._own.whole @ self._whole.solve(e)[self._part])

    def _solved(self, b: Array) -> Array:
        """D_A⁻¹ b."""
        return b if self._blocks is None else self._blocks.solve(b)

    def _times(self, u: Array) -> Array:
        """A u."""
        self._x.array[:] = u
        self._A.mult(self._x, self._y)
        return np.array(self._y.array_r)

    def _spectrum(self) -> tuple[float, float]:
        """Return an interval for the eigenvalues of D_A⁻¹ΠᵀA, as conjugate gradients show them."""
        comm = self._comm
        b = self._times(np.random.default_rng(comm.rank).standard_normal(len(self._own.cluster)))
        (least,) = PARAMETERS.nothing * summed(comm, np.array([b @ self._solved(b)]))
        r, p = b - self._times(self._of_clusters(b)), np.zeros_like(b)
        sizes, steps = list[float](), list[float]()
        for _ in range(PARAMETERS.seen):
            s = self._solved(r)
            s -= self._of_clusters(self._times(s))
            (size,) = summed(comm, np.array([r @ s]))
            p = s + (size / sizes[-1] if sizes else 0.0) * p
            Ap = self._times(p)
            (curvature,) = summed(comm, np.array([p @ Ap]))
            if bcast_from_root(comm, not (size > least and curvature > 0.0)):
                break
            sizes.append(float(size))
            steps.append(float(size / curvature))
            r -= steps[-1] * Ap
        values = steering(comm, *_ritz_values(np.array(sizes), np.array(steps)))
        low, top = float(PARAMETERS.below * values[0]), float(PARAMETERS.above * values[-1])
        return min(max(low, top / PARAMETERS.widest), 0.5 * top), top

    def destroy(self) -> None:
        """Free A and the factors. Collective."""
        for item in (self._A, self._x, self._y):
            item.destroy()


def _ritz_values(sizes: Array, steps: Array) -> Array:
    """Those of conjugate gradients, ascending, from rᵀz and the lengths of steps; 1 without any."""
    if len(sizes) == 0:
        return np.ones(1)
    beta, inverse = sizes[1:] / sizes[:-1], 1.0 / steps
    diagonal = inverse + np.append(0.0, beta * inverse[:-1])
    beside = np.sqrt(beta) * inverse[:-1]
    return np.asarray(eigvalsh_tridiagonal(diagonal, beside))


def _count(low: float, high: float) -> int:
    """Return the number of Chebyshev steps that reduce an interval to ``left``."""
    root = np.sqrt(high / low)
    return int(np.ceil(np.arccosh(1.0 / PARAMETERS.left) / np.log((root + 1.0) / (root - 1.0))))


def _blocks(A: PETSc.Mat, cluster: Array) -> csr_array:
    """Return the blocks of A between motions of one cluster each, with a shift."""
    indptr, columns, values = A.getDiagonalBlock().getValuesCSR()
    own = csr_array((values, columns, indptr), shape=(len(cluster),) * 2).tocoo()
    within = cluster[own.coords[0]] == cluster[own.coords[1]]
    places = tuple(i[within] for i in own.coords)
    blocks = csr_array(coo_array((own.data[within], places), shape=own.shape))
    diagonal = blocks.diagonal()
    shift = PARAMETERS.shift * np.maximum(diagonal, PARAMETERS.shift * diagonal.max(initial=0.0))
    return csr_array(blocks + diags_array(np.where(shift > 0.0, shift, 1.0)))


# --- Coarse space of subdomain motions within clusters ----------------------------------------
# In clusters G = R̃ᵀBᵀ knows whole clusters only, and M_f, which moves one subdomain at a time,
# is far stiffer than a cluster: a jump along a whole side of a cluster costs M_f energy on each
# face of its subdomains, but the cluster only one smooth displacement. Ĝ = R̂ᵀBᵀ, R̂ the rigid
# motions of all subdomains, takes that part of a jump, as P does without clusters.


class Balanced:
    """M = (I − YC)ᵀ M_f (I − YC) + CᵀDC with C = XYᵀ, beside a part that is solved for apart.

    Mandel, Comm. Numer. Methods Engrg. 9, 1993, 233–241. Where D = (CFCᵀ)⁻¹ and Y = FCᵀD it is the
    inverse of F on the range of Cᵀ; what is only near to that remains positive semidefinite, and
    definite if no x has both (I − YC)x = 0 and DCx = 0. Vectors of rows are this rank's parts;
    coordinates may be replicated or distributed. The functions are collective.

    Args:
        on_face: M_f, which is taken over.
        energy: D, shape of the coordinates.
        solve: X c.
        forces: Y c, in the face.
        moved: Yᵀ y, y in the face.
        owned: What is destroyed with it.
    """

    def __init__(
        self,
        on_face: FaceOperator,
        energy: Array,
        *,
        solve: Callable[[Array], Array],
        forces: Callable[[Array], Array],
        moved: Callable[[Array], Array],
        owned: Sequence[Any] = (),
    ) -> None:
        self._on_face, self._energy, self._owned = on_face, energy, owned
        self._solve, self._forces, self._moved = solve, forces, moved

    def __call__(self, x: Array) -> Array:
        """M x, x in the face. Collective."""
        c = self._solve(self._moved(x))
        y = self._on_face(x - self._forces(c))
        return y - self._forces(self._solve(self._moved(y) - self._energy * c))

    def destroy(self) -> None:
        """Free what it has been given. Collective."""
        for item in (self._on_face, *self._owned):
            item.destroy()


class ClusterMotions:
    """Ĝ of the rigid motions of all subdomains, in clusters.

    Args:
        B: Dual rows × trace unknowns.
        coarse: The natural coarse space, of clusters. The constructor is collective.
        subdomains: The clusters.
        weights: D of the rows, on this rank's trace unknowns.
        prefix: Prefix of the factors' PETSc options.

    Attributes:
        count: Number of these motions, of all subdomains.
        factors: Makes the factors of faces, of motions of whole clusters, and counts them.
    """

    def __init__(
        self,
        B: PETSc.Mat,
        coarse: CoarseSpace,
        subdomains: ClusteredSubdomains,
        weights: Array,
        prefix: str = "tfeti_coarse_",
    ) -> None:
        self._coarse, self._prefix = coarse, prefix
        self._own: InnerMotions = subdomains.inner_motions()
        self._Gt = products(B, self._own.rows)
        indptr, columns, values = self._Gt.getValuesCSR()
        self.count = self._Gt.getSize()[1]
        self._rows = csr_array((values, columns, indptr), shape=(len(indptr) - 1, self.count))
        self._damping = self._own.energy / mean_stiffness(subdomains, weights)
        self._contact = np.concatenate((coarse.bounded, coarse.rubbing))
        self._always = np.ones(len(indptr) - 1, dtype=bool)
        self._always[self._contact] = False
        self._base = _gram(csr_array(self._rows[self._always]))
        self._whole = side_by_side(self._own.whole, self._Gt.getComm())
        self._width = self._whole.getSize()[1]
        self.factors = FaceFactors(coarse.comm, NullModes(csr_array((self._width, 0))), prefix)

    def balanced(self, face: Face, on_face: FaceOperator) -> FaceOperator:
        """M_f with these motions: Y = ZZᵀĜᵀ, C = XYᵀ, X of ``ClusterSteps``. Collective.

        For X = (ĜĜᵀ)⁺, D = 0 that is what plain TFETI has: M_f between its projectors. Whatever X
        is, a jump that averages allow becomes forces of a displacement that has it, R̂XĜ and what
        M_f makes of the rest, so that no eigenvalue of M F is below 1.

        Args:
            face: The face.
            on_face: M_f, which is taken over.

        Raises:
            FactorError: A factor could not be made.
        """
        if np.any(face.status[self._always] != Status.FREE):
            part = _gram(csr_array(face.Z.T @ self._rows))
        else:
            contact = csr_array(face.Z[self._contact].T @ self._rows[self._contact])
            part = csr_array(self._base + _gram(contact))
        A = self._assembled(part)
        inner = ClusterSteps(self._coarse.comm, self._own, self._of_clusters(A), A, self._prefix)
        alpha, x = self._Gt.createVecs()

        def forces(c: Array) -> Array:
            alpha.array[:] = c
            self._Gt.mult(alpha, x)
            return face.restricted(x.array_r)

        def moved(y: Array) -> Array:
            x.array[:] = face.restricted(y)
            self._Gt.multTranspose(x, alpha)
            return np.array(alpha.array_r)

        return Balanced(
            on_face,
            self._own.energy,
            solve=inner.solve,
            forces=forces,
            moved=moved,
            owned=(inner, alpha, x),
        )

    def _assembled(self, part: csr_array) -> PETSc.Mat:
        """Return the sum of all ranks' parts, and what springs add. Collective."""
        terms: coo_array = part.tocoo()
        row, column = (i.astype(np.int64) for i in terms.coords)
        ranges = self._Gt.getOwnershipRangesColumn()
        owner = np.searchsorted(ranges, row, side="right") - 1
        exchange = Exchange(self._coarse.comm, owner)
        row, column, values = (exchange.send(x) for x in (row, column, terms.data))
        own, first = len(self._damping), int(ranges[self._coarse.comm.rank])
        summed_up = csr_array(coo_array((values, (row - first, column)), shape=(own, self.count)))
        places = (np.arange(own), first + np.arange(own))
        damping = coo_array((self._damping, places), shape=(own, self.count))
        rows = csr_array(summed_up + damping)
        table = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType), rows.data)
        size, comm = (own, None), self._Gt.getComm()
        A = PETSc.Mat().createAIJ(size=(size, size), csr=table, comm=comm)
        return A

    def _of_clusters(self, A: PETSc.Mat) -> SemidefiniteFactor:
        """(NᵀAN)⁻¹ on all ranks, N the motions of whole clusters, with a shift. Collective."""
        gram = A.PtAP(self._whole)
        indptr, columns, values = gram.getValuesCSR()
        first, last = gram.getOwnershipRange()
        above = np.full(first, indptr[0]), np.full(self._width - last, indptr[-1])
        table = (values, columns, np.concatenate((above[0], indptr, above[1])))
        whole = replicated(csr_array(table, shape=(self._width,) * 2), self._coarse.comm)
        gram.destroy()
        diagonal = whole.diagonal()
        squares, terms = self._own.whole.multiply(self._own.whole), A.getDiagonal()
        parts = joined_over(self._coarse.comm, squares.T @ terms.array_r)
        terms.destroy()
        shift = PARAMETERS.free * np.maximum(diagonal, 0.0) + PARAMETERS.rounded * parts
        return self.factors.factor(csr_array(whole + diags_array(shift)))

    def destroy(self) -> None:
        """Free Ĝ. Collective."""
        self._Gt.destroy()
        self._whole.destroy()


def motions_of_clusters(
    B: PETSc.Mat, coarse: CoarseSpace, weights: Array, prefix: str
) -> ClusterMotions:
    """Return the motions of subdomains in clusters. Collective."""
    assert isinstance(coarse.subdomains, ClusteredSubdomains)
    return ClusterMotions(B, coarse, coarse.subdomains, weights, prefix)


def _gram(Gt: csr_array) -> csr_array:
    return csr_array(Gt.T @ Gt)
