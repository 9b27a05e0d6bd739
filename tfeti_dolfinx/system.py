"""The parts of a solve, made in stages that are kept until their input changes."""

from collections import Counter
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.logging import stage
from tfeti_dolfinx.common.parallel import any_rank, count_over
from tfeti_dolfinx.constraints.gluing import Gluing, glue
from tfeti_dolfinx.constraints.rows import row_weights
from tfeti_dolfinx.contact.friction import Coulomb
from tfeti_dolfinx.contact.partner import Contact, ContactPartner, Gap
from tfeti_dolfinx.contact.records import (
    ContactRecords,
    Friction,
    condition_areas,
    given_slips,
    mean_of_copies,
    slips,
)
from tfeti_dolfinx.contact.rigid_body import has_facets
from tfeti_dolfinx.contact.search import ContactSearch, KnownRows
from tfeti_dolfinx.contact.tools import Tools
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.feti.dual import Dual, contact_set
from tfeti_dolfinx.forms.assembly import Data, Forms
from tfeti_dolfinx.forms.dirichlet import EndPlanes, Prescribed, prescribe
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.report import Sizes, StageCounts
from tfeti_dolfinx.settings import Settings
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.subdomains.sparse_block import EqualSubdomains
from tfeti_dolfinx.subdomains.subdomains import (
    FiniteElements,
    SubdomainMethod,
    Subdomains,
    subdomain_data,
)

T = TypeVar("T")
# of nonlinear bodies, or in time, they have more
OwnForms = TypeVar("OwnForms", bound=Forms, covariant=True)


def made(item: T | None) -> T:
    """Return a stage's result, or raise if it has not been made."""
    if item is None:
        raise InputError("nothing has been made yet; expected a call of solve() before")
    return item


class System(Generic[OwnForms]):
    """Parts of a scene's dual problem. Creation and all methods are collective.

    ``STAGES`` below are made in their order, where something they depend on has changed.

    Attributes:
        forms: The compiled forms.
        bcs: Dirichlet conditions.
        elements: Stiffness and load of subdomains, by finite elements or another method.
        tools: The rigid bodies.
        time: That of the rigid bodies' laws.
        origin: Displacement in primal order at which the mesh is, in finite strain; else None.
        factory: Makes K⁺ of subdomains.
        kplus_number: How often K⁺ was made; multipliers μ of Gλ = e belong to one K⁺.
        is_tangent: Whether stiffnesses are tangents of Newton's method, each near the one before:
            what is known of ‖F‖, and the weights of rows, stay. So multipliers go on.
        weights: Those of the last rows; None before.
    """

    def __init__(
        self,
        forms: OwnForms,
        bcs: Sequence[fem.DirichletBC],
        contacts: Sequence[ContactPartner],
        dofs: TornDofs,
        settings: Settings,
        method: SubdomainMethod | None = None,
    ) -> None:
        self.forms, self.bcs, self._contacts = forms, bcs, list(contacts)
        self._dofs, self._settings = dofs, settings
        self._secondary: list[Any] = [getattr(contact, "secondary", None) for contact in contacts]
        self._has_friction = any(contact.friction is not None for contact in contacts)
        # other obstacles have normals of their own, and of degree 1 nodes see no others
        shapes = [getattr(contact, "shape", None) for contact in contacts]  # pairs have none
        meets = any(shape is None or has_facets(shape) for shape in shapes)
        bends = dofs.V.element.basix_element.degree > 1
        self._sees_conditions = meets or (bends and len(shapes) > 0)
        self._sees_symmetry = dofs.bs == dofs.V.mesh.geometry.dim and (
            meets or (self._has_friction and bends)
        )
        self.elements = (
            FiniteElements(dofs) if method is None else method.assembly(dofs, dofs.decomposition)
        )
        self.origin: Array | None = None
        self.tools, self.time = Tools(contacts, dofs), 0.0
        self.tools.check_mass(forms.has_mass)
        # displacement in primal order at which the load step begins; None: no displacement
        self._begin: Array | None = None
        self._known_slips: tuple[ContactRecords, Array] | None = None
        self._stale, self._made = set(STAGES), Counter[str]()
        self.factory, self._counted = settings.inverse_factory(), 0
        self._equals = EqualSubdomains(self.factory)
        # as the last `Dual` had them: more rows hardly change ‖F‖
        self._norm, self._law_target = 0.0, (0.0, 0.0)
        self.kplus_number, self.is_tangent = 0, False
        self.weights: Array | None = None
        self._K: Any = None
        self._search: ContactSearch | None = None
        self._known_rows: KnownRows | None = None
        self.known_friction: Array | None = None
        self._prescribed: Prescribed | None = None
        self._ends: EndPlanes | None = None
        self._conditions: list[fem.DirichletBC] | None = None  # that it is of, with their values
        self._values = Data(
            lambda: [bc.g.x.array if hasattr(bc.g, "x") else bc.g.value for bc in self.bcs],
            dofs.comm,
        )
        self._gluing: Gluing | None = None
        self._subdomains: Subdomains | None = None
        self._dual: tuple[Dual, Options] | None = None

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
        return made(self._dual)[0]

    @property
    def options(self) -> Options:
        """The options, with the solver and the preconditioner of the dual problem for ``auto``."""
        return made(self._dual)[1]

    @property
    def subdomains(self) -> Subdomains:
        """The subdomains with their factors."""
        return made(self._subdomains)

    def look_for_changes(self) -> None:
        """See whether the mesh, or what forms, conditions and laws refer to, has changed."""
        changes = self.forms.changes() | self.tools.read(self.time)
        for what in (name for name in CHANGES if name in changes):
            self.change(what)
        if self.forms.repeats:  # assembled, too
            self._made["stiffness"] += 1
        comm, given = self._dofs.comm, list(self.bcs)
        if "points" in changes:
            self._ends = None
        if self._ends is None and given and self._sees_symmetry:
            self._ends = EndPlanes(self._dofs)
        if self._values.has_changed() or given != self._conditions or "points" in changes:
            self._conditions, old = None, self._prescribed  # what raises looks again
            new = self._prescribed = prescribe(self._dofs, given, self._ends)
            if old is None or any_rank(comm, new.kinds != old.kinds):
                self.change("places" if self._sees_conditions else "constraints")
            elif any_rank(comm, new.value != old.value):
                self.change("right side")
            self._conditions = given
        if self._search is not None:
            self._look_at_values(self._search)

    def _look_at_values(self, search: ContactSearch) -> None:
        """See whether shapes, gaps and laws of friction are others at the conditions."""
        if search.shapes_have_changed():
            self.change("places")
        if search.read_gaps():
            self.change("right side")
        if (known := self.known_friction) is not None:
            comm, friction = self._dofs.comm, search.friction()
            if any_rank(comm, not np.array_equal(friction > 0.0, known > 0.0)):
                self.change("constraints")
            elif any_rank(comm, not np.array_equal(friction, known)):
                self.known_friction = friction
                self.change("friction")

    def change(self, what: str) -> None:
        """Say that something has changed, a key of ``CHANGES``; what is out of date is freed."""
        self._stale |= set(CHANGES[what])
        if what == "stiffness" and not self.is_tangent:
            self._stale |= {"constraints", "friction"}
        if "coarse problem" in self._stale:
            self._destroy_dual()
        if "factors" in self._stale:
            if self._subdomains is not None:  # what does not change is not factored again
                self._equals.keep(self._subdomains.blocks)
            self._destroy_subdomains()

    def set_gaps(self, gaps: Mapping[int, Gap]) -> tuple[ContactPartner, ...]:
        """Give contacts, by position, another ``gap=``, and return all contacts as they are then.

        Conditions stay, but for their gaps. Raise an InputError where a gap does not fit, or
        overlaps too deep; nothing has changed then.
        """
        contacts = {i: self._contacts[i].with_gap(gap) for i, gap in gaps.items()}
        if self._search is not None:
            self._search.set_gaps(gaps)
        for i, contact in contacts.items():
            self._contacts[i] = contact
        self.change("right side")
        return tuple(self._contacts)

    def begin_at(self, u: Array) -> None:
        """Let a load step begin at a displacement in primal order."""
        self._begin, self._known_slips = u, None

    def count_slips_from(self, end: Solution) -> None:
        """Let a load step begin at the end of another, with its slips while conditions stay."""
        self._begin, self._known_slips = end.u, (end.gluing.records, end.slip_at_end)
        if self._has_friction:
            self.change("right side")
        elif self._gluing is not None:
            self._gluing = replace(self._gluing, slip=self._slip()[0])

    def displacement_at_begin(self) -> Array:
        """Return where the load step began, with free motions of rigid bodies, shape ``(n,)``."""
        u = np.zeros(self.subdomains.num_nodal) if self._begin is None else self._begin
        return np.append(u, self.tools.at_begin()[: self.tools.num_local])

    def rows(self) -> KnownRows | None:
        """Return the rows that the last search ended with; None before the first."""
        return None if self._search is None else self._search.rows()

    def know_rows(self, rows: KnownRows | None, secondary: Sequence[int] | None = None) -> None:
        """Let the next search end with the rows and sides that an earlier one of the scene had.

        Without rows it is as the first one, without sides they stay.
        """
        self._known_rows = rows
        self._secondary = self._secondary if secondary is None else list(secondary)
        self.change("points")

    def make(self, seconds: MutableMapping[str, float], last: str = "linear term") -> None:
        """Make what is out of date up to a stage. After an error its stage stays out of date.

        Raise an InputError where Dirichlet values, contacts, stiffness or load do not fit; a
        NoSolutionError where the problem has no solution; a FactorError where a matrix could not be
        factored. ``seconds`` takes the seconds of each stage.
        """
        for name, (timed_as, make) in STAGES.items():
            if name in self._stale:
                with stage(timed_as, seconds):
                    make(self)
                self._stale -= {name, BRINGS.get(name, name)}
                self._made[name] += 1
            if name == last:
                break

    def sizes(self) -> Sizes:
        """Return the sizes, 0 before there are rows."""
        if self._gluing is None:
            return Sizes()
        return Sizes.of_rows(self._gluing, self.elements.inside, self.search.unmet())

    def take_counts(self) -> StageCounts:
        """Return how often stages were made since the last call."""
        done, self._made = self._made, Counter()
        new = {*done, *(BRINGS.get(name) for name in done), *self._stale}
        has_kernel = self._dual is None or self.dual.coarse.dimension > 0
        before, self._counted = self._counted, self.factory.factorizations
        return StageCounts(
            factorizations=count_over(self._dofs.comm, self._counted - before),
            coarse_factorizations=done["coarse problem"] if has_kernel else 0,
            assemblies=done["stiffness"],
            searches=done["search"],
            gluings=done["constraints"],
            reused=[name for name in STAGES if name not in new],
        )

    def destroy(self) -> None:
        """Destroy the PETSc objects; all stages are out of date."""
        self._destroy_dual()
        self._destroy_subdomains()
        self._equals.kept.clear()
        if self._gluing is not None:
            self._gluing.constraints.B.destroy()
        self._gluing = None
        self._stale = set(STAGES)

    # ------------------------------------------------------------------- stages

    def _assemble_stiffness(self) -> None:
        self._K = self.forms.stiffness()
        self._blocks = self.elements.node_blocks(self._K, self.factory)
        if self.elements.replaces:  # the load that a force per volume makes depends on S
            self.change("load")

    def _find_contacts(self) -> None:
        dofs, tools, before = self._dofs, self.tools, self._search
        tools.place(finite=self.origin is not None)
        contacts = [
            replace(contact, secondary=side) if isinstance(contact, Contact) else contact
            for contact, side in zip(tools.placed(self._contacts), self._secondary, strict=True)
        ]
        decided = before is not None or self._known_rows is not None
        stiffness = None if decided else self._blocks
        self._search = ContactSearch(
            contacts, dofs, stiffness, self.origin, tools, made(self._prescribed)
        )
        if before is None:
            tools.check_begin(contacts, self._search.records)
        # its sides stay
        self._secondary = [contact.surfaces[0] for contact in self._search.contacts]
        if self._known_rows is not None:
            self._search.take_rows(*self._known_rows)
            self._known_rows = None

    def _make_rows(self) -> None:
        if self._gluing is not None:
            self._gluing.constraints.B.destroy()
        search, dofs, tools = self.search, self._dofs, self.tools
        search.move()
        if self.weights is None or not self.is_tangent:
            scaling = self._settings.options.scaling
            self.weights = row_weights(self._blocks, scaling, dofs.comm)
        records = search.records
        if self._has_friction:  # a bound of 0 has no rows
            friction = self.known_friction = search.friction()
            rubs = np.any(friction > 0.0, axis=1)
            records = replace(records, friction=np.where(rubs, records.friction, Friction.NONE))
        self._gluing = glue(
            dofs,
            made(self._prescribed),
            records,
            search.length,
            self.weights,
            slip=self._slip(),
            tools=tools,
        )

    def _fill_right_side(self) -> None:
        self.search.move()
        values, records = made(self._prescribed).value, self.search.records
        gluing = replace(self.gluing, records=replace(self.gluing.records, motion=records.motion))
        self._gluing = gluing.with_right_side(values, records.gap, self._slip())
        before, after = gluing.drawn, self._gluing.drawn
        if self._has_friction and any_rank(self._dofs.comm, not np.array_equal(before, after)):
            self.change("friction")

    def _set_friction_limits(self) -> None:
        """Give the rows their areas, the ψ_i, and the μ_i under Coulomb's law."""
        if not self._has_friction and self._settings.extensions.feasible_set is contact_set:
            return
        search, gluing = self.search, self.gluing
        surfaces = [contact.surfaces[0] for contact in search.contacts]
        area = condition_areas(gluing.records, self._dofs, surfaces, self.forms.thickness)
        friction = made(self.known_friction) if self._has_friction else np.zeros(gluing.slip.shape)
        self._gluing = gluing.with_friction(friction, area)

    def _assemble_load(self) -> None:
        self._load = self.elements.load(self.forms)
        if self._subdomains is not None:
            load = self.tools.load[: self.tools.num_local]
            self._subdomains.update(f=np.append(self._dofs.to_primal(self._load.values), load))
            self._take_rounding()

    def _take_rounding(self) -> None:
        """Tell subdomains what rounding is in their loads; none beside a given one. Collective."""
        if self._load.rounding is None:
            return
        subdomains, parts = self.subdomains, self.subdomains.dof_parts
        rounding, given = map(self._dofs.to_primal, (self._load.rounding, self._load.given))
        subdomains.load_rounding[: len(rounding)] = rounding
        has_given = [[float(np.any(given[part])) for part in parts]]
        (loaded,) = subdomains.of_bodies(has_given, largest=True)
        for part, body in zip(parts, subdomains.body_of_block, strict=True):
            subdomains.load_rounding[part] *= loaded[body] == 0.0

    def _factor(self) -> None:
        dofs, trace = self._dofs, self.gluing.constraints.trace
        # single precision pays in one solve, without bounds that many programs look for
        again = self.is_tangent or self.kplus_number > 0
        self.factory.mixed &= not (
            again or any(isinstance(x.friction, Coulomb) for x in self._contacts)
        )
        self._subdomains = self._settings.make_subdomains(
            subdomain_data(dofs, self._K, self._load.values, trace),
            dofs,
            self._equals,
            self.tools,
            self.elements.blocks,
            self.is_tangent,
        )
        self._K, self._subdomains.is_tangent = None, self.is_tangent
        self._subdomains.retrace(trace)
        self._take_rounding()
        self.kplus_number += 1

    def _make_dual(self) -> None:
        law, names = self._settings.extensions.feasible_set, self.tools.free_names
        of_springs = np.repeat(
            np.arange(len(self.subdomains.blocks)),
            [part.stop - part.start for part in self.subdomains.spring_parts],
        )
        before = self.gluing.constraints
        if (constraints := before.with_springs(of_springs)) is not before:
            before.B.destroy()
            self._gluing = replace(self.gluing, constraints=constraints)
        self._dual = self._settings.make_dual(
            self.gluing.constraints, self.subdomains, self._dofs, law, names
        )
        self.dual.norm, self.dual.law_target = self._norm, self._law_target
        self._equals.kept.clear()

    def _slip(self) -> tuple[Array, Array]:
        """Tangential v_i where the load step begins, and those of prescribed components alone."""
        records = self.search.records
        if self._begin is None:
            return (np.zeros(records.tangents.shape[:2]),) * 2
        if self._known_slips is not None:
            before, slip = self._known_slips
            names = ("frame", "condition", "entry_group", "weight")
            same = all(np.array_equal(getattr(records, n), getattr(before, n)) for n in names)
            if not any_rank(self._dofs.comm, not same):
                # of the points of rigid bodies that are there now
                way = before.motion - self.tools.motion_at_begin(records)
                return (slip + np.einsum("ntg,ng->nt", records.tangents, way),) * 2
        begun = replace(records, motion=self.tools.motion_at_begin(records))
        slip = slips(begun, self._dofs, self._begin)
        if not self._has_friction:
            return slip, slip
        flag = made(self._prescribed).flag
        given = np.where(flag, mean_of_copies(self._dofs, self._begin), 0.0)
        return slip, given_slips(begun, self._dofs, flag, given)

    def _destroy_dual(self) -> None:
        if self._dual is not None:
            self._norm, self._law_target = self.dual.norm, self.dual.law_target
            self.dual.destroy()
        self._dual = None

    def _destroy_subdomains(self) -> None:
        if self._subdomains is not None:
            self._subdomains.destroy()
        self._subdomains = None
        if not self.is_tangent:
            self._norm = 0.0


# in the order in which they are made, with the name that their seconds have in the report
STAGES: dict[str, tuple[str, Callable[[System[Forms]], None]]] = {
    "stiffness": ("assembly", System._assemble_stiffness),
    "search": ("contact", System._find_contacts),
    "constraints": ("constraints", System._make_rows),
    "right side": ("constraints", System._fill_right_side),
    "friction": ("constraints", System._set_friction_limits),
    "load": ("assembly", System._assemble_load),
    "factors": ("factors", System._factor),
    "trace": ("factors", lambda system: system.subdomains.retrace(system.gluing.constraints.trace)),
    "coarse problem": ("coarse", System._make_dual),
    "linear term": ("coarse", lambda system: system.dual.update_load(system.gluing.constraints)),
}
# what has to be made anew where something has changed
CHANGES = {
    "points": tuple(STAGES),
    "stiffness": ("stiffness", "factors", "trace", "coarse problem"),  # and rows, by their scaling
    "constraints": ("constraints", "friction", "trace", "coarse problem"),
    "places": ("search", "constraints", "friction", "trace", "coarse problem"),
    "right side": ("right side", "linear term"),
    "friction": ("friction", "linear term"),
    "load": ("load", "linear term"),
}
# what comes with a stage
BRINGS = {"constraints": "right side", "factors": "trace", "coarse problem": "linear term"}
