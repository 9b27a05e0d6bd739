"""What a solution says of friction, and what does not change it: closed forms and limits."""

import numpy as np
import pytest
from dolfinx import fem
from scenes import decomposed, displacement, largest, problem, solved
from test_tresca import nodal_data

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.io.output import nodal_fields

EXACT = {"rtol": 1e-10}


def floor(gdim, law, reach=np.inf):
    up = np.eye(gdim)[-1]
    return tfeti.Obstacle("bottom", tfeti.Plane(0.0 * up, up), friction=law, reach=reach)


def on_a_floor(cell, law, traction, n=4, subdomains=4, **options):
    d = decomposed(cell, n, subdomains)
    gdim = d.mesh.geometry.dim
    return solved(problem(d, traction, [floor(gdim, law)], **{**EXACT, **options}))


SCENES = [("quadrilateral", (0.05, -0.05)), ("tetrahedron", (0.01, -0.035, -0.05))]


@pytest.mark.parametrize("law", [tfeti.Tresca(0.0), tfeti.Coulomb(0.0)])
def test_a_bound_of_0_is_no_friction(law):
    (cell, traction), _ = SCENES
    without, with_none = (on_a_floor(cell, one, traction) for one in (None, law))
    assert np.allclose(displacement(with_none)[1], displacement(without)[1], rtol=0, atol=1e-9)
    assert with_none.report.sticking == with_none.report.sliding == 0
    assert with_none.report.active_contacts == without.report.active_contacts > 0
    assert with_none.report.tangential_rows == without.report.tangential_rows == 0
    assert with_none.report.F_multiplications == without.report.F_multiplications


@pytest.mark.parametrize("law", [tfeti.Tresca(1e3), tfeti.Coulomb(1e3)])
def test_a_large_bound_sticks(law, comm):
    cell, traction = SCENES[1]
    p = on_a_floor(cell, law, traction)
    assert p.report.sliding == 0
    assert p.report.sticking == p.report.active_contacts > 0
    _, _, status, slip = nodal_data(p.solution, comm)
    sticks = status == tfeti.ContactStatus.STICK
    assert np.abs(slip[sticks]).max() <= 1e-9 * np.abs(displacement(p)[1]).max()


@pytest.mark.parametrize(("cell", "traction"), SCENES)
def test_where_all_slides_friction_is_its_bound_times_the_area(cell, traction, comm):
    bound = 1e-4
    p = on_a_floor(cell, tfeti.Tresca(bound), traction)
    data = p.solution.contact()
    size = np.linalg.norm(data.tangential_traction, axis=1)
    assert np.all(size <= bound * (1 + 1e-9))
    slides = data.status == tfeti.ContactStatus.SLIP
    assert comm.allreduce(int(slides.sum())) == p.report.sliding > 0
    assert np.allclose(size[slides], bound)
    opposed = np.sum(data.tangential_traction * data.slip, axis=1)[slides]
    along = bound * np.linalg.norm(data.slip, axis=1)[slides]
    assert np.allclose(opposed, -along, rtol=1e-6, atol=1e-12)
    # what bodies feel is what nodes do
    total = comm.allreduce((data.area[:, None] * data.tangential_traction).sum(axis=0))
    total -= comm.allreduce((data.force[:, None] * data.normal).sum(axis=0))
    assert np.allclose(p.solution.body_forces.force.sum(axis=0), total, rtol=0, atol=1e-13)


def test_fields_of_friction_are_written():
    rough = on_a_floor("quadrilateral", tfeti.Tresca(0.01), (0.05, -0.05))
    names = [field.name for field in nodal_fields(rough.solution)]
    assert {"tangential_traction", "slip", "status"} <= set(names)
    traction = rough.solution.tangential_traction.x.array.reshape(-1, 2)
    assert largest(traction) == pytest.approx(0.01)
    smooth = on_a_floor("quadrilateral", None, (0.05, -0.05))
    names = [field.name for field in nodal_fields(smooth.solution)]
    assert not {"tangential_traction", "slip"} & set(names)


def test_a_bound_may_change_between_solves():
    """A DOLFINx function with other values: no factor, no row, and the answer of a fresh solve."""
    d = decomposed("quadrilateral", 5, 4)
    bound = fem.Function(fem.functionspace(d.mesh, ("Lagrange", 1)))
    bound.x.array[:] = 0.01
    p = solved(problem(d, (0.05, -0.05), [floor(2, tfeti.Tresca(bound))], **EXACT))
    first = displacement(p)[1]
    bound.x.array[:] = 0.004
    p.solve()
    assert p.report.factorizations == p.report.gluings == p.report.coarse_factorizations == 0
    assert "friction" not in p.report.reused
    assert np.abs(displacement(p)[1] - first).max() > 1e-4
    for value in (0.0, 0.004):  # a bound of 0 has no rows
        fresh = solved(problem(d, (0.05, -0.05), [floor(2, tfeti.Tresca(value))], **EXACT))
        bound.x.array[:] = value
        p.solve()
        assert np.allclose(displacement(p)[1], displacement(fresh)[1], rtol=0, atol=1e-8)
        assert (p.report.tangential_rows > 0) == (value > 0)
    p.solve()
    assert "friction" in p.report.reused
    assert p.report.F_multiplications <= 2


@pytest.mark.parametrize("law", [tfeti.Tresca(0.02), tfeti.Coulomb(0.2)])
def test_friction_alone_holds_a_body(law, comm):
    """Nothing else holds the block along the plane; beyond the capacity the error names both."""
    d, bound = decomposed("hexahedron", 3, 3), 0.02
    p = problem(d, (0.9 * bound, 0.0, -0.1), [floor(3, law)], clamped=(), rtol=1e-8)
    p.solve()
    data = p.solution.contact()
    friction = comm.allreduce((data.area[:, None] * data.tangential_traction).sum(axis=0))
    assert np.allclose(friction, (-0.9 * bound, 0.0, 0.0), rtol=0, atol=1e-7)
    assert p.report.free_modes == 0
    traction = (1.5 * bound, 0.0, -0.1)
    p = problem(d, traction, [floor(3, law)], clamped=(), rtol=1e-6)
    says = {
        tfeti.Tresca: "the work 0.03 on a motion of size 1, and friction takes 0.02 at",
        tfeti.Coulomb: r"1\.5\d* times as large",
    }[type(law)]
    with pytest.raises(tfeti.NoSolutionError, match=f"translation in x.* {says}"):
        p.solve()
    p = problem(d, traction, [floor(3, tfeti.Tresca(0.0))], clamped=(), rtol=1e-6)
    with pytest.raises(tfeti.NoSolutionError, match=r"translation in x.* nothing resists that"):
        p.solve()
