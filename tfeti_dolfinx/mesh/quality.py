"""How far from regular the cells of a mesh are."""

from __future__ import annotations

import basix
import numpy as np
from dolfinx import mesh as dmesh

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.compat import geometry_dofmap
from tfeti_dolfinx.mesh.entities import cell_entities

# columns: the edges of a regular simplex that leave its first vertex
REGULAR = {
    "triangle": np.array([[1.0, 0.5], [0.0, 0.75**0.5]]),
    "tetrahedron": np.array(
        [[1.0, 0.5, 0.5], [0.0, 0.75**0.5, 12**-0.5], [0.0, 0.0, (2 / 3) ** 0.5]]
    ),
}


def flatness(mesh: dmesh.Mesh) -> Array:
    """‖J‖‖J⁻¹‖/gdim of each local cell, in Frobenius norms: 1 for a regular one, shape ``(c,)``.

    J is the map from a regular cell, in its middle. A box whose longest edge is a times its
    shortest has about a/2; cells without volume have as much as a float can be.
    """
    cell_type = mesh.topology.cell_type
    cell = getattr(basix.CellType, cell_type.name)
    corners = geometry_dofmap(mesh)[:, : len(cell_entities(cell_type, 0))]
    gdim = mesh.geometry.dim
    element = basix.create_element(basix.ElementFamily.P, cell, 1)
    middle = basix.geometry(cell).mean(axis=0)[None]
    slopes = element.tabulate(1, middle)[1:, 0, :, 0]
    J = np.einsum("dv,cvg->cgd", slopes, mesh.geometry.x[corners, :gdim])
    if cell_type.name in REGULAR:
        J = J @ np.linalg.inv(REGULAR[cell_type.name])
    if gdim == 2:
        cofactor, det = J, J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    else:
        cofactor = np.cross(J[:, [1, 2, 0]], J[:, [2, 0, 1]])
        det = np.sum(J[:, 0] * cofactor[:, 0], axis=1)
    sizes = np.linalg.norm(J, axis=(1, 2)) * np.linalg.norm(cofactor, axis=(1, 2))
    return np.asarray(sizes / (gdim * np.maximum(np.abs(det), TINY)))
