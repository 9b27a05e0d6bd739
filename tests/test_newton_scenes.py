"""Block Newton on scenes: it finds what SMALSE-M finds, and contact costs little."""

import numpy as np
import pytest
import ufl
from bodies import held, pressed, stacked, stiffer_above, two_body_problem
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import clamp, curved_obstacle, decomposed, displacement, hooke, problem, strain
from test_faces import in_a_corner, on_a_block

import tfeti_dolfinx as tfeti

RTOL = 1e-8


def on_an_obstacle(cell):
    d = decomposed(cell, 4, 6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(d.mesh.geometry.dim), reach=0.2)
    return lambda **options: problem(d, contacts=[obstacle], **options)


def with_late_rows(**options):
    d = decomposed("hexahedron", 4, 6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.035)
    return problem(d, contacts=[obstacle], **options)


def between_parallel_planes(gap):
    """The rows of two obstacles on the same nodes are the same rows, with other gaps."""

    def made(**options):
        d = decomposed("hexahedron", 3, 4)
        planes = [tfeti.Plane((0, 0, -0.002 - z), (0, 0, 1)) for z in (0.0, gap)]
        contacts = [tfeti.Obstacle("bottom", plane, reach=0.2) for plane in planes]
        return problem(d, contacts=contacts, **options)

    return made


def blocks(ratio, cell="hexahedron", nu=0.3):
    """A block on a block that does not match it, one of them stiffer."""

    def made(**options):
        d = stacked(cell, 3, 4, 4)
        stress = stiffer_above(d, ratio, nu)
        clamped = held(d, "lower bottom", "upper left", "upper front")
        contact = tfeti.Contact("lower top", "upper bottom", secondary="lower top")
        return two_body_problem(d, pressed(d, 1e-2), clamped, [contact], stress=stress, **options)

    return made


SCENES = {
    "hexahedra on an obstacle": on_an_obstacle("hexahedron"),
    "triangles on an obstacle": on_an_obstacle("triangle"),
    "late rows": with_late_rows,
    "in a corner": in_a_corner,
    "on a block": on_a_block,
    "equal blocks": blocks(1.0),
    "a stiff block": blocks(1e4),
    "a soft block": blocks(1e-4),
    "two equal obstacles": between_parallel_planes(0.0),
    "two parallel obstacles": between_parallel_planes(1e-3),
}


def solved(scene, **options):
    p = scene(tfeti_rtol=RTOL, **options)
    p.solve()
    return p


def apart(p, q):
    """Largest difference of two displacements over the largest displacement."""
    a, b = displacement(p)[1], displacement(q)[1]
    return np.abs(a - b).max() / np.abs(b).max()


@pytest.mark.parametrize("name", list(SCENES))
def test_it_finds_what_smalse_finds(name):
    newton = solved(SCENES[name], tfeti_qp_type="newton")
    smalse = solved(SCENES[name], tfeti_qp_type="smalse")
    assert apart(newton, smalse) <= 100 * RTOL
    assert newton.report.active_contacts > 0
    assert newton.report.newton_faces > 0 == smalse.report.newton_faces
    assert newton.report.power_method_multiplications == 0
    assert newton.report.F_multiplications < smalse.report.F_multiplications
    newton.destroy()
    smalse.destroy()


@pytest.mark.parametrize("pc_type", ["none", "lumped", "dirichlet"])
def test_preconditioners_do_not_change_the_answer(pc_type):
    scene = SCENES["a soft block"]
    p = solved(scene, tfeti_qp_type="newton", tfeti_pc_type=pc_type)
    q = solved(scene, tfeti_qp_type="newton")
    assert apart(p, q) <= 100 * RTOL
    multiplied = p.report.preconditioner_multiplications
    assert (multiplied == 0) == (pc_type == "none")
    p.destroy()
    q.destroy()


@pytest.mark.parametrize("gap", [0.0, 1e-9, 1e-3])
def test_equal_rows_with_other_gaps_are_told_apart(gap):
    """Of two parallel planes the nearer one carries; the other one is found to lose."""
    alone = multiplications(between_parallel_planes(1.0))
    assert multiplications(between_parallel_planes(gap)) <= 5 * alone


def multiplications(scene):
    p = solved(scene)
    counted = p.report.F_multiplications
    p.destroy()
    return counted


@pytest.mark.parametrize("ratio", [1e4, 1e-4, 1e6, 1e-6])
def test_jumps_of_stiffness_cost_little(ratio):
    """The scaling by the rows of the face makes up for them."""
    assert multiplications(blocks(ratio)) <= 4 * multiplications(blocks(1.0))


@pytest.mark.parametrize(("nu", "factor"), [(0.49, 2), (0.499, 5)])
def test_nearly_incompressible_bodies_cost_little(nu, factor):
    assert multiplications(blocks(1.0, nu=nu)) <= factor * multiplications(blocks(1.0))


def cantilever(length, cells, subdomains, floor, degree=1, **options):
    """A slender beam, clamped on the left, with a load on its top; maybe over a plane."""
    n = (cells * length, cells)
    mesh = dmesh.create_rectangle(
        MPI.COMM_WORLD, [(0, 0), (length, 1)], list(n), dmesh.CellType.quadrilateral
    )
    sides = {"left": (0, 0.0), "bottom": (1, 0.0), "top": (1, 1.0)}
    facets = [
        dmesh.locate_entities_boundary(mesh, 1, lambda x, a=axis, v=at: np.isclose(x[a], v))
        for axis, at in sides.values()
    ]
    values = np.repeat(np.arange(1, 4, dtype=np.int32), [len(f) for f in facets])
    facets = np.concatenate(facets)
    order = np.argsort(facets)
    tags = dmesh.meshtags(mesh, 1, facets[order], values[order])
    names = {name: tag for tag, name in enumerate(sides, start=1)}
    d = tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=names)
    V = fem.functionspace(d.mesh, ("Lagrange", degree, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    bcs = [clamp(V, d.facets("left"))]
    plane = tfeti.Plane((0, -(floor or 0.0), 0), (0, 1, 0))
    contacts = [] if floor is None else [tfeti.Obstacle("bottom", plane, reach=np.inf)]
    return tfeti.ContactProblem(
        ufl.inner(hooke()(u), strain(v)) * ufl.dx,
        -1e-6 * v[1] * ds(d.surface("top")),
        bcs,
        contacts,
        d,
        stress=hooke(),
        petsc_options=options,
    )


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("floor", [1e-3, 0.1])
@pytest.mark.parametrize("subdomains", [2, 16])
def test_slender_cantilevers_over_a_plane(degree, floor, subdomains):
    """20 : 1; the tip comes down by about 0.2 where nothing stops it."""
    p = cantilever(20, 2, subdomains, floor, degree, tfeti_qp_type="newton")
    p.solve()
    assert p.report.active_contacts > 0
    assert p.report.F_multiplications <= 200
    p.destroy()


def test_contact_that_never_touches_costs_what_no_contact_costs():
    """Two multiplications more at most, however far the plane is."""
    free = cantilever(20, 2, 16, None)
    free.solve()
    for floor in (1.0, 100.0):
        far = cantilever(20, 2, 16, floor, tfeti_qp_type="newton")
        far.solve()
        assert far.report.contact_rows > 0 == far.report.active_contacts
        assert far.report.F_multiplications <= free.report.F_multiplications + 2
        assert apart(far, free) <= 1e-5
        far.destroy()
    free.destroy()


@pytest.mark.parametrize("name", ["hexahedra on an obstacle", "equal blocks", "in a corner"])
def test_a_second_solve_costs_next_to_nothing(name):
    """At most 2 multiplications, and no factor but those of faces."""
    p = solved(SCENES[name], tfeti_qp_type="newton")
    before = displacement(p)[1]
    p.solve()
    assert p.report.F_multiplications <= 2
    assert p.report.factorizations == p.report.coarse_factorizations == 0
    assert np.allclose(displacement(p)[1], before, rtol=0, atol=100 * RTOL * np.abs(before).max())
    p.destroy()
