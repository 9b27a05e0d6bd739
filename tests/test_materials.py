"""Laws of nonlinear bodies: their tangents, exact paths, rotations, and what they refuse."""

import numpy as np
import pytest
import ufl
from bodies import held, torn_boxes
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import accepted, clamp, integral, largest, solved, unknowns
from scipy.optimize import brentq

import tfeti_dolfinx as tfeti
from benchmarks.stress.laws import neo_hooke
from tfeti_dolfinx.nonlinear.forms import rotation_free_tangent
from tfeti_dolfinx.nonlinear.state import InternalVariables

E, NU = 1.0, 0.3
PLASTIC = {"yield_stress": 0.02, "hardening": 0.1, "saturation": 0.01, "rate": 20.0}
MODELS = ["plane_strain", "axisymmetric", "3d"]
LAWS = {
    "J2": (tfeti.J2Plasticity, PLASTIC),
    "finite J2": (tfeti.FiniteJ2Plasticity, PLASTIC),
    "neo-Hooke": (tfeti.NeoHooke, {}),
    "St. Venant": (tfeti.SaintVenantKirchhoff, {}),
}


def body(model, n=1):
    """A few cells, and a displacement on them."""
    if model == "3d":
        mesh = dmesh.create_box(
            MPI.COMM_SELF, [[0.0] * 3, [1.0] * 3], [n] * 3, dmesh.CellType.tetrahedron
        )
    else:
        ends = [[0.5, 0.0], [1.5, 1.0]]
        mesh = dmesh.create_rectangle(MPI.COMM_SELF, ends, [n] * 2, dmesh.CellType.quadrilateral)
    gdim = mesh.geometry.dim
    mesh.geometry.x[:, :gdim] += 0.1 * np.sin(7.0 * mesh.geometry.x[:, ::-1][:, -gdim:])
    return fem.Function(fem.functionspace(mesh, ("Lagrange", 1, (gdim,))))


def assembled(form, u, law):
    """Function of a displacement: the assembled form, the law up to date."""
    compiled = fem.form(form)
    rank = len(form.arguments())

    def at(values):
        u.x.array[:] = values
        law.update()
        if rank == 1:
            return np.array(fem.assemble_vector(compiled).array)
        return fem.assemble_matrix(compiled).to_dense()

    return at


@pytest.mark.parametrize("selective", [False, True])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", LAWS)
def test_the_tangent_is_the_derivative_of_the_residual(name, model, selective):
    """Beyond the yield stress, in the second load step, to the error of central differences."""
    if (selective, model) == (True, "3d"):
        pytest.skip("as in 2D")
    kind, given = LAWS[name]
    u = body(model)
    elastic = tfeti.Elasticity(u.function_space.mesh, E=E, nu=NU, model=model)
    law = kind(elastic, u, selective=selective, **given)
    V = u.function_space
    v, w = ufl.TestFunction(V), ufl.TrialFunction(V)
    F = law.residual(v)
    J = law.tangent(w, v) if name == "J2" else ufl.derivative(F, u, w)
    rng = np.random.default_rng(1)
    first, way, d = (0.1 * rng.normal(size=u.x.array.size) for _ in range(3))
    residual, tangent = assembled(F, u, law), assembled(J, u, law)
    if given:
        residual(0.5 * first)
        InternalVariables(law.state, V.mesh).commit()
        assert np.any(law.p.x.array > 0.0)
    at, h = first + 0.5 * way, 1e-5
    found = tangent(at) @ d
    if name != "J2":  # far from where their moduli are changed
        at *= (0.2 if model == "3d" else 0.5) if given else 0.1
        found = tangent(at) @ d
        if given:
            assert np.any(law._new[1] > law.p.x.array)
            assert not np.any(law._more.x.array)
    expected = (residual(at + h * d) - residual(at - h * d)) / (2.0 * h)
    assert np.abs(found - expected).max() < 1e-7 * np.abs(expected).max()
    K = tangent(at)
    assert np.abs(K - K.T).max() < 1e-12 * np.abs(K).max()


@pytest.mark.parametrize("name", LAWS)
def test_a_small_displacement_is_that_of_linear_elasticity(name):
    kind, given = LAWS[name]
    u = body("plane_strain", 2)
    elastic = tfeti.Elasticity(u.function_space.mesh, E=E, nu=NU, model="plane_strain")
    law = kind(elastic, u, **given)
    v, w = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)
    J = law.tangent(w, v) if name == "J2" else ufl.derivative(law.residual(v), u, w)
    K = assembled(J, u, law)(np.zeros_like(u.x.array))
    expected = fem.assemble_matrix(fem.form(elastic.a(w, v))).to_dense()
    assert np.abs(K - expected).max() < 1e-13
    # and selective integration has the forces of a homogeneous strain
    mesh, found = dmesh.create_unit_cube(MPI.COMM_SELF, 2, 2, 2, dmesh.CellType.hexahedron), []
    elastic = tfeti.Elasticity(mesh, E=E, nu=NU)
    for selective in (False, True):
        u = fem.Function(fem.functionspace(mesh, ("Lagrange", 1, (3,))))
        u.interpolate(lambda x: (0.05 * x[0] + 0.04 * x[1], -0.02 * x[1], -0.01 * x[2]))
        law = kind(elastic, u, selective=selective, **given)
        law.update()
        v = ufl.TestFunction(u.function_space)
        found.append(fem.assemble_vector(fem.form(law.residual(v))).array)
    assert np.abs(found[1] - found[0]).max() < 1e-9 * np.abs(found[0]).max()
    # and its stress is that of its forces in any small strain
    u.x.array[:] = 1e-4 * np.random.default_rng(1).normal(size=u.x.array.size)
    law.update()
    forms = ufl.inner(law.stress(u), elastic.strain(v)) * law.dx, law.residual(v)
    found, expected = (fem.assemble_vector(fem.form(form)).array for form in forms)
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()


def test_neo_hooke_is_that_of_the_reference():
    for model in ("plane_strain", "3d"):
        u = body(model)
        elastic = tfeti.Elasticity(u.function_space.mesh, E=E, nu=NU, model=model)
        law = tfeti.NeoHooke(elastic, u, degree=4)
        v = ufl.TestFunction(u.function_space)
        energy = neo_hooke(u, E, NU) * ufl.dx(metadata={"quadrature_degree": 4})
        u.x.array[:] = 0.1 * np.random.default_rng(2).normal(size=u.x.array.size)
        law.update()
        found = fem.assemble_vector(fem.form(law.residual(v))).array
        expected = fem.assemble_vector(fem.form(ufl.derivative(energy, u, v))).array
        assert np.abs(found - expected).max() < 1e-14


@pytest.mark.parametrize(
    ("name", "stretch", "nu"), [("neo-Hooke", 1.6, 0.45), ("St. Venant", 0.5, 0.3)]
)
def test_the_tangent_stays_definite_and_the_residual_as_it_is(name, stretch, nu):
    """Stretched to where the moduli are indefinite: all but rigid motions have energy."""
    u = body("plane_strain")
    V, kind = u.function_space, LAWS[name][0]
    law = kind(tfeti.Elasticity(V.mesh, E=E, nu=nu, model="plane_strain"), u)
    u.interpolate(lambda x: ((stretch - 1.0) * x[0], (stretch - 1.0) * x[1]))
    v = ufl.TestFunction(V)
    F = ufl.variable(law.deformation(u))
    energy = sum(law.energies(F))
    plain = ufl.derivative(energy * law.dx, u, v)
    least = []
    for form in (plain, law.residual(v)):
        K = assembled(rotation_free_tangent(form, u), u, law)(u.x.array.copy())
        least.append(np.linalg.eigvalsh(K))
    assert least[0][0] < -1e-3
    assert np.all(np.abs(least[1][:3]) < 1e-12)
    assert least[1][3] > 1e-3
    residual = [fem.assemble_vector(fem.form(form)).array for form in (plain, law.residual(v))]
    assert np.abs(residual[0] - residual[1]).max() < 1e-14


def test_the_plastic_tangent_stays_definite_where_stresses_are_beyond_its_moduli():
    """Dilated, as a step is that turns a body too far: the mean stress is beyond its hardening."""
    u = body("plane_strain")
    V = u.function_space
    elastic = tfeti.Elasticity(V.mesh, E=E, nu=NU, model="plane_strain")
    law = tfeti.FiniteJ2Plasticity(elastic, u, yield_stress=1e-3, hardening=1e-3)
    u.interpolate(lambda x: (0.04 * x[0], 0.01 * x[1]))
    residual = law.residual(ufl.TestFunction(V))
    K = assembled(rotation_free_tangent(residual, u), u, law)(u.x.array.copy())
    values = np.linalg.eigvalsh(K)
    assert np.any(law._more.x.array > 0.0)
    assert np.all(np.abs(values[:3]) < 1e-12)
    assert values[3] > 1e-5 * values[-1]
    before = fem.assemble_vector(fem.form(residual)).array
    law._more.x.array[:] = 0.0
    assert np.abs(fem.assemble_vector(fem.form(residual)).array - before).max() < 1e-14
    K = fem.assemble_matrix(fem.form(rotation_free_tangent(residual, u))).to_dense()
    assert np.linalg.eigvalsh(K)[0] < -1e-4 * values[-1]


def test_a_turn_does_not_change_a_finite_law():
    """Forces turn with the body, elastic and plastic, through load steps: P(QF) = Q P(F)."""

    def turned(angle):
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    for kind, given in (LAWS[name] for name in ("finite J2", "neo-Hooke", "St. Venant")):
        forces = []
        for angle in (0.0, 1.1):
            u = body("plane_strain")
            V = u.function_space
            law = kind(tfeti.Elasticity(V.mesh, E=E, nu=NU, model="plane_strain"), u, **given)
            residual = assembled(law.residual(ufl.TestFunction(V)), u, law)
            x = V.tabulate_dof_coordinates()[:, :2]
            way = 0.1 * np.random.default_rng(3).normal(size=x.shape)
            for share in (0.5, 1.0):
                turn = turned(share * angle)
                f = residual(((x + share * way) @ turn.T - x).ravel())
                for function, value in getattr(law, "state", {}).items():
                    function.x.array[:] = value()
            forces.append(f.reshape(-1, 2) @ turn)
        assert np.abs(forces[0] - forces[1]).max() < 1e-13


BOTH = tfeti.J2Plasticity, tfeti.FiniteJ2Plasticity  # which take hardening in one way
FORMS = [*((kind, form) for kind in BOTH for form in ("volumes", "constant"))]
FORMS += [(BOTH[0], "function"), (BOTH[1], "UFL"), *((kind, "laws") for kind in BOTH)]
FORMS.append((BOTH[1], "neo-Hooke"))


@pytest.mark.parametrize(("kind", "form"), FORMS)
def test_two_steels_yield_each_by_its_own_law(kind, form, comm):
    """Pulled alike, the stress of each is that of its hardening, and one is warned to flow."""
    parts = [("soft", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2, 2, 2))]
    parts += [("hard", (0.0, 2.0, 0.0), (1.0, 3.0, 1.0), (2, 2, 2))]
    bars = {"soft": lambda x: x[1] < 1.5, "hard": lambda x: x[1] > 1.5}
    cut = torn_boxes("tetrahedron", parts, 3, volumes=bars)
    laws = {"soft": (0.01, 0.05), "hard": (0.01, 0.05) if form == "constant" else (0.02, 0.2)}
    given = {}
    for k, name in enumerate(("yield_stress", "hardening")):
        soft, hard = laws["soft"][k], laws["hard"][k]
        y = ufl.SpatialCoordinate(cut.mesh)[1]
        given[name] = {
            "volumes": {"soft": soft, "hard": hard},
            "UFL": ufl.conditional(ufl.lt(y, 1.5), soft, hard),
            "constant": fem.Constant(cut.mesh, 10.0),
        }.get(form)
        if form == "function":
            given[name] = fem.Function(fem.functionspace(cut.mesh, ("DG", 0)))
            given[name].interpolate(lambda x, a=soft, b=hard: np.where(x[1] < 1.5, a, b))
    V, u, v, w = unknowns(cut)
    elastic = tfeti.Elasticity(cut, E=E, nu=NU)
    made = [kind(elastic, u, **given)] if given["hardening"] else []
    for name, (y, h) in {} if made else laws.items():
        made.append(kind(elastic, u, yield_stress=y, hardening=h, volumes=name))
    if form == "neo-Hooke":
        made[1] = tfeti.NeoHooke(elastic, u, volumes=[cut.volume("hard")])
    if form == "constant":  # a constant may change
        given["yield_stress"].value, given["hardening"].value = laws["soft"]
    pulled = fem.Constant(cut.mesh, 0.0)
    sides = [f"{name} {side}" for name in laws for side in ("left", "front", "bottom")]
    bcs = held(cut, *sides, *((f"{name} right", pulled) for name in laws))(V)
    finite = kind is tfeti.FiniteJ2Plasticity
    F, more = sum(law.residual(v) for law in made), {"petsc_options": {"rtol": 1e-10}}
    problem = tfeti.NonlinearContactProblem(F, u, bcs, [], cut, finite=finite, **more)
    for length in (1.03, 1.1):
        pulled.value = length - 1.0
        accepted(problem)
    (flow,) = (text for text in problem.report.warnings if "plastic flow keeps the vol" in text)
    assert all((name in flow) == (law == laws["soft"]) for name, law in laws.items())
    strain = np.log(length) if finite else length - 1.0
    dx = made[0].dx(subdomain_data=cut.cell_tags)
    F = ufl.Identity(3) + ufl.grad(u)
    stress = sum(law.stress(u)[0, 0] for law in made) * (ufl.det(F) if finite else 1.0)
    for name, (start, modulus) in laws.items():
        force = integral(stress * dx(cut.volume(name)))
        expected = (start + modulus * strain) / (1 + modulus / E)  # p = ε − σ/E
        if (form, name) == ("neo-Hooke", "hard"):
            # b² across: b² − 1 + λ/μ ln(length b²) = 0
            ratio = 2 * NU / (1 - 2 * NU)
            across = brentq(lambda b, r=ratio: b - 1 + r * np.log(length * b), 0.5, 1.0)
            expected = E / 2 / (1 + NU) * (length**2 - across)
        assert force == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_stresses_at_nodes_are_those_of_the_points(cell, comm):
    """Sheared by a hundredth, beyond the yield stress: von Mises' stress is σ_y(p) everywhere."""
    mesh = dmesh.create_unit_square(comm, 3, 3, dmesh.CellType[cell])
    facets = dmesh.locate_entities_boundary(mesh, 1, lambda x: np.full(x.shape[1], True))
    tags = dmesh.meshtags(mesh, 1, facets, np.full_like(facets, 1))
    decomposition = tfeti.decompose(mesh, 2, facet_tags=tags, surfaces={"side": 1})
    V, u, v, w = unknowns(decomposition)
    given = fem.Function(V)
    given.interpolate(lambda x: (0.04 * x[1], 0.0 * x[0]))
    elastic = tfeti.Elasticity(decomposition, E=E, nu=NU, model="plane_strain")
    law = tfeti.J2Plasticity(elastic, u, yield_stress=0.01, hardening=0.1)
    bcs, F = [clamp(V, decomposition.facets("side"), given)], law.residual(v)
    more = {"stress": law.stress, "petsc_options": {"rtol": 1e-10}}
    problem = solved(tfeti.NonlinearContactProblem(F, u, bcs, [], decomposition, **more))
    mu = E / 2 / (1 + NU)
    q = np.sqrt(3.0) * mu * 0.04
    expected = q - 3.0 * mu * (q - 0.01) / (3.0 * mu + 0.1)
    for found in (problem.solution.von_mises, problem.solution.nodal_von_mises):
        assert np.allclose(found.x.array, expected, rtol=1e-7, atol=0.0)
    assert largest(problem.solution.discretisation_error.x.array) < 1e-8


def test_mistakes_are_named():
    u = body("plane_strain")
    sheet = tfeti.Elasticity(u.function_space.mesh, E=E, nu=NU, model="plane_stress")
    strain = tfeti.Elasticity(u.function_space.mesh, E=E, nu=NU, model="plane_strain")
    for kind, given in LAWS.values():
        with pytest.raises(tfeti.InputError, match="plane stress is not there"):
            kind(sheet, u, **given)
        with pytest.raises(tfeti.InputError, match="on another mesh"):
            kind(strain, body("plane_strain"), **given)
        second = fem.Function(fem.functionspace(u.function_space.mesh, ("Lagrange", 2, (2,))))
        with pytest.raises(tfeti.InputError, match="selective=True on quadrilaterals"):
            kind(strain, second, selective=True, **given)
        with pytest.raises(tfeti.InputError, match="elasticity.on is .*; expected a Decomposition"):
            kind(strain, u, volumes="a", **given)
        if given:
            with pytest.raises(tfeti.InputError, match="yield_stress"):
                kind(strain, u, yield_stress=-1.0)
            x = ufl.SpatialCoordinate(u.function_space.mesh)
            with pytest.raises(tfeti.InputError, match=r"hardening=-0\.\d+: expected 0 or more"):
                kind(strain, u, yield_stress=1.0, hardening=x[0] - 1.0)
            with pytest.raises(tfeti.InputError, match="saturation is of shape"):
                kind(strain, u, yield_stress=1.0, saturation=x)


def test_volumes_that_do_not_fit_are_named(comm):
    parts = [(name, (0.0, y), (1.0, y + 1.0), (2, 2)) for name, y in (("a", 0.0), ("b", 2.0))]
    halves = {"a": lambda x: x[1] < 1.5, "b": lambda x: x[1] > 1.5}
    cut = torn_boxes("quadrilateral", parts, 2, volumes=halves)
    _, u, v, _ = unknowns(cut)
    elastic, rings = (tfeti.Elasticity(cut, E=E, nu=NU, model=model) for model in MODELS[:2])
    for said, volumes in {"no volume 'c' .*: 'a'": "c", "expected names or tags": []}.items():
        with pytest.raises(tfeti.InputError, match=said):
            tfeti.NeoHooke(elastic, u, volumes=volumes)
    names = "a", "b", ["a", "b"], ["b", "a"]
    a, b, both, again = (tfeti.NeoHooke(elastic, u, volumes=some) for some in names)
    every, other = tfeti.SaintVenantKirchhoff(elastic, u), tfeti.NeoHooke(elastic, u)
    yields = [tfeti.J2Plasticity(elastic, u, yield_stress=y) for y in (1.0, 2.0)]
    dx, strain = ufl.dx(subdomain_data=cut.cell_tags), elastic.strain(v)
    parts = [ufl.inner(law.stress(u), strain) * dx(k) for k, law in enumerate(yields, 1)]
    b_linear = a.residual(v) + ufl.inner(elastic.stress(u), strain) * dx(cut.volume("b"))
    for said, F, *of_finite in (
        (r"J: 4 cells are in no dx; .* without it are: 'b' \(2\)", a.residual(v)),
        ("a NeoHooke and a S.*, both in 'a'; expected vol", a.residual(v) + every.residual(v)),
        ("both in 'a', 'b'; expected volumes=", every.residual(v) + other.residual(v)),
        ("a NeoHooke and a NeoHooke, both in 'b'; exp", both.residual(v) + b.residual(v)),
        ("J2Plasticity is of small strain; expected Finite", yields[0].residual(v), elastic),
        ("small strain does, in volume 'b'; expected one of", b_linear, elastic),
        ("small strain does, in volume 'a', volume 'b'; exp", elastic.a(u, v), elastic),
        ("does, in volume 'a', volume 'b'; exp", rings.a(u, v), rings),
    ):
        with pytest.raises(tfeti.InputError, match=said):
            more = {"finite": True, "thickness": of_finite[0].thickness} if of_finite else {}
            tfeti.NonlinearContactProblem(F, u, [], [], cut, **more)
    for F in (a.residual(v) + b.residual(v), sum(parts), both.residual(v) + again.residual(v)):
        own = 1e-3 * ufl.inner(u, v) * ufl.dx - v[1] * dx(cut.volume("a"))
        tfeti.NonlinearContactProblem(F + own, u, [], [], cut)
