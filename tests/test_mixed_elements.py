"""A body of boundary elements on one of finite elements: as near to all finite ones as both err."""

import numpy as np
import pytest
import ufl
from bodies import boxes, held, sided
from dolfinx import fem
from dolfinx import mesh as dmesh
from scenes import displacement

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.compat import geometry_dofmap

KINDS = {
    "finite": None,
    "upper": tfeti.BoundaryElements("upper"),
    "lower": tfeti.BoundaryElements("lower"),
}
# how much higher the upper block's bottom is; in space its facets stay flat
RISE = {"triangle": lambda x: 0.1 * x[:, 0] ** 2, "hexahedron": lambda x: 0.1 * x[:, 0]}


def blocks(cell, n):
    """A block on one of half its modulus, which it touches in a part of its bottom."""
    gdim = 2 if cell == "triangle" else 3
    low, high, up = (0.0,) * (gdim - 1), (1.0,) * (gdim - 1), gdim - 1
    mesh, facet_tags, names = boxes(
        cell,
        [
            ("lower", (*low, -1.0), (*high, 0.0), (n,) * gdim),
            ("upper", (*low, 0.0), (*high, 1.0), (n,) * gdim),
        ],
    )
    cells = np.arange(len(geometry_dofmap(mesh)), dtype=np.int32)
    above = (dmesh.compute_midpoints(mesh, gdim, cells)[:, up] > 0).astype(np.int32)
    x, dofmap = mesh.geometry.x, geometry_dofmap(mesh)
    of_upper = np.zeros(len(x), dtype=bool)
    of_upper[dofmap[above > 0].ravel()] = True
    x[of_upper, up] += (RISE[cell](x) * (1.0 - x[:, up]))[of_upper]
    return tfeti.decompose(
        mesh,
        lambda x: (x[up] > 0).astype(int),
        cell_tags=dmesh.meshtags(mesh, gdim, cells, 1 + above),
        facet_tags=facet_tags,
        volumes={"lower": 1, "upper": 2},
        surfaces=names,
    )


def probed(cell, n, elements, grid):
    """Displacements of the nodes of a grid on sides that are free or loaded."""
    d = blocks(cell, n)
    gdim = d.mesh.geometry.dim
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (gdim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    model = {"model": "plane_strain"} if gdim == 2 else {}
    elastic = tfeti.Elasticity(d, E={"lower": 1.0, "upper": 2.0}, nu=0.3, **model)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    pressure = 0.01 * (1 + ufl.SpatialCoordinate(d.mesh)[0])
    sides = ["lower bottom", "lower left", "upper left"]
    if gdim == 3:
        sides += ["lower front", "upper front"]
    p = tfeti.ContactProblem(
        elastic.a(u, v),
        -pressure * v[gdim - 1] * ds(d.surface("upper top")),
        held(d, *sides)(V),
        [sided("lower top", "upper bottom", reach=0.1)],
        d,
        petsc_options={"tfeti_rtol": 1e-8},
        boundary_elements=elements,
    )
    p.solve()
    pressure = p.solution.contact(0).pressure
    assert 0.3 < d.comm.allreduce(np.sum(pressure > 0)) / d.comm.allreduce(len(pressure)) < 0.8
    x, found = displacement(p)
    p.destroy()
    on_grid = np.all(np.abs(x * grid - np.rint(x * grid)) < 1e-6, axis=1)
    right = np.isclose(x[:, 0], 1.0) & (x[:, gdim - 1] < -1e-9)
    return found[on_grid & (np.isclose(x[:, gdim - 1], 1.0) | right)]


SLOW = pytest.param("hexahedron", (2, 4), 8, marks=pytest.mark.slow)


@pytest.mark.parametrize(("cell", "sizes", "fine"), [("triangle", (4, 8), 32), SLOW])
def test_mixed_scenes_agree_within_the_sum_of_both_errors(cell, sizes, fine):
    """Errors are against a finer solution of the same kind of elements, so that limits differ."""
    finest = {kind: probed(cell, fine, KINDS[kind], sizes[0]) for kind in KINDS}
    size = np.linalg.norm(finest["finite"])
    errors, apart = [], []
    for n in sizes:
        found = {kind: probed(cell, n, KINDS[kind], sizes[0]) for kind in KINDS}
        errors.append({k: np.linalg.norm(found[k] - finest[k]) / size for k in KINDS})
        apart.append({k: np.linalg.norm(found[k] - found["finite"]) / size for k in KINDS})
    for kind in ("upper", "lower"):
        assert errors[1][kind] < 0.4 * errors[0][kind]
        assert errors[1][kind] < 1.5 * errors[1]["finite"]
        for error, difference in zip(errors, apart, strict=True):
            assert 0 < difference[kind] < error[kind] + error["finite"], (errors, apart)
