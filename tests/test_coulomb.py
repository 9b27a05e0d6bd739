"""Coulomb's friction from the user's door: against its own natural map, limits, its law."""

import numpy as np
import pytest
import ufl
from bodies import boxes, two_body_problem
from dolfinx import fem
from hypothesis import given, settings
from hypothesis import strategies as st
from mpi4py import MPI
from reference.friction import parts
from scenes import clamp, decomposed, displacement, forms, hooke, problem
from test_friction_fields import EXACT, SCENES, floor, solved
from test_tresca import SIDES, SOLVERS, nodal_data, on_the_plane, stresses, two_boxes

import tfeti_dolfinx as tfeti
from demos import mindlin_3d
from demos.partial_slip import pushed
from meshes import half_spaces

# the change of bounds at which they are at rest is 100 rtol: u and forces follow to this
SHARE = 1e-6
COEFFICIENTS = stresses(0.0, 0.5)
LOADS_2D = st.tuples(stresses(-0.06, 0.06), stresses(-0.08, 0.01))
LOADS_3D = st.tuples(stresses(-0.04, 0.04), stresses(-0.04, 0.04), stresses(-0.08, 0.01))
SCENES_2D = st.tuples(
    st.sampled_from(["triangle", "quadrilateral"]),
    st.integers(2, 5),
    st.integers(1, 4),
    LOADS_2D,
    COEFFICIENTS.map(lambda mu: (mu,)),
)
SCENES_3D = st.tuples(
    st.sampled_from(["tetrahedron", "hexahedron"]),
    st.integers(2, 3),
    st.integers(1, 4),
    LOADS_3D,
    st.one_of(COEFFICIENTS.map(lambda mu: (mu,)), st.tuples(COEFFICIENTS, COEFFICIENTS)),
    st.floats(0.0, 3.0),
)


@SOLVERS
@settings(max_examples=12)
@given(SCENES_2D, st.sampled_from([0.0, 0.01]))
def test_a_square_on_a_plane(qp_type, scene, gap):
    on_the_plane(*scene, gap=gap, kind=tfeti.Coulomb, share=SHARE, qp_type=qp_type)


@SOLVERS
@settings(max_examples=6)
@given(SCENES_3D)
def test_a_cube_on_a_plane(qp_type, scene):
    on_the_plane(*scene, kind=tfeti.Coulomb, share=SHARE, qp_type=qp_type)


@SOLVERS
@settings(max_examples=8)
@given(SCENES_2D, SIDES)
def test_a_square_on_a_square(qp_type, scene, secondary):
    two_boxes(*scene, 0.0, secondary, kind=tfeti.Coulomb, share=SHARE, qp_type=qp_type)


@SOLVERS
@settings(max_examples=4)
@given(SCENES_3D, SIDES)
def test_a_cube_on_a_cube(qp_type, scene, secondary):
    two_boxes(*scene, secondary, kind=tfeti.Coulomb, share=SHARE, qp_type=qp_type)


@pytest.mark.parametrize(("cell", "traction"), SCENES)
def test_a_coefficient_of_0_is_no_friction(cell, traction):
    without = solved(cell, None, traction)
    with_none = solved(cell, tfeti.Coulomb(0.0), traction)
    assert np.allclose(displacement(with_none)[1], displacement(without)[1], rtol=0, atol=1e-9)
    assert with_none.report.sticking == with_none.report.friction_iterations == 0


@pytest.mark.parametrize(("cell", "traction"), SCENES)
def test_a_large_coefficient_sticks(cell, traction, comm):
    p = solved(cell, tfeti.Coulomb(1e3), traction)
    assert p.report.sliding == 0
    assert p.report.sticking == p.report.active_contacts > 0
    _, _, status, slip = nodal_data(p.solution, comm)
    sticks = status == tfeti.ContactStatus.STICK
    assert np.abs(slip[sticks]).max() <= 1e-9 * np.abs(displacement(p)[1]).max()


@pytest.mark.parametrize(("cell", "traction"), SCENES)
def test_the_law_holds(cell, traction, comm):
    """Traction at most μ times pressure; slip against it where they are equal, else none."""
    p, mu = solved(cell, tfeti.Coulomb(0.3), traction), 0.3
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


@pytest.mark.parametrize(("cell", "traction"), SCENES)
def test_few_problems_with_given_bounds(cell, traction):
    p = solved(cell, tfeti.Coulomb(0.3), traction, rtol=1e-6)
    assert 0 < p.report.friction_iterations <= 10
    assert p.report.residuals["friction"] <= p.report.tolerances["friction"]
    assert p.report.tolerances["friction"] == pytest.approx(1e-4)
    p.solve()  # the same load again
    assert p.report.F_multiplications <= 2
    assert p.report.factorizations == 0


@pytest.mark.parametrize("subdomains", [2, 6])
def test_what_is_open_has_no_bound(subdomains, comm):
    """Forces that rounding leaves on open nodes were discs that block Newton could not follow."""
    a = mindlin_3d.a
    model = half_spaces.build(1.0, a / 4, 1.2 * a, growth=0.4) if comm.rank == 0 else None
    loads, parts = mindlin_3d.scene(tfeti.read_gmsh(model, comm, subdomains))
    p = tfeti.ContactProblem(**parts)
    for share in (0.0, 0.3):
        pushed(p, loads, mindlin_3d.CLOSED, share * mindlin_3d.CLOSED.capacity)
        assert p.report.friction_iterations <= 10
    p.destroy()


def beside(shear, rtol):
    """Two boxes apart on rough planes, the second loaded by 1e-4 of what the first is."""
    parts = [("heavy", (0.0, 0.0), (1.0, 1.0), (4, 4)), ("light", (2.0, 0.0), (3.0, 1.0), (4, 4))]
    mesh, tags, names = boxes("quadrilateral", parts)
    d = tfeti.decompose(mesh, 4, facet_tags=tags, surfaces=names)
    heavy, light = (fem.Constant(d.mesh, np.array(q)) for q in ((0.03, -0.05), (shear, -5e-6)))

    def load(v, ds):
        return sum(
            ufl.dot(q, v) * ds(d.surface(f"{name} top"))
            for q, name in ((heavy, "heavy"), (light, "light"))
        )

    plane = tfeti.Plane((0, 0), (0, 1))
    contacts = [
        tfeti.Obstacle(f"{name} bottom", plane, friction=tfeti.Coulomb(0.3), reach=np.inf)
        for name in ("heavy", "light")
    ]
    clamped = ("heavy left", "light left")
    p = two_body_problem(
        d, load, lambda V: [clamp(V, d.facets(name)) for name in clamped], contacts, rtol=rtol
    )
    p.solve()
    return p, light


def test_bounds_of_a_light_body_come_to_rest():
    """Beside those of a heavy one nothing of them was seen: u was off by a hundredth."""
    p, light = beside(3e-6, 1e-6)
    light.value[0] = 4.5e-6
    p.solve()
    x, u = displacement(p)
    exact = displacement(beside(4.5e-6, 1e-10)[0])[1]
    for on in (x[:, 0] < 1.5, x[:, 0] > 1.5):
        assert np.abs(u - exact)[on].max() <= 1e-4 * np.abs(exact[on]).max()


def test_limits_are_values_of_a_set():
    """A set under other forces of normals leaves the problem, and the rows, as they are."""
    p = solved("quadrilateral", tfeti.Coulomb(0.3), (0.05, -0.05))
    rows, now = p.solution.gluing.constraints, p.dual.constraints
    limits, x = now.limits.copy(), np.linspace(-1.0, 1.0, rows.num_rows)
    loose = p.dual.set_under(np.full(len(rows.pressed), np.inf)).project(x)
    assert np.array_equal(loose[rows.sets.tangents], x[rows.sets.tangents])
    assert np.array_equal(now.limits, limits)
    assert not np.any(rows.limits)
    p.destroy()


def test_bounds_that_do_not_come_to_rest_are_an_error():
    slow = {"friction_type": "fixed_point", "friction_max_it": 2}
    with pytest.raises(tfeti.ConvergenceError, match="DIVERGED_FRICTION .*Coulomb's friction do"):
        solved("quadrilateral", tfeti.Coulomb(0.3), (0.05, -0.05), **slow)


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_friction_alone_holds_a_body(cell, comm):
    """Up to μ times what presses it; beyond that the error says by how much."""
    d, mu, press = decomposed(cell, 3, 3), 0.3, 0.1
    gdim = d.mesh.geometry.dim
    for share in (0.5, 0.9):
        traction = (share * mu * press, *np.zeros(gdim - 2), -press)
        p = problem(d, traction, [floor(gdim, tfeti.Coulomb(mu))], clamped=(), rtol=1e-8)
        p.solve()
        data = p.solution.contact()
        friction = (data.area[:, None] * data.tangential_traction).sum(axis=0)
        expected = np.r_[-share * mu * press, np.zeros(gdim - 1)]
        assert np.allclose(comm.allreduce(friction), expected, rtol=0, atol=1e-7)
        assert p.report.free_modes == 0
    traction = (1.5 * mu * press, *np.zeros(gdim - 2), -press)
    p = problem(d, traction, [floor(gdim, tfeti.Coulomb(mu))], clamped=(), rtol=1e-6)
    with pytest.raises(tfeti.NoSolutionError, match=r"translation in x.* 1\.5\d* times as large"):
        p.solve()


def test_what_sticks_where_a_wall_pushes_slips():
    """Sticking to the floor contradicts a wall that overlaps it by 0.01: bounds hold neither."""
    d = decomposed("quadrilateral", 4, 3)
    law = tfeti.Coulomb(0.3)
    wall = tfeti.Obstacle("left", tfeti.Plane((0.01, 0), (1, 0)), friction=law)
    p = problem(d, (0.0, -0.05), [floor(2, law), wall], clamped=(), rtol=1e-8)
    p.solve()
    x, u = displacement(p)
    assert u[np.isclose(x[:, 0], 0.0), 0].min() >= 0.01 - 1e-9
    data = [p.solution.contact(k) for k in (0, 1)]
    for one in data:
        size = np.linalg.norm(one.tangential_traction, axis=1)
        assert np.all(size <= 0.3 * one.pressure + 1e-8)


MU = (0.4, 0.15)


def capacity(angle, press):
    """What holds a block that is pressed and pulled along an angle."""
    return press / np.hypot(np.cos(angle) / MU[0], np.sin(angle) / MU[1])


@pytest.mark.parametrize("angle", [0.0, 0.3, pytest.param(0.9, marks=pytest.mark.slow), np.pi / 2])
def test_a_block_pulled_at_an_angle_slips_at_its_capacity(angle):
    """Within 0.1 %, orthotropic: a load above it has no solution, one below it may have one."""
    d, press = decomposed("hexahedron", 2, 2), 0.1
    law = tfeti.Coulomb(MU, direction=(1, 0, 0))
    pull = capacity(angle, press) * np.array([np.cos(angle), np.sin(angle)])
    p = problem(d, (*(1.001 * pull), -press), [floor(3, law)], clamped=())
    with pytest.raises(tfeti.NoSolutionError, match=r"would have to be 1\.001 times as large"):
        p.solve()
    below = {"max_it": 5, "error_if_not_converged": False}
    p = problem(d, (*(0.999 * pull), -press), [floor(3, law)], clamped=(), **below)
    p.solve()  # is tried; so near to the capacity it takes long
    assert p.report.converged_reason != "NO_SOLUTION"
    p = problem(d, (*(0.95 * pull), -press), [floor(3, law)], clamped=())
    p.solve()
    assert p.report.converged_reason == "CONVERGED_RTOL"


@pytest.mark.parametrize("angle", [0.3, pytest.param(1.2, marks=pytest.mark.slow)])
def test_a_block_that_is_drawn_along_slides_at_its_capacity(angle, comm):
    """Its top is drawn, its bottom slides: the force is on the ellipse, where that is normal."""
    d, press = decomposed("hexahedron", 3, 2), 0.1
    law = tfeti.Coulomb(MU, direction=(1, 0, 0))
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, 0.0, 0.0), d.surface("top"))
    value = np.array([5.0 * np.cos(angle), 5.0 * np.sin(angle), -press])
    dofs = fem.locate_dofs_topological(V, 2, d.facets("top"))
    bcs = [fem.dirichletbc(value, dofs, V)]
    p = tfeti.ContactProblem(a, L, bcs, [floor(3, law)], d, petsc_options={"rtol": 1e-7})
    p.solve()
    assert p.report.sticking == 0
    data = p.solution.contact()
    friction = comm.allreduce((data.area[:, None] * data.tangential_traction).sum(axis=0))[:2]
    pressed = comm.allreduce(float(data.force.sum()))
    along = np.arctan2(-friction[1], -friction[0])
    assert np.linalg.norm(friction) == pytest.approx(capacity(along, pressed), rel=1e-3)
    normal = np.arctan2(friction[1] / MU[1] ** 2, friction[0] / MU[0] ** 2)
    assert normal == pytest.approx(np.arctan2(-np.sin(angle), -np.cos(angle)), abs=0.02)


def test_two_bodies_that_friction_joins_are_free_together():
    """Nothing holds them along the plane, and nothing drives them: the load presses only."""
    mesh, tags, names = boxes("quadrilateral", parts(2, 3, 0.0))
    d = tfeti.decompose(mesh, 3, facet_tags=tags, surfaces=names)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, -0.05), d.surface("upper top"))
    smooth = tfeti.Obstacle("lower bottom", tfeti.Plane((0, -1), (0, 1)), reach=np.inf)
    pair = tfeti.Contact("lower top", "upper bottom", friction=tfeti.Coulomb(0.3))
    p = tfeti.ContactProblem(a, L, [], [smooth, pair], d, stress=hooke())
    p.solve()
    assert p.report.free_modes == 1
    left = clamp(V, d.facets("lower left"))
    held = tfeti.ContactProblem(a, L, [left], [smooth, pair], d, stress=hooke())
    held.solve()
    assert held.report.free_modes == 0


def test_a_load_that_the_last_bounds_cannot_hold():
    """Pressed and pulled twice as much: the step before says too little of what friction holds."""
    d = decomposed("hexahedron", 3, 3)
    V, a, _ = forms(d.mesh, d.facet_tags, (0.0, 0.0, 0.0), d.surface("top"))
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    t = fem.Constant(d.mesh, np.array([0.7 * 0.3 * 0.05, 0.0, -0.05]))
    L = ufl.dot(t, ufl.TestFunction(V)) * ds(d.surface("top"))
    p = tfeti.ContactProblem(a, L, [], [floor(3, tfeti.Coulomb(0.3))], d, petsc_options=EXACT)
    p.solve()
    first = displacement(p)[1]
    t.value *= 2.0
    p.solve()
    assert np.allclose(displacement(p)[1], 2.0 * first, rtol=0, atol=1e-6 * np.abs(first).max())


def between_walls():
    """A square between two walls that do not press it, pulled along them."""
    d, law = decomposed("quadrilateral", 4, 3), tfeti.Coulomb(0.5)
    walls = [
        tfeti.Obstacle(side, tfeti.Plane(point, normal), friction=law, reach=np.inf)
        for side, point, normal in (("left", (0, 0), (1, 0)), ("right", (1, 0), (-1, 0)))
    ]
    return d, problem(d, (0.0, -0.05), walls, clamped=(), rtol=1e-6)


def test_a_body_between_walls_that_nothing_presses_is_an_error():
    """Forces within the law could hold it, but nothing makes the walls press: it slides on."""
    d, p = between_walls()
    said = f"DIVERGED_FRICTION .* body '{d.body_names[0]}' slides without end: .* gaps that overlap"
    with pytest.raises(tfeti.ConvergenceError, match=said):
        p.solve()


def test_the_body_that_slides_without_end_is_named():
    """Of a square pressed on a plane and one between walls that nothing presses."""
    parts = [("still", (0.0, 0.0), (1.0, 1.0), (3, 3)), ("loose", (2.0, 0.0), (3.0, 1.0), (3, 3))]
    mesh, tags, names = boxes("quadrilateral", parts)
    d = tfeti.decompose(mesh, 4, facet_tags=tags, surfaces=names)
    planes = {
        "still bottom": tfeti.Plane((0, 0), (0, 1)),
        "loose left": tfeti.Plane((2, 0), (1, 0)),
        "loose right": tfeti.Plane((3, 0), (-1, 0)),
    }
    p = two_body_problem(
        d,
        lambda v, ds: -0.05 * v[1] * (ds(d.surface("still top")) + ds(d.surface("loose top"))),
        lambda V: [],
        [
            tfeti.Obstacle(side, plane, friction=tfeti.Coulomb(0.5), reach=np.inf)
            for side, plane in planes.items()
        ],
    )
    loose = d.body_names[body_of(d, "loose left")]
    with pytest.raises(tfeti.ConvergenceError, match=f"DIVERGED_FRICTION .* body '{loose}' slides"):
        p.solve()


def body_of(d, surface):
    """The body that a surface is of."""
    facets, comm = d.facets(surface), d.comm
    d.mesh.topology.create_connectivity(1, 2)
    cells = [d.mesh.topology.connectivity(1, 2).links(f)[0] for f in facets]
    found = d.body_of_subdomain[d.cell_subdomain[cells]] if cells else np.array([-1])
    return comm.allreduce(int(found.max()), op=MPI.MAX)
