"""Coulomb's friction from the user's door: its law, and its limits."""

import numpy as np
import pytest
import ufl
from bodies import clamped, drawn, held, pressed, sided, stacked, torn_boxes, two_body_problem
from dolfinx import fem, mesh
from mpi4py import MPI
from scenes import apart, bumpy, decomposed, displacement, forms, problem, solved, vectors
from test_friction_fields import SCENES, floor, on_a_floor
from test_nearly_free import rings

import tfeti_dolfinx as tfeti


@pytest.mark.parametrize(("cell", "traction"), SCENES)
def test_the_law_holds(cell, traction, comm):
    """Traction at most μ times pressure; slip against it where they are equal, else none."""
    p, mu = on_a_floor(cell, tfeti.Coulomb(0.3), traction), 0.3
    assert p.report.sticking > 0
    assert p.report.sliding > 0
    data = p.solution.contact()
    largest = np.max(comm.allgather(float(data.pressure.max(initial=0.0))))
    size, slid = (np.linalg.norm(v, axis=1) for v in (data.tangential_traction, data.slip))
    closed = data.status != tfeti.ContactStatus.OPEN
    assert np.all(size <= mu * data.pressure + 1e-7 * largest)
    assert np.all(size[~closed] <= 1e-7 * largest)
    strict = closed & (size < (1.0 - 1e-4) * mu * data.pressure)
    assert np.all(slid[strict] <= 1e-8)
    slides = data.status == tfeti.ContactStatus.SLIP
    opposed = np.sum(data.tangential_traction * data.slip, axis=1)[slides]
    assert np.allclose(opposed, -(size * slid)[slides], rtol=1e-5, atol=1e-10)
    assert np.allclose(size[slides], mu * data.pressure[slides], rtol=1e-5, atol=1e-7 * largest)


MU = (0.4, 0.15)


def capacity(angle, press):
    """What holds a block that is pressed and pulled along an angle."""
    return press / np.hypot(np.cos(angle) / MU[0], np.sin(angle) / MU[1])


@pytest.mark.parametrize("angle", [0.3, pytest.param(np.pi / 2, marks=pytest.mark.slow)])
def test_a_block_pulled_at_an_angle_slips_at_its_capacity(angle):
    """Orthotropic: a load that is 0.1 % above it has no solution."""
    d, press = decomposed("hexahedron", 2, 2), 0.1
    law = tfeti.Coulomb(MU, direction=(1, 0, 0))
    pull = capacity(angle, press) * np.array([np.cos(angle), np.sin(angle)])
    p = problem(d, (*(1.001 * pull), -press), [floor(3, law)], clamped=())
    with pytest.raises(tfeti.NoSolutionError, match=r"would have to be 1\.001 times as large"):
        p.solve()
    p = solved(problem(d, (*(0.95 * pull), -press), [floor(3, law)], clamped=()))
    assert p.report.converged_reason == "CONVERGED_RTOL"


def test_a_block_that_is_drawn_along_slides_at_its_capacity(comm):
    """Its top is drawn, its bottom slides: the force is on the ellipse, where that is normal."""
    d, law = decomposed("hexahedron", 3, 2), tfeti.Coulomb(MU, direction=(1, 0, 0))
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, 0.0, 0.0), d.surface("top"))
    angle, value = 0.3, np.array([5.0 * np.cos(0.3), 5.0 * np.sin(0.3), -0.1])
    bcs = clamped(d, ("top", value))(V)
    p = solved(tfeti.ContactProblem(a, L, bcs, [floor(3, law)], d, petsc_options={"rtol": 1e-7}))
    assert p.report.sticking == 0
    data = p.solution.contact()
    friction = comm.allreduce((data.area[:, None] * data.tangential_traction).sum(axis=0))[:2]
    pressed = comm.allreduce(float(data.force.sum()))
    along = np.arctan2(-friction[1], -friction[0])
    assert np.linalg.norm(friction) == pytest.approx(capacity(along, pressed), rel=1e-3)
    normal = np.arctan2(friction[1] / MU[1] ** 2, friction[0] / MU[0] ** 2)
    assert normal == pytest.approx(np.arctan2(-np.sin(angle), -np.cos(angle)), abs=0.02)


@pytest.mark.parametrize("law", [tfeti.Coulomb(0.3), tfeti.Tresca(0.003)])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_a_block_that_is_drawn_by_its_side_rubs_there_too(cell, law, comm):
    """Drawn to and fro: all of the floor bears its bound, and who draws has it to bear."""
    d = decomposed(cell, 4, 2)
    gdim, way = d.mesh.geometry.dim, fem.Constant(d.mesh, 0.0)
    V, a, L = forms(d.mesh, d.facet_tags, np.eye(gdim)[-1] * -0.01, d.surface("top"))
    bcs, options, known = held(d, ("left", way))(V), {"rtol": 1e-9}, []
    p = tfeti.ContactProblem(a, L, bcs, [floor(gdim, law)], d, petsc_options=options)
    for way.value, force in ((0.5, -0.003), (-0.5, 0.003), (-0.5, None)):
        p.solve()
        assert p.report.F_multiplications < 35
        data, pulls = p.solution.contact(), -p.solution.reaction("left").force[0]
        assert data.resultant.force[0] == pytest.approx(pulls, abs=1e-10)
        if force:
            assert np.all(data.status == tfeti.ContactStatus.SLIP)
            assert pulls == pytest.approx(force, rel=1e-3)
            bound = 0.3 * data.pressure if isinstance(law, tfeti.Coulomb) else 0.003
            against = -np.abs(bound / np.linalg.norm(data.slip, axis=1))[:, None] * data.slip
            assert data.tangential_traction == pytest.approx(against, abs=1e-7)
        p.accept()
        known.append((p.state(), p.u.x.array.copy()))
    p.restore(known[0][0])  # conditions have the values of the next step
    p.solve()
    assert p.u.x.array == pytest.approx(known[1][1], abs=1e-7)
    q = tfeti.ContactDynamics(a, L, bcs, p.contacts, d, mass=1.0, petsc_options=options)
    for record in tfeti.LoadSteps(q, lambda q, t: setattr(way, "value", -0.1 * t), [0.5, 1]).run():
        assert record.motion["friction"] == pytest.approx(-record.dissipation, rel=1e-6)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_bodies_that_are_carried_along_together_rub_as_if_they_stayed(cell):
    """Where sides are held that do not match: what conditions leave of a slip moves along."""
    d, law, found = stacked(cell, 4, 3, upper=(0.0, 0.8)), tfeti.Coulomb(0.3), []
    pair, way = sided("upper bottom", "lower top", friction=law), fem.Constant(d.mesh, 0.0)
    bcs = held(d, "lower bottom", ("lower left", way), ("upper left", way))
    p = two_body_problem(d, pressed(d, 0.01), bcs, [pair], rtol=1e-9)
    for way.value in (0.0, 1.0):
        p.solve()
        found.append(p.solution.contact().tangential_traction)
    assert found[1] == pytest.approx(found[0], abs=1e-6)


@pytest.mark.parametrize(
    ("cell", "mu", "tilt", "size", "rtol", "shares", "kind_of"),
    [
        # directions of a face that holds the block by rounding alone do not balance any load
        ("quadrilateral", 0.1, 0.1, (8, 4), 1e-6, (0.5, 0.9, 0.96, 0.97, 0.99, 0.5, 0.99), "auto"),
        # rows that slip and stick by turns
        ("quadrilateral", 0.05, 0.1, (12, 6), 1e-9, (0.5, 0.75, 0.589, 0.01, 0.99), "auto"),
        ("triangle", 0.05, 0.1, (12, 6), 1e-9, (0.5, 0.75, 0.589, 0.01, 0.99), "auto"),
        # bounds of the step before do not hold the block
        ("quadrilateral", 0.5, 1.0, (8, 4), 1e-6, (0.1, 0.9), "fixed_point"),
    ],
)
def test_a_block_on_a_slope_pushed_up_and_down_near_its_limits(
    cell, mu, tilt, size, rtol, shares, kind_of
):
    """Shares of the way from the force at which it slides down to the one at which it goes up."""
    kind = getattr(mesh.CellType, cell)
    whole = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (4, 2)], size, kind)
    d = tfeti.decompose(whole, 2, surfaces={"bottom": lambda x: np.isclose(x[1], 0.0)})
    c, s = np.array((1.0, tilt)) / np.hypot(1.0, tilt)
    d.mesh.geometry.x[:, :2] = d.mesh.geometry.x[:, :2] @ np.array(((c, s), (-s, c)))
    low, high = (tilt - mu) / (1 + mu * tilt), (mu + tilt) / (1 - mu * tilt)  # of its weight
    elastic = tfeti.Elasticity(d, E=1e3, nu=0.3, model="plane_strain")
    V, u, v = vectors(d)
    push = fem.Constant(d.mesh, (0.0, -0.125))

    def pushed_by(share, problem=None):
        push.value[0] = 0.125 * (low + share * (high - low))
        plane = tfeti.Plane((0, 0), normal=(-s, c))
        floor = tfeti.Obstacle("bottom", plane, friction=tfeti.Coulomb(mu))
        given = elastic.a(u, v), ufl.inner(push, v) * ufl.dx, [], [floor], d
        problem = problem or tfeti.ContactProblem(*given, petsc_options=options)
        problem.solve()
        return problem

    options, warm = {"rtol": rtol, "friction_type": kind_of}, None
    for share in shares:
        warm = pushed_by(share, warm)
        cold = pushed_by(share)
        assert apart(warm.u.x.array, cold.u.x.array) <= 5.0 * rtol
        cold.destroy()


def test_the_body_that_slides_without_end_is_named():
    """Of a square pressed on a plane and one between walls that nothing presses."""
    parts = [("still", (0.0, 0.0), (1.0, 1.0), (3, 3)), ("loose", (2.0, 0.0), (3.0, 1.0), (3, 3))]
    d = torn_boxes("quadrilateral", parts, 4)
    planes = {"still bottom": ((0, 0), (0, 1)), "loose left": ((2, 0), (1, 0))}
    planes["loose right"], law = ((3, 0), (-1, 0)), tfeti.Coulomb(0.5)
    given = {"friction": law, "reach": np.inf}
    contacts = [tfeti.Obstacle(on, tfeti.Plane(*plane), **given) for on, plane in planes.items()]
    tops = d.surface("still top"), d.surface("loose top")
    p = two_body_problem(d, lambda v, ds: -0.05 * v[1] * ds(tops), clamped(d), contacts)
    said = r"body \d is free to move \(translation in y\) without end on contact 1: .* 2: .* gap"
    with pytest.raises(tfeti.ConvergenceError, match=f"DIVERGED_FRICTION .* {said}"):
        p.solve()


def test_a_ring_is_turned_in_its_fit_as_far_as_friction_holds(comm):
    """Above that it would wedge at 180 radians, as nodes are spaced unevenly by 1e-4."""
    d = rings([((0, 0), r, r + 0.5, 2, 24, 1e-4, seed) for r, seed in ((0.5, 1), (1.0, 2))], 3)
    twist, (x, y) = fem.Constant(d.mesh, 1e-3), ufl.SpatialCoordinate(d.mesh)

    def load(v, ds):
        return twist * (x * v[1] - y * v[0]) * ds(d.surface("in0"))

    fit = tfeti.Contact("out0", "in1", gap=-0.01, friction=tfeti.Coulomb(0.2), name="fit")
    p = solved(two_body_problem(d, load, clamped(d, "out1"), [fit]))
    fit = p.solution.contact("fit")
    pressed, turned = comm.allreduce(fit.force.sum()), abs(fit.resultant.moment[2])
    twist.value *= 0.97 * 0.2 * np.cos(np.pi / 24) * pressed / turned
    p.solve()
    assert np.abs(p.u.x.array).max(initial=0.0) < 0.01
    twist.value *= 1.05 / 0.97
    with pytest.raises(tfeti.ConvergenceError, match=r"in the plane\) without end on .*: fit, "):
        p.solve()
    p.update(values=[])
    with pytest.raises(tfeti.NoSolutionError, match=r"rotation in the plane\): nothing resists"):
        p.solve()


def test_what_sticks_where_a_wall_pushes_slips():
    """Sticking to the floor contradicts a wall that overlaps it by 0.01: bounds hold neither."""
    d, law = decomposed("quadrilateral", 4, 3), tfeti.Coulomb(0.3)
    wall = tfeti.Obstacle("left", tfeti.Plane((0.01, 0), (1, 0)), friction=law)
    p = solved(problem(d, (0.0, -0.05), [floor(2, law), wall], clamped=(), rtol=1e-8))
    x, u = displacement(p)
    assert u[np.isclose(x[:, 0], 0.0), 0].min() >= 0.01 - 1e-9
    for one in map(p.solution.contact, (0, 1)):
        size = np.linalg.norm(one.tangential_traction, axis=1)
        assert np.all(size <= 0.3 * one.pressure + 1e-8)


@pytest.mark.parametrize(("weight", "side"), [(1e-4, 0.026), (1e-6, 0.2), (1e-7, 0.026)])
def test_a_block_that_falls_onto_waves_is_held(weight, side):
    """If all points stuck it would hang above them, and press nowhere."""
    d = torn_boxes("quadrilateral", [("a", (0.0, 0.0), (1.0, 0.7), (6, 3))], 2)
    contacts = [tfeti.Obstacle("a bottom", bumpy(0.004, 0.006), friction=tfeti.Coulomb(0.5))]
    force = fem.Constant(d.mesh, (weight * side, -weight))
    p = solved(two_body_problem(d, drawn(d, None, force), clamped(d), contacts))
    found = p.solution.contact().resultant.force[:2]
    assert np.allclose(found, -0.7 * np.asarray(force.value), rtol=1e-6, atol=0.0)
