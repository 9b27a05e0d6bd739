"""A bound of the algebraic error in energy, from the gap between primal and dual values."""

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, dot_over, largest, summed
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.recovery import elastic_displacement, min_norm_correction
from tfeti_dolfinx.qp.coarse import HELD, imbalance
from tfeti_dolfinx.qp.projection import project_onto_feasible
from tfeti_dolfinx.qp.sets import FeasibleSet


def energy_bound(
    dual: Dual, lam: Array, u: Array, norm: float, balanced: float = 1e-12
) -> tuple[float, float]:
    """Bound ‖u − u*‖_K of the displacement u of λ ∈ Ω, u* the discrete solution. Collective.

    Return the bound, infinite where no forces balance the load, and ‖u − u_λ‖_K, what it takes to
    balance them, 0 where they are.

    With K u = f − Bᵀλ, λ ∈ Ω, and any admissible v

    J(v) − q(λ) = ½‖v − u‖²_K + λ_Nᵀ(c_N − B_N v) + Σ(ψ_i‖T_i v − c_i‖ − τ_iᵀ(T_i v − c_i)),

    which is at least ½‖v − u*‖²_K + ½‖u − u*‖²_K (Prager, Synge, Q. Appl. Math. 5, 1947). All terms
    are differences already: nothing cancels. v closes on the trace what rows miss, and is extended
    harmonically: ‖v − u‖²_K is δᵀSδ; what ends of springs move comes to its root.
    It costs one multiplication by S, and one solve in each
    subdomain more where λ does not balance the load. ``norm`` is ‖F‖, or an estimate, or 0;
    ``balanced`` the worst entry of Gλ − e beside its terms from which on the forces are balanced.
    """
    forces, displacement, apart = _balanced(dual, lam, u, norm, balanced)
    if not np.isfinite(apart):
        return apart, apart
    change, loss = admissible(dual, forces, displacement, norm)
    lifted = np.empty_like(change)
    dual.make_schur().mult(change, lifted)
    comm, ends = dual.coarse.comm, dual.coarse.spring_ends(forces, displacement)
    own = np.array([change @ lifted, dual.coarse.sigma * (ends @ ends), loss])
    moved, stretched, lost = summed(comm, own)
    energy = 0.5 * (np.sqrt(max(moved, 0.0)) + np.sqrt(stretched)) ** 2
    gap = bcast_from_root(comm, float(max(energy + lost, 0.0)))
    return apart + float(np.sqrt(2.0 * gap)), apart


def admissible(
    dual: Dual, lam: Array, u: Array, norm: float, far: float = 1e8
) -> tuple[Array, float]:
    """δ = v − u on the trace, which makes v admissible, and what contact loses by v. Collective.

    1. Equality rows are closed, and those of contact where λ + (Bu − c)/‖F‖ is in Ω: where a force
       is large beside what its row misses. The least δ in D does so.
    2. Others may open, or slip. Where some overlap then, all are closed.
    3. Contact loses max μᵀq − λᵀq, μ ∈ Ω, by q = Bv − c; the maximum is at P_Ω(λ + tq), t ``far``
       beside the forces.

    Return δ on this rank's trace unknowns; this rank's part of what contact loses, and of what
    closed rows still miss, as they depend on each other, times their forces.
    """
    constraints, comm = dual.constraints, dual.coarse.comm
    contact = constraints.sets.contact
    g = constraints.jumps(u[dual.subdomains.trace]) - constraints.c
    p = lam + g / (norm or 1.0)
    held = (dual.feasible.project(p) == p)[contact]
    wanted = -g
    for closed in (held, np.ones_like(held)):
        wanted[contact] = np.where(closed, -g[contact], 0.0)
        change = min_norm_correction(constraints, wanted, closed)
        left = constraints.jumps(change) - wanted  # of rows that are not closed: B δ
        q = np.where(closed, 0.0, (g + left)[contact])
        t = far * largest(comm, lam) / (largest(comm, q) or 1.0)
        moved_by = within(dual.feasible, lam, contact, t * q)
        overlaps = (np.abs(moved_by) > 0.5 * t * np.abs(q)) & (q != 0.0)
        if not any_rank(comm, bool(overlaps.any())):
            break
    still = np.where(closed, np.abs(left[contact]), 0.0)
    return change, float(moved_by @ q + np.abs(lam[contact]) @ still)


def within(feasible: FeasibleSet, lam: Array, rows: Array, step: Array) -> Array:
    """P_Ω(λ + step) − λ on some rows."""
    to = np.array(lam)
    to[rows] += step
    return np.asarray((feasible.project(to) - lam)[rows])


def _balanced(
    dual: Dual, lam: Array, u: Array, norm: float, balanced: float
) -> tuple[Array, Array, float]:
    """Return forces in Ω with Gλ = e, their displacement, and its distance from u in energy.

    Where λ does not balance the load, the nearest feasible point to λ − (Fλ − d)/‖F‖ does: that
    to λ might take a force off its bound where something opens or slips far.
    """
    coarse, subdomains, constraints = dual.coarse, dual.subdomains, dual.constraints
    outside = dual.feasible.project(lam) - lam
    left, size = dot_over(coarse.comm, (outside, outside), (lam, lam))
    inside = left <= balanced**2 * size
    if inside and (coarse.dimension == 0 or imbalance(coarse, lam) <= balanced):
        return lam, u, 0.0
    wanted = lam
    if norm > 0.0:
        missed = constraints.jumps(u[subdomains.trace]) - constraints.c
        missed[coarse.springs] = coarse.spring_ends(lam, u)
        wanted = lam + missed / norm
    found, _ = project_onto_feasible(coarse, dual.feasible, wanted)
    if imbalance(coarse, found) > HELD:
        return lam, u, float("inf")
    # −K⁺Bᵀ(λ' − λ) + Rα, α such that rows miss as much as before
    zero = np.zeros_like(u)
    change = elastic_displacement(constraints, subdomains, found - lam, zero)
    if coarse.dimension:
        rows = constraints.jumps(change[subdomains.trace])
        rows[coarse.springs] = coarse.spring_ends(found - lam, change)
        change = change - coarse.kernel_motion(coarse.solve(coarse.G(rows)))
    energy = summed(coarse.comm, np.array([sum(subdomains.energies(change))]))[0]
    return found, u + change, float(np.sqrt(max(energy, 0.0)))
