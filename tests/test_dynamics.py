"""Bodies with mass: identities of the step, motions that have closed forms, and warm starts."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from bodies import drawn, sided, stacked
from dolfinx import fem
from moving import Thrown
from scenes import (
    accepted,
    apart,
    clamp,
    decomposed,
    elastic,
    forms,
    hooke,
    integral,
    largest,
    measures,
    roller,
    solved,
    vectors,
)
from scenes import displacement as nodal

import tfeti_dolfinx as tfeti
from demos import scene


@pytest.mark.parametrize(("cell", "stabilised"), [("quadrilateral", False), ("tetrahedron", True)])
def test_free_flight_is_exact(cell, stabilised):
    """A rigid motion under a constant force is a parabola: the rule is exact for it."""
    given = {"stabilised": stabilised, "lumped": cell == "tetrahedron", "weight": 0.5}
    scene = Thrown(cell, 3, gap=5.0, thrown=(0.3, 0.1, 0.0), **given)
    scene.step(0.125, 4)
    u = scene.problem.u.x.array.reshape(-1, scene.gdim)
    assert largest(u[:, -1] + 0.3 * 0.5 + 0.5 * 0.5**2 / 2) <= 1e-12
    assert largest(u[:, 0] - 0.1 * 0.5) <= 1e-12
    v = scene.problem.solution.velocity.x.array.reshape(-1, scene.gdim)
    assert largest(v[:, -1] + 0.3 + 0.5 * 0.5) <= 1e-12


def test_the_mass_of_a_ring_is_that_of_its_radius(shared_tmp):
    """The kinetic energy of the velocity (r, 0) of a cone of radius R(z) is π/4 ∫R⁴."""
    d = decomposed("triangle", 2, 2)
    d.mesh.geometry.x[:, 0] *= 1.0 + 0.5 * d.mesh.geometry.x[:, 1]
    law, (V, u, v) = tfeti.Elasticity(d, E=1.0, nu=0.3, model="axisymmetric"), vectors(d)
    grows = fem.Function(V)
    grows.interpolate(lambda x: np.stack((x[0], 0.0 * x[0])))
    given = {"mass": 1.0, "velocity": grows, "thickness": law.thickness}
    p = tfeti.ContactDynamics(law.a(u, v), ufl.ZeroBaseForm((v,)), [], [], d, **given)
    steps = tfeti.LoadSteps(p, lambda p, t: None, [1e-6])
    (record,) = steps.run()
    steps.write_csv(shared_tmp / "ring.csv")
    assert ",kinetic,elastic,energy," in (shared_tmp / "ring.csv").read_text()
    assert record.motion["kinetic"] == pytest.approx(np.pi / 10 * (1.5**5 - 1), rel=1e-5)


@pytest.mark.parametrize(
    ("cell", "below", "stabilised"), [("triangle", True, True), ("tetrahedron", False, False)]
)
def test_the_energy_changes_by_what_was_done(cell, below, stabilised):
    """Through an impact, under a load that changes; contact takes λᵀ(g − Bu), g − Bu it closes."""
    scene = Thrown(cell, 3, below=below, stabilised=stabilised, weight=0.02)
    comm, gaps, impacts, most = scene.problem.decomposition.comm, None, 0, 0.0
    for n in range(12):
        scene.weight.value[0] = 0.01 * n
        ((motion, forces),) = scene.step(0.1)
        solution = scene.problem.solution
        most = max(most, motion["energy"])
        assert abs(motion["defect"]) <= 1e-12 * most
        assert abs(motion["supports"]) <= 1e-8 * most
        assert motion["friction"] == 0.0
        assert motion["predictor"] <= 1e-8 * most
        if gaps is not None:
            closed = comm.allreduce(float(solution.force @ gaps))
            assert motion["contact"] == pytest.approx(-closed, rel=0, abs=1e-8 * most)
            assert closed >= -1e-8 * most
        gaps = np.array(solution.remaining_gap)
        impacts += abs(forces[-1][-1]) > 0.0
    assert impacts >= 2


def test_an_obstacle_that_moves_does_work():
    """A plane comes up under the box: what contact does is −λᵀ(g⁺ − g) less what it closes."""
    scene = Thrown("quadrilateral", 3, stabilised=True, thrown=(0.0, 0.0, 0.0))
    comm, gaps, speed, work = scene.problem.decomposition.comm, None, 0.2, 0.0
    for n in range(1, 16):
        scene.problem.update(gap={"plane": 0.02 - speed * 0.1 * n})
        ((motion, _),) = scene.step(0.1)
        solution = scene.problem.solution
        assert abs(motion["defect"]) <= 1e-12
        if gaps is not None:
            closed = comm.allreduce(float(solution.force @ (gaps - speed * 0.1)))
            assert motion["contact"] == pytest.approx(-closed, rel=0, abs=1e-9)
        work += motion["contact"]
        gaps = np.array(solution.remaining_gap)
    momentum = mean(scene, scene.problem.solution.velocity.x.array.reshape(-1, 2))
    # an elastic body leaves with twice the speed of the plane, less what swings in it
    assert speed < momentum[-1] <= 2 * speed
    assert work >= 0.5 * momentum[-1] ** 2


def mean(scene, values):
    """Mean of a field over the box, of mass 1."""
    inertia = scene.problem._system.forms.inertia
    mass = (inertia.M @ values.ravel()).reshape(values.shape)
    return scene.problem.decomposition.comm.allreduce(mass.sum(axis=0))


def test_momentum_changes_by_forces_of_contact():
    """Forces in the report are those that turn the box round."""
    scene = Thrown("quadrilateral", 4, stabilised=True, weight=0.02)
    before, impulse = np.zeros(2), np.zeros(2)
    for n in range(20):
        ((_, forces),) = scene.step(0.1)
        now = mean(scene, scene.problem.solution.velocity.x.array.reshape(-1, 2))
        if n:
            assert now - before == pytest.approx(
                0.1 * np.subtract(forces[0], (0.0, 0.02)), abs=1e-9
            )
        impulse, before = impulse + 0.1 * np.array(forces[0]), now
    assert impulse[1] > 0.3
    assert impulse[0] == 0.0


def test_friction_slows_down_what_slides():
    """On a plane that holds it down it loses bound · area a second; slips count from the start."""
    bound, speed = 0.01, 0.2
    given = {"gap": 0.0, "friction": tfeti.Tresca(bound), "nu": 0.0, "weight": 0.05}
    scene = Thrown("quadrilateral", 4, **given, thrown=(0.0, speed, 0.0), begin=-1.0)
    lost = 0.0
    for n in range(1, 13):
        ((motion, forces),) = scene.step(0.25)
        assert motion["friction"] <= 1e-12
        assert abs(motion["defect"]) <= 1e-13
        lost -= motion["friction"]
        v = mean(scene, scene.problem.solution.velocity.x.array.reshape(-1, 2))
        assert v[0] == pytest.approx(speed - bound * 0.25 * n, abs=1e-9)
        assert forces[0][0] == pytest.approx(-bound, abs=1e-9)
    assert lost > 0.0
    comm = scene.problem.decomposition.comm
    dissipated = comm.allreduce(float(scene.problem.solution.dissipation.sum()))
    assert -motion["friction"] == pytest.approx(dissipated, rel=1e-6)


def test_a_step_is_newmark_s_by_dense_matrices():
    """An independent solution without contact: one dense matrix for the whole, not torn box."""
    scene = Thrown("quadrilateral", 3, gap=5.0, thrown=(0.3, 0.1, 0.4))
    scene.step(0.2, 5)
    found = nodal(scene.problem)
    whole = Thrown("quadrilateral", 3, gap=5.0, thrown=(0.3, 0.1, 0.4), subdomains=1)
    whole.problem.take_step(0.2)
    forms = whole.problem._system.forms
    u, v = np.zeros_like(forms.inertia.motion.v), forms.inertia.motion.v
    K, M = forms.K.toarray(), forms.inertia.M.toarray()
    if len(u):
        for _ in range(5):
            now = np.linalg.solve(K + 4 * M / 0.04, 4 * M @ (u + 0.2 * v) / 0.04 - K @ u)
            u, v = now, 2 * (now - u) / 0.2 - v
    whole.problem.u.x.array[:] = u
    assert np.allclose(found[1], nodal(whole.problem)[1], rtol=0, atol=1e-9)


def test_equal_steps_share_factors_and_another_one_says_that_it_refactors(caplog):
    scene = Thrown("quadrilateral", 4)
    comm = scene.problem.decomposition.comm
    first = scene.step(0.1) and scene.problem.report.factorizations
    assert first > 0
    scene.step(0.1 * (1 + 1e-12), 3)
    assert scene.problem.report.factorizations == 0
    assert scene.problem.report.assemblies == 0
    assert "factored anew" not in caplog.text
    scene.step(0.05)
    assert scene.problem.report.factorizations > 0
    says = "the step is now 0.05, it was 0.1: all is factored anew"
    assert (says in caplog.text) == (comm.rank == 0)


def test_mistakes_of_motions():
    d = decomposed("quadrilateral", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, 0.0), d.surface("top"))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx, quadratic = ufl.dx(domain=d.mesh), fem.functionspace(d.mesh, ("Lagrange", 2, (2,)))
    for says, given in {
        "mass=-1": {"mass": -1.0},
        "mass: .*volume": {"mass": {"nobody": 1.0}},
        "stabilised=1: expected True or False": {"stabilised": 1},
        "rtol auto: errors of steps": {"petsc_options": {"rtol": "auto"}, "stress": hooke()},
        "lumped=True with a form of the mass; expected a": dict(mass=u[0] * v[0] * dx, lumped=True),
        "velocity is ": {"velocity": fem.Function(quadratic)},
    }.items():
        with pytest.raises(tfeti.InputError, match=says):
            tfeti.ContactDynamics(a, L, [], [], d, **{"mass": 1.0, **given})
    for says, mass in {
        "mass: the matrix has a diagonal entry -": -ufl.inner(u, v) * dx,
        "mass: the matrix is not symmetric": (ufl.inner(u, v) + 0.3 * u[0] * v[1]) * dx,
        "mass: a translation along x has the mass": a,
    }.items():
        problem = tfeti.ContactDynamics(a, L, [], [], d, mass=mass)
        problem.take_step(0.1)
        with pytest.raises(tfeti.InputError, match=says):
            problem.solve()
    problem = tfeti.ContactDynamics(a, L, [], [], d, mass=1.0)
    with pytest.raises(tfeti.InputError, match="the step has no size yet"):
        problem.solve()
    for size in (0, np.nan, 1e-200, 1e200):
        with pytest.raises(tfeti.InputError, match="step="):
            problem.take_step(size)


@pytest.mark.parametrize("name", ["velocity", "u"])
def test_begins_that_tear_bodies_are_refused(name):
    """Copies of a node that fly apart would be pulled together by forces of no load."""
    d = decomposed("quadrilateral", 2, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, 0.0), d.surface("top"))
    begin, subdomain = fem.Function(V), np.zeros((len(V.dofmap.list), 4), dtype=np.int64)
    begin.interpolate(lambda x: x[:2] - 0.3)
    tfeti.ContactDynamics(a, L, [], [], d, mass=1.0, **{name: begin})
    subdomain[:] = d.cell_subdomain[:, None]
    nodes, of = np.unique(V.dofmap.list, return_index=True)
    begin.x.array.reshape(-1, 2)[nodes[subdomain.ravel()[of] == 1], 1] += 0.01
    with pytest.raises(tfeti.InputError, match=f"^{name}.*differs by 0.01 between torn copies"):
        tfeti.ContactDynamics(a, L, [], [], d, mass=1.0, **{name: begin})
    begin.x.array[:1] = np.nan
    with pytest.raises(tfeti.InputError, match=f"^{name}.* not finite numbers"):
        tfeti.ContactDynamics(a, L, [], [], d, mass=1.0, **{name: begin})


def test_a_state_or_a_solution_without_velocity():
    thrown = Thrown("quadrilateral", 3, gap=0.03, reach=0.01, stabilised=True)
    thrown.step(0.1)
    assert thrown.problem.report.late_contact_rows > 0  # after the predictor
    thrown.problem.restore(thrown.problem.state())
    state = replace(thrown.problem.state(), velocity=np.zeros(0))
    with pytest.raises(tfeti.InputError, match="the state is of a problem without mass"):
        thrown.problem.restore(state)
    d = decomposed("quadrilateral", 3)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, -0.1), d.surface("top"))
    still = solved(tfeti.ContactProblem(a, L, [clamp(V, d.facets("left"))], [], d))
    with pytest.raises(tfeti.InputError, match="no velocity: expected the solution of a Contact"):
        still.solution.velocity  # noqa: B018


def test_a_light_body_gets_its_momentum_from_the_force_on_it(comm):
    """It hits one that is pressed: a blow that is small beside that, to a loose tolerance."""
    d, tau, pushes = stacked("triangle", 4, 3, 3, upper=(0.4, 0.6), gap=0.02), 0.05, []
    V, u, v = vectors(d)
    above = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(d.mesh)[1], 0.0), 1.0, 0.0)
    thrown, now = fem.Function(V), fem.Function(V)
    thrown.interpolate(lambda x: (0.0 * x[0], -0.1 * (x[1] > 0.01)))
    now.x.array[:] = thrown.x.array
    a, L = elastic(u, v), drawn(d, "lower left", (0.02, 0.0))
    contacts, given = [sided("upper bottom", "lower top", reach=1.0)], {"velocity": thrown}
    given |= {"mass": 1.0 - (1.0 - 1e-5) * above, "petsc_options": {"rtol": 1e-2}}
    L, bcs = L(v, measures(d)[1]), [clamp(V, d.facets("lower bottom"))]
    problem = tfeti.ContactDynamics(a, L, bcs, contacts, d, **given)
    problem.take_step(tau)
    for _ in range(6):
        before = integral(1e-5 * above * now[1] * ufl.dx)
        accepted(problem)
        now.x.array[:] = problem.solution.velocity.x.array
        pushes.append(problem.report.contact_forces[0][1])
        change = (integral(1e-5 * above * now[1] * ufl.dx) - before) / tau
        assert change == pytest.approx(pushes[-1], rel=1e-2, abs=1e-12)
    assert max(pushes) > 1e-7


RTOL = 1e-8


class Driven:
    """Sides of a mesh go down or up by what ``place`` says; nothing else moves or loads."""

    def __init__(self, d, sides, contact):
        V, u, v = vectors(d)
        self.place, up = fem.Constant(d.mesh, 0.0), d.mesh.geometry.dim - 1
        bcs = [roller(V, up, d.facets(side), self.place) for side in sides]
        given = elastic(u, v), ufl.ZeroBaseForm((v,)), bcs, [contact], d
        more = {"mass": 1.0, "stabilised": True, "petsc_options": {"rtol": RTOL}}
        self.problem = tfeti.ContactDynamics(*given, **more)

    def step(self, size, place):
        """Go on to where supports have a place; the report."""
        self.place.value = place
        self.problem.take_step(size)
        accepted(self.problem)
        return self.problem.report


def test_a_support_may_stop_just_above_a_plane():
    """u + τv, with what is prescribed going on as before, lies below it."""
    plane, rough = tfeti.Plane((0, -0.1), (0, 1)), tfeti.Tresca(0.01)
    floor = tfeti.Obstacle("bottom", plane, reach=1.0, friction=rough)
    scene = Driven(decomposed("quadrilateral", 4, 4), ["left"], floor)
    for n in range(1, 9):
        report = scene.step(0.2, -0.095 * min(n / 5, 1))
        assert report.motion["predictor"] <= RTOL * report.motion["energy"]
        assert np.all(scene.problem.solution.remaining_gap >= -0.1 * RTOL)


def test_a_body_that_a_support_has_not_reached_stays_where_it_is():
    """The support stops before the gap is closed, with a velocity that would have closed it."""
    contact = tfeti.Contact("upper bottom", "lower top", reach=1.0)
    d = stacked("quadrilateral", 2, 3, 4, gap=0.12)
    scene = Driven(d, ["lower bottom", "lower top"], contact)
    V = scene.problem.u.function_space
    above = V.tabulate_dof_coordinates()[:, 1] > 0.06
    for place in (0.05, 0.1, 0.1, 0.1):
        report = scene.step(0.5, place)
        moved = scene.problem.u.x.array.reshape(-1, 2)[above]
        assert largest(moved) <= RTOL * 0.1
        assert report.contact_forces == [[0.0, 0.0]]
        assert report.motion["predictor"] == pytest.approx(0.0, abs=1e-12)


# of the first impact of the balls: 2.94 δ/V, δ = (15mV²/16E*√R)^(2/5)
SPEED, MODULUS = np.sqrt(2 * 10.0 * 0.3), 2e4 / (1 - 0.3**2)
HERTZ_LASTS = 2.94 * (15 * 4 / 3 * np.pi * SPEED**2 / (16 * MODULUS)) ** 0.4 / SPEED


# a demo and its arguments; steps of a size
BAR = "bouncing_bar", ["--cells", 16], 64, 10.0 / 30.0 / 16  # of h/c, to the end of an impact
BALL = "falling_balls_3d", ["--balls", 1, "--gap", 0.05], 18, HERTZ_LASTS / 15  # a rough one


@pytest.mark.parametrize(("demo", "arguments", "steps", "size"), [BAR, BALL])
def test_a_step_takes_two_thirds_of_one_that_begins_with_nothing(demo, arguments, steps, size):
    counts = []
    for options in ({}, {"recycle": 0}):
        made = scene(demo, arguments, "ContactDynamics")
        problem = tfeti.ContactDynamics(**{**made, "petsc_options": options})
        problem.take_step(size)
        for _ in range(steps):
            problem._start = None if options else problem._start
            accepted(problem)
            if any(np.linalg.norm(force) > 0.0 for force in problem.report.contact_forces):
                counts.append((bool(options), problem.report.F_multiplications))
        problem.destroy()
    cold, F = np.transpose(counts)
    assert min(np.bincount(cold)) >= 10
    assert F[cold == 0].mean() <= 2 / 3 * F[cold == 1].mean()


TIGHT = 1e-9


class Stretched:
    """A square that lies on a plane and is let go; its displacement at the begin is not 0."""

    def __init__(self, stabilised):
        d = decomposed("quadrilateral", 4, 4)
        V, u, v = vectors(d)
        self.data = {"E": fem.Constant(d.mesh, 1.0), "density": fem.Constant(d.mesh, 1.0)}
        begin = fem.Function(V)
        begin.interpolate(lambda x: np.stack((0.1 * x[0] ** 2, 0.2 * x[1])))
        floor = [tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)))]
        given = self.data["E"] * elastic(u, v), ufl.ZeroBaseForm((v,)), [], floor, d
        more = {"stabilised": stabilised, "u": begin, "petsc_options": {"rtol": TIGHT}}
        self.problem = tfeti.ContactDynamics(*given, mass=self.data["density"], **more)

    def solve(self, step, data):
        """Of a step from the begin: displacements and velocities of this rank."""
        for name, value in data.items():
            self.data[name].value = value
        self.problem.take_step(step)
        u = self.problem.solve().x.array.copy()
        return np.concatenate((u, self.problem.solution.velocity.x.array))


@pytest.mark.parametrize(
    ("stabilised", "change"),
    [(False, (0.4, {})), (True, (0.2, {"E": 3.0})), (False, (0.2, {"density": 0.2}))],
)
def test_a_step_that_is_solved_again_is_that_of_the_new_data(stabilised, change):
    """The load of a step has 2Mw/τ² − Ku/2 in it, also where u, v and the load have stayed."""
    scene, other = Stretched(stabilised), Stretched(stabilised)
    first = scene.solve(0.2, {})
    scene.problem.go_back()
    again, anew = scene.solve(*change), other.solve(*change)
    assert apart(first, anew) > 0.01
    assert apart(again, anew) <= 100 * TIGHT


def test_a_state_is_gone_on_from_with_another_density():
    """Or with a step whose size was said before the state was taken."""
    scene = Stretched(False)
    scene.solve(0.2, {})
    scene.problem.accept()
    state = scene.problem.state()
    anew = scene.solve(0.1, {"density": 0.5})
    for before in (0.2, 0.1):
        other = Stretched(False)
        other.problem.take_step(before)
        other.problem.restore(state)
        found = other.solve(0.1, {"density": 0.5})
        assert np.allclose(found, anew, rtol=0, atol=100 * TIGHT)
