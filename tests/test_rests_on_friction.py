"""Bodies that friction alone holds: where it does not balance the load, that is said."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from moving import Thrown
from mpi4py import MPI
from scenes import clamp, decomposed, displacement, hooke, strain

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.accuracy import diagnostics as doubts
from tfeti_dolfinx.accuracy.diagnostics import lost_on_friction

PRESSURE = 0.01
# as the silent wrong answer was found
PLAIN = {"pc_type": "lumped"}


def pressed(cell, n, subdomains, friction, along, clamped=(), **options):
    """A box that an uneven pressure holds on a plane, and a traction pushes along it."""
    d = decomposed(cell, n, subdomains)
    gdim = d.mesh.geometry.dim
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (gdim,)))
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(d.mesh)
    quadrature = {"quadrature_degree": 4}
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags, metadata=quadrature)
    a = ufl.inner(hooke()(u), strain(v)) * ufl.dx(metadata=quadrature)
    pressure = PRESSURE * (1.0 + 0.6 * (x[0] - 0.5) + 0.4 * (x[gdim - 2] - 0.5))
    traction = ufl.as_vector([along, *[0.0] * (gdim - 2), -pressure])
    L = ufl.dot(traction, v) * ds(d.surface("top"))
    up = np.eye(gdim)[-1]
    plane = tfeti.Obstacle("bottom", tfeti.Plane(0.0 * up, up), friction=friction, reach=np.inf)
    bcs = [clamp(V, d.facets(name)) for name in clamped]
    return tfeti.ContactProblem(a, L, bcs, [plane], d, stress=hooke(), petsc_options=options)


def said(p):
    """The warnings in question."""
    return [text for text in p.report.warnings if "friction alone holds" in text]


def at_rest(n, load, bound):
    """u of the square under friction that changes nothing else: the least work along the plane.

    Σψ_i|u_i + y| − load·y is least at the weighted median of −u_i, shifted by the load.
    """
    p = pressed("quadrilateral", n, 1, None, 0.0, rtol=1e-11)
    p.solve()
    x, u = displacement(p)
    below = np.abs(x[:, 1]) < 1e-9
    ends = (x[below, 0] < 1e-9) | (x[below, 0] > 1.0 - 1e-9)
    limits = bound * np.where(ends, 0.5, 1.0) / n
    places = -u[below, 0]
    work = [np.sum(limits * np.abs(u[below, 0] + y)) - load * y for y in places]
    u[:, 0] += places[np.argmin(work)]
    return u


@pytest.mark.parametrize("share", [1e-8, 1e-10, 1e-12])
def test_no_wrong_answer_is_silent(share):
    """Of the pressure; errors of u up to 0.6 of its size were CONVERGED without a word."""
    rtol, bound = 1e-5, share * PRESSURE
    load = 0.95 * bound
    expected = at_rest(8, load, bound)
    p = pressed("quadrilateral", 8, 4, tfeti.Tresca(bound), load, rtol=rtol, **PLAIN)
    p.solve()
    error = np.abs(displacement(p)[1] - expected).max() / np.abs(expected).max()
    texts = said(p)
    if error > 100.0 * rtol:
        assert len(texts) == 1
        assert "body 0: friction alone holds translation in x" in texts[0]
    if error < rtol:
        assert not texts


def test_a_load_above_friction_that_counts_as_none_is_named():
    """Below 1e-9 of the loads it is none to the test of solvability: the body slides far."""
    bound = 1e-10 * PRESSURE
    p = pressed("quadrilateral", 8, 4, tfeti.Tresca(bound), 1.05 * bound, rtol=1e-5, **PLAIN)
    p.solve()
    assert len(said(p)) == 1


LAWS_2D = [tfeti.Tresca(0.003), tfeti.Coulomb(0.3)]
LAWS_3D = [*LAWS_2D, tfeti.Tresca((0.002, 0.004), direction=(1.0, 1.0, 0.0))]
LAWS = [("triangle", 4, law) for law in LAWS_2D] + [("hexahedron", 3, law) for law in LAWS_3D]


@pytest.mark.parametrize("clusters", [0, 2])
@pytest.mark.parametrize(("cell", "n", "law"), LAWS)
def test_a_body_is_missed_where_it_is_not(cell, n, law, clusters):
    """Moved along the plane, or turned on it, by 1e-3 of its displacement; no law does at rest."""
    p = pressed(cell, n, 4, law, 0.0015, rtol=1e-6, clusters=clusters)
    p.solve()
    assert said(p) == []
    dual, dofs, u, lam = p.dual, p.dofs, p.solution.u, p.solution.lam
    gdim = dofs.bs
    size = dofs.comm.allreduce(np.abs(u).max(initial=0.0), op=MPI.MAX)
    x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node, :gdim] - 0.5
    motions = [np.zeros_like(x) for _ in range(gdim)]
    motions[0][:, 0] = 1.0
    if gdim == 3:
        motions[1][:, 1] = 1.0
        motions[2][:, 0], motions[2][:, 1] = -x[:, 1], x[:, 0]
    before = dual.F.count["solver"], sum(dual.F.count.values())
    for motion in motions[: 2 * gdim - 3]:
        for way in (-1e-3, 1e-3):
            moved = u + way * size * motion.ravel()
            assert lost_on_friction(dual.coarse, dual.constraints, moved, lam, 1e-6) is not None
    assert before == (dual.F.count["solver"], sum(dual.F.count.values()))


def test_what_else_is_held_is_not_asked_about():
    """Of a clamped box such friction changes nothing."""
    p = pressed("quadrilateral", 4, 2, tfeti.Tresca(1e-12), 1e-3, ("left",), rtol=1e-6)
    p.solve()
    assert p.report.warnings == []


def test_without_friction_nothing_is_asked(monkeypatch):
    def never(*_):
        raise AssertionError("it has no friction")

    monkeypatch.setattr(doubts, "lost_on_friction", never)
    pressed("quadrilateral", 4, 2, None, 0.0, rtol=1e-6).solve()


def test_inertia_holds():
    """A body with mass does not rest on friction, however little that is."""
    law = tfeti.Tresca(1e-12)
    scene = Thrown("quadrilateral", 3, gap=0.0, weight=0.01, friction=law, thrown=(0.0, 0.01, 0.0))
    for _ in range(3):
        scene.step(0.1)
    assert said(scene.problem) == []
