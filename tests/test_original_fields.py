"""Functions of the mesh before it is torn, and of the torn mesh, on the other one."""

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import CELLS, box, clamp, forms, integral, largest

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.compat import interpolation_points

KINDS = {
    "P1": ("Lagrange", 1, ()),
    "P2 tensor": ("Lagrange", 2, (2, 2)),
    "P3 vector": ("Lagrange", 3, (2,)),
    "P4": ("Lagrange", 4, ()),
    "DG0": ("DG", 0, ()),
    "DG3 vector": ("DG", 3, (3,)),
    "quadrature": ("quadrature", 3, ()),
    "quadrature vector": ("quadrature", 4, (3,)),
}


def bent(cell):
    """A box without right angles, of cells in two directions or three."""
    comm, cell_type = MPI.COMM_WORLD, dmesh.to_type(cell)
    simplices = cell in ("triangle", "tetrahedron")
    ghosts = dmesh.GhostMode.shared_facet if simplices else dmesh.GhostMode.none
    if cell in ("triangle", "quadrilateral"):
        mesh = dmesh.create_rectangle(comm, [(0, 0), (1, 1)], [5, 4], cell_type, ghost_mode=ghosts)
    else:
        corners = [(0, 0, 0), (1, 1, 1)]
        mesh = dmesh.create_box(comm, corners, [3, 2, 2], cell_type, ghost_mode=ghosts)
    gdim, x = mesh.geometry.dim, mesh.geometry.x
    x[:, :gdim] += 0.02 * np.sin(7.0 * np.roll(x[:, :gdim], 1, axis=1))
    return mesh


def space(mesh, family, degree, shape):
    if family == "quadrature":
        element = basix.ufl.quadrature_element(mesh.basix_cell(), degree=degree, value_shape=shape)
    else:
        element = basix.ufl.element(family, mesh.basix_cell(), degree, shape=shape)
    return fem.functionspace(mesh, element)


def wave(V, name="wave"):
    """The interpolant of a function that has no symmetry."""
    f, x = fem.Function(V, name=name), ufl.SpatialCoordinate(V.mesh)
    s = ufl.sin(3 * x[0] + 2 * x[1] ** 2 - x[-1 % len(x)]) + x[0]
    shape = V.ufl_element().reference_value_shape
    values = np.array([(i + 1) * s + i * x[1] for i in range(int(np.prod(shape, dtype=int)))])
    expression = ufl.as_tensor(values.reshape(shape).tolist()) if shape else s
    f.interpolate(fem.Expression(expression, interpolation_points(V)))
    f.x.scatter_forward()
    return f


@pytest.mark.parametrize("cell", [*CELLS, "cut"])
def test_functions_are_the_same_on_both_meshes(cell):
    """A mesh that is cut from another has its cells' numbers from DOLFINx, not from a file."""
    mesh = bent("triangle" if cell == "cut" else cell)
    if cell == "cut":
        cells = dmesh.locate_entities(mesh, 2, lambda x: x[0] < 0.7)
        mesh = dmesh.create_submesh(mesh, 2, cells)[0]
    d = tfeti.decompose(mesh, 3)
    for kind in KINDS.values():
        untorn, torn = wave(space(mesh, *kind), "T"), wave(space(d.mesh, *kind), "u")
        there = d.from_original(untorn)
        assert there.function_space.mesh is d.mesh
        assert there.name == "T"
        assert largest(there.x.array - torn.x.array) < 1e-13, kind
        assert np.array_equal(d.to_original(there).x.array, untorn.x.array), kind
        back = d.to_original(torn)
        assert back.function_space.mesh is mesh
        assert back.name == "u"
        assert largest(back.x.array - untorn.x.array) < 1e-13, kind


def test_a_jump_at_a_tear(comm):
    """A continuous space cannot have it: the mean; the discontinuous one keeps it."""
    square = dmesh.create_unit_square(comm, 4, 4, dmesh.CellType.quadrilateral)
    d = tfeti.decompose(square, lambda x: x[0] > 0.5)
    for family in ("Lagrange", "DG"):
        u = fem.Function(space(d.mesh, family, 1, ()))
        cells = u.function_space.dofmap.list
        u.x.array[cells] = d.cell_subdomain[:, None]
        f = d.to_original(u)
        x = f.function_space.tabulate_dof_coordinates()[:, 0]
        if family == "DG":
            assert np.isclose(integral(f * f * ufl.dx), 0.5)
        else:
            assert np.array_equal(f.x.array, np.where(x > 0.51, 1.0, np.where(x < 0.49, 0.0, 0.5)))


def test_a_load_of_the_mesh_before_it_is_torn(comm):
    """Of thermal strain of a temperature that was computed before: as with one subdomain."""
    mesh, facet_tags, names = box("triangle", 6)
    T = wave(space(mesh, "Lagrange", 2, ()))
    energy = []
    for subdomains in (1, 5):
        d = tfeti.decompose(mesh, subdomains, facet_tags=facet_tags, surfaces=names)
        V, a, _ = forms(d.mesh, d.facet_tags, (0.0, 0.0), d.surface("top"))
        L = d.from_original(T) * ufl.div(ufl.TestFunction(V)) * ufl.dx
        bc = clamp(V, d.facets("left"))
        u = tfeti.ContactProblem(a, L, [bc], [], d, petsc_options={"rtol": 1e-10}).solve()
        back = d.to_original(u)
        assert back.function_space.mesh is mesh
        energy.append(integral(T * ufl.div(back) * ufl.dx))
    assert energy[0] > 0.0
    assert np.isclose(*energy, rtol=1e-8)
