"""Solves that repeat: only what depends on a change is made again."""

import gc
import sys
from collections import Counter
from weakref import ref

import numpy as np
import pytest
import ufl
from dolfinx import fem
from scenes import apart, clamp, curved_obstacle, decomposed, elastic, problem, solved, vectors
from scipy.sparse._base import _spbase
from test_elasticity import compressed

import tfeti_dolfinx as tfeti

COUNTERS = ("assemblies", "searches", "gluings", "factorizations", "coarse_factorizations")
MADE_ONCE = {"stiffness", "search", "constraints", "factors", "trace", "coarse problem"}


class Repeated:
    """A box on a curved obstacle, clamped on the left, that takes other data."""

    def __init__(
        self, cell="hexahedron", contact=True, parts=6, friction=None, extensions=None, **options
    ):
        d = decomposed(cell, 4, parts)
        gdim = d.mesh.geometry.dim
        V, u, v = vectors(d)
        ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
        self.E = fem.Constant(d.mesh, 1.0)
        self.load = fem.Constant(d.mesh, np.array([0.0] * (gdim - 1) + [-0.05]))
        self.held = fem.Constant(d.mesh, np.zeros(gdim))
        obstacle = tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=0.2, friction=friction)
        given = self.E * elastic(u, v), ufl.dot(self.load, v) * ds(d.surface("top"))
        bcs, contacts = [clamp(V, d.facets("left"), self.held)], [obstacle] if contact else []
        more = {"petsc_options": {"rtol": 1e-10, **options}, "extensions": extensions}
        self.problem = tfeti.ContactProblem(*given, bcs, contacts, d, **more)
        self.cell, self.contact, self.options = cell, contact, options

    def change(self, E=1.0, load=-0.05, held=0.0):
        self.E.value, self.load.value[-1], self.held.value[-1] = E, load, held

    def solve(self, **changes):
        self.change(**changes)
        self.problem.solve()
        return self.problem.solution

    def fresh(self, **changes):
        """The solution of a problem that was never solved with other data."""
        other = Repeated(self.cell, self.contact, **self.options)
        solution = other.solve(**changes)
        other.problem.destroy()
        return solution


def counters(report):
    return [getattr(report, name) for name in COUNTERS]


@pytest.fixture(params=[("hexahedron", "newton"), ("triangle", "smalse"), ("tetrahedron", "pcpg")])
def scene(request):
    cell, qp_type = request.param
    made = Repeated(cell, contact=qp_type != "pcpg", qp_type=qp_type)
    yield made
    made.problem.destroy()


@pytest.fixture
def pair():
    """Two scenes, lumped: a preconditioner of Dirichlet factors interiors of another trace."""
    made = [Repeated("triangle", pc_type="lumped") for _ in range(2)]
    yield made
    for item in made:
        item.problem.destroy()


def test_the_same_load_again_costs_next_to_nothing(scene):
    first = scene.solve()
    before, lam = first.u.copy(), first.lam.copy()
    second = scene.solve()
    report = scene.problem.report
    assert report.F_multiplications + report.power_method_multiplications <= 2
    assert counters(report) == [0] * len(COUNTERS)
    assert set(report.reused) >= MADE_ONCE | {"right side", "load", "linear term"}
    assert apart(second.u, first.u) <= 1e-9
    assert second is not first
    assert np.array_equal(first.u, before)
    assert np.array_equal(first.lam, lam)


def test_another_load_makes_no_row_and_no_factor(scene):
    first = scene.solve()
    before = first.displacement.x.array.copy()
    second = scene.solve(load=-0.08)
    report = scene.problem.report
    assert counters(report) == [0] * len(COUNTERS)
    assert set(report.reused) >= MADE_ONCE
    assert "load" not in report.reused
    assert apart(second.u, scene.fresh(load=-0.08).u) <= 1e-8
    assert apart(second.u, first.u) > 1e-2
    assert np.array_equal(first.displacement.x.array, before)


def counted(solve):
    """Python calls and sparse matrices of a solve."""
    calls, matrices, make = Counter(), Counter(), _spbase.__init__

    def init(self, *given, **words):
        matrices["made"] += 1
        make(self, *given, **words)

    def profile(frame, event, given):
        calls[event] += 1

    try:
        _spbase.__init__ = init
        sys.setprofile(profile)
        solve()
    finally:
        sys.setprofile(None)
        _spbase.__init__ = make
    return calls["call"], matrices["made"]


@pytest.mark.parametrize(("cell", "most"), [("triangle", 90), ("hexahedron", 145)])
def test_a_solve_with_friction_makes_few_sparse_matrices(cell, most):
    scene = Repeated(cell, parts=8, friction=tfeti.Coulomb(0.3))
    assert max(scene.problem.decomposition.comm.allgather(counted(scene.solve)[1])) <= most


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_small_problems_take_few_calls_and_sparse_matrices(cell):
    """A first solve makes 55 matrices at most, another load none, by 4500 calls of functions."""
    scene = Repeated(cell, parts=8, qp_type="newton")
    most = 4500 if scene.problem.decomposition.comm.size == 1 else 7000  # ranks exchange
    assert counted(scene.solve)[1] <= 55
    calls, matrices = counted(lambda: scene.solve(load=-0.051))
    assert calls <= most
    assert matrices == 0
    scene.solve()
    assert counted(scene.solve)[0] <= most // 2


def test_other_data_make_what_depends_on_them_alone(scene):
    """Prescribed values no row, a stiffness no search; what was destroyed is made again."""
    first = scene.solve()
    second = scene.solve(held=-0.01)
    assert counters(scene.problem.report) == [0] * len(COUNTERS)
    assert "right side" not in scene.problem.report.reused
    assert apart(second.u, scene.fresh(held=-0.01).u) <= 1e-8
    third = scene.solve(E=2.0)
    report = scene.problem.report
    assert [*counters(report)[:3], report.coarse_factorizations] == [1, 0, 1, 1]
    assert report.factorizations > 0
    assert apart(third.u, scene.fresh(E=2.0).u) <= 1e-8
    assert (report.in_all["solves"], report.in_all["searches"]) == (3, 1)
    assert len(set(scene.problem.decomposition.comm.allgather(report.details()))) == 1
    scene.problem.destroy()
    assert apart(scene.solve().u, first.u) <= 1e-9


def test_another_gap_makes_no_row(pair):
    """Values of a constant, a function on the mesh or one of points are seen without ``update``."""
    scene, other = pair
    first, mesh = scene.solve(), scene.problem.decomposition.mesh
    before, name = first.remaining_gap.copy(), scene.problem.contacts[0].name
    size, field = fem.Constant(mesh, 0.0), fem.Function(fem.functionspace(mesh, ("Lagrange", 1)))
    for gap in (size, field, lambda x: size.value + 0.0 * x[0]):
        scene.problem.update(gap={name: gap})
        for value in (0.01, 0.0, 0.01, 0.01):
            size.value = field.x.array[:] = value
            other.problem.update(gap={0: value})
            assert apart(scene.solve().u, other.solve().u) <= 1e-8
            assert counters(scene.problem.report) == [0] * len(COUNTERS)
        assert "right side" in scene.problem.report.reused
    assert apart(scene.problem.solution.u, first.u) > 1e-3
    assert np.array_equal(first.remaining_gap, before)


def test_shapes_that_take_other_values_are_seen():
    """A function that a user has given may depend on what changes; contacts stay those given."""
    below = np.zeros(1)
    shape = tfeti.SignedDistance(
        lambda x: x[1] - below[0], lambda x: [0.0 * x[0], 1.0 + 0.0 * x[0]]
    )
    given = decomposed("triangle", 4, 4), (0.0, -0.05), [tfeti.Obstacle("bottom", shape)]
    p, q = (problem(*given, rtol=1e-10) for _ in range(2))
    p.solve()
    below[:] = -0.01
    assert apart(solved(p).solution.u, solved(q).solution.u) <= 1e-8
    assert p.report.searches == 1
    assert solved(p).report.searches == 0
    with pytest.raises(TypeError, match="does not support item assignment"):
        p.contacts[0] = q.contacts[0]


def test_other_forms_and_conditions(pair):
    scene, other = pair
    first = scene.solve()
    d, V = scene.problem.decomposition, scene.problem.dofs.V
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    scene.problem.update(load=ufl.dot(2.0 * scene.load, v) * ds(d.surface("top")))
    twice = scene.solve()
    assert counters(scene.problem.report) == [0] * len(COUNTERS)
    assert apart(twice.u, other.solve(load=-0.1).u) <= 1e-8
    scene.problem.update(stiffness=2.0 * elastic(u, v))
    assert apart(scene.solve().u, other.solve(load=-0.1, E=2.0).u) <= 1e-8
    scene.problem.update(values=[clamp(V, d.facets("right"), scene.held)])
    mirrored = scene.solve()
    assert scene.problem.report.gluings == 1
    assert scene.problem.report.factorizations == 0
    assert scene.problem.report.searches == 0
    assert apart(mirrored.u, first.u) > 1e-2


@pytest.mark.parametrize("act", [lambda s: s.solve(E=3.0), lambda s: s.problem.destroy()])
def test_factors_go_at_once_with_what_needs_them(act):
    """No collection of cycles is waited for: at most one generation of factors takes memory."""
    scene = solved(Repeated())
    gc.disable()
    try:
        old = [ref(block.stiffness) for block in scene.problem.dual.subdomains.blocks]
        act(scene)
        assert [stiffness() for stiffness in old] == [None] * len(old)
    finally:
        gc.enable()


def test_factors_that_failed_are_made_again():
    """Of the stiffness that was assembled for them: it stays until factors are made of it."""
    scene = Repeated("triangle")
    for _ in range(2):
        with pytest.raises(tfeti.InputError, match="the stiffness has a diagonal entry"):
            scene.solve(E=-1.0)
    assert scene.problem.report.assemblies == 0
    assert not {"factors", "coarse problem"} & set(scene.problem.report.reused)
    assert apart(scene.solve().u, scene.fresh().u) <= 1e-8


def test_a_mesh_that_has_moved_is_searched_again(pair):
    scene, other = pair
    first = scene.solve()
    for item in (scene, other):
        item.problem.decomposition.mesh.geometry.x[:, 1] -= 0.015
    second = scene.solve()
    assert scene.problem.report.searches == 1
    assert apart(second.u, other.solve().u) <= 1e-8
    assert apart(second.u, first.u) > 1e-2


def test_the_stress_of_an_earlier_solution_is_that_of_its_modulus():
    d = decomposed("triangle", 3, 3)
    nu = fem.Function(fem.functionspace(d.mesh, ("DG", 0)))
    nu.x.array[:] = 0.3
    thickness = fem.Constant(d.mesh, 1.0)
    elastic = tfeti.Elasticity(d, E=1.0, nu=nu, model="plane_strain", thickness=thickness)
    floor = tfeti.Obstacle("bottom", curved_obstacle(2))
    problem = compressed(d, elastic, contacts=[floor], sides=("left",), rtol=1e-10)

    def fields(solution):
        of = solution.stress, solution.nodal_von_mises, solution.pressure
        return [field.x.array for field in of]

    first = problem.solution
    problem.solve()
    expected = [values.copy() for values in fields(problem.solution)]
    elastic.E.value, thickness.value, nu.x.array[:] = 7.0, 2.0, 0.1
    problem.solve()
    for now, then in zip(fields(first), expected, strict=True):
        assert np.allclose(now, then, rtol=1e-6, atol=1e-9)
    assert apart(fields(problem.solution)[0], expected[0]) > 1e-2


def test_an_update_that_raises_has_changed_nothing(pair):
    scene, other = pair
    first = scene.solve()
    V = scene.problem.dofs.V
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    good = {"stiffness": 2.0 * elastic(u, v), "load": ufl.ZeroBaseForm((v,))}
    good |= {"values": [], "gap": {0: 0.1}}
    for name, value in {"load": 1, "values": [None], "gap": {0: np.nan}}.items():
        with pytest.raises(tfeti.InputError):
            scene.problem.update(**{**good, name: value})
        assert apart(scene.solve().u, first.u) <= 1e-8
        assert counters(scene.problem.report) == [0] * len(COUNTERS)


def test_coefficients_that_become_zero_leave_no_friction():
    d, plane = decomposed("quadrilateral", 4, 2), tfeti.Plane((0, 0), (0, 1))
    field, number = fem.Function(fem.functionspace(d.mesh, ("DG", 0))), fem.Constant(d.mesh, 0.0)
    for mu, given in ((field, field.x.array), (number, number.value)):
        p = problem(d, (0.02, -0.07), [tfeti.Obstacle("bottom", plane, friction=tfeti.Coulomb(mu))])
        for value in (0.02, 0.0, 0.02):
            given[...] = value
            p.solve()
            along, across = p.solution.contact().resultant.force
            assert abs(along) > 1e-3 * across if value else abs(along) <= 1e-12 * across
