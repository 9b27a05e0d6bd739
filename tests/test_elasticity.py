"""Elasticity offered once: closed forms in every model, moduli by names, pressures of rings."""

import gmsh
import numpy as np
import pytest
import ufl
from bodies import held, stacked
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import box, decomposed, hooke, relative, strain

import tfeti_dolfinx as tfeti
from demos.hertz import PointContact, compare
from meshes.tools import graded_size, started_model

PRESSURE, YOUNG, POISSON = 0.1, 2.0, 0.3
EXACT = {"rtol": 1e-12, "error_if_not_converged": False}
CELLS = {
    "3d": ("tetrahedron", "hexahedron"),
    "plane_strain": ("triangle", "quadrilateral"),
    "plane_stress": ("triangle", "quadrilateral"),
    "axisymmetric": ("triangle", "quadrilateral"),
}
# of each model both cells and both degrees; the other products are slow: a form of each is compiled
SCENES = [
    pytest.param(model, cell, degree, marks=[pytest.mark.slow] * (CELLS[model][degree - 1] != cell))
    for model in CELLS
    for cell in CELLS[model]
    for degree in (1, 2)
]


def compressed(d, elastic, degree=1, contacts=(), on="top", sides=("left", "bottom"), **options):
    """A body pressed from above, its sides held along their normals."""
    gdim = d.mesh.geometry.dim
    V = fem.functionspace(d.mesh, ("Lagrange", degree, (gdim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        -fem.Constant(d.mesh, PRESSURE) * elastic.thickness * v[gdim - 1] * ds(d.surface(on)),
        held(d, *sides)(V),
        list(contacts),
        d,
        stress=elastic.stress,
        thickness=elastic.thickness,
        petsc_options={**EXACT, **options},
    )
    problem.solve()
    return problem


def uniaxial(model, x, nu=POISSON):
    """Displacement and stress under a pressure along the last axis."""
    p, E, gdim = PRESSURE, YOUNG, 3 if model == "3d" else 2
    s = np.zeros((3, 3))
    s[gdim - 1, gdim - 1] = -p
    along, across = -p / E, nu * p / E
    if model == "plane_strain":
        s[2, 2] = -nu * p
        along, across = along * (1 - nu**2), across * (1 + nu)
    u = across * x[:, :gdim]
    u[:, -1] = along * x[:, gdim - 1]
    return u, s.ravel()


@pytest.mark.parametrize(("model", "cell", "degree"), SCENES)
def test_uniaxial_stress(model, cell, degree, comm):
    d = decomposed(cell, 2, 3)
    elastic = tfeti.Elasticity(d, E=YOUNG, nu=POISSON, model=model)
    sides = ("left", "bottom", "front") if model == "3d" else ("left", "bottom")
    problem = compressed(d, elastic, degree, sides=sides)
    x = problem.u.function_space.tabulate_dof_coordinates()
    u, stress = uniaxial(model, x)
    found = problem.u.x.array.reshape(u.shape)
    error = max(
        np.abs(found - u).max(initial=0.0),
        np.abs(problem.solution.stress.x.array.reshape(-1, 9) - stress).max(initial=0.0),
    )
    assert comm.allreduce(error, op=MPI.MAX) < 1e-9


@pytest.mark.parametrize(
    ("cell", "degree"),
    [
        ("triangle", 2),
        ("quadrilateral", 1),
        ("tetrahedron", 1),
        ("hexahedron", 2),
    ],
)
def test_the_form_is_the_one_that_users_write(cell, degree):
    """With quadrature of a degree that is exact on these affine cells for certain."""
    mesh, _, _ = box(cell, 2)
    gdim = mesh.geometry.dim
    V = fem.functionspace(mesh, ("Lagrange", degree, (gdim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    elastic = tfeti.Elasticity(mesh, E=YOUNG, nu=POISSON, model=None if gdim == 3 else MODELS[0])
    dx = ufl.dx(metadata={"quadrature_degree": 8})
    written = ufl.inner(hooke(YOUNG, POISSON)(u), strain(v)) * dx
    ours, theirs = (fem.assemble_matrix(fem.form(a)).to_scipy() for a in (elastic.a(u, v), written))
    assert relative(ours.data, theirs.data) < 1e-13


MODELS = ("plane_strain", "plane_stress")


@pytest.mark.parametrize("model", MODELS)
def test_a_thickness_changes_forces_only(model, comm):
    """Displacement and pressure stay as they are, forces are multiplied."""
    d = decomposed("quadrilateral", 3, 2)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)), name="floor")
    states = []
    for thickness in (None, 5.0):
        elastic = tfeti.Elasticity(d, E=YOUNG, nu=POISSON, model=model, thickness=thickness)
        problem = compressed(d, elastic, contacts=[floor], sides=("left",))
        data = problem.solution.contact("floor")
        assert np.allclose(data.pressure, PRESSURE, rtol=0, atol=1e-9)
        force, area = comm.allreduce(np.array([data.force.sum(), data.area.sum()]))
        assert np.isclose(force, PRESSURE * area, rtol=1e-8)
        states.append((problem.u.x.array.copy(), area))
    assert np.allclose(states[0][0], states[1][0], rtol=0, atol=1e-9)
    assert np.isclose(states[1][1], 5.0 * states[0][1], rtol=1e-12)


def test_a_number_that_is_changed_needs_no_new_form():
    mesh, _, _ = box("triangle", 2)
    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    elastic = tfeti.Elasticity(mesh, E=YOUNG, nu=POISSON, model="plane_stress")
    form = fem.form(elastic.a(u, v))
    before = fem.assemble_matrix(form).to_scipy().data.copy()
    elastic.E.value = 3 * YOUNG
    assert relative(fem.assemble_matrix(form).to_scipy().data, 3 * before) < 1e-14


def two_materials(n=3):
    """A box in two volumes, "lower" and "upper"."""
    mesh, facet_tags, names = box("quadrilateral", 2 * n)
    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    above = dmesh.compute_midpoints(mesh, 2, cells)[:, 1] > 0.5
    tags = dmesh.meshtags(mesh, 2, cells, np.where(above, 7, 4).astype(np.int32))
    volumes = {"lower": 4, "upper": 7}
    return tfeti.decompose(mesh, 4, tags, facet_tags, surfaces=names, volumes=volumes)


@pytest.mark.parametrize("names", [("lower", "upper"), (4, 7), ("upper", np.int32(4))])
def test_moduli_by_names(names, comm):
    d = two_materials()
    value = {"lower": 1.0, 4: 1.0, "upper": 8.0, 7: 8.0}
    elastic = tfeti.Elasticity(
        d, E={name: value[name] for name in names}, nu={"upper": 0.3, "lower": 0.2}, model=MODELS[0]
    )
    problem = compressed(d, elastic, sides=("left", "right", "bottom"))
    x = problem.u.function_space.tabulate_dof_coordinates()
    y = x[:, 1]
    # confined: ε_yy = −p/(λ + 2μ) in each half
    stiff = [E * (1 - nu) / (1 + nu) / (1 - 2 * nu) for E, nu in ((1.0, 0.2), (8.0, 0.3))]
    exact = -PRESSURE * (np.minimum(y, 0.5) / stiff[0] + np.maximum(y - 0.5, 0) / stiff[1])
    error = np.abs(problem.u.x.array.reshape(-1, 2)[:, 1] - exact).max(initial=0.0)
    assert comm.allreduce(error, op=MPI.MAX) < 1e-9


def functions_of(d):
    E = fem.Function(fem.functionspace(d.mesh, ("DG", 0)))
    E.x.array[:] = YOUNG
    return E


@pytest.mark.parametrize(
    "modulus",
    [
        lambda d: YOUNG,
        functions_of,
        lambda d: ufl.conditional(ufl.gt(ufl.SpatialCoordinate(d.mesh)[1], 0.5), YOUNG, YOUNG),
    ],
    ids=["number", "function", "expression"],
)
def test_moduli_of_all_kinds(modulus, comm):
    d = decomposed("triangle", 2, 2)
    problem = compressed(d, tfeti.Elasticity(d, E=modulus(d), nu=POISSON, model="plane_stress"))
    x = problem.u.function_space.tabulate_dof_coordinates()
    error = np.abs(problem.u.x.array.reshape(-1, 2) - uniaxial("plane_stress", x)[0])
    assert comm.allreduce(error.max(initial=0.0), op=MPI.MAX) < 1e-9


# Lamé: radii 1 and 2, pressure 1 inside
def tube(r, z, E=YOUNG, nu=POISSON):
    """Displacement of a thick tube that cannot grow longer."""
    A, B = 1 / 3, 4 / 3
    return np.stack(((1 + nu) / E * ((1 - 2 * nu) * A * r + B / r), 0 * z))


def shell(r, z, E=YOUNG, nu=POISSON):
    """Displacement of a thick sphere."""
    rho = np.hypot(r, z)
    radial = ((1 - 2 * nu) / 7 * rho + (1 + nu) * 4 / 7 / rho**2) / E
    return radial * np.stack((r, z)) / rho


SHAPES = {
    "tube": (lambda s, t: (1 + s, t), tube),
    "shell": (
        lambda s, t: ((1 + s) * np.sin(np.pi / 2 * t), (1 + s) * np.cos(np.pi / 2 * t)),
        shell,
    ),
}


def errors_of_shape(shape, cell, n):
    """Relative L² errors of displacement and strain under a pressure inside."""
    place, exact = SHAPES[shape]
    mesh, tags, names = box(cell, n)
    x = mesh.geometry.x
    x[:, 0], x[:, 1] = place(x[:, 0], x[:, 1])
    d = tfeti.decompose(mesh, 4, facet_tags=tags, surfaces=names)
    elastic = tfeti.Elasticity(d, E=YOUNG, nu=POISSON, model="axisymmetric")
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    inside = ds(d.surface("left"))
    # of the shell "bottom" is the axis, where u_r = 0, and "top" the equator
    axis_of = {"bottom": 0 if shape == "shell" else 1, "top": 1}
    bcs = [
        fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(k), 1, d.facets(side)), V.sub(k))
        for side, k in axis_of.items()
    ]
    L = -elastic.thickness * ufl.dot(ufl.FacetNormal(d.mesh), v) * inside
    problem = tfeti.ContactProblem(
        elastic.a(u, v), L, bcs, [], d, stress=elastic.stress, petsc_options={"rtol": 1e-8}
    )
    uh = problem.solve()
    W = fem.functionspace(d.mesh, ("Lagrange", 3, (2,)))
    w = fem.Function(W)
    w.interpolate(lambda x: exact(x[0], x[1]))
    dx = ufl.Measure("dx", domain=d.mesh, metadata={"quadrature_degree": 6})
    errors = []
    for part in (lambda f: f, elastic.strain):
        squares = [elastic.thickness * ufl.inner(part(f), part(f)) * dx for f in (uh - w, w)]
        sums = [d.comm.allreduce(fem.assemble_scalar(fem.form(form))) for form in squares]
        errors.append(np.sqrt(sums[0] / sums[1]))
    return errors, problem


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@pytest.mark.parametrize("shape", SHAPES)
def test_thick_walls_converge(shape, cell):
    """Slopes over three meshes, by least squares: 2 in L², 1 in the strain."""
    counts = np.array([6, 12, 24])
    errors = np.array([errors_of_shape(shape, cell, n)[0] for n in counts])
    slopes = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert errors[-1, 0] < 0.005
    assert 1.8 < slopes[0] < 2.2
    assert 0.9 < slopes[1] < 1.3


def test_stress_on_the_axis_is_finite_and_right(comm):
    """u_r/r is 0/0 there; the hoop stress of a sphere's pole is that of its other points."""
    errors = []
    for n in (8, 16):
        stress = errors_of_shape("shell", "quadrilateral", n)[1].solution.stress
        x = stress.function_space.tabulate_dof_coordinates()
        values = stress.x.array.reshape(-1, 3, 3)[: len(x)]
        assert np.all(np.isfinite(values))
        axis = x[:, 0] < 1e-12
        hoop = (1 + 4 / x[axis, 1] ** 3) / 7  # of Lamé's sphere
        error = np.abs(values[axis, 2, 2] - hoop).max(initial=0.0)
        errors.append(comm.allreduce(error, op=MPI.MAX))
    assert errors[1] < 0.1
    assert errors[1] < 0.65 * errors[0]


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_pressure_of_a_cylinder_on_a_plane(cell, comm):
    """It is force per area of the ring, on the axis too."""
    d = decomposed(cell, 3, 3)
    elastic = tfeti.Elasticity(d, E=YOUNG, nu=POISSON, model="axisymmetric")
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)))
    problem = compressed(d, elastic, contacts=[floor], sides=("left",))
    data, solution = problem.solution.contact(), problem.solution
    assert np.allclose(data.pressure, PRESSURE, rtol=0, atol=1e-9)
    assert np.isclose(comm.allreduce(data.area.sum()), np.pi, rtol=1e-12)
    assert np.isclose(comm.allreduce(data.force.sum()), PRESSURE * np.pi, rtol=1e-8)
    assert np.isclose(solution.body_forces.force[0, 1], PRESSURE * np.pi, rtol=1e-8)
    on = np.isclose(data.points[:, 1], 0.0)
    assert np.all(on)
    for field, exact in ((solution.pressure, PRESSURE), (solution.traction, PRESSURE)):
        largest = comm.allreduce(field.x.array.max(initial=0.0), op=MPI.MAX)
        assert np.isclose(largest, exact, rtol=0, atol=1e-9)


def test_pressure_of_cylinders_whose_meshes_do_not_match():
    """Multipliers are uniform along a line, not around the axis: of second order, not exact."""
    counts, errors = np.array([3, 6, 12]), []
    for n in counts:
        d = stacked("quadrilateral", n, n + 1)
        elastic = tfeti.Elasticity(d, E=YOUNG, nu=POISSON, model="axisymmetric")
        pair = tfeti.Contact("upper bottom", "lower top", name="joint")
        sides = ("lower bottom", "lower left", "upper left")
        problem = compressed(d, elastic, contacts=[pair], on="upper top", sides=sides)
        data = problem.solution.contact("joint")
        squares = np.array([data.area @ (data.pressure / PRESSURE - 1) ** 2, data.area.sum()])
        squares = d.comm.allreduce(squares)
        errors.append(np.sqrt(squares[0] / squares[1]))
    assert errors[-1] < 0.003
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] > 1.8


def quarter_disc(comm, a, elements):
    """Half of a half disc, r ≥ 0: a half ball on the plane z = 0."""
    model = None
    if comm.rank == 0:
        model = started_model("quarter_disc")
        geo = model.geo
        lowest, centre, right = (geo.addPoint(*x, 0.0) for x in ((0, 0), (0, 1), (1, 1)))
        arc, top = geo.addCircleArc(lowest, centre, right), geo.addLine(right, centre)
        axis = geo.addLine(centre, lowest)
        body = geo.addPlaneSurface([geo.addCurveLoop([arc, top, axis])])
        geo.synchronize()
        model.addPhysicalGroup(2, [body], name="ball")
        for name, curve in (("arc", arc), ("top", top), ("axis", axis)):
            model.addPhysicalGroup(1, [curve], name=name)
        graded_size((0.0, 0.0, 0.0), a / elements, 1.5 * a, 0.3)
        gmsh.model.mesh.generate(2)
    return tfeti.read_gmsh(model, comm, subdomains=4)


def test_hertz_of_a_ball(comm):
    """The closed form that the demo in 3D has with 60 000 unknowns, in the plane."""
    a, nu = 0.05, 0.3
    hertz = PointContact.from_half_width(a, 1.0, 1 / (1 - nu**2))
    d = quarter_disc(comm, a, 15)
    elastic = tfeti.Elasticity(d, E={"ball": 1.0}, nu=nu, model="axisymmetric")
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    push = fem.Constant(d.mesh, (0.0, -hertz.load / np.pi))
    axis = fem.locate_dofs_topological(V.sub(0), 1, d.facets("axis"))
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        elastic.thickness * ufl.dot(push, v) * ds(d.surface("top")),
        [fem.dirichletbc(0.0, axis, V.sub(0))],
        [tfeti.Obstacle("arc", tfeti.Plane((0, 0), normal=(0, 1)), reach=2 * a**2)],
        d,
        thickness=elastic.thickness,
        petsc_options={"rtol": 1e-8},
    )
    problem.solve()
    data = problem.solution.contact()
    errors = compare(comm, data, data.points[:, 0], hertz)
    assert abs(errors["force"]) < 1e-6
    for name in ("half_width", "peak_pressure", "pressure_l2"):
        assert abs(errors[name]) < 0.02, name
