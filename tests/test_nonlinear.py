"""Nonlinear bodies in contact beside independent solvers, and exact identities."""

import numpy as np
import pytest
import ufl
from bodies import drawn, held, stacked, torn_boxes
from dolfinx import fem
from reference.nonlinear import above_plane, block, by_dolfinx, nearest_nodes
from scenes import accepted, clamp, decomposed, integral, largest, measures, solved, unknowns

import tfeti_dolfinx as tfeti
from benchmarks.stress.laws import SimplePlasticity, neo_hooke
from tfeti_dolfinx.nonlinear.newton import Anderson
from tfeti_dolfinx.nonlinear.state import InternalVariables

E, NU = 1.0, 0.3
DX = {"metadata": {"quadrature_degree": 4}}


def torn(comm, gdim, n, bulge, subdomains):
    """The block of ``reference.nonlinear``, torn."""
    mesh, tags = block(gdim, n, bulge, comm)
    return tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces={"low": 1, "top": 2})


def plane(gdim):
    up = np.eye(gdim)[-1]
    return tfeti.Obstacle("low", tfeti.Plane((0.0,) * gdim, normal=tuple(up)))


def held_top(V, decomposition):
    """A displacement of the upper side, and its condition."""
    gdim = decomposition.mesh.geometry.dim
    value = fem.Constant(decomposition.mesh, (0.0,) * gdim)
    return value, clamp(V, decomposition.facets("top"), value)


def reference(gdim, n, bulge, make, path):
    """Displacements of all steps by PETSc's solver, and their space."""
    mesh, tags = block(gdim, n, bulge)
    V = fem.functionspace(mesh, ("Lagrange", 1, (gdim,)))
    u, v, du = fem.Function(V), ufl.TestFunction(V), ufl.TrialFunction(V)
    F, state = make(u, v)
    internal = InternalVariables(state, mesh)
    value = fem.Constant(mesh, (0.0,) * gdim)
    low, top = (fem.locate_dofs_topological(V, gdim - 1, tags.find(tag)) for tag in (1, 2))
    bcs, steps = [fem.dirichletbc(value, top, V)], []

    def start(down):
        if steps:
            internal.commit()
        value.value[-1] = down

    starts = [lambda down=down: start(down) for down in path]
    for found in above_plane(F, ufl.derivative(F, u, du), u, bcs, low, gdim - 1, starts):
        steps.append(found)
    return V, steps


def simple_plasticity(u, v):
    """A residual, and its internal variables."""
    law = SimplePlasticity(u, E, NU, 0.01, 0.05, 2)
    return law.residual(v), law.state


def of_neo_hooke(u, v):
    """The same without internal variables."""
    return ufl.derivative(neo_hooke(u, E, NU) * ufl.dx(**DX), u, v), {}


def check_steps(problem, value, path, W, steps, to=1e-8):
    """u of every step is that of the reference, relative to its size."""
    V = problem.u.function_space
    nodes = nearest_nodes(W, V)
    for value.value[-1], expected in zip(path, steps, strict=True):
        accepted(problem)
        assert largest(problem.u.x.array - expected[nodes].ravel()) < to * np.abs(expected).max()


@pytest.mark.parametrize(
    ("gdim", "n", "path"), [(2, 5, [-0.04, -0.08, 0.01, -0.1]), (3, 2, [-0.05, -0.02, -0.08])]
)
def test_plasticity_is_that_of_an_active_set_method(gdim, n, path, comm):
    """Loading, unloading, in the plane to above the obstacle, reloading."""
    problem, _, value = plastic(comm, gdim=gdim, n=n, petsc_options={"rtol": 1e-9})
    check_steps(problem, value, path, *reference(gdim, n, 0.05, simple_plasticity, path))


@pytest.mark.parametrize(("gdim", "n"), [(2, 5), (3, 2)])
def test_finite_strain_is_that_of_an_active_set_method(gdim, n, comm):
    """Pressed to 60 % of its height; the reference goes there in shorter steps."""
    path, shorter = [-0.2, -0.4], np.arange(-0.05, -0.41, -0.05)
    problem, value = finite(comm, gdim, n, rtol=2e-9)
    x = problem.decomposition.mesh.geometry.x.copy()
    W, steps = reference(gdim, n, 0.2, of_neo_hooke, shorter)
    check_steps(problem, value, path, W, steps[3::4])
    field, data = problem.solution.pressure.x.array, problem.solution.contact(0)  # over areas now
    assert np.isclose(largest(field), largest(data.pressure), rtol=1e-6)
    twice = 2.0 * problem.u.x.array  # of a body of twice the size
    problem.decomposition.mesh.geometry.x[:] *= 2.0
    value.value[-1] *= 2.0
    accepted(problem)
    assert largest(problem.u.x.array - twice) < 1e-8
    assert np.array_equal(problem.decomposition.mesh.geometry.x, 2.0 * x)


@pytest.mark.parametrize("finite", [False, True])
def test_without_contact_it_is_dolfinx_own_solver(finite, comm):
    """Pressed between two sides that are held: J2 there and back, and neo-Hooke by a third."""
    path = [-0.2, -0.33] if finite else [-0.03, -0.01, -0.05]
    make = of_neo_hooke if finite else simple_plasticity

    def conditions(V, low, top, value):
        return [clamp(V, low), clamp(V, top, value)]

    mesh, tags = block(2, 4, 0.2)
    W = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    w, way = fem.Function(W), fem.Constant(mesh, (0.0, 0.0))
    F, state = make(w, ufl.TestFunction(W))
    internal, steps = InternalVariables(state, mesh), []
    solve = by_dolfinx(F, w, conditions(W, tags.find(1), tags.find(2), way))
    decomposition = torn(comm, 2, 4, 0.2, 4)
    V, u, v, _ = unknowns(decomposition)
    value, (F, state) = fem.Constant(decomposition.mesh, (0.0, 0.0)), make(u, v)
    bcs = conditions(V, decomposition.facets("low"), decomposition.facets("top"), value)
    more = {"state": state, "finite": finite, "petsc_options": {"rtol": 1e-10}}
    problem = tfeti.NonlinearContactProblem(F, u, bcs, [], decomposition, **more)
    for way.value[1] in path:
        solve()
        steps.append(np.array(w.x.array.reshape(-1, 2)))
        internal.commit()
    check_steps(problem, value, path, W, steps, 1e-9)


def plastic(comm, hardening=0.05, n=4, gdim=2, springs=0.0, **more):
    """The block of J2 material, its problem, and the constant that moves its upper side."""
    decomposition = torn(comm, gdim, n, 0.05, 3)
    V, u, v, _ = unknowns(decomposition)
    model = "3d" if gdim == 3 else "plane_strain"
    elastic = tfeti.Elasticity(decomposition, E=E, nu=NU, model=model)
    law = tfeti.J2Plasticity(elastic, u, yield_stress=0.01, hardening=hardening)
    value, bc = held_top(V, decomposition)
    given, more = (u, [bc], [plane(gdim)], decomposition), {"petsc_options": {"rtol": 1e-8}, **more}
    F = law.residual(v) + fem.Constant(decomposition.mesh, springs) * ufl.dot(u, v) * ufl.dx
    return tfeti.NonlinearContactProblem(F, *given, **more), law, value


def test_only_subdomains_with_a_new_tangent_are_factored_again(comm):
    """Of four layers the lowest yields: each new tangent costs its two factors."""
    cut = torn(comm, 2, 8, 0.05, lambda x: np.clip(4 * x[1], 0, 3).astype(int))
    V, u, v, _ = unknowns(cut)
    strength = fem.Function(fem.functionspace(cut.mesh, ("DG", 0)))
    strength.interpolate(lambda x: np.where(x[1] < 0.25, 0.01, 10.0))
    law = SimplePlasticity(u, E, NU, strength, 0.05, 2)
    value, bc = held_top(V, cut)
    given = law.residual(v), u, [bc], [plane(2)], cut
    problem = tfeti.NonlinearContactProblem(*given, state=law.state)
    counts = []
    for value.value[-1] in (-0.03, -0.06):
        accepted(problem)
        counts.append((problem.report.assemblies, problem.report.factorizations))
    (first, all_made), (again, made_again) = counts
    assert min(first, again) > 1
    assert all_made == 2 * 4 + 2 * (first - 1)
    assert made_again <= 2 * again


@pytest.mark.parametrize("springs", [0.0, 0.1])  # which are soft until the block yields
def test_rows_and_their_multipliers_outlive_the_tangent(springs, comm):
    """A state restored by another problem has the contact forces of the one that found it."""
    problem, _, value = plastic(comm, springs=springs)
    gluings = []
    for value.value[-1] in (-0.02, -0.05):
        accepted(problem)
        gluings.append(problem.report.gluings)
        assert problem.report.assemblies > 1
    assert gluings == [1, 0]
    other, _, there = plastic(comm, springs=springs)
    there.value[-1] = -0.05
    other.restore(problem.state())
    contacts = [p.solution.contact(0) for p in (problem, other)]
    force, expected = (contact.resultant.force for contact in reversed(contacts))
    assert np.abs(force - expected).max() < 1e-12 * np.abs(expected).max()


def test_perfect_plasticity_keeps_the_stress_below_yield(comm):
    """And a share of the elastic moduli in the tangent, less where all flows, changes no answer."""
    tolerances = [tfeti.NewtonTolerances(share=share) for share in (0.0, 0.1)]
    others, (problem, law, value) = (plastic(comm, 0.0, tolerances=given) for given in tolerances)
    for value.value[-1] in (-0.04, -0.06, -0.02, -0.07):
        others[2].value[-1] = value.value[-1]
        accepted(others[0]), accepted(problem)
        assert largest(problem.u.x.array - others[0].u.x.array) < 1e-8
    assert 0.0 == others[1].share.value < law.share.value < 0.1
    law.update()
    assert largest(law.p.x.array) > 1e-3
    sigma = ufl.dev(law.stress(problem.u))
    beyond = ufl.conditional(ufl.gt(1.5 * ufl.inner(sigma, sigma), 0.01**2 * (1 + 1e-8)), 1.0, 0.0)
    assert integral(beyond * law.dx) == 0.0


def test_stress_of_a_bar_follows_its_hardening(comm):
    """Pulled along an axis and free across: σ = σ_y(p), p = ε − σ/E, loaded and unloaded."""
    decomposition = decomposed("tetrahedron", 2, 3)
    V, u, v, _ = unknowns(decomposition)
    elastic = tfeti.Elasticity(decomposition, E=E, nu=NU)
    numbers = {"yield_stress": 0.01, "hardening": 0.05, "saturation": 0.02, "rate": 30.0}
    law, found = tfeti.J2Plasticity(elastic, u, **numbers), {}
    pulled = fem.Constant(decomposition.mesh, 0.0)
    bcs = held(decomposition, "left", ("right", pulled), "front", "bottom")(V)
    given, options = (law.residual(v), u, bcs, [], decomposition), {"rtol": 1e-10}
    problem = tfeti.NonlinearContactProblem(*given, petsc_options=options)
    force = fem.form(law.stress(u)[0, 0] * law.dx)
    for strain in (0.005, 0.02, 0.04, 0.035):
        pulled.value = strain
        accepted(problem)
        found[strain] = comm.allreduce(fem.assemble_scalar(force)), largest(law.p.x.array)
    assert found[0.005] == pytest.approx((0.005 * E, 0.0), abs=1e-9)
    for strain in (0.02, 0.04):
        stress, p = found[strain]
        hard = 0.01 + 0.05 * p + 0.02 * (1 - np.exp(-30.0 * p))
        assert (p, stress) == pytest.approx((strain - stress / E, hard), abs=1e-9)
    assert found[0.035] == pytest.approx((stress - 0.005 * E, p), abs=1e-9)


def test_a_stiff_body_that_yields_beside_a_soft_one_is_as_right(comm):
    """It moves 1e-3 of the other, or less, and does as if that were not there, to rtol."""
    found, rtol = [], 1e-4
    for names in ("a", "ab"):
        parts = [(s, (2.0 * i, 0.0), (2.0 * i + 1.0, 1.0), (4, 4)) for i, s in enumerate(names)]
        d = torn_boxes("triangle", parts, 3)
        V, u, v, w = unknowns(d)
        stiff = ufl.conditional(ufl.lt(ufl.SpatialCoordinate(d.mesh)[0], 1.5), 1e4, 1.0)
        elastic = tfeti.Elasticity(d, E=stiff, nu=NU, model="plane_strain")
        law = tfeti.J2Plasticity(elastic, u, yield_stress=0.01, hardening=0.05 * stiff)
        F = law.residual(v)
        for s in names:
            F -= drawn(d, f"{s} top", (0.002, -0.02 if s == "a" else -0.005))(v, measures(d)[1])
        bcs = [clamp(V, d.facets(f"{s} bottom")) for s in names]
        accepted(tfeti.NonlinearContactProblem(F, u, bcs, [], d, petsc_options={"rtol": rtol}))
        found.append(largest(u.x.array[np.repeat(V.tabulate_dof_coordinates()[:, 0] < 1.5, 2)]))
    assert found[1] < 1e-3 * largest(u.x.array)
    assert found[1] == pytest.approx(found[0], rel=2.0 * rtol)


def test_a_step_that_did_not_converge_is_not_accepted(comm):
    problem, _, value = plastic(comm, tolerances=tfeti.NewtonTolerances(max_it=2))
    value.value[-1] = -0.09
    with pytest.raises(tfeti.ConvergenceError, match="increment is still"):
        problem.solve()
    assert np.all(problem.u.x.array == 0.0)
    with pytest.raises(tfeti.InputError, match="has not converged"):
        problem.accept()


def test_a_free_body_slides_on_both_sides(comm):
    """Between two others slips hardly tell its place: Q = μN drawn along, on, and back."""
    sizes = (("low", 0.0, 0.0, 8), ("mid", 1.0, 1.0, 5), ("up", 0.0, 2.0, 8))
    parts = [(name, (a, y), (4.0 - a, y + 1.0), (n, 2)) for name, a, y, n in sizes]
    d = torn_boxes("quadrilateral", parts, 5)
    V, u, v, _ = unknowns(d)
    law, mu = SimplePlasticity(u, E, NU, 0.03, 0.05, 2), 0.6
    value = fem.Constant(d.mesh, (0.0, 0.0))
    bcs = [clamp(V, d.facets("low bottom")), clamp(V, d.facets("up top"), value)]
    pairs = (("low top", "mid bottom"), ("mid top", "up bottom"))
    contacts = [tfeti.Contact(*pair, friction=tfeti.Coulomb(mu)) for pair in pairs]
    problem = tfeti.NonlinearContactProblem(law.residual(v), u, bcs, contacts, d, state=law.state)
    for along, sign in ((0.0, 0.0), (0.1, -1.0), (0.3, -1.0), (0.0, 1.0)):
        value.value[:] = along, -0.02
        accepted(problem)
        for Q, N in (problem.solution.contact(i).resultant.force for i in range(2)):
            assert abs(Q - sign * mu * N) < 1e-4 * abs(N)


@pytest.mark.parametrize(("most", "kept"), [(0, [0, 0, 0]), (2, [1, 2, 2])])
def test_acceleration_has_as_many_iterates_as_it_is_given(most, kept, comm):
    faster, found = Anderson(tfeti.NewtonTolerances(anderson=most), comm), []
    for k in range(3):
        u, d = np.full(2, float(k)), np.array((1.0, 0.5**k))
        assert np.array_equal(faster.next(u, d), u + d) or most
        found.append(len(faster.past))
    assert found == kept


def two_blocks(degree, **where):
    """Two blocks of neo-Hooke that do not match, ν = 0, and what moves the upper one."""
    decomposition = stacked("triangle", 3, 4, 4, **where)
    V, u, v, _ = unknowns(decomposition, degree)
    F = ufl.derivative(neo_hooke(u, E, 0.0) * ufl.dx(**DX), u, v)
    value = fem.Constant(decomposition.mesh, 0.0)
    bcs = held(decomposition, ("upper top", value), "lower bottom", "lower left", "upper left")(V)
    return decomposition, u, F, value, bcs


def finite(comm, gdim=2, n=4, bulge=0.2, rtol=1e-9):
    """The block of neo-Hooke, above a plane, and the constant that moves its upper side."""
    decomposition = torn(comm, gdim, n, bulge, 4)
    V, u, v, _ = unknowns(decomposition)
    value, bc = held_top(V, decomposition)
    F, _ = of_neo_hooke(u, v)
    options = {"finite": True, "petsc_options": {"rtol": rtol}}
    return tfeti.NonlinearContactProblem(F, u, [bc], [plane(gdim)], decomposition, **options), value


def test_a_closed_elastic_cycle_ends_where_it_began(comm):
    """Pressed by a third, and back to a light touch: u and energy are those of the way there."""
    problem, value = finite(comm)
    energy, found, energies = fem.form(neo_hooke(problem.u, E, NU) * ufl.dx(**DX)), [], []
    for value.value[-1] in (-0.1, -0.35, -0.1):
        accepted(problem)
        found.append(np.array(problem.u.x.array))
        energies.append(comm.allreduce(fem.assemble_scalar(energy)))
    assert abs(energies[2] - energies[0]) < 1e-8 * energies[1]
    assert largest(found[0] - found[2]) < 1e-8


@pytest.mark.parametrize(("degree", "moves"), [(1, (-0.05, -0.1)), (1, (-0.5,)), (2, (-0.5,))])
def test_patch_of_two_finite_bodies_is_exact(degree, moves, comm):
    """Two blocks that do not match, pressed by a quarter at most: homogeneous strain, ν = 0."""
    decomposition, u, F, value, bcs = two_blocks(degree)
    given = (F, u, bcs, [tfeti.Contact("lower top", "upper bottom")], decomposition)
    problem = tfeti.NonlinearContactProblem(*given, finite=True, petsc_options={"rtol": 1e-10})
    for value.value in moves:
        accepted(problem)
    exact = ufl.as_vector((0, 0.5 * moves[-1] * (1 + ufl.SpatialCoordinate(decomposition.mesh)[1])))
    assert integral(ufl.inner(u - exact, u - exact) * ufl.dx) ** 0.5 < 1e-9


def test_a_small_step_of_two_finite_bodies_is_linear():
    d, u, F, value, bcs = two_blocks(2, upper=(0.2, 0.7))  # facets are straight, u is not
    value.value, zero = -1e-3, ufl.ZeroBaseForm(F.arguments())
    contacts = [tfeti.Contact("upper bottom", "lower top", secondary="upper bottom")]
    linear = solved(tfeti.ContactProblem(ufl.derivative(F, u), zero, bcs, contacts, d))
    accepted(tfeti.NonlinearContactProblem(F, u, bcs, contacts, d, finite=True))
    assert largest(u.x.array - linear.u.x.array) < 3e-6


def small(comm):
    """A few cells, their displacement, test function and law, what is held, and where."""
    decomposition = torn(comm, 2, 2, 0.05, 2)
    V, u, v, _ = unknowns(decomposition)
    elastic = tfeti.Elasticity(decomposition, E=E, nu=NU, model="plane_strain")
    return decomposition, u, v, elastic, *held_top(V, decomposition)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"F": "square"}, "F is not a linear form"),
        ({"F": "energy", "J": None}, "F has no test function; expected a linear form, such as"),
        ({"F": "dead"}, "F does not depend on u"),
        ({"J": "skew"}, "not symmetric .* or the tangent of an energy"),
        ({"finite": True}, "no J"),
        ({"state": {1: 2}}, "state: a key"),
        ({"state": "elsewhere"}, "state: the new value of f: the function 'f' is on another mesh"),
        ({"update": 3}, "update"),
        ({"u": None}, "u is"),
    ],
)
def test_mistakes_are_named(change, said, comm):
    decomposition, u, v, elastic, _, bc = small(comm)
    du = ufl.TrialFunction(u.function_space)
    forms = {"F": elastic.a(u, v), "J": elastic.a(du, v)}
    meant = {"square": ufl.inner(v, v) * ufl.inner(u, v) * ufl.dx, "energy": u[0] ** 2 * ufl.dx}
    meant["dead"] = elastic.a(fem.Function(u.function_space), v)
    meant["elsewhere"] = {u: small(comm)[1]}
    meant["skew"] = forms["J"] + 0.1 * du[0].dx(1) * v[1] * ufl.dx
    change = {k: meant[to] if isinstance(to, str) else to for k, to in change.items()}
    given = {**forms, "u": u, **change}
    F, u = given.pop("F"), given.pop("u")
    with pytest.raises(tfeti.InputError, match=said):
        tfeti.NonlinearContactProblem(F, u, [bc], [plane(2)], decomposition, **given).solve()


def test_what_updates_may_have_a_function_of_its_own_named_u(comm):
    decomposition, u, v, elastic, _, bc = small(comm)

    class Heated:
        u = fem.Function(v.ufl_function_space())

        def update(self):
            self.u.x.array[:] = 0.0

    F, given = elastic.a(u, v), {"update": Heated().update}
    solved(tfeti.NonlinearContactProblem(F, u, [bc], [plane(2)], decomposition, **given))


def test_what_a_nonlinear_problem_does_not_take_is_named(comm):
    problem, law, _ = plastic(comm)
    with pytest.raises(tfeti.InputError, match="load and stiffness are those of linear problems"):
        problem.update(load=ufl.ZeroBaseForm((ufl.TestFunction(problem.u.function_space),)))
    for said, given in {
        "rtol auto: it is for linear problems": {"petsc_options": {"rtol": "auto"}},
        "tolerances: max_it=0: expected 1": {"tolerances": tfeti.NewtonTolerances(max_it=0)},
        "a J2Plasticity of another displacement": {"update": law.update, "state": law.state},
    }.items():
        with pytest.raises(tfeti.InputError, match=said):
            plastic(comm, stress=lambda u: ufl.Identity(3) * u[0], **given)
    d, u, v, *_ = small(comm)
    pressed = tfeti.Obstacle("low", tfeti.Plane((0.0, 0.0), normal=(0.0, 1.0)), gap=-0.01)
    with pytest.raises(tfeti.InputError, match="a given gap with finite=True"):
        tfeti.NonlinearContactProblem(of_neo_hooke(u, v)[0], u, [], [pressed], d, finite=True)


def test_a_ready_law_is_updated_and_committed_however_it_is_passed(comm):
    found = []
    for given in ({}, {"update": None}, {"state": {}}, {"state": None, "update": None}):
        problem, law, value = plastic(comm, **given)
        for value.value[-1] in (-0.04, -0.01):
            accepted(problem)
        found.append(np.array(problem.u.x.array))
        assert largest(law.p.x.array) > 1e-3
        assert np.array_equal(found[0], found[-1])


def test_a_tangent_of_another_problem_is_named(comm):
    d, u, v, elastic, value, bc = small(comm)
    J = 0.01 * elastic.a(ufl.TrialFunction(u.function_space), v)
    given, few = (elastic.a(u, v), u, [bc], [plane(2)], d), tfeti.NewtonTolerances(max_it=4)
    problem = tfeti.NonlinearContactProblem(*given, J=J, tolerances=few)
    value.value[-1] = -0.1
    with pytest.raises(tfeti.ConvergenceError, match="J that is the derivative of F, as J2P"):
        problem.solve()


def test_a_law_that_gives_no_number_is_named(comm):
    decomposition, u, v, elastic, value, bc = small(comm)
    F = elastic.a(u, v) + ufl.sqrt(1e-3 - u[1] ** 2) * v[0] * ufl.dx
    J = elastic.a(ufl.TrialFunction(u.function_space), v)
    problem = tfeti.NonlinearContactProblem(F, u, [bc], [plane(2)], decomposition, J=J)
    value.value[-1] = -0.3
    with pytest.raises(tfeti.TfetiError, match="not finite"):
        problem.solve()
    assert np.all(problem.u.x.array == 0.0)
