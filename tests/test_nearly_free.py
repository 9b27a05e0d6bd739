"""Motions that contact holds hardly or not at all are named; of free ones the smallest is taken."""

import basix.ufl
import numpy as np
import pytest
import ufl
from bodies import clamped, drawn, joined, no_load, torn_boxes, two_body_problem
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import accepted, bumpy, decomposed, exterior, problem, solved
from true_errors import ring_problem

import tfeti_dolfinx as tfeti
from meshes.rings import lame_pressure
from meshes.rings import rings as shrunk


def ring(centre, inner, outer, layers, around, jitter, seed):
    """Nodes and quadrilaterals of a ring whose nodes are not quite evenly spaced."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(around) + jitter * rng.uniform(-1, 1, around)) / around
    r = np.linspace(inner, outer, layers + 1)
    points = np.stack((np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle))), axis=2)
    i, j = (index.ravel() for index in np.indices((layers, around)))
    a, b = i * around + j, i * around + (j + 1) % around
    return centre + points.reshape(-1, 2), np.stack((a, a + around, b, b + around), axis=1)


def rings(parts, subdomains):
    """Rings in one mesh, each with its sides: ``in0``, ``out0``, ``in1``, ..."""
    element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    mesh = joined([ring(*part) for part in parts], element)
    facets, at, beside = exterior(mesh)
    values, names = np.zeros(len(facets), dtype=np.int32), {}
    for i, (centre, inner, outer, *_) in enumerate(parts):
        own = np.linalg.norm(beside - centre, axis=1)
        own = (own > inner * 0.9) & (own < outer)
        outside = np.linalg.norm(at - centre, axis=1) > 0.5 * (inner + outer)
        values[own] = 2 * i + 1 + outside[own]
        names |= {f"in{i}": 2 * i + 1, f"out{i}": 2 * i + 2}
    tags = dmesh.meshtags(mesh, 1, facets, values)
    return tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=names)


def ring_in_ring(subdomains, jitter, rtol):
    """Pressure inside the inner ring; the outer one is held outside."""
    parts = [((0, 0), 0.5, 1.0, 2, 24, jitter, 1), ((0, 0), 1.0, 1.5, 2, 36, jitter, 2)]
    d = rings(parts, subdomains)

    def load(v, ds):
        return -0.01 * ufl.dot(ufl.FacetNormal(d.mesh), v) * ds(d.surface("in0"))

    pair = tfeti.Contact("out0", "in1", reach=0.2)
    return two_body_problem(d, load, clamped(d, "out1"), [pair], rtol=rtol)


def three_discs(subdomains, jitter):
    """Heavy discs in a row on a floor, a little apart from the walls beside them."""
    parts = [((2.0 * i, 0.0), 0.3, 1.0, 2, 20, jitter, i) for i in range(3)]
    d = rings(parts, subdomains)
    contacts = [tfeti.Contact(f"out{i}", f"out{i + 1}", reach=0.2) for i in range(2)]
    contacts += [tfeti.Obstacle(f"out{i}", tfeti.Plane((0, -1), (0, 1))) for i in range(3)]
    contacts += [
        tfeti.Obstacle("out0", tfeti.Plane((-1.01, 0), (1, 0))),
        tfeti.Obstacle("out2", tfeti.Plane((5.01, 0), (-1, 0))),
    ]
    return two_body_problem(d, drawn(d, None, (0.0, -1e-3)), clamped(d), contacts)


def motions(p):
    """Mean displacement and turn of each body, on nodes counted once."""
    d, dofs = p.decomposition, p.dofs
    u = dofs.to_primal(p.u.x.array).reshape(-1, 2)
    x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node, :2]
    share = 1.0 / dofs.spread(dofs.multiplicity)
    body, found = d.body_of_subdomain[dofs.node_subdomain], []
    for b in range(d.num_bodies):
        w, y, v = share[body == b], x[body == b], u[body == b]
        sums = d.comm.allreduce(np.concatenate(([w.sum()], w @ y, w @ v)))
        centre, mean = sums[1:3] / sums[0], sums[3:] / sums[0]
        y = y - centre
        turn = np.sum(w * (y[:, 0] * v[:, 1] - y[:, 1] * v[:, 0]))
        size = np.sum(w * np.sum(y**2, axis=1))
        found.append((*mean, d.comm.allreduce(turn) / d.comm.allreduce(size)))
    return np.array(found)


def test_a_ring_in_an_even_ring_does_not_turn():
    """Nothing holds its turn; friction of no force, first, would leave that to rounding."""
    for subdomains in (2, 5):
        p = solved(ring_in_ring(subdomains, 0.0, 1e-6))
        assert np.abs(motions(p)[:, 2]).max() <= 1e-8
        assert p.report.free_modes == 1
        (only,) = p.report.nearly_free
        assert (only["mode"], only["stiffness"]) == ("rotation in the plane", 0.0)
    fit = {"friction": tfeti.Coulomb(0.1), "gap": 0.0, "name": "fit"}
    for subdomains in (2, 12, 33):
        p = solved(ring_problem((16, 20), 1, {"subdomains": subdomains, "turn": 0.0}, 0.0, **fit))
        p.update(gap={"fit": -1e-3})
        p.solve()
        assert p.report.F_multiplications <= 25


@pytest.mark.parametrize(
    ("cells", "degree", "away"),
    [((16, 20), 2, 0.0), ((17, 33), 2, 0.0), ((40, 30), 1, 1e4), ((16, 20), 1, 0.0)],
)
def test_a_fit_that_nothing_holds_in_space_is_right_with_friction(cells, degree, away):
    """Sides of friction are apart by curved facets; that does not hold both rings as one."""
    d = shrunk(MPI.COMM_WORLD, cells, degree)
    d.mesh.geometry.x[:, :2] += away
    fit = tfeti.Contact("shaft", "hub", gap=-0.01, friction=tfeti.Coulomb(0.5))
    p = solved(two_body_problem(d, no_load, lambda V: [], [fit], degree, rtol=1e-8))
    contact = p.solution.contact(0)
    pressure = d.comm.allreduce(contact.force.sum()) / d.comm.allreduce(contact.area.sum())
    assert pressure == pytest.approx(lame_pressure(0.01), rel=0.03)
    assert p.report.F_multiplications <= 50
    assert p.report.free_modes == 3


def test_a_torque_on_a_fit_that_floats_is_named():
    d, rough = shrunk(MPI.COMM_WORLD, (16, 20)), {"friction": tfeti.Coulomb(0.5)}
    x, y = ufl.SpatialCoordinate(d.mesh)
    fits = [tfeti.Contact("shaft", "hub", gap=-0.01, **rough)]
    way, rim = 1e-5 * ufl.as_vector((-y, x)), d.surface("rim")
    with pytest.raises(tfeti.NoSolutionError, match=r"together \(rotation"):
        two_body_problem(d, lambda v, ds: ufl.dot(way, v) * ds(rim), lambda V: [], fits).solve()


@pytest.mark.parametrize("law", [None, tfeti.Coulomb(0.2)])
def test_a_fit_is_taken_to_nothing_and_back(law):
    d, pressures = shrunk(MPI.COMM_WORLD, (16, 20), 2), []
    fit = tfeti.Contact("shaft", "hub", gap=-0.005, friction=law)
    p = two_body_problem(d, no_load, clamped(d, "bore"), [fit], 2)
    for gap in (-0.01, 0.0, 0.0, -0.01, 0.0):
        p.update(gap={0: gap})
        pressures.append(accepted(p).contact().pressure)
    assert pressures[3] == pytest.approx(pressures[0], rel=1e-3)
    assert max(pressures[1], pressures[2], pressures[4]) < 1e-6 * pressures[0]


def test_fits_are_released_beside_one_that_stays():
    """What rounding leaves of their forces holds no ring, and is not iterated on for long."""
    given = [(0, 0.4, 16), (0, 1.0, 20), (0, 1.6, 24), (6, 0.4, 16), (6, 1.0, 20)]
    parts = [((x, 0), r, r + 0.6, 2, n, 0.05, i) for i, (x, r, n) in enumerate(given, 1)]
    d, fit = rings(parts, 5), {"gap": 0.0, "friction": tfeti.Coulomb(0.3)}
    fits = [tfeti.Contact(f"out{i}", f"in{i + 1}", secondary=f"out{i}", **fit) for i in (0, 1, 3)]
    p = two_body_problem(d, no_load, clamped(d, "out2", "out4"), fits, rtol=1e-8)
    for overlaps in ((1, 0, 0), (1, 1, 1), (0, 0, 1)):
        p.update(gap={i: -1e-3 * o for i, o in enumerate(overlaps)})
        assert accepted(p).F_multiplications <= 600


@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_a_light_pin_in_a_hole_bears_a_torque_up_to_its_angle_of_friction(gap):
    """It rolls up the side of the hole by an angle whose sine is the torque over W r."""
    parts = [((0, 0), 0.3, 1.0 - gap, 3, 40, 0.0, 1), ((0, 0), 1.0, 1.5, 2, 48, 0.0, 2)]
    d = rings(parts, 4)
    (x, y), torque = ufl.SpatialCoordinate(d.mesh), fem.Constant(d.mesh, 0.0)
    pulls = ufl.as_vector((-torque * y / 0.09, torque * x / 0.09 - 1.0))

    def load(v, ds):
        return 1e-5 * ufl.dot(pulls, v) * ds(d.surface("in0"))

    contact = tfeti.Contact("out0", "in1", friction=tfeti.Coulomb(0.3))
    p = two_body_problem(d, load, clamped(d, "out1"), [contact])
    sine = 0.3 / np.hypot(1.0, 0.3) * (1.0 - gap)
    for share in (0.0, -0.5, 0.9, 0.3):
        torque.value = share * sine
        p.solve()
        borne = p.solution.contact(0).resultant
        force, moment = borne.force[1], borne.moment[2]
        assert abs(borne.force[0]) <= 1e-6 * force
        assert moment / force == pytest.approx(-torque.value, abs=0.01 * sine)
        assert p.report.F_multiplications <= 400
    torque.value = 1.1 * sine
    with pytest.raises(tfeti.ConvergenceError, match="DIVERGED_FRICTION"):
        p.solve()


def test_a_ring_that_polygons_hold_by_a_little():
    """Its turn follows from the meshes: small normals' errors hold it, which is said."""
    turns, held = [], []
    for subdomains in (2, 5):
        p = solved(ring_in_ring(subdomains, 0.05, 1e-8))
        turns.append(motions(p)[:, 2])
        (only,) = p.report.nearly_free
        assert only["mode"] == "rotation in the plane"
        held.append(only["stiffness"])
        assert p.report.free_modes == 0
    assert 1e-6 < held[0] < 1e-2
    assert held[0] == pytest.approx(held[1], rel=1e-6)
    assert np.allclose(turns[0], turns[1], atol=1e-5 * np.abs(turns[0]).max() + 1e-9)


@pytest.mark.parametrize(("jitter", "layouts"), [(0.0, (3, 6)), (0.2, (3, 7))])
def test_three_discs_between_walls_are_held_alike_on_all_layouts(jitter, layouts):
    """They may slide until they meet, which is said; how they stand is known."""
    results = []
    for subdomains in layouts:
        p = solved(three_discs(subdomains, jitter))
        results.append(motions(p)[:, 1])
        assert p.report.residuals["penetration"] <= p.report.tolerances["penetration"]
        assert p.report.residuals["gluing_jump"] <= p.report.tolerances["gluing_jump"]
        named = {(m["bodies"][0], m["mode"]) for m in p.report.nearly_free}
        assert {(f"body {b}", "translation in x") for b in range(3)} <= named
        (note,) = p.report.notes
        assert "body 0: translation in x" in note
    assert np.allclose(results[0], results[1], atol=1e-5 * np.abs(results[0]).max())


def test_a_block_that_slides_freely_stays_where_it_is():
    """No force along the floor, so no way along it, whatever the subdomains."""
    for subdomains in (1, 4):
        d = decomposed("quadrilateral", 4, subdomains)
        floor = [tfeti.Obstacle("bottom", tfeti.Plane((0, -0.01), (0, 1)))]
        p = solved(problem(d, (0.0, -0.05), floor, clamped=(), tfeti_rtol=1e-9))
        assert abs(motions(p)[0, 0]) <= 1e-9
        only = {"bodies": ["body 0"], "mode": "translation in x", "stiffness": 0.0}
        assert p.report.nearly_free == [only]


def test_a_clamped_beam_needs_no_contact_to_hold_it():
    d = decomposed("quadrilateral", 4, 2)
    d.mesh.geometry.x[:, 0] *= 10.0
    p = problem(d, (0.0, -1e-4), [tfeti.Obstacle("bottom", tfeti.Plane((0, -0.01), (0, 1)))])
    p.solve()
    assert (p.report.active_contacts > 0, p.report.warnings) == (True, [])


@pytest.mark.parametrize(("share", "rtol"), [(1e-5, 1e-4), (1e-3, 1e-2)])
def test_forces_hold_a_light_body_beside_one_that_is_pressed(share, rtol):
    """They are small beside errors of the other's; of a third body, that nothing loads, none."""
    parts = [(name, (2.0 * i, 0.0), (2.0 * i + 1.0, 1.0), (8, 8)) for i, name in enumerate("abc")]
    d = torn_boxes("triangle", parts, 6)
    floor = bumpy(0.002, 0.0)
    contacts = [tfeti.Obstacle(f"{name} bottom", floor) for name in "abc"]

    def load(v, ds):
        return drawn(d, "a top", (0, -0.01))(v, ds) + drawn(d, "b top", (0, -0.01 * share))(v, ds)

    p = solved(two_body_problem(d, load, clamped(d), contacts, rtol=rtol))
    forces = [p.solution.contact(k).resultant.force[1] for k in range(3)]
    assert np.allclose(forces, (0.01, 0.01 * share, 0.0), rtol=1e-6, atol=0.0)
