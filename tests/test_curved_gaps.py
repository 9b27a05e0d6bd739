"""Pins in bores: what straight facets do to a gap, the warning, and gap="curved"."""

from functools import cache

import numpy as np
import pytest
import ufl
from bodies import ORDERS, dofs_on, gathered, no_load, searched, sided
from mpi4py import MPI
from scenes import CELLS, clamp, roller, solved, vectors
from test_contact_gaps import shaped

import tfeti_dolfinx as tfeti
from meshes.lug import PIN, lug

CLEARANCE, PUSHED = 0.05, 0.1
PAIR = ("pin side", "bore")
SAYS = "contact of 'pin side' with 'bore': facets are straight where the surfaces are curved"
EXPECTS = 'expected gap="curved", mesh and displacements of degree 2, or smaller facets'


def pushed_pin(sizes, contact, order=1, **mesh):
    """The lug's edge is clamped, the pin's core is moved down; in space the ends stay in planes."""
    d = lug(MPI.COMM_WORLD, sizes, order, clearance=CLEARANCE, **mesh)
    gdim = d.mesh.geometry.dim
    law = {} if gdim == 3 else {"model": "plane_strain"}
    V, u, v = vectors(d, order)
    bcs = []
    for name, y in (("edge", 0.0), ("core", -PUSHED)):
        bcs.append(clamp(V, d.facets(name), np.array([0.0, y, 0.0][:gdim])))
    for name, axis in (("middle", 0), ("ends", 2)):
        if name in d.names.surfaces:
            bcs.append(roller(V, axis, d.facets(name)))
    a = tfeti.Elasticity(d, E=210e3, nu=0.3, **law).a(u, v)
    options = {"rtol": 1e-7}
    return tfeti.ContactProblem(a, no_load(v, None), bcs, [contact], d, petsc_options=options)


def pin_in_lug(sizes, gap="geometry", order=1, **mesh):
    return pushed_pin(sizes, tfeti.Contact(*PAIR, gap=gap), order, **mesh)


def force_and_peak(p):
    """Solve; the force that holds the pin up, and the highest pressure."""
    p.solve()
    contact = p.solution.contact()
    force = gathered(contact.force * contact.normal[:, 1]).sum()
    return np.array([abs(force), gathered(contact.pressure).max()])


@cache
def reference():
    """Force and peak on curved cells of degree 2, a sixth of the size."""
    return force_and_peak(pin_in_lug((0.5, 0.5), order=2))


# elements of the pin and of the lug, what the mesh is besides, its share of the force, and how far
# the peak pressure of degree 1 may be off
LUGS = {
    "finer pin": ((2.0, 3.0), {}, 1.0, 0.05),
    "half": ((3.0, 2.0), {"half": True}, 0.5, 0.05),
    "tetrahedra": ((3.0, 2.0), {"thickness": 3.0}, 3.0, 0.1),
}


@pytest.mark.parametrize("name", LUGS)
def test_a_pin_in_a_lug_with_curved_gaps(name):
    """Without them facets that decide are warned of: up to h²/8R = 0.11 beside the surfaces."""
    sizes, mesh, share, far = LUGS[name]
    p = pin_in_lug(sizes, **mesh)
    force, _ = force_and_peak(p) / reference()
    assert abs(force / share - 1.0) > 0.4
    (warning,) = p.report.warnings
    assert warning.startswith(SAYS)
    assert warning.endswith(EXPECTS)
    assert "change the gap, at most 0.05" in warning
    p = pin_in_lug(sizes, "curved", **mesh)
    assert np.all(np.abs(force_and_peak(p) / reference() / (share, 1.0) - 1.0) < (0.01, far))
    assert not p.report.warnings


def test_facets_that_miss_each_other_are_warned_of():
    """The pin, finer, hangs between its nodes: it would touch, and no node has a force."""
    p = pin_in_lug((3.0, 0.75))
    assert not np.any(force_and_peak(p))
    assert any(text.startswith(SAYS) and "together by 0;" in text for text in p.report.warnings)
    # pressures of nodes that are hardly covered do not hide them
    p = solved(pin_in_lug((3.0, 2.0), thickness=6.0, layers=2, thin=0.53))
    (warning,) = p.report.warnings
    assert warning.startswith(SAYS)


def test_curved_cells_that_cannot_turn_are_warned_of():
    d = lug(MPI.COMM_WORLD, (3.0, 2.0), 2, clearance=CLEARANCE)
    V, u, v = vectors(d)
    x = ufl.SpatialCoordinate(d.mesh)
    a = tfeti.Elasticity(d, E=210e3, nu=0.3, model="plane_strain").a(u, v)
    p = solved(tfeti.ContactProblem(a, (x[0] * v[1] - x[1] * v[0]) * ufl.dx, [], [], d))
    assert "degree 1, in which curved cells cannot turn without strain" in p.report.warnings[0]


@pytest.mark.parametrize(
    ("sizes", "order", "gap"),
    [((3.0, 2.0), 2, "geometry"), ((3.0, 2.0), 1, CLEARANCE)],
    ids=["degree 2", "given"],
)
def test_facets_that_do_not_decide_are_not_warned_of(sizes, order, gap):
    p = pin_in_lug(sizes, gap, order)
    assert np.all(np.abs(force_and_peak(p) / reference() - 1.0) < (0.04, 0.06))
    assert not p.report.warnings


@pytest.mark.parametrize("gap", ["geometry", "curved"])
def test_facets_do_not_show_at_an_obstacle(gap):
    """Its distance is taken at the vertices, which are on the pin."""
    bore = tfeti.Cylinder((0, 0), axis=(0, 0, 1), radius=PIN + CLEARANCE, inside=True)
    contact = tfeti.Obstacle("pin side", bore, gap=gap)
    p, finer = pushed_pin((1.5, 3.0), contact), pushed_pin((0.75, 3.0), contact, 2)
    assert np.all(np.abs(force_and_peak(p) / force_and_peak(finer) - 1.0) < 0.02)
    assert not p.report.warnings


PAIRS = list(zip(CELLS, 2 * ORDERS, strict=True))


def height(x):
    """A saddle, or a bent line."""
    return 0.3 * x[:, 0] ** 2 - (0.2 * x[:, 1] ** 2 if x.shape[1] == 2 else 0.0)


@pytest.mark.parametrize(("cell", "sides"), PAIRS)
def test_surfaces_are_fitted_and_edges_are_not_rounded_off(cell, sides):
    """Of one shape, 0.01 apart: of degree 2, rims, corners, however coarse; roofs of 90 degrees."""
    pairs = [sided(*sides, reach=0.5, gap=gap) for gap in ("geometry", "curved")]
    dofs = dofs_on(shaped(cell, 3, 5, height, lambda x: height(x) + 0.01))
    flat, curved = (searched([pair], dofs) for pair in pairs)
    expected = 0.01 * np.abs(curved.normal[:, -1])
    flat, curved = (gathered(np.abs(records.gap - expected)).max() for records in (flat, curved))
    assert flat > 1e-3
    assert curved < 0.12 * flat
    roof = shaped(cell, 4, 6, lambda x: -np.abs(x[:, 0]), lambda x: 0.01 - np.abs(x[:, 0]))
    found = [gathered(searched([pair], dofs_on(roof)).gap) for pair in pairs]
    assert len(found[0]) > 0
    assert np.allclose(*found, rtol=0.0, atol=1e-12)
