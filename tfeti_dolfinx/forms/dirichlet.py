"""Dirichlet conditions: what fits the torn mesh, and the components that they prescribe."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import space_of
from tfeti_dolfinx.common.parallel import box_over_ranks, maxima, summed
from tfeti_dolfinx.common.validation import checked_type, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs, is_same_space, space_in_words


def listed_conditions(bcs: Iterable[fem.DirichletBC]) -> list[fem.DirichletBC]:
    """Return the conditions as a list; raise an InputError for anything else. Not collective."""
    if isinstance(bcs, fem.DirichletBC) or not isinstance(bcs, Iterable):
        raise InputError(
            f"bcs is {shown(bcs)}; expected a list of Dirichlet conditions, [] for none"
        )
    conditions = list(bcs)
    for number, bc in enumerate(conditions):
        what = f"Dirichlet condition {number}"
        checked_type(bc, fem.DirichletBC, what, "a dolfinx.fem.DirichletBC")
    return conditions


def check_conditions(conditions: Sequence[fem.DirichletBC], dofs: TornDofs) -> None:
    """Raise unless conditions are on the space or a component of it, and fit it. Collective.

    Each has unknowns of the space, and does not prescribe facets of tears as if they were of the
    boundary.
    """
    V = dofs.V
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
    _check_not_on_tears(conditions, dofs)


@dataclass(frozen=True)
class Prescribed:
    """Components that Dirichlet conditions prescribe, for the owned groups."""

    flag: Array  # whether a component is prescribed, shape (g, bs)
    value: Array  # its value, 0 where it is not, shape (g, bs)
    across: Array | None = None  # whether it is across a plane of symmetry, (g, bs); None: none is

    @property
    def kinds(self) -> Array:
        """0 for a component that is free, 1 if prescribed, 3 if across a plane of symmetry."""
        return self.flag + (0 if self.across is None else 2 * self.across)


class EndPlanes:
    """Planes x_k = c at which the whole mesh ends, and ends in facets: maybe planes of symmetry.

    In finite strain it is the mesh at rest: nodes of an iterate leave a plane by its tolerance.

    Creation is collective. Under axisymmetry x_0 = 0 is the only one across r. What is within
    ``near``, over the mesh's extent, lies in a plane.
    """

    def __init__(self, dofs: TornDofs, near: float = 1e-6) -> None:
        self._comm, gdim = dofs.comm, dofs.V.mesh.geometry.dim
        x = dofs.points(at_rest=True)[:, :gdim]
        low, high = box_over_ranks(dofs.comm, x)
        near *= np.max(high - low)
        at = np.abs(x[:, None] - np.stack((low, high))) <= near  # both ends, shape (n, 2, gdim)
        if dofs.axisymmetric:
            at[np.abs(x[:, 0]) > near, :, 0] = False
        facets, flat = dofs.facet_nodes(dofs.decomposition.boundary), np.zeros_like(at)
        np.logical_or.at(flat, facets, at[facets].all(axis=1)[:, None])
        on, flat = dofs.reduce(np.stack((at, flat), axis=1), np.logical_or).swapaxes(0, 1)
        on &= summed(dofs.comm, np.sum(on & ~flat, axis=0)) == 0
        # the owned groups on some plane, shape (n,), and on which, shape (n, 2, gdim)
        self._groups = np.flatnonzero(on.any(axis=(1, 2)))
        self._on = on[self._groups]

    def across(self, flag: Array, value: Array, agreement: float) -> Array | None:
        """Return flags of components across planes of symmetry, ``(g, gdim)``; None: none is one.

        These are all of whose nodes have u_k prescribed, and alike: the mirror image moves along.
        Values that differ by less than ``agreement``, relative, are the same. Collective.
        """
        on, whole = self._on, np.zeros_like(flag)
        flag, value = flag[self._groups, None], value[self._groups, None]
        free, there = np.any(on & ~flag, axis=0), np.any(on, axis=0)
        most, least = (
            np.where(on, values, -np.inf).max(axis=0, initial=-np.inf) for values in (value, -value)
        )
        free, there, most, least = maxima(self._comm, np.array([free, there, most, least]))
        alike = most + least <= agreement * np.maximum(np.abs(most), np.abs(least))
        planes = (free == 0.0) & (there > 0.0) & alike
        whole[self._groups] = np.any(on & planes, axis=1)
        return whole if np.any(planes) else None


def prescribe(
    dofs: TornDofs,
    bcs: Sequence[fem.DirichletBC],
    ends: EndPlanes | None = None,
    agreement: float = 1e-10,
) -> Prescribed:
    """Collect Dirichlet values of all copies of nodes. Collective.

    Planes of symmetry are looked for among ``ends``.

    Raise an InputError where a value is not finite, or values at a node differ by more than
    ``agreement``, relative to the largest.
    """
    size = dofs.V.dofmap.index_map.size_local * dofs.bs
    values = np.full((len(bcs), size), np.nan)
    for row, bc in zip(values, bcs, strict=True):
        bc.set(row)
    low = np.fmin.reduce(values, axis=0, initial=np.inf)
    high = np.fmax.reduce(values, axis=0, initial=-np.inf)
    low = dofs.reduce(dofs.to_primal(low).reshape(-1, dofs.bs), np.minimum)
    high = dofs.reduce(dofs.to_primal(high).reshape(-1, dofs.bs), np.maximum)
    flag = low <= high
    with raised_on_all_ranks(dofs.comm):
        for number, bc in enumerate(bcs):
            value = bc.g.x.array if hasattr(bc.g, "x") else bc.g.value
            if not np.all(np.isfinite(value)):
                raise InputError(f"Dirichlet condition {number} has a value that is not finite")
        scale = np.abs(np.concatenate((low[flag], high[flag]))).max(initial=0.0)
        apart = np.subtract(high, low, out=np.zeros_like(low), where=flag)
        if np.any(wrong := apart > agreement * scale):
            at = tuple(np.argwhere(wrong)[0])
            raise InputError(
                f"Dirichlet conditions contradict each other: component {at[1]} of a node is "
                f"prescribed as {low[at]} and as {high[at]} "
                f"(at {wrong.sum()} components of nodes on this rank)"
            )
    value = np.where(flag, low, 0.0)
    return Prescribed(flag, value, ends.across(flag, value, agreement) if ends else None)


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
    own, component = V._cpp_object, list(space.component())
    if len(component) == 1 and 0 <= component[0] < V.num_sub_spaces:
        own = own.sub(component)
    if not is_same_space(space, own):
        raise InputError(
            f"{what} is on {space_in_words(space)}; expected the space of a, "
            f"{space_in_words(V._cpp_object)}, or V.sub(i) of it"
        )
    size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
    highest = int(bc.dof_indices()[0].max(initial=-1))
    if highest >= size:
        raise InputError(
            f"{what} prescribes the unknown {highest}, but this rank has {size}; expected "
            "unknowns that were located in the space of a"
        )


def _check_not_on_tears(bcs: Sequence[fem.DirichletBC], dofs: TornDofs) -> None:
    """Raise if a condition prescribes facets of tears as if they were of the boundary. Collective.

    To DOLFINx tears are exterior facets, too; a condition knows unknowns only. It is wrong if each
    of its unknowns is on an exterior facet that it prescribes wholly, in a component, some of the
    boundary, some of tears with nodes off it. So a region with nodes inside of subdomains may be
    prescribed, and a surface inside a body in a condition of its own.
    """
    decomposition = dofs.decomposition
    if not bcs or not decomposition.is_torn:
        return
    tears, outer = (dofs.facet_nodes(f) for f in (decomposition.tears, decomposition.boundary))
    at_boundary = np.zeros(dofs.num_nodes, dtype=bool)
    at_boundary[outer] = True
    at_boundary = dofs.spread(dofs.reduce(at_boundary, np.logical_or))
    within = ~np.all(at_boundary[tears], axis=1)
    count = np.empty((len(bcs), 3, dofs.bs), dtype=np.int64)
    for number, bc in enumerate(bcs):
        given = np.zeros(dofs.num_nodes * dofs.bs, dtype=bool)
        given[bc.dof_indices()[0]] = True
        given = dofs.to_primal(given).reshape(-1, dofs.bs)
        of_tears, of_outer = (np.all(given[nodes], axis=1) for nodes in (tears, outer))
        count[number, 0] = np.sum(of_tears[within], axis=0)
        count[number, 1] = np.sum(of_outer, axis=0)
        for nodes, whole in ((tears, of_tears), (outer, of_outer)):
            facet, component = np.nonzero(whole)
            given[nodes[facet], component[:, None]] = False
        count[number, 2] = np.sum(given, axis=0)
    tear, boundary, others = np.moveaxis(dofs.comm.allreduce(count), 1, 0)
    wrong = np.max(np.where((boundary > 0) & (others == 0), tear, 0), axis=1)
    if np.any(wrong):
        number = int(np.argmax(wrong > 0))
        raise InputError(
            f"Dirichlet condition {number} prescribes {(wrong[number] + 1) // 2} facets that lie "
            "on tears inside a body, besides facets of its boundary: to DOLFINx tears are "
            "exterior, too; expected facets of the boundary: decomposition.boundary, "
            "decomposition.facets(name) or decomposition.locate_facets(marker); a surface inside a "
            "body, and nodes of a region that are not on the boundary, are for a condition of "
            "their own"
        )
