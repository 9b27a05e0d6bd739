"""Nonlinear bodies with mass: steps beside linear ones and DOLFINx's, and what motions keep."""

import numpy as np
import pytest
import ufl
from bodies import stacked
from dolfinx import fem
from dolfinx import mesh as dmesh
from moving import Thrown
from mpi4py import MPI
from reference.nonlinear import block, by_dolfinx, nearest_nodes
from scenes import accepted, apart, decomposed, elastic, largest, unknowns, vectors

import tfeti_dolfinx as tfeti
from benchmarks.stress.laws import neo_hooke

E, NU, RHO = 1.0, 0.3, 1.0
DX = {"metadata": {"quadrature_degree": 4}}


def field(V, values):
    found = fem.Function(V)
    found.interpolate(values)
    return found


def spinning(x):
    """A rigid motion that turns the block of two by one about its centre, and moves it."""
    return np.array([0.1 - 0.5 * (x[1] - 0.5), -0.2 + 0.5 * (x[0] - 1.0)])


def bending(x):
    """A velocity that stretches the block, too."""
    return spinning(x) + np.array([0.3 * np.sin(x[0] * x[1]), 0.2 * np.cos(2 * x[0])])


def flying(d, velocity, contacts=(), rtol=1e-11, **more):
    """Bodies of neo-Hooke that fly, and what their momentum and energy are."""
    V, u, test, _ = unknowns(d)
    v, now = field(V, velocity), fem.Function(V)
    energy = neo_hooke(u, E, NU) * ufl.dx(**DX)
    given = {"mass": RHO, "velocity": v, "finite": True, "petsc_options": {"rtol": rtol}}
    F = ufl.derivative(energy, u, test)
    problem = tfeti.NonlinearContactDynamics(F, u, [], contacts, d, **{**given, **more})
    x = ufl.SpatialCoordinate(d.mesh) + u
    figures = [
        *(RHO * now[i] * ufl.dx for i in range(2)),
        RHO * (x[0] * now[1] - x[1] * now[0]) * ufl.dx,
        energy + RHO / 2 * ufl.dot(now, now) * ufl.dx,
    ]
    forms = [fem.form(figure) for figure in figures]

    def kept(velocity=v):
        now.x.array[:] = velocity.x.array
        return np.array([d.comm.allreduce(fem.assemble_scalar(form)) for form in forms])

    return problem, kept


def rubber(n=2, velocity=bending, subdomains=4, **more):
    """A block."""
    mesh, tags = block(2, n, 0.0, MPI.COMM_WORLD)
    d = tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces={"low": 1, "top": 2})
    return flying(d, velocity, **more)


def fly(problem, kept, size, steps):
    """Momentum in two directions, moment of momentum, energy: of the begin and of all steps."""
    found = [kept()]
    problem.take_step(size)
    for _ in range(steps):
        accepted(problem)
        found.append(kept(problem.solution.velocity))
    return np.array(found)


def test_free_flight_keeps_momentum_and_its_energy_to_the_square_of_the_step(comm):
    errors = []
    for steps in (10, 20):
        found = fly(*rubber(), 2.0 / steps, steps)
        momentum = found[:, :2] - found[0, :2]
        assert np.abs(momentum).max() <= 1e-9
        errors.append(np.abs(found[:, 2:] - found[0, 2:]).max(axis=0))
    moment, energy = errors[0] / errors[1]
    assert 3.0 <= energy <= 5.5
    assert 3.0 <= moment <= 5.5
    assert errors[1][1] <= 0.02 * found[0, 3]


def test_steps_are_those_of_dolfinx_own_solver(comm):
    """The trapezoidal rule, written in UFL on the mesh that is not torn."""
    problem, kept = rubber()
    fly(problem, kept, 0.1, 6)
    mesh, _ = block(2, 2, 0.0)
    W = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, w, old, v = fem.Function(W), fem.Function(W), fem.Function(W), field(W, bending)
    test, tau = ufl.TestFunction(W), 0.1
    halves = [0.5 * ufl.derivative(neo_hooke(f, E, NU) * ufl.dx(**DX), f, test) for f in (u, old)]
    inertia = 2 / tau**2 * RHO * ufl.dot(u - w, test) * ufl.dx
    solve = by_dolfinx(halves[0] + halves[1] + inertia, u, [])
    for _ in range(6):
        old.x.array[:] = u.x.array
        w.x.array[:] = u.x.array + tau * v.x.array
        solve()
        v.x.array[:] += 2 / tau * (u.x.array - w.x.array)
    nodes = nearest_nodes(W, problem.u.function_space)
    expected = u.x.array.reshape(-1, 2)[nodes]
    assert largest(problem.u.x.array.reshape(-1, 2) - expected) <= 1e-8


@pytest.mark.parametrize("stabilised", [False, True])
def test_a_linear_body_takes_the_steps_of_the_linear_problem(stabilised, comm):
    """Through an impact with friction, under a load that changes."""
    keywords = {"friction": tfeti.Coulomb(0.3), "stabilised": stabilised}
    scene = Thrown("quadrilateral", 3, weight=0.02, **keywords)
    d = decomposed("quadrilateral", 3, 4)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (2,)))
    u, v, weight = fem.Function(V), ufl.TestFunction(V), fem.Constant(d.mesh, (0.0, -0.02))
    F = elastic(u, v) - ufl.dot(weight, v) * ufl.dx
    velocity = fem.Function(V)
    velocity.x.array[:] = scene.problem._system.forms.inertia.motion.v
    plane = tfeti.Plane((0.0, -0.02), (0.0, 1.0))
    contact = tfeti.Obstacle("bottom", plane, friction=tfeti.Coulomb(0.3), reach=1.0, name="plane")
    given = {"mass": 1.0, "velocity": velocity, "petsc_options": {"rtol": 1e-10}}
    given["stabilised"] = stabilised
    problem = tfeti.NonlinearContactDynamics(F, u, [], [contact], d, **given)
    problem.take_step(0.1)
    touched, most, F = 0, 0.0, np.zeros(2)
    for n in range(10):
        weight.value[0] = scene.weight.value[0] = 0.01 * n
        ((motion, forces),) = scene.step(0.1)
        accepted(problem)
        assert largest(u.x.array - scene.problem.u.x.array) <= 1e-8
        ends = [p.solution.velocity.x.array for p in (problem, scene.problem)]
        assert largest(ends[0] - ends[1]) <= 1e-7
        report = problem.report
        assert report.contact_forces[0] == pytest.approx(forces[0], abs=1e-7)
        most = max(most, motion["energy"])
        for name in ("kinetic", "contact", "friction", "predictor"):
            assert report.motion[name] == pytest.approx(motion[name], abs=1e-7 * most)
        assert abs(report.motion["defect"]) <= 1e-8 * most
        touched += forces[0][1] > 0.0
        F += [p.report.F_multiplications for p in (problem, scene.problem)]
    assert touched >= 2
    assert F[0] <= 1.5 * F[1]  # as its tangent stays


@pytest.mark.parametrize("stabilised", [False, True])
def test_an_impact_in_finite_strain_balances(stabilised, comm):
    """A block that turns hits a plane with its corner: forces change momentum, energy balances."""
    plane = tfeti.Plane((0.0, -0.1), (0.0, 1.0))
    contact = tfeti.Obstacle("low", plane, reach=3.0)
    given = {"contacts": [contact], "stabilised": stabilised, "rtol": 1e-9}
    problem, kept = rubber(velocity=spinning, subdomains=2, **given)
    begin, tau, impulse = kept(), 0.1, 0.0
    problem.take_step(tau)
    for _ in range(14):
        accepted(problem)
        motion, forces = problem.report.motion, problem.report.contact_forces
        assert abs(motion["defect"]) <= 1e-7 * begin[3]
        assert motion["predictor"] <= 1e-9 * begin[3]
        before, impulse = impulse, impulse + tau * forces[0][1]
        now = kept(problem.solution.velocity)
        assert now[1] - begin[1] == pytest.approx(impulse, abs=1e-7)
        assert now[0] == pytest.approx(begin[0], abs=1e-7)
        assert impulse >= before - 1e-9
    assert impulse > 0.3
    assert now[3] <= 1.01 * begin[3]


def test_a_block_that_turns_on_another_one_gains_no_energy(comm):
    """Momentum is kept, moments nearly; a step that is solved again ends where it did."""
    d = stacked("quadrilateral", 2, 3, 4, gap=0.05)

    def thrown(x):
        above = x[1] > 0.0
        return above * np.array([0.2 - 0.5 * (x[1] - 0.55), -0.3 + 0.5 * (x[0] - 0.5)])

    pair = tfeti.Contact("upper bottom", "lower top", reach=1.0)
    problem, kept = flying(d, thrown, [pair], rtol=1e-7, stabilised=True)
    begin = kept()
    problem.take_step(0.06)
    for n in range(20):
        u = np.array(problem.solve().x.array) if n % 6 == 0 else None
        accepted(problem)
        assert u is None or largest(problem.u.x.array - u) <= 1e-7
        end = kept(problem.solution.velocity)
        assert end[:2] == pytest.approx(begin[:2], abs=1e-7)
        assert 0.9 * begin[3] <= end[3] <= 1.001 * begin[3]
        assert problem.report.motion["predictor"] <= 1e-9 * begin[3]
    assert end[2] == pytest.approx(begin[2], rel=0.02)


def bar(comm):
    """A plastic bar that hits a wall; the plastic strain is an internal variable."""
    box = [[0.0, 0.0], [3.0, 1.0]], (6, 2)
    mesh = dmesh.create_rectangle(comm, *box, dmesh.CellType.quadrilateral)
    sides = {"left": lambda x: np.isclose(x[0], 0.0)}
    d = tfeti.decompose(mesh, 3, surfaces=sides)
    V, u, v, du = unknowns(d)
    elastic = tfeti.Elasticity(d, E=1.0, nu=0.3, model="plane_strain")
    steel = tfeti.J2Plasticity(elastic, u, yield_stress=0.02, hardening=0.1)
    wall = tfeti.Obstacle("left", tfeti.Plane((-0.01, 0.0), normal=(1.0, 0.0)), reach=1.0)
    left = field(V, lambda x: np.array([-0.1 + 0 * x[0], 0 * x[0]]))
    given = {"mass": 1.0, "velocity": left, "stabilised": True, "petsc_options": {"rtol": 1e-9}}
    F = steel.residual(v)
    return tfeti.NonlinearContactDynamics(F, u, [], [wall], d, **given), steel


def test_a_plastic_impact_loses_energy_and_goes_on_from_its_checkpoint(comm, shared_tmp):
    times = 0.25 * np.arange(1, 41)

    def series(until, folder, resume=False):
        problem, steel = bar(comm)
        given = problem, lambda *_: None, times[:until]
        records = tfeti.LoadSteps(*given, checkpoint=shared_tmp / folder).run(resume=resume)
        v = problem.solution.velocity.x.array.copy()
        return records, problem.u.x.array.copy(), v, steel.p.x.array.copy()

    _, *whole = series(14, "whole")
    series(9, "parts")
    _, *parts = series(14, "parts", resume=True)
    for found, expected in zip(parts, whole, strict=True):
        assert largest(found - expected) <= 1e-7
    assert largest(whole[2]) > 0.01
    records = series(40, "whole", resume=True)[0]
    begin, end = 0.5 * 3.0 * 0.1**2, records[-1].motion["kinetic"]
    assert end < 0.8 * begin  # an elastic bar keeps nearly all
    assert records[-1].contact_forces[0] == [0.0, 0.0]


def test_a_step_that_is_given_up_leaves_no_trace(comm):
    problem, steel = bar(comm)
    problem.take_step(0.25)
    accepted(problem)
    u, p = problem.u.x.array.copy(), steel.p.x.array.copy()
    problem.take_step(2.0)
    problem.solve()
    problem.go_back()
    assert np.array_equal(problem.u.x.array, u)
    assert np.array_equal(steel.p.x.array, p)
    problem.take_step(0.25)
    problem.solve()
    other, _ = bar(comm)
    other.take_step(0.25)
    for _ in range(2):
        accepted(other)
    assert largest(problem.u.x.array - other.u.x.array) <= 1e-8


@pytest.mark.parametrize("kind", ["linear", "stabilised", "finite"])
def test_a_hammer_and_a_block_have_one_momentum(kind, shared_tmp):
    """They fly after a slanted blow with friction; a run goes on from its checkpoint."""
    found, path, times = [], shared_tmp / "hammer", 0.01 * np.arange(1, 21)
    shape = {"point": (0.7, 1.2), "free": ("x", "y", "rz"), "velocity": (0.3, -2.0)}
    plate = tfeti.Plane((0.5, 1.01), normal=(0.02, -1.0))
    hammer = tfeti.RigidBody(plate, **shape, mass=0.5, inertia=0.02, force=(0.0, -0.2))
    contacts = [tfeti.Obstacle("top", hammer, friction=tfeti.Coulomb(0.3), reach=1.0)]
    given = {"stabilised": kind != "linear", "petsc_options": {"rtol": 1e-9}}
    for last in (20, 9, 20):
        d = decomposed("triangle", 4, 4)
        problem, kept = flying(d, lambda x: 0.0 * x[:2], contacts, **given)
        if kind != "finite":
            _, u, v = vectors(d)
            forms = elastic(u, v), ufl.ZeroBaseForm((v,))
            problem = tfeti.ContactDynamics(*forms, [], contacts, d, mass=RHO, **given)
        steps = tfeti.LoadSteps(problem, lambda *_: None, times[:last], checkpoint=path)
        records = steps.run(resume=last == 20 and len(found) > 0)
        found.append(problem.u.x.array)
        problem.restore(problem.state())
        tool, motion = problem.solution.tool(0), [record.motion for record in records]
        assert max(abs(one["defect"]) for one in motion) < 1e-9
        assert sum(one["friction"] for one in motion) <= 0.0 < np.abs(tool.spin[2])
        both = 0.5 * tool.velocity + kept(problem.solution.velocity)[:2]
        assert np.allclose(both, (0.15, -1.0 - 0.2 * times[last - 1]), rtol=0.0, atol=1e-11)
    assert apart(found[2], found[0]) < 1e-8


def test_mistakes_are_named(comm):
    with pytest.raises(tfeti.InputError, match="mass"):
        rubber(mass=-1.0)
