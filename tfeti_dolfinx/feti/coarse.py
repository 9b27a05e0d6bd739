"""The natural coarse space: G = Rᵀ Bᵀ, its projectors, and motions that no row of B resists."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array, vstack

from tfeti_dolfinx.common.arrays import Array, joined
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, chunk_offsets, joined_over
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.feti.projectors import (
    FaceFactors,
    Grams,
    NullModes,
    ObliqueFactor,
    SemidefiniteFactor,
)
from tfeti_dolfinx.feti.rigid_bodies import (
    TOLERANCES,
    Bodies,
    BodyRows,
    Motions,
    kernel_basis,
    orthonormal_columns,
    unresisted,
)
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.friction_newton import Following
from tfeti_dolfinx.qp.sets import Face
from tfeti_dolfinx.subdomains.subdomains import Subdomains


class CoarseSpace(Coarse):
    """G, GGᵀ and what follows from them; the r-vectors are replicated on all ranks.

    G = (R T)ᵀ Bᵀ, with T a basis of the kernel that has the bodies' motions as coordinates.
    Rows of springs are √(D/σ) PᵀR, so that F is 1/σ there. Creation and all methods but
    ``spring_ends`` are collective. ``names`` are those of bodies and of their modes.

    Attributes:
        bounded: Local rows with λ ≥ 0, ``rubbing`` those of friction, ``springs`` those of springs,
            behind all others.
        dimension: r, the dimension of the kernel of K.
        e: (R T)ᵀ f, shape ``(r,)``; 0 instead of rounding where only contact holds a body.
        motions: The bodies' motions in the basis T; ``work`` is the product of their transpose with
            an r-vector.
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        row_size: Sum of the moduli of each local row of B, the same however the mesh is torn. A
            row over it gives lengths. Shape ``(m_local,)``.
        bodies: Motions of the bodies.
        J: This rank's rows of B R over their size, on motions of bodies; empty for gluing rows.
        unheld: Motions that neither springs nor equality rows resist, friction apart; each of
            these rows acts on one body.
        free_motions: Motions that no row resists at all.
        null: Orthonormal basis of null(Gᵀ), scipy CSR, shape ``(r, c)``.
        grams: GGᵀ, and those of faces.
        factors: Makes the factors of faces, and counts them apart from that of GGᵀ, ``factor``.
    """

    def __init__(
        self,
        constraints: Constraints,
        subdomains: Subdomains,
        names: tuple[Sequence[str], Sequence[str]],
        sigma: float,
        prefix: str,
    ) -> None:
        B, sets = constraints.B, constraints.sets
        self.subdomains, self.comm, self.sigma = subdomains, subdomains.comm, sigma
        self.bounded, self.rubbing, comm = sets.normals, sets.tangents.ravel(), subdomains.comm
        self.springs = springs = sets.springs if subdomains.num_springs else sets.springs[:0]
        # 1. rows of B R, and on motions of bodies
        kernel = subdomains.kernel_rows
        offsets = chunk_offsets(comm, kernel.shape[1])
        dimension = int(offsets[-1])
        self._own = slice(int(offsets[comm.rank]), int(offsets[comm.rank + 1]))
        BR = products(B, kernel)
        indptr, indices, data = BR.getValuesCSR()
        Gt = csr_array((data, indices, indptr), shape=(B.getLocalSize()[0], dimension))
        BR.destroy()
        indptr, _, data = B.getValuesCSR()
        row = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        sizes = np.bincount(row, np.abs(data), minlength=len(indptr) - 1).astype(float)
        if len(springs):  # behind all others
            own = csr_array(subdomains.spring_rows / np.sqrt(sigma))
            place = (own.data, self._own.start + own.indices, own.indptr)
            Gt = csr_array(
                vstack((Gt[: -len(springs)], csr_array(place, shape=(len(springs), dimension))))
            )
            sizes[springs] = np.sqrt(own.power(2).sum(axis=1))
        self.row_size = np.where(sizes > 0.0, sizes, 1.0)
        self.bodies = Bodies(subdomains, *names)
        equalities = np.ones(len(self.row_size), dtype=bool)
        equalities[sets.contact] = False
        whole, little = self._on_bodies(Gt, equalities)
        self.J = replace(whole, parts=np.where(little, 0.0, whole.parts))
        # 2. motions that rows leave free: equalities, with soft springs, with contact
        glues = np.array(equalities)
        glues[springs] = False
        self.unheld = self._unglued = self.unresisted(glues, self.bodies.unsprung)
        if subdomains.num_springs:
            self.unheld = self.unresisted(equalities, self.bodies.unsprung)
        # contact does not hold bodies that move as one; nor do its rows then in G
        J, several = self.J, self.bodies.count > 1 and self.unheld.free.any()
        if several and any_rank(comm, len(self.rubbing) > 0):
            self.J = J.without(self.bodies.as_one(self.unheld))
        self.free_motions = self.unresisted(~equalities)
        self.J = J.without(self.free_motions.joint)
        # 3. a basis of the kernel with these motions, made on one rank: processors that round
        # differently might choose differently
        self._basis = bcast_from_root(
            comm, kernel_basis(self.bodies, self._unglued, self.free_motions)
        )
        self.motions = self._basis.coordinates
        self.work = self.motions.transposed
        # what hardly acts on a body holds none, but forces balance only with it
        joint = np.isin(whole.body, self.free_motions.joint.nonzero()[0] // self.bodies.k)
        parts = np.where(little & ~joint[:, None], whole.parts, self.J.parts)
        rows = replace(self.J, parts=parts * self.row_size[self.J.row, None])
        Gt = self._basis.rows(Gt, rows, glues)
        free = self.free_motions.columns
        null = self.motions.csr() @ free if free.shape[1] else csr_array((dimension, 0))
        # 4. GGᵀ
        self.null = bcast_from_root(comm, orthonormal_columns(null))
        self.grams = Grams(Gt, np.flatnonzero(~equalities), comm)
        self.factors = FaceFactors(comm, NullModes(self.null), prefix)
        self.factor = self.factors.factor(self.grams.whole, "coarse problem")
        super().__init__(comm, Gt, np.zeros(0), self.factor.solve)
        self.e = self._load()
        self._on_face: Coarse | None = None
        self._damped: tuple[Face, float, SemidefiniteFactor] | None = None

    def _load(self) -> Array:
        if not self.dimension:
            return np.zeros(0)
        e = self._basis.transposed(joined_over(self.comm, self.subdomains.kernel_load))
        basis, Z = self._basis, self._unglued
        work = np.einsum("bij,bi->bj", Z.single, self.work(e).reshape(Z.free.shape)) * Z.free
        still = np.linalg.norm(work, axis=1) <= self.bodies.unloaded
        e[np.flatnonzero((basis.unheld & still[:, None])[basis.kept])] = 0.0
        return e

    def _on_bodies(self, Gt: csr_array, equalities: Array) -> tuple[BodyRows, Array]:
        """Return the rows of B R over their size on motions of bodies, without what is rounding.

        And flags of parts of contact rows that hardly act on bodies, as between the faces of a
        closed slit.
        """
        J = Gt @ self.bodies.motions.csr()
        counts = np.diff(J.indptr)
        row = np.repeat(np.arange(len(counts)), counts)
        J.data /= self.row_size[row]
        largest: Array = np.zeros(len(counts))
        np.maximum.at(largest, row, np.abs(J.data))
        little = largest <= TOLERANCES.gluing
        noise = np.where(little & equalities, TOLERANCES.gluing, TOLERANCES.no_grip)
        J.data[np.abs(J.data) <= noise[row]] = 0.0
        J.eliminate_zeros()
        found = BodyRows.of(J, self.bodies.count, self.bodies.k)
        return found, little[found.row, None]

    def update_load(self) -> None:
        """Replace e = Rᵀ f by that of the Blocks' present loads."""
        self.bodies.update_load()
        self.e = self._load()

    def kernel_motion(self, alpha: Array) -> Array:
        """R T α of an r-vector on all unknowns of this rank, shape ``(n,)``."""
        return self.subdomains.kernel_motion(self._basis.kernel(alpha)[self._own])

    def spring_ends(self, lam: Array, u: Array) -> Array:
        """Return how far the ends of springs move under λ and u, which rows hold, shape ``(k,)``.

        √(D/σ) Pᵀu − λ/σ, in the length that makes a spring as stiff as a row.
        """
        parts = [(b.springs, u[part]) for b, part in self.subdomains.block_parts]
        stretched = joined([of.stretched(v) for of, v in parts if of]) / np.sqrt(self.sigma)
        return np.asarray(stretched - lam[self.springs] / self.sigma)

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """(G_f G_fᵀ + damping·GGᵀ)⁻¹y, f a face of the rows."""
        if not self.dimension:
            return y
        known = self._damped
        if known is None or any_rank(self.comm, not face.is_like(known[0])) or known[1] != damping:
            self._damped = None
            gram = self.grams.of_face(face, damping)
            known = self._damped = (face, damping, self.factors.factor(gram))
        return known[2].solve(y)

    def on_face(self, face: Face) -> Coarse:
        """Return the projectors on a face of the rows, G_f = GZ; the last ones if it is that face.

        A face that leaves motions free that all rows hold has a G_f without full rank: harmless
        for P and Q, since what the factor makes of such a motion G_fᵀ does not see.
        """
        known = self._on_face
        # a face that bends is like none
        if known is None or any_rank(self.comm, known.face is None or not face.is_like(known.face)):
            self._on_face = None
            factor = self.factors.factor(self.grams.of_face(face))
            known = self._on_face = Coarse(self.comm, self.Gt, self.e, factor.solve, face)
            known.rows, known.moduli = self.rows, self.moduli
        known.e = self.e
        return known

    def oblique(self, face: Face, C: Following) -> Coarse:
        """Return the projectors on a face of the rows where others follow: λ = (I + C)u.

        Raise a FactorError where forces on the face do not determine what balances a load.
        """
        self.factors.count += int(self.dimension > 0)
        factor = ObliqueFactor(self.grams, face, C, self.factors.null)
        made = Coarse(self.comm, self.Gt, self.e, factor.solve, face, C.followed)
        made.rows = self.rows
        return made

    def rows_driven(self, free: Motions) -> Array:
        """Return local rows that act on bodies which the load drives along free motions."""
        motion = None
        if free.count:
            motion = bcast_from_root(self.comm, self.bodies.driven(free, self.work(self.e)))
        if motion is None:
            return np.empty(0, dtype=np.int64)
        moved = np.any(motion.reshape(self.bodies.count, -1), axis=1)
        return self.J.row[moved[self.J.body]]

    def nearly_free(self, loose: Motions) -> list[dict[str, Any]]:
        """List motions of those that contact rows hold hardly or not, see ``Bodies.listed``."""
        if not self.unheld.free.any():  # conditions hold all bodies: contact need not
            return []
        hardly = replace(loose, free=loose.stiffness <= TOLERANCES.nearly)
        return bcast_from_root(self.comm, self.bodies.listed(hardly))

    def unresisted(self, rows: Array, within: Motions | None = None) -> Motions:
        """Return motions of a space that rows do not resist.

        The null space of Gᵀ lives on the bodies' motions: one that no gluing row resists is the
        same in all subdomains of a body. Found on one rank: processors that round differently might
        count differently. ``rows`` are flags of local rows, the space is by default ``unheld``.
        """
        space = within or self.unheld
        if not space.free.any():
            return space
        grams = self.comm.gather(self.J.gram(rows), root=0)
        found: Any = None
        with raised_on_all_ranks(self.comm):
            if grams is not None:
                found = unresisted(grams, space)
        return cast(Motions, bcast_from_root(self.comm, found))


def products(B: PETSc.Mat, R: csr_array) -> PETSc.Mat:
    """B R, R the trace unknowns of this rank × columns of its own. Collective."""
    matrix = side_by_side(R, B.getComm())
    BR = B.matMult(matrix)
    matrix.destroy()
    return BR


def side_by_side(own: csr_array, comm: PETSc.Comm) -> PETSc.Mat:
    """A matrix with a block for each rank, which acts on nothing of the others'. Collective."""
    index = PETSc.IntType
    first = chunk_offsets(comm.tompi4py(), own.shape[1])[comm.rank]
    size = ((own.shape[0], None), (own.shape[1], None))
    table = (own.indptr.astype(index), (own.indices + first).astype(index), own.data)
    return PETSc.Mat().createAIJ(size=size, csr=table, comm=comm)
