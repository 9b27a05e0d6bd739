"""A body of boundary elements on one of finite elements: as near to all finite ones as both err."""

import numpy as np
import ufl
from bodies import held, sided, torn_boxes
from scenes import displacement, solved, vectors

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.compat import geometry_dofmap

KINDS = {
    "finite": None,
    "upper": tfeti.BoundaryElements("upper"),
    "lower": tfeti.BoundaryElements("lower"),
}


def blocks(n):
    """A block on one of half its modulus, which it touches in a part of its bottom."""
    parts = [("lower", (0.0, -1.0), (1.0, 0.0), (n, n)), ("upper", (0.0, 0.0), (1.0, 1.0), (n, n))]
    volumes = {"lower": lambda x: x[1] <= 1e-9, "upper": lambda x: x[1] >= -1e-9}
    d = torn_boxes("triangle", parts, lambda x: (x[1] > 0).astype(int), volumes=volumes)
    x, dofmap = d.mesh.geometry.x, geometry_dofmap(d.mesh)
    of_upper = np.unique(dofmap[x[dofmap][:, :, 1].mean(axis=1) > 0.0])
    x[of_upper, 1] += (0.1 * x[:, 0] ** 2 * (1.0 - x[:, 1]))[of_upper]
    return d


def probed(n, elements, grid):
    """Displacements of the nodes of a grid on sides that are free or loaded."""
    d = blocks(n)
    V, u, v = vectors(d)
    elastic = tfeti.Elasticity(d, E={"lower": 1.0, "upper": 2.0}, nu=0.3, model="plane_strain")
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    pressure = 0.01 * (1 + ufl.SpatialCoordinate(d.mesh)[0])
    L = -pressure * v[1] * ds(d.surface("upper top"))
    bcs = held(d, "lower bottom", "lower left", "upper left")(V)
    pair, more = [sided("lower top", "upper bottom", reach=0.1)], {"boundary_elements": elements}
    more |= {"petsc_options": {"tfeti_rtol": 1e-8}}
    p = solved(tfeti.ContactProblem(elastic.a(u, v), L, bcs, pair, d, **more))
    pressure = p.solution.contact(0).pressure
    assert 0.3 < d.comm.allreduce(np.sum(pressure > 0)) / d.comm.allreduce(len(pressure)) < 0.8
    x, found = displacement(p)
    on_grid = np.all(np.abs(x * grid - np.rint(x * grid)) < 1e-6, axis=1)
    right = np.isclose(x[:, 0], 1.0) & (x[:, 1] < -1e-9)
    return found[on_grid & (np.isclose(x[:, 1], 1.0) | right)]


def test_mixed_scenes_agree_within_the_sum_of_both_errors():
    """Errors are against a finer solution of the same kind of elements, so that limits differ."""
    sizes, fine = (4, 8), 32
    finest = {kind: probed(fine, KINDS[kind], sizes[0]) for kind in KINDS}
    size = np.linalg.norm(finest["finite"])
    errors, apart = [], []
    for n in sizes:
        found = {kind: probed(n, KINDS[kind], sizes[0]) for kind in KINDS}
        errors.append({k: np.linalg.norm(found[k] - finest[k]) / size for k in KINDS})
        apart.append({k: np.linalg.norm(found[k] - found["finite"]) / size for k in KINDS})
    for kind in ("upper", "lower"):
        assert errors[1][kind] < 0.4 * errors[0][kind]
        assert errors[1][kind] < 1.5 * errors[1]["finite"]
        for error, difference in zip(errors, apart, strict=True):
            assert 0 < difference[kind] < error[kind] + error["finite"], (errors, apart)
