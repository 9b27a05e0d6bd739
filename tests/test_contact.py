"""Contact with obstacles: against an active set on the untorn mesh, and by the laws of contact."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from reference import UntornElasticity
from scenes import curved_obstacle, decomposed, displacement, hooke, problem, relative, strain

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import ContactStatus

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]

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
    gdim = gdim_of(cell)
    untorn = UntornElasticity(cell, n, (0.0,) * (gdim - 1) + (-0.05,), grading=grading)
    return untorn.solve_contact(curved_obstacle(gdim).distance)


@pytest.mark.parametrize("cell", CELLS)
def test_agrees_with_an_active_set_on_the_untorn_mesh(cell):
    n = 12 if gdim_of(cell) == 2 else 6
    p = contact_problem(cell, n)
    p.solve()
    u, lam = reference(cell, n)
    assert relative(displacement(p)[1], u) <= 1e-8
    force = p.decomposition.comm.allreduce(p.solution.contact(0).force.sum())
    assert force == pytest.approx(lam.sum(), rel=1e-7)
    assert p.report.active_contacts == np.sum(lam > 0.0)
    assert 0 < p.report.active_contacts < p.report.contact_rows


@pytest.mark.parametrize(
    "options",
    [
        {"tfeti_scaling": "multiplicity"},
        SMALSE | {"tfeti_smalse_rho": 5, "tfeti_smalse_M": 10, "tfeti_smalse_beta": 0.2},
        SMALSE | {"tfeti_mpgp_gamma": 10.0, "tfeti_mpgp_alpha": 1.0},
        {"tfeti_qp_type": "newton", "tfeti_newton_reduction": 0.1, "tfeti_newton_gamma": 0.3},
        {"tfeti_qp_type": "newton", "tfeti_pc_type": "lumped"},
    ],
)
def test_variants_find_the_same(options):
    p = contact_problem(**options)
    p.solve()
    assert relative(displacement(p)[1], reference()[0]) <= 1e-8


@pytest.mark.parametrize("subdomains", [1, 4, 16])
def test_subdomains_do_not_matter(subdomains):
    p = contact_problem("tetrahedron", 6, subdomains)
    p.solve()
    assert relative(displacement(p)[1], reference("tetrahedron")[0]) <= 1e-8


def test_the_laws_of_contact_hold_below_the_tolerance():
    p = contact_problem(tfeti_rtol=1e-6)
    p.solve()
    for name, allowed in p.report.tolerances.items():
        assert p.report.residuals[name] <= allowed, name


def test_fields_tell_the_state_of_contact():
    p = contact_problem()
    p.solve()
    s = p.solution
    status, pressure, gap = (f.x.array for f in (s.status, s.pressure, s.gap))
    z = p.u.function_space.tabulate_dof_coordinates()[:, 2]
    assert np.array_equal(status == ContactStatus.NONE, z > 1e-9)
    assert np.all((pressure > 0) == (status == ContactStatus.TOUCHING))
    assert np.all(np.abs(gap[status == ContactStatus.TOUCHING]) <= 1e-9)
    assert np.all(gap[status == ContactStatus.OPEN] > -1e-9)
    comm = p.decomposition.comm
    assert comm.allreduce(np.sum(status == ContactStatus.OPEN)) > 0
    data = s.contact(0)
    total = comm.allreduce(np.sum(data.pressure * data.area))
    assert total == pytest.approx(comm.allreduce(data.force.sum()))


def test_forces_are_in_equilibrium_with_the_stress():
    """The contact force is what the load and the clamped face leave over."""
    p = contact_problem(tfeti_rtol=1e-10)
    uh = p.solve()
    d = p.decomposition
    V = uh.function_space
    v = ufl.TestFunction(V)
    dx = ufl.dx(metadata={"quadrature_degree": 2})
    internal = fem.assemble_vector(fem.form(ufl.inner(hooke()(uh), strain(v)) * dx)).array
    lifted = p.dofs.reduce(p.dofs.to_primal(internal).reshape(-1, 3), np.add, 0.0)
    forces = np.zeros((p.dofs.num_groups, 3))
    records = p.solution.gluing.records
    forces[records.group] -= p.solution.force[:, None] * records.normal
    x = p.dofs.reduce(V.tabulate_dof_coordinates()[p.dofs.dolfinx_node], np.minimum, np.inf)
    bottom_only = np.isclose(x[:, 2], 0) & (x[:, 0] > 1e-9)
    assert d.comm.allreduce(int(np.sum(bottom_only))) > 0
    assert np.allclose(lifted[bottom_only], forces[bottom_only], atol=1e-9)


def test_an_obstacle_out_of_reach_stays_out_of_the_way():
    d = decomposed("hexahedron", 4, 4)
    far = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -10), (0, 0, 1)))
    with_it = problem(d, contacts=[far], tfeti_rtol=1e-10)
    without = problem(d, tfeti_rtol=1e-10)
    with_it.solve()
    without.solve()
    assert with_it.report.active_contacts == 0
    assert relative(displacement(with_it)[1], displacement(without)[1]) <= 1e-8


def test_nodes_out_of_reach_get_rows_only_where_they_come_to_overlap():
    # without a preconditioner: interiors of subdomains that get rows would be factored anew
    whole, part = (contact_problem(reach=reach, **SMALSE) for reach in (np.inf, 0.022))
    whole.solve()
    part.solve()
    assert part.report.far_contact_nodes > 0
    assert part.report.late_contact_rows > 0
    assert part.report.contact_rows < whole.report.contact_rows
    assert relative(displacement(part)[1], displacement(whole)[1]) <= 1e-8
    assert part.report.factorizations == whole.report.factorizations


@pytest.mark.parametrize("inside", [False, True])
def test_spheres_and_cylinders(inside):
    """A rigid ball below, or a hollow around, touches where the analysis says."""
    radius = 0.5 if not inside else 4.0
    centre = (0.7, 0.5, -radius - 0.02) if not inside else (0.7, 0.5, radius - 0.1)
    for shape in (
        tfeti.Sphere(centre, radius, inside),
        tfeti.Cylinder(centre, (0, 3, 0), radius, inside),
    ):
        d = decomposed("hexahedron", 8, 4)
        p = problem(d, (0, 0, -0.08), [tfeti.Obstacle("bottom", shape)], tfeti_rtol=1e-9)
        uh = p.solve()
        x = uh.function_space.tabulate_dof_coordinates()
        bottom = np.isclose(x[:, 2], 0)
        moved = x[bottom].T + uh.x.array.reshape(-1, 3)[bottom].T
        lowest = d.comm.allreduce(float(np.min(shape.distance(moved), initial=np.inf)), op=MPI.MIN)
        assert lowest >= -5e-3  # the condition is linear, the shape is curved
        assert p.report.active_contacts > 0


def test_two_obstacles_for_one_surface():
    d = decomposed("hexahedron", 6, 4)
    planes = [tfeti.Plane((0, 0, -0.02), (0.3, 0, 1)), tfeti.Plane((0, 0, -0.02), (-0.3, 0, 1))]
    p = problem(d, contacts=[tfeti.Obstacle("bottom", plane) for plane in planes])
    p.solve()
    assert p.report.contact_rows > 0
    assert len(p.solution.contact(1).gap) == len(p.solution.contact(0).gap)
    with pytest.raises(tfeti.InputError, match="contact 2: there are 2"):
        p.solution.contact(2)


def test_a_body_held_only_by_contact():
    d = decomposed("quadrilateral", 8, 6)
    corner = [
        tfeti.Obstacle("bottom", tfeti.Plane((0, -0.01), (0, 1))),
        tfeti.Obstacle("left", tfeti.Plane((-0.01, 0), (1, 0))),
    ]
    p = problem(d, (-0.02, -0.05), corner, clamped=(), tfeti_rtol=1e-9)
    p.solve()
    comm, s = d.comm, p.solution
    assert comm.allreduce(s.contact(0).force.sum()) == pytest.approx(0.05, rel=1e-6)
    assert comm.allreduce(s.contact(1).force.sum()) == pytest.approx(0.02, rel=1e-6)
    assert p.report.free_modes == 0


def test_a_free_motion_that_no_load_drives_is_reported():
    d = decomposed("quadrilateral", 8, 6)
    floor = [tfeti.Obstacle("bottom", tfeti.Plane((0, -0.01), (0, 1)))]
    p = problem(d, (0.0, -0.05), floor, clamped=(), tfeti_rtol=1e-9)
    uh = p.solve()
    assert p.report.free_modes == 1
    bottom = p.solution.contact(0)
    assert d.comm.allreduce(bottom.force.sum()) == pytest.approx(0.05, rel=1e-6)
    assert np.all(np.isfinite(uh.x.array))


def test_multiplications_are_counted_by_the_book():
    p = contact_problem(tfeti_rtol=1e-6, tfeti_qp_type="smalse")
    p.solve()
    r = p.report
    steps = r.cg_steps + 2 * r.expansion_steps + r.proportioning_steps
    assert r.F_multiplications == steps + 1  # F λ̄; P_Ω(0) = 0 here, so no multiplication for it
    assert r.power_method_multiplications == 15
    assert r.preconditioner_multiplications == 0
    assert 0 < r.factorizations <= 6  # some subdomains are equal
