"""Diagnostics of a solution: the warnings of the report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array, diags_array

from tfeti_dolfinx.common.arrays import TINY, Array, joined, sum_rows, sums
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.contact.records import GEOMETRY
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.recovery import constraint_residual, orthonormal
from tfeti_dolfinx.feti.rigid_bodies import parts_of_motions
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.diagnostics import flatness, shared_by_bodies
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.report import Report
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.subdomains.block import mode_names
from tfeti_dolfinx.subdomains.stiffness import stretch_over_shear
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# --- Sliding motions that friction alone must hold --------------------------------------------

# of rtol: how far a body may be from where friction balances its load
FAR = 20.0
# rounding of displacements, of the largest; of the work of a load, of the most that it could do;
# and of that of friction what says nothing of where a body is
NOISE, ROUNDING, NO_HOLD = 2.5e-13, 1e-14, 1e-6


@dataclass(frozen=True)
class Lost:
    """Motions of bodies along which a displacement is wrong, or not determined; on all ranks.

    Attributes:
        motions: As columns on the bodies' motions, scipy CSR, shape ``(bodies * k, lost)``.
        share: What friction bears along each, of the most that the largest load could do, shape
            ``(lost,)``.
    """

    motions: csr_array
    share: Array


def lost_on_friction(
    coarse: CoarseSpace, constraints: Constraints, u: Array, lam: Array, rtol: float
) -> Lost | None:
    """Return motions that friction alone holds, but not where the displacement is. Collective.

    Along a motion y that neither springs, nor equality rows, nor closed normals resist, friction
    balances the load e: ρ(t) = yᵀe − Σψ_i (T_i y)ᵀq_i/‖q_i‖, q_i the slips of u + ty, is 0 or jumps
    over it at t = 0. It falls with t, so u is farther than t from such a place along y if ρ does
    not change its sign between −t and t. Where ψ_i is tiny nothing else sees that: τ_i moves
    nothing, and a slip that it does not allow is hardly work. Products with B, none with F.

    Args:
        coarse: The coarse space.
        constraints: Rows, their limits and coefficients.
        u: This rank's displacement, shape ``(n,)``.
        lam: The multipliers of this rank's rows.
        rtol: The relative tolerance that was asked for.

    Returns:
        Those motions of which that is so for 20 rtol of the displacement, or None.
    """
    w = constraint_residual(constraints, u[coarse.subdomains.trace])
    slips = np.array(w.array_r)
    w.destroy()
    allowed = _allowed(coarse, u, rtol)
    N = _held_by_nothing_else(coarse, constraints, slips, allowed)
    if N.shape[1] == 0:
        return None
    law = _Sliding(coarse, constraints, slips, lam, N)
    reach = _largest(N, np.repeat(allowed, coarse.bodies.k))
    back, ahead = law.left(-reach), law.left(reach)
    # what friction bears is lost in the noise of the solution: there it must say where a body is
    weak = law.most <= rtol * law.load
    sure = np.where(weak, np.maximum(NO_HOLD * law.most, law.noise), -rtol * law.most)
    lost = bcast_from_root(coarse.comm, (law.most > 0.0) & ((back < sure) | (ahead > -sure)))
    if not lost.any():
        return None
    return Lost(csr_array(N[:, np.flatnonzero(lost)]), law.most[lost] / max(law.load, TINY))


class _Sliding:
    """Load and friction along motions, shape ``(motions,)``, on all ranks. Creation is collective.

    Attributes:
        most: The most that friction can bear, Σ‖ψ_i T_i y‖.
        load: The most that the largest load on a body could do.
        noise: Rounding of the work of the load.
    """

    def __init__(
        self,
        coarse: CoarseSpace,
        constraints: Constraints,
        slips: Array,
        lam: Array,
        N: csr_array,
    ) -> None:
        rows, size = constraints.sets.tangents, constraints.tangent_scale[:, None]
        by_law = constraints.coefficients * lam[constraints.pressed_by][:, None]
        pressed = (constraints.pressed_by >= 0)[:, None]
        limits = np.where(pressed, by_law, constraints.limits) * size
        J = csr_array(diags_array(coarse.row_size) @ coarse.J @ N)
        along = [csr_array(J[own]) for own in rows.T]
        i, self._motion = sum((abs(A) for A in along), csr_array(along[0].shape)).nonzero()
        entries = [np.asarray(A[i, self._motion]).ravel() for A in along]
        self._v = np.stack(entries, axis=1) / size[i]
        self._q, self._limits = (slips[rows] / size)[i], limits[i]
        self._comm, self._count = coarse.comm, N.shape[1]
        self.most = self._summed(np.linalg.norm(self._limits * self._v, axis=1))
        self._work = N.T @ (coarse.motions.T @ coarse.e)
        bodies = coarse.bodies
        largest = bodies.loads * np.sqrt(bodies.nodes)
        self.load = float(largest.max(initial=0.0))
        self.noise = ROUNDING * _largest(N, np.repeat(largest, bodies.k))

    def left(self, t: Array) -> Array:
        """ρ of each motion, t of it farther. Collective."""
        z = self._limits * (self._q + t[self._motion][:, None] * self._v)
        length = np.maximum(np.linalg.norm(z, axis=1), TINY)
        return self._work - self._summed(np.sum(self._limits * z * self._v, axis=1) / length)

    def _summed(self, values: Array) -> Array:
        own = sum_rows(self._motion, values, self._count)
        self._comm.Allreduce(MPI.IN_PLACE, own, op=MPI.SUM)
        return own


def _allowed(coarse: CoarseSpace, u: Array, rtol: float) -> Array:
    """Return the displacement error allowed to each body, shape ``(bodies,)``."""
    size = coarse.subdomains.body_maxima([coarse.subdomains.sizes(u)])[0]
    return np.asarray(FAR * rtol * size + NOISE * size.max(initial=0.0))


def _held_by_nothing_else(
    coarse: CoarseSpace, constraints: Constraints, slips: Array, allowed: Array
) -> csr_array:
    """Return orthonormal motions that normals which may be closed do not resist, on all ranks."""
    row, column = coarse.J.tocoo().coords
    near = np.zeros(len(slips))
    np.maximum.at(near, row, allowed[column // coarse.bodies.k])
    closed, normals = np.zeros(len(slips), dtype=bool), constraints.sets.normals
    closed[normals] = -slips[normals] <= near[normals] * constraints.scale
    motions = coarse.unresisted(closed)
    return bcast_from_root(coarse.comm, orthonormal(motions, coarse.bodies.k)[0])


def _largest(N: csr_array, values: Array) -> Array:
    """Return for each column the largest value among the rows where it has entries."""
    entries = N.tocoo()
    row, column = entries.coords
    largest = np.zeros(N.shape[1])
    np.maximum.at(largest, column, np.where(entries.data != 0.0, values[row], 0.0))
    return largest


# --- Warnings of the report -------------------------------------------------------------------

# relative rounding of a stiffness
EPSILON = float(np.finfo(float).eps)
# errors of beams and strips that are 10⁴ times as long as thick, over the estimate of rounding:
# 10 to 50 were seen
OF_ROUNDING = 30.0
# ‖J‖‖J⁻¹‖/gdim of a cell that is about 1000 times as long as thick
FLAT = 500.0
# (λ + 2μ)/μ: 51 of ν = 0.49; from here on linear displacements are too stiff
LOCKS = 50.0
# radians; what linear kinematics then takes for strain is half the square, 0.5 %
TURNS = 0.1
# of what the largest pressure presses together: gaps that straight facets change by as much had
# forces and pressures wrong by 4 to 10 %
FACETS = 0.5
LISTED = 3  # bodies that a sentence names
ESTIMATES = "estimates"  # how the sentence on them begins


class Diagnostics:
    """Diagnostics of solutions beyond residuals; a solution seen before is not examined again.

    Args:
        decomposition: The torn mesh.
        dofs: Dof maps.

    Attributes:
        finite: Whether kinematics are not linear, so that bodies may turn.
    """

    def __init__(self, decomposition: Decomposition, dofs: TornDofs) -> None:
        self._decomposition, self._dofs = decomposition, dofs
        self.finite = False
        self._of: Dual | None = None
        self._lasting: list[str] = []

    def found(self, dual: Dual, solution: Solution, report: Report, rtol: float) -> list[str]:
        """Sentences, each of which names the thing. Collective.

        Args:
            dual: The dual problem.
            solution: What was found.
            report: What is known already.
            rtol: The relative tolerance that was asked for.
        """
        if self._of is not dual:
            lasting = (self._cells(), self._locking(dual.subdomains), self._hinges())
            self._lasting, self._of = [text for texts in lasting for text in texts], dual
        u = solution.u
        return [
            *_loose(report),
            *self._on_friction(dual, u, solution.lam, rtol),
            *self._rounding(dual, u, rtol),
            *self._springs(dual, rtol),
            *self._turned(u, dual.subdomains),
            *self._facets(solution, dual.subdomains),
            *self._lasting,
            *_of_estimates(report),
        ]

    def _cells(self) -> Iterator[str]:
        """Cells that are far from regular."""
        flat = float(np.max(flatness(self._decomposition.mesh), initial=1.0))
        worst = float(self._dofs.comm.allreduce(flat, op=MPI.MAX))
        if worst > FLAT:
            yield (
                f"cells: the flattest is about {2.0 * worst:.0e} times as long as thick; forces "
                "and multiplications suffer from more than 10"
            )

    def _hinges(self) -> Iterator[str]:
        """Bodies that a mesh joins in nodes alone."""
        names = self._decomposition.body_names
        for (a, b), count in zip(*shared_by_bodies(self._decomposition), strict=True):
            yield (
                f"{names[a]}, {names[b]}: the mesh joins them in nodes alone ({count}), in no "
                "facet: they are bodies of their own, and not joined; expected a common facet"
            )

    def _locking(self, subdomains: Subdomains) -> Iterator[str]:
        """Displacements of degree 1 where a material hardly changes its volume."""
        if self._dofs.V.element.basix_element.degree > 1:
            return
        x, ratios = self._points(subdomains), []
        for block, part in zip(subdomains.blocks, subdomains.dof_parts, strict=True):
            own = x[part.start // self._dofs.bs : part.stop // self._dofs.bs]
            ratios.append(stretch_over_shear(own, self._dofs.bs, block.multiply))
        worst = subdomains.body_maxima([ratios])[0]
        if np.any(worst > LOCKS):
            t = float(worst.max())
            yield (
                f"{self._names(worst > LOCKS)}: Poisson's ratio is about "
                f"{(t - 2.0) / (2.0 * t - 2.0):.4g} and displacements have degree 1, which makes "
                "it too stiff (locking); expected degree 2"
            )

    def _on_friction(self, dual: Dual, u: Array, lam: Array, rtol: float) -> Iterator[str]:
        """Bodies that friction alone holds, but somewhere else."""
        if dual.contact_rows[1] == 0:
            return
        lost = lost_on_friction(dual.coarse, dual.constraints, u, lam, rtol)
        if lost is None:
            return
        modes = mode_names(self._decomposition.mesh.geometry.dim, self._dofs.bs)
        names = self._decomposition.body_names
        found = list(parts_of_motions(lost.motions, dual.coarse.bodies, names, modes))
        for (bodies, mode), share in list(zip(found, lost.share, strict=True))[:LISTED]:
            yield (
                f"{', '.join(bodies)}: friction alone holds {mode}, by {share:.0e} of the largest "
                "load at most, and does not balance the load where the body is: its displacement "
                f"is wrong along that by more than {FAR:g} rtol, or not determined; expected a "
                "larger bound or coefficient of friction, or a spring or Dirichlet condition"
            )
        if (rest := len(found) - LISTED) > 0:
            yield f"{rest} more motions that friction alone holds are wrong, or not determined"

    def _rounding(self, dual: Dual, u: Array, rtol: float) -> Iterator[str]:
        """Warn of slender bodies, whose small bending energy is inexact by the rounding of K.

        Entries of K are right to ε, so the energy uᵀKu is to ε Σ|K_ij u_i u_j|, about ε uᵀDu, D
        the diagonal; of u less the rigid motion of the body, which K knows to do no work.
        """
        subdomains, motions = dual.subdomains, dual.coarse.bodies
        bent = u - subdomains.modes_motion(motions.amounts(motions.part_of(u)))
        diagonal = joined([block.diagonal for block in subdomains.blocks])
        energy, terms = subdomains.body_sums(
            [subdomains.energies(u), sums(diagonal * bent**2, subdomains.dof_parts)]
        )
        known = energy > EPSILON * energy.max(initial=0.0)
        share = (
            OF_ROUNDING * EPSILON * np.divide(terms, energy, out=np.zeros_like(terms), where=known)
        )
        if np.any(share > rtol):
            yield (
                f"{self._names(share > rtol)}: rounding of the stiffness may change the "
                f"displacement by about {share.max():.0e} of its size, more than rtol {rtol:g}; "
                "expected thicker parts, fewer cells, or a larger rtol"
            )

    def _springs(self, dual: Dual, rtol: float) -> Iterator[str]:
        """Springs so soft that rounding of the stiffness is a part of them."""
        if dual.soft is None:
            return
        share = EPSILON * dual.soft.amplification
        if np.any(share > rtol):
            yield (
                f"{self._names(share > rtol)}: springs hold subdomains so softly that rounding of "
                f"the stiffness is about {share.max():.0e} of them, more than rtol {rtol:g}; "
                "expected stiffer ones or none, or a larger rtol"
            )

    def _turned(self, u: Array, subdomains: Subdomains) -> Iterator[str]:
        """Bodies that turn farther than linear kinematics bears."""
        bs = self._dofs.bs
        if self.finite or bs != self._decomposition.mesh.geometry.dim or bs == 1:
            return
        x, angles = self._points(subdomains), []
        for part in subdomains.dof_parts:
            rows = slice(part.start // bs, part.stop // bs)
            slope = np.linalg.lstsq(x[rows], u[part].reshape(-1, bs), rcond=None)[0]
            angles.append(float(np.linalg.norm(slope - slope.T)) / 8.0**0.5)
        worst = subdomains.body_maxima([angles])[0]
        if np.any(worst > TURNS):
            yield (
                f"{self._names(worst > TURNS)}: parts turn by up to {worst.max():.2g} radians; "
                "linear kinematics takes half the square of that for strain: expected smaller "
                "loads, or a nonlinear model"
            )

    def _facets(self, solution: Solution, subdomains: Subdomains) -> Iterator[str]:
        """Pairs of surfaces so alike that their straight facets decide where they meet.

        What facets change of a gap is how far the smooth surfaces are apart where there is a force,
        and how deep they overlap where there is none. It counts beside the distance by which the
        largest pressure presses a node and what it meets into their surroundings, its force times
        Σ_j w_ij²/K_jj.
        """
        records, comm = solution.gluing.records, self._dofs.comm
        flat = np.array([contact.gap == GEOMETRY for contact in solution.contacts])
        if not np.any(flat):
            return
        shown = records.conforms & flat[records.contact]
        if not any_rank(comm, bool(np.any(shown))):
            return
        diagonal = joined([block.diagonal for block in subdomains.blocks])
        K = self._dofs.reduce(diagonal.reshape(-1, self._dofs.bs).mean(axis=1), np.add, 0.0)
        (K,) = self._dofs.lookup(records.entry_group, K)
        gives = records.area * sum_rows(records.condition, records.weight**2 / K, len(records))
        change = records.curved_gap - records.geometric_gap
        overlap = -change - np.maximum(solution.remaining_gap, 0.0)
        change = np.where(solution.force > 0.0, np.abs(change), overlap)
        pressure = solution.force / records.area
        for i, contact in enumerate(solution.contacts):
            own = records.contact == i
            largest = comm.allreduce(float(pressure[own].max(initial=0.0)), op=MPI.MAX)
            own &= shown & (change > np.maximum(FACETS * largest * gives, 0.0))
            columns = change, gives, records.curved_gap
            most = np.array([column[own].max(initial=-np.inf) for column in columns])
            comm.Allreduce(MPI.IN_PLACE, most, op=MPI.MAX)
            if most[0] > 0.0:
                yield (
                    f"{contact.name}: facets are straight where the surfaces are curved, and "
                    f"change the gap, at most {most[2]:.2g} there, by up to {most[0]:.2g}, where "
                    f"the largest pressure presses elements together by {largest * most[1]:.2g}; "
                    'expected gap="curved", a mesh of degree 2, or smaller facets'
                )

    def _points(self, subdomains: Subdomains) -> Array:
        """Return points of this rank's primal nodes, from the middle of their subdomains on."""
        gdim, bs = self._decomposition.mesh.geometry.dim, self._dofs.bs
        x = self._dofs.V.tabulate_dof_coordinates()[self._dofs.dolfinx_node, :gdim]
        for part in subdomains.dof_parts:
            rows = slice(part.start // bs, part.stop // bs)
            x[rows] -= x[rows].mean(axis=0)
        return np.asarray(x)

    def _names(self, which: Array) -> str:
        """Return names of bodies, the first ones if they are many; the same on all ranks."""
        names = self._decomposition.body_names
        some = bcast_from_root(self._dofs.comm, np.flatnonzero(which))
        listed = ", ".join(names[body] for body in some[:LISTED])
        rest = len(some) - LISTED
        return f"{listed} and {rest} more" if rest > 0 else listed


def note_estimates(report: Report, numbers: dict[str, float]) -> None:
    """Give a report estimates that were made since, and a warning where they say nothing.

    Args:
        report: That of the solve.
        numbers: What ``Estimates.numbers`` gives.
    """
    report.warnings = [text for text in report.warnings if not text.startswith(ESTIMATES)]
    report.estimates = numbers
    report.warnings += _of_estimates(report)


def _of_estimates(report: Report) -> Iterator[str]:
    """A bound of the algebraic error that no displacement of this size can miss."""
    energy, bound = (report.estimates.get(key, 0.0) for key in ("energy", "algebraic"))
    if bound > energy:
        share = f"{bound / energy:.0e} times" if energy and np.isfinite(bound) else "far beyond"
        yield (
            f"{ESTIMATES}: the bound of the algebraic error is {share} the energy norm of the "
            "displacement, so it says nothing of it: forces, which it is made of, are lost in "
            "rounding, or do not balance the load; residuals['displacement_error'] estimates the "
            "error of the displacement itself"
        )


def _loose(report: Report) -> Iterator[str]:
    """Motions that are not determined, or hardly."""
    if report.free_modes:
        yield (
            f"{report.free_modes} rigid motions are free: nothing resists or drives them, the "
            "smallest displacement was taken"
        )
    for motion in report.nearly_free[:LISTED]:
        bodies, mode, held = (motion[key] for key in ("bodies", "mode", "stiffness"))
        assert isinstance(bodies, list)
        share = f"hold hardly ({held:.0e} of what they could)" if held else "do not hold"
        yield f"{', '.join(bodies)}: contacts with a force {share} {mode}; the smallest was taken"
    if (rest := len(report.nearly_free) - LISTED) > 0:
        yield f"{rest} more motions are held hardly or not by contacts with a force"
