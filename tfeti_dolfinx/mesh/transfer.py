"""Functions on the mesh that was decomposed and on the torn one: their values go cell by cell."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from dolfinx import fem, la
from dolfinx import mesh as dmesh

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import original_cells
from tfeti_dolfinx.common.parallel import Exchange
from tfeti_dolfinx.common.validation import checked_type
from tfeti_dolfinx.errors import InputError


class CellExchange:
    """Rows of values that travel between the cells of two meshes. All is collective.

    The torn mesh has the cells of the one before on other ranks and in another order, but each
    with its vertices in the same order: a reference cell's points are those of the other's.

    Args:
        untorn: The mesh that was decomposed.
        ids: For each cell of the torn mesh the original id, shape ``(n,)``.
    """

    def __init__(self, untorn: dmesh.Mesh, ids: Array) -> None:
        comm, topology = untorn.comm, untorn.topology
        self._num_cells = topology.index_map(topology.dim).size_local
        known = original_cells(untorn)[: self._num_cells]
        asking, telling = Exchange(comm, ids % comm.size), Exchange(comm, known % comm.size)
        known, cell = telling.send(known), telling.send(np.arange(self._num_cells))
        order = np.argsort(known)
        found = order[np.searchsorted(known, asking.send(ids), sorter=order)]
        self._from_owner = Exchange(comm, asking.answer(telling.source[found]))
        self._cell = self._from_owner.send(asking.answer(cell[found]))

    def to_torn(self, rows: Array) -> Array:
        """Return rows of the owned cells of the untorn mesh as those of the torn one's cells."""
        return self._from_owner.answer(rows[self._cell])

    def to_untorn(self, rows: Array) -> Array:
        """Return rows of the cells of the torn mesh as those of the untorn one's owned cells."""
        out = np.empty((self._num_cells, *rows.shape[1:]), dtype=rows.dtype)
        out[self._cell] = self._from_owner.send(rows)
        return out


def check_function(f: Any, mesh: dmesh.Mesh, name: str, expected: str) -> None:
    """Raise an InputError unless f is a function on a mesh whose unknowns are values.

    Those of a cell are then those of a cell like it. ``name`` and ``expected`` are for messages.
    """
    checked_type(f, fem.Function, name, f"a dolfinx.fem.Function on {expected}")
    if f.function_space.mesh._cpp_object is not mesh._cpp_object:
        raise InputError(f"{name} is on another mesh; expected a function on {expected}")
    if f.function_space.element.needs_dof_transformations:
        raise InputError(
            f"{name} is from {f.function_space.ufl_element()}, whose unknowns depend on the "
            "directions of edges and facets; expected a Lagrange, DG or quadrature space"
        )


def carried(
    given: fem.Function, mesh: dmesh.Mesh, exchange: Callable[[Array], Array]
) -> fem.Function:
    """Return a function on the other mesh, in a space of the same element. Collective.

    The exchange takes rows of its cells to those of the other mesh, where the result has the same
    unknowns in the cells, or their means.
    """
    g = given.collapse() if given.function_space.component() else given
    V, source = g.function_space, g.copy().x
    source.scatter_forward()
    values = exchange(source.array.reshape(-1, V.dofmap.bs)[_owned_dofs(V)])
    W = fem.functionspace(mesh, V.ufl_element())
    f, apart, number = (fem.Function(W, dtype=values.dtype) for _ in range(3))
    x, sums, counts = (h.x.array.reshape(-1, W.dofmap.bs) for h in (f, apart, number))
    dofs = _owned_dofs(W)
    x[dofs] = values
    f.x.scatter_forward()
    np.add.at(sums, dofs, values - x[dofs])  # 0 but for rounding where f is continuous
    np.add.at(counts, dofs, 1.0)
    for h in (apart, number):
        h.x.scatter_reverse(la.InsertMode.add)
        h.x.scatter_forward()
    x += sums / counts
    f.name = given.name
    return f


def _owned_dofs(V: fem.FunctionSpace) -> Array:
    """Return the blocks of unknowns of each owned cell, shape ``(n, m)``."""
    topology = V.mesh.topology
    return np.asarray(V.dofmap.list)[: topology.index_map(topology.dim).size_local]
