"""Motions of subdomains within clusters: a coarse space of the preconditioner, solved by steps.

In clusters G = R̃ᵀBᵀ knows whole clusters only, and M_f, which moves one subdomain at a time, is far
stiffer than a cluster: what jumps all over a cluster's side costs it as many faces as there are,
the cluster one smooth displacement. With Ĝ = R̂ᵀBᵀ, R̂ the rigid motions of all subdomains, those
take over what they can of a jump, as they do by P without clusters.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc
from scipy.sparse import coo_array, csr_array, diags_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.cluster_steps import ClusterSteps
from tfeti_dolfinx.dual.coarse import CoarseSpace, products, side_by_side
from tfeti_dolfinx.dual.grams import replicated
from tfeti_dolfinx.dual.null_basis import NullBasis
from tfeti_dolfinx.dual.operator import DualOperator
from tfeti_dolfinx.dual.projectors import FaceFactors, Factor
from tfeti_dolfinx.dual.soft_modes import SoftModes, mean_stiffness
from tfeti_dolfinx.parallel import Exchange
from tfeti_dolfinx.qp.balanced import Balanced
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.problem import FaceOperator
from tfeti_dolfinx.subdomains.clusters import ClusteredSubdomains, InnerMotions

# relative, added to the diagonal: motions of whole clusters that no row of a face holds
FREE = 1e-12
# of the terms that it is the sum of, added, too: what rounding makes of motions of a body that no
# row of a face holds
ROUNDED = 1e-14


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
        amplification: As of ``SoftModes``.
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
        self.amplification = subdomains.body_maxima([self._own.amplification])[0]
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
        none = NullBasis(np.zeros(0, dtype=np.int64), csr_array((self._width, 0)))
        self.factors = FaceFactors(coarse.comm, none, prefix)

    def balanced(self, face: Face, on_face: FaceOperator) -> FaceOperator:
        """M_f with these motions. Collective.

        Args:
            face: The face.
            on_face: M_f, which is taken over.

        Raises:
            FactorError: A factor could not be made.
        """
        if np.any(face.constrained[self._always]):
            part = _gram(csr_array(face.Z.T @ self._rows))
        else:
            contact = csr_array(face.Z[self._contact].T @ self._rows[self._contact])
            part = csr_array(self._base + _gram(contact))
        A = self._assembled(part)
        inner = ClusterSteps(self._coarse.comm, self._own, self._of_clusters(A), A, self._prefix)
        return Balanced(on_face, _Inner(face, self._Gt, self._own.energy, inner))

    def _assembled(self, part: csr_array) -> PETSc.Mat:
        """The sum of all ranks' parts, and what springs add. Collective."""
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

    def _of_clusters(self, A: PETSc.Mat) -> Factor:
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
        parts = np.concatenate(self._coarse.comm.allgather(squares.T @ terms.array_r))
        terms.destroy()
        shift = FREE * np.maximum(diagonal, 0.0) + ROUNDED * parts
        return self.factors.factor(csr_array(whole + diags_array(shift)))

    def destroy(self) -> None:
        """Free Ĝ. Collective."""
        self._Gt.destroy()
        self._whole.destroy()


def motions_for(
    B: PETSc.Mat, coarse: CoarseSpace, weights: Array, preconditioner: DualOperator, prefix: str
) -> SoftModes | ClusterMotions:
    """What M_f does not know of: soft springs, or the motions of subdomains in clusters."""
    subdomains = coarse.subdomains
    if isinstance(subdomains, ClusteredSubdomains):
        return ClusterMotions(B, coarse, subdomains, weights, prefix)
    return SoftModes(B, coarse, weights, preconditioner, prefix)


class _Inner:
    """Y = ZZᵀĜᵀ, C = XYᵀ, X of ``ClusterSteps``.

    For X = (ĜĜᵀ)⁺, D = 0 that is what plain TFETI has: M_f between its projectors. Whatever X is, a
    jump that averages allow becomes forces of a displacement that has it, R̂XĜ and what M_f makes
    of the rest, so that no eigenvalue of M F is below 1.
    """

    def __init__(self, face: Face, Gt: PETSc.Mat, energy: Array, inner: ClusterSteps) -> None:
        self._face, self._Gt, self._inner, self.energy = face, Gt, inner, energy
        self._alpha, self._x = Gt.createVecs()

    def coordinates(self, x: Array) -> Array:
        """C x."""
        return self._inner.solve(self.moved(x))

    def forces(self, c: Array) -> Array:
        """Y c."""
        self._alpha.array[:] = c
        self._Gt.mult(self._alpha, self._x)
        return self._face.restricted(self._x.array_r)

    def moved(self, y: Array) -> Array:
        """Yᵀ y."""
        self._x.array[:] = self._face.restricted(y)
        self._Gt.multTranspose(self._x, self._alpha)
        return np.array(self._alpha.array_r)

    def directions(self, c: Array) -> Array:
        """Cᵀ c."""
        return self.forces(self._inner.solve(c))

    def destroy(self) -> None:
        """Free the factors. Collective."""
        self._inner.destroy()
        self._alpha.destroy()
        self._x.destroy()


def _gram(Gt: csr_array) -> csr_array:
    return csr_array(Gt.T @ Gt)
