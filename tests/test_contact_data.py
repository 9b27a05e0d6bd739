"""The state of a contact's nodes: found by name, with signs that are kept."""

from functools import partial

import numpy as np
import pytest
from bodies import clamped, gathered, held, no_load, pressed, stacked, two_body_problem
from dolfinx import fem
from scenes import decomposed, problem, solved

import tfeti_dolfinx as tfeti
from meshes import half_ball, half_cylinder
from meshes.tools import torn


@pytest.fixture(scope="module")
def stack():
    """A box on a box on a plane; the pair's name outlives the exchange of its sides."""
    d = stacked("quadrilateral", 4, 3)
    contacts = [
        tfeti.Obstacle("lower bottom", tfeti.Plane((0, -1), (0, 1))),
        tfeti.Contact("lower top", "upper bottom", name="joint"),
    ]
    bcs = held(d, "lower left", "upper left")
    return solved(two_body_problem(d, pressed(d), bcs, contacts, rtol=1e-10)).solution


def test_contacts_by_name_and_by_position(stack):
    for position, name in enumerate(("obstacle of surface 'lower bottom'", "joint")):
        assert stack.contacts[position].name == name  # whichever side becomes secondary
        by_name, by_position = stack.contact(name), stack.contact(position)
        assert isinstance(by_name, tfeti.ContactData)
        for field in vars(by_name).keys() - {"resultant"}:
            assert np.array_equal(getattr(by_name, field), getattr(by_position, field)), field
    assert tfeti.Contact("a", 3).name == "contact of 'a' with 3"
    assert tfeti.Obstacle("a", tfeti.Plane((0, 0), (0, 1))).name == "obstacle of surface 'a'"


@pytest.mark.parametrize("contact", [0, 1])
def test_force_pushes_against_the_normal(stack, contact, comm):
    """The resultant on the secondary body is −Σ force·normal."""
    data = stack.contact(contact)
    force = comm.allreduce(-data.force @ data.normal)
    assert np.allclose(force, (0.0, 0.1), rtol=0, atol=1e-7)
    # points of the secondary side lie on the body that the normal leaves: down, out of it
    assert np.allclose(gathered(data.normal), (0.0, -1.0), rtol=0, atol=1e-12)


def test_resultants_and_reactions_are_in_balance(stack):
    """Both boxes together: the floor's force, the supports' and the load, 0.1 downwards."""
    floor, joint = (stack.contact(k) for k in (0, 1))
    assert (floor.surface, joint.surface) == ("lower bottom", "upper bottom")
    assert np.allclose(floor.resultant.force, (0.0, 0.1), rtol=0, atol=1e-7)
    assert np.allclose(joint.resultant.moment, (0.0, 0.0, 0.05), rtol=0, atol=1e-7)
    sides = [stack.reaction(f"{box} left") for box in ("lower", "upper")]
    for side in sides:  # they may slide along
        assert abs(side.force[1]) < 1e-9
    total = floor.resultant.force + sum(side.force for side in sides)
    assert np.allclose(total, (0.0, 0.1), rtol=0, atol=1e-7)
    moment = floor.resultant.moment[2] + sum(side.moment[2] for side in sides)
    assert np.isclose(moment, 0.05, rtol=0, atol=1e-7)  # of the load, at the middle of the side


@pytest.mark.parametrize("mesh", [half_cylinder, half_ball])
def test_moments_on_curved_facets_are_in_balance(mesh, comm):
    """Facets of degree 2 are curved: a force acts on all their nodes, not at ends of chords."""
    build = partial(mesh.build, fine=0.2, fine_radius=0.3, growth=0.5)
    d = torn(comm, build, 3, order=2)
    gdim = d.mesh.geometry.dim
    given = np.array([0.003, -0.002, -0.01] if gdim == 3 else [0.003, -0.01])
    way = fem.Function(fem.functionspace(d.mesh, ("Lagrange", 2, (gdim,))))
    way.interpolate(lambda x: given[:, None] * (1.0 + x[0]))
    plane = tfeti.Plane((0.0,) * gdim, (0.0,) * (gdim - 1) + (1.0,))
    floor = [tfeti.Obstacle("contact", plane, friction=tfeti.Coulomb(0.3))]
    p = solved(two_body_problem(d, no_load, clamped(d, ("top", way)), floor, 2, rtol=1e-10))
    pushed, kept = p.solution.contact().resultant, p.solution.reaction("top")
    size = np.abs(pushed.moment).max()
    assert size > 1e-6
    assert np.allclose(pushed.force, -kept.force, rtol=0, atol=1e-9)
    assert np.allclose(pushed.moment, -kept.moment, rtol=0, atol=1e-7 * size)


def test_a_reaction_is_the_force_of_the_stress(comm):
    """A bar that is stretched: E ε on its end, friction of the floor beside it."""
    d = decomposed("quadrilateral", 4, 4)
    floor = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)), friction=tfeti.Tresca(0.01))
    p = solved(problem(d, traction=(0.02, -0.05), contacts=[floor], rtol=1e-10))
    p.destroy()  # its solution stays
    friction = p.solution.contact().resultant
    reaction = p.solution.reaction("left")
    assert np.allclose(reaction.force + friction.force, (-0.02, 0.05), rtol=0, atol=1e-8)
    assert np.isclose(reaction.moment[2] + friction.moment[2], 0.02 + 0.025, rtol=0, atol=1e-8)
    with pytest.raises(tfeti.InputError, match="no surface 'lid'"):
        p.solution.reaction("lid")


def test_bodies_are_in_the_order_of_their_names(stack):
    d = stack.decomposition
    assert list(dict.fromkeys(d.body_of_subdomain.tolist())) == [0, 1]
    assert d.body_names == [f"body {b}" for b in range(2)]
    # only the upper body, on which the lower one presses, has a resultant that is not 0
    size = np.abs(stack.body_forces.force[:, 1])
    assert np.allclose(np.sort(size), (0.0, 0.1), rtol=0, atol=1e-7)
