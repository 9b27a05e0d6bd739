"""The discretisation error: near to the true one, 0 where there is none, the same on all ranks."""

import numpy as np
import pytest
import ufl
from bodies import (
    clamped,
    drawn,
    held,
    pressed,
    sided,
    sides_of,
    stacked,
    stiffer_above,
    two_body_problem,
)
from scenes import box, clamp, curved_obstacle, decomposed, forms, hooke, problem, solved
from true_errors import AGAINST_FINER, ball, error_against, lame_error, shrink_fit, stress_of_cells

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.io.output import cell_fields

RTOL = {"rtol": 1e-7}


def index(p, true):
    """Estimate over true error."""
    return p.estimate().discretisation / true


@pytest.mark.parametrize(("degree", "triangles"), [(1, True), (2, False)])
@pytest.mark.parametrize("cells", [8, pytest.param(32, marks=pytest.mark.slow)])
def test_shrink_fit(cells, degree, triangles):
    p = solved(shrink_fit(cells, degree, triangles, **RTOL))
    error, size = lame_error(p)
    assert p.estimate().energy == pytest.approx(size, rel=0.05)
    assert 0.4 <= index(p, error) <= 1.5


@pytest.mark.parametrize(
    ("scene", "sizes", "finest"),
    [*AGAINST_FINER, pytest.param(ball, (3_000, 10_000, 30_000), 240_000, marks=pytest.mark.slow)],
)
def test_against_a_finer_mesh(serial_only, scene, sizes, finest):
    finer = solved(scene(finest, **RTOL))
    reference, errors = stress_of_cells(finer), []
    for size in sizes:
        p = solved(scene(size, **RTOL))
        error, energy = error_against(p, reference)
        errors.append(error / energy)
        assert 0.6 <= index(p, error) <= 1.5
    assert np.all(np.diff(errors) < 0.0)


def layers(names):
    """A cube of two layers, with or without names for them, E = 1 below and 10 above."""
    mesh, tags, sides = box("tetrahedron", 4)
    volumes = {"below": lambda x: x[2] <= 0.5, "above": lambda x: x[2] >= 0.5} if names else None
    return tfeti.decompose(mesh, 5, facet_tags=tags, surfaces=sides, volumes=volumes)


@pytest.mark.parametrize("names", [True, False])
def test_stress_and_strain_may_jump_where_materials_meet(names):
    """ν = 0, pulled: the strain jumps, and the solution is exact."""
    d = layers(names)
    stress = hooke(ufl.conditional(ufl.gt(ufl.SpatialCoordinate(d.mesh)[2], 0.5), 10.0, 1.0), 0.0)
    given = drawn(d, "top", (0, 0, 1e-3)), clamped(d, "bottom"), []
    p = solved(two_body_problem(d, *given, stress=stress, rtol=1e-9))
    assert (p.estimate().relative_discretisation <= 1e-6) == names


def test_bodies_in_contact_have_stresses_of_their_own():
    """Blocks of different stiffness under a pressure: each has its strain, uniform."""
    d = stacked("hexahedron", 3, 4)
    bcs, pair = held(d, *sides_of("hexahedron")), [sided("lower top", "upper bottom")]
    given = {"stress": stiffer_above(d, 100.0), "rtol": 1e-9}
    p = solved(two_body_problem(d, pressed(d, 1e-2), bcs, pair, **given))
    assert p.estimate().relative_discretisation <= 1e-6


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_it_does_not_see_tears(cell):
    """One subdomain or many, on any number of ranks."""
    found = []
    for subdomains in (1, 7):
        d = decomposed(cell, 5, subdomains)
        obstacle = tfeti.Obstacle("bottom", curved_obstacle(d.mesh.geometry.dim))
        p = solved(problem(d, contacts=[obstacle], rtol=1e-9))
        found.append(p.estimate().discretisation)
        field = p.solution.discretisation_error.x.array
        assert np.all(field >= 0.0)
        whole = p.dofs.comm.allreduce(float(field @ field))
        assert np.sqrt(whole) == pytest.approx(found[-1])
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_without_a_stress_only_the_algebraic_error_is_known():
    d = decomposed("triangle", 3, 2)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, -1e-2), d.surface("top"))
    p = solved(tfeti.ContactProblem(a, L, [clamp(V, d.facets("left"))], [], d))
    found = p.estimate()
    assert found.discretisation is None
    assert np.isnan(found.relative_discretisation)
    assert "discretisation" not in p.report.estimates


def test_files_have_the_field_once_it_is_made():
    p = solved(problem(decomposed("quadrilateral", 6, 5)))
    names = [field.name for field in cell_fields(p.solution)]
    p.estimate()
    fields = cell_fields(p.solution)
    assert [field.name for field in fields] == [*names, "discretisation_error"]
    own = p.solution.discretisation_error
    cells = np.asarray(own.function_space.dofmap.list)[:, 0]
    copied = np.asarray(fields[-1].function_space.dofmap.list)[:, 0]
    assert np.array_equal(fields[-1].x.array[copied], own.x.array[cells])
