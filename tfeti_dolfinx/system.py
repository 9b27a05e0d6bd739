"""The parts of a solve, made in stages that are kept until their input changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.logging import stage
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.constraints.gluing import Gluing, Prescribed, glue, prescribe
from tfeti_dolfinx.constraints.rows import row_weights
from tfeti_dolfinx.contact.forces import condition_areas
from tfeti_dolfinx.contact.partner import ContactPartner, Gap
from tfeti_dolfinx.contact.records import ContactRecords, slips
from tfeti_dolfinx.contact.search import ContactSearch
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.extensions import Settings
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.forms.assembly import Forms
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.report import Report, fill_sizes
from tfeti_dolfinx.subdomains.block import Counters
from tfeti_dolfinx.subdomains.build import (
    FiniteElements,
    SubdomainMethod,
    make_subdomains,
    subdomain_data,
)
from tfeti_dolfinx.subdomains.factor import added_options
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# --- Stages and their dependencies ------------------------------------------------------------

T = TypeVar("T")

# in the order in which they are made, with the name that their seconds have in the report
STAGES = {
    "stiffness": "assembly",
    "search": "contact",
    "rows": "gluing",
    "right side": "gluing",
    "friction": "gluing",
    "load": "assembly",
    "factors": "subdomains",
    "trace": "subdomains",
    "coarse problem": "dual",
    "linear term": "dual",
}
# what has to be made anew where something has changed
CHANGES = {
    "points": tuple(STAGES),
    "stiffness": ("stiffness", "rows", "friction", "factors", "trace", "coarse problem"),
    "rows": ("rows", "friction", "trace", "coarse problem"),
    "right side": ("right side", "linear term"),
    "friction": ("friction", "linear term"),
    "load": ("load", "linear term"),
}
# what comes with a stage
BRINGS = {"rows": "right side", "factors": "trace", "coarse problem": "linear term"}


class Stages:
    """Stages of a solve: those that are out of date, and those made.

    Attributes:
        made: How often each stage was made since the counts were last taken.
    """

    def __init__(self) -> None:
        self.made: Counter[str] = Counter()
        self._stale = set(STAGES)

    def change(self, what: str) -> None:
        """Something has changed: a key of ``CHANGES``."""
        self._stale |= set(CHANGES[what])

    def is_stale(self, name: str) -> bool:
        """Return whether a stage is out of date."""
        return name in self._stale

    def stale(self) -> Iterator[str]:
        """Stages that are out of date, in order; each is up to date when the next is asked for.

        Where the loop is left, as by an error, the stage that was being made stays out of date.
        """
        for name in STAGES:
            if name in self._stale:
                yield name
                self._stale -= {name, BRINGS.get(name, name)}
                self.made[name] += 1

    def forget(self) -> None:
        """All stages are out of date."""
        self._stale = set(STAGES)

    def take_counts(self) -> tuple[Counter[str], list[str]]:
        """Return how often stages were made since the last call, and those that were up to date."""
        made, self.made = self.made, Counter()
        new = {*made, *(BRINGS.get(name) for name in made), *self._stale}
        return made, [name for name in STAGES if name not in new]


def made(item: T | None) -> T:
    """Return a stage's result, or raise if it has not been made."""
    if item is None:
        raise InputError("nothing has been made yet; expected a call of solve() before")
    return item


# --- Friction limits and reference of slips ---------------------------------------------------


class FrictionBounds:
    """Bounds of tangential forces from laws of friction. All methods are collective.

    Args:
        contacts: Obstacles and pairs; without friction nothing is done.
        dofs: Dof maps.
        decomposition: The torn mesh.
        thickness: What areas of the mesh are multiplied with, a number or a scalar in UFL.

    Attributes:
        exists: Whether a contact has friction.
        rest: Displacement at which the load step begins, in primal order; None: no displacement.
        known: The conditions of the step before with their slips at its end, where that is
            ``rest``; they count as long as conditions stay the same.
    """

    def __init__(
        self,
        contacts: Sequence[ContactPartner],
        dofs: TornDofs,
        decomposition: Decomposition,
        thickness: Any,
    ) -> None:
        self._dofs, self._decomposition, self._thickness = dofs, decomposition, thickness
        self._known: Array | None = None
        self.exists = any(contact.friction is not None for contact in contacts)
        self.rest: Array | None = None
        self.known: tuple[ContactRecords, Array] | None = None

    def begin(self, rest: Array, known: tuple[ContactRecords, Array] | None = None) -> None:
        """Let a load step begin at a displacement. Not collective."""
        self.rest, self.known = rest, known

    def slip(self, search: ContactSearch) -> Array:
        """Tangential v_i of all conditions where the load step begins, shape ``(n, gdim - 1)``."""
        records = search.records
        if self.rest is None:
            return np.zeros(records.tangents.shape[:2])
        if self.known is not None:
            before, slip = self.known
            if not any_rank(self._dofs.comm, not records.slips_as(before)):
                return slip
        return slips(records, self._dofs, self.rest)

    def has_changed(self, search: ContactSearch) -> bool:
        """Return whether laws have changed since the limits were last set.

        Raises:
            InputError: A value is negative or no number somewhere.
        """
        if not self.exists or self._known is None:
            return False
        return any_rank(self._dofs.comm, not np.array_equal(search.friction(), self._known))

    def set_limits(self, gluing: Gluing, search: ContactSearch) -> None:
        """Fill the ψ_i of the rows, and the μ_i under Coulomb's law.

        Raises:
            InputError: A value is negative or no number somewhere.
        """
        if not self.exists:
            return
        contacts = search.contacts
        surfaces = [contact.surfaces[0] for contact in contacts]
        of, thickness = self._decomposition, self._thickness
        area = condition_areas(gluing.records, self._dofs, of, surfaces, thickness)
        self._known = search.friction()
        gluing.constraints.set_limits(gluing.tangents.limits(self._known, area))
        gluing.constraints.coefficients[:] = gluing.tangents.coefficients(self._known)


# --- From forms to the dual problem -----------------------------------------------------------


class System:
    """Parts of a scene's dual problem. Creation and all methods are collective.

    Args:
        forms: The compiled forms.
        bcs: Dirichlet conditions.
        contacts: Obstacles and pairs.
        dofs: Dof maps.
        decomposition: The torn mesh.
        settings: How to solve.
        method: What takes the place of finite elements, say boundary elements.

    Attributes:
        forms: The compiled forms.
        bcs: Dirichlet conditions.
        friction: What bounds tangential forces.
        elements: Stiffness and load of subdomains.
        origin: Displacement in primal order at which the mesh is, in finite strain; else None.
    """

    def __init__(
        self,
        forms: Forms,
        bcs: Sequence[fem.DirichletBC],
        contacts: list[ContactPartner],
        dofs: TornDofs,
        decomposition: Decomposition,
        settings: Settings,
        method: SubdomainMethod | None = None,
    ) -> None:
        self.forms, self.bcs, self._contacts = forms, bcs, contacts
        self._dofs, self._decomposition, self._settings = dofs, decomposition, settings
        self.friction = FrictionBounds(contacts, dofs, decomposition, forms.thickness)
        self.elements = (
            FiniteElements(dofs) if method is None else method.assembly(dofs, decomposition)
        )
        self._stages, self._counters, self._counted = Stages(), Counters(), 0
        self.origin: Array | None = None
        self._seen = 0.0  # of ‖F‖, which more rows hardly change
        self._K: Any = None
        self._search: ContactSearch | None = None
        self._known_rows: tuple[Sequence[float], Sequence[Array]] | None = None
        self._prescribed: Prescribed | None = None
        self._gluing: Gluing | None = None
        self._subdomains: Subdomains | None = None
        self._dual: Dual | None = None

    @property
    def search(self) -> ContactSearch:
        """The contacts' conditions."""
        return made(self._search)

    @property
    def gluing(self) -> Gluing:
        """Rows, and the records that they come from."""
        return made(self._gluing)

    @property
    def dual(self) -> Dual:
        """The dual problem."""
        return made(self._dual)

    @property
    def subdomains(self) -> Subdomains:
        """The subdomains with their factors."""
        return made(self._subdomains)

    def look_for_changes(self) -> None:
        """See whether the mesh, or what forms and Dirichlet conditions refer to, has changed.

        Raises:
            InputError: Dirichlet conditions contradict each other.
        """
        if self.forms.has_new_points():
            self.change("points")
        if self.forms.has_new_stiffness():
            self.change("stiffness")
        if self.forms.has_new_load():
            self.change("load")
        new, old = prescribe(self._dofs, self.bcs), self._prescribed
        self._prescribed = new
        if old is None or any_rank(self._dofs.comm, not np.array_equal(new.flag, old.flag)):
            self.change("rows")
        elif any_rank(self._dofs.comm, not np.array_equal(new.value, old.value)):
            self.change("right side")
        if self._search is not None and self.friction.has_changed(self._search):
            self.change("friction")

    def change(self, what: str) -> None:
        """Say that something has changed, a key of ``CHANGES``; what is out of date is freed."""
        self._stages.change(what)
        if self._stages.is_stale("coarse problem"):
            self._destroy_dual()
        if self._stages.is_stale("factors"):
            self._destroy_subdomains()

    def set_gaps(self, gaps: Mapping[int, Gap]) -> None:
        """Give contacts, by position, another ``gap=``; their conditions stay, but for their gaps.

        Raises:
            InputError: A gap does not fit, or overlaps too deep. Nothing has changed.
        """
        contacts = {i: self._contacts[i].with_gap(gap) for i, gap in gaps.items()}
        if self._search is not None:
            self._search.set_gaps(gaps)
        for i, contact in contacts.items():
            self._contacts[i] = contact
        self.change("right side")

    def make(self, report: Report) -> Dual:
        """Make what is out of date; the dual problem.

        Args:
            report: Takes seconds and sizes.

        Raises:
            InputError: Dirichlet values, contacts, stiffness or load do not fit.
            NoSolutionError: The problem has no solution.
            FactorError: A matrix could not be factored.
        """
        for name in self._stages.stale():
            with stage(STAGES[name], report.seconds):
                MAKERS[name](self)
        return self.dual

    def count(self, report: Report) -> None:
        """Enter sizes and the stages made since the last call in a report."""
        if self._gluing is not None:
            inside = self.elements.inside()
            fill_sizes(report, self._dofs, self._decomposition, self._gluing, inside)
            report.unmet_contacts = self.search.unmet()
        made, report.reused = self._stages.take_counts()
        report.assemblies, report.searches = made["stiffness"], made["search"]
        report.gluings = made["rows"]
        has_kernel = self._dual is None or self._dual.coarse.dimension > 0
        report.coarse_factorizations = made["coarse problem"] if has_kernel else 0
        factored = self._counters.factorizations
        report.factorizations = self._dofs.comm.allreduce(factored - self._counted)
        self._counted = factored

    def count_slips_from(self, u: Array, known: tuple[ContactRecords, Array]) -> None:
        """Let slips count from a displacement in primal order, with those of its conditions."""
        self.friction.begin(u, known)
        if self.friction.exists:
            self.change("right side")
        elif self._gluing is not None:
            self._gluing = replace(self._gluing, slip=self.friction.slip(self.search))

    def know_rows(self, reach: Sequence[float], groups: Sequence[Array]) -> None:
        """Let the next search end with the rows that an earlier one of the scene had."""
        self._known_rows = (reach, groups)
        self.change("points")

    def destroy(self) -> None:
        """Destroy the PETSc objects; all stages are out of date."""
        self._destroy_dual()
        self._destroy_subdomains()
        if self._gluing is not None:
            self._gluing.constraints.destroy()
        self._gluing = None
        self._stages.forget()

    def _assemble_stiffness(self) -> None:
        K = self.forms.stiffness()
        self._blocks = self.elements.node_blocks(K, self._settings.making(self._counters))
        self._K = K
        if self.elements.replaces:  # the load that a force per volume makes depends on S
            self.change("load")

    def _find_contacts(self) -> None:
        dofs, cut = self._dofs, self._decomposition
        self._search = ContactSearch(self._contacts, dofs, cut, self._blocks, self.origin)
        if self.origin is not None:  # sides stay those of the first search
            self._contacts[:] = self._search.contacts
        if self._known_rows is not None:
            self._search.take_rows(*self._known_rows)
            self._known_rows = None

    def _make_rows(self) -> None:
        if self._gluing is not None:
            self._gluing.constraints.destroy()
        search = self.search
        scaling, dofs = self._settings.options.scaling, self._dofs
        weights = row_weights(self._blocks, scaling, dofs.comm)
        prescribed, slip = made(self._prescribed), self.friction.slip(search)
        self._gluing = glue(dofs, prescribed, search.records, search.length, weights, slip)

    def _fill_right_side(self) -> None:
        values, gaps = made(self._prescribed).value, self.search.records.gap
        self._gluing = self.gluing.with_right_side(values, gaps, self.friction.slip(self.search))

    def _assemble_load(self) -> None:
        self._f = self.elements.load(self.forms)
        if self._subdomains is not None:
            self._subdomains.update(f=self._dofs.to_primal(self._f))

    def _factor(self) -> None:
        counters, given = self._counters, self._settings
        dofs, cut, trace = self._dofs, self._decomposition, self.gluing.constraints.trace
        with added_options(given.prefix, given.factor_options):
            kind = given.extensions.subdomains
            self._subdomains = make_subdomains(
                subdomain_data(dofs, cut, self._K, self._f, trace),
                self.elements.blocks(given.make_block(counters)),
                cut,
                counters,
                given.local_choice,
                Subdomains if kind is None else kind(dofs, cut),
            )
        self._K = None
        self._take_trace()

    def _take_trace(self) -> None:
        made(self._subdomains).retrace(self.gluing.constraints.trace)

    def _make_dual(self) -> None:
        settings, scene = self._settings, (self._dofs, self._decomposition)
        parts = self.gluing.constraints, made(self._subdomains)
        law = settings.extensions.feasible_set
        self._dual = settings.make_dual(*parts, *scene, law)
        self._dual.saw(self._seen)

    def _destroy_dual(self) -> None:
        if self._dual is not None:
            self._seen = self._dual.seen
            self._dual.destroy()
        self._dual = None

    def _destroy_subdomains(self) -> None:
        if self._subdomains is not None:
            self._subdomains.destroy()
        self._subdomains, self._seen = None, 0.0


MAKERS: dict[str, Callable[[System], None]] = {
    "stiffness": System._assemble_stiffness,
    "search": System._find_contacts,
    "rows": System._make_rows,
    "right side": System._fill_right_side,
    "friction": lambda system: system.friction.set_limits(system.gluing, system.search),
    "load": System._assemble_load,
    "factors": System._factor,
    "trace": System._take_trace,
    "coarse problem": System._make_dual,
    "linear term": lambda system: system.dual.update_load(),
}
