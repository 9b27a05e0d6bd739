"""A bound of the algebraic error in energy, from the gap between primal and dual values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, summed
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.recovery import min_norm_correction, moved
from tfeti_dolfinx.qp.coarse import HELD, NoCoarse, imbalance
from tfeti_dolfinx.qp.krylov import estimate_norm
from tfeti_dolfinx.qp.projection import project_onto_feasible
from tfeti_dolfinx.qp.sets import FeasibleSet
from tfeti_dolfinx.subdomains.local_operators import LocalOperator
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# worst entry of Gλ − e beside its terms: from there on the forces are balanced first
BALANCED = 1e-12
# Of the first step, the last one, and rounding of gaps; a step costs a multiplication by B and Bᵀ.
# The bound is one wherever steps end, since a last correction closes what is left.
CLOSED, ROUNDING, MOST_STEPS = 1e-10, 1e-15, 300
# Lanczos steps for ‖BD⁻¹Bᵀ‖
NORM_STEPS = 10


class LiftedScene(Protocol):
    """Parts of the dual problem that an error bound needs."""

    constraints: Constraints
    subdomains: Subdomains
    coarse: CoarseSpace
    feasible: FeasibleSet

    @property
    def lifting(self) -> LocalOperator:
        """S of all subdomains of this rank, the energy of harmonic extensions. Collective."""
        ...


@dataclass(frozen=True)
class EnergyBound:
    """A bound of ‖u − u*‖_K, u* the exact solution of the discrete problem; on all ranks.

    Attributes:
        error: The bound, a root of an energy; infinite where no forces balance the load.
        gap: J(v) − q(λ) ≥ 0 of an admissible displacement v and of balanced forces λ.
        moved: ‖u − u_λ‖_K, what it takes to balance the forces; 0 where they are.
        steps: Steps in which v was made admissible, each a multiplication by B and by Bᵀ.
    """

    error: float
    gap: float
    moved: float
    steps: int


def energy_bound(scene: LiftedScene, lam: PETSc.Vec, u: Array, norm: float) -> EnergyBound:
    """Bound the algebraic error of a displacement that belongs to multipliers. Collective.

    With K u = f − Bᵀλ, λ ∈ Ω, and any admissible v

    J(v) − q(λ) = ½‖v − u‖²_K + λ_Nᵀ(c_N − B_N v) + Σ(ψ_i‖T_i v − c_i‖ − τ_iᵀ(T_i v − c_i)),

    which is at least ½‖v − u*‖²_K + ½‖u − u*‖²_K (Prager, Synge, Q. Appl. Math. 5, 1947). All terms
    are differences already: nothing cancels. v closes on the trace what rows miss, and is extended
    harmonically: ‖v − u‖²_K is δᵀSδ. It costs one multiplication by S, and one solve in each
    subdomain more where λ does not balance the load.

    Args:
        scene: The dual problem.
        lam: The multipliers λ ∈ Ω.
        u: The displacement K⁺(f − Bᵀλ) + Rα on this rank, shape ``(n,)``.
        norm: ‖F‖, or an estimate; 0 where there is none. It is asked for where λ is not feasible.
    """
    forces, balanced, apart = _balanced(scene, lam, u, norm)
    if not np.isfinite(apart):
        return EnergyBound(apart, apart, apart, 0)
    change, loss, steps = admissible(scene, forces, balanced)
    lifted = np.empty_like(change)
    scene.lifting.mult(change, lifted)
    comm = scene.coarse.comm
    energy, own = summed(comm, np.array([0.5 * float(change @ lifted), loss]))
    gap = bcast_from_root(comm, float(max(energy + own, 0.0)))
    if forces is not lam:
        forces.destroy()
    return EnergyBound(apart + float(np.sqrt(2.0 * gap)), gap, apart, steps)


def admissible(scene: LiftedScene, lam: PETSc.Vec, u: Array) -> tuple[Array, float, int]:
    """δ = v − u on the trace, which makes v admissible, and what contact loses by v. Collective.

    μ ∈ Ω minimises ½(μ − λ)ᵀA(μ − λ) − (μ − λ)ᵀ(Bu − c) with A = BD⁻¹Bᵀ/κ, κD the diagonal of K:
    it stands for F. With δ = −D⁻¹Bᵀ(μ − λ)/κ then Bv − c is normal to Ω at μ: torn copies agree,
    prescribed values are met, nothing overlaps, and slip is along the friction of μ. So the terms
    of contact in J(v) − q(λ) are (μ − λ)ᵀ(Bv − c). Where a force is large beside what its row
    misses, the row is closed; else it may open, whichever is cheaper. μ is found roughly, with a
    vector that is normal to Ω there; a last correction gives Bv − c that value.

    Returns:
        δ on this rank's trace unknowns; this rank's part of the terms of contact, and what rows
        still miss, as they depend on each other, times their forces; steps taken.
    """
    rows, comm = _ScaledGram(scene), scene.coarse.comm
    g, given = rows.missed(u), np.array(lam.array_r)
    sets, feasible = scene.constraints.sets, scene.feasible.shifted(given)
    x = np.zeros_like(given)
    x[sets.equalities] = -rows.unit * g[sets.equalities]  # orthonormal, apart from contact
    if not any_rank(comm, sets.contact.size > 0):
        change = rows.displacement(x)
        rows.destroy()
        return change, 0.0, 0
    x, normal, steps = _nearest_normal(rows, feasible, x, g)
    missed = np.zeros_like(x)
    missed[sets.contact] = -(g + rows.times(x) + normal)[sets.contact]
    last, force = rows.closing(missed), np.abs(given + x)
    force[sets.equalities] = 0.0  # they are met
    left = np.abs(missed - rows.of(last))
    before, after = rows.sums(force * np.abs(missed), force * left)
    if after > before:  # rows that depend on each other
        last, left = np.zeros_like(last), np.abs(missed)
    loss = float(x[sets.contact] @ normal[sets.contact] + force @ left)
    change = rows.displacement(x) - last
    rows.destroy()
    return change, loss, steps


def _nearest_normal(
    rows: _ScaledGram, feasible: FeasibleSet, x: Array, linear: Array
) -> tuple[Array, Array, int]:
    """x of Ω with −(Ax + linear) normal to Ω there, the normal, and steps taken. Collective.

    Accelerated projected gradients, which begin anew where they turn back (O'Donoghue, Candès,
    Found. Comput. Math. 15, 2015). What is near to a boundary need not be told from what is on it.
    """
    length = 1.0 / rows.norm()
    x, left, momentum, step = feasible.project(x), 0.0, 1.0, 0
    g = rows.times(x) + linear
    y, g_y = x, g
    while True:
        new = feasible.project(y - length * g_y)
        normal = (y - new) / length - g_y
        g_new, step = rows.times(new) + linear, step + 1
        size, turn, gap = rows.sums((y - new) ** 2, (y - new) * (new - x), linear**2)
        left = left or CLOSED * np.sqrt(size) + ROUNDING * length * np.sqrt(gap)
        if np.sqrt(size) <= left or step >= MOST_STEPS:
            return new, normal, step
        momentum, before = (1.0, 1.0) if turn > 0.0 else (_next(momentum), momentum)
        ahead = (before - 1.0) / momentum
        y, g_y = new + ahead * (new - x), g_new + ahead * (g_new - g)
        x, g = new, g_new


def _next(momentum: float) -> float:
    return 0.5 + float(np.sqrt(0.25 + momentum**2))


class _ScaledGram:
    """A = BD⁻¹Bᵀ/κ on arrays of this rank's rows, and what rows miss. All is collective."""

    def __init__(self, scene: LiftedScene) -> None:
        self._constraints, self._trace = scene.constraints, scene.subdomains.trace
        self._comm, B = scene.coarse.comm, scene.constraints.B
        self._x, self._w = scene.constraints.c.duplicate(), B.createVecRight()
        own = float(np.min(scene.subdomains.diagonal / scene.constraints.weights, initial=np.inf))
        self.unit = float(self._comm.allreduce(own, op=MPI.MIN))

    def missed(self, u: Array) -> Array:
        """c − Bu."""
        self._w.array[:] = u[self._trace]
        self._constraints.B.mult(self._w, self._x)
        return np.asarray(self._constraints.c.array_r - self._x.array_r)

    def displacement(self, x: Array) -> Array:
        """−D⁻¹Bᵀx/κ."""
        self._x.array[:] = x
        self._constraints.B.multTranspose(self._x, self._w)
        return np.asarray(-self._w.array_r / (self.unit * self._constraints.weights))

    def times(self, x: Array) -> Array:
        """BD⁻¹Bᵀx/κ."""
        return self.of(-self.displacement(x))

    def of(self, v: Array) -> Array:
        """Bv of a displacement of the trace."""
        self._w.array[:] = v
        self._constraints.B.mult(self._w, self._x)
        return np.array(self._x.array_r)

    def closing(self, missed: Array) -> Array:
        """The least v in D with Bv = missed, 0 on equalities, as far as rows are independent."""
        self._x.array[:] = missed
        every = np.ones(self._constraints.sets.contact.size, dtype=bool)
        return min_norm_correction(self._constraints, self._x, every)

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = BD⁻¹Bᵀx/κ."""
        y.array[:] = self.times(x.array_r)

    def norm(self) -> float:
        """‖A‖, or a little more."""
        return estimate_norm(self, NoCoarse(), self._constraints.c, NORM_STEPS)

    def sums(self, *values: Array) -> list[float]:
        """Return sums of values over all rows, the same on all ranks."""
        own = np.array([float(np.sum(value)) for value in values])
        return list(bcast_from_root(self._comm, summed(self._comm, own)))

    def destroy(self) -> None:
        """Destroy the work vectors."""
        self._x.destroy()
        self._w.destroy()


def _balanced(
    scene: LiftedScene, lam: PETSc.Vec, u: Array, norm: float
) -> tuple[PETSc.Vec, Array, float]:
    """Return forces in Ω with Gλ = e, their displacement, and its distance from u in energy.

    Where λ does not balance the load, the nearest feasible point to λ − (Fλ − d)/‖F‖ does: that
    to λ might take a force off its bound where something opens or slips far.
    """
    coarse = scene.coarse
    given = lam.array_r
    outside = float(np.sum((scene.feasible.project(given) - given) ** 2))
    left, size = summed(coarse.comm, np.array([outside, float(given @ given)]))
    inside = bcast_from_root(coarse.comm, bool(left <= BALANCED**2 * size))
    if inside and (coarse.dimension == 0 or imbalance(coarse, lam) <= BALANCED):
        return lam, u, 0.0
    rows, wanted = _ScaledGram(scene), lam.copy()
    if norm > 0.0:
        wanted.array[:] -= rows.missed(u) / norm
    found = project_onto_feasible(
        coarse if coarse.dimension else NoCoarse(), scene.feasible, wanted
    )
    for item in (rows, wanted):
        item.destroy()
    if found.missing > HELD:
        found.lam.destroy()
        return lam, u, float("inf")
    change = _change(scene, found.lam.array_r - lam.array_r)
    energies = sum(scene.subdomains.energies(change))
    apart = float(np.sqrt(max(coarse.comm.allreduce(energies), 0.0)))
    return found.lam, u + change, apart


def _change(scene: LiftedScene, forces: Array) -> Array:
    """−K⁺Bᵀλ + Rα for a change of forces, with α such that rows miss as much as before."""
    B, coarse, subdomains = scene.constraints.B, scene.coarse, scene.subdomains
    w, rows = B.createVecRight(), scene.constraints.c.duplicate()
    rows.array[:] = forces
    B.multTranspose(rows, w)
    change = -subdomains.solve(subdomains.extended(w.array_r))
    w.array[:] = change[subdomains.trace]
    B.mult(w, rows)
    alpha = np.zeros(0)
    if coarse.dimension:
        alpha = -coarse.solve(coarse.G(rows.array_r))
    for vec in (w, rows):
        vec.destroy()
    return moved(change, coarse, alpha)
