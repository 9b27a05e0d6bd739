"""Preconditioners on faces: Dirichlet, smoothing, factors of contact rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, eigsh

from tfeti_dolfinx.common.arrays import Array, Entries, LocalMatrix
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, largest, rows_over
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.feti.coarse import CoarseSpace, side_by_side
from tfeti_dolfinx.feti.operator import DualOperator, LateDirichlet, Metric
from tfeti_dolfinx.feti.projectors import FaceFactors
from tfeti_dolfinx.qp.problem import FaceOperator, Operator
from tfeti_dolfinx.qp.sets import Face, Status
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, has_solver

OfArray = Callable[[Array], Array]


@dataclass(frozen=True)
class SmoothingParameters:
    """Parameters of preconditioners on faces."""

    steps: int = 3  # Chebyshev steps
    range: float = 8.0  # the part of the spectrum that they make small, from its top down
    # steps for cells that keep their volumes, or that are flat: the top is `high`
    many_steps: int = 12
    wide_range: float = 100.0  # the same of the spectrum
    high: float = 5.0  # top of the spectrum over diag K, from which on it is
    exact: float = 1e-2  # relative, of the top of the spectrum
    dense: int = 20  # trace unknowns of a rank up to which eigenvalues come from a dense matrix
    orthonormal: float = 1e-12  # entry of B_C D⁻¹ B_Cᵀ − I, whose diagonal is 1, that is rounding
    # added to the unit diagonal: rows that depend on each other leave no pivot, and B_fᵀ takes away
    # what the shift makes of them, down to rounding over it
    shift: float = 1e-8
    # contact rows up to which their factor is whole on each rank; it is shared among ranks beyond
    whole: int = 20_000


PARAMETERS = SmoothingParameters()

# --- Preconditioner on a face -----------------------------------------------------------------


class Deflation(Protocol):
    """A coarse space of a preconditioner on faces."""

    count: int  # number of its motions, of all subdomains
    factors: FaceFactors  # makes the factors of faces, and counts them

    def balanced(self, face: Face, on_face: FaceOperator) -> FaceOperator:
        """Return M_f, which is taken over, with these motions. Collective."""

    def destroy(self) -> None:
        """Free what belongs to it. Collective."""


# from B, the natural coarse space, weights and a prefix of options
MakeDeflation = Callable[[PETSc.Mat, CoarseSpace, Array, str], Deflation]


class FacePreconditioner:
    """M_f = W⁻¹B_f D⁻¹ p(KH) A p(HK) D⁻¹B_fᵀ W⁻¹, W = B_f D⁻¹B_fᵀ, f the rows of a face.

    Gluing and Dirichlet rows are orthonormal in D⁻¹ and orthogonal to contact rows, so W is the
    identity but for its block of contact rows, W_C, normals and tangents. That is the identity too
    where no two of them meet, as at an obstacle, and no component is prescribed.

    Displacements with given jumps are made smooth: D⁻¹B_fᵀW⁻¹λ has the jumps λ, and is the least
    in D that has. H = D⁻¹ − D⁻¹B_fᵀW⁻¹B_fD⁻¹ makes displacements without jumps, so p(HK) with
    p(0) = 1 changes no jump: p is Chebyshev's polynomial, which takes away what HK, K = K_bb, has
    large eigenvalues for, and so comes near to the least in K (Saad, Iterative Methods for Sparse
    Linear Systems, SIAM 2003, section 12.3). Where a subdomain keeps its volume, displacements are
    those of the unknowns next to the trace, too, and K is that of them all: what is inside has to
    follow. There B and A are 0. Without a metric p = 1.

    Where a face is curved M_f stands for (ZᵀFZ + κ)⁻¹. F + κ is the F of a scene in which each
    direction with a curvature moves a spring of stiffness 1/κ besides: for that B_f gains the
    column 1 and A the entry 1/κ. Its weight in D is 1/(κσ), σ the diagonal of B D⁻¹ diag(K) D⁻¹Bᵀ,
    which makes M_f the inverse where F is 1/σ. So it is W_κ⁻¹(B_f D⁻¹ A D⁻¹B_fᵀ + κσ²)W_κ⁻¹ with
    W_κ = W + κσ. With springs a displacement is followed by ρ, of which κσρ is how far they move.
    ``whole`` is B D⁻¹ A D⁻¹Bᵀ on all rows, A the Schur complements, or the stiffness on the trace;
    with the metric of smoothing, or without. ``diagonal`` is that of K on the local trace unknowns,
    the mean at each node. M_f of all rows and of the last face are kept. Creation and all methods
    are collective.

    Attributes:
        whole: A, and B D⁻¹ = B_D.
        weights: D, of the trace and of what is next to it.
        apply: K on it.
        chebyshev: Steps of p, none without a metric.
        work, jumps: Vectors of the trace, and of the rows.
    """

    apply: Callable[[Array, Array], None]

    def __init__(
        self,
        whole: DualOperator,
        constraints: Constraints,
        diagonal: Array,
        prefix: str,
        deflation: Deflation | None,
    ) -> None:
        self.whole, self._deflation, self._prefix = whole, deflation, prefix
        self._constraints, self._contact = constraints, constraints.sets.contact
        self._comm = constraints.B.getComm().tompi4py()
        self._gram = _contact_gram(constraints.B, whole.B, self._contact)
        self._size = _diagonal(whole.B, diagonal)
        self.work, self.jumps = whole.B.createVecs()
        self.weights, self.chebyshev = constraints.weights, list[tuple[float, float]]()
        self._metric: Metric | None = None
        self._diagonal = diagonal
        self._on_all: FaceOperator | None = None
        self._last: tuple[Face, FaceOperator] | None = None
        self.follow()

    def follow(self) -> None:
        """Follow what the operator on all rows becomes."""
        if isinstance(self.whole, LateDirichlet):
            self.whole.make_if_due()
        if (metric := self.whole.metric) is not self._metric and metric is not None:
            self._metric = metric
            self._smooth_in(metric, self._diagonal)

    def _smooth_in(self, metric: Metric, diagonal: Array) -> None:
        """Choose the steps by a bound of the largest eigenvalue of D⁻¹K."""
        comm, self.apply = self._comm, metric.trace.mult
        size = bcast_from_root(comm, largest(comm, diagonal / self.weights))
        if metric.near is not None and size > 0.0:
            with raised_on_all_ranks(comm):
                near, next_to = metric.near()
                K = LocalMatrix(near)
            self.apply = lambda u, out: np.copyto(out, K @ u)
            self.weights = np.concatenate((self.weights, next_to / size))
        with raised_on_all_ranks(comm):
            own = _largest_eigenvalue(self.apply, self.weights)
        top, given = bcast_from_root(comm, largest(comm, np.array([own]))), PARAMETERS
        steps, part = given.steps, given.range
        if metric.hard or top > given.high * size:
            steps, part = given.many_steps, given.wide_range
        if top > 0.0:  # there are rows
            self.chebyshev = chebyshev(steps, top / part, top)

    def on_all_rows(self) -> Operator:
        """Return M on all rows: itself where it has no coarse space, and smooths nothing there."""
        smooths = isinstance(self.whole, LateDirichlet) or self.whole.metric is not None
        count = 0 if self._deflation is None else self._deflation.count
        if not (count or (smooths and not any(self._constraints.contact_rows))):
            return self.whole
        if self._on_all is None:
            rows = self._constraints.num_rows
            self._on_all = self._made(Face(np.ones(rows, dtype=bool), np.full(rows, Status.FREE)))
        return self._on_all

    def on_face(self, face: Face) -> FaceOperator:
        """Return M_f, that of the last time if it is that face.

        Raise a FactorError where W_C has no factor.
        """
        if self._last is not None:
            known, operator = self._last
            if not any_rank(self._comm, not face.is_like(known)):
                return operator
            self._last = None
            operator.destroy()
        self._last = face, self._made(face)
        return self._last[1]

    def _made(self, face: Face) -> FaceOperator:
        """Make M_f, with the coarse space if there is one."""
        free, factor, contact = np.zeros_like(face.free), None, None
        free[self._contact] = face.free[self._contact]
        on_contact = replace(face, free=free)
        along = np.sum(face.tangents**2 * self._size[face.tangent_rows], axis=1)
        size = np.concatenate((self._size[free], along))
        bent = on_contact.bends * size
        if self._gram is not None or np.any(bent):
            Z_C = on_contact.Z
            contact = Z_C, bent, size
        if self._gram is not None:
            # Z_CᵀW_C Z_C, which becomes the factor's
            directions = side_by_side(Z_C[self._contact], self._gram.getComm())
            part = self._gram.PtAP(directions)
            directions.destroy()
            added = part.createVecLeft()
            added.array[:] = PARAMETERS.shift + bent
            part.setDiagonal(added, PETSc.InsertMode.ADD_VALUES)
            added.destroy()
            if part.getSize()[0]:
                factor = ContactFactor(part, self._prefix)
            else:
                part.destroy()
        made = _OnFace(self, face, contact, factor)
        return made if self._deflation is None else self._deflation.balanced(face, made)

    def destroy(self) -> None:
        """Destroy what was made, not the operator on all rows nor the coarse space."""
        made = (self._last and self._last[1], self._on_all, self.work, self.jumps, self._gram)
        for item in made:
            if item is not None:
                item.destroy()
        self._on_all = self._last = None  # they know this object


class _OnFace:
    """M_f between vectors of a face, which have the layout of all rows.

    ``contact`` are Z_C, its directions of contact rows, and κσ and σ of them; None where W_κ is the
    identity. ``factor`` is that of W_C + κσ; None where W_C is the identity.
    """

    def __init__(
        self,
        on_all: FacePreconditioner,
        face: Face,
        contact: tuple[csr_array, Array, Array] | None,
        factor: ContactFactor | None,
    ) -> None:
        self._on_all, self._face, self._factor = on_all, face, factor
        self._is_identity, self._bends = contact is None, False
        self._moves, self._sizes = np.zeros((2, 0))
        if contact is not None:
            Z_C, self._bent, size = contact
            self._Z_C, bends = LocalMatrix(Z_C), self._bent > 0.0
            self._moves, self._sizes = self._bent[bends], size[bends]
            self._bends = bool(np.any(bends))
            if self._bends:
                self._springs = LocalMatrix(Z_C[:, bends])

    def __call__(self, x: Array) -> Array:
        """M_f x: displacements of the trace, of what is next to it, of springs. Collective."""
        on, moves, sizes = self._on_all, self._moves, self._sizes
        on.follow()
        B, w, y = on.whole.B, on.work, on.jumps
        trace, size = w.getLocalSize(), len(on.weights)
        D, none = np.append(on.weights, np.ones(len(moves))), np.zeros(size - trace)
        solved = self._face.restricted if self._is_identity else self._solved

        def lifted() -> Array:  # B_Dᵀ y
            B.multTranspose(y, w)
            along = self._springs.transposed(y.array_r) if self._bends else moves
            return np.concatenate((w.array_r, none, along))

        def put_jumps(v: Array) -> None:  # y = B_D v
            w.setArray(v[:trace])
            B.mult(w, y)
            if self._bends:
                y.array[:] += self._springs @ (moves * v[size:])

        def without_jumps(v: Array) -> Array:  # H v
            put_jumps(v)
            y.setArray(solved(y.array_r))
            return v / D - lifted()

        def stiff(u: Array) -> Array:  # K u
            out = np.empty(len(u))
            out[size:] = sizes * u[size:]
            on.apply(u[:size], out[:size])
            return out

        # 1. the least displacement in D with the jumps x, and smooth
        y.setArray(solved(x))
        u = smoothed(on.chebyshev, stiff, without_jumps, lifted())
        # 2. its forces A u, and back
        v = np.zeros(len(u))
        v[size:] = sizes * u[size:]
        on.whole.multiply(u[:trace], v[:trace])
        put_jumps(smoothed(on.chebyshev, without_jumps, stiff, v))
        return solved(y.array_r) + on.whole.added * x

    def _solved(self, x: Array) -> Array:
        """Z W_κ⁻¹ Zᵀx on this rank's rows, where W_κ is not the identity."""
        values, factor = self._face.restricted(x), self._factor
        contact = self._Z_C.transposed(values)
        solved = contact / (1.0 + self._bent) if factor is None else factor.solve(contact)
        return np.asarray(values + self._Z_C @ (solved - contact))

    def destroy(self) -> None:
        """Destroy the factor. Collective."""
        if self._factor is not None:
            self._factor.destroy()


def _diagonal(B: PETSc.Mat, diagonal: Array) -> Array:
    """Return the diagonal of B diag(K) Bᵀ on the local rows. Collective."""
    squares, size, result = B.copy(), B.createVecRight(), B.createVecLeft()
    rows, columns, values = squares.getValuesCSR()
    squares.setValuesCSR(rows, columns, values**2)
    squares.assemble()
    size.array[:] = diagonal
    squares.mult(size, result)
    found = np.array(result.array_r)
    for item in (squares, size, result):
        item.destroy()
    return found


def _contact_gram(B: PETSc.Mat, B_D: PETSc.Mat, contact: Array) -> PETSc.Mat | None:
    """B_C D⁻¹ B_Cᵀ, or None where it is the identity but for rounding. Collective."""
    first = B.getOwnershipRange()[0]
    rows = PETSc.IS().createGeneral((first + contact).astype(PETSc.IntType), comm=B.getComm())
    B_C, scaled = B.createSubMatrix(rows), B_D.createSubMatrix(rows)
    transposed = B_C.transpose(PETSc.Mat())
    gram = scaled.matMult(transposed)
    for item in (rows, B_C, scaled, transposed):
        item.destroy()
    gram.shift(-1.0)
    apart = gram.norm(PETSc.NormType.INFINITY)
    gram.shift(1.0)
    if bcast_from_root(B.getComm().tompi4py(), apart <= PARAMETERS.orthonormal):
        gram.destroy()
        return None
    return gram


# --- Chebyshev steps --------------------------------------------------------------------------


def _largest_eigenvalue(apply: Callable[[Array, Array], None], weights: Array) -> float:
    """Bound the largest eigenvalue of D⁻¹K on this rank from above."""
    size, root = len(weights), np.sqrt(weights)

    def scaled(x: Array) -> Array:
        out = np.empty(size)
        apply(x.ravel() / root, out)
        return out / root

    if size <= PARAMETERS.dense:
        columns = [scaled(column) for column in np.eye(size)]
        return float(np.max(np.linalg.eigvalsh(np.reshape(columns, (size, size))), initial=0.0))
    start = np.random.default_rng(0).standard_normal(size)
    K = LinearOperator((size, size), matvec=scaled, dtype=float)
    (top,) = eigsh(K, k=1, which="LA", v0=start, tol=PARAMETERS.exact, return_eigenvectors=False)
    return float((1.0 + PARAMETERS.exact) * top)


def chebyshev(count: int, low: float, high: float) -> list[tuple[float, float]]:
    """Return a and b of ``count`` Chebyshev steps d ← a d + b r, u ← u + d, for an interval."""
    middle, half = 0.5 * (high + low), 0.5 * (high - low)
    rho = half / middle
    steps = [(0.0, 1.0 / middle)]
    for _ in range(count - 1):
        following = 1.0 / (2.0 * middle / half - rho)
        steps.append((following * rho, 2.0 * following / half))
        rho = following
    return steps


def smoothed(steps: list[tuple[float, float]], first: OfArray, then: OfArray, u: Array) -> Array:
    """p(A)u, A being two operators, each called once in each step; u without steps."""
    if not steps:
        return u
    rest = -then(first(u))
    change: Array = np.zeros(u.shape)
    for k, (a, b) in enumerate(steps):
        if k:
            rest -= then(first(change))
        change = a * change + b * rest
        u = u + change
    return u


# --- Factor of a distributed matrix of contact rows -------------------------------------------


class ContactFactor:
    """Cholesky factor of an SPD matrix of contact rows, which is taken over.

    With ``whole`` rows at most it is whole on each rank: small and sparse, it takes one gather, and
    less time. With more MUMPS, where PETSc has it, shares it, so that what a rank holds does not
    grow with the surfaces that touch. All methods are collective; creation raises a FactorError
    where it fails.
    """

    def __init__(self, A: PETSc.Mat, prefix: str, whole: int = PARAMETERS.whole) -> None:
        self._comm, size = A.getComm().tompi4py(), A.getSize()[0]
        first, last = A.getOwnershipRange()
        self._own, self._sizes, matrix = slice(first, last), list[int](), A
        if self._comm.size == 1 or size <= whole or not has_solver("mumps"):
            self._sizes = [int(count) for count in np.diff(A.getOwnershipRanges())]
            indptr, indices, data = A.getValuesCSR()
            A.destroy()
            own = Entries(data, indices, indptr, (last - first, size))
            matrix = rows_over(self._comm, own)
        with raised_on_all_ranks(self._comm):
            self._factor = CholeskyFactor(matrix, prefix)

    def solve(self, b: Array) -> Array:
        """A⁻¹b, of this rank's parts."""
        if not self._sizes:
            return self._factor.solve(b)
        whole = np.empty(sum(self._sizes))
        self._comm.Allgatherv(np.ascontiguousarray(b), [whole, self._sizes])
        return np.asarray(self._factor.solve(whole)[self._own])

    def destroy(self) -> None:
        """Destroy the factor."""
        self._factor.destroy()
