"""Mortar conditions between bodies: rows, forces, late pairs, an independent reference."""

import numpy as np
import pytest
import ufl
from bodies import (
    TO_ROUNDING,
    boxes,
    gathered,
    held,
    jagged,
    pressed,
    searched,
    sided,
    stacked,
    two_body_problem,
)
from dolfinx import fem
from mpi4py import MPI
from reference.mortar import TwoBoxes
from scenes import clamp, displacement, relative

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.mesh.dofs import TornDofs

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]
PAIR = sided("upper bottom", "lower top")


def total(values):
    return MPI.COMM_WORLD.allreduce(np.sum(values, axis=0))


def clamped(d, *sides):
    return lambda V: [clamp(V, d.facets(side)) for side in sides]


def tilted(d, push=0.07, pull=0.12):
    """Load on the upper top: down on the right, up on the left."""

    def load(v, ds):
        x = ufl.SpatialCoordinate(d.mesh)
        return (pull - (pull + push) * x[0]) * v[len(v) - 1] * ds(d.surface("upper top"))

    return load


def lever(cell, subdomains=4, n=(3, 4), contact=PAIR, gap=0.0, **options):
    """The upper box clamped on its left side and pressed on the lower one by its right end."""
    d = stacked(cell, *n, subdomains, gap=gap)
    bcs = clamped(d, "lower bottom", "upper left")
    return two_body_problem(d, tilted(d), bcs, [contact], **options)


@pytest.mark.parametrize("cell", CELLS)
def test_matching_meshes_give_node_to_node_rows(cell):
    d = stacked(cell, 3, 3, 4)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (d.mesh.geometry.dim,)))
    dofs = TornDofs(V, d)
    records = searched([PAIR], dofs, d)
    order = np.argsort(records.condition, kind="stable")
    assert np.array_equal(records.condition[order], np.repeat(np.arange(len(records)), 2))
    pairs = records.coefficients(0)[order].reshape(-1, 2, d.mesh.geometry.dim)
    own = records.entry_group[order].reshape(-1, 2) == (
        records.group[:, None] + dofs.group_offsets[d.comm.rank]
    )
    assert np.all(own.sum(axis=1) == 1)
    sign = np.where(own, 1.0, -1.0)[:, :, None]
    assert np.allclose(pairs, sign * records.normal[:, None], rtol=0, atol=1e-13)
    assert np.allclose(records.gap, 0.0, atol=1e-14)
    assert total(len(records)) == 4 ** (d.mesh.geometry.dim - 1)
    assert np.isclose(total(records.area.sum()), 1.0)


@pytest.mark.parametrize("cell", CELLS)
def test_flat_sides_far_from_the_origin_have_exact_normals(cell):
    """The turn that rounding of places may make would be multiplied by the gap."""
    d = stacked(cell, 3, 4, 4)
    gdim = d.mesh.geometry.dim
    d.mesh.geometry.x[:, gdim - 1] += 172790.7
    dofs = TornDofs(fem.functionspace(d.mesh, ("Lagrange", 1, (gdim,))), d)
    records = searched([PAIR], dofs, d)
    assert np.all(np.abs(records.normal[:, : gdim - 1]) <= 1e-15)
    assert total(len(records)) > 0


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", CELLS)
def test_both_sides_bear_the_same_traction(cell, degree):
    d = stacked(cell, 3, 4, jagged)
    gdim = d.mesh.geometry.dim
    sides = ["lower bottom", "lower left", "upper left"]
    sides += ["lower front", "upper front"] if gdim == 3 else []
    problem = two_body_problem(d, pressed(d, 0.1), held(d, *sides), [PAIR], degree, **TO_ROUNDING)
    problem.solve()
    solution = problem.solution
    forces = solution.body_forces
    names = d.body_names
    signs = np.array([1.0 if total_height(d, b) > 0 else -1.0 for b in range(len(names))])
    assert np.allclose(forces.force[:, -1], 0.1 * signs, rtol=0, atol=1e-9)
    assert np.allclose(forces.force.sum(axis=0), 0.0, atol=1e-12)
    assert np.allclose(forces.moment.sum(axis=0), 0.0, atol=1e-12)
    x = problem.u.function_space.tabulate_dof_coordinates()
    t = solution.traction.x.array.reshape(-1, gdim)[: len(x)]
    touching = np.isclose(x[:, gdim - 1], 0.0)
    assert np.allclose(np.abs(t[touching, -1]), 0.1, rtol=0, atol=1e-9)
    assert np.allclose(t[~touching], 0.0)
    assert np.allclose(t[:, :-1], 0.0)
    _, dof = problem.dofs.scalar
    p = solution.pressure.x.array[dof]
    secondary = p > 0
    normal = t[problem.dofs.dolfinx_node, -1]
    assert np.allclose(p[secondary], 0.1, rtol=0, atol=1e-9)
    assert np.all(normal[secondary] > 0)


def total_height(d, body):
    """Sum of the cells' heights in a body."""
    mesh = d.mesh
    cells = np.flatnonzero(d.body_of_subdomain[d.cell_subdomain] == body)
    heights = mesh.geometry.x[geometry_dofmap(mesh)[cells]][:, :, mesh.geometry.dim - 1]
    return total(heights.sum())


def forces_on_nodes(problem):
    """Bᵀλ, this rank's part."""
    B = problem.dual.constraints.B
    lam, v = B.createVecLeft(), B.createVecRight()
    lam.array[:] = problem.solution.lam
    B.multTranspose(lam, v)
    return np.array(v.array_r)


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
@pytest.mark.parametrize("n", [(3, 4), (5, 3)])
def test_independent_active_set(cell, n):
    reference = TwoBoxes(cell, *n, push=0.07, pull=0.12)
    x_ref, u_ref, points, lam = reference.solve()
    acting = []
    for qp_type in ("newton", "smalse"):
        problem = lever(cell, jagged, n, qp_type=qp_type, **TO_ROUNDING)
        problem.solve()
        x, u = displacement(problem)
        assert np.allclose(x, x_ref)
        assert relative(u, u_ref) <= 1e-8
        acting.append(forces_on_nodes(problem))
        data = problem.solution.contact()
        place, force = gathered(data.points), gathered(data.force)
        order = np.lexsort(np.rint(place.T * 1e7))
        assert np.allclose(place[order], points)
        force = force[order]
        assert force.min() >= 0.0
        assert relative(reference.on_nodes(force), reference.on_nodes(lam)) <= 1e-8
        # in 3D 5 rows on the 5 prescribed vertices of an edge meet the 4 nodes of another one, so λ
        # is not unique there, but Bᵀλ is
        if cell == "quadrilateral" or n[0] > n[1]:
            assert relative(force, lam) <= 1e-8
            assert np.array_equal(force > 1e-9 * lam.max(), lam > 1e-9 * lam.max())
    assert relative(*acting) <= 1e-8
    assert 0 < np.sum(lam > 0) < len(lam)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_pairs_out_of_reach_join_when_they_overlap(cell):
    near = lever(
        cell, gap=0.001, rtol=1e-10, pc_type="none", contact=sided(*PAIR.surfaces, reach=0.01)
    )
    late = lever(
        cell, gap=0.001, rtol=1e-10, pc_type="none", contact=sided(*PAIR.surfaces, reach=1e-4)
    )
    near.solve()
    late.solve()
    assert near.report.late_contact_rows == 0
    assert late.report.late_contact_rows > 0
    assert late.report.contact_rows <= near.report.contact_rows
    assert relative(displacement(late)[1], displacement(near)[1]) <= 1e-7
    assert late.report.factorizations == near.report.factorizations


def test_a_body_that_only_far_surfaces_hold_is_found():
    d = stacked("quadrilateral", 3, 4, 4, gap=0.2)
    problem = two_body_problem(
        d, pressed(d), held(d, "lower bottom", "lower left", "upper left"), [PAIR], rtol=1e-10
    )
    problem.solve()
    assert problem.report.late_contact_rows == problem.report.contact_rows == 5
    assert np.allclose(gathered(problem.solution.contact().pressure), 0.1, atol=1e-6)


def three(cell="quadrilateral"):
    """A box on two boxes that stand side by side, all meshed differently."""
    parts = [
        ("left", (0.0, -1.0), (1.0, 0.0), (3, 3)),
        ("right", (1.5, -1.0), (2.5, 0.0), (4, 4)),
        ("upper", (0.0, 0.0), (2.5, 1.0), (7, 3)),
    ]
    mesh, tags, names = boxes(cell, parts)
    return tfeti.decompose(mesh, 6, facet_tags=tags, surfaces=names)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@pytest.mark.parametrize("upper_is_secondary", [True, False])
def test_a_surface_in_two_pairs(cell, upper_is_secondary):
    d = three(cell)
    pairs = [("upper bottom", "left top"), ("upper bottom", "right top")]
    contacts = [sided(*(p if upper_is_secondary else p[::-1])) for p in pairs]
    bcs = held(d, "left bottom", "left left", "right bottom", "right left", "upper left")
    problem = two_body_problem(d, pressed(d), bcs, contacts, **TO_ROUNDING)
    problem.solve()
    loads = np.sort(problem.solution.body_forces.force[:, 1])
    assert np.isclose(loads[-1], 0.25, atol=1e-9)
    assert np.isclose(loads.sum(), 0.0, atol=1e-9)
    sides = [total(problem.solution.contact(i).force.sum()) for i in (0, 1)]
    assert np.allclose(np.sort(sides), np.sort(-loads[:2]), atol=1e-12)


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("degree", [1, 2])
def test_obstacle_under_a_uniform_pressure(cell, degree):
    d = stacked(cell, 2, 3, 4, gap=0.5)
    gdim = d.mesh.geometry.dim
    up = np.eye(3)[gdim - 1][:gdim]
    sides = ["lower bottom", "lower left", "lower right", "upper left"]
    if gdim == 3:
        sides += ["lower front", "upper front"]
    plane = tfeti.Obstacle("upper bottom", tfeti.Plane(tuple(0.4 * up), tuple(up)))
    problem = two_body_problem(d, pressed(d), held(d, *sides), [plane], degree, **TO_ROUNDING)
    problem.solve()
    assert np.allclose(gathered(problem.solution.contact().pressure), 0.1, rtol=0, atol=1e-9)
    assert problem.report.contact_rows == 4 ** (gdim - 1)


@pytest.mark.parametrize("scaling", ["stiffness", "multiplicity"])
def test_contact_rows_are_orthogonal_to_gluing_rows(scaling):
    problem = lever("quadrilateral", jagged, (5, 4), scaling=scaling)
    problem.solve()
    if MPI.COMM_WORLD.size > 1:
        return  # B is gathered on one rank only
    constraints = problem.dual.constraints
    B = dense(constraints.B)
    gram = (B / constraints.weights) @ B.T
    sets = constraints.sets
    assert np.allclose(gram[np.ix_(sets.equalities, sets.normals)], 0.0, atol=1e-13)
    assert np.allclose(np.diag(gram), 1.0)


def dense(matrix):
    rows, columns, values = matrix.getValuesCSR()
    out = np.zeros(matrix.getSize())
    out[np.repeat(np.arange(len(rows) - 1), np.diff(rows)), columns] = values
    return out


@pytest.mark.parametrize(
    ("sides", "changes", "message"),
    [
        (("upper bottom", "upper bottom"), {}, "both are the same surface"),
        (("upper bottom", "lid"), {}, r"contact of 'upper bottom' with 'lid': no surface 'lid'"),
        (
            ("upper bottom", "nothing"),
            {},
            "contact of 'upper bottom' with 'nothing': surface 'nothing' has no facets",
        ),
        (("upper bottom", "lower top"), {"reach": -1.0}, "reach=-1.0, expected a positive length"),
        (("upper bottom", "lower top"), {"reach": float("nan")}, "reach=nan, expected a positive"),
        (("upper bottom", "lower top"), {"reach": "far"}, "reach='far', expected a positive"),
        (("upper bottom", "lower bottom"), {"reach": 2.0}, "face away from each other"),
        (
            ("upper bottom", "lower top"),
            {"secondary": "lower bottom"},
            "contact of .* with .*: secondary='lower bottom', expected one of its surfaces",
        ),
        (("upper bottom", "lower top"), {"secondary": "lid"}, "secondary='lid', expected one of"),
        (("upper bottom", "lower top"), {"secondary": None}, "secondary=None, expected one of"),
        (("upper bottom", "lower top"), {"gap": "none"}, "of 'upper bottom' .*: gap='none', exp"),
        (("upper bottom", "lower top"), {"gap": np.inf}, "gap=inf, expected"),
        (("upper bottom", "lower top"), {"gap": lambda x: x[:1]}, "gap, a function, did not give"),
        (("upper bottom", "lower top"), {"gap": lambda x: x[0] * np.nan}, "gap is .* at the point"),
    ],
)
def test_bad_pairs(sides, changes, message):
    mesh, tags, names = boxes("quadrilateral", BOXES)
    d = tfeti.decompose(mesh, 4, facet_tags=tags, surfaces={**names, "nothing": 99})
    check_message(d, tfeti.Contact(*sides, **changes), message)


BOXES = [
    ("lower", (0.0, -1.0), (1.0, 0.0), (3, 3)),
    ("upper", (0.0, 0.0), (1.0, 1.0), (4, 4)),
]


def check_message(d, contact, message):
    bcs = held(d, "lower bottom", "lower left", "upper left")
    problem = two_body_problem(d, pressed(d), bcs, [contact])
    with pytest.raises(tfeti.InputError, match=message):
        problem.solve()


def test_surfaces_that_overlap_a_little_are_pushed_apart():
    d = stacked("quadrilateral", 3, 4, 4, gap=-0.01)
    bcs = held(d, "lower bottom", "lower left", "upper top", "upper left")
    problem = two_body_problem(d, pressed(d, 0.0, "upper right"), bcs, [PAIR], rtol=1e-10)
    problem.solve()
    assert np.allclose(gathered(problem.solution.contact().gap), 0.0, atol=1e-10)
    assert np.ptp(gathered(problem.solution.contact().pressure)) < 1e-9


def test_facets_without_area():
    d = stacked("quadrilateral", 3, 4, 1 if MPI.COMM_WORLD.size == 1 else 2)
    x = d.mesh.geometry.x
    corner = np.isclose(x[:, 0], 0.25) & np.isclose(x[:, 1], 0.0)
    x[corner, 0] = 0.0
    check_message(d, PAIR, "contact of .*: 1 facets of 'upper bottom' have no area")


@pytest.mark.parametrize(
    ("load", "message"),
    [
        ((0.0, 0.1), r"body \d.*translation in y"),
        ((0.1, -0.1), r"body \d.*translation in x"),
    ],
)
def test_a_body_that_contact_cannot_hold(load, message):
    d = stacked("quadrilateral", 3, 4, 4)

    def push(v, ds):
        return ufl.dot(fem.Constant(d.mesh, load), v) * ds(d.surface("upper top"))

    problem = two_body_problem(d, push, clamped(d, "lower bottom"), [PAIR])
    with pytest.raises(tfeti.NoSolutionError, match=message):
        problem.solve()


def test_a_body_that_only_contact_holds():
    """It slides freely, which no load drives: one free mode, and a uniform pressure."""
    d = stacked("quadrilateral", 3, 4, 4)
    problem = two_body_problem(d, pressed(d), held(d, "lower bottom", "lower left"), [PAIR])
    problem.solve()
    assert problem.report.free_modes == 1
    assert np.allclose(gathered(problem.solution.contact().pressure), 0.1, atol=1e-6)
