"""B as a distributed PETSc matrix (dual rows × trace unknowns), and c."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.gluing.row_sets import RowSets, row_sets
from tfeti_dolfinx.gluing.rows import Rows, stack
from tfeti_dolfinx.gluing.span import row_span
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import Exchange, chunk_offsets, owner_of


@dataclass(frozen=True)
class Constraints:
    """B u = c on equality rows, B u ≤ c on rows of contact normals; tangents have friction.

    B acts on *trace* unknowns only: primal unknowns that some row touches, sorted as the primal
    ones. It depends neither on prescribed values nor on gaps; c does, and can be filled again.

    Attributes:
        B: Dual rows × trace unknowns, MPIAIJ.
        c: Right sides, distributed as the rows; 0 until they are set.
        sets: Which local rows are what.
        trace: Local primal unknown of each local trace unknown, ascending.
        span: Projector of each node of the trace onto the directions that rows act along, the row
            of each trace unknown, shape ``(t, bs)``.
        weights: D on the local trace unknowns: the rows are scaled with it.
        scale: The s_i of the conditions with rows, one for each of ``sets.normals``: over it what
            a row misses is a length.
        tangent_scale: The same for each point of ``sets.tangents``, shape ``(t,)``.
        limits: The ψ_i, semi-axes of the sets of the tangential multipliers, shape
            ``(t, gdim - 1)``; 0 until they are set.
        pressed_by: Under Coulomb's law the local row of the condition's normal, else −1, shape
            ``(t,)``.
        coefficients: The μ_i of Coulomb's law, else 0, shape ``(t, gdim - 1)``.
        pressures: The λ_N whose friction the limits are, under Coulomb's law; nan until they
            are set, shape ``(t,)``.
    """

    B: PETSc.Mat
    c: PETSc.Vec
    sets: RowSets
    trace: Array
    span: Array
    weights: Array
    scale: Array
    tangent_scale: Array
    limits: Array
    pressed_by: Array
    coefficients: Array
    pressures: Array

    @property
    def num_rows(self) -> int:
        """All local rows."""
        return self.sets.num_rows

    def set_right_side(self, c: Array) -> None:
        """Fill c anew, with this rank's part of it, shape ``(num_rows,)``. B stays."""
        self.c.array[:] = c

    def set_limits(self, limits: Array) -> None:
        """Fill the ψ_i anew, shape ``(t, gdim - 1)``. B stays."""
        self.limits[:] = limits

    @property
    def pressed(self) -> Array:
        """Positions of the points of ``sets.tangents`` with a coefficient of Coulomb's law."""
        return np.flatnonzero(np.any(self.coefficients > 0.0, axis=1))

    def set_pressures(self, pressures: Array) -> None:
        """Fill the ψ_i under Coulomb's law, μ_i times a λ_N of each of ``pressed``; ∞ sticks."""
        at = self.pressed
        self.pressures[at] = pressures
        mu = self.coefficients[at]
        self.limits[at] = np.multiply(mu, pressures[:, None], out=np.zeros_like(mu), where=mu > 0.0)

    def destroy(self) -> None:
        """Destroy the PETSc objects. Collective."""
        self.B.destroy()
        self.c.destroy()


def assemble_constraints(
    dofs: TornDofs,
    tables: Sequence[Rows],
    weights: Array,
    scale: Array,
    tangent_scale: Array,
    pressed_by: Array,
) -> Constraints:
    """Assemble B, with c = 0 and ψ = 0. Collective.

    Args:
        dofs: Dof maps.
        tables: This rank's rows: equalities, contact normals, tangents.
        weights: D on the local primal unknowns.
        scale: What each normal row was multiplied by.
        tangent_scale: What the tangential rows of each condition were multiplied by.
        pressed_by: For each of them the position of its normal row under Coulomb's law, else −1.
    """
    rows = stack(list(tables))
    equalities, normals, tangents = (len(table) for table in tables)
    sets = row_sets(equalities, normals, tangents, dofs.bs)
    trace, column = _trace_columns(dofs, rows.column)
    span = row_span(dofs, tables[0], stack(list(tables[1:])), trace)
    num_rows, num_columns = len(rows), len(trace)
    order = np.lexsort((column, rows.row))
    indptr = np.concatenate(([0], np.cumsum(np.bincount(rows.row, minlength=num_rows))))
    index = PETSc.IntType
    B = PETSc.Mat().createAIJ(
        size=((num_rows, None), (num_columns, None)),
        csr=(indptr.astype(index), column[order].astype(index), rows.value[order]),
        comm=dofs.comm,
    )
    c = B.createVecLeft()
    c.set(0.0)
    shape, row = sets.tangents.shape, pressed_by.copy()
    row[row >= 0] = sets.normals[row[row >= 0]]
    return Constraints(
        B=B,
        c=c,
        sets=sets,
        trace=trace,
        span=span,
        weights=weights[trace],
        scale=scale,
        tangent_scale=tangent_scale,
        limits=np.zeros(shape),
        pressed_by=row,
        coefficients=np.zeros(shape),
        pressures=np.full(len(row), np.nan),
    )


def _trace_columns(dofs: TornDofs, column: Array) -> tuple[Array, Array]:
    """Local primal unknowns that rows of any rank touch, and the entries' global trace column."""
    offsets = dofs.offsets * dofs.bs
    needed, place = np.unique(column, return_inverse=True)
    exchange = Exchange(dofs.comm, owner_of(offsets, needed))
    asked = exchange.send(needed) - offsets[dofs.comm.rank]
    trace = np.unique(asked)
    start = chunk_offsets(dofs.comm, len(trace))[dofs.comm.rank]
    return trace, exchange.answer(start + np.searchsorted(trace, asked))[place]
