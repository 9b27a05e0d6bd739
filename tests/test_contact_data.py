"""The state of a contact's nodes: found by name, with signs that are kept."""

import numpy as np
import pytest
from bodies import gathered, held, pressed, stacked, two_body_problem

import tfeti_dolfinx as tfeti


@pytest.fixture(scope="module")
def stack():
    """A box on a box on a plane; the pair's name outlives the exchange of its sides."""
    d = stacked("quadrilateral", 4, 3)
    contacts = [
        tfeti.Obstacle("lower bottom", tfeti.Plane((0, -1), (0, 1))),
        tfeti.Contact("lower top", "upper bottom", name="joint"),
    ]
    p = two_body_problem(d, pressed(d), held(d, "lower left", "upper left"), contacts, rtol=1e-10)
    p.solve()
    return p.solution


def test_contacts_by_name_and_by_position(stack):
    for position, name in enumerate(("obstacle of surface 'lower bottom'", "joint")):
        assert stack.contacts[position].name == name  # whichever side becomes secondary
        by_name, by_position = stack.contact(name), stack.contact(position)
        assert isinstance(by_name, tfeti.ContactData)
        for field in vars(by_name):
            assert np.array_equal(getattr(by_name, field), getattr(by_position, field)), field


def test_a_default_name_has_both_surfaces():
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


def test_bodies_are_in_the_order_of_their_names(stack):
    d = stack.decomposition
    assert list(dict.fromkeys(d.body_of_subdomain.tolist())) == [0, 1]
    assert d.body_names == [f"body {b}" for b in range(2)]
    # only the upper body, on which the lower one presses, has a resultant that is not 0
    size = np.abs(stack.body_forces.force[:, 1])
    assert np.allclose(np.sort(size), (0.0, 0.1), rtol=0, atol=1e-7)
