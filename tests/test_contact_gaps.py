"""Gaps: never outside the pointwise ones, of curved facets, given by the user; shrink fits."""

import numpy as np
import pytest
import ufl
from bodies import (
    ORDERS,
    clamped,
    dofs_on,
    gathered,
    held,
    no_load,
    searched,
    sided,
    stacked,
    torn_boxes,
    two_body_problem,
)
from dolfinx import fem
from mpi4py import MPI
from scenes import CELLS, apart, by_point, decomposed, displacement, problem, solved, unknowns
from true_errors import OVERLAP, ring_problem

import tfeti_dolfinx as tfeti
from benchmarks.stress.laws import neo_hooke
from meshes.rings import lame_pressure
from tfeti_dolfinx.mortar.facets import group_points


def shaped(cell, n_lower, n_upper, lower, upper, across=(0.0, 1.0)):
    """Boxes whose facing sides are bent to the heights lower(x) and upper(x), x from −½ to ½."""
    last = 1 if cell in CELLS[:2] else 2
    low, high = ((end,) * last for end in across)
    parts = [
        ("lower", (0.0,) * last + (-1.0,), (1.0,) * last + (0.0,), (n_lower,) * last + (2,)),
        ("upper", (*low, 0.5), (*high, 1.5), (n_upper,) * last + (2,)),
    ]
    d = torn_boxes(cell, parts, 4)
    x = d.mesh.geometry.x
    at, z = x[:, :last] - 0.5, x[:, last]
    above = z > 0.25
    z[:] = np.where(above, z - 0.5 + (1.5 - z) * upper(at), z + (1.0 + z) * lower(at))
    return d


def bent(cell, n_lower, n_upper, lower, upper, at=np.array, gap=0.0):
    """Sides bent to c|x|², so far apart at x = 0."""
    ends = [
        lambda x, c=c: c[1] + c[0] * np.sum(at(x) ** 2, axis=1)
        for c in ((lower, 0.0), (upper, gap))
    ]
    return shaped(cell, n_lower, n_upper, *ends)


@pytest.mark.parametrize("sides", ORDERS)
@pytest.mark.parametrize(
    ("cell", "n", "curvatures"),
    [
        ("triangle", (2, 16), (0.025, 0.4)),
        ("quadrilateral", (16, 2), (-0.4, 0.0)),
        ("tetrahedron", (3, 8), (-0.3, 0.3)),
        ("hexahedron", (2, 16), (0.0, 0.4)),
    ],
)
def test_bodies_that_only_touch_have_no_overlap(cell, n, curvatures, sides):
    """Flat, convex and concave sides; a mean with ψ_i, negative somewhere, must not say more."""
    gaps = searched([sided(*sides, reach=0.5)], dofs_on(bent(cell, *n, *curvatures))).gap
    assert gathered(gaps).min() > -1e-12


@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_a_gap_that_is_rounding_of_coordinates_is_none(size):
    """Turned bodies that touch; one that is 1e-12 of their size stays."""
    for gap in (0.0, 1e-12):
        d = stacked("triangle", 3, 4, 4, gap=gap)
        turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
        d.mesh.geometry.x[:, :2] = size * d.mesh.geometry.x[:, :2] @ turn
        for sides in ORDERS:
            gaps = gathered(searched([sided(*sides)], dofs_on(d)).gap)
            assert np.allclose((gaps.min(), gaps.max()), gap * size, rtol=1e-2, atol=0.0)


@pytest.mark.parametrize(
    ("cell", "slope"),
    [("triangle", 0.02), ("quadrilateral", -0.02), ("tetrahedron", -0.02), ("hexahedron", 0.02)],
)
def test_an_overhanging_wedge(cell, slope):
    """Over an edge the gap goes on if it opens; one that closes would overlap with nothing."""
    n, gdim = 4, 2 if cell in CELLS[:2] else 3
    start = 0.5 if slope < 0.0 else -0.5
    sides = (lambda x: 0.0 * x[:, 0]), (lambda x: slope * (x[:, 0] - start))
    dofs = dofs_on(shaped(cell, 3, n, *sides, across=(0.0, 1.15)))
    records = searched([sided(*ORDERS[0], reach=0.5)], dofs)
    x = gathered(group_points(dofs)[records.group])[:, 0] - 0.5
    gaps, expected = gathered(records.gap), slope * (x - start)
    assert np.sum(x > 0.5) == n ** (gdim - 2) + (gdim - 2)
    assert np.allclose(gaps, np.maximum(expected, 0.0), rtol=1e-3, atol=1e-12)


def two_bodies(finite, d, bcs, pair, degree=1):
    """Linear elasticity, or neo-Hooke in finite strain, solved."""
    if not finite:
        return solved(two_body_problem(d, no_load, bcs, [pair], degree, rtol=1e-9))
    V, u, v, _ = unknowns(d, degree)
    F = ufl.derivative(neo_hooke(u, 1.0, 0.3) * ufl.dx(metadata={"quadrature_degree": 4}), u, v)
    options = {"finite": True, "petsc_options": {"rtol": 1e-9}}
    return solved(tfeti.NonlinearContactProblem(F, u, bcs(V), [pair], d, **options))


@pytest.mark.parametrize(
    ("cell", "degree", "gap", "sides", "finite"),
    [
        ("quadrilateral", 2, "geometry", ORDERS[1], False),
        ("quadrilateral", 1, "curved", ORDERS[0], False),
        ("hexahedron", 1, "geometry", ORDERS[0], False),
        ("quadrilateral", 2, "geometry", ORDERS[1], True),
        ("hexahedron", 1, "curved", ORDERS[0], True),
    ],
)
def test_a_half_and_a_quarter_have_the_answer_of_the_whole(cell, degree, gap, sides, finite):
    """A ball in a bowl: normals, what is covered, curvature, and friction across the planes."""
    last = 1 if cell == "quadrilateral" else 2
    planes = [f"{body} {side}" for body in ("lower", "upper") for side in ("left", "front")[:last]]

    def answer(parts):
        at = np.array if parts == 2 else (lambda x: 0.5 * x + 0.25)
        d = bent(cell, 3 * parts, 4 * parts, 0.9, 1.0, at, 0.01)
        x = d.mesh.geometry.x  # nodes are off a plane by what files round
        x[:, :last] = at(x[:, :last] - 0.5) + 1e-7 * np.sin(9.0 * x[:, last : last + 1])
        planar = held(d, *planes[len(planes) * (parts - 1) :])
        ends = clamped(d, "lower bottom", ("upper top", -0.04 * np.eye(last + 1)[-1]))
        pair = sided(*sides, gap=gap, friction=tfeti.Coulomb(0.3), reach=0.3)
        p = two_bodies(finite, d, lambda V: planar(V) + ends(V), pair, degree)
        data = p.solution.contact()
        both = displacement(p), by_point(d.comm, data.points, data.pressure)
        return [values[np.all(x[:, :last] > -1e-6, axis=1)] for x, values in both]

    for part, of_whole in zip(answer(1), answer(2), strict=True):
        assert apart(part, of_whole) < 1e-4


@pytest.mark.parametrize("finite", [False, True])
def test_a_slant_that_begins_at_a_guide_keeps_its_normal(finite):
    """The mirror image would have an edge there."""
    d = shaped("quadrilateral", 3, 4, *[lambda x: 0.2 * x[:, 0]] * 2)
    bcs = held(d, "lower left", "upper left", "lower bottom", ("upper top", -0.04))
    p = two_bodies(finite, d, bcs, sided(*ORDERS[0]))
    normal = np.array([0.2, -1.0]) / np.hypot(0.2, 1.0)
    assert np.allclose(p.solution.contact().normal, normal, atol=0.03 if finite else 1e-8)


@pytest.mark.parametrize(
    ("gap", "n", "bends"), [("curved", (10, 8), (0.0, 1.0)), ("geometry", (6, 8), (-0.5, 0.5))]
)
def test_the_answer_in_finite_strain_does_not_depend_on_the_path(gap, n, bends):
    """Two nodes would have the lowest gap of one point; bodies that touch hardly move."""
    ends = []
    for path in ((-0.1,), (0.0, -0.12, -0.1)):
        d = bent("quadrilateral", *n, *bends)
        way = fem.Constant(d.mesh, (0.0, path[0]))
        bcs = clamped(d, "lower bottom", ("upper top", way))
        p = two_bodies(True, d, bcs, sided(*ORDERS[0], gap=gap, reach=0.4))
        for way.value[1] in path:
            solved(p)
            assert way.value[1] or gap == "curved" or np.abs(displacement(p)[1]).max() < 2e-4
        ends.append(displacement(p)[1])
    assert apart(*ends) < 1e-7


def test_slivers_beyond_a_rim_say_little_of_gaps_in_finite_strain():
    """The primary side's rim is on a line of nodes; the force is nearly that of a fine mesh."""
    bowl = (lambda x: 0.0 * x[:, 0]), (lambda x: 0.3 * np.sum((1.5 * x + 0.75) ** 2, axis=1))
    d = shaped("hexahedron", 3, 4, *bowl, across=(0.0, 2 / 3))
    d.mesh.geometry.x[:, :2] *= 1.5
    bcs = clamped(d, "lower bottom", ("upper top", -0.1 * np.eye(3)[2]))
    p = two_bodies(True, d, bcs, sided(*ORDERS[1], gap="curved", reach=0.4))
    assert np.isclose(p.solution.contact().resultant.force[2], -0.00855, rtol=0.15)


def test_a_punch_less_wide_than_its_overlap_presses_in_finite_strain():
    """Facets of the block, covered in part, lie deeper in it than that part is wide."""
    flat = [lambda x, z=z: np.full(len(x), z) for z in (0.0, -0.12)]
    d = shaped("quadrilateral", 3, 1, *flat, across=(0.45, 0.55))
    bcs = clamped(d, "lower bottom", "upper top")
    ends = [two_bodies(True, d, bcs, sided(*s, reach=0.4)).solution.contact() for s in ORDERS]
    assert np.allclose([np.abs(end.resultant.force[1]) for end in ends], 0.01187, rtol=0.01)


def against_lame(p):
    """Solve; relative error of the mean pressure, and of the pressure in L²."""
    p.solve()
    data, exact = p.solution.contact(), lame_pressure(OVERLAP)
    area, pressure = gathered(data.area), gathered(data.pressure)
    error = np.sqrt(np.average((pressure - exact) ** 2, weights=area))
    return np.average(pressure, weights=area) / exact - 1.0, error / exact


@pytest.mark.parametrize(
    ("cells", "order", "mesh", "contact", "secondary"),
    [
        ((48, 64), 1, {}, {"gap": lambda x: -OVERLAP * np.hypot(x[0], x[1])}, "auto"),
        ((96, 128), 1, {"triangles": True}, {"gap": -OVERLAP}, "hub"),
        ((48, 64), 1, {}, {"gap": "curved"}, "shaft"),
        ((40, 48), 2, {}, {}, "hub"),
        ((40, 48), 2, {"triangles": True}, {}, "auto"),
    ],
    ids=["function", "triangles", "curved", "geometry", "geometry, triangles"],
)
def test_a_ring_shrunk_on_another(cells, order, mesh, contact, secondary):
    overlap = OVERLAP if contact.get("gap", "curved") == "curved" else 0.0
    p = ring_problem(cells, order, mesh | {"overlap": overlap}, secondary=secondary, **contact)
    mean, error = against_lame(p)
    assert abs(mean) <= (0.005 if contact else 0.01)
    assert error <= (0.03 if contact else 0.05)


def test_free_rings_are_solved():
    """Rows hold the turn of one in the other by the errors of their normals, or not at all."""
    p = ring_problem((24, 32), 2, {"subdomains": 8, "overlap": OVERLAP}, 0.0, secondary="hub")
    assert abs(against_lame(p)[0]) <= 0.011
    assert p.report.converged_reason == "CONVERGED_RTOL"
    assert p.report.residuals["displacement_error"] <= 1e-8
    assert p.report.residuals["penetration"] <= 1e-8 * OVERLAP
    assert p.report.free_modes >= 3
    assert "rotation in the plane" in {motion["mode"] for motion in p.report.nearly_free}


def test_the_gap_of_an_obstacle_is_what_is_given():
    d, plane = decomposed("quadrilateral", 4), tfeti.Plane((0, -0.3), (0, 1))
    for gap, expected in ((0.01, 0.01), (-0.02, -0.02), (lambda x: 0.1 * x[0], None)):
        contacts = [tfeti.Obstacle("bottom", plane, gap=gap)]
        p = solved(problem(d, contacts=contacts, clamped=("top",), loaded="right"))
        records, x = p.solution.gluing.records, p.solution.contact().points
        assert np.allclose(records.gap, 0.1 * x[:, 0] if expected is None else expected)
        assert p.report.contact_rows > 0
    with pytest.raises(tfeti.InputError, match="obstacle of surface 'bottom': gap=nan, expected"):
        problem(d, contacts=[tfeti.Obstacle("bottom", plane, gap=np.nan)]).solve()


def test_the_gap_of_a_pair_is_what_is_given():
    """Also where the meshes overlap by more than the reach."""
    dofs = dofs_on(stacked("triangle", 3, 4, 4, gap=-0.1))
    records = searched([sided(*ORDERS[0], gap=lambda x: x[0] - 0.5)], dofs)
    assert np.allclose(records.gap, group_points(dofs)[records.group][:, 0] - 0.5)
    assert MPI.COMM_WORLD.allreduce(len(records)) == 5
