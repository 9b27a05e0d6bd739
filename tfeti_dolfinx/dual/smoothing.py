"""Displacements with given jumps, made smooth: steps towards the least energy of the trace."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, eigsh

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.operator import DualOperator, Metric
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.parallel import agreed

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
    """What curvature adds to a face: directions of contact rows that move a spring each.

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
        """At least the largest eigenvalue of D⁻¹K, as nearly as is of use. Collective."""
        with raised_on_all_ranks(self._comm):
            top = _largest_eigenvalue(self._apply, self._weights)
        return self._largest(top)

    def _largest(self, value: float) -> float:
        """The largest of all ranks, on which all agree. Collective."""
        return float(agreed(self._comm, self._comm.allreduce(value, op=MPI.MAX)))


def _largest_eigenvalue(apply: Callable[[Array, Array], None], weights: Array) -> float:
    """At least that of D⁻¹K on this rank."""
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
    """Steps d ← a d + b r, u ← u + d, that make what has eigenvalues in an interval small.

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
