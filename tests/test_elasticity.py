"""Elasticity offered once: closed forms in every model, moduli by names, pressures of rings."""

import numpy as np
import pytest
import ufl
from bodies import TO_ROUNDING, held
from dolfinx import fem
from scenes import box, decomposed, integral, largest, roller, solved, vectors
from test_mortar_cases import decomposed_boxes

import tfeti_dolfinx as tfeti

PRESSURE, YOUNG, POISSON = 0.1, 2.0, 0.3
PLANE = dict.fromkeys(
    ("plane_strain", "plane_stress", "axisymmetric"), ("triangle", "quadrilateral")
)
CELLS = {"3d": ("tetrahedron", "hexahedron"), **PLANE}
# of each model both cells and both degrees
SCENES = [(model, CELLS[model][degree - 1], degree) for model in CELLS for degree in (1, 2)]


def compressed(d, elastic, degree=1, contacts=(), on="top", sides=("left", "bottom"), **options):
    """A body pressed from above, its sides held along their normals."""
    gdim = d.mesh.geometry.dim
    V, u, v = vectors(d, degree)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    L = -fem.Constant(d.mesh, PRESSURE) * elastic.thickness * v[gdim - 1] * ds(d.surface(on))
    given = elastic.a(u, v), L, held(d, *sides)(V), list(contacts), d
    more = {"thickness": elastic.thickness, "petsc_options": {**TO_ROUNDING, **options}}
    return solved(tfeti.ContactProblem(*given, stress=elastic.stress, **more))


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
    assert largest(found - u) < 1e-9
    assert largest(problem.solution.stress.x.array.reshape(-1, 9) - stress) < 1e-9


MODELS = ("plane_strain", "plane_stress")


def test_a_thickness_changes_forces_only(comm):
    """Displacement and pressure stay as they are, forces are multiplied."""
    d = decomposed("quadrilateral", 3, 2)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)), name="floor")
    states = []
    for thickness in (None, 5.0):
        elastic = tfeti.Elasticity(d, E=YOUNG, nu=POISSON, model=MODELS[1], thickness=thickness)
        problem = compressed(d, elastic, contacts=[floor], sides=("left",))
        data = problem.solution.contact("floor")
        assert np.allclose(data.pressure, PRESSURE, rtol=0, atol=1e-9)
        force, area = comm.allreduce(np.array([data.force.sum(), data.area.sum()]))
        assert np.isclose(force, PRESSURE * area, rtol=1e-8)
        states.append((problem.u.x.array.copy(), area))
    assert np.allclose(states[0][0], states[1][0], rtol=0, atol=1e-9)
    assert np.isclose(states[1][1], 5.0 * states[0][1], rtol=1e-12)


@pytest.mark.parametrize("names", [("lower", "upper"), ("upper", np.int32(1))])
def test_moduli_by_names(names, comm):
    mesh, facet_tags, sides = box("quadrilateral", 6)
    volumes = {"lower": lambda x: x[1] <= 0.5, "upper": lambda x: x[1] >= 0.5}
    d = tfeti.decompose(mesh, 4, facet_tags=facet_tags, surfaces=sides, volumes=volumes)
    value = {"lower": 1.0, 1: 1.0, "upper": 8.0, 2: 8.0}
    given = {"E": {name: value[name] for name in names}, "nu": {"upper": 0.3, "lower": 0.2}}
    elastic = tfeti.Elasticity(d, **given, model=MODELS[0])
    problem = compressed(d, elastic, sides=("left", "right", "bottom"))
    x = problem.u.function_space.tabulate_dof_coordinates()
    y = x[:, 1]
    # confined: ε_yy = −p/(λ + 2μ) in each half
    stiff = [E * (1 - nu) / (1 + nu) / (1 - 2 * nu) for E, nu in ((1.0, 0.2), (8.0, 0.3))]
    exact = -PRESSURE * (np.minimum(y, 0.5) / stiff[0] + np.maximum(y - 0.5, 0) / stiff[1])
    assert largest(problem.u.x.array.reshape(-1, 2)[:, 1] - exact) < 1e-9


# Lamé: radii 1 and 2, pressure 1 inside
def tube(r, z, E=YOUNG, nu=POISSON):
    """Displacement of a thick tube that cannot grow longer."""
    return np.stack(((1 + nu) / E * ((1 - 2 * nu) * r + 4 / r) / 3, 0 * z))


def shell(r, z, E=YOUNG, nu=POISSON):
    """Displacement of a thick sphere."""
    rho = np.hypot(r, z)
    radial = ((1 - 2 * nu) / 7 * rho + (1 + nu) * 4 / 7 / rho**2) / E
    return radial * np.stack((r, z)) / rho


SHAPES = {
    "tube": (lambda s, t: (1 + s, t), tube),
    "shell": (lambda s, t: (1 + s) * np.stack([f(t * np.pi / 2) for f in (np.sin, np.cos)]), shell),
}


def errors_of_shape(shape, cell, n):
    """Relative L² errors of displacement and strain under a pressure inside."""
    place, exact = SHAPES[shape]
    mesh, tags, names = box(cell, n)
    x = mesh.geometry.x
    x[:, 0], x[:, 1] = place(x[:, 0], x[:, 1])
    d = tfeti.decompose(mesh, 4, facet_tags=tags, surfaces=names)
    elastic = tfeti.Elasticity(d, E=YOUNG, nu=POISSON, model="axisymmetric")
    V, u, v = vectors(d)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    # of the shell "bottom" is the axis, where u_r = 0, and "top" the equator
    axis_of = {"bottom": 0 if shape == "shell" else 1, "top": 1}
    bcs = [roller(V, k, d.facets(side)) for side, k in axis_of.items()]
    L = -elastic.thickness * ufl.dot(ufl.FacetNormal(d.mesh), v) * ds(d.surface("left"))
    more = {"stress": elastic.stress, "petsc_options": {"rtol": 1e-8}}
    uh = tfeti.ContactProblem(elastic.a(u, v), L, bcs, [], d, **more).solve()
    w = fem.Function(fem.functionspace(d.mesh, ("Lagrange", 3, (2,))))
    w.interpolate(lambda x: exact(x[0], x[1]))
    dx = ufl.Measure("dx", domain=d.mesh, metadata={"quadrature_degree": 6})
    errors = []
    for part in (lambda f: f, elastic.strain):
        squares = [elastic.thickness * ufl.inner(part(f), part(f)) * dx for f in (uh - w, w)]
        errors.append(np.sqrt(np.divide(*map(integral, squares))))
    return errors


@pytest.mark.parametrize(("shape", "cell"), [("tube", "triangle"), ("shell", "quadrilateral")])
def test_thick_walls_converge(shape, cell):
    """Slopes over three meshes, by least squares: 2 in L², 1 in the strain."""
    counts = np.array([6, 12, 24])
    errors = np.array([errors_of_shape(shape, cell, n) for n in counts])
    slopes = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert errors[-1, 0] < 0.005
    assert 1.8 < slopes[0] < 2.2
    assert 0.9 < slopes[1] < 1.3


@pytest.mark.parametrize("degree", [1, 2])
def test_pressure_of_cylinders_on_a_plane(degree, comm):
    """It is force per area of the ring, on the axis, too, which is part of a surface here."""
    parts = [("lower", (0, -1), (1, 0), (3, 3)), ("upper", (0, 0), (1, 1), (4, 4))]
    d = decomposed_boxes(parts, 3, [("lower bottom", ["lower bottom", "lower left"])])
    elastic = tfeti.Elasticity(d, E=YOUNG, nu=POISSON, model="axisymmetric")
    floor = tfeti.Obstacle("lower bottom", tfeti.Plane((0, -1), (0, 1)), reach=0.01)
    given = {"contacts": [floor, tfeti.Contact("upper bottom", "lower top")], "on": "upper top"}
    solution = compressed(d, elastic, degree, sides=["upper left"], **given).solution
    for data in map(solution.contact, range(2)):
        assert np.allclose(data.pressure, PRESSURE, rtol=0, atol=1e-9)
        assert np.isclose(comm.allreduce(data.area.sum()), np.pi, rtol=1e-12)
        assert np.isclose(comm.allreduce(data.force.sum()), PRESSURE * np.pi, rtol=1e-8)
    assert np.isclose(solution.body_forces.force[0, 1], PRESSURE * np.pi, rtol=1e-8)
