"""Laws of mechanics that nonlinear bodies in contact keep: objectivity, balance, energy, h²."""

import numpy as np
import pytest
import ufl
from bodies import boxes, clamped, sided, stacked, torn_boxes
from dolfinx import fem
from reference.nonlinear import pressed_ring
from scenes import accepted, integral, largest, roller, solved, unknowns
from test_mortar_cases import decomposed_boxes

import tfeti_dolfinx as tfeti
from benchmarks.stress.laws import neo_hooke
from meshes.rings import rings as shrunk

E, NU, PAIR = 1.0, 0.3, ("lower top", "upper bottom")
DX = {"metadata": {"quadrature_degree": 4}}


def hyperelastic(decomposition, conditions, *contacts, rtol=1e-10):
    """Bodies of neo-Hooke in contact; ``conditions`` makes those of Dirichlet from V."""
    V, u, v, _ = unknowns(decomposition)
    F = ufl.derivative(neo_hooke(u, E, NU) * ufl.dx(**DX), u, v)
    options = {"finite": True, "petsc_options": {"rtol": rtol}}
    return tfeti.NonlinearContactProblem(F, u, conditions(V), contacts, decomposition, **options)


def test_a_scene_that_is_turned_has_no_stress(comm):
    """Two blocks that touch, turned by 90° in steps: strains are rounding, and so are stresses."""
    decomposition, turned = stacked("triangle", 2, 3, 3), []

    def conditions(V):
        turned.append(fem.Function(V))
        return clamped(decomposition, ("lower bottom", turned[0]), ("upper top", turned[0]))(V)

    problem = hyperelastic(decomposition, conditions, tfeti.Contact(*PAIR), rtol=1e-11)
    (turn,), u = turned, problem.u
    strain = ufl.grad(u) + ufl.grad(u).T + ufl.grad(u).T * ufl.grad(u)
    for angle in np.linspace(0.0, np.pi / 2, 5)[1:]:
        c, s = np.cos(angle), np.sin(angle)
        R = np.array(((c - 1.0, -s, 0.0), (s, c - 1.0, 0.0)))
        turn.interpolate(lambda x, R=R: R @ x)
        accepted(problem)
        assert integral(ufl.inner(strain, strain) * ufl.dx) < 1e-20
        assert largest(u.x.array - turn.x.array) < 1e-9


def moving(decomposition, *fixed):
    """Conditions that fix surfaces and move the upper one, and where it is moved to."""
    way = fem.Constant(decomposition.mesh, (0.0, 0.0))
    return way, clamped(decomposition, ("upper top", way), *fixed)


@pytest.mark.parametrize(("lean", "push", "to"), [(0.0, 0.02, 5e-5), (0.9, 0.001, 3e-4)])
@pytest.mark.parametrize("order", [("lower", "upper"), ("upper", "lower")])
def test_whole_boundaries_pass_the_end_of_a_table_as_faces_do(order, lean, push, to):
    """A block that slides over the end, its corner first, has the forces of its face alone."""
    parts = [("lower", (-1, -0.5), (0.5, 0), (11, 4)), ("upper", (0.1, 0), (0.5, 0.3), (4, 3))]
    faces, forces = {"lower": ["lower top"], "upper": ["upper bottom"]}, []
    for sides in ((), ("left", "right")):
        skins = [(body, faces[body] + [f"{body} {side}" for side in sides]) for body in order]
        d = decomposed_boxes(parts, 4, skins)
        x, y = d.mesh.geometry.x[:, :2].T
        x += lean * (x - 0.3) * np.maximum(y, 0.0)
        way, bcs = moving(d, "lower bottom")
        problem = hyperelastic(d, bcs, sided(*order, friction=tfeti.Coulomb(0.3)), rtol=1e-6)
        for along in (0.0, 0.08, 0.16, 0.24, 0.32):
            way.value = (along, -push)
            accepted(problem)
            forces.append(problem.solution.contact().resultant.force)
    assert np.allclose(forces[:5], forces[5:], atol=to)


@pytest.mark.parametrize("scene", [(4, 3, 0.8, 0.1, "auto"), (8, 5, 0.7, 0.6, PAIR[1])])
def test_forces_balance_and_friction_only_dissipates(scene, comm):
    """A narrow block pressed into a wide one and drawn to and fro: it slips, or sticks."""
    *n, end, mu, secondary = scene
    decomposition = stacked("triangle", *n, 3, upper=(0.2, end))
    way, conditions = moving(decomposition, "lower bottom")
    contact = tfeti.Contact(*PAIR, friction=tfeti.Coulomb(mu), secondary=secondary)
    problem = hyperelastic(decomposition, conditions, contact, rtol=1e-8)
    lost = 0.0
    for way.value[:] in ((0.0, -0.1), (0.2, -0.12), (-0.1, -0.1), (-0.1, 0.1)):
        accepted(problem)
        solution = problem.solution
        held = [solution.reaction(side) for side in ("lower bottom", "upper top")]
        below, above = (reaction.force for reaction in held)
        push = solution.contact(0)  # of the secondary side; the other one has its reaction
        support = below if push.surface == "lower top" else above
        size = np.linalg.norm(support) if way.value[1] < 0.0 else 1e-5
        assert np.allclose(below, -above, rtol=0, atol=1e-9 * size)
        assert np.allclose(push.resultant.force, -support, rtol=0, atol=1e-9 * size)
        assert abs(held[0].moment[2] + held[1].moment[2]) < 1e-4 * size
        assert solution.dissipation.min(initial=0.0) >= -1e-12 * E
        lost += comm.allreduce(float(np.sum(solution.dissipation)))
    assert lost > (1e-3 if mu < 0.5 else 0.0)
    assert np.linalg.norm(support) < 1e-12


@pytest.mark.parametrize("n", [(3, 4), (4, 3)])
def test_a_block_that_only_friction_held_is_let_go_at_once(n, comm):
    """Pressed, sheared, and the plate back to where it was: no strain, near where it was."""
    d = stacked("quadrilateral", *n, 3, upper=(0.2, 0.8))
    way = fem.Constant(d.mesh, (0.0, 0.0))
    plate = tfeti.RigidBody(tfeti.Plane((0.0, 1.0), (0.0, -1.0)), displacement=way)
    rough = {"friction": tfeti.Coulomb(0.5)}
    contacts = tfeti.Contact(*PAIR, **rough), tfeti.Obstacle("upper top", plate, **rough)
    problem = hyperelastic(d, clamped(d, "lower bottom"), *contacts, rtol=1e-6)
    u, x = problem.u, ufl.SpatialCoordinate(d.mesh)
    upper, places = ufl.conditional(ufl.gt(x[1], 0.0), 1.0, 0.0), []
    for way.value[:] in ((0.0, -0.1), (0.1, -0.1), (0.0, 0.0)):
        accepted(problem)
        places.append(integral(upper * u[0] * ufl.dx))
    assert integral(ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(u)) * ufl.dx) < 1e-16
    assert places[1] > 0.01
    assert abs(places[2] - places[1]) < 0.02 * places[1]


def test_moments_balance_about_where_bodies_are(comm):
    """A block drawn over a plane and turned: forces act at X + u."""
    decomposition = torn_boxes("triangle", [("upper", (0.0, 0.0), (2.0, 1.0), (6, 3))], 3)
    way, conditions = moving(decomposition)
    plane = tfeti.Plane((0.0, 0.0), normal=(0.0, 1.0))
    ground = tfeti.Obstacle("upper bottom", plane, friction=tfeti.Coulomb(0.3))
    problem = hyperelastic(decomposition, conditions, ground)
    for way.value[:] in ((0.0, -0.1), (0.3, -0.2)):
        accepted(problem)
        held, pushed = problem.solution.reaction("upper top"), problem.solution.contact(0).resultant
        size = np.linalg.norm(pushed.force)
        assert np.allclose(held.force, -pushed.force, rtol=0, atol=1e-9 * size)
        assert np.allclose(held.moment, -pushed.moment, rtol=0, atol=1e-9 * size)
    assert abs(held.moment[2]) > 0.01


@pytest.mark.parametrize("secondary", ["auto", PAIR[0]])
def test_newtons_method_ends_where_facets_are_covered_in_part(secondary, comm):
    """A block pressed into a wider one and drawn; "auto" is the side that is covered wholly."""
    parts = [("lower", (0.0, 0.0, 0.0), (1.0, 1.0, 0.5), (4, 4, 1))]
    parts += [("upper", (0.25, 0.25, 0.5), (0.7, 0.7, 1.0), (3, 3, 1))]
    d = torn_boxes("hexahedron", parts, 4)
    way = fem.Constant(d.mesh, (0.0, 0.0, -0.1))
    pair = tfeti.Contact(*PAIR, friction=tfeti.Coulomb(0.3), secondary=secondary)
    p = hyperelastic(d, clamped(d, "lower bottom", ("upper top", way)), pair)
    assert all(accepted(p).newton_steps <= 20 for way.value[0] in (0.0, 0.1))
    assert p.solution.contacts[0].surfaces[0] == PAIR[secondary == "auto"]


ENDS = (("left", 1), ("right", 0))  # of a quarter ring, and what is held there


def rings(comm, n):
    """Quarter rings 1 to 1.5 and 1.5 to 2 that do not match."""
    parts = [
        ("lower", (0.0, 1.0), (np.pi / 2, 1.5), (4 * n, n)),
        ("upper", (0.0, 1.5), (np.pi / 2, 2.0), (5 * n, n)),
    ]
    mesh, tags, names = boxes("quadrilateral", parts, comm)
    angle, radius = mesh.geometry.x[:, 0].copy(), mesh.geometry.x[:, 1].copy()
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    return tfeti.decompose(mesh, 3, facet_tags=tags, surfaces=names)


def test_a_fit_that_nothing_holds_in_space_is_solved_with_friction(comm):
    """Rings shrunk on each other do not turn as one, since contact does not hold that."""
    d = shrunk(comm, (24, 30), 2, overlap=0.05)
    V, u, v, _ = unknowns(d, 2)
    F = ufl.derivative(neo_hooke(u, E, NU) * ufl.dx(**DX), u, v)
    rough = tfeti.Contact("shaft", "hub", friction=tfeti.Coulomb(0.2))
    problem = tfeti.NonlinearContactProblem(F, u, [], [rough], d, finite=True)
    for steps in (10, 5):
        accepted(problem)
        assert problem.report.newton_steps <= steps
    x = V.tabulate_dof_coordinates()
    turns = x[:, 0] * u.x.array[1::2] - x[:, 1] * u.x.array[::2]
    assert largest(turns) < 0.01 * largest(u.x.array)


def test_a_ring_that_spins_on_another_is_named(comm):
    d = shrunk(comm, (16, 20), overlap=0.01)
    V, u, v, _ = unknowns(d)
    F = ufl.derivative(neo_hooke(u, E, NU) * ufl.dx(**DX), u, v)
    given = clamped(d, "bore")(V), [tfeti.Contact("shaft", "hub")], d
    few = tfeti.NewtonTolerances(max_it=8)
    problem = tfeti.NonlinearContactProblem(F, u, *given, finite=True, tolerances=few)
    spins = r"'outer'\) is free to move \(rotation in the plane\), or contact hardly resists that"
    with pytest.raises(tfeti.ConvergenceError, match=spins):
        problem.solve()


def unbalanced(problem):
    """Moments of both reactions together, over their force: a length."""
    below, above = (problem.solution.reaction(side) for side in ("lower bottom", "upper top"))
    size = np.linalg.norm(above.force)
    assert np.allclose(below.force, -above.force, rtol=0, atol=1e-9 * size)
    return abs(below.moment[2] + above.moment[2]) / size, abs(above.moment[2]) / size


def test_moments_balance_on_a_flat_interface(comm):
    """Two blocks that do not match, of steel that yields, pressed and drawn with friction."""
    decomposition = stacked("triangle", 4, 3, 3, upper=(0.2, 0.8))
    way, conditions = moving(decomposition, "lower bottom")
    V, u, v, w = unknowns(decomposition)
    elastic = tfeti.Elasticity(decomposition, E=E, nu=NU, model="plane_strain")
    steel = tfeti.J2Plasticity(elastic, u, yield_stress=0.02, hardening=0.1)
    contact = tfeti.Contact(*PAIR, friction=tfeti.Coulomb(0.3))
    given, tight = (u, conditions(V), [contact], decomposition), {"rtol": 1e-9}
    problem = tfeti.NonlinearContactProblem(steel.residual(v), *given, petsc_options=tight)
    for way.value[:] in ((0.0, -0.05), (0.03, -0.06)):
        accepted(problem)
        left, of = unbalanced(problem)
        assert left < 1e-9 < 0.1 < of
    assert largest(steel.p.x.array) > 0.01


def test_moments_balance_to_h_squared_on_a_curved_interface(comm):
    """Two rings that do not match, the outer one pressed on the inner one and turned, μ = 0.3."""
    found, turn = [], 0.1
    for n in (1, 2, 4):
        decomposition, ways = rings(comm, n), []

        def conditions(V, d=decomposition, ways=ways):
            ways.append(fem.Function(V))
            return clamped(d, ("upper top", ways[0]), "lower bottom")(V)

        contact = tfeti.Contact(*PAIR, friction=tfeti.Coulomb(0.3))
        problem = hyperelastic(decomposition, conditions, contact, rtol=1e-9)
        for k, angle in ((0.95, 0.0), (0.92, turn)):
            c, s = k * np.cos(angle), k * np.sin(angle)
            ways[0].interpolate(
                lambda x, c=c, s=s: (c * x[0] - s * x[1] - x[0], s * x[0] + c * x[1] - x[1])
            )
            accepted(problem)
        left, of = unbalanced(problem)
        assert of > 0.1
        found.append(left)
    assert found[2] < 0.3 * found[1] < 0.3**2 * found[0] < 0.3**2 * 1e-2


def test_a_curved_patch_is_right_to_h_squared(comm):
    """Two rings, the inner one widened by 30 %, beside the ordinary differential equation."""
    radius, errors, widened = pressed_ring(1.0, 2.0, 1.3, E, NU), [], 0.3
    for n in (2, 4):
        decomposition = rings(comm, n)

        def conditions(V, d=decomposition):
            way = fem.Function(V)
            way.interpolate(lambda p: widened * p[:2] / np.hypot(p[0], p[1]))
            sides = [(f"{name} {side}", k) for name in ("lower", "upper") for side, k in ENDS]
            rollers = [roller(V, k, d.facets(side)) for side, k in sides]
            return [*clamped(d, ("lower bottom", way))(V), *rollers]

        contact = tfeti.Contact(*PAIR, gap="curved")
        problem = solved(hyperelastic(decomposition, conditions, contact, rtol=1e-8))
        x = problem.u.function_space.tabulate_dof_coordinates()[:, :2]
        u, R = problem.u.x.array.reshape(-1, 2), np.linalg.norm(x, axis=1)
        exact = (radius(R) / R - 1.0)[:, None] * x
        errors.append(largest(u - exact))
    assert errors[1] < 0.3 * errors[0] < 2e-4
