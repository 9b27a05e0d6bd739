"""Scenes whose discretisation error is known, by a closed form or by a finer mesh of the same."""

import numpy as np
import pytest
import ufl
from bodies import held, pressed, two_body_problem
from dolfinx import fem, geometry
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import hooke, strain, vectors

import tfeti_dolfinx as tfeti
from benchmarks.pressures import LineContact
from demos import scene
from meshes.half_cylinder import build
from meshes.rings import INNER, MIDDLE, OUTER, lame_pressure, rings
from tfeti_dolfinx.common.compat import interpolation_points

E, NU = 1.0, 0.3
OVERLAP = MIDDLE / 1500
HALF_WIDTH = 0.04


def hertz(elements, **options):
    """The half cylinder of ``demos/hertz_2d.py``, so many elements along the half width."""
    model = None
    if MPI.COMM_WORLD.rank == 0:
        growth = 3.6 / elements
        model = build(1.0, HALF_WIDTH / elements, 1.5 * HALF_WIDTH, growth, partitions=8)
    d = tfeti.read_gmsh(model, MPI.COMM_WORLD)
    load = LineContact.from_half_width(HALF_WIDTH, 1.0, E / (1 - NU**2)).load
    plane = tfeti.Obstacle("contact", tfeti.Plane((0, 0), (0, 1)), reach=2 * HALF_WIDTH**2)
    pressure = pressed(d, load / 2, "top")
    return two_body_problem(d, pressure, held(d, "axis"), [plane], **options)


def ball(unknowns, **options):
    """The half ball of ``demos/hertz_3d.py``."""
    made = scene("hertz_3d", ["--unknowns", unknowns])
    return tfeti.ContactProblem(**made, petsc_options=options)


# scenes in 2D, their sizes, and that of the mesh beside which they are judged
AGAINST_FINER = [(hertz, (6, 12), 30), pytest.param(hertz, (6, 12, 24), 60, marks=pytest.mark.slow)]


def ring_problem(cells, degree, mesh, springs=1e-6, options=None, **contact):
    """Two rings; weak springs hold them against motions that contact leaves free."""
    d = rings(MPI.COMM_WORLD, cells, degree, **mesh)
    V, u, v = vectors(d, degree)
    dx = ufl.Measure("dx", domain=d.mesh, metadata={"quadrature_degree": 4 * degree - 2})
    spring, L = fem.Constant(d.mesh, springs), ufl.ZeroBaseForm((v,))
    a = ufl.inner(hooke()(u), strain(v)) * dx + spring * ufl.dot(u, v) * dx
    given = {"stress": hooke(), "petsc_options": options or {"rtol": 1e-8}}
    return tfeti.ContactProblem(a, L, [], [tfeti.Contact("shaft", "hub", **contact)], d, **given)


def shrink_fit(cells, degree=1, triangles=True, **options):
    """A ring shrunk on another one; degree 2 on curved cells."""
    mesh, sizes = {"triangles": triangles}, (3 * cells, 4 * cells)
    return ring_problem(sizes, degree, mesh, options=options, gap=-OVERLAP)


def density(sigma):
    """σ : C⁻¹σ in UFL."""
    return ((1 + NU) * ufl.inner(sigma, sigma) - NU * ufl.tr(sigma) ** 2) / E


def lame_error(p):
    """Error of a shrink fit in energy, and the energy, against Lamé's stress. Collective."""
    mesh, uh = p.decomposition.mesh, p.solution.displacement
    x = ufl.SpatialCoordinate(mesh)
    r2 = x[0] ** 2 + x[1] ** 2
    body = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    at = body.function_space.tabulate_dof_coordinates()
    body.x.array[:] = np.linalg.norm(at, axis=1) > MIDDLE
    q = lame_pressure(OVERLAP)
    a, b, c = INNER**2, MIDDLE**2, OUTER**2
    outside = ufl.gt(body, 0.5)
    mean = ufl.conditional(outside, q * b / (c - b), -q * b / (b - a))
    apart = ufl.conditional(outside, -q * b * c / (c - b), q * a * b / (b - a)) / r2
    s = ((x[0] ** 2 - x[1] ** 2) * apart / r2, 2 * x[0] * x[1] * apart / r2)
    sigma = ufl.as_tensor([[mean + s[0], s[1], 0], [s[1], mean - s[0], 0], [0, 0, 2 * NU * mean]])
    dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 6})
    parts = [fem.assemble_scalar(fem.form(density(t) * dx)) for t in (sigma - hooke()(uh), sigma)]
    return np.sqrt(p.dofs.comm.allreduce(np.array(parts)))


def stress_of_cells(p):
    """Midpoints, areas and stresses of this rank's cells, of displacements of degree 1."""
    mesh, tdim = p.decomposition.mesh, p.decomposition.mesh.topology.dim
    W, Q = (fem.functionspace(mesh, ("DG", 0, *shape)) for shape in (((3, 3),), ()))
    sigma = fem.Function(W)
    expression = hooke()(p.solution.displacement)
    sigma.interpolate(fem.Expression(expression, interpolation_points(W)))
    areas = fem.assemble_vector(fem.form(ufl.TestFunction(Q) * ufl.dx)).array
    cells = np.arange(len(p.decomposition.cell_subdomain), dtype=np.int32)
    values = sigma.x.array.reshape(-1, 3, 3)[np.asarray(W.dofmap.list)[:, 0]]
    area = areas[np.asarray(Q.dofmap.list)[:, 0]]
    return dmesh.compute_midpoints(mesh, tdim, cells), area, values


def error_against(p, fine):
    """Error in energy on one rank, and the energy, against ``stress_of_cells`` of a finer mesh."""
    mesh, (points, area, sigma) = p.decomposition.mesh, fine
    tdim = mesh.topology.dim
    cells = np.arange(len(p.decomposition.cell_subdomain), dtype=np.int32)
    tree = geometry.bb_tree(mesh, tdim, entities=cells)
    found = geometry.compute_colliding_cells(
        mesh, geometry.compute_collisions_points(tree, points), points
    )
    first, inside = np.zeros(len(points), dtype=np.int32), np.diff(found.offsets) > 0
    first[inside] = found.array[found.offsets[:-1][inside]]
    middle = geometry.create_midpoint_tree(mesh, tdim, cells)
    first[~inside] = geometry.compute_closest_entity(tree, middle, mesh, points[~inside])

    def norm(e):
        squares = (1 + NU) * np.einsum("nij,nij->n", e, e) - NU * np.einsum("nii->n", e) ** 2
        return np.sqrt(area @ squares / E)

    return norm(stress_of_cells(p)[2][first] - sigma), norm(sigma)
