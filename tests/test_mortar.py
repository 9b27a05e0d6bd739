"""Mortar conditions between bodies: rows, forces, late pairs, an independent reference."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from bodies import (
    TO_ROUNDING,
    clamped,
    dofs_on,
    gathered,
    held,
    jagged,
    pressed,
    searched,
    sided,
    stacked,
    torn_boxes,
    two_body_problem,
)
from mpi4py import MPI
from reference import mortar
from scenes import CELLS, by_point, displacement, relative, solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import NoSolutionError

PAIR = sided("upper bottom", "lower top")


def total(values):
    return MPI.COMM_WORLD.allreduce(np.sum(values, axis=0))


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
    dofs = dofs_on(d)
    records = searched([PAIR], dofs)
    order = np.argsort(records.condition, kind="stable")
    assert np.array_equal(records.condition[order], np.repeat(np.arange(len(records)), 2))
    pairs = records.coefficients(0)[order].reshape(-1, 2, d.mesh.geometry.dim)
    group = records.group[:, None] + dofs.group_offsets[d.comm.rank]
    own = records.entry_group[order].reshape(-1, 2) == group
    assert np.all(own.sum(axis=1) == 1)
    sign = np.where(own, 1.0, -1.0)[:, :, None]
    assert np.allclose(pairs, sign * records.normal[:, None], rtol=0, atol=1e-13)
    assert np.allclose(records.gap, 0.0, atol=1e-14)
    assert total(len(records)) == 4 ** (d.mesh.geometry.dim - 1)
    assert np.isclose(total(records.area.sum()), 1.0)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_flat_sides_far_from_the_origin_have_exact_normals(cell):
    """The turn that rounding of places may make would be multiplied by the gap."""
    d = stacked(cell, 3, 4, 4)
    gdim = d.mesh.geometry.dim
    d.mesh.geometry.x[:, gdim - 1] += 172790.7
    records = searched([PAIR], dofs_on(d))
    assert np.all(np.abs(records.normal[:, : gdim - 1]) <= 1e-15)
    assert total(len(records)) > 0


# each cell, each degree, and dimensions with both degrees
DEGREES = pytest.mark.parametrize(("cell", "degree"), list(zip(CELLS, (2, 1, 2, 1), strict=True)))


@pytest.mark.parametrize(
    ("cell", "n", "secondary"),
    [
        ("quadrilateral", (3, 4), "upper"),
        ("hexahedron", (5, 3), "upper"),
        ("hexahedron", (4, 3), "lower"),
    ],
)
def test_independent_active_set(cell, n, secondary):
    x_ref, u_ref, points, lam = mortar.lever(cell, *n, 0.07, 0.12, secondary)
    contact = PAIR if secondary == "upper" else sided(*PAIR.surfaces[::-1])
    for qp_type in ("newton", "smalse"):
        problem = solved(lever(cell, jagged, n, contact, qp_type=qp_type, **TO_ROUNDING))
        x, u = displacement(problem)
        assert np.allclose(x, x_ref)
        assert relative(u, u_ref) <= 1e-8
        data = problem.solution.contact()
        place, force = by_point(MPI.COMM_WORLD, data.points, data.force)
        assert np.allclose(place, points)
        assert force.min() >= 0.0
        assert relative(force, lam) <= 1e-8
        assert np.array_equal(force > 1e-9 * lam.max(), lam > 1e-9 * lam.max())
    assert 0 < np.sum(lam > 0) < len(lam)


def test_pairs_out_of_reach_join_when_they_overlap():
    pairs = [sided(*PAIR.surfaces, reach=reach) for reach in (0.01, 1e-4)]
    given = {"gap": 0.001, "rtol": 1e-10, "pc_type": "none"}
    near, late = (solved(lever("hexahedron", contact=pair, **given)) for pair in pairs)
    assert near.report.late_contact_rows == 0
    assert late.report.late_contact_rows > 0
    assert late.report.contact_rows <= near.report.contact_rows
    assert relative(displacement(late)[1], displacement(near)[1]) <= 1e-7
    assert late.report.factorizations == near.report.factorizations


def test_a_body_that_only_far_surfaces_hold_is_found():
    d = stacked("quadrilateral", 3, 4, 4, gap=0.2)
    bcs = held(d, "lower bottom", "lower left", "upper left")
    problem = solved(two_body_problem(d, pressed(d), bcs, [PAIR], rtol=1e-10))
    assert problem.report.late_contact_rows == problem.report.contact_rows == 5
    assert np.allclose(gathered(problem.solution.contact().pressure), 0.1, atol=1e-6)


@DEGREES
def test_a_clamped_edge_bears_nothing_where_bodies_open(cell, degree):
    """They open as x² from there, which a dual multiplier takes for an overlap."""
    flat = (1.0,) * (2 if cell in CELLS[2:] else 1)
    low, high = (0.0,) * len(flat), (4.0, *flat[1:])
    parts = [
        ("lower", (*low, -1.0), (*high, 0.0), (6, *(2,) * len(flat))),
        ("upper", (*low, 0.0), (*high, 1.0), (8, *(3,) * len(flat))),
    ]
    d = torn_boxes(cell, parts, 4)
    load = pressed(d, -1e-4, "upper right")
    table = tfeti.Obstacle("upper bottom", tfeti.Plane((0, 0, 0), (0,) * len(flat) + (1,)))
    for contact in (PAIR, sided(*PAIR.surfaces[::-1]), table):
        for side in ("lower bottom", "lower left"):
            bcs = clamped(d, side, "upper left")
            problem = solved(two_body_problem(d, load, bcs, [contact], degree, **TO_ROUNDING))
            assert np.all(problem.solution.contact().force == 0.0)
        overlap = replace(contact, gap=-1e-3)
        with pytest.raises(NoSolutionError, match="nodes? penetrates? by up to 0.001 whatever"):
            two_body_problem(d, load, bcs, [overlap], degree).solve()


def three(cell="quadrilateral"):
    """A box on two boxes that stand side by side, all meshed differently."""
    parts = [
        ("left", (0.0, -1.0), (1.0, 0.0), (3, 3)),
        ("right", (1.5, -1.0), (2.5, 0.0), (4, 4)),
        ("upper", (0.0, 0.0), (2.5, 1.0), (7, 3)),
    ]
    return torn_boxes(cell, parts, 6)


@pytest.mark.parametrize(
    ("cell", "upper_is_secondary"), [("triangle", True), ("quadrilateral", False)]
)
def test_a_surface_in_two_pairs(cell, upper_is_secondary):
    d = three(cell)
    pairs = [("upper bottom", "left top"), ("upper bottom", "right top")]
    contacts = [sided(*(p if upper_is_secondary else p[::-1])) for p in pairs]
    bcs = held(d, "left bottom", "left left", "right bottom", "right left", "upper left")
    problem = solved(two_body_problem(d, pressed(d), bcs, contacts, **TO_ROUNDING))
    loads = np.sort(problem.solution.body_forces.force[:, 1])
    assert np.isclose(loads[-1], 0.25, atol=1e-9)
    assert np.isclose(loads.sum(), 0.0, atol=1e-9)
    sides = [total(problem.solution.contact(i).force.sum()) for i in (0, 1)]
    assert np.allclose(np.sort(sides), np.sort(-loads[:2]), atol=1e-12)


@DEGREES
def test_obstacle_under_a_uniform_pressure(cell, degree):
    d = stacked(cell, 2, 3, 4, gap=0.5)
    gdim = d.mesh.geometry.dim
    up = np.eye(3)[gdim - 1][:gdim]
    sides = ["lower bottom", "lower left", "lower right", "upper left"]
    sides += ["lower front", "upper front"] if gdim == 3 else []
    plane = tfeti.Obstacle("upper bottom", tfeti.Plane(tuple(0.4 * up), tuple(up)))
    problem = two_body_problem(d, pressed(d), held(d, *sides), [plane], degree, **TO_ROUNDING)
    problem.solve()
    assert np.allclose(gathered(problem.solution.contact().pressure), 0.1, rtol=0, atol=1e-9)
    assert problem.report.contact_rows == 4 ** (gdim - 1)


@pytest.mark.parametrize(
    ("sides", "changes", "message"),
    [
        (("upper bottom", "lower bottom"), {"reach": 2.0}, "face away from each other"),
        (
            ("upper bottom", "lower top"),
            {"secondary": "lower bottom"},
            "contact of .* with .*: secondary='lower bottom', expected one of its surfaces",
        ),
        (("upper bottom", "lower top"), {"gap": "none"}, "of 'upper bottom' .*: gap='none', exp"),
        (("upper bottom", "lower top"), {"gap": lambda x: x[:1]}, r"gap at .* \(1, \d\); exp"),
        (("upper bottom", "lower top"), {"gap": lambda x: x[0] * np.nan}, "gap is .* at the point"),
    ],
)
def test_bad_pairs(sides, changes, message):
    check_message(stacked("quadrilateral", 3, 4, 4), tfeti.Contact(*sides, **changes), message)


def check_message(d, contact, message):
    bcs = held(d, "lower bottom", "lower left", "upper left")
    problem = two_body_problem(d, pressed(d), bcs, [contact])
    with pytest.raises(tfeti.InputError, match=message):
        problem.solve()


def test_facets_without_area():
    d = stacked("quadrilateral", 3, 4, 1 if MPI.COMM_WORLD.size == 1 else 2)
    x = d.mesh.geometry.x
    corner = np.isclose(x[:, 0], 0.25) & np.isclose(x[:, 1], 0.0)
    x[corner, 0] = 0.0
    check_message(d, PAIR, "contact of .*: 1 facets of 'upper bottom' have no area")
