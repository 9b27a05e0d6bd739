"""Slender cantilevers over a plane are as in beam theory, whether they touch or not."""

import numpy as np
import pytest
from bodies import clamped, pressed, torn_boxes, two_body_problem
from scenes import displacement, hooke, solved

import tfeti_dolfinx as tfeti

E, NU, LOAD = 1.0, 0.3, 1e-7  # of load: so much in all that the beam bends a little
PLATE = E / (1.0 - NU**2)  # modulus of bending in plane strain
SHEAR = 5.0 / 6.0 * E / (2.0 * (1.0 + NU))
# deflections by a unit load in all, on the right end or on the top (Timoshenko)
FREE_TIP = {
    "right": lambda length: 4.0 * length**3 / PLATE + length / SHEAR,
    "top": lambda length: 1.5 * length**3 / PLATE + 0.5 * length / SHEAR,
}


def cantilever(loaded, length, gap, subdomains=8):
    """A beam of unit height, clamped on the left, and the deflection that it has without contact.

    ``gap`` is the height over the plane as a share of that; None: no plane.
    """
    tip = LOAD * FREE_TIP[loaded](length)
    parts = [("beam", (0.0, 0.0), (float(length), 1.0), (2 * length, 2))]
    d = torn_boxes("quadrilateral", parts, subdomains)
    plane = tfeti.Plane((0.0, -tip * (gap or 0.0)), (0.0, 1.0))
    contacts = [] if gap is None else [tfeti.Obstacle("beam bottom", plane, reach=np.inf)]
    pressure = pressed(d, LOAD / (length if loaded == "top" else 1.0), f"beam {loaded}")
    p = solved(two_body_problem(d, pressure, clamped(d, "beam left"), contacts, 2, hooke(E, NU)))
    x, u = displacement(p)
    return p, -u[np.isclose(x[:, 0], length)][:, 1].max(), tip


@pytest.mark.parametrize(("loaded", "length", "subdomains"), [("right", 20, 16), ("top", 40, 2)])
def test_a_plane_that_is_never_touched_costs_nothing(loaded, length, subdomains):
    """Two multiplications more at most, however far it is."""
    free, tip, expected = cantilever(loaded, length, None, subdomains)
    far, other, _ = cantilever(loaded, length, 100.0, subdomains)
    assert far.report.contact_rows > 0 == far.report.active_contacts
    assert far.report.F_multiplications <= free.report.F_multiplications + 2
    assert np.isclose(tip, other, rtol=1e-5)
    assert np.isclose(tip, expected, rtol=0.01)


def test_a_propped_cantilever_presses_as_beams_do():
    """The tip of a beam under uniform load rests on the plane: 3/8 of the load, less by the gap."""
    p, tip, free = cantilever("top", 40, 0.5)
    assert p.report.active_contacts > 0
    assert np.isclose(tip, 0.5 * free, rtol=0.01)
    force = p.solution.body_forces.force.sum(axis=0)
    assert np.isclose(force[1], 3.0 / 16.0 * LOAD, rtol=0.01)
