"""Rows that glue: interfaces, Dirichlet conditions and contact put together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import TINY, Array, sum_rows
from tfeti_dolfinx.common.parallel import any_rank, count_over, largest, least
from tfeti_dolfinx.constraints.rows import (
    TOLERANCES,
    Constraints,
    ContactRows,
    Rows,
    assemble_constraints,
    stack,
)
from tfeti_dolfinx.contact.records import ContactRecords, Friction, given_slips, relative_motion
from tfeti_dolfinx.contact.tools import RigidEntries, Tools
from tfeti_dolfinx.errors import NoSolutionError, TfetiError
from tfeti_dolfinx.forms.dirichlet import Prescribed
from tfeti_dolfinx.mesh.dofs import TornDofs

# --- Rows from conditions of contact ----------------------------------------------------------


class RowBuilder:
    """Rows from conditions. Creation and ``rows`` are collective.

    A coefficient a becomes a·w/Σw on each torn copy, w its weight in D (a/k on k copies of equal
    weight): so rows are orthogonal to the gluing rows in the inner product of D⁻¹. Prescribed
    components are left to the right side. D is that of copies, shape ``(c, bs)``.
    """

    def __init__(
        self,
        dofs: TornDofs,
        prescribed: Prescribed,
        weights: Array,
        records: ContactRecords,
        rigid: RigidEntries,
    ) -> None:
        sums = np.add.reduceat(weights, dofs.copy_offsets[:-1]) if len(weights) else weights
        self.records, self._dofs, self._weights, self._rigid = records, dofs, weights, rigid
        self._prescribed, self._total = dofs.lookup(records.entry_group, prescribed.flag, sums)
        # tangents across a plane of symmetry, where nothing slips, shape (n, gdim - 1)
        self.across = np.zeros(records.tangents.shape[:2], dtype=bool)
        if prescribed.across is not None:
            along = np.abs(records.tangents) * prescribed.across[records.group][:, None]
            self.across = np.any(along > 1.0 - TOLERANCES.nothing_left, axis=2)

    def left(self, axis: int) -> tuple[Array, Array, Array]:
        """Squared norms in D⁻¹, with and without prescribed components.

        And the share of Σ_j |a_ij| along the axis that is not prescribed, free motions of rigid
        bodies included, which does not depend on stiffnesses. Shapes ``(n,)``.
        """
        records, (*both, of_rigid) = self.records, self._along(axis)
        of_D = [np.sum(a**2 / self._total, axis=1) for a in both]
        terms = np.column_stack((*of_D, *(np.linalg.norm(a, axis=1) for a in both)))
        before, after, *moduli = sum_rows(records.condition, terms, len(records)).T
        for of in moduli:
            np.add.at(of, self._rigid.condition, np.abs(of_rigid))
        share = moduli[1] / np.maximum(moduli[0], TINY)
        return before, after, share

    def rows(self, axis: int, condition: Array, scale: Array) -> Rows:
        """Return a row for each of these conditions along an axis, times its scale."""
        records, dofs, rigid = self.records, self._dofs, self._rigid
        place = np.full(len(records), -1)
        place[condition] = np.arange(len(condition))
        used = np.flatnonzero(place[records.condition] >= 0)
        entry, node, weight = dofs.lookup_copies(records.entry_group[used], self._weights)
        row = place[records.condition[used[entry]]]
        _, free, of_rigid = self._along(axis)
        shares = (free / self._total)[used[entry]]
        values = shares * weight * scale[row][:, None]
        columns = node[:, None] * dofs.bs + np.arange(dofs.bs)
        of = np.flatnonzero(place[rigid.condition] >= 0)
        to = place[rigid.condition[of]]
        return Rows(
            group=records.group[condition],
            row=np.append(np.repeat(row, dofs.bs), to),
            column=np.append(columns, dofs.offsets[-1] * dofs.bs + rigid.unknown[of]),
            value=np.append(values, of_rigid[of] * scale[to]),
        )

    def _along(self, axis: int) -> tuple[Array, Array, Array]:
        """Coefficients along an axis of the frames: all, and with 0 at prescribed components.

        And those of the unknowns of rigid bodies.
        """
        given, rigid = self.records.coefficients(axis), self._rigid
        own = np.sum(self.records.frame[rigid.condition, axis] * rigid.direction, axis=1)
        return given, np.where(self._prescribed, 0.0, given), own


# --- Rows of contact: normals, and tangents of conditions with friction ------------------------


def contact_rows(dofs: TornDofs, builder: RowBuilder) -> tuple[Rows, Rows, ContactRows]:
    """B_N and T from the conditions within reach, normal rows of unit norm in D⁻¹. Collective.

    A condition whose normal row prescribed components decide keeps its tangents under a given
    bound. Under Coulomb's law it has none: the pressure is hidden in what holds the node.
    """
    records, count = builder.records, dofs.bs - 1
    before, squares, _ = builder.left(0)
    left = squares > TOLERANCES.nothing_left**2 * before
    own = np.flatnonzero(records.within_reach & left)
    decided, scale = np.flatnonzero(records.within_reach & ~left), 1.0 / np.sqrt(squares[own])
    normals = builder.rows(0, own, scale)
    if not any_rank(dofs.comm, records.friction != Friction.NONE):
        none, number = np.empty(0, dtype=np.int64), np.empty(0)
        moves = np.empty((0, count), dtype=bool)
        contact = ContactRows(own, none, decided, scale, number, none, moves)
        return normals, Rows(none, none, none, number), contact
    of_axes = [builder.left(1 + k) for k in range(count)]
    squares, _, share = np.array(of_axes).transpose(1, 2, 0)
    left = (share > TOLERANCES.little_left) & ~builder.across
    of_normal, row = np.zeros(len(records)), np.full(len(records), -1)
    of_normal[own], row[own] = scale, np.arange(len(own))
    row[records.friction != Friction.COULOMB] = -1
    rubs = (records.friction == Friction.GIVEN) & records.within_reach
    rubs |= (records.friction == Friction.COULOMB) & (of_normal > 0.0)
    points = np.flatnonzero(rubs & np.any(left, axis=1))
    longest = np.sqrt(squares[points].max(axis=1, initial=0.0))
    over, moves = of_normal[points], left[points]
    over = np.where(over > 0.0, over, 1.0 / np.maximum(longest, TINY))
    rows = stack([builder.rows(1 + k, points, over * moves[:, k]) for k in range(count)])
    # those of a condition one after the other
    place = np.arange(len(rows)).reshape(-1, count).T.ravel()
    group = np.repeat(records.group[points], count)
    rows = Rows(group, place[rows.row], rows.column, rows.value)
    return normals, rows, ContactRows(own, points, decided, scale, over, row[points], moves)


# --- Rows of interfaces and Dirichlet conditions ----------------------------------------------


def equality_rows(dofs: TornDofs, flag: Array, weights: Array) -> tuple[Rows, csr_array]:
    """B_E, by flags of the prescribed components of groups, ``(g, bs)``; and what makes its c.

    That takes values of all components to right sides, 0 but of rows that hold one. A component
    that is prescribed has one row per copy and no gluing rows. The k − 1 gluing rows of k copies
    are orthonormal in the inner product of D⁻¹, D the weights of all copies, shape ``(c, bs)``;
    with equal weights they are (1, …, 1, −j)/√(j + j²), j = 1, …, k − 1. Differences of neighbours
    instead would have a Gram matrix of condition O(k²).
    """
    multiplicities = np.unique(dofs.multiplicity)
    tables = [_glue(dofs, flag, weights, int(m)) for m in multiplicities if m > 1]
    # one row with one entry per copy and prescribed component
    of_copy = np.repeat(np.arange(dofs.num_groups), dofs.multiplicity)
    copy, k = np.nonzero(flag[of_copy])
    group, column = of_copy[copy], dofs.copies[copy] * dofs.bs + k
    holding = Rows(group, np.arange(len(copy)), column, np.sqrt(weights[copy, k]))
    rows = stack([holding, *tables])
    order = np.argsort(rows.group, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    rows = Rows(rows.group[order], place[rows.row], rows.column, rows.value)
    n = len(holding)  # these rows have one entry each, and their entries come first
    at = rows.row[:n], group * dofs.bs + k
    return rows, csr_array((rows.value[:n], at), shape=(len(rows), flag.size))


def _glue(dofs: TornDofs, flag: Array, weights: Array, k: int) -> Rows:
    """Gluing rows of all free components of groups with k copies.

    Gram–Schmidt on e_i − e_{i+1}: rows (w_1, …, w_j, −W_j) over norms, W_j = w_1 + … + w_j.
    """
    group, component = np.nonzero((dofs.multiplicity == k)[:, None] & ~flag)
    places = dofs.copy_offsets[group][:, None] + np.arange(k)
    columns = dofs.copies[places] * dofs.bs + component[:, None]
    w, j = weights[places, component[:, None]], np.arange(k - 1)
    sums = np.cumsum(w, axis=1)
    rows = np.tril(np.ones((k - 1, k))) * w[:, None, :]
    rows[:, j, j + 1] = -sums[:, :-1]
    rows /= np.sqrt(sums[:, :-1] + sums[:, :-1] ** 2 / w[:, 1:])[:, :, None]
    row, copy = (index.ravel() for index in np.indices((len(group) * (k - 1), k)))
    return Rows(
        group=np.repeat(group, k - 1),
        row=row,
        column=columns[row // (k - 1), copy],
        value=rows.reshape(-1, k)[row, copy],
    )


# --- All rows of a scene ----------------------------------------------------------------------


@dataclass(frozen=True)
class Gluing:
    """Rows of a scene, and the Dirichlet values and contact records that they come from.

    B depends on which components are prescribed, on the records' normals and weights, on which
    of them are within reach, and on D. Prescribed values and gaps are in c alone.
    """

    dofs: TornDofs  # dof maps
    prescribed: Prescribed  # Dirichlet values
    records: ContactRecords  # contact conditions of this rank
    # from components of the owned groups, unrolled, to right sides of equality rows, (e, g·bs)
    to_equalities: csr_array
    constraints: Constraints  # B, c and the sets of rows
    length: float  # a length of the scene
    # where the load step begins: the tangential v_i of all conditions then, shape (n, gdim - 1), of
    # prescribed components alone where a tangent is prescribed. Friction acts on what comes to it
    slip: Array
    # whether conditions make the node of a tangential row without entries slip along it, while it
    # moves along the other tangent: friction is then against both slips, shape (t, gdim - 1)
    drawn: Array

    def right_side(self) -> Array:
        """Return this rank's part of c, shape ``(num_rows,)``. Collective."""
        sets, rows, records = self.constraints.sets, self.constraints.contact, self.records
        held, left, rounding = self._held
        decided, comm = left[rows.decided], self.dofs.comm
        wrong = decided < -rounding[rows.decided]
        overlaps = count_over(comm, wrong)
        deepest = least(comm, float(decided.min(initial=0.0)))
        if overlaps:
            raise NoSolutionError(
                "an obstacle or a contact lies within a part of the surface whose displacement is "
                f"prescribed: {overlaps} node{'s penetrate' if overlaps > 1 else ' penetrates'} by "
                f"up to {-deepest:.6g} whatever the rest does"
            )
        c = np.zeros(self.constraints.num_rows)
        c[sets.equalities] = self.to_equalities @ self.prescribed.value.ravel()
        c[sets.normals] = left[rows.normals] * rows.scale
        if self.constraints.contact_rows[1]:
            along, at = np.einsum("ntg,ng->nt", records.tangents, held), rows.points
            slips = np.where(rows.moves, (self.slip - along)[at], -self.given_slip[at])
            slides = rows.moves | self.drawn
            c[sets.tangents] = np.where(slides, slips * rows.tangent_scale[:, None], 0.0)
        return c

    def with_friction(self, values: Array, area: Array) -> Gluing:
        """The same rows with ∫φ_i, ψ_i = traction · ∫φ_i / s_i, and the μ_i of Coulomb's law.

        Of a point ψ_i or μ_i is 0, and both where nothing can slip. Tractions or coefficients,
        ``(n, gdim - 1)``, and areas ∫φ_i, ``(n,)``, are those of all conditions.
        """
        constraints, rows = self.constraints, self.constraints.contact
        own, given = values[rows.points], (rows.pressed_by < 0)[:, None]
        over = (area[rows.points] / rows.tangent_scale)[:, None]
        slides = rows.moves | self.drawn
        bounded = replace(
            constraints,
            area=area[rows.normals],
            limits=np.where(slides & given, own * over, 0.0),
            coefficients=np.where(slides & ~given, own, 0.0),
        )
        return replace(self, constraints=bounded)

    def closed(self) -> Array:
        """Return the conditions that prescribed components decide and that touch. Collective."""
        at, (_, left, rounding) = self.constraints.contact.decided, self._held
        return np.asarray(at[np.abs(left[at]) <= rounding[at]])

    def forced(self) -> Array:
        """Return flags of tangents that are prescribed, so have no row, ``(n, gdim - 1)``.

        They are those of conditions with friction and a normal row.
        """
        forced, rows = np.zeros(self.slip.shape, dtype=bool), self.constraints.contact
        forced[rows.normals] = True
        forced[self.records.friction == Friction.NONE] = False
        forced[rows.points] &= ~rows.moves
        return forced

    @cached_property
    def given_slip(self) -> Array:
        """Slips of prescribed components, ``(n, gdim - 1)``. Collective at first use."""
        flag, value = self.prescribed.flag, self.prescribed.value
        return given_slips(self.records, self.dofs, flag, value) - self.slip

    @cached_property
    def _held(self) -> tuple[Array, Array, Array]:
        """All v_i of prescribed components, and what they leave of gaps. Collective at first use.

        And the slack of these: facets of curved surfaces may overlap where bodies do not.
        """
        records = self.records
        held = relative_motion(records, self.dofs, self.prescribed.value) - records.motion
        left = records.gap - np.sum(records.normal * held, axis=1)
        curved = 2.0 * np.abs(records.curved_gap - records.geometric_gap)
        return held, left, curved + TOLERANCES.overlap * self.length

    def with_right_side(
        self, values: Array, gaps: Array, begin: tuple[Array, Array] | None = None
    ) -> Gluing:
        """The same rows with c of other prescribed values, gaps and slips. Collective.

        Values are of owned groups, shape ``(g, bs)``, and have no effect on components that are not
        prescribed; gaps, lengths, of the conditions; slips where the step begins are those of all
        components, and of prescribed ones alone, default the attribute. B is shared.
        """
        flag, slip = self.prescribed.flag, self.slip
        if begin is not None:
            slip = np.where(self.forced(), begin[1], begin[0])
        gluing = replace(
            self,
            prescribed=replace(self.prescribed, value=np.where(flag, values, 0.0)),
            records=replace(self.records, gap=gaps),
            slip=slip,
        )
        gluing = replace(gluing, drawn=gluing._drawn())
        return replace(gluing, constraints=replace(self.constraints, c=gluing.right_side()))

    def _drawn(self) -> Array:
        """Return ``drawn``: slips that are more than rounding. Collective."""
        moves, at = self.constraints.contact.moves, self.constraints.contact.points
        if self.dofs.bs < 3 or not self.constraints.contact_rows[1]:
            return np.zeros_like(moves)
        values, motion = self.prescribed.value, self.records.motion
        known = np.concatenate([x.ravel() for x in (values, motion, self.slip)])
        least_slip = TOLERANCES.still * largest(self.dofs.comm, known)
        slips = np.abs(self.given_slip[at]) > least_slip
        return ~moves & np.any(moves, axis=1)[:, None] & slips

    def multipliers(self, earlier: Gluing, lam: Array) -> Array:
        """Multipliers of earlier rows of the same scene on these; zero on rows that are new.

        Where other components are prescribed all rows of equalities are. Collective.
        """
        if earlier.constraints.B is self.constraints.B:
            return np.array(lam)
        sets, before = self.constraints.sets, earlier.constraints.sets
        start = np.zeros(self.constraints.num_rows)
        flags, flags_before = self.prescribed.flag, earlier.prescribed.flag
        if not any_rank(self.dofs.comm, not np.array_equal(flags, flags_before)):
            start[sets.equalities] = lam[before.equalities]
        if np.array_equal(sets.springs_of, before.springs_of):
            start[sets.springs] = lam[before.springs]
        # ratios: of rows that stay they are exactly 1, and what F makes of the start is known
        for now, then in zip(self._kinds(), earlier._kinds(), strict=True):
            (keys, scale, to), (keys_then, scale_then, of) = now, then
            _, new, old = np.intersect1d(keys, keys_then, return_indices=True)
            start[to[new]] = lam[of[old]] * (scale_then[old] / scale[new])[:, None]
        return start

    def _kinds(self) -> Iterator[tuple[Array, Array, Array]]:
        """Yield keys of conditions, scales and rows, of normals and of tangents."""
        sets, rows, records = self.constraints.sets, self.constraints.contact, self.records
        # of the contact and the node of each condition; no mesh has so many nodes
        keys = (records.contact << 40) + records.group
        yield keys[rows.normals], rows.scale, sets.normals[:, None]
        yield keys[rows.points], rows.tangent_scale, sets.tangents

    def contacts_of(self, rows: Array) -> list[int]:
        """Positions, in the user's list, of the contacts that local rows are of. Collective."""
        sets, contact = self.constraints.sets, self.constraints.contact
        normals = contact.normals[np.isin(sets.normals, rows)]
        tangents = contact.points[np.isin(sets.tangents, rows).any(axis=1)]
        own = np.unique(self.records.contact[np.concatenate((normals, tangents))])
        return sorted(set().union(*self.dofs.comm.allgather(own.tolist())))


class WarmStart(NamedTuple):
    """Multipliers of a solve, from which the next one starts."""

    gluing: Gluing  # the rows that λ is of
    lam: Array  # λ
    mu: Array  # multipliers of Gλ = e
    kplus_number: int  # the K⁺ that these are of, see `System`


def glue(
    dofs: TornDofs,
    prescribed: Prescribed,
    records: ContactRecords,
    length: float,
    weights: Array,
    slip: tuple[Array, Array] | None = None,
    tools: Tools | None = None,
) -> Gluing:
    """Rows of interfaces, Dirichlet conditions and contacts, and their right sides. Collective.

    Raise a NoSolutionError where Dirichlet conditions and contacts contradict each other; an
    InputError where a rigid body with free motions meets nodes that are prescribed. Records within
    reach get rows. D is positive, one for each local primal unknown, the stiffness there, or ones:
    rows are orthonormal in the inner product of D⁻¹ as far as they can be.
    """
    D = dofs.gather_copies(weights.reshape(-1, dofs.bs))
    tools = Tools([], dofs) if tools is None else tools
    rigid = tools.entries(records)
    builder = RowBuilder(dofs, prescribed, D, records, rigid)
    normal_rows, sliding_rows, contact = contact_rows(dofs, builder)
    if tools.num_unknowns:
        decided = np.intersect1d(contact.decided, rigid.condition)
        tools.check_nodes(records.contact[decided])
    equalities, to_equalities = equality_rows(dofs, prescribed.flag, D)
    tables = (equalities, normal_rows, sliding_rows)
    constraints = assemble_constraints(dofs, tables, weights, contact, tools.num_unknowns)
    still, drawn = np.zeros(records.tangents.shape[:2]), np.zeros_like(contact.moves)
    gluing = Gluing(dofs, prescribed, records, to_equalities, constraints, length, still, drawn)
    try:
        return gluing.with_right_side(prescribed.value, records.gap, slip)
    except TfetiError:  # on all ranks
        constraints.B.destroy()
        raise
