"""A step of bodies with mass that is solved again, with another mass, stiffness or size."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from scenes import apart, decomposed, elastic, vectors

import tfeti_dolfinx as tfeti

RTOL = 1e-9


class Stretched:
    """A square that lies on a plane and is let go; its displacement at the begin is not 0."""

    def __init__(self, stabilised):
        d = decomposed("quadrilateral", 4, 4)
        V, u, v = vectors(d)
        self.data = {"E": fem.Constant(d.mesh, 1.0), "density": fem.Constant(d.mesh, 1.0)}
        begin = fem.Function(V)
        begin.interpolate(lambda x: np.stack((0.1 * x[0] ** 2, 0.2 * x[1])))
        self.problem = tfeti.ContactDynamics(
            self.data["E"] * elastic(u, v),
            ufl.ZeroBaseForm((v,)),
            [],
            [tfeti.Obstacle("bottom", tfeti.Plane((0, 0), (0, 1)))],
            d,
            mass=self.data["density"],
            stabilised=stabilised,
            u=begin,
            petsc_options={"rtol": RTOL},
        )

    def solve(self, step, data):
        """Of a step from the begin: displacements and velocities of this rank."""
        for name, value in data.items():
            self.data[name].value = value
        self.problem.take_step(step)
        u = self.problem.solve().x.array.copy()
        return np.concatenate((u, self.problem.solution.velocity.x.array))


@pytest.mark.parametrize(
    ("stabilised", "change"),
    [(False, (0.4, {})), (True, (0.2, {"E": 3.0})), (False, (0.2, {"density": 0.2}))],
)
def test_a_step_that_is_solved_again_is_that_of_the_new_data(stabilised, change):
    """The load of a step has 2Mw/τ² − Ku/2 in it, also where u, v and the load have stayed."""
    scene, other = Stretched(stabilised), Stretched(stabilised)
    first = scene.solve(0.2, {})
    scene.problem.go_back()
    again, anew = scene.solve(*change), other.solve(*change)
    assert apart(first, anew) > 0.01
    assert apart(again, anew) <= 100 * RTOL


def test_a_state_is_gone_on_from_with_another_density():
    """Or with a step whose size was said before the state was taken."""
    scene = Stretched(False)
    scene.solve(0.2, {})
    scene.problem.accept()
    state = scene.problem.state()
    anew = scene.solve(0.1, {"density": 0.5})
    for before in (0.2, 0.1):
        other = Stretched(False)
        other.problem.take_step(before)
        other.problem.restore(state)
        found = other.solve(0.1, {"density": 0.5})
        assert np.allclose(found, anew, rtol=0, atol=100 * RTOL)
