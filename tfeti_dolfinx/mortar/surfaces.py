"""Contact surfaces: their facets, and the integrals of the hats of their nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import JIT_OPTIONS
from tfeti_dolfinx.common.parallel import box_over_ranks
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs


def surface_facets(decomposition: Decomposition, name: str | int) -> Array:
    """Local facets of a contact surface, ascending. Collective.

    Raises:
        InputError: The surface is unknown, empty, or lies inside a body.
    """
    facets = decomposition.facets(name)
    comm = decomposition.comm
    if comm.allreduce(len(facets)) == 0:
        raise InputError(f"surface {name!r} has no facets; expected a part of the boundary")
    inside = np.setdiff1d(facets, decomposition.boundary, assume_unique=True)
    if count := comm.allreduce(len(inside)):
        raise InputError(
            f"surface {name!r}: {count} of its facets lie inside a body; "
            "expected facets on the boundary only"
        )
    return facets


def hat_integrals(dofs: TornDofs, names: Sequence[str | int], thickness: Any = 1.0) -> Array:
    """Return ∫φ_i of the hats of degree 1 over the union of surfaces, by names or tags. Collective.

    They are weighted by the thickness, a number or a scalar in UFL. One integral per owned group,
    zero off the surfaces and off the vertices, shape ``(g,)``.
    """
    if not names:
        return np.zeros(dofs.num_groups)
    (W, node), decomposition = dofs.hats, dofs.decomposition
    tags = tuple(sorted({decomposition.surface(name) for name in names}))
    ds = ufl.Measure("ds", domain=W.mesh, subdomain_data=decomposition.facet_tags)
    weight = fem.Constant(W.mesh, thickness) if isinstance(thickness, float) else thickness
    form = fem.form(weight * ufl.TestFunction(W) * ds(tags), jit_options=JIT_OPTIONS)
    per_node = np.zeros(dofs.num_nodes)
    per_node[node] = fem.assemble_vector(form).array
    return dofs.reduce(per_node, np.add, 0.0)


def surface_nodes(dofs: TornDofs, facets: Array) -> Array:
    """Primal nodes of local facets."""
    fdim = dofs.V.mesh.topology.dim - 1
    nodes = fem.locate_dofs_topological(dofs.V, fdim, facets.astype(np.int32), remote=False)
    return dofs.primal_nodes(nodes)


def group_points(dofs: TornDofs) -> Array:
    """Return coordinates of the owned groups, shape ``(g, 3)``. Collective."""
    return dofs.reduce(dofs.points(), np.minimum, np.inf)


def extent(decomposition: Decomposition, facets: Array) -> float:
    """Return the length of the diagonal of the box of local facets of a surface. Collective."""
    mesh = decomposition.mesh
    fdim = mesh.topology.dim - 1
    mesh.topology.create_connectivity(fdim, mesh.topology.dim)
    x = np.empty((0, 3))
    if len(facets):  # DOLFINx divides by their number
        nodes = dmesh.entities_to_geometry(mesh, fdim, facets.astype(np.int32))
        x = mesh.geometry.x[np.unique(nodes)]
    low, high = box_over_ranks(decomposition.comm, x)
    return float(np.linalg.norm(high - low))


def diameter(decomposition: Decomposition) -> float:
    """Return the length of the diagonal of the mesh's box. Collective."""
    low, high = box_over_ranks(decomposition.comm, decomposition.mesh.geometry.x)
    return float(np.linalg.norm(high - low))
