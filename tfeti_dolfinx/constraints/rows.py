"""Rows of B and right sides c in named sets, and their scaling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import Exchange, any_rank, chunk_offsets, least, owner_of, summed
from tfeti_dolfinx.mesh.dofs import TornDofs


@dataclass(frozen=True)
class RowTolerances:
    """Tolerances of rows."""

    # of a normal row's norm: if prescribed components leave less, rounding of the normal made it
    # (ε|x|/h of a facet of size h at x), and the row is dropped
    nothing_left: float = 1e-6
    # of Σ_j |a_ij| of a tangential row: if prescribed components leave less, it is dropped. On a
    # plane of symmetry, where nothing slips across, neighbours that do not match leave a rest that
    # hardly moves but would take friction; a body that is free leaves a half
    little_left: float = 0.25
    # of the largest displacement: a slip that is prescribed, and less, is none, as solves leave it
    still: float = 1e-6
    # overlap, over the scene's length, that rounding of gaps and prescribed values may leave
    overlap: float = 1e-10


TOLERANCES = RowTolerances()

# --- Tables of rows ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Rows:
    """Rows of one kind that this rank owns, in coordinate form."""

    group: Array  # owned group that each row belongs to, shape (n,)
    row: Array  # row of each entry, shape (k,)
    column: Array  # global primal unknown of each entry, shape (k,)
    value: Array  # the entries, shape (k,)

    def __len__(self) -> int:
        return len(self.group)


def stack(tables: list[Rows]) -> Rows:
    """Return the rows of several tables, one table after the other, and so are their entries."""
    starts = np.cumsum([0, *(len(t) for t in tables)])
    return Rows(
        group=np.concatenate([t.group for t in tables]),
        row=np.concatenate([t.row + s for t, s in zip(tables, starts[:-1], strict=True)]),
        column=np.concatenate([t.column for t in tables]),
        value=np.concatenate([t.value for t in tables]),
    )


# --- Kinds of rows ----------------------------------------------------------------------------


@dataclass(frozen=True)
class RowSets:
    """Local rows of B by name: nobody else knows in which order they stand."""

    equalities: Array  # gluing rows, and rows that hold prescribed components, shape (e,)
    normals: Array  # rows of contact conditions along their normals, λ ≥ 0, shape (n,)
    tangents: Array  # rows along the tangents of conditions with friction, shape (t, gdim - 1)
    # rows of soft springs, which no unknown of the mesh is in, and this rank's subdomain of each,
    # shape (k,)
    springs: Array = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    springs_of: Array = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @property
    def contact(self) -> Array:
        """All rows of contact conditions, normals first."""
        return np.concatenate((self.normals, self.tangents.ravel()))


@dataclass(frozen=True)
class ContactRows:
    """Rows of contact: the conditions, by their places in the records, that they are of."""

    normals: Array  # condition of each row of `RowSets.normals`, shape (n,)
    points: Array  # condition of each point of `RowSets.tangents`, shape (t,)
    decided: Array  # conditions of this rank that prescribed components decide alone, without rows
    # the s_i that a condition was multiplied by: one number for all rows of a condition, that which
    # gives its normal row unit norm. Its force is s_i λ_i; over s_i what a row misses is a length
    scale: Array
    # the same for each point, shape (t,); where prescribed components leave no normal row, one that
    # gives the longer tangential row unit norm
    tangent_scale: Array
    # under Coulomb's law the normal row of each point, as a position in `normals`, else −1
    pressed_by: Array
    # whether prescribed components leave enough of a row (`RowTolerances.little_left`); rows
    # without entries stay, so that a disc stays a disc, shape (t, gdim - 1)
    moves: Array


# --- Scaling D of rows ------------------------------------------------------------------------


def row_weights(blocks: Array, scaling: str, comm: MPI.Intracomm) -> Array:
    """D: at each node the mean of the diagonal of K over the smallest one, or ones. Collective.

    One number for a node: then a scene that is turned has the rows of the scene, turned. From the
    block of K of each local primal node, ``(num_nodes, bs, bs)``, one for each unknown,
    ``(num_nodes * bs,)``; ones for the scaling "multiplicity".
    """
    diagonals = np.diagonal(blocks, axis1=1, axis2=2)
    if scaling == "multiplicity":
        return np.ones(diagonals.size)
    means = np.mean(np.maximum(diagonals, 0.0), axis=1)
    positive = means > 0.0  # what is not is reported when Blocks are built
    lowest = float(np.min(means[positive], initial=np.inf))
    D = np.where(positive, means / least(comm, lowest), 1.0)
    return np.repeat(D, blocks.shape[1])


# --- B as a distributed PETSc matrix, and c ---------------------------------------------------


@dataclass(frozen=True)
class Constraints:
    """B u = c on equality rows, B u ≤ c on rows of contact normals; tangents have friction.

    B acts on *trace* unknowns only: primal unknowns that some row touches, sorted as the primal
    ones. It depends neither on prescribed values nor on gaps; c does.
    """

    B: PETSc.Mat  # dual rows × trace unknowns, MPIAIJ
    c: Array  # right sides of this rank's rows
    sets: RowSets  # which local rows are what
    trace: Array  # local primal unknown of each local trace unknown, ascending
    # D on the local trace unknowns: the rows are scaled with it. Of rigid bodies it is infinite,
    # and D⁻¹, which is what anything is made with, 0
    weights: Array
    contact: ContactRows  # what rows of contact are of
    # ∫φ_i of the conditions of normals, times the thickness; 0 without friction, and a set of one's
    # own
    area: Array
    limits: Array  # the ψ_i, semi-axes of the sets of the tangential multipliers, (t, gdim - 1)
    coefficients: Array  # the μ_i of Coulomb's law, else 0, shape (t, gdim - 1)

    @property
    def num_rows(self) -> int:
        """All local rows."""
        return len(self.c)

    def jumps(self, v: Array) -> Array:
        """B v on this rank's rows, of displacements on this rank's trace. Collective."""
        trace, rows = self.B.createVecs()
        trace.setArray(v)
        self.B.mult(trace, rows)
        return _taken(rows, trace)

    def forces(self, lam: Array) -> Array:
        """Bᵀλ on this rank's trace, of multipliers of this rank's rows. Collective."""
        trace, rows = self.B.createVecs()
        rows.setArray(lam)
        self.B.multTranspose(rows, trace)
        return _taken(trace, rows)

    def with_springs(self, subdomain: Array) -> Constraints:
        """Return rows with those of springs, each of a subdomain of this rank, behind the others.

        These rows where they are so, else others, with a B of their own. Collective.
        """
        comm, sets = self.B.getComm().tompi4py(), self.sets
        if not any_rank(comm, not np.array_equal(subdomain, sets.springs_of)):
            return self
        indptr, indices, data = self.B.getValuesCSR()
        rows, count = self.num_rows - len(sets.springs), len(subdomain)
        table = np.append(indptr[: rows + 1], np.full(count, indptr[-1], dtype=indptr.dtype))
        size = ((rows + count, None), (self.B.getLocalSize()[1], None))
        B = PETSc.Mat().createAIJ(size=size, csr=(table, indices, data), comm=self.B.getComm())
        c = np.append(self.c[:rows], np.zeros(count))
        sets = replace(sets, springs=rows + np.arange(count), springs_of=subdomain)
        return replace(self, B=B, c=c, sets=sets)

    @cached_property
    def contact_rows(self) -> tuple[int, int]:
        """The numbers of normal and of tangential rows on all ranks. Collective at first use."""
        own = np.array([self.sets.normals.size, self.sets.tangents.size])
        normals, tangents = summed(self.B.getComm().tompi4py(), own)
        return int(normals), int(tangents)

    @property
    def scale(self) -> Array:
        """The s_i of the conditions with rows, one for each of ``sets.normals``."""
        return self.contact.scale

    @property
    def pressed_by(self) -> Array:
        """Under Coulomb's law the local row of each point's normal, else −1, shape ``(t,)``."""
        return np.append(self.sets.normals, -1)[self.contact.pressed_by]

    @property
    def pressed(self) -> Array:
        """Positions of the points of ``sets.tangents`` with a coefficient of Coulomb's law."""
        return np.flatnonzero(np.any(self.coefficients > 0.0, axis=1))

    def with_pressures(self, pressures: Array) -> Constraints:
        """The same rows with the ψ_i = μ_i λ_N,i of Coulomb's law, λ_N of ``pressed``; ∞ sticks.

        Where no force moves a row it slips whatever bounds it: it has no share of a bound of ∞.
        """
        at, limits = self.pressed, self.limits.copy()
        sticks = np.isinf(pressures)[:, None] & ~self.contact.moves[at]
        mu = np.where(sticks, 0.0, self.coefficients[at])
        limits[at] = np.multiply(mu, pressures[:, None], out=np.zeros_like(mu), where=mu > 0.0)
        return replace(self, limits=limits)


def _taken(result: PETSc.Vec, other: PETSc.Vec) -> Array:
    """Return the values of a vector, and destroy both. Collective."""
    values = np.array(result.array_r)
    result.destroy()
    other.destroy()
    return values


def assemble_constraints(
    dofs: TornDofs, tables: Sequence[Rows], weights: Array, contact: ContactRows, rigid: int = 0
) -> Constraints:
    """Assemble B of this rank's rows, with c = 0 and ψ = 0. Collective.

    The tables are those of equalities, contact normals and tangents; the weights are D on the local
    primal unknowns. ``rigid`` counts unknowns of rigid bodies, on the last rank behind those of its
    nodes.
    """
    rows = stack(list(tables))
    used = rows.value != 0.0
    rows = Rows(rows.group, rows.row[used], rows.column[used], rows.value[used])
    ends = np.cumsum([len(table) for table in tables])[:-1]
    equalities, normals, tangents = np.split(np.arange(len(rows)), ends)
    width = dofs.bs - 1  # rows of a condition stand together
    sets = RowSets(equalities, normals, tangents.reshape(len(tangents) // max(width, 1), width))
    # the trace: local primal unknowns that rows of any rank touch
    offsets = dofs.offsets * dofs.bs
    if rigid:
        offsets[-1] += rigid
        own = rigid if dofs.comm.rank == dofs.comm.size - 1 else 0
        weights = np.append(weights, np.full(own, np.inf))
    needed, place = np.unique(rows.column, return_inverse=True)
    exchange = Exchange(dofs.comm, owner_of(offsets, needed))
    asked = exchange.send(needed) - offsets[dofs.comm.rank]
    trace = np.unique(asked)
    start = chunk_offsets(dofs.comm, len(trace))[dofs.comm.rank]
    column = exchange.answer(start + np.searchsorted(trace, asked))[place]
    num_rows, num_columns = len(rows), len(trace)
    order = np.lexsort((column, rows.row))
    indptr = np.concatenate(([0], np.cumsum(np.bincount(rows.row, minlength=num_rows))))
    index = PETSc.IntType
    B = PETSc.Mat().createAIJ(
        size=((num_rows, None), (num_columns, None)),
        csr=(indptr.astype(index), column[order].astype(index), rows.value[order]),
        comm=dofs.comm,
    )
    return Constraints(
        B=B,
        c=np.zeros(num_rows),
        sets=sets,
        trace=trace,
        weights=weights[trace],
        contact=contact,
        area=np.zeros(len(normals)),
        limits=np.zeros(sets.tangents.shape),
        coefficients=np.zeros(sets.tangents.shape),
    )
