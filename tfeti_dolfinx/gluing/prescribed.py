"""Dirichlet values, spread over all torn copies of a node."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import checked_type, shown
from tfeti_dolfinx.compat import prescribed_values, space_of
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.entities import cell_facets
from tfeti_dolfinx.mesh.spaces import component_of, described, is_same_space

AGREEMENT = 1e-10


@dataclass(frozen=True)
class Prescribed:
    """Components that Dirichlet conditions prescribe, for the owned groups.

    Attributes:
        flag: Whether a component is prescribed, shape ``(g, bs)``.
        value: Its value, 0 where it is not, shape ``(g, bs)``.
    """

    flag: Array
    value: Array


def prescribe(dofs: TornDofs, bcs: Sequence[fem.DirichletBC]) -> Prescribed:
    """Collect Dirichlet values and spread them to all copies of their nodes. Collective.

    Raises:
        InputError: Conditions do not fit V, contradict each other at a node, or are not finite.
    """
    bcs = checked_conditions(bcs, dofs.V)
    size = dofs.V.dofmap.index_map.size_local * dofs.bs
    values = prescribed_values(bcs, size)
    low = np.fmin.reduce(values, axis=0, initial=np.inf)
    high = np.fmax.reduce(values, axis=0, initial=-np.inf)
    low = dofs.reduce(dofs.to_primal(low).reshape(-1, dofs.bs), np.minimum, np.inf)
    high = dofs.reduce(dofs.to_primal(high).reshape(-1, dofs.bs), np.maximum, -np.inf)
    flag = low <= high
    with raised_on_all_ranks(dofs.comm):
        _check_finite(bcs)
        _check_agreement(low, high, flag)
    return Prescribed(flag=flag, value=np.where(flag, low, 0.0))


def checked_conditions(
    bcs: Iterable[fem.DirichletBC], V: fem.FunctionSpace
) -> list[fem.DirichletBC]:
    """The conditions as a list. Collective.

    Raises:
        InputError: They are no Dirichlet conditions on V or a component of V, or one of them has
            no unknowns, or some that V has not.
    """
    conditions = listed_conditions(bcs)
    count = np.zeros(len(conditions), dtype=np.int64)
    with raised_on_all_ranks(V.mesh.comm):
        for number, bc in enumerate(conditions):
            _check_space(f"Dirichlet condition {number}", bc, V)
            count[number] = len(bc.dof_indices()[0])
    total = V.mesh.comm.allreduce(count)
    if not np.all(total):
        raise InputError(
            f"Dirichlet condition {int(np.argmin(total))} holds nowhere: it has no unknowns on any "
            "rank; expected at least one"
        )
    return conditions


def check_not_on_tears(
    bcs: Sequence[fem.DirichletBC], dofs: TornDofs, decomposition: Decomposition
) -> None:
    """Raise if a condition prescribes facets of tears as if they were of the boundary. Collective.

    To DOLFINx tears are exterior facets, so ``exterior_facet_indices`` and
    ``locate_entities_boundary`` find them, too. A condition knows unknowns only. It is taken for
    one on exterior facets if each unknown is one of an exterior facet all of whose unknowns, of a
    component, are prescribed. It is wrong if some of these facets are of the boundary and some of
    tears, unless all nodes of the latter are on the boundary. So nodes of a region may be
    prescribed, which are also inside of subdomains, and those of a surface inside a body, in a
    condition of its own, wherever the tears are.

    Args:
        bcs: Conditions on the space of ``dofs``.
        dofs: Dof maps.
        decomposition: The torn mesh.

    Raises:
        InputError: A condition is.
    """
    if not bcs or not decomposition.is_torn:
        return
    tears, outer = (_facet_nodes(dofs, f) for f in (decomposition.tears, decomposition.boundary))
    at_boundary = np.zeros(dofs.num_nodes, dtype=bool)
    at_boundary[outer] = True
    at_boundary = dofs.spread(dofs.reduce(at_boundary, np.logical_or, False))
    within = ~np.all(at_boundary[tears], axis=1)
    count = np.empty((len(bcs), 3, dofs.bs), dtype=np.int64)
    for number, bc in enumerate(bcs):
        held = np.zeros(dofs.num_nodes * dofs.bs, dtype=bool)
        held[bc.dof_indices()[0]] = True
        held = dofs.to_primal(held).reshape(-1, dofs.bs)
        of_tears, of_outer = (np.all(held[nodes], axis=1) for nodes in (tears, outer))
        count[number, 0] = np.sum(of_tears[within], axis=0)
        count[number, 1] = np.sum(of_outer, axis=0)
        for nodes, whole in ((tears, of_tears), (outer, of_outer)):
            facet, component = np.nonzero(whole)
            held[nodes[facet], component[:, None]] = False
        count[number, 2] = np.sum(held, axis=0)
    tear, boundary, others = np.moveaxis(dofs.comm.allreduce(count), 1, 0)
    wrong = np.max(np.where((boundary > 0) & (others == 0), tear, 0), axis=1)
    if np.any(wrong):
        number = int(np.argmax(wrong > 0))
        raise InputError(
            f"Dirichlet condition {number} prescribes {(wrong[number] + 1) // 2} facets that lie "
            "on tears inside a body, besides facets of its boundary: to DOLFINx tears are "
            "exterior, too; expected facets of the boundary: decomposition.boundary, "
            "decomposition.facets(name) or decomposition.locate_facets(marker); a surface inside a "
            "body is for a condition of its own"
        )


def _facet_nodes(dofs: TornDofs, facets: Array) -> Array:
    """Return the primal nodes of local facets of one cell, shape ``(f, nodes per facet)``."""
    V, of_cells = dofs.V, cell_facets(dofs.V.mesh)
    chosen = np.zeros(int(of_cells.max(initial=-1)) + 1, dtype=bool)
    chosen[facets] = True
    cell, place = np.nonzero(chosen[of_cells])
    element, fdim = V.element.basix_element, V.mesh.topology.dim - 1
    on_facet = np.array(element.entity_closure_dofs[fdim])[place]
    return dofs.primal_nodes(np.take_along_axis(np.asarray(V.dofmap.list)[cell], on_facet, axis=1))


def listed_conditions(bcs: Iterable[fem.DirichletBC]) -> list[fem.DirichletBC]:
    """The conditions as a list. Not collective.

    Raises:
        InputError: They are nothing that gives Dirichlet conditions.
    """
    if isinstance(bcs, fem.DirichletBC) or not isinstance(bcs, Iterable):
        raise InputError(
            f"bcs is {shown(bcs)}; expected a list of Dirichlet conditions, [] for none"
        )
    conditions = list(bcs)
    for number, bc in enumerate(conditions):
        what = f"Dirichlet condition {number}"
        checked_type(bc, fem.DirichletBC, what, "a dolfinx.fem.DirichletBC")
    return conditions


def _check_space(what: str, bc: fem.DirichletBC, V: fem.FunctionSpace) -> None:
    space = space_of(bc)
    if space.mesh is not V.mesh._cpp_object:
        raise InputError(
            f"{what} is on another mesh; expected a space on decomposition.mesh, the torn mesh"
        )
    if hasattr(bc.g, "x") and bc.g.function_space.mesh is not space.mesh:
        raise InputError(
            f"the value of {what} is a function on another mesh; expected one on "
            "decomposition.mesh, the torn mesh, such as decomposition.from_original(g)"
        )
    own = component_of(V, list(space.component()))
    if own is None or not is_same_space(space, own):
        raise InputError(
            f"{what} is on {described(space)}; expected the space of a, "
            f"{described(V._cpp_object)}, or V.sub(i) of it"
        )
    size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
    highest = int(bc.dof_indices()[0].max(initial=-1))
    if highest >= size:
        raise InputError(
            f"{what} prescribes the unknown {highest}, but this rank has {size}; expected "
            "unknowns that were located in the space of a"
        )


def _check_finite(bcs: Sequence[fem.DirichletBC]) -> None:
    for number, bc in enumerate(bcs):
        value = bc.g.x.array if hasattr(bc.g, "x") else bc.g.value
        if not np.all(np.isfinite(value)):
            raise InputError(f"Dirichlet condition {number} has a value that is not finite")


def _check_agreement(low: Array, high: Array, flag: Array) -> None:
    scale = np.abs(np.concatenate((low[flag], high[flag]))).max(initial=0.0)
    spread = np.subtract(high, low, out=np.zeros_like(low), where=flag)
    wrong = spread > AGREEMENT * scale
    if not np.any(wrong):
        return
    group, component = np.argwhere(wrong)[0]
    raise InputError(
        f"Dirichlet conditions contradict each other: component {component} of a node is "
        f"prescribed as {low[group, component]} and as {high[group, component]} "
        f"(at {wrong.sum()} components of nodes on this rank)"
    )
