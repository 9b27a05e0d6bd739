"""Preconditioners on faces: Dirichlet, smoothing, factors of contact rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, eigsh

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.feti.operator import DualOperator, Metric
from tfeti_dolfinx.qp.problem import FaceOperator
from tfeti_dolfinx.qp.sets import Face
from tfeti_dolfinx.subdomains.factor import CholeskyFactor

# --- Smoothing of displacements with given jumps ----------------------------------------------

# steps, and the part of the spectrum that they make small, from its top down
STEPS, RANGE = 3, 8.0
# the same for cells that keep their volumes, or where the top is above so many times diag K: flat
# ones
MANY_STEPS, WIDE_RANGE, HIGH = 8, 50.0, 5.0
# relative, of the top of the spectrum
EXACT = 1e-2
# trace unknowns of a rank up to which eigenvalues come from a dense matrix
FEW = 20

OfArray = Callable[[Array], Array]


@dataclass(frozen=True)
class Springs:
    """Springs of the curvature on a face: one for each direction of contact rows with κ > 0.

    Attributes:
        directions: Rows × directions, those with a curvature κ > 0.
        bent: κσ, the inverse of the springs' weight in D, shape ``(k,)``.
        size: σ, shape ``(k,)``.
    """

    directions: csr_array
    bent: Array
    size: Array


class Smoothing:
    """B_D p(KH) A p(HK) B_Dᵀ, B_D = B D⁻¹, K = K_bb, in the place of B_D A B_Dᵀ.

    B_DᵀW⁻¹λ has the jumps λ on the rows of a face, W = B_f D⁻¹ B_fᵀ, and is the least in D that
    has. H = D⁻¹ − D⁻¹B_fᵀW⁻¹B_fD⁻¹ makes displacements without jumps, so p(HK) with p(0) = 1
    changes no jump: p is Chebyshev's polynomial, which takes away what HK has large eigenvalues
    for, and so comes near to the least in K (Saad, Iterative Methods for Sparse Linear Systems,
    SIAM 2003, section 12.3).

    Where a subdomain keeps its volume, displacements are those of the unknowns next to the trace,
    too, and K is that of them all: what is inside has to follow. There B and A are 0.

    With springs a displacement is followed by ρ, of which κσρ is how far they are moved.

    Args:
        whole: B_D A B_Dᵀ.
        metric: K_bb, and what more of K there is.
        weights: D on this rank's trace unknowns. The constructor is collective.
        diagonal: That of K there, the mean at each node.
    """

    def __init__(
        self, whole: DualOperator, metric: Metric, weights: Array, diagonal: Array
    ) -> None:
        self._whole, self._weights, self._trace = whole, weights, len(weights)
        self._apply: Callable[[Array, Array], None] = metric.trace.mult
        self._w = whole.B.createVecRight()
        self._comm = self._w.getComm().tompi4py()
        size = self._largest(float(np.max(diagonal / weights, initial=0.0)))
        if metric.near is not None and size > 0.0:
            with raised_on_all_ranks(self._comm):
                near = metric.near()
            self._apply = near.mult
            self._weights = np.concatenate((weights, near.diagonal / size))
        top = self._top()
        many = metric.hard or top > HIGH * size
        steps, part = (MANY_STEPS, WIDE_RANGE) if many else (STEPS, RANGE)
        self._steps = chebyshev(steps, top / part, top) if top > 0.0 else []  # no rows: nothing

    def mult(self, y: PETSc.Vec, solve: OfArray, springs: Springs) -> None:
        """y ← B_D p(KH) A p(HK) B_Dᵀ y. Collective.

        Args:
            y: A vector of rows, which is worked in.
            solve: Z W_κ⁻¹ Zᵀ on this rank's rows. Collective.
            springs: Those of the face.
        """

        def without_jumps(v: Array) -> Array:
            self._put_jumps(v, springs, y)
            y.array[:] = solve(y.array_r)
            smooth = -self._lifted(y, springs)
            smooth += v / self._weights_with(springs)
            return smooth

        def force(u: Array) -> Array:
            return self._forces(self._apply, u, springs)

        u = self._lifted(y, springs)
        u = smoothed(self._steps, lambda u: without_jumps(force(u)), u)
        v = self._forces(self._of_trace, u, springs)
        v = smoothed(self._steps, lambda v: force(without_jumps(v)), v)
        self._put_jumps(v, springs, y)

    def destroy(self) -> None:
        """Free the work vector. Collective."""
        self._w.destroy()

    def _weights_with(self, springs: Springs) -> Array:
        """D, and 1 for each spring."""
        return np.concatenate((self._weights, np.ones(len(springs.size))))

    def _lifted(self, y: PETSc.Vec, springs: Springs) -> Array:
        """B_Dᵀ y, 0 next to the trace, and the springs' part of y."""
        self._whole.B.multTranspose(y, self._w)
        next_to = np.zeros(len(self._weights) - self._trace)
        return np.concatenate((self._w.array_r, next_to, springs.directions.T @ y.array_r))

    def _put_jumps(self, v: Array, springs: Springs, y: PETSc.Vec) -> None:
        """y = B_D v, and what springs add to it."""
        self._w.array[:] = v[: self._trace]
        self._whole.B.mult(self._w, y)
        y.array[:] += springs.directions @ (springs.bent * v[len(self._weights) :])

    def _forces(self, apply: Callable[[Array, Array], None], u: Array, springs: Springs) -> Array:
        """A u, and the forces of the springs."""
        size, out = len(self._weights), np.empty_like(u)
        apply(u[:size], out[:size])
        out[size:] = springs.size * u[size:]
        return out

    def _of_trace(self, u: Array, out: Array) -> None:
        """A u; next to the trace 0."""
        self._whole.multiply(u[: self._trace], out[: self._trace])
        out[self._trace :] = 0.0

    def _top(self) -> float:
        """Bound the largest eigenvalue of D⁻¹K from above. Collective."""
        with raised_on_all_ranks(self._comm):
            top = _largest_eigenvalue(self._apply, self._weights)
        return self._largest(top)

    def _largest(self, value: float) -> float:
        """Return the largest of all ranks, on which all agree. Collective."""
        return float(bcast_from_root(self._comm, self._comm.allreduce(value, op=MPI.MAX)))


def _largest_eigenvalue(apply: Callable[[Array, Array], None], weights: Array) -> float:
    """Bound the largest eigenvalue of D⁻¹K on this rank from above."""
    size, root = len(weights), np.sqrt(weights)

    def scaled(x: Array) -> Array:
        out = np.empty(size)
        apply(x.ravel() / root, out)
        return out / root

    if size <= FEW:
        columns = [scaled(column) for column in np.eye(size)]
        return float(np.max(np.linalg.eigvalsh(np.reshape(columns, (size, size))), initial=0.0))
    start = np.random.default_rng(0).standard_normal(size)
    K = LinearOperator((size, size), matvec=scaled, dtype=float)
    (top,) = eigsh(K, k=1, which="LA", v0=start, tol=EXACT, return_eigenvectors=False)
    return float((1.0 + EXACT) * top)


def chebyshev(count: int, low: float, high: float) -> list[tuple[float, float]]:
    """Return coefficients of Chebyshev steps d ← a d + b r, u ← u + d, for an interval.

    Args:
        count: Their number, at least 1.
        low: Lower end of the interval, positive.
        high: Upper end.

    Returns:
        a and b of each.
    """
    middle, half = 0.5 * (high + low), 0.5 * (high - low)
    rho = half / middle
    steps = [(0.0, 1.0 / middle)]
    for _ in range(count - 1):
        following = 1.0 / (2.0 * middle / half - rho)
        steps.append((following * rho, 2.0 * following / half))
        rho = following
    return steps


def smoothed(steps: list[tuple[float, float]], apply: OfArray, u: Array) -> Array:
    """p(A)u, A being ``apply``, which is called once in each step."""
    change, rest = np.zeros_like(u), -apply(u)
    for k, (a, b) in enumerate(steps):
        if k:
            rest -= apply(change)
        change = a * change + b * rest
        u = u + change
    return u


# --- Factor of a distributed matrix of contact rows -------------------------------------------


class ContactFactor:
    """Cholesky factor of a matrix of contact rows, whole on each rank; it is small and sparse.

    Args:
        A: Symmetric positive definite, AIJ; taken over. The constructor is collective.
        prefix: Prefix of the factor's PETSc options.

    Raises:
        FactorError: It could not be made.
    """

    def __init__(self, A: PETSc.Mat, prefix: str) -> None:
        self._comm, size = A.getComm().tompi4py(), A.getSize()[0]
        first, last = A.getOwnershipRange()
        self._own = slice(first, last)
        indptr, indices, data = A.getValuesCSR()
        A.destroy()
        counts = joined_over(self._comm, np.diff(indptr))
        table = np.concatenate(([0], np.cumsum(counts)))
        parts = (joined_over(self._comm, part) for part in (data, indices))
        with raised_on_all_ranks(self._comm):
            self._factor = CholeskyFactor(csr_array((*parts, table), shape=(size, size)), prefix)

    def solve(self, b: Array) -> Array:
        """A⁻¹b, of this rank's parts. Collective."""
        return np.asarray(self._factor.solve(joined_over(self._comm, b))[self._own])

    def destroy(self) -> None:
        """Free the factor."""
        self._factor.destroy()


def joined_over(comm: MPI.Intracomm, own: Array) -> Array:
    """Return the arrays of all ranks, one after the other. Collective."""
    if comm.size == 1:
        return own
    sizes = np.empty(comm.size, dtype=np.int64)
    comm.Allgather(np.array([len(own)]), sizes)
    whole = np.empty(int(sizes.sum()), dtype=own.dtype)
    comm.Allgatherv(np.ascontiguousarray(own), [whole, sizes.tolist()])
    return whole


# --- Preconditioner on a face -----------------------------------------------------------------

# an entry of B_N D⁻¹ B_Nᵀ − I, whose diagonal is 1, that is rounding
ORTHONORMAL = 1e-12
# added to the unit diagonal: rows that depend on each other leave no pivot, and B_fᵀ takes away
# what the shift makes of them, down to rounding over it
SHIFT = 1e-8


class FacePreconditioner:
    """M_f = W⁻¹B_f D⁻¹ A D⁻¹B_fᵀ W⁻¹, W = B_f D⁻¹B_fᵀ, f the rows of a face.

    Gluing and Dirichlet rows are orthonormal in D⁻¹ and orthogonal to contact rows, so W is the
    identity but for its block of contact rows, W_C, normals and tangents. That is the identity too
    where no two of them meet, as at an obstacle, and no component is prescribed.

    Where a face is curved M_f stands for (ZᵀFZ + κ)⁻¹. F + κ is the F of a scene in which each
    direction with a curvature moves a spring of stiffness 1/κ besides: for that B_f gains the
    column 1 and A the entry 1/κ. Its weight in D is 1/(κσ), σ the diagonal of B D⁻¹ diag(K) D⁻¹Bᵀ,
    which makes M_f the inverse where F is 1/σ. So it is W_κ⁻¹(B_f D⁻¹ A D⁻¹B_fᵀ + κσ²)W_κ⁻¹ with
    W_κ = W + κσ.

    Where the operator on all rows has a metric, displacements with given jumps are made smooth in
    it (``Smoothing``).

    Args:
        whole: B D⁻¹ A D⁻¹Bᵀ on all rows, A the Schur complements, or the stiffness on the trace.
        constraints: B and D. The constructor is collective.
        diagonal: That of K on the local trace unknowns.
        prefix: Prefix of the factor's PETSc options.
    """

    def __init__(
        self, whole: DualOperator, constraints: Constraints, diagonal: Array, prefix: str
    ) -> None:
        self._whole, self._prefix, sets = whole, prefix, constraints.sets
        self._contact = np.concatenate((sets.normals, sets.tangents.ravel()))
        self._gram = _contact_gram(constraints, self._contact)
        self._size = _diagonal(constraints, diagonal)
        self._smoothing: Smoothing | None = None
        if whole.metric is not None:
            self._smoothing = Smoothing(whole, whole.metric, constraints.weights, diagonal)

    def on_face(self, face: Face) -> FaceOperator:
        """M_f on a face. Collective.

        Raises:
            FactorError: W_C has no factor.
        """
        on_contact = csr_array(face.Z[self._contact])
        kept = np.unique(on_contact.indices)
        Z_C, factor = csr_array(face.Z[:, kept]), None
        size = Z_C.multiply(Z_C).T @ self._size
        bent = face.curvature[kept] * size
        if self._gram is not None:
            part = _restricted(self._gram, csr_array(on_contact[:, kept]))
            added = part.createVecLeft()
            added.array[:] = SHIFT + bent
            part.setDiagonal(added, PETSc.InsertMode.ADD_VALUES)
            added.destroy()
            if part.getSize()[0]:
                factor = ContactFactor(part, self._prefix)
            else:
                part.destroy()
        operator = self._whole if self._smoothing is None else self._smoothing
        return _OnFace(operator, face, Z_C, (bent, size), factor)

    def destroy(self) -> None:
        """Destroy W_C, not the operator on all rows. Collective."""
        if self._smoothing is not None:
            self._smoothing.destroy()
        if self._gram is not None:
            self._gram.destroy()


class _OnFace:
    """M_f between vectors of a face, which have the layout of all rows."""

    def __init__(
        self,
        whole: DualOperator | Smoothing,
        face: Face,
        Z_C: csr_array,
        springs: tuple[Array, Array],
        factor: ContactFactor | None,
    ) -> None:
        self._whole, self._face, self._Z_C, self._factor = whole, face, Z_C, factor
        (self._bent, size), bends = springs, springs[0] > 0.0
        self._bends = bool(np.any(bends))
        self._springs = Springs(csr_array(Z_C[:, bends]), self._bent[bends], size[bends])

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M_f x. Collective."""
        if isinstance(self._whole, Smoothing):
            y.array[:] = self._scaled(x.array_r)
            self._whole.mult(y, self._scaled, self._springs)
        else:
            scaled, springs = x.duplicate(), self._springs
            scaled.array[:] = self._scaled(x.array_r)
            self._whole.mult(scaled, y)
            moved = springs.bent * springs.size * (springs.directions.T @ scaled.array_r)
            y.array[:] += springs.directions @ moved
            scaled.destroy()
        y.array[:] = self._scaled(y.array_r)

    def _scaled(self, x: Array) -> Array:
        """W_κ⁻¹x on the rows of the face."""
        values = self._face.restricted(x)
        if self._factor is None and not self._bends:
            return values
        contact = self._Z_C.T @ values
        solved = contact / (1.0 + self._bent)
        if self._factor is not None:
            solved = self._factor.solve(contact)
        return np.asarray(values + self._Z_C @ (solved - contact))

    def destroy(self) -> None:
        """Free the factor. Collective."""
        if self._factor is not None:
            self._factor.destroy()


def _restricted(gram: PETSc.Mat, Z: csr_array) -> PETSc.Mat:
    """ZᵀWZ, Z with a row for each local row of W. Collective."""
    comm, index = gram.getComm(), PETSc.IntType
    own = Z.shape[1]
    start = comm.tompi4py().exscan(own) or 0
    indices = (start + Z.indices).astype(index)
    table = (Z.indptr.astype(index), indices, Z.data)
    size = ((Z.shape[0], None), (own, None))
    directions = PETSc.Mat().createAIJ(size=size, csr=table, comm=comm)
    part = gram.PtAP(directions)
    directions.destroy()
    return part


def _diagonal(constraints: Constraints, diagonal: Array) -> Array:
    """Return the diagonal of B D⁻¹ diag(K) D⁻¹Bᵀ on the local rows. Collective."""
    B = constraints.B
    squares, size = B.copy(), B.createVecRight()
    rows, columns, values = squares.getValuesCSR()
    squares.setValuesCSR(rows, columns, values**2)
    squares.assemble()
    size.array[:] = diagonal / constraints.weights**2
    result = B.createVecLeft()
    squares.mult(size, result)
    found = np.array(result.array_r)
    for item in (squares, size, result):
        item.destroy()
    return found


def _contact_gram(constraints: Constraints, contact: Array) -> PETSc.Mat | None:
    """B_C D⁻¹ B_Cᵀ, or None where it is the identity but for rounding. Collective."""
    B = constraints.B
    comm = B.getComm()
    first = B.getOwnershipRange()[0]
    rows = PETSc.IS().createGeneral((first + contact).astype(PETSc.IntType), comm=comm)
    B_N = B.createSubMatrix(rows)
    transposed = B_N.transpose(PETSc.Mat())
    inverse = B.createVecRight()
    inverse.array[:] = 1.0 / constraints.weights
    B_N.diagonalScale(None, inverse)
    gram = B_N.matMult(transposed)
    for item in (rows, B_N, transposed, inverse):
        item.destroy()
    gram.shift(-1.0)
    apart = gram.norm(PETSc.NormType.INFINITY)
    gram.shift(1.0)
    if comm.tompi4py().bcast(apart <= ORTHONORMAL, root=0):
        gram.destroy()
        return None
    return gram
