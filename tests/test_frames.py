"""Frames of contact conditions, and what follows from them: coefficients, gaps, slips, rows."""

import numpy as np
import pytest
import ufl
from bodies import ORDERS, dofs_on, gathered, nodal, searched, sided, stacked
from dolfinx import fem
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from scenes import decomposed, measures

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.contact.records import relative_displacement, slips
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import group_points
from tfeti_dolfinx.mortar.segments import frames
from tfeti_dolfinx.mortar.tolerances import SEARCH


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def simple_normals(gdim):
    """Normals of plane faces as engineers draw them: axes, diagonals, simple slopes."""
    steps = np.arange(-4, 5)
    grid = np.stack(np.meshgrid(*[steps] * gdim), axis=-1).reshape(-1, gdim)
    return unit(grid[np.any(grid != 0, axis=1)])


@given(st.integers(1, 3), st.integers(0, 1000))
def test_frames_are_orthonormal_and_right_handed(gdim, seed):
    normal = unit(np.random.default_rng(seed).standard_normal((20, gdim)))
    frame = frames(normal)
    assert frame.shape == (20, gdim, gdim)
    assert np.array_equal(frame[:, 0], normal)
    assert np.allclose(frame @ frame.transpose(0, 2, 1), np.eye(gdim), rtol=0, atol=1e-14)
    if gdim > 1:
        assert np.allclose(np.linalg.det(frame), 1.0)


@pytest.mark.parametrize("gdim", [2, 3])
def test_rounding_of_a_normal_does_not_turn_its_tangents(gdim):
    normal = simple_normals(gdim)
    assert np.all(np.abs(np.abs(normal[:, 0]) - SEARCH.axis_switch) > 1e-3)
    rng = np.random.default_rng(0)
    for size in (1e-15, 1e-9):
        moved = unit(normal + size * rng.standard_normal(normal.shape))
        assert np.allclose(frames(moved), frames(normal), rtol=0, atol=20 * size)


@pytest.mark.parametrize(
    ("cell", "sides", "gap", "degree"),
    [
        ("triangle", ORDERS[0], 0.1, 2),
        ("quadrilateral", ORDERS[1], 0.0, 1),
        ("tetrahedron", ORDERS[1], 0.1, 1),
        ("hexahedron", ORDERS[0], 0.0, 2),
    ],
)
def test_slip_and_gap_of_moved_bodies(cell, sides, gap, degree):
    """One body moves by t + Ax, or both rotate: linear fields are met exactly."""
    d = stacked(cell, 3, 4, 4, gap=gap)
    dofs = dofs_on(d, degree)
    records, gdim = searched([sided(*sides, reach=0.5)], dofs), dofs.bs
    assert MPI.COMM_WORLD.allreduce(len(records)) > 0
    x = group_points(dofs)[records.group][:, :gdim]
    rng = np.random.default_rng(3)
    t, A = rng.standard_normal(gdim), rng.standard_normal((gdim, gdim))
    of_upper = 1.0 if sides[0] == "upper bottom" else -1.0

    def upper_moves(x):
        return np.where(x[:, gdim - 1 :] > 0.5 * gap - 1e-9, t + x @ A.T, 0.0)

    def rotation(x):
        return t + x @ (A - A.T)

    if gap > 0.0:  # else nodes of both bodies have the same points
        at = x if of_upper > 0.0 else x + gap * records.normal
        check_motion(records, dofs, upper_moves, of_upper * (t + at @ A.T))
    away = -gap * records.normal  # from what a node meets to the node
    check_motion(records, dofs, rotation, away @ (A - A.T))


def check_motion(records, dofs, motion, v):
    """The relative displacement is v, and slip its tangential part."""
    u = nodal(dofs, motion)
    assert np.allclose(relative_displacement(records, dofs, u), v, rtol=0, atol=1e-12)
    along = slips(records, dofs, u)
    assert along.shape == (len(records), dofs.bs - 1)
    tangential = v - np.sum(records.normal * v, axis=1)[:, None] * records.normal
    found = np.einsum("nt,ntg->ng", along, records.tangents)
    assert np.allclose(found, tangential, rtol=0, atol=1e-12)


def test_a_membrane_over_an_obstacle(shared_tmp):
    """Height u = −g(1 − y), held at the top, pulled down; the obstacle bears q − g."""
    g, q = 0.1, 0.3
    d = decomposed("quadrilateral", 6, 4)
    below = tfeti.SignedDistance(lambda x: 0.0 * x[0] + g, lambda x: np.eye(3)[:, :1] + 0.0 * x)
    V = fem.functionspace(d.mesh, ("Lagrange", 1))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    bcs = [fem.dirichletbc(0.0, fem.locate_dofs_topological(V, 1, d.facets("top")), V)]
    a = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx
    L = fem.Constant(d.mesh, -q) * v * measures(d)[1](d.surface("bottom"))
    contacts, options = [tfeti.Obstacle("bottom", below)], {"tfeti_rtol": 1e-10}
    p = tfeti.ContactProblem(a, L, bcs, contacts, d, petsc_options=options)
    steps, uh = tfeti.LoadSteps(p, lambda problem, time: None, [1.0]), p.u
    steps.run()
    steps.write_csv(shared_tmp / "membrane.csv")
    head, row = (shared_tmp / "membrane.csv").read_text().splitlines()
    assert head.count(",") == row.count(",") == 4
    y = uh.function_space.tabulate_dof_coordinates()[:, 1]
    assert np.allclose(uh.x.array, -g * (1.0 - y), rtol=0, atol=1e-8)
    records = p.solution.gluing.records
    assert records.frame.shape == (len(records), 1, 1)
    assert np.allclose(gathered(p.solution.contact().pressure), q - g, rtol=0, atol=1e-7)
    assert slips(records, p.dofs, p.dofs.to_primal(uh.x.array)).shape == (len(records), 0)


def test_two_surfaces_of_a_scalar_space_are_an_error():
    d = stacked("quadrilateral", 3, 4, 4)
    V = fem.functionspace(d.mesh, ("Lagrange", 1))
    with pytest.raises(InputError, match="contact of .*: the space is scalar; expected displ"):
        searched([tfeti.Contact("upper bottom", "lower top")], TornDofs(V, d))
