"""Problems without a solution are recognised and explained, not iterated on."""

import numpy as np
import pytest
import ufl
from bodies import boxes, clamped, drawn, two_body_problem
from dolfinx import fem
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, decomposed, problem, solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx import NoSolutionError
from tfeti_dolfinx.feti.solvability import check_solvable


@pytest.mark.parametrize(
    ("load", "contact", "says"),
    [
        ((0.1, 0, -0.05), True, r"\(volume 'ball'\) is free to move \(translation in x\): nothing"),
        ((0, 0, -0.05), False, r"translation in z\): nothing resists that"),
        ((0, 0, 0.05), True, r"translation in z\): only contact could resist that"),
    ],
)
def test_what_moves_a_body_is_named(load, contact, says):
    mesh, tags, names = box("hexahedron", 2)
    ball = {"ball": lambda x: x[0] > -1}
    d = tfeti.decompose(mesh, 3, facet_tags=tags, surfaces=names, volumes=ball)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0, -0.01), (0, 0, 1)))
    p = problem(d, load, [floor] if contact else [], clamped=())
    with pytest.raises(NoSolutionError, match=says):
        p.solve()


def test_an_arch_fails_where_blocks_turn_at_its_joints():
    """A load a little beyond what rigid blocks bear: more friction nearly holds it."""
    parts = [(f"{k}", (1.001 * k, 5.0), (1.001 * k + 1, 6.0), (4 + k % 2, 4)) for k in range(7)]
    mesh, tags, names = boxes("quadrilateral", parts)
    angle, r = mesh.geometry.x.T[:2] * [[np.pi / 7.006], [1.0]]
    mesh.geometry.x[:, :2] = np.stack((-r * np.cos(angle), r * np.sin(angle)), axis=1)
    d = tfeti.decompose(mesh, 7, facet_tags=tags, surfaces=names)
    law, floor = {"friction": tfeti.Coulomb(0.7)}, tfeti.Plane((0, 0), (0, 1))
    contacts = [tfeti.Contact(f"{k} right", f"{k + 1} left", gap=0.0, **law) for k in range(6)]
    contacts += [tfeti.Obstacle(end, floor, **law) for end in ("0 left", "6 right")]
    crowd, held = drawn(d, "2 top", (0.0, -0.06)), lambda V: []
    p = two_body_problem(d, lambda v, ds: crowd(v, ds) - 0.02 * v[1] * ufl.dx, held, contacts)
    with pytest.raises(NoSolutionError, match="free to move together"):
        p.solve()


def test_a_load_that_turns_is_looked_at_again_and_one_that_grows_is_not(monkeypatch):
    """A block that a floor alone holds: pressed, three times as hard, then pulled off it."""
    asked = []
    looks = "tfeti_dolfinx.feti.dual.check_solvable"
    monkeypatch.setattr(looks, lambda *given: asked.append(check_solvable(*given)))
    d, weight = decomposed("quadrilateral", 4, 2), (0.0, -0.05)
    force = fem.Constant(d.mesh, weight)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)))
    p = solved(two_body_problem(d, drawn(d, None, force), clamped(d), [floor]))
    force.value = (0.0, -0.15)
    before = len(asked)
    p.solve()
    pressed = d.comm.allreduce(p.solution.contact(0).force.sum())
    assert (len(asked), pressed) == (before, pytest.approx(0.15, rel=1e-4))
    force.value = (0.0, 0.05)
    with pytest.raises(NoSolutionError, match="only contact could resist that"):
        p.solve()


@settings(max_examples=10)
@given(st.floats(-0.4, 1.4), st.floats(0.05, 1.0))
def test_solvable_just_if_the_resultant_is_over_the_support(centre, width):
    """A block on a flat floor, loaded by a pressure around ``centre``: it stands or tips."""
    d = decomposed("quadrilateral", 4, 2)
    x = ufl.SpatialCoordinate(d.mesh)
    # a linear pressure on the top of resultant 1 at x = c; its first moment about 0 is c
    c = centre * width + 0.5 * (1 - width)
    at = fem.Constant(d.mesh, c)  # one form for all examples
    pressure = (4 - 6 * at) + (12 * at - 6) * x[0]
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)))
    # of two points, exact for it times a hat
    p = two_body_problem(
        d, lambda v, ds: -pressure * v[1] * ds(d.surface("top")), clamped(d), [floor]
    )
    if 1e-3 < c < 1 - 1e-3:
        p.solve()
        force = d.comm.allreduce(p.solution.contact(0).force.sum())
        assert force == pytest.approx(1.0, rel=1e-4)
    elif c < -1e-3 or c > 1 + 1e-3:
        with pytest.raises(NoSolutionError, match="only contact could resist that"):
            p.solve()
