"""Contact with obstacles: against an active set on the untorn mesh, and by the laws of contact."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from reference.untorn import on_plane, untorn_box
from scenes import (
    CELLS,
    curved_obstacle,
    decomposed,
    displacement,
    elastic,
    problem,
    relative,
    solved,
)

import tfeti_dolfinx as tfeti

SMALSE = {"tfeti_qp_type": "smalse"}


def gdim_of(cell):
    return 2 if cell in ("triangle", "quadrilateral") else 3


def contact_problem(cell="hexahedron", n=6, subdomains=6, grading=1.0, reach=np.inf, **options):
    gdim = gdim_of(cell)
    d = decomposed(cell, n, subdomains, grading=grading)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=reach)
    options = {"tfeti_rtol": 1e-10, **options}
    return problem(d, (0.0,) * (gdim - 1) + (-0.05,), [obstacle], **options)


def reference(cell="hexahedron", n=6, grading=1.0):
    """Displacement and forces, of conditions along the last axis."""
    gdim = gdim_of(cell)
    scene = untorn_box(cell, n, (0.0,) * (gdim - 1) + (-0.05,), grading=grading)
    frame = np.vstack((-np.eye(gdim)[-1], np.eye(gdim)[:-1]))
    met = on_plane(scene, np.zeros(gdim - 1), frame, curved_obstacle(gdim).distance)
    return met.solve(), met.force[:, 0]


@pytest.mark.parametrize("cell", CELLS)
def test_agrees_with_an_active_set_on_the_untorn_mesh(cell):
    n = 12 if gdim_of(cell) == 2 else 6
    p = solved(contact_problem(cell, n))
    u, lam = reference(cell, n)
    assert relative(displacement(p)[1], u) <= 1e-8
    force = p.decomposition.comm.allreduce(p.solution.contact(0).force.sum())
    assert force == pytest.approx(lam.sum(), rel=1e-7)
    assert p.report.active_contacts == np.sum(lam > 0.0)
    assert 0 < p.report.active_contacts < p.report.contact_rows


@pytest.mark.parametrize(
    "options",
    [
        SMALSE | {"tfeti_smalse_rho": 5, "tfeti_smalse_M": 10, "tfeti_mpgp_gamma": 10.0},
        {"tfeti_newton_reduction": 0.1, "tfeti_newton_gamma": 0.3, "tfeti_pc_type": "lumped"},
        {"tfeti_scaling": "multiplicity"},
    ],
)
def test_variants_find_the_same(options):
    p = solved(contact_problem(**options))
    assert relative(displacement(p)[1], reference()[0]) <= 1e-8


def test_the_laws_of_contact_hold_below_the_tolerance():
    p = solved(contact_problem(tfeti_rtol=1e-6))
    for name, allowed in p.report.tolerances.items():
        assert p.report.residuals[name] <= allowed, name


def test_forces_are_in_equilibrium_with_the_stress():
    """The contact force is what the load and the clamped face leave over."""
    p = contact_problem(tfeti_rtol=1e-10)
    uh = p.solve()
    d = p.decomposition
    V = uh.function_space
    v = ufl.TestFunction(V)
    internal = fem.assemble_vector(fem.form(elastic(uh, v))).array
    lifted = p.dofs.reduce(p.dofs.to_primal(internal).reshape(-1, 3), np.add)
    forces = np.zeros((p.dofs.num_groups, 3))
    records = p.solution.gluing.records
    forces[records.group] -= p.solution.force[:, None] * records.normal
    x = p.dofs.reduce(V.tabulate_dof_coordinates()[p.dofs.dolfinx_node], np.minimum)
    bottom_only = np.isclose(x[:, 2], 0) & (x[:, 0] > 1e-9)
    assert d.comm.allreduce(int(np.sum(bottom_only))) > 0
    assert np.allclose(lifted[bottom_only], forces[bottom_only], atol=1e-9)


@pytest.mark.parametrize(
    "shape",
    [
        tfeti.Sphere((0.7, 0.5, -0.52), 0.5),
        tfeti.Cylinder((0.7, 0.5, 3.9), (0, 3, 0), 4.0, inside=True),
    ],
)
def test_spheres_and_cylinders(shape):
    """A rigid ball below, or a hollow around, touches where the analysis says."""
    d = decomposed("hexahedron", 6, 4)
    p = problem(d, (0, 0, -0.08), [tfeti.Obstacle("bottom", shape)], tfeti_rtol=1e-9)
    uh = p.solve()
    x = uh.function_space.tabulate_dof_coordinates()
    bottom = np.isclose(x[:, 2], 0)
    moved = x[bottom].T + uh.x.array.reshape(-1, 3)[bottom].T
    lowest = d.comm.allreduce(float(np.min(shape.distance(moved), initial=np.inf)), op=MPI.MIN)
    assert lowest >= -5e-3  # the condition is linear, the shape is curved
    assert p.report.active_contacts > 0


def test_a_body_held_only_by_contact():
    d = decomposed("quadrilateral", 8, 6)
    corner = [
        tfeti.Obstacle("bottom", tfeti.Plane((0, -0.01), (0, 1))),
        tfeti.Obstacle("left", tfeti.Plane((-0.01, 0), (1, 0))),
    ]
    p = solved(problem(d, (-0.02, -0.05), corner, clamped=(), tfeti_rtol=1e-9))
    comm, s = d.comm, p.solution
    assert comm.allreduce(s.contact(0).force.sum()) == pytest.approx(0.05, rel=1e-6)
    assert comm.allreduce(s.contact(1).force.sum()) == pytest.approx(0.02, rel=1e-6)
    assert p.report.free_modes == 0


def test_multiplications_are_counted_by_the_book():
    p = solved(contact_problem(tfeti_rtol=1e-6, tfeti_qp_type="smalse"))
    r = p.report
    steps = r.cg_steps + 2 * r.expansion_steps + r.proportioning_steps
    assert r.F_multiplications == steps + 1  # F λ̄; P_Ω(0) = 0 here, so no multiplication for it
    assert r.power_method_multiplications == 15
    assert r.preconditioner_multiplications == 0
    assert 0 < r.factorizations <= 6  # some subdomains are equal
