"""Recovery of displacements from multipliers; where several are equally good, the smallest."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.optimize import lsq_linear
from scipy.sparse import block_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import norm

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.rigid_bodies import Motions, by_parts
from tfeti_dolfinx.feti.solvability import CutRows, minimise
from tfeti_dolfinx.qp.sets import Face
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# --- Recovery of displacements from multipliers -----------------------------------------------

# Of GGᵀ, added to G_f G_fᵀ: rows with a force that hold a motion by less are not asked about it,
# since they would answer with their rounding over this share.
DAMPING = 1e-8


def recover(
    B: PETSc.Mat,
    c: PETSc.Vec,
    coarse: CoarseSpace,
    lam: PETSc.Vec,
    gradient: PETSc.Vec,
    face: Face,
    pinv_load: Array,
) -> tuple[Array, Array, Array]:
    """u = K⁺(f − Bᵀλ) + Rα. Collective.

    α = (GGᵀ)⁻¹G(Fλ − d − ν) makes the rows' residuals vanish, but for ν, the gaps of open rows
    as the solver left them. A step of the damped normal equations on the rows f that the face
    holds (equalities, λ_N > 0) makes theirs as small as α can.

    Args:
        B: Dual rows × trace unknowns.
        c: Right sides.
        coarse: The coarse space.
        lam: The multipliers.
        gradient: Fλ − d up to the range of Gᵀ; on rows that the face does not hold it is ν.
        face: The face of λ.
        pinv_load: K⁺f, shape ``(n,)``.

    Returns:
        This rank's part of u, shape ``(n,)``, of c − B u, and of Fλ − d, shape ``(m,)``.
    """
    v, residual = B.createVecRight(), c.duplicate()
    subdomains = coarse.subdomains
    u = bent(B, subdomains, lam, pinv_load)
    v.array[:] = u[subdomains.trace]
    B.mult(v, residual)
    residual.aypx(-1.0, c)  # c − B K⁺(f − Bᵀλ) = Fλ − d
    g = np.array(residual.array_r)
    for vec in (v, residual):
        vec.destroy()
    nu = np.where(face.holding, 0.0, gradient.array_r)
    alpha = _alpha(coarse, g, face.holding, nu)
    return moved(u, coarse, alpha), g - coarse.Gt @ alpha, g


def constraint_residual(constraints: Constraints, v: Array) -> PETSc.Vec:
    """B v − c, a new vector, of displacements on this rank's trace. Collective."""
    trace, w = constraints.B.createVecRight(), constraints.c.duplicate()
    trace.array[:] = v
    constraints.B.mult(trace, w)
    w.axpy(-1.0, constraints.c)
    trace.destroy()
    return w


def bent(B: PETSc.Mat, subdomains: Subdomains, lam: PETSc.Vec, pinv_load: Array) -> Array:
    """K⁺(f − Bᵀλ), this rank's part, shape ``(n,)``. Collective.

    Args:
        B: Dual rows × trace unknowns.
        subdomains: This rank's Blocks.
        lam: The multipliers.
        pinv_load: K⁺f, shape ``(n,)``.
    """
    w = B.createVecRight()
    B.multTranspose(lam, w)
    u = pinv_load - subdomains.solve(subdomains.extended(w.array_r))
    w.destroy()
    return np.asarray(u)


def moved(u: Array, coarse: CoarseSpace, alpha: Array) -> Array:
    """u + Rα."""
    return u + coarse.subdomains.kernel_motion(coarse.local_alpha(alpha))


def _alpha(coarse: CoarseSpace, gradient: Array, free: Array, nu: Array) -> Array:
    """Return kernel coordinates that make the rows' residuals vanish as far as they can."""
    if coarse.dimension == 0:
        return np.zeros(0)
    alpha = coarse.solve(coarse.G(gradient - nu))
    if coarse.comm.allreduce(int(np.sum(~free))) == 0:
        return alpha
    factor = coarse.damped_factor(free, DAMPING)
    left = np.where(free, gradient - coarse.Gt @ alpha, 0.0)
    step = factor.solve(coarse.G(left))
    factor.destroy()
    return alpha + step


# --- Smallest of equally good displacements ---------------------------------------------------

# Motions held by less than this share of what the same contacts hold at most are nearly free:
# their contacts' normals are off by less than 6 degrees from a right angle.
NEARLY = 1e-2
# Contact force that counts as none: as a share of the largest on the same bodies; or in multiples
# of the solver's own error, unless it is a larger share of the bodies' loads.
NO_FORCE, NO_EFFECT = 1e-6, 10.0
# Size of what is left of a joint motion of size 1 that motions of single bodies span already: both
# come from null spaces of Gram matrices, whose vectors are right to the root of rounding.
DEPENDENT = 1e-8
# A motion of size 1 that no row sees by more is free: a mesh's coordinates are not more exact.
# Excess of a row, as a share of all motion, that is its rounding: more would be an error of bodies
# that move less. Coefficient of a motion of size 1 that is rounding.
UNSEEN, EXCESS, SLOPE = 1e-9, 1e-13, 1e-12
# of lsq_linear: as far as rounding lets it come
TIGHT = 1e-14


def nearly_free(
    coarse: CoarseSpace, lam: Array, carrying: Array, error: float
) -> tuple[Motions, Array]:
    """Return motions that the contact rows with a force do not hold, or hardly. Collective.

    Args:
        coarse: The coarse space.
        lam: The multipliers.
        carrying: Flags of the local rows that carry a force.
        error: How large multipliers may be by the solver's error alone.

    Returns:
        The motions, and flags of the local rows with a force, or with friction.
    """
    lam, force = np.where(carrying, np.abs(lam), 0.0), np.zeros(len(lam))
    force[coarse.bounded] = (lam * coarse.row_size)[coarse.bounded]
    row, column = coarse.J.tocoo().coords
    body = column // coarse.bodies.k
    largest = np.zeros(coarse.bodies.count)
    np.maximum.at(largest, body, force[row])
    coarse.comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    loads = np.where(coarse.bodies.loads > 0.0, coarse.bodies.loads, np.inf)
    against_forces, against_loads = np.full((2, len(lam)), np.inf)
    np.minimum.at(against_forces, row, largest[body])
    np.minimum.at(against_loads, row, loads[body])
    error_alone = (lam <= NO_EFFECT * error) & (force <= NO_FORCE * against_loads)
    real = (force > 0.0) & (force > NO_FORCE * against_forces) & ~error_alone
    # what sticks holds, pushed or not; and what slips cannot do so farther or less as it likes
    real[coarse.rubbing] = carrying[coarse.rubbing]
    return coarse.unresisted(real, below=NEARLY), real


def smallest_motion(
    coarse: CoarseSpace,
    u: Array,
    gap: Array,
    motions: Motions,
    force: Array,
) -> Array:
    """Return kernel coordinates of the motion that makes u the smallest solution. Collective.

    Of the displacements that differ by these motions, that keep open contacts open and leave the
    rows with a force as near to contact as they are, it has the least mean squares on the bodies.

    Args:
        coarse: The coarse space.
        u: This rank's part of the displacement, shape ``(n,)``.
        gap: c − B u, shape ``(m,)``.
        motions: Motions that hardly any force resists.
        force: Flags of local contact rows with a force.

    Returns:
        Shape ``(r,)``.
    """
    N, body = bcast_from_root(coarse.comm, orthonormal(motions, coarse.bodies.k))
    wanted = -(N.T @ coarse.bodies.part_of(u))
    size = float(np.abs(wanted).max(initial=0.0))
    rows = _rows(coarse, _seen(coarse, N), gap / coarse.row_size, force, body)
    y = minimise(
        rows,
        lambda A, b: _nearest(A, b, wanted),
        EXCESS * size,
        coarse.comm,
        np.empty(0, dtype=np.int64),
    )
    if y is None:
        return np.zeros(coarse.dimension)
    return np.asarray(coarse.motions @ (N @ (rows.allowed(y, EXCESS * size, coarse.comm) * y)))


def orthonormal(motions: Motions, k: int) -> tuple[csr_array, Array]:
    """Return an orthonormal basis of the motions, and a body of each."""
    alone, joint = motions.alone, motions.joint
    body = np.repeat(np.arange(len(motions.free)), motions.free.sum(axis=1))
    if joint.shape[1] == 0:
        return alone, body
    joint = csr_array(joint @ diags_array(1.0 / norm(joint, axis=0)))
    joint = by_parts(csr_array(joint - alone @ (alone.T @ joint)), _span)
    entries = csc_array(joint)
    entries.data[np.abs(entries.data) <= SLOPE] = 0.0
    entries.eliminate_zeros()
    entries.sort_indices()
    first = entries.indices[entries.indptr[:-1]] // k
    return csr_array(block_array([[alone, joint]])), np.concatenate((body, first))


def _span(columns: Array) -> Array:
    """Return orthonormal basis of the span of columns of size 1, or less if they are dependent."""
    U, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(U[:, size > DEPENDENT])


def _seen(coarse: CoarseSpace, N: csr_array) -> csr_array:
    """Return J N of the local rows, 0 for motions that hardly any row sees. Collective."""
    A = csr_array(coarse.J @ N)
    largest = np.zeros(A.shape[1])
    np.maximum.at(largest, A.indices, np.abs(A.data))
    coarse.comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    A.data[largest[A.indices] <= UNSEEN] = 0.0
    A.eliminate_zeros()
    return A


def _rows(coarse: CoarseSpace, A: csr_array, gap: Array, force: Array, body: Array) -> CutRows:
    """Set up A y ≤ gap on open rows, |gap − A y| on others no larger than it is anywhere."""
    bounded = np.zeros(len(gap), dtype=bool)
    bounded[coarse.bounded] = True
    closed = ~bounded | force
    largest = float(np.abs(gap[closed]).max(initial=0.0))
    error = coarse.comm.allreduce(largest, op=MPI.MAX)
    upper = np.where(force, gap + error, np.maximum(gap, 0.0))
    matrix = csr_array(block_array([[A[bounded]], [-A[force]]]))
    return CutRows(matrix, np.concatenate((upper[bounded], error - gap[force])), body)


def _nearest(A: csr_array, b: Array, wanted: Array) -> Array:
    """Project ``wanted`` onto A y ≤ b, separately for parts that do not meet."""
    y = wanted.copy()
    if A.shape[0] == 0:
        return y
    links = csr_array(abs(A).T @ abs(A))
    part = connected_components(links, directed=False)[1]
    part_of_row = part[A.indices[A.indptr[:-1]]]
    for p in np.unique(part_of_row):
        columns, rows = np.flatnonzero(part == p), np.flatnonzero(part_of_row == p)
        own, limit = A[rows][:, columns].toarray(), b[rows]
        # rows that hardly hold a motion are lengths as all others are, once their size is 1
        size = np.linalg.norm(own, axis=1)
        own, limit = own / size[:, None], limit / size
        for _ in range(2):  # the second time from a point that is off by rounding
            y[columns] += _least_distance(own, limit, y[columns])
    return y


def _least_distance(A: Array, b: Array, wanted: Array) -> Array:
    """min ½‖x‖² over A(x + wanted) ≤ b by least squares with bounds.

    Lawson, Hanson, Solving Least Squares Problems, 1974, chapter 23, problem LDP.
    """
    excess = A @ wanted - b
    scale = np.abs(excess).max()
    if np.all(excess <= 0.0):
        return np.zeros_like(wanted)
    E = np.concatenate((-A.T, excess[None, :] / scale))
    f = np.zeros(len(E))
    f[-1] = 1.0
    r = E @ lsq_linear(E, f, bounds=(0.0, np.inf), method="bvls", tol=TIGHT).x - f
    return np.asarray(-scale * r[:-1] / r[-1])


# --- Minimum-norm correction of constraint residuals ------------------------------------------

# Conjugate gradients for least squares: with the usual eigenvalues of B_f D⁻¹ B_fᵀ, 0.6 to 2, about
# 15 steps to this part of the first gradient; what is left of w then has at most 1e-2 of its energy
# where one is 1e-8.
EXACT, MOST_STEPS = 1e-10, 100


def min_norm_correction(constraints: Constraints, w: PETSc.Vec, closed: Array) -> Array:
    """Return the least displacement v in D for which B_f v comes nearest to w. Collective.

    Gluing and Dirichlet rows are orthonormal in D⁻¹, and orthogonal to contact rows: D⁻¹B_fᵀw
    closes them. Contact rows are not so to each other: where a stiff and fine side is the secondary
    one, several of them act on the same soft nodes of the primary one, nearly alike; and where
    walls meet, rows of a node depend on each other, so that no v has B_f v = w.

    Args:
        constraints: B and D.
        w: What rows miss, zero on rows that are not asked about.
        closed: Flags of the local contact rows that are, in the order of ``sets.contact``.

    Returns:
        On this rank's trace unknowns, shape ``(Σ t_s,)``.
    """
    rows, z = _ClosedRows(constraints, closed), w.duplicate()
    own, contact = np.array(w.array_r), constraints.sets.contact
    missed = np.where(closed, own[contact], 0.0)
    own[contact] = 0.0
    z.array[:] = own
    v = rows.spread(z) + rows.nearest(missed)
    z.destroy()
    rows.destroy()
    return v


class _ClosedRows:
    """B_f and D on the contact rows flagged."""

    def __init__(self, constraints: Constraints, rows: Array) -> None:
        self._constraints, self._rows = constraints, rows
        self._contact = constraints.sets.contact
        self._comm = constraints.B.getComm().tompi4py()
        self._x, self._y = constraints.c.duplicate(), constraints.c.duplicate()
        self._v = constraints.B.createVecRight()
        self._x.set(0.0)

    def spread(self, z: PETSc.Vec) -> Array:
        """D⁻¹Bᵀz."""
        self._constraints.B.multTranspose(z, self._v)
        return np.asarray(self._v.array_r / self._constraints.weights)

    def nearest(self, w: Array) -> Array:
        """Return the least v with B_f v nearest to w, zero off the rows, by conjugate gradients."""
        D, r = self._constraints.weights, w.copy()
        s = self._upwards(r)
        v, p, left = np.zeros_like(s), s.copy(), self._dot(s, D * s)
        first = left
        for _ in range(MOST_STEPS):
            if left <= EXACT**2 * first:
                break
            q = self._downwards(p)
            curvature = self._dot(q, q)
            if curvature == 0.0:
                break
            length = left / curvature
            v += length * p
            r -= length * q
            s = self._upwards(r)
            left, before = self._dot(s, D * s), left
            p = s + left / before * p
        return v

    def _upwards(self, r: Array) -> Array:
        """D⁻¹B_fᵀr."""
        self._x.array[self._contact] = r
        return self.spread(self._x)

    def _downwards(self, v: Array) -> Array:
        """B_f v."""
        self._v.array[:] = v
        self._constraints.B.mult(self._v, self._y)
        return np.where(self._rows, self._y.array_r[self._contact], 0.0)

    def _dot(self, a: Array, b: Array) -> float:
        return float(self._comm.allreduce(a @ b))

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        for vec in (self._x, self._y, self._v):
            vec.destroy()
