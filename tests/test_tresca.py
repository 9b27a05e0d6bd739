"""Friction from the user's door to u and λ, against an independent solver, without tears."""

import numpy as np
import pytest
from bodies import torn_boxes
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import untorn
from scenes import by_point, clamp, decomposed, displacement, forms, hooke, problem, solved

import tfeti_dolfinx as tfeti

EXACT = {"rtol": 1e-10}
AT_REST = 1e-6
BOTH = ["newton", pytest.param("smalse", marks=pytest.mark.slow)]
SOLVERS = pytest.mark.parametrize("qp_type", BOTH)


def frame_of(gdim, angle, normal):
    """Axes of all conditions: normal ±e_last, then the tangents; in 3D turned by an angle."""
    last = normal * np.eye(gdim)[-1]
    if gdim == 2:
        return np.array([last, [1.0, 0.0]])
    first = np.array([np.cos(angle), np.sin(angle), 0.0])
    return np.array([last, first, np.cross(last, first)])


def law_of(kind, bounds, angle):
    """A law whose frame ``frame_of`` has."""
    if len(bounds) == 1:
        return kind(bounds[0])
    return kind(tuple(bounds), direction=(np.cos(angle), np.sin(angle), 0.0))


def nodal_data(solution, comm, contact=0):
    """Points of all conditions with their forces as vectors, sorted by point, on every rank."""
    data = solution.contact(contact)
    force = data.area[:, None] * data.tangential_traction - data.force[:, None] * data.normal
    return by_point(comm, data.points, force, data.status, data.slip)


def compare(p, u, x, force, frame, share=1e-7):
    """u and forces agree."""
    comm = p.dofs.comm
    scale = max(np.abs(u).max(), AT_REST)
    assert np.allclose(displacement(p)[1], u, rtol=0, atol=share * scale)
    points, found, status, slip = nodal_data(p.solution, comm)
    assert np.allclose(points[:, : u.shape[1]], x[:, : u.shape[1]])
    expected = -force @ frame
    assert np.allclose(found, expected, rtol=0, atol=share * max(np.abs(expected).max(), AT_REST))
    return status, slip


def on_the_plane(
    cell, n, subdomains, traction, bounds, angle=0.0, gap=0.0, kind=tfeti.Tresca, share=1e-7, **more
):
    d = decomposed(cell, n, subdomains)
    gdim = d.mesh.geometry.dim
    up = np.eye(gdim)[-1]
    law = law_of(kind, bounds, angle)
    plane = tfeti.Obstacle("bottom", tfeti.Plane(-gap * up, up), friction=law, reach=np.inf)
    p = solved(problem(d, traction, [plane], **EXACT, **more))
    frame = frame_of(gdim, angle, -1.0)
    both = np.resize(bounds, gdim - 1)
    scene = untorn.untorn_box(cell, n, traction)
    met = untorn.on_plane(scene, both, frame, gap, kind is tfeti.Coulomb)
    u, x = met.solve(), scene.x[scene.side("bottom")[0]]
    status, _ = compare(p, u, x, met.force, frame, share)
    return p, status


def stresses(low, high):
    """Numbers of a sensible size, or 0."""
    return st.integers(round(1e3 * low), round(1e3 * high)).map(lambda number: 1e-3 * number)


# of each law: the largest bound or coefficient, and how near u and forces are; the change of
# Coulomb's bounds at which they are at rest is 100 rtol
LAWS = pytest.mark.parametrize(
    "law", [(tfeti.Tresca, 0.05, 1e-7), (tfeti.Coulomb, 0.5, 1e-6)], ids=["Tresca", "Coulomb"]
)
ONE = stresses(0.0, 1.0)
SCENES_2D = st.tuples(
    st.sampled_from(["triangle", "quadrilateral"]),
    st.integers(2, 6),
    st.integers(1, 4),
    st.tuples(stresses(-0.06, 0.06), stresses(-0.08, 0.01)),
    ONE.map(lambda bound: (bound,)),
    st.just(0.0),
)
SCENES_3D = st.tuples(
    st.sampled_from(["tetrahedron", "hexahedron"]),
    st.integers(2, 3),
    st.integers(1, 4),
    st.tuples(stresses(-0.05, 0.05), stresses(-0.05, 0.05), stresses(-0.08, 0.01)),
    st.one_of(ONE.map(lambda bound: (bound,)), st.tuples(ONE, ONE)),
    st.floats(0.0, 3.0),
)


def by_law(law, scene):
    """A scene whose bounds are shares of the largest, and what goes with its law."""
    kind, most, share = law
    bounds = tuple(most * bound for bound in scene[4])
    return (*scene[:4], bounds, *scene[5:]), {"kind": kind, "share": share}


SCENES = pytest.mark.parametrize("scenes", [SCENES_2D, SCENES_3D], ids=["square", "cube"])


@LAWS
@SOLVERS
@SCENES
@settings(max_examples=5)
@given(st.data(), st.sampled_from([0.0, 0.01]))
def test_a_box_on_a_plane(qp_type, law, scenes, data, gap):
    scene, given = by_law(law, data.draw(scenes))
    on_the_plane(*scene, gap=gap, qp_type=qp_type, **given)


def test_some_nodes_stick_and_some_slip():
    p, status = on_the_plane("hexahedron", 4, 4, (0.0, -0.035, -0.05), (0.015,))
    assert p.report.sticking == np.sum(status == tfeti.ContactStatus.STICK) > 0
    assert p.report.sliding == np.sum(status == tfeti.ContactStatus.SLIP) > 0
    assert p.report.tangential_rows == 2 * p.report.contact_rows


def two_boxes(
    cell, n, subdomains, traction, bounds, angle, secondary, kind=tfeti.Tresca, share=1e-7, **more
):
    gdim, apart = (2 if cell in ("triangle", "quadrilateral") else 3), 0.05
    d = torn_boxes(cell, untorn.parts(gdim, n, n, apart), max(subdomains, 2))
    V, a, L = forms(d.mesh, d.facet_tags, traction, d.surface("upper top"))
    clamped = ("lower bottom", "upper left")
    given = {"secondary": secondary, "gap": 0.0, "reach": 0.3}
    pair = tfeti.Contact("lower top", "upper bottom", friction=law_of(kind, bounds, angle), **given)
    bcs = [clamp(V, d.facets(name)) for name in clamped]
    options = {**EXACT, **more}
    p = solved(tfeti.ContactProblem(a, L, bcs, [pair], d, stress=hooke(), petsc_options=options))
    frame, both = frame_of(gdim, angle, 1.0), np.resize(bounds, gdim - 1)
    scene, coulomb = untorn.two_boxes(cell, traction, clamped, n, n, apart), kind is tfeti.Coulomb
    (below, area), (above, _) = scene.side("lower top"), scene.side("upper bottom")
    entries = [{int(a): 1.0, int(b): -1.0} for a, b in zip(below, above, strict=True)]
    axes = (np.ones_like(area) if coulomb else area)[:, None] * both
    met = untorn.Conditions(scene, entries, 0.0, axes, frame, coulomb)
    u, x, force = met.solve(), scene.x[below], met.force
    if secondary == "upper bottom":
        x, force = x + apart * np.eye(3)[gdim - 1], -force
    compare(p, u, x, force, frame, share)
    # what acts on one box reacts on the other
    total = p.solution.body_forces.force
    assert np.allclose(total.sum(axis=0), 0.0, rtol=0, atol=1e-12)
    return p


SIDES = st.sampled_from(["lower top", "upper bottom"])


@LAWS
@SOLVERS
@SCENES
@settings(max_examples=4)
@given(st.data(), SIDES)
def test_a_box_on_a_box(qp_type, law, scenes, data, secondary):
    scene, given = by_law(law, data.draw(scenes))
    two_boxes(*scene, secondary, qp_type=qp_type, **given)
