"""Errors of a solution: their estimates, and the warnings of the report."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import nan
from time import perf_counter
from typing import Any
from weakref import ref

import basix
import numpy as np
from dolfinx import fem
from dolfinx import mesh as dmesh

from tfeti_dolfinx.common.arrays import EPSILON, TINY, Array, joined, sum_rows, sums
from tfeti_dolfinx.common.compat import geometry_degree, geometry_dofmap
from tfeti_dolfinx.common.parallel import (
    Exchange,
    any_rank,
    bcast_from_root,
    count_over,
    largest,
    maxima,
    steering,
    summed,
)
from tfeti_dolfinx.contact.partner import GEOMETRY
from tfeti_dolfinx.contact.records import relative_displacement
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.duality_gap import energy_bound
from tfeti_dolfinx.feti.stopping import ErrorTarget
from tfeti_dolfinx.forms.fields import Stress, StressRecovery, checked_stress
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.untorn import cell_entities, facet_points
from tfeti_dolfinx.mortar.facets import create_element
from tfeti_dolfinx.mortar.tolerances import SEARCH
from tfeti_dolfinx.report import Outcome
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock, stretch_over_shear
from tfeti_dolfinx.subdomains.subdomains import Subdomains
from tfeti_dolfinx.system import System

# --- Estimates of the algebraic and the discretisation error ----------------------------------


@dataclass(frozen=True)
class Estimates:
    """Errors of a solution in the energy norm ‖u‖_K = √(uᵀKu); the same on all ranks.

    Attributes:
        energy: ‖u‖_K, a root of an energy.
        algebraic: Bound of ‖u − u*‖_K, u* the exact solution of the discrete problem: its
            constraints, and the last bounds of friction. Infinite where no forces balance the load.
        discretisation: Estimate of ‖u* − ū‖_K, ū the exact solution of the continuous problem;
            None if the problem was given no stress. ``Solution.discretisation_error`` has its
            parts.
        rounding: What rounding leaves of ‖u‖_K where bodies move and do not deform.
        factorizations: Subdomain matrices factored for it.
        lifting_multiplications: Applications of S, the Schur complements.
        recoveries: Displacements recovered, each for one more solve in every subdomain.
        seconds: Wall seconds of this rank.
    """

    energy: float
    algebraic: float
    discretisation: float | None
    rounding: float
    factorizations: int
    lifting_multiplications: int
    recoveries: int
    seconds: float

    @property
    def relative_algebraic(self) -> float:
        """The bound over ‖u‖_K."""
        return self.algebraic / max(self.energy, TINY)

    @property
    def relative_discretisation(self) -> float:
        """The estimate over ‖u‖_K; nan if the problem was given no stress."""
        return (nan if self.discretisation is None else self.discretisation) / max(
            self.energy, TINY
        )


def estimate(
    system: System[Any], solution: Solution, rounding: float, outcome: Outcome
) -> Estimates:
    """Estimate the errors of the last solution, ‖u‖_K of which may be rounding. Collective.

    Its outcome has them then, too, with a warning where they are of no use.
    """
    if solution.gluing.constraints.B is not system.gluing.constraints.B:
        raise InputError(
            "estimate: the constraints are not those of the solution; expected a call after solve()"
        )
    dual, u = system.dual, system.subdomains.with_rigid(solution.u)
    comm, factory, start = dual.coarse.comm, system.factory, perf_counter()
    factored = factory.factorizations
    bound, moved = energy_bound(dual, solution.lam, u, dual.norm)
    squares = [float(sum(dual.subdomains.energies(u))), 0.0]
    if solution.has_stress:
        squares[1] = float(np.sum(solution.discretisation_error.x.array**2))
    sizes = np.sqrt(np.maximum(summed(comm, np.array(squares)), 0.0))
    energy, discretisation = steering(comm, *sizes)
    found = Estimates(
        energy=float(energy),
        algebraic=bound,
        discretisation=float(discretisation) if solution.has_stress else None,
        rounding=rounding,
        factorizations=count_over(comm, factory.factorizations - factored),
        lifting_multiplications=1,
        recoveries=int(moved > 0.0),
        seconds=perf_counter() - start,
    )
    outcome.estimates = {name: x for name, x in vars(found).items() if x is not None}
    kept = [text for text in outcome.warnings if not text.startswith(ESTIMATES)]
    outcome.warnings = [*kept, *of_estimates(outcome)]
    return found


def goal_of(stress: Stress, dofs: TornDofs, thickness: Any) -> ErrorTarget:
    """From displacements in primal order to their discretisation error. Collective."""
    u = fem.Function(dofs.V)
    recovery = StressRecovery(u, checked_stress(stress, u), dofs, thickness)

    def error(values: Array) -> float:  # of all bodies, a root of an energy
        u.x.array[:] = dofs.to_dolfinx(values[: dofs.num_nodes * dofs.bs])
        total = summed(dofs.comm, np.array([recovery.squares().sum()]))
        return float(steering(dofs.comm, *np.sqrt(total))[0])

    return error


# --- Warnings ---------------------------------------------------------------------------------


def flatness(mesh: dmesh.Mesh) -> Array:
    """‖J‖‖J⁻¹‖/gdim of each local cell, in Frobenius norms: 1 for a reference cell, shape ``(c,)``.

    J is the map from the reference cell, in its middle. A box whose longest edge is a times its
    shortest has about a/2; cells without volume have as much as a float can be.
    """
    cell_type = mesh.topology.cell_type
    cell = getattr(basix.CellType, cell_type.name)
    corners = geometry_dofmap(mesh)[:, : len(cell_entities(cell_type, 0))]
    gdim = mesh.geometry.dim
    element = create_element(basix.ElementFamily.P, cell, 1)
    middle = basix.geometry(cell).mean(axis=0)[None]
    slopes = element.tabulate(1, middle)[1:, 0, :, 0]
    J = np.moveaxis(mesh.geometry.x.T[:gdim, corners] @ slopes.T, 2, 1).copy()  # cells come last
    # J⁻¹ is the adjugate over the determinant, turned
    if gdim == 2:
        adjugate = J[::-1, ::-1] * [[[1.0], [-1.0]], [[-1.0], [1.0]]]
    else:
        adjugate = np.cross(J[[1, 2, 0]], J[[2, 0, 1]], axis=1)
    volume = np.abs((J[0] * adjugate[0]).sum(axis=0))
    sizes = np.sqrt((J**2).sum(axis=(0, 1)) * (adjugate**2).sum(axis=(0, 1)))
    return np.asarray(sizes / np.maximum(gdim * volume, TINY * sizes))


ESTIMATES = "estimates"  # how the sentence on them begins


@dataclass(frozen=True)
class WarningLimits:
    """Limits from which on the report warns."""

    # errors of beams and strips that are 10⁴ times as long as thick, over the estimate of rounding:
    # 10 to 50 were seen
    rounding: float = 30.0
    flat: float = 500.0  # ‖J‖‖J⁻¹‖/gdim of a cell that is about 1000 times as long as thick
    # (λ + 2μ)/μ, 20 of ν = 0.474, from which on linear displacements are too stiff: errors of
    # forces are ten times those of ν = 0.3. Of ν = 0.49 it is 51, of rubber pressed by 40 % 26
    locks: float = 20.0
    resists: float = 0.01  # of a body's energy, that by which curved cells resist to turn
    turns: float = 0.1  # radians; what linear kinematics takes for strain is half the square, 0.5 %
    # of what the largest pressure presses together: gaps that straight facets change by as much had
    # forces and pressures wrong by 4 to 10 %
    facets: float = 0.5
    # a pressure that is not believed over the largest of other nodes; at edges they differ by less
    stands_out: float = 2.0
    # a gap below 0 that a mesh has, over the largest displacement: forces follow from it then
    overlaps: float = 0.1
    # of the largest displacement: how far an edge in a corner may move there, or be apart at first
    corners: float = 0.01
    listed: int = 3  # bodies that a sentence names


LIMITS = WarningLimits()


class Diagnostics:
    """Diagnostics of solutions beyond residuals; a solution seen before is not examined again.

    ``may_lock``: displacements have degree 1, and the law is not selective; ``flowing_cells``:
    from laws, those of this rank in which plastic flow is most of the strain.
    """

    def __init__(self, dofs: TornDofs) -> None:
        self._decomposition, self._dofs = dofs.decomposition, dofs
        self.may_lock = dofs.V.element.basix_element.degree == 1
        self.flowing_cells: list[Callable[[], Array]] = []
        self._of: ref[Dual] | None = None  # one that is out of date goes, with its factors
        self._lasting: list[str] = []
        self._locks = np.zeros(0, dtype=bool)  # which bodies lock whatever flows
        self._slopes: list[Array] = []

    def found(
        self, dual: Dual, solution: Solution, outcome: Outcome, energy: Array, rtol: float
    ) -> list[str]:
        """Sentences, each of which names the thing, from uᵀKu of each body, too. Collective."""
        if self._of is None or self._of() is not dual:
            nodes = self._points(dual.subdomains)
            lasting = (self._cells, self._locking(dual.subdomains, nodes), self._hinges)
            self._lasting, self._of = [text for texts in lasting for text in texts], ref(dual)
            # mean slopes of a displacement of each subdomain, (gdim, nodes)
            gdim = self._decomposition.mesh.geometry.dim
            grams = np.reshape([x.T @ x for x in nodes], (-1, gdim, gdim))
            inverse = np.linalg.pinv(grams, EPSILON * np.array([len(x) for x in nodes]), True)
            self._slopes = [A @ x.T for A, x in zip(inverse, nodes, strict=True)]
        u = solution.u
        return [
            *_loose(outcome),
            *self._rounding(dual, u, energy, rtol),
            *([] if solution.finite else self._turned(u, dual.subdomains)),
            *self._facets(solution, dual.subdomains),
            *_corners(solution),
            *self._lasting,
            *self._flow(),
            *of_estimates(outcome),
        ]

    @cached_property
    def _cells(self) -> list[str]:
        """Cells that are far from regular."""
        worst = largest(self._dofs.comm, flatness(self._decomposition.mesh))
        if worst <= LIMITS.flat:
            return []
        return [
            f"cells: the flattest is about {2.0 * worst:.0e} times as long as thick; forces "
            "and iterations suffer from more than 10"
        ]

    @cached_property
    def _hinges(self) -> list[str]:
        """Bodies that a mesh joins in nodes alone."""
        d, names = self._decomposition, self._decomposition.body_names
        if d.num_bodies == 1:
            return []
        body = np.zeros(len(d.original_nodes), dtype=np.int64)
        body[geometry_dofmap(d.mesh)] = d.body_of_subdomain[d.cell_subdomain][:, None]
        node = np.unique(facet_points(d.mesh, d.boundary))
        ids = d.original_nodes[node].astype(np.int64)
        exchange = Exchange(d.comm, ids % d.comm.size)
        met = np.stack((exchange.send(ids), exchange.send(body[node])), axis=1)
        met = np.unique(met, axis=0)
        same = met[1:, 0] == met[:-1, 0]
        local = np.stack((met[:-1, 1], met[1:, 1]), axis=1)[same]
        own, own_counts = np.unique(local, axis=0, return_counts=True)  # few, however many nodes
        shared = Counter[tuple[int, int]]()
        for pairs, counts in d.comm.allgather((own.tolist(), own_counts.tolist())):
            shared.update(dict(zip(map(tuple, pairs), counts, strict=True)))
        return [
            f"{names[a]}, {names[b]}: the mesh joins them in nodes alone ({count}), in no facet: "
            "they are bodies of their own, and not joined; expected a common facet"
            for (a, b), count in sorted(shared.items())
        ]

    def _locking(self, subdomains: Subdomains, nodes: Sequence[Array]) -> Iterator[str]:
        """Displacements of degree 1 where a material hardly changes its volume."""
        if not self.may_lock:
            return
        ratios = [
            block.stiffness.stretch_over_shear
            if isinstance(block, SparseBlock)
            else stretch_over_shear(x, self._dofs.bs, block.multiply)
            for block, x in zip(subdomains.elastic, nodes, strict=True)
        ]
        worst = subdomains.of_bodies([ratios], largest=True)[0]
        self._locks = worst > LIMITS.locks
        if np.any(self._locks):
            t = float(worst.max())
            yield (
                f"{self._names(self._locks)}: Poisson's ratio of its stiffness is about "
                f"{(t - 2.0) / (2.0 * t - 2.0):.4g} and displacements have degree 1, which makes "
                "it too stiff (locking) unless its law is selective; expected degree 2"
            )

    def _flow(self) -> Iterator[str]:
        """Displacements of degree 1 where plastic flow keeps the volume."""
        if not (self.may_lock and self.flowing_cells):
            return
        d, cells = self._decomposition, np.concatenate([of() for of in self.flowing_cells])
        own = np.zeros(d.num_bodies)
        own[d.body_of_subdomain[d.cell_subdomain[cells]]] = 1.0
        if np.any(flows := maxima(d.comm, own) > self._locks[: d.num_bodies]):
            yield (
                f"{self._names(flows)}: plastic flow keeps the volume, and displacements have "
                "degree 1, which makes it too stiff (locking); expected degree 2, or selective=True"
                " on quadrilaterals or hexahedra"
            )

    def _rounding(self, dual: Dual, u: Array, energy: Array, rtol: float) -> Iterator[str]:
        """Warn of slender bodies, whose small bending energy is inexact by the rounding of K.

        That of uᵀKu is about ε uᵀDu, D the diagonal, of u less the rigid motion of the body.
        """
        subdomains = dual.subdomains
        u = subdomains.with_rigid(u)
        bent = dual.coarse.bodies.elastic(u)
        diagonal = joined([block.diagonal for block in subdomains.blocks])
        parts = subdomains.dof_parts
        squares = [sums(diagonal * of**2, parts) for of in (bent, u)]
        terms, moved = subdomains.of_bodies(squares)
        # that of a body which only moves is rounding
        known = energy > EPSILON * np.maximum(energy, EPSILON * moved).max(initial=0.0)
        share = np.divide(terms, energy, out=np.zeros_like(terms), where=known)
        share *= LIMITS.rounding * EPSILON
        if np.any(share > rtol):
            yield (
                f"{self._names(share > rtol)}: rounding of the stiffness may change the "
                f"displacement by about {share.max():.0e} of its size, more than rtol {rtol:g}; "
                "expected thicker parts, fewer cells, or a larger rtol"
            )

    def _turned(self, u: Array, subdomains: Subdomains) -> Iterator[str]:
        """Bodies that turn farther than linear kinematics bears."""
        bs = self._dofs.bs
        if bs != self._decomposition.mesh.geometry.dim or bs == 1:
            return
        turns = []
        for (_, part), slope_of in zip(subdomains.elastic_parts, self._slopes, strict=True):
            slope = slope_of @ u[part].reshape(-1, bs)
            turns.append((slope - slope.T) / 2.0)
        yield from self._resisting(u, subdomains, turns)
        angles = [float(np.linalg.norm(turn)) / 2.0**0.5 for turn in turns]
        worst = subdomains.of_bodies([angles], largest=True)[0]
        turned = worst > LIMITS.turns
        if np.any(turned):
            yield (
                f"{self._names(turned)}: parts turn by up to {worst.max():.2g} radians; "
                "linear kinematics takes half the square of that for strain: expected smaller "
                "loads, or finite strain"
            )

    def _resisting(self, u: Array, subdomains: Subdomains, turns: Sequence[Array]) -> Iterator[str]:
        """Bodies whose curved cells resist mean turns of subdomains, shapes ``(gdim, gdim)``."""
        mesh, degree = self._decomposition.mesh, self._dofs.V.element.basix_element.degree
        if geometry_degree(mesh) <= degree or self._dofs.axisymmetric:
            return
        turned, points = np.zeros_like(u), self._points(subdomains)
        for (_, part), x, turn in zip(subdomains.elastic_parts, points, turns, strict=True):
            turned[part] = (x @ turn).ravel()
        each = [subdomains.energies(subdomains.with_rigid(of)) for of in (u, turned)]
        energy, resists = subdomains.of_bodies(each)
        stiff = resists > LIMITS.resists * energy
        if np.any(stiff):
            yield (
                f"{self._names(stiff)}: cells are curved and displacements have degree "
                f"{degree}, in which curved cells cannot turn without strain: that is up to "
                f"{(resists[stiff] / energy[stiff]).max():.1g} of the energy; expected "
                f"displacements of degree {geometry_degree(mesh)}, or a mesh of degree {degree}"
            )

    def _facets(self, solution: Solution, subdomains: Subdomains) -> Iterator[str]:
        """Pairs of surfaces so alike that their straight facets decide where they meet.

        What facets change of a gap counts beside the distance by which the largest pressure presses
        a node and what it meets into their surroundings, its force times Σ_j w_ij²/K_jj.
        """
        records, comm = solution.gluing.records, self._dofs.comm
        flat = np.array([contact.gap == GEOMETRY for contact in solution.contacts])
        if not np.any(flat):
            return
        shown = records.conforms & flat[records.contact]
        if not any_rank(comm, shown):
            return
        diagonal = joined([block.diagonal for block in subdomains.elastic])
        K = self._dofs.reduce(diagonal.reshape(-1, self._dofs.bs).mean(axis=1), np.add)
        (K,) = self._dofs.lookup(records.entry_group, K)
        gives = solution.area * sum_rows(records.condition, records.weight**2 / K, len(records))
        change = records.curved_gap - records.geometric_gap
        overlap = -change - np.maximum(solution.remaining_gap, 0.0)
        change = np.where(solution.force > 0.0, np.abs(change), overlap)
        peaks, _ = solution.largest_pressures
        for i, contact in enumerate(solution.contacts):
            own = shown & (records.contact == i)
            own &= change > np.maximum(LIMITS.facets * peaks[i] * gives, 0.0)
            columns = change, gives, records.curved_gap
            most = maxima(comm, np.array([c[own].max(initial=-np.inf) for c in columns]))
            if most[0] > 0.0:
                yield (
                    f"{contact.name}: facets are straight where the surfaces are curved, and "
                    f"change the gap, at most {most[2]:.2g} there, by up to {most[0]:.2g}, where "
                    f"the largest pressure presses elements together by {peaks[i] * most[1]:.2g}; "
                    'expected gap="curved", mesh and displacements of degree 2, or smaller facets'
                )

    def _points(self, subdomains: Subdomains) -> list[Array]:
        """Return points of each subdomain's nodes on this rank, from their middle on."""
        gdim, bs = self._decomposition.mesh.geometry.dim, self._dofs.bs
        x = self._dofs.points()[:, :gdim]
        parts = [x[p.start // bs : p.stop // bs] for _, p in subdomains.elastic_parts]
        return [own - own.mean(axis=0) for own in parts]

    def _names(self, which: Array) -> str:
        """Return names of bodies, the first ones if they are many; the same on all ranks."""
        names = self._decomposition.body_names
        some = bcast_from_root(self._dofs.comm, np.flatnonzero(which))
        listed = ", ".join(names[body] for body in some[: LIMITS.listed])
        rest = len(some) - LIMITS.listed
        return f"{listed} and {rest} more" if rest > 0 else listed


def of_estimates(outcome: Outcome) -> Iterator[str]:
    """A bound of the algebraic error that no displacement of this size can miss."""
    keys = ("energy", "algebraic", "rounding")
    energy, bound, rounding = (outcome.estimates.get(key, 0.0) for key in keys)
    if bound > max(energy, rounding):
        share = f"{bound / energy:.0e} times" if energy and np.isfinite(bound) else "far beyond"
        yield (
            f"{ESTIMATES}: the bound of the algebraic error is {share} the energy norm of the "
            "displacement, so it says nothing of it: forces, which it is made of, are lost in "
            "rounding, or do not balance the load; residuals['displacement_error'] estimates the "
            "error of the displacement itself"
        )


def _loose(outcome: Outcome) -> Iterator[str]:
    """Motions that contacts constrain weakly."""
    weak = [motion for motion in outcome.nearly_free if motion["stiffness"]]
    for motion in weak[: LIMITS.listed]:
        yield (
            f"{', '.join(motion['bodies'])}: active contacts constrain {motion['mode']} weakly "
            f"({motion['stiffness']:.0e} of what they could): the displacement along it is poorly "
            "determined; add friction, a spring or a Dirichlet condition if it matters"
        )
    if (rest := len(weak) - LIMITS.listed) > 0:
        yield f"{rest} more motions are weakly constrained by active contacts"


def _corners(solution: Solution) -> Iterator[str]:
    """Pairs with edges in corners, whose nodes have one condition for two sides. Collective.

    It is as good as two where a node has met both sides from the start, and moves along neither.
    """
    records, comm = solution.gluing.records, solution.dofs.comm
    if not any_rank(comm, records.corner):
        return
    v = relative_displacement(records, solution.dofs, solution.u)
    moved = np.maximum(np.linalg.norm(v, axis=1), np.abs(records.gap))
    far = records.corner & (moved > LIMITS.corners * largest(comm, solution.u))
    counts = np.bincount(records.contact[far], minlength=len(solution.contacts))
    for i in np.flatnonzero(summed(comm, counts)):
        name, (a, b) = solution.contacts[i].name, solution.contacts[i].surfaces
        yield (
            f"{name}: an edge of {a!r} is in a corner of {b!r}, and is stopped in one direction "
            "alone; expected a pair for each side of the corner, with names of their own"
        )


def notes_of(outcome: Outcome, solution: Solution) -> list[str]:
    """Return what is worth knowing of an answer, whose displacement is right. Collective."""
    found = list[str]()
    if outcome.contacts and not any(contact.touching for contact in outcome.contacts):
        gaps = [contact.gap for contact in outcome.contacts if contact.nodes]
        nearest = f" (smallest gap {min(gaps):.2g})" if gaps else ""
        # given bounds of friction act all the same
        acts = any_rank(solution.dofs.comm, solution.condition_forces)
        says = (
            "forces act across open gaps" if acts else "the displacement is that without contacts"
        )
        found.append(f"no contact touches{nearest}: {says}")
    return [*found, *_hardly_covered(solution), *_overlapping(solution), *_free(outcome)]


def _hardly_covered(solution: Solution) -> Iterator[str]:
    """Pairs with large pressures on slivers, whose ∫φ_i are small against forces. Collective."""
    most, others = solution.largest_pressures
    for i in np.flatnonzero(others > LIMITS.stands_out * most):
        yield (
            f"{solution.contacts[i].name}: pressures go up to {others[i]:.3g} at nodes of which "
            f"the other side covers less than {SEARCH.believed:.0%}, elsewhere they are at most "
            f"{most[i]:.3g}; forces are right, pressures of such nodes are not: "
            "expected the other side as the secondary one, or a node where the other side ends"
        )


def _overlapping(solution: Solution) -> Iterator[str]:
    """Pairs that press on each other since they overlap as they are meshed. Collective."""
    records, comm, contacts = solution.gluing.records, solution.dofs.comm, solution.contacts
    pairs = [len(c.surfaces) == 2 and isinstance(c.gap, str) for c in contacts]
    if solution.finite or not any(pairs):
        return
    depth = np.zeros(len(contacts))
    np.maximum.at(depth, records.contact, np.where(solution.force > 0.0, -records.gap, 0.0))
    depth = maxima(comm, depth)
    for i in np.flatnonzero(pairs & (depth > LIMITS.overlaps * largest(comm, solution.u))):
        yield (
            f"{contacts[i].name}: the surfaces overlap by up to {depth[i]:.2g} as they are meshed, "
            "and are pressed apart; where no interference is meant: expected smaller facets, "
            "mesh and displacements of degree 2, or gap= with the clearance"
        )


def _free(outcome: Outcome) -> list[str]:
    """Motions that are free."""
    loose = [motion for motion in outcome.nearly_free if not motion["stiffness"]]
    if not loose and not outcome.free_modes:
        return []
    some = "; ".join(f"{', '.join(m['bodies'])}: {m['mode']}" for m in loose[: LIMITS.listed])
    listed = f" ({some}{'; …' if len(loose) > LIMITS.listed else ''})" if some else ""
    if len(loose) > outcome.free_modes:
        return [
            f"active contacts do not hold {len(loose)} rigid motions{listed}: displacements "
            "that differ by them are as right"
        ]
    are, them = ("s are", "them") if outcome.free_modes > 1 else (" is", "it")
    return [
        f"{outcome.free_modes} rigid motion{are} free{listed}: nothing resists or drives {them}, "
        "the displacement nearest to that where the load step began was taken"
    ]
