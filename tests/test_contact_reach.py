"""How far contacts look: one word, default and behaviour for obstacles and pairs."""

import numpy as np
import pytest
from bodies import gathered, held, pressed, sided, stacked, two_body_problem
from scenes import decomposed, displacement, problem, relative, solved

import tfeti_dolfinx as tfeti

SIDES = ("upper bottom", "lower top")


def below(distance, **changes):
    return tfeti.Obstacle("bottom", tfeti.Plane((0, -distance), (0, 1)), **changes)


@pytest.mark.parametrize("distance", [0.1, 1e6])
def test_an_obstacle_that_is_never_touched_changes_nothing(distance):
    d = decomposed("quadrilateral", 6)
    without, with_it = (problem(d, (0.0, -1e-3), some) for some in ([], [below(distance)]))
    without.solve()
    with_it.solve()
    assert with_it.report.contact_rows == 0
    assert with_it.report.F_multiplications == without.report.F_multiplications
    assert relative(displacement(with_it)[1], displacement(without)[1]) <= 1e-12
    assert with_it.report.unmet_contacts == ["0: obstacle of surface 'bottom'"]


@pytest.mark.parametrize("distance", [0.1, 1e3])
def test_a_pair_that_never_touches_changes_nothing(distance):
    found = []
    for contacts in ([], [sided(*SIDES)]):
        d = stacked("triangle", 3, 4, 4, gap=distance)
        sides = ["lower bottom", "lower left", "upper top", "upper left"]
        p = solved(two_body_problem(d, pressed(d, 1e-3, "upper right"), held(d, *sides), contacts))
        assert p.report.contact_rows == 0
        found.append(displacement(p)[1])
    assert relative(*found) <= 1e-12


def test_who_meets_nobody_is_said(caplog):
    d = stacked("quadrilateral", 3, 4, 4)
    sides = ["lower bottom", "lower left", "upper left"]
    contacts = [sided(*SIDES), sided("upper right", "lower right")]
    contacts += [tfeti.Obstacle("lower top", tfeti.Plane((0, 30), (0, -1)))]
    p = solved(two_body_problem(d, pressed(d), held(d, *sides), contacts))
    unmet = ["1: contact of 'upper right' with 'lower right'", "2: obstacle of surface 'lower top'"]
    assert p.report.unmet_contacts == unmet
    for name in unmet:
        assert (f"contact {name} has nothing within reach" in caplog.text) == (d.comm.rank == 0)
    assert "'upper bottom'" not in caplog.text


@pytest.mark.parametrize("reach", [None, 1e-3, np.inf])
def test_the_reach_does_not_change_the_answer(reach):
    """Of a plane that the load closes."""
    d = decomposed("quadrilateral", 8)
    found = [problem(d, (0.0, -0.05), [below(0.02, reach=one)], rtol=1e-10) for one in (reach, 1.0)]
    for p in found:
        p.solve()
    assert (found[0].report.late_contact_rows > 0) == (reach == 1e-3)
    assert 0 < found[0].report.active_contacts == found[1].report.active_contacts
    assert relative(*(displacement(p)[1] for p in found)) <= 1e-7


@pytest.mark.parametrize("rtol", [1e-2, 1e-3])
def test_a_punch_from_afar_presses_by_little(rtol):
    """Its way, of which rtol is a part, says nothing of how deep it presses."""
    d = stacked("quadrilateral", 3, 4, 4, gap=0.3)

    sides = ["lower bottom", "lower left", ("upper top", -0.3005), "upper left"]
    forces = []
    for one in (rtol, 1e-10):
        p = solved(two_body_problem(d, pressed(d, 0.0), held(d, *sides), [sided(*SIDES)], rtol=one))
        forces.append(p.solution.contact(0).resultant.force[1])
    assert forces[1] > 1e-4
    assert forces[0] == pytest.approx(forces[1], rel=rtol)


def test_a_body_that_only_a_far_obstacle_holds():
    """What is farther yet, and not needed, gets no rows."""
    d = decomposed("quadrilateral", 6)
    beyond = tfeti.Obstacle("top", tfeti.Plane((0, 1e6), (0, -1)))
    p = solved(problem(d, (0.0, -0.01), [below(5.0), beyond], clamped=(), rtol=1e-9))
    assert p.report.contact_rows == p.report.late_contact_rows == 7
    assert p.report.unmet_contacts == ["1: obstacle of surface 'top'"]
    assert np.isclose(gathered(p.solution.contact(0).force).sum(), 0.01)


@pytest.mark.parametrize("reach", [0.0, np.nan, "1", True])
def test_a_reach_that_is_none(reach):
    p = problem(decomposed("quadrilateral", 4), contacts=[below(0.1, reach=reach)])
    with pytest.raises(tfeti.InputError, match="obstacle of surface 'bottom': reach=.*, expected"):
        p.solve()
