"""Stabilised steps of bodies with mass whose supports move, near contact."""

import numpy as np
import pytest
import ufl
from bodies import stacked
from dolfinx import fem
from scenes import accepted, decomposed, elastic, largest, roller, vectors

import tfeti_dolfinx as tfeti

RTOL = 1e-8


class Driven:
    """Sides of a mesh go down or up by what ``place`` says; nothing else moves or loads."""

    def __init__(self, d, sides, contact):
        V, u, v = vectors(d)
        self.place, up = fem.Constant(d.mesh, 0.0), d.mesh.geometry.dim - 1
        self.problem = tfeti.ContactDynamics(
            elastic(u, v),
            ufl.ZeroBaseForm((v,)),
            [roller(V, up, d.facets(side), self.place) for side in sides],
            [contact],
            d,
            mass=1.0,
            stabilised=True,
            petsc_options={"rtol": RTOL},
        )

    def step(self, size, place):
        """Go on to where supports have a place; the report."""
        self.place.value = place
        self.problem.take_step(size)
        accepted(self.problem)
        return self.problem.report


def test_a_support_may_stop_just_above_a_plane():
    """u + τv, with what is prescribed going on as before, lies below it."""
    plane, rough = tfeti.Plane((0, -0.1), (0, 1)), tfeti.Tresca(0.01)
    floor = tfeti.Obstacle("bottom", plane, reach=1.0, friction=rough)
    scene = Driven(decomposed("quadrilateral", 4, 4), ["left"], floor)
    for n in range(1, 9):
        report = scene.step(0.2, -0.095 * min(n / 5, 1))
        assert report.motion["predictor"] <= RTOL * report.motion["energy"]
        assert np.all(scene.problem.solution.remaining_gap >= -0.1 * RTOL)


def test_a_body_that_a_support_has_not_reached_stays_where_it_is():
    """The support stops before the gap is closed, with a velocity that would have closed it."""
    contact = tfeti.Contact("upper bottom", "lower top", reach=1.0)
    d = stacked("quadrilateral", 2, 3, 4, gap=0.12)
    scene = Driven(d, ["lower bottom", "lower top"], contact)
    V = scene.problem.u.function_space
    above = V.tabulate_dof_coordinates()[:, 1] > 0.06
    for place in (0.05, 0.1, 0.1, 0.1):
        report = scene.step(0.5, place)
        moved = scene.problem.u.x.array.reshape(-1, 2)[above]
        assert largest(moved) <= RTOL * 0.1
        assert report.contact_forces == [[0.0, 0.0]]
        assert report.motion["predictor"] == pytest.approx(0.0, abs=1e-12)
