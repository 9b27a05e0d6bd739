"""From forms to the dual problem, in stages that are kept until their input changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.assembly import Forms
from tfeti_dolfinx.boundary_elements import BoundaryElements, Replaced
from tfeti_dolfinx.contact.arguments import Gap
from tfeti_dolfinx.contact.partners import ContactPartner
from tfeti_dolfinx.contact.search import ContactSearch
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.extensions import Settings
from tfeti_dolfinx.friction_bounds import FrictionBounds
from tfeti_dolfinx.gluing.glue import Gluing, glue
from tfeti_dolfinx.gluing.prescribed import Prescribed, prescribe
from tfeti_dolfinx.gluing.stiffening import Stiffening
from tfeti_dolfinx.gluing.weights import row_weights
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import any_rank
from tfeti_dolfinx.report import Report
from tfeti_dolfinx.report_filling import fill_sizes
from tfeti_dolfinx.stages import STAGES, Stages, made
from tfeti_dolfinx.subdomains.averages import clusters_of
from tfeti_dolfinx.subdomains.build import make_subdomains, subdomain_data
from tfeti_dolfinx.subdomains.data import Counters
from tfeti_dolfinx.subdomains.factor import added_options
from tfeti_dolfinx.subdomains.subdomains import Subdomains
from tfeti_dolfinx.timing import stage


class System:
    """What the dual problem of a scene is made from. Creation and all methods are collective.

    Args:
        forms: The compiled forms.
        bcs: Dirichlet conditions.
        contacts: Obstacles and pairs.
        dofs: Dof maps.
        decomposition: The torn mesh.
        settings: How to solve.
        boundary: Where boundary elements are.

    Attributes:
        forms: The compiled forms.
        bcs: Dirichlet conditions.
        friction: What bounds tangential forces.
        replaced: What boundary elements put in the place of finite ones.
        spectrum: Extreme eigenvalues of B Bᵀ, if somebody has put them here.
    """

    def __init__(
        self,
        forms: Forms,
        bcs: Sequence[fem.DirichletBC],
        contacts: list[ContactPartner],
        dofs: TornDofs,
        decomposition: Decomposition,
        settings: Settings,
        boundary: BoundaryElements | None = None,
    ) -> None:
        self.forms, self.bcs, self._contacts = forms, bcs, contacts
        self._dofs, self._decomposition, self._settings = dofs, decomposition, settings
        self.friction = FrictionBounds(contacts, dofs, decomposition, forms.thickness)
        self.replaced = Replaced(boundary, dofs, decomposition)
        self.spectrum: dict[str, float] = {}
        self._stiffening = Stiffening(settings.options.penalty, dofs)
        self._stages, self._counters, self._counted = Stages(), Counters(), 0
        self._seen = 0.0  # of ‖F‖, which more rows hardly change
        self._K: Any = None
        self._added: Array | None = None
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
        if self._stiffening.look(new):
            self.change("stiffness")
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
        """Put sizes into a report, and what was made since it was last counted."""
        if self._gluing is not None:
            inside = self.replaced.inside()
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

    def count_slips_from(self, u: Array) -> None:
        """Let slips count from a displacement in primal order."""
        self.friction.rest = u
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
        self._blocks = self.replaced.node_blocks(K, self._settings.making(self._counters))
        self._K, self._added = K, self._stiffening.added(K)
        if self.replaced.exists:  # the load that a force per volume makes depends on S
            self.change("load")

    def _find_contacts(self) -> None:
        dofs, cut = self._dofs, self._decomposition
        self._search = ContactSearch(self._contacts, dofs, cut, self._blocks)
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
        self.spectrum = {}

    def _fill_right_side(self) -> None:
        values, gaps = made(self._prescribed).value, self.search.records.gap
        self._gluing = self.gluing.with_right_side(values, gaps, self.friction.slip(self.search))

    def _assemble_load(self) -> None:
        self._f = self.replaced.load(self.forms)
        if self._subdomains is not None:
            self._subdomains.update(f=self._dofs.to_primal(self._f))

    def _factor(self) -> None:
        counters, given = self._counters, self._settings
        if self._K is None:  # it went into Blocks that could not be made
            self._assemble_stiffness()
            self._stages.made["stiffness"] += 1
        K, self._K = self._K, None  # it goes into the Blocks
        dofs, cut, choice = self._dofs, self._decomposition, given.local_choice
        data = subdomain_data(dofs, cut, K, self._f, self.gluing.constraints.trace, self._added)
        with added_options(given.prefix, given.factor_options):
            clusters = clusters_of(dofs, cut, given.options.clusters)
            how = self.replaced.blocks(given.make_block(counters)), cut, counters, choice
            self._subdomains = make_subdomains(data, *how, clusters)
        self._take_trace()

    def _take_trace(self) -> None:
        rows = self.gluing.constraints
        made(self._subdomains).retrace(rows.trace, rows.span)

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
