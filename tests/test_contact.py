"""Contact with obstacles: against an active set on the untorn mesh; sides, and what is in reach."""

import numpy as np
import pytest
import ufl
from bodies import (
    gathered,
    held,
    pressed,
    sided,
    sides_of,
    stacked,
    stiffer_above,
    two_body_problem,
)
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


UPPER, LOWER = "upper bottom", "lower top"


def scene(
    contact, n=(4, 4), stiffness=1.0, cell="quadrilateral", degree=1, subdomains=4, **options
):
    """A box on a box, n = (cells of the lower, of the upper); the upper one is stiffer."""
    d = stacked(cell, *n, subdomains)
    stress, bcs = stiffer_above(d, stiffness), held(d, *sides_of(cell))
    return solved(two_body_problem(d, pressed(d), bcs, [contact], degree, stress=stress, **options))


@pytest.mark.parametrize("sides", [(UPPER, LOWER), (LOWER, UPPER)])
@pytest.mark.parametrize(
    ("n", "stiffness", "secondary"),
    [((3, 6), 0.1, LOWER), ((6, 3), 5.0, UPPER), ((16, 15), 5.0, LOWER), ((4, 4), 1.0, None)],
)
def test_the_coarser_side_is_taken_of_equal_meshes_the_softer_one(n, stiffness, secondary, sides):
    p = scene(tfeti.Contact(*sides), n, stiffness)
    expected = secondary or sides[0]  # of two equal ones the first
    assert p.solution.contacts[0].surfaces[0] == expected
    _, dof = p.dofs.scalar
    height = p.u.function_space.tabulate_dof_coordinates()[p.dofs.dolfinx_node, 1]
    pressure = p.solution.pressure.x.array[dof]
    assert np.allclose(pressure[pressure > 0.0], 0.1, atol=1e-5)
    assert np.allclose(height[pressure > 0.0], 0.0)


@pytest.mark.parametrize(
    ("cell", "degree", "subdomains"), [("triangle", 2, 5), ("tetrahedron", 1, 2)]
)
def test_the_side_is_the_same_for_all_elements_and_subdomains(cell, degree, subdomains):
    p = scene(tfeti.Contact(UPPER, LOWER), (2, 3), 1.0, cell, degree, subdomains)
    assert p.solution.contacts[0].surfaces == (LOWER, UPPER)


@pytest.mark.parametrize(("n", "factor"), [((16, 2), 40.0), ((1, 4), 4000.0)])
def test_a_side_is_judged_where_bodies_meet(n, factor, caplog):
    """The lower one is coarse, but where the upper one stands; or is a facet far larger than it."""
    for contact in (sided(LOWER, UPPER), tfeti.Contact(LOWER, UPPER)):
        d = stacked("quadrilateral", *n, 4, upper=(0.0, 0.25))
        x = d.mesh.geometry.x
        far = (x[:, 1] < 1e-9) & (x[:, 0] > 0.25)
        x[far, 0] = 0.25 + factor * (x[far, 0] - 0.25)
        bcs = held(d, "lower bottom", "lower left", "upper left")
        p = solved(two_body_problem(d, pressed(d), bcs, [contact]))
    assert p.solution.contacts[0].surfaces == (UPPER, LOWER)
    assert ("may lack conditions" in caplog.text) == (n[0] == 1 and d.comm.rank == 0)


def test_a_choice_that_is_much_the_worse_one_is_warned_of(caplog):
    for named in (UPPER, stacked("quadrilateral").surface(UPPER)):
        p = scene(tfeti.Contact(LOWER, UPPER, secondary=named), (6, 4), 100.0)
        assert p.solution.contacts[0].surfaces == (UPPER, LOWER)
    assert "times as stiff" not in caplog.text  # it is the coarser one
    scene(sided(UPPER, LOWER), (4, 5), 3.0)
    warned = "'upper bottom' is 3.75 times as stiff per area as 'lower top'" in caplog.text
    assert warned == (MPI.COMM_WORLD.rank == 0)


def below(distance, **changes):
    return tfeti.Obstacle("bottom", tfeti.Plane((0, -distance), (0, 1)), **changes)


@pytest.mark.parametrize("distance", [0.1, 1e6])
def test_an_obstacle_that_is_never_touched_changes_nothing(distance):
    d = decomposed("quadrilateral", 6)
    both = ([], [below(distance)])
    without, with_it = (solved(problem(d, (0.0, -1e-3), contacts)) for contacts in both)
    assert with_it.report.contact_rows == 0
    assert with_it.report.F_multiplications == without.report.F_multiplications
    assert relative(displacement(with_it)[1], displacement(without)[1]) <= 1e-12
    assert with_it.report.unmet_contacts == ["0: obstacle of surface 'bottom'"]


@pytest.mark.parametrize("distance", [0.1, 1e3])
def test_a_pair_that_never_touches_changes_nothing(distance):
    found = []
    for contacts in ([], [sided(UPPER, LOWER)]):
        d = stacked("triangle", 3, 4, 4, gap=distance)
        sides = ["lower bottom", "lower left", "upper top", "upper left"]
        p = solved(two_body_problem(d, pressed(d, 1e-3, "upper right"), held(d, *sides), contacts))
        assert p.report.contact_rows == 0
        found.append(displacement(p)[1])
    assert relative(*found) <= 1e-12


def test_who_meets_nobody_is_said(caplog):
    d = stacked("quadrilateral", 3, 4, 4)
    sides = ["lower bottom", "lower left", "upper left"]
    contacts = [sided(UPPER, LOWER), sided("upper right", "lower right")]
    contacts += [tfeti.Obstacle("lower top", tfeti.Plane((0, 30), (0, -1)))]
    p = solved(two_body_problem(d, pressed(d), held(d, *sides), contacts))
    unmet = ["1: contact of 'upper right' with 'lower right'", "2: obstacle of surface 'lower top'"]
    assert p.report.unmet_contacts == unmet
    for name in unmet:
        assert (f"contact {name} has nothing within reach" in caplog.text) == (d.comm.rank == 0)
    assert "'upper bottom'" not in caplog.text


@pytest.mark.parametrize("reach", [None, 1e-3, np.inf])
def test_the_reach_does_not_change_the_answer(reach):
    """Of a plane that the load closes."""
    d = decomposed("quadrilateral", 8)
    floors = [[below(0.02, reach=one)] for one in (reach, 1.0)]
    found = [solved(problem(d, (0.0, -0.05), floor, rtol=1e-10)) for floor in floors]
    assert (found[0].report.late_contact_rows > 0) == (reach == 1e-3)
    assert 0 < found[0].report.active_contacts == found[1].report.active_contacts
    assert relative(*(displacement(p)[1] for p in found)) <= 1e-7


@pytest.mark.parametrize("rtol", [1e-2, 1e-3])
def test_a_punch_from_afar_presses_by_little(rtol):
    """Its way, of which rtol is a part, says nothing of how deep it presses."""
    d = stacked("quadrilateral", 3, 4, 4, gap=0.3)
    sides = ["lower bottom", "lower left", ("upper top", -0.3005), "upper left"]
    forces = []
    for one in (rtol, 1e-10):
        given = pressed(d, 0.0), held(d, *sides), [sided(UPPER, LOWER)]
        p = solved(two_body_problem(d, *given, rtol=one))
        forces.append(p.solution.contact(0).resultant.force[1])
    assert forces[1] > 1e-4
    assert forces[0] == pytest.approx(forces[1], rel=rtol)


def test_a_body_that_only_a_far_obstacle_holds():
    """What is farther yet, and not needed, gets no rows."""
    d = decomposed("quadrilateral", 6)
    beyond = tfeti.Obstacle("top", tfeti.Plane((0, 1e6), (0, -1)))
    p = solved(problem(d, (0.0, -0.01), [below(5.0), beyond], clamped=(), rtol=1e-9))
    assert p.report.contact_rows == p.report.late_contact_rows == 7
    assert p.report.unmet_contacts == ["1: obstacle of surface 'top'"]
    assert np.isclose(gathered(p.solution.contact(0).force).sum(), 0.01)


@pytest.mark.parametrize("reach", [-1.0, 0.0, np.nan, "1", True])
def test_a_reach_that_is_none(reach):
    p = problem(decomposed("quadrilateral", 4), contacts=[below(0.1, reach=reach)])
    with pytest.raises(tfeti.InputError, match="obstacle of surface 'bottom': reach=.*, expected"):
        p.solve()
