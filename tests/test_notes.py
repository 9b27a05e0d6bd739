"""Notes of the report: what is worth knowing of an answer whose displacement is right."""

import re

import numpy as np
import pytest
from bodies import held, pressed, sided, sides_of, stacked, two_body_problem
from scenes import decomposed, problem, solved

import tfeti_dolfinx as tfeti


@pytest.mark.parametrize("height", [-0.5, 0.0])
def test_contacts_none_of_which_touches_are_said(height):
    d = decomposed("quadrilateral", 3)
    floor = [tfeti.Obstacle("bottom", tfeti.Plane((0, height), (0, 1)), reach=1.0)]
    p = solved(problem(d, contacts=floor))
    said = [note for note in p.report.notes if note.startswith("no contact touches")]
    if height < 0.0:
        contact = p.report.contact()
        assert contact.touching == 0
        assert 0.0 < contact.gap < 0.5
        text = f"no contact touches (smallest gap {contact.gap:.2g}): the displacement is that "
        assert said == [f"{text}without contacts"]
        assert f"notes     {said[0]}" in str(p.report)
        with pytest.raises(tfeti.ConvergenceError, match=r"what rtol .*; no contact touches \(s"):
            problem(d, contacts=floor, max_it=1).solve()
    else:
        assert p.report.contacts[0].touching > 0
        assert said == []


def test_friction_of_a_given_bound_acts_on_contacts_none_of_which_touches():
    floor = tfeti.Plane((0, -0.5), (0, 1))
    rubs = tfeti.Obstacle("bottom", floor, reach=1.0, friction=tfeti.Tresca(0.02))
    p = solved(problem(decomposed("quadrilateral", 3), contacts=[rubs], traction=(0.05, -0.05)))
    (contact,) = p.report.contacts
    assert contact.touching == 0
    assert contact.resultant == pytest.approx([0.02 * (1.0 - 1.0 / 6.0), 0.0])  # less the corner
    assert p.report.notes == [
        f"no contact touches (smallest gap {contact.gap:.2g}): forces act across open gaps"
    ]


def test_no_contact_is_no_contact_that_does_not_touch():
    p = solved(problem(decomposed("quadrilateral", 3)))
    assert p.report.notes == []


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
@pytest.mark.parametrize(
    ("beyond", "secondary", "expected"),
    [(0.03, "lower top", True), (0.5, "lower top", False), (0.03, "upper bottom", False)],
)
def test_pressures_of_nodes_that_are_hardly_covered(cell, beyond, secondary, expected):
    """A block whose edge is a little beyond a node of the face on which it is pressed."""
    width, gap = (1.0 + beyond) / 3.0, -0.02 if beyond > 0.1 else 0.0
    d = stacked(cell, 3, 4, 4, upper=(0.0, width), gap=gap)
    primary = {"lower top": "upper bottom", "upper bottom": "lower top"}[secondary]
    contact = sided(secondary, primary, name="faces")
    p = solved(two_body_problem(d, pressed(d, 0.1), held(d, *sides_of(cell)), [contact]))
    found = [note for note in p.report.notes if note.startswith("faces: pressures go up to")]
    (summary,) = p.report.contacts
    load = 0.1 * width ** (d.mesh.geometry.dim - 1)
    assert np.isclose(abs(summary.resultant[-1]), load, rtol=1e-5)
    assert len(found) == expected
    overlaps = [note for note in p.report.notes if "surfaces overlap by up to 0.02" in note]
    assert len(overlaps) == (gap < 0.0)
    assert 0.1 <= summary.pressure <= 0.5  # 0.1 is the mean, and edges have more
    if expected:
        assert float(re.search(r"up to (\S+) at nodes", found[0])[1]) > 0.5
        assert f"they are at most {summary.pressure:.3g};" in found[0]
